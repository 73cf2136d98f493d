"""What a newcomer gets wrong is answered in a line that says what to do."""

import logging
import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest
from helpers import refused
from rich.console import Console

import quadrl
from quadrl.base.errors import QuadrlWarning
from quadrl.base.extras import MissingLibrary, needed
from quadrl.base.progress import ProgressBar
from quadrl.learning.config import TrainConfig


def hover(**options):
    return gymnasium.make("quadrl/Hover-v0", **options)


MISTAKES = {
    "a function without return": (
        lambda: quadrl.evaluate(lambda observation: None, "hover", episodes=2),
        "does the function that flies return its action?",
    ),
    "a picture without pixels": (
        lambda: hover(render_mode="rgb_array", width=0),
        "width = 0: must be a whole number of at least 1",
    ),
    "a start below the ground": (
        lambda: hover().reset(options={"position": (0, 0, -50)}),
        r"position = .*must be above the ground, at z of at least -3",
    ),
    "an episode of one and a half steps": (
        lambda: hover(time_limit=0.07),
        "hover time_limit = 0.07: must be whole control steps of 0.05 s",
    ),
    "an episode shorter than a step": (lambda: hover(time_limit=0.01), "whole control steps"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_answered(mistake):
    call, answer = MISTAKES[mistake]
    with refused(match=answer):
        call()


def test_a_discount_of_one_is_warned_of():
    with pytest.warns(QuadrlWarning, match="usual are 0.9 to 0.99"):
        TrainConfig("hover", gamma=1.0)


WITHOUT_EXTRAS = {  # a command or a function, and what it needs, with what installs it
    "quadrl train hover": ("torch", "'quadrl[train]'"),
    "quadrl train hover --seeds 0:2": ("torch", "'quadrl[train]'"),
    "quadrl study study.toml": ("torch", "'quadrl[train]'"),
    "quadrl render hover": ("PIL", "'quadrl[video]'"),
    "quadrl plot runs/x": ("matplotlib", "'quadrl[video]'"),
    "quadrl robustness hover": ("matplotlib", "'quadrl[video]'"),
    "quadrl view hover": ("viser", "'quadrl[view]'"),
    "quadrl export hover --to onnx": ("onnx", "'quadrl[export]'"),
    "quadrl export hover --to torch": ("torch", "'quadrl[train]'"),
    "quadrl tasks": None,
    "quadrl.train": ("torch", "'quadrl[train]'"),
    "quadrl.study({'tasks': ['hover']})": ("torch", "'quadrl[train]'"),
    "quadrl.plot('runs/x')": ("matplotlib", "'quadrl[video]'"),
    "quadrl.export('hover', 'onnx')": ("onnx", "'quadrl[export]'"),
    "quadrl.envs.torchrl": ("torch", "'quadrl[train]'"),
    "quadrl.envs.rsl_rl": ("rsl_rl", "'quadrl[rsl_rl]'"),
    "quadrl.envs.sb3": ("stable_baselines3", "stable-baselines3"),
}
BARE = """
import sys

class Without:
    def find_spec(name, path=None, target=None):
        if name in sys.argv[1].split():
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Without)
import quadrl
from quadrl.cli import main
for call in sys.stdin.read().splitlines():
    print("#", call, file=sys.stderr, flush=True)
    try:
        main(call.split()[1:]) if call.startswith("quadrl ") else eval(call)
    except SystemExit as end:
        assert end.code == 2
    except ImportError as error:
        print(f"quadrl: {error}", file=sys.stderr, flush=True)
"""


@pytest.mark.slow
def test_without_extras_everything_says_in_a_line_what_it_needs(tmp_path):
    names = "torch torchrl tensordict matplotlib PIL mediapy viser onnx rsl_rl stable_baselines3"
    (tmp_path / "study.toml").write_text('tasks = ["hover"]')
    done = subprocess.run(
        [sys.executable, "-c", BARE, names],
        input="\n".join(WITHOUT_EXTRAS), cwd=tmp_path, capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": str(Path(quadrl.__file__).parents[1])},
    )  # fmt: skip
    said = {call: "" for call in WITHOUT_EXTRAS}
    for line in done.stderr.splitlines():
        if line.startswith("# "):
            call = line.removeprefix("# ")
        else:
            said[call] += line
    for call, needs in WITHOUT_EXTRAS.items():
        by = " ".join(call.partition("(")[0].split()[:2])
        line = f"quadrl: {by} needs {needs[0]}: python -m pip install {needs[1]}" if needs else ""
        assert said[call] == line
    assert [path.name for path in tmp_path.iterdir()] == ["study.toml"]


PUBLIC = """Aerodynamics Observing Policy RANDOMIZATIONS Randomization Rotor Task VEHICLES
Vehicle __version__ check envs evaluate export load plot register render rendering ring robustness
study suite tasks testing train"""


def test_tab_completion_shows_the_public_names_alone():
    assert sorted(dir(quadrl)) == PUBLIC.split()
    assert all(hasattr(quadrl, name) for name in PUBLIC.split())


@pytest.mark.parametrize("lines", [True, False])
def test_a_pipe_gets_lines_of_trainings_but_none_of_drawings(capsys, monkeypatch, lines):
    monkeypatch.setattr(ProgressBar, "LINE_SECONDS", 0.0)
    with ProgressBar(Console(force_terminal=False), lines=lines) as bar:
        bar.update(1, 4, "working")
    assert capsys.readouterr().out == (" 25 %  working\n" if lines else "")


def test_a_check_that_passes_logs_nothing():
    pytest.importorskip("torchrl")
    said = []
    log = logging.getLogger("torchrl")
    log.addHandler(handler := logging.NullHandler())
    handler.handle = said.append
    try:
        quadrl.testing.keeps_torchrl(quadrl.tasks.make("hover"))
    finally:
        log.removeHandler(handler)
    assert not said


def test_a_part_of_a_missing_library_is_named_by_the_library():
    with pytest.raises(MissingLibrary, match="quadrl train needs torchrl: python -m pip"):
        with needed("quadrl train"):
            raise ModuleNotFoundError(name="torchrl.envs")
