"""The image and the dev container name what there is; the nightly run builds the image."""

import json
import re
import shlex
import tomllib
from pathlib import Path

from quadrl import cli

REPOSITORY = Path(__file__).parents[2]
FOLDER = REPOSITORY / ".devcontainer"
INSTRUCTIONS = {"FROM", "RUN", "WORKDIR", "COPY", "CMD"}


def instructions():
    """(instruction, its arguments as words) of the Dockerfile, lines joined."""
    text = re.sub(r"^#.*\n", "", (FOLDER / "Dockerfile").read_text(), flags=re.MULTILINE)
    lines = re.sub(r"\\\n\s*", "", text).splitlines()
    return [(line.split()[0], shlex.split(line.partition(" ")[2])) for line in lines if line]


def of(name):
    return [words for instruction, words in instructions() if instruction == name]


def test_every_instruction_is_known_and_stages_follow_one_another():
    assert {name for name, _ in instructions()} == INSTRUCTIONS
    (first, second) = of("FROM")
    assert re.fullmatch(r"python:3\.1[1-3]-slim-\w+", first[0]), (
        "a Python that quadrl is tested with"
    )
    assert first[1:] == ["AS", "system"] and second == ["system", "AS", "quadrl"]


def test_it_installs_what_ci_draws_with():
    (workflow,) = {
        line
        for line in (REPOSITORY / ".github/workflows/ci.yml").read_text().splitlines()
        if "apt-get install" in line
    }
    wanted = {*workflow.partition("install -y ")[2].split()}
    (installs,) = [words for words in of("RUN") if "apt-get" in words]
    assert wanted and wanted <= {*installs}


def test_it_installs_this_checkout_with_an_extra_that_there_is():
    assert of("COPY") == [[".", "/opt/quadrl"]]
    (words,) = [words for words in of("RUN") if "uv" in words and "--system" in words]
    constraints = words[words.index("--constraint") + 1].removeprefix("/opt/quadrl/")
    assert (REPOSITORY / constraints).is_file()
    (extra,) = [x[1] for word in words if (x := re.fullmatch(r"/opt/quadrl\[(\w+)\]", word))]
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    assert extra in project["optional-dependencies"]


def test_its_commands_are_commands():
    runs = [words[words.index("quadrl") :] for words in of("RUN") if "quadrl" in words]
    starts = [
        json.loads(line)
        for line in re.findall(r"^CMD (.*)$", (FOLDER / "Dockerfile").read_text(), re.M)
    ]
    assert runs and starts
    for _, *arguments in runs + starts:
        cli.parse(arguments)


def test_the_image_leaves_out_what_git_does():
    ignored = (REPOSITORY / ".gitignore").read_text().splitlines()
    folders = {line.strip("/") for line in ignored if re.fullmatch(r"/(\w|/|\.venv)+/", line)}
    assert "runs" in folders
    assert folders <= {*(FOLDER / "Dockerfile.dockerignore").read_text().splitlines()}


def test_the_dev_container_builds_the_stage_and_runs_the_script():
    container = json.loads((FOLDER / "devcontainer.json").read_text())
    build = container["build"]
    assert (FOLDER / build["dockerfile"]).is_file()
    assert (FOLDER / build["context"]).resolve() == REPOSITORY
    assert build["target"] in [words[-1] for words in of("FROM")]
    assert (REPOSITORY / container["postCreateCommand"]).is_file()
