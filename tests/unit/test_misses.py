"""What a training says that misses what its task asks, and what to type next."""

import dataclasses
import json
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

from quadrl import cli, tasks
from quadrl.core.solved import Target, missed
from quadrl.learning import run as learning_run
from quadrl.learning.config import TrainConfig
from quadrl.learning.run import Run

PAGES = Path(__file__).parents[2] / "docs" / "tasks"
SUCCESS = Target("success_rate", "successful", 0.95, True)
TIME = Target("time_s", "to the last gate", 4.65)
HOW = {
    "end_diverged_rate": 0.0, "end_away_rate": 0.2, "end_time_limit_rate": 0.8,
    "reward_progress_mean": 41.0, "reward_spin_mean": -120.0, "reward_survival_mean": 3.5,
}  # fmt: skip


def run(task, metrics, **settings):
    """A finished training that reached these figures."""
    config = TrainConfig(task, **settings)
    own = {"task": config.scenario.task, "metrics": metrics | HOW, "_repr_html_": str}
    flown = SimpleNamespace(**own)
    return Run(Path("runs/own run"), config, None, flown, 1.0)


def reached(task, share):
    """Figures of which each is off its target by this share, on the side that misses it."""
    return {
        x.metric: x.limit * (1 - share if x.at_least else 1 + share) + share / 1000 * (not x.limit)
        for x in tasks.TASKS[task].targets
    }


def test_it_is_said_by_how_much_a_target_is_missed_also_where_rounding_hides_it():
    said = missed((SUCCESS, TIME), {"success_rate": 0.79, "time_s": 4.71})
    assert said == (
        "successful 79 %, asked at least 95 %: 16 % short; "
        "to the last gate 4.7 s, asked at most 4.7 s: 0.060 s over"
    )
    assert missed((SUCCESS, TIME), {"success_rate": 0.95, "time_s": 4.65}) == ""
    # No flight came to the last gate.
    assert missed((TIME,), {"time_s": None}) == "to the last gate none, asked at most 4.7 s"


@pytest.mark.parametrize("task", tasks.TASKS)
def test_every_task_says_each_target_that_it_misses_and_a_command_that_is_understood(task):
    assert run(task, reached(task, 0.0)).misses == ""
    training = run(task, reached(task, 0.5))
    assert all(f"{x.words} " in training.misses for x in tasks.TASKS[task].targets)
    said, command = training.misses.split(". Next: ")
    assert said.startswith("misses: ") and "\n" not in training.misses
    cli.parse(shlex.split(command)[1:])


def next_of(training):
    return training.misses.split(". Next: ")[1]


def test_other_conditions_go_on_with_their_own_run():
    figures = reached("recovery", 0.5)
    late = run("recovery", figures, vehicle_options={"dead_time": 0.02}, steps=1000)
    assert next_of(late) == "quadrl train --resume 'runs/own run' --steps 2000"
    disturbed = run("hover", reached("hover", 0.5), variant="robust").misses
    calm = "quadrl evaluate 'runs/own run' --weather calm --randomization none"
    assert disturbed.endswith(f". They count undisturbed: {calm}")


def test_a_task_that_cannot_be_made_without_options_goes_on_too():
    given = {"task_options": {"members": ["hover", "recovery"]}}
    training = run("one_of", {"hover_success_rate": 0.5}, **given, steps=1000)
    assert next_of(training) == "quadrl train --resume 'runs/own run' --steps 2000"


def test_python_and_notebooks_say_it():
    for share, lines in ((0.5, 4), (0.0, 1)):
        training = run("hover", reached("hover", share))
        assert len(repr(training).splitlines()) == lines
        assert ("misses: " in training._repr_html_()) == (lines == 4)


def test_how_episodes_ended_and_what_the_reward_was_made_of_is_said_with_a_miss():
    assert run("hover", reached("hover", 0.0)).causes == ""
    ended, made = run("hover", reached("hover", 0.5)).causes.split("\n")
    assert ended == "its episodes ended: time limit 80 %, away 20 %"
    assert made == "its reward an episode: mostly spin -120, then progress 41, survival 3.5"


def test_late_commands_lead_to_the_training_that_stands_them():
    own = run("hover", {"success_rate": 1.0}, vehicle="crazyflie")
    assert own.lateness == ""
    stands = dataclasses.replace(own, late={0.01: 1.0, 0.02: 0.98})
    assert (
        stands.lateness == "successful with commands that act 10 ms later 100 %, 20 ms later 98 %"
    )
    falls = dataclasses.replace(own, late={0.01: 0.98, 0.02: 0.0}).lateness
    said, given = falls.split("; to stand that, train with ")
    assert said.endswith("10 ms later 98 %, 20 ms later 0 %")
    cli.parse(["train", "hover", *shlex.split(given)])
    assert json.loads(shlex.split(given)[1]) == {"command_delay": [0.0, 0.02]}


def test_late_commands_take_the_place_of_drawn_delays(monkeypatch):
    flown = []

    def evaluate(policy, scenario, **given):
        flown.append(given["randomization"])
        return SimpleNamespace(metrics={"success_rate": 1.0})

    monkeypatch.setattr(learning_run, "evaluate", evaluate)
    drawn = {"mass": (0.8, 1.2), "command_delay": (0.0, 0.02)}
    scenario = TrainConfig("hover", vehicle="crazyflie", randomization=drawn).scenario
    assert learning_run._later(None, scenario, 1) == {0.01: 1.0, 0.02: 1.0}
    assert [one.command_delay for one in flown] == [(0.01, 0.01), (0.02, 0.02)]
    assert {one.mass for one in flown} == {(0.8, 1.2)}
