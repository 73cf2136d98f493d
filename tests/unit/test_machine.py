"""Memory is asked for before it is taken: what does not fit ends in one line."""

import resource

import pytest
from helpers import refused
from runs import changed

from quadrl.base import machine
from quadrl.core.environment import Environment
from quadrl.evaluation.rollout import fly
from quadrl.learning.train import Training
from quadrl.tasks.hover import Hover

GIB = 1 << 30
LARGE = {
    "long histories": {"num_envs": 1 << 20, "observe": {"observation_history": 1000}},
    "a sensor's long history": {
        "num_envs": 1 << 20,
        "observe": {"sensors": {"observation_history": {"length": 1000}}},
    },
    "long delays": {
        "num_envs": 1 << 20,
        "randomization": {"observation_delay": (0, 10.0), "command_delay": (0, 10.0)},
    },
}


@pytest.fixture
def little(monkeypatch):
    """A machine with 1 GiB to spare."""
    monkeypatch.setattr(machine, "free_memory", lambda: GIB)


@pytest.mark.parametrize("settings", LARGE.values(), ids=LARGE)
def test_more_aircraft_than_fit_are_refused_before_they_are_made(settings):
    taken = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with refused(match=r"num_envs = 1048576 would take \d{2,}.\d GiB .*: ask"):
        Environment("hover", **settings)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - taken < 200_000  # [kB]


def test_the_memory_that_is_free_is_the_least_of_all_limits(tmp_path, monkeypatch):
    free = machine.free_memory()
    assert 0 < free < 1 << 50
    for name, text in (
        ("max", f"{2 * GIB}"),
        ("current", f"{GIB}"),
        ("stat", "anon 5\ninactive_file 1000\n"),
    ):
        (tmp_path / f"memory.{name}").write_text(text)
    monkeypatch.setattr(machine, "CGROUP", tmp_path)
    assert machine.free_memory() == min(GIB + 1000, free) or free < GIB + 1000
    (tmp_path / "memory.max").write_text("max\n")
    assert machine.free_memory() > GIB + 1000 or free < 2 * GIB


def test_flights_and_trainings_that_do_not_fit_are_refused(little, tmp_path):
    with refused(match=r"20 flights of 2000000 steps would take .* GiB"):
        fly(lambda seen: seen[:, :4], Hover(time_limit=1e5), episodes=20)
    for settings, name in (
        ({"hidden": (30_000, 30_000)}, "hidden = .30000, 30000. would take 13.4 GiB"),
        ({"num_envs": 1 << 16, "rollout": 64}, "num_envs . rollout = 4194304 would take"),
    ):
        with refused(match=name):
            Training(changed(**settings), tmp_path / "run")
        assert not (tmp_path / "run").exists()
