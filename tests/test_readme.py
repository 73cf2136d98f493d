"""What README.md and docs/ show works as it stands there.

Python snippets run as they are. Commands run as they are too, with SHORTER appended where they
would take long; of an option that is given twice the last counts.
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

REPOSITORY = Path(__file__).parents[1]
README = REPOSITORY / "README.md"
PAGES = (README, *sorted((REPOSITORY / "docs").glob("*.md")))
SCRIPTS = ("quickstart", "test")
SHORT_TRAINING = ("--steps", "8192", "--episodes", "4", "--no-video")
SHORTER = {
    "train": SHORT_TRAINING,
    "evaluate": ("--episodes", "4"),
    "render": ("--width", "160", "--height", "120", "--fps", "2"),
    "benchmark": ("--num-envs", "8", "--seconds", "0.01", "--repeats", "1"),
}
RUN = "runs/hover"  # what the README calls its run


def blocks(language):
    """(name, content) of the fenced blocks of all pages."""
    found = []
    for page in PAGES:
        texts = re.findall(
            rf"^```{language}\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL
        )
        found += [pytest.param(text, id=f"{page.stem}-{k}") for k, text in enumerate(texts)]
    return found


COMMANDS = [line for block in blocks("bash") for line in block.values[0].splitlines() if line]
QUADRL = [command for command in COMMANDS if command.startswith("quadrl ")]


def environment():
    """Environment variables with which the repository's package is found from anywhere."""
    paths = [str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)}


def run(command, folder):
    return subprocess.run(
        command, cwd=folder, env=environment(), capture_output=True, text=True, timeout=300
    )


def quadrl(*arguments):
    return (sys.executable, "-m", "quadrl", *arguments)


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
    done = run((scripts / "quickstart", *SHORT_TRAINING), folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture
def folder(trained, tmp_path):
    """A folder of its own with that run."""
    shutil.copytree(trained / RUN, tmp_path / RUN)
    return tmp_path


# ---------------------------------------------------------------------------- snippets and commands


@pytest.mark.parametrize("snippet", blocks("python"))
def test_python_snippet_runs(snippet, folder):
    (folder / "snippet.py").write_text(snippet)
    done = run((sys.executable, "snippet.py"), folder)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", QUADRL)
def test_quadrl_command_runs(command, folder):
    _, *arguments = shlex.split(command)
    if "--out" in arguments:
        shutil.rmtree(folder / RUN)  # the README makes it with this command
    done = run(quadrl(*arguments, *SHORTER.get(arguments[0], ())), folder)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_command_is_one_that_is_checked():
    scripts = [f"scripts/{name}" for name in SCRIPTS]
    for command in COMMANDS:
        known = command in QUADRL or command in scripts or command.startswith("python -m pip ")
        assert known, f"nothing checks {command!r}"


def test_every_subcommand_is_shown():
    from quadrl.cli import COMMANDS as SUBCOMMANDS

    assert {shlex.split(command)[1] for command in QUADRL} == set(SUBCOMMANDS)


def test_pip_command_names_what_there_is():
    (command,) = [command for command in COMMANDS if command.startswith("python -m pip ")]
    *_, option, constraints, target = shlex.split(command)
    assert (option, constraints) == ("--constraint", "constraints.txt")
    assert (REPOSITORY / constraints).is_file()
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = re.fullmatch(r"\.\[(.*)\]", target).group(1).split(",")
    assert set(extras) <= set(project["optional-dependencies"])


# -------------------------------------------------------------------------------------- the scripts


@pytest.mark.parametrize("name", SCRIPTS)
def test_script_is_there_and_sound(name):
    path = REPOSITORY / "scripts" / name
    assert os.access(path, os.X_OK)
    assert run(("bash", "-n", path), REPOSITORY).returncode == 0


def test_quickstart_makes_the_run_folder_that_the_readme_lists(trained):
    (table,) = re.findall(r"^\| file \|.*?\n\n", README.read_text(), re.MULTILINE | re.DOTALL)
    listed = {name.rstrip("/") for name in re.findall(r"`([\w.]+/?)`", table)}
    assert listed - {"flight.mp4"} == {path.name for path in (trained / RUN).iterdir()}


# ----------------------------------------------------------------------------------- the rest of it


def test_generated_parts_are_up_to_date():
    done = run((sys.executable, REPOSITORY / "scripts" / "readme_table", "--check"), REPOSITORY)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", [pytest.param(page, id=page.name) for page in PAGES])
def test_links_lead_somewhere(page):
    targets = re.findall(r"\]\(([^)]+)\)", page.read_text())
    for target in targets:
        if "://" not in target:
            assert (page.parent / target.partition("#")[0]).exists(), target


@pytest.mark.parametrize("page", [pytest.param(page, id=page.name) for page in PAGES])
def test_files_that_are_named_exist(page):
    named = re.findall(r"`((?:quadrl|tests|tasks|scripts|docs|assets)/[\w./]+)`", page.read_text())
    for name in named:
        assert (REPOSITORY / name).exists(), name


def test_pictures_are_small():
    pages = "".join(page.read_text() for page in PAGES)
    for picture in (REPOSITORY / "docs" / "images").rglob("*.*"):
        assert picture.stat().st_size < 400_000, picture.name
        assert picture.name in pages, f"{picture.name} is not shown"
