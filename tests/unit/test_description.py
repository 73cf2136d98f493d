"""What is said of a task is what it does."""

import dataclasses
import json

import numpy as np
import pytest

from quadrl import tasks
from quadrl.base.docstrings import docstrings
from quadrl.core.environment import Environment
from quadrl.learning.description import describe, describe_action, describe_observation
from quadrl.tasks.hover import Hover


@dataclasses.dataclass(frozen=True)
class Tidy(Hover):
    """Hover, with a term that has no weight of its own."""

    margin: float = 0.5
    """Something
    in two lines [m]."""

    def reward(self, before, now, end):
        """The common terms and another."""
        return super().reward(before, now, end) | {"tidy": -3.0 * now.potentials.angular_speed}


@pytest.mark.slow
@pytest.mark.parametrize("name", tasks.TASKS)
def test_terms_and_weights_are_those_of_a_flight(name):
    described = describe(tasks.make(name))
    json.dumps(described, allow_nan=False)

    def first_step(**options):
        environment = Environment(tasks.make(name, **options), seed=0)
        environment.reset()
        return environment, environment.step(np.full((1, 4), 0.5)).reward_terms

    environment, once = first_step()
    layout = {t["name"]: slice(t["first"], t["last"] + 1) for t in described["observation"]}
    assert layout == environment.layout
    weights = {term["name"]: term["weight"] for term in described["reward"]}
    assert list(weights) == list(once)
    assert all(term["meaning"] for term in described["reward"])
    # Twice the weight is twice the term.
    _, twice = first_step(**{f"{term}_weight": 2 * weight for term, weight in weights.items()})
    for term in weights:
        assert twice[term] == pytest.approx(2 * once[term], rel=1e-12), term


def test_a_task_of_ones_own_is_described():
    described = describe(Tidy(time_limit=3.0))
    assert described["time_limit"] == 3.0
    assert "35 rad/s at 1" in described["action"]
    option = {"name": "margin", "value": 0.5, "meaning": "Something in two lines [m]"}
    assert option in described["options"]
    assert described["reward"][-1] == {"name": "tidy", "weight": None, "meaning": ""}
    assert docstrings(Tidy)["time_limit"] == "Time limit of an episode [s]"


def test_the_layout_is_that_of_the_aircraft():
    environment = Environment(Hover(), vehicle="hexa", seed=0)
    speeds = next(t for t in describe_observation(environment) if t["name"] == "rotor_speed")
    assert (speeds["first"], speeds["last"]) == (15, 20)
    assert describe_action(environment.vehicle).startswith("6 numbers")
