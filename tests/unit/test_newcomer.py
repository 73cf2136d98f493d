"""What a newcomer gets wrong is answered in a line that says what to do."""

import gymnasium
import pytest
from helpers import refused

import quadrl
from quadrl.base.errors import QuadrlWarning
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


PUBLIC = """Aerodynamics Observing Policy RANDOMIZATIONS Randomization Task VEHICLES Vehicle
__version__ check envs evaluate export load plot register render rendering robustness study suite
tasks testing train"""


def test_tab_completion_shows_the_public_names_alone():
    assert sorted(dir(quadrl)) == PUBLIC.split()
    assert all(hasattr(quadrl, name) for name in PUBLIC.split())
