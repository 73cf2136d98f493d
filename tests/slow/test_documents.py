"""What README.md and docs/ show works as it stands there.

Python snippets run as they are, those of a page one after the other in one process. Commands run as
they are too, with SHORTER appended; of an option that is given twice the last counts.
"""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import textwrap
import time
import tomllib
from pathlib import Path

import pytest
from processes import python, run

import quadrl
from quadrl import tasks
from quadrl.learning.plan import read_plan
from scripts.reports import pages, report

REPOSITORY = Path(__file__).parents[2]
PAGES = [*pages.all_pages(), REPOSITORY / "CONTRIBUTING.md"]
TEXTS = {str(page.relative_to(REPOSITORY)): page.read_text() for page in PAGES}
LANGUAGES = {"python", "bash", "bibtex", "diff", "toml", ""}  # the first two are run
SCRIPTS = ("scripts/quickstart", "scripts/test")
SHORT_TRAINING = ("--steps", "8192", "--episodes", "4", "--no-video")
SHORTER = {
    "train": SHORT_TRAINING,
    "evaluate": ("--episodes", "4"),
    "render": ("--width", "160", "--height", "120", "--fps", "2"),
    "robustness": ("--episodes", "2", "--no-recovery"),
    "benchmark": ("--num-envs", "8", "--seconds", "0.01", "--repeats", "1"),
}
STUDIES = sorted((REPOSITORY / "docs" / "studies").glob("*.toml"))
RUN = "runs/hover"  # what the pages call their run


RUNNER = "import runpy, sys\nfor path in sys.argv[1:]: runpy.run_path(path, run_name='__main__')"


def blocks(language):
    """The fenced blocks of each page that has any, also those of its tabs."""
    pattern = re.compile(rf"^( *)```{language}\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)
    found = {
        page: [textwrap.dedent(block) for _, block in pattern.findall(text)]
        for page, text in TEXTS.items()
    }
    return {page: blocks for page, blocks in found.items() if blocks}


PYTHON = blocks("python")
COMMANDS = [
    line
    for page in blocks("bash").values()
    for block in page
    for line in block.splitlines()
    if line
]
PIP = [command for command in COMMANDS if command.startswith("python -m pip ")]
QUADRL = list(dict.fromkeys(command for command in COMMANDS if command.startswith("quadrl ")))
VIEWS = [command for command in QUADRL if command.startswith("quadrl view ")]


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
    run(scripts / "quickstart", *SHORT_TRAINING, cwd=folder)
    return folder


@pytest.fixture
def folder(trained, tmp_path):
    """A folder of its own with that run."""
    shutil.copytree(trained / RUN, tmp_path / RUN)
    return tmp_path


@pytest.mark.parametrize("page", PYTHON)
def test_python_snippets_run(page, folder):
    names = [f"snippet_{k}.py" for k in range(len(PYTHON[page]))]
    for name, snippet in zip(names, PYTHON[page], strict=True):
        (folder / name).write_text(snippet)
    python("-c", RUNNER, *names, cwd=folder)


@pytest.mark.parametrize("command", [command for command in QUADRL if command not in VIEWS])
def test_quadrl_command_runs(command, folder):
    _, *arguments = shlex.split(command)
    if RUN in arguments and arguments[arguments.index(RUN) - 1] == "--out":
        shutil.rmtree(folder / RUN)  # this command makes it
    shorter = SHORTER.get(arguments[0], ())
    for option in shorter:  # each is given once
        if option.startswith("--") and option in arguments:
            at = arguments.index(option)
            del arguments[at : at + (1 if option.startswith("--no-") else 2)]
    python("-m", "quadrl", *arguments, *shorter, cwd=folder)


@pytest.mark.parametrize("command", VIEWS)
def test_quadrl_view_flies_until_it_is_interrupted(command, folder):
    _, *arguments = shlex.split(command, comments=True)
    program = (sys.executable, "-m", "quadrl", *arguments, "--port", "0")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(program, cwd=folder, **pipes) as viewer:
        assert "http://localhost:" in viewer.stdout.readline()
        time.sleep(2.0)
        viewer.send_signal(signal.SIGINT)
        rest = viewer.stdout.read()
    assert viewer.returncode == 0, rest
    assert rest == "stopped\n"


def test_every_command_is_checked():
    for page, text in TEXTS.items():
        fences = re.findall(r"^ *```(.*)$", text, re.MULTILINE)
        assert set(fences[::2]) <= LANGUAGES, page
    for command in COMMANDS:
        assert command in (*QUADRL, *SCRIPTS, *PIP), command
    for script in SCRIPTS:
        assert os.access(REPOSITORY / script, os.X_OK)
        run("bash", "-n", REPOSITORY / script)


@pytest.mark.parametrize("command", sorted(set(PIP)))
def test_pip_command_names_what_there_is(command):
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    _, _, _, install, *options, target = shlex.split(command)
    assert install == "install"
    if options:
        option, constraints = options
        assert option == "--constraint" and (REPOSITORY / constraints).is_file()
    name, extras, where = re.fullmatch(
        r"(\.|quadrl)\[(.*)\](| @ git\+\$REPOSITORY)", target
    ).groups()
    assert name == ("." if options else project["name"]) and not (options and where)
    assert set(extras.split(",")) <= set(project["optional-dependencies"])


def test_every_task_has_a_page():
    for name in tasks.TASKS:
        assert f"<!-- begin task-{name} -->" in TEXTS[f"docs/tasks/{name}.md"]


def test_pages_count_the_tasks_and_the_aircraft():
    counted = f"[{len(tasks.TASKS)} tasks](tasks.md)"
    assert counted in TEXTS["docs/index.md"] and counted in TEXTS["docs/clients.md"]
    assert f"[{len(quadrl.VEHICLES)} aircraft](aircraft.md)" in TEXTS["docs/index.md"]


def test_actions_of_workflows_are_pinned():
    for file in (REPOSITORY / ".github" / "workflows").glob("*.yml"):
        for use in re.findall(r"uses: (.*)", file.read_text()):
            assert re.fullmatch(r"[\w/-]+@[0-9a-f]{40}  # v[\d.]+", use), (file, use)


@pytest.mark.parametrize("file", STUDIES, ids=lambda file: file.stem)
def test_every_study_can_be_read_and_is_on_a_page(file, tmp_path):
    assert read_plan(file, tmp_path).runs
    assert any(f"docs/studies/{file.name}" in text for text in TEXTS.values())


@pytest.mark.parametrize("name", ["paper", "paper_noise"])
def test_studies_of_the_paper_can_be_trained(name, tmp_path):
    plan = read_plan(REPOSITORY / "docs" / "studies" / f"{name}.toml", tmp_path)
    assert {run.config.seed for run in plan.runs} == {*range(1000, 1020)}
    assert f"docs/studies/{name}.toml" in TEXTS["docs/paper.md"]
    # A task's algorithms get as many steps, and practise the same.
    practised = {
        task: {
            (run.config.steps, str(sorted(run.config.training_options.items())))
            for run in plan.runs
            if run.config.task == task
        }
        for task in {run.config.task for run in plan.runs}
    }
    assert {task: len(each) for task, each in practised.items()} == dict.fromkeys(practised, 1)


def test_quickstart_makes_the_run_folder_that_the_page_lists(trained):
    (table,) = re.findall(
        r"^A run is a folder:\n\n(.*?)\n\n", TEXTS["docs/training.md"], re.MULTILINE | re.DOTALL
    )
    listed = {name.rstrip("/") for name in re.findall(r"`([\w.]+/?)`", table)}
    assert listed - {"flight.mp4"} == {path.name for path in (trained / RUN).iterdir()}


def test_generated_parts_are_up_to_date():
    pages.pages(check=True)


@pytest.mark.parametrize("page", PAGES, ids=TEXTS)
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


def test_pictures_are_shown_and_small_and_the_readme_is_short():
    assert len(TEXTS["README.md"].splitlines()) < 200
    whole = "".join(TEXTS.values())
    for picture in report.IMAGES.rglob("*.*"):
        moves = picture.suffix == ".webp"
        assert picture.stat().st_size < (1_500_000 if moves else 400_000), picture.name
        assert picture.name in whole, f"{picture.name} is not shown"
