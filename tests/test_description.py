"""What is said of a task is what it does."""

import dataclasses

import numpy as np
import pytest

from quadrl import tasks
from quadrl.description import describe, docstrings, observation_rows, reward_rows
from quadrl.environment import Environment
from quadrl.tasks.hover import Hover
from quadrl.vehicle import Vehicle


@dataclasses.dataclass(frozen=True)
class Tidy(Hover):
    """Hover, with a term that has no weight of its own."""

    margin: float = 0.5
    """Something
    in two lines [m]."""

    def reward(self, before, now, rotor_command, outcome, vehicle):
        """The common terms and another."""
        terms = super().reward(before, now, rotor_command, outcome, vehicle)
        return terms | {"tidy": -3.0 * now.spin}


@pytest.mark.parametrize("name", tasks.TASKS)
def test_entries_and_terms_are_those_of_a_flight(name):
    described = describe(tasks.make(name))
    environment = Environment(name, seed=0)
    environment.reset()
    now = environment.step(np.zeros(4))
    layout = {entry.name: slice(entry.first, entry.last + 1) for entry in described.observation}
    assert layout == environment.layout
    assert [term.name for term in described.reward] == list(now.reward_terms)
    assert all(term.meaning and term.weight is not None for term in described.reward)


@pytest.mark.parametrize("name", tasks.TASKS)
def test_a_term_weighs_what_is_said(name):
    # Twice the weight is twice the term.
    def first_step(**options):
        environment = Environment(tasks.make(name, **options), seed=0)
        environment.reset()
        return environment.step(np.full(4, 0.5)).reward_terms

    weights = {term.name: term.weight for term in describe(tasks.make(name)).reward}
    once = first_step()
    twice = first_step(**{f"{term}_weight": 2 * weight for term, weight in weights.items()})
    for term in weights:
        assert twice[term] == pytest.approx(2 * once[term], rel=1e-12), term


def test_a_task_of_ones_own_is_described():
    described = describe(Tidy(horizon=3.0), Vehicle(action_scale=20.0))
    assert described.horizon == 3.0
    assert "20 rad/s at 1" in described.action
    assert [(o.value, o.meaning) for o in described.options if o.name == "margin"] == [
        (0.5, "Something in two lines [m]")
    ]
    assert (described.reward[-1].name, described.reward[-1].weight) == ("tidy", None)
    assert docstrings(Tidy)["horizon"] == "Time limit of an episode [s]"


def test_tables_say_where_tasks_differ():
    described = [describe(tasks.make(name)) for name in ("hover", "landing", "target_following")]
    _, observation = observation_rows(described)
    assert observation[-1][0] == "target_velocity"
    assert observation[-1][3].endswith("(only target_following)")
    _, reward = reward_rows(described)
    weights = {name: (usual, others) for name, _, usual, others in reward}
    assert weights["progress"] == ("100", "")
    assert weights["survival"] == ("10", "landing 0")
    assert weights["failure"] == ("", "landing 300")
    assert reward_rows(described[:1])[0] == ("reward", "meaning", "weight")
