"""What README.md and docs/ show works as it stands there.

Python snippets run as they are, those of a page one after the other in one process. Commands run as
they are too, with SHORTER appended; of an option that is given twice the last counts. Those of a
block that makes a run of its own run one after the other in one folder. Commands in sentences and
studies, which would take hours, are parsed, and the settings of trainings are checked.
"""

import dataclasses
import functools
import importlib.util
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
from quadrl import cli, tasks
from quadrl.cli.flown import parse_options
from quadrl.learning.plan import read_plan
from scripts.reports import pages, report

REPOSITORY = Path(__file__).parents[2]
PAGES = [*pages.all_pages(), REPOSITORY / "CONTRIBUTING.md"]
TEXTS = {str(page.relative_to(REPOSITORY)): page.read_text() for page in PAGES}
LANGUAGES = {"python", "bash", "bibtex", "c", "diff", "toml", ""}  # the first two are run
SCRIPTS = ("scripts/quickstart", "scripts/test")
ACTIVATES = "source .venv/bin/activate"
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
UNRUN = (
    "quadrl view ",
    "quadrl study ",
    "quadrl identify ",
    "quadrl replay ",
    "quadrl crosscheck ",
)  # tested in another way
REFERENCE = {f"docs/{name}.md" for name in ("api", "cli", "paper", "results")}
GUIDES = sorted(x for x in TEXTS if re.fullmatch(r"docs/(tasks/)?\w+\.md", x) if x not in REFERENCE)
FENCE = re.compile(r"^( *)```(.*)\n((?:.*\n)*?)\1```$", re.MULTILINE)  # indent, language, block


RUNNER = """
import importlib, runpy, sys
for name in sys.argv[1:]:  # a file that a reader saves is imported
    snippet = name.startswith("snippet")
    runpy.run_path(name, run_name="__main__") if snippet else importlib.import_module(name)
"""


def blocks(language):
    """The fenced blocks of each page that has any, also those of its tabs."""
    found = {
        page: [textwrap.dedent(block) for _, own, block in FENCE.findall(text) if own == language]
        for page, text in TEXTS.items()
    }
    return {page: blocks for page, blocks in found.items() if blocks}


def commands(block):
    """The commands of a block; a line may go on in the next one."""
    return [line for line in re.sub(r"\\\n *", "", block).splitlines() if line]


def in_turn(block):
    """Its commands of quadrl, those together that need a run which another of them makes."""
    found = [x for x in commands(block) if x.startswith("quadrl ") and not x.startswith(UNRUN)]
    made = re.findall(r"--out (runs/\S+)|--name (\S+)", block)
    alone = {out or f"runs/{name}" for out, name in made} <= {RUN}
    return [(command,) for command in found] if alone else [tuple(found)] * bool(found)


PYTHON = blocks("python")
BASH = [block for page in blocks("bash").values() for block in page]
COMMANDS = [command for block in BASH for command in commands(block)]
PIP = [command for command in COMMANDS if command.startswith("python -m pip ")]
VIEWS = [command for command in COMMANDS if command.startswith("quadrl view ")]
SAVED = {  # files that a page lets its reader save, by name
    name: block
    for text in TEXTS.values()
    for name, block in re.findall(r"save it as `(\w+\.py)`[^`]*```python\n((?:.*\n)*?)```\n", text)
}
QUADRL = list(dict.fromkeys(some for block in BASH for some in in_turn(block)))
# tests/slow/test_identification.py runs those of the page, with logs of its own.
LOGS = [x for x in COMMANDS if x.startswith(("quadrl identify ", "quadrl replay "))]
STARTS_RAY = [command for command in COMMANDS if command.startswith("ray ")]
PLACEHOLDER = re.compile(r"\b(COMMAND|FOLDER|NAME|TASK|N)\b")
WRITTEN = {
    " ".join(command.split())
    for text in TEXTS.values()
    for command in re.findall(r"`(quadrl [^`]*)`", FENCE.sub("", text))
}
SENTENCES = sorted(x for x in WRITTEN if not PLACEHOLDER.search(x) and "--help" not in x)
CROSSCHECKS = [command for command in COMMANDS if command.startswith("quadrl crosscheck ")]
STUDIED = [command for command in COMMANDS if command.startswith("quadrl study ")]


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
    said = run(scripts / "quickstart", *SHORT_TRAINING, cwd=folder).stdout
    assert said.endswith(f"for the command quadrl: {ACTIVATES}\n")
    return folder


@pytest.fixture
def folder(trained, tmp_path):
    """A folder of its own with that run, and the files that pages let their readers save."""
    shutil.copytree(trained / RUN, tmp_path / RUN)
    for name, block in SAVED.items():
        (tmp_path / name).write_text(block)
    return tmp_path


def shortened(arguments):
    """The arguments of a command with those of SHORTER, each given once."""
    arguments, shorter = [*arguments], SHORTER.get(arguments[0], ())
    for option in shorter:
        if option.startswith("--") and option in arguments:
            at = arguments.index(option)
            del arguments[at : at + (1 if option.startswith("--no-") else 2)]
    return [*arguments, *shorter]


@pytest.mark.parametrize("page", PYTHON)
def test_python_snippets_run(page, folder):
    snippets = PYTHON[page]
    if not importlib.util.find_spec("dm_control"):
        snippets = [snippet for snippet in snippets if "quadrl.load(" not in snippet]
    saved = {block: name.removesuffix(".py") for name, block in SAVED.items()}
    names = [saved.get(snippet, f"snippet_{k}.py") for k, snippet in enumerate(snippets)]
    for name, snippet in zip(names, snippets, strict=True):
        if snippet not in saved:
            (folder / name).write_text(snippet)
    python("-c", RUNNER, *names, cwd=folder)


@pytest.mark.parametrize("commands", QUADRL, ids=" ".join)
def test_quadrl_commands_run(commands, folder):
    for command in commands:
        _, *arguments = shlex.split(command, comments=True)
        if RUN in arguments and arguments[arguments.index(RUN) - 1] == "--out":
            shutil.rmtree(folder / RUN)  # this command makes it
        python("-m", "quadrl", *shortened(arguments), cwd=folder)


@pytest.mark.parametrize("command", [*SENTENCES, *STUDIED, *CROSSCHECKS])
def test_command_that_is_not_run_is_understood(command):
    _, *arguments = shlex.split(command, comments=True)
    made_before = {"--import", "--resume", "--from", "--seeds", "RUN"} & {*arguments}
    if len(arguments) == 1:
        assert arguments[0] in (*cli.COMMANDS, "--version")
    elif arguments[0] == "train" and not made_before:
        cli.main([*arguments, *{"--dry-run"} - {*arguments}])
    elif arguments[0] == "evaluate" and not made_before:
        cli.main(shortened(arguments))
    else:
        cli.parse(arguments)


@pytest.mark.parametrize("name", tasks.TASKS)
def test_options_in_sentences_of_a_task_are_what_it_takes(name):
    known = {field.name for field in dataclasses.fields(tasks.TASKS[name])}
    page, _, _ = TEXTS[f"docs/tasks/{name}.md"].partition("## Trained")  # and what was tried
    for span in re.findall(r"`((?:\w+=[\w.]+\s*)+)`", FENCE.sub("", page)):
        given = parse_options(tuple(span.split()))
        if given.keys() <= known and ".csv" not in span:
            tasks.make(name, **given)


def test_the_study_of_the_page_can_be_read(tmp_path):
    (text,) = (block for page in blocks("toml").values() for block in page)
    (tmp_path / "study.toml").write_text(text)
    assert len(read_plan(tmp_path / "study.toml", tmp_path).runs) == 2 * 2 * 2 * 5  # as it says


@pytest.mark.parametrize("command", VIEWS)
def test_quadrl_view_flies_until_it_is_interrupted(command, folder):
    _, *arguments = shlex.split(command, comments=True)
    program = (sys.executable, "-m", "quadrl", *arguments, "--port", "0")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    # What is started in the background by a script ignores the signal, and so would the viewer.
    heard = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(program, cwd=folder, preexec_fn=heard, **pipes) as viewer:
        try:
            assert "http://localhost:" in viewer.stdout.readline()
            time.sleep(2.0)
            viewer.send_signal(signal.SIGINT)
            rest, _ = viewer.communicate(timeout=60)
        finally:
            viewer.kill()
    assert viewer.returncode == 0, rest
    assert rest == "stopped\n"


def test_every_command_is_checked():
    for page, text in TEXTS.items():
        fences = re.findall(r"^ *```(.*)$", text, re.MULTILINE)
        assert set(fences[::2]) <= LANGUAGES, page
        for block in blocks("").get(page, ()):  # which nothing runs
            assert not re.search(r"^ *(quadrl|python -m) ", block, re.MULTILINE), page
    tested = {command for some in QUADRL for command in some}
    other = {*VIEWS, *STUDIED, *SCRIPTS, *PIP, *LOGS, *CROSSCHECKS, *STARTS_RAY, ACTIVATES}
    assert {*COMMANDS} <= tested | other
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
    assert counted in TEXTS["docs/index.md"] and counted in TEXTS["docs/elsewhere.md"]
    assert f"[{len(quadrl.VEHICLES)} aircraft](aircraft.md)" in TEXTS["docs/index.md"]


@pytest.mark.parametrize("page", GUIDES)
def test_a_guide_can_be_read_in_minutes(page):
    own = re.sub(r"<!-- begin ([\w-]+) -->.*?<!-- end \1 -->", "", TEXTS[page], flags=re.DOTALL)
    assert len(own.split()) <= 1500


def test_what_was_tried_is_linked_from_its_guide():
    for page in (page for page in TEXTS if page.startswith("docs/lab/")):
        name = page.removeprefix("docs/")
        assert [x for x in GUIDES if f"]({name}" in TEXTS[x] or f"](../{name}" in TEXTS[x]], page


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


def test_the_commands_of_the_first_page_can_follow_one_another():
    made = re.findall(r"--out (\S+)", "".join(blocks("bash")["README.md"]))
    assert made and RUN not in made  # quickstart makes that one
    assert len(made) == len({*made})


def test_generated_parts_are_up_to_date():
    pages.pages(check=True)


def test_where_learning_wins_has_the_flights_of_the_reports():
    """Means over the seeds of each task; a policy and a controller in the order of the page."""
    rows = re.findall(
        r"^\| (.*) \| successful \| (.*) \| (.*) \| .* \| .* \| "
        r"`scripts/report (robust|robustness)` \|",
        TEXTS["docs/results.md"],
        re.MULTILINE,
    )
    order = "hover static_waypoint random_waypoint straight_and_level landing target_following"
    parts = {"robust": "rows", "robustness": "alone"}
    loaded = {name: report.load(name)[part] for name, part in parts.items()}
    assert {row[-1] for row in rows} == {*parts}
    for condition, *cells, name in rows:
        own = [row for row in loaded[name] if row["condition"] == condition]
        for cell, controller in zip(cells, (False, True), strict=True):
            if name == "robust":
                chosen = [row for row in own if (row["seed"] == "controller") == controller]
                shares = [(row["task"], row["success"]) for row in chosen]
            else:
                who = "tuned controller" if controller else "robust policy"
                shares = [(row["task"], row[who]) for row in own]
            said = [float(share.removesuffix(" %")) for share in cell.split(", ")]
            for task, share in zip(order.split(), said, strict=True):
                flown = [x for of, x in shares if of == task]
                assert abs(share - 100 * sum(flown) / len(flown)) <= 0.51, (condition, task)


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
