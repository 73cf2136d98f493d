"""What README.md and docs/ show works as it stands there.

Python snippets run as they are. Commands run as they are too, with SHORTER appended; of an option
that is given twice the last counts.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from scripts.reports import pages, report

REPOSITORY = Path(__file__).parents[2]
PAGES = [*report.pages(), REPOSITORY / "CONTRIBUTING.md"]
TEXTS = {page.name: page.read_text() for page in PAGES}
SCRIPTS = ("scripts/quickstart", "scripts/test")
SHORT_TRAINING = ("--steps", "8192", "--episodes", "4", "--no-video")
SHORTER = {
    "train": SHORT_TRAINING,
    "evaluate": ("--episodes", "4"),
    "render": ("--width", "160", "--height", "120", "--fps", "2"),
    "benchmark": ("--num-envs", "8", "--seconds", "0.01", "--repeats", "1"),
}
RUN = "runs/hover"  # what the pages call their run
REPLACED = ("in free flight .", "one a rotor", "is allowed", "pilot", "door")


def blocks(language):
    """(name, content) of the fenced blocks of all pages."""
    pattern = re.compile(rf"^```{language}\n(.*?)^```$", re.MULTILINE | re.DOTALL)
    return [
        pytest.param(block, id=f"{page.removesuffix('.md')}-{k}")
        for page, text in TEXTS.items()
        for k, block in enumerate(pattern.findall(text))
    ]


COMMANDS = [line for block in blocks("bash") for line in block.values[0].splitlines() if line]
QUADRL = list(dict.fromkeys(command for command in COMMANDS if command.startswith("quadrl ")))


def run(command, folder):
    done = subprocess.run(
        command, cwd=folder, env=report.ENVIRONMENT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder in which scripts/quickstart has made the README's run, shortly.

    The script itself, in a repository whose environment is the one that the tests run in.
    """
    folder = tmp_path_factory.mktemp("trained")
    scripts, programs = folder / "scripts", folder / ".venv" / "bin"
    scripts.mkdir()
    programs.mkdir(parents=True)
    shutil.copy(REPOSITORY / "scripts" / "quickstart", scripts)
    (scripts / "lib.sh").write_text(
        f'REPOSITORY="{folder}"\nENVIRONMENT="$REPOSITORY/.venv"\nensure_environment() {{ :; }}\n'
    )
    program = programs / "quadrl"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m quadrl "$@"\n')
    program.chmod(0o755)
    run((scripts / "quickstart", *SHORT_TRAINING), folder)
    return folder


@pytest.fixture
def folder(trained, tmp_path):
    """A folder of its own with that run."""
    shutil.copytree(trained / RUN, tmp_path / RUN)
    return tmp_path


@pytest.mark.parametrize("snippet", blocks("python"))
def test_python_snippet_runs(snippet, folder):
    (folder / "snippet.py").write_text(snippet)
    run((sys.executable, "snippet.py"), folder)


@pytest.mark.parametrize("command", QUADRL)
def test_quadrl_command_runs(command, folder):
    _, *arguments = shlex.split(command)
    if "--out" in arguments:
        shutil.rmtree(folder / RUN)  # this command makes it
    shorter = SHORTER.get(arguments[0], ())
    run((sys.executable, "-m", "quadrl", *arguments, *shorter), folder)


def test_every_command_is_checked():
    for command in COMMANDS:
        known = (*QUADRL, *SCRIPTS)
        assert command in known or command.startswith("python -m pip "), command
    for script in SCRIPTS:
        assert os.access(REPOSITORY / script, os.X_OK)
        subprocess.run(("bash", "-n", REPOSITORY / script), check=True)


def test_pip_command_names_what_there_is():
    (command,) = [command for command in COMMANDS if command.startswith("python -m pip ")]
    *_, option, constraints, target = shlex.split(command)
    assert option == "--constraint" and (REPOSITORY / constraints).is_file()
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = re.fullmatch(r"\.\[(.*)\]", target).group(1).split(",")
    assert set(extras) <= set(project["optional-dependencies"])


def test_quickstart_makes_the_run_folder_that_the_page_lists(trained):
    (table,) = re.findall(r"^\| file \|.*?\n\n", TEXTS["training.md"], re.MULTILINE | re.DOTALL)
    listed = {name.rstrip("/") for name in re.findall(r"`([\w.]+/?)`", table)}
    assert listed - {"flight.mp4"} == {path.name for path in (trained / RUN).iterdir()}


def test_generated_parts_are_up_to_date():
    pages.main(check=True)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_names_lead_somewhere(page):
    text = page.read_text()
    for target in re.findall(r"\]\(([^)]+)\)", text):
        path, _, anchor = target.partition("#")
        there = page.parent / path if path else page
        assert "://" in target or there.exists(), target
        if anchor:
            heads = re.findall(r"^#+ (.*)$", there.read_text(), re.MULTILINE)
            assert anchor in [re.sub(r"[^\w -]", "", h).lower().replace(" ", "-") for h in heads]
    for name in re.findall(r"`((?:quadrl|tests|tasks|scripts|docs|assets)/[\w./]+)`", text):
        assert (REPOSITORY / name).exists(), name


def test_pictures_are_shown_and_small():
    whole = "".join(TEXTS.values())
    for picture in report.IMAGES.rglob("*.*"):
        assert picture.stat().st_size < 400_000, picture.name
        assert picture.name in whole, f"{picture.name} is not shown"


def test_words_that_were_replaced_stay_away():
    generators = {path.name: path.read_text() for path in Path(report.__file__).parent.glob("*.py")}
    for name, text in (TEXTS | generators).items():
        for words in REPLACED:
            assert not re.search(rf"(?<!\w){re.escape(words)}(?!\w)", text), f"{name}: {words}"
    assert len(TEXTS["README.md"].splitlines()) < 200
