"""quadrl.train, evaluate, render and plot, and what they return shows of itself."""

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import refused
from policies import make_remembering
from processes import python
from rich.console import Console
from runs import TINY

import quadrl
from quadrl.base.progress import ProgressBar
from quadrl.cli import main
from quadrl.evaluation.controllers import make_controller
from quadrl.learning.config import TrainConfig

SETTINGS = dict(
    num_envs=8, rollout=4, steps=192, hidden=(16,), task_options={"time_limit": 0.5}, episodes=2
)
SMALL = dict(width=160, height=120, fps=10, progress=False)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return quadrl.train("hover", seed=3, out=tmp_path_factory.mktemp("runs") / "run", **SETTINGS)


def test_train_is_the_command(run, tmp_path):
    words = ["--num-envs", "8", "--rollout", "4", "--steps", "192", "--hidden", "16", "--seed", "3"]
    more = ["--task-options", "time_limit=0.5", "--episodes", "2", "--no-video"]
    main(["train", "hover", *words, *more, "--out", str(tmp_path / "run")])
    names = ("policy.safetensors", "config.json")
    for name in names:
        assert (run.folder / name).read_bytes() == (tmp_path / "run" / name).read_bytes()
    assert run.config == TrainConfig.of_folder(run.folder)
    assert run.evaluation.metrics["episodes"] == 2 and run.seconds > 0


def test_train_takes_all_settings_at_once(run, tmp_path):
    again = quadrl.train(run.config, out=tmp_path / "run", episodes=2, on_progress=lambda _: None)
    name = "policy.safetensors"
    assert (again.folder / name).read_bytes() == (run.folder / name).read_bytes()


def test_train_goes_on_further(run, tmp_path):
    folder = Path(shutil.copytree(run.folder, tmp_path / "run"))
    further = quadrl.train(resume=folder, steps=256, episodes=2)
    assert further.config.steps == 256 >= further.policy.metadata["steps"]
    rows = (folder / "metrics.csv").read_text().splitlines()
    assert rows[-1].split(",")[1] == "256"
    with refused("seed", 4):
        quadrl.train(resume=folder, seed=4)


def test_evaluate_takes_whatever_flies(run, tmp_path):
    short = dict(episodes=2, time_limit=0.5)
    forms = (run, run.policy, run.folder, str(run.folder / "policy.safetensors"))
    found = [quadrl.evaluate(form, **short).metrics for form in forms]
    found.append(quadrl.evaluate(lambda seen: run.policy(seen), "hover", **short).metrics)
    assert all(metrics == found[0] for metrics in found)
    shipped = [quadrl.evaluate(form, **short).metrics for form in (
        "hover", quadrl.Policy.pretrained("hover"))]  # fmt: skip
    assert shipped[0] == shipped[1] != found[0]
    own = make_controller("geometric", "hover", "hexa")
    flown = [quadrl.evaluate(form, "hover", vehicle="hexa", **short).metrics for form in (
        "geometric", own)]  # fmt: skip
    assert flown[0] == flown[1] and flown[0]["vehicle"] == "hexa"


def test_an_evaluation_has_the_task_and_the_vehicle_of_the_training(run):
    flown = quadrl.evaluate(run, episodes=1)
    assert flown.task.time_limit == 0.5 and flown.vehicle.name == "paper"
    assert quadrl.evaluate(run, "static_waypoint", episodes=1).task.time_limit == 10.0


@pytest.mark.parametrize(("kind", "begins"), [("mp4", b"ftyp"), ("gif", b"GIF8"), ("png", b"PNG")])
def test_render(run, tmp_path, kind, begins):
    video = quadrl.render(run, kind=kind, **SMALL)
    assert begins in video.content[:12]
    path = video.save(tmp_path / f"flight.{kind}")
    assert path.read_bytes() == video.content
    with refused("path"):
        video.save(tmp_path / "flight.txt")


def test_plot(run, tmp_path):
    other = quadrl.train("hover", seed=4, out=tmp_path / "other", **SETTINGS)
    pictures = [
        quadrl.plot(run), quadrl.plot(run.folder, other), quadrl.plot(run.evaluation)
    ]  # fmt: skip
    assert all(picture.content.startswith(b"\x89PNG") for picture in pictures)
    assert len({picture.content for picture in pictures}) == 3
    third = quadrl.train("landing", out=tmp_path / "third", **SETTINGS)
    with refused("task"):
        quadrl.plot(run, third)
    with refused():
        quadrl.plot()


def test_everything_says_what_it_is_in_short(run):
    shown = (
        run, run.policy, run.evaluation, run.evaluation.rollout, run.config,
        quadrl.VEHICLES["racer"], quadrl.plot(run),
    )  # fmt: skip
    for one in shown:
        # A run that misses its task's targets says so in a line of its own, with what to do next,
        # and in two how its episodes ended and what its reward was made of.
        said, *missed = repr(one).split("\n", 2)
        assert len(said) < 300 and missed == ([run.misses, run.causes] if one is run else [])
    assert run.misses.startswith("misses: ")
    assert repr(TINY.seed) in repr(TINY) and "num_envs=8" in repr(TINY)


def test_notebooks_show_results(run):
    for one in (run, run.evaluation):
        assert "<table>" in one._repr_html_() and "success_rate" in one._repr_html_()
    assert 'src="data:image/png;base64,' in quadrl.plot(run)._repr_html_()


def test_a_notebook_updates_one_line(monkeypatch):
    lines = []

    def display(content, raw, display_id=None):
        lines.append(content["text/plain"])
        return SimpleNamespace(update=display)

    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=display))
    with ProgressBar(Console(force_jupyter=True)) as bar:
        for done in range(1, 5):
            bar.update(done, 4, "drawing")
    assert lines and "━" * ProgressBar.WIDTH in lines[-1] and "drawing" in lines[-1]
    assert len({len(line) for line in lines}) == 1


LOADED = """
import json, sys, torch
said = {"scenario": ""}
module = torch.export.load(sys.argv[1], extra_files=said).module()
rows = torch.tensor(json.loads(sys.argv[2]))
given = [rows] + [torch.full((len(rows), int(n)), 0.5) for n in sys.argv[3:]]
found = module(*given)
print(json.dumps([part.tolist() for part in (found if sys.argv[3:] else [found])]))
assert "quadrl" not in sys.modules and json.loads(said["scenario"])["task"] == "hover"
"""


@pytest.mark.parametrize(
    "policy", [quadrl.Policy.pretrained("hover"), make_remembering()], ids=repr
)
def test_a_program_of_torch_loads_where_quadrl_is_not(policy, tmp_path):
    path = quadrl.export(policy, "torch", tmp_path / "policy.pt2")
    rows = np.random.default_rng(0).normal(policy.mean, policy.deviation, (5, policy.size))
    rows = rows.astype(np.float32)
    sizes = [policy.state_size] * bool(policy.memory)
    done = python("-W", "error", "-c", LOADED, path, json.dumps(rows.tolist()), *sizes)
    expected = policy.step(rows, np.full((5, policy.state_size), 0.5))
    for found, array in zip(json.loads(done.stdout), expected, strict=False):
        np.testing.assert_allclose(found, array, rtol=0, atol=1e-6)
