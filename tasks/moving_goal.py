"""What the two tasks with a moving goal share: its velocity is seen, and matching it rewarded."""

from __future__ import annotations

import abc
import dataclasses

from quadrl.rotation import Array
from quadrl.state import State
from quadrl.task import OBSERVATION, TARGET_VELOCITY, FieldsT, Task


@dataclasses.dataclass(frozen=True)
class MovingGoalTask(Task[FieldsT]):
    """Keep to a goal that moves."""

    observation = OBSERVATION | TARGET_VELOCITY

    horizon: float = 20.0
    """Time limit of an episode [s]."""
    speed_weight: float = 20.0
    """Reward for a m/s lost of the speed relative to the target."""

    @abc.abstractmethod
    def target_velocity(self, state: State, fields: FieldsT) -> Array:
        """Velocity of the target, (..., 3) [m/s], world frame."""
