"""The command that trains a run again."""

import pytest

from quadrl.base.errors import QuadrlError
from quadrl.learning.command import command
from quadrl.learning.config import TrainConfig


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"task": "hover"}, "quadrl train hover --algo ppo --seed 3"),
        (
            {"task": "hover", "vehicle": "racer", "steps": 8192, "engine": "mujoco"},
            "quadrl train hover --algo ppo --seed 3 --vehicle racer --engine mujoco --steps 8192",
        ),
        (
            {"task": "hover", "variant": "robust"},
            "quadrl train hover --algo ppo --seed 3 --variant robust",
        ),
    ],
)
def test_a_command_says_what_is_not_usual(settings, said):
    assert command(TrainConfig(**settings, seed=3)) == said


def test_a_command_for_other_settings_is_refused():
    with pytest.raises(QuadrlError, match="quadrl train hover"):
        command(TrainConfig("hover", gamma=0.9))
