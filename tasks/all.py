"""One policy for all: the paper's six tasks in one, one of them drawn for each episode."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

from quadrl.core.one_of import OneOf
from quadrl.core.solved import Target
from quadrl.core.task import Task
from quadrl.tasks.hover import Hover
from quadrl.tasks.landing import Landing
from quadrl.tasks.random_waypoint import RandomWaypoint
from quadrl.tasks.static_waypoint import StaticWaypoint
from quadrl.tasks.straight_and_level import StraightAndLevel
from quadrl.tasks.target_following import TargetFollowing


def _own(task: type[Task], **more: float) -> dict[str, Any]:
    """A task with the options of its own trainings by PPO, and more."""
    return {"task": task.name, **task.training_with["ppo"]["training_options"], **more}


AT_GOAL: dict[str, float] = {"progress_weight": 200.0, "spin_weight": 10.0}
"""What tasks pay that stay at a goal: with their own weights errors there are larger."""
PRACTISED: tuple[dict[str, Any], ...] = (
    _own(Hover, **AT_GOAL),
    {"task": StaticWaypoint.name, **AT_GOAL},
    # From rest. It faces east, as the others do: the network sees one yaw of each goal.
    {"task": RandomWaypoint.name, **RandomWaypoint.training["training_options"],
     "faces_east": True, **AT_GOAL},
    _own(StraightAndLevel),
    _own(Landing, progress_weight=200.0, haste_weight=120.0, failure_weight=100.0,
         success_weight=400.0),
    _own(TargetFollowing),
)  # fmt: skip
"""How trainings fly them. With its own rewards landing is not learned: it stays above its pad."""
FLOWN, LANDED, NEAR = 0.98, 0.95, 0.03
"""Shares of successful flights, of landings, and the error [m] that one policy for all is asked."""


@dataclasses.dataclass(frozen=True)
class All(OneOf):
    """Fly whichever of the paper's six tasks is drawn.

    A policy sees which it is and how a target moves by the sensor `standard`, and flies each task
    by that task's own name, too.
    """

    name = "all"
    compiled = True
    training: ClassVar[dict[str, Any]] = {
        "observe": {"sensors": {"standard": {}}},
        "holds_goal": True,
        "num_envs": 512,
        "steps": 6_000_000,
        # With two layers of 128 and smaller steps it learns to land three times later, or never.
        "hidden": (256,),
        "critic_hidden": (128, 128),
        # Those of the tasks' own trainings: a longer one costs accuracy, and with a shorter one
        # landing is never learned.
        "gammas": (0.92, 0.9, 0.93, 0.94, 0.98, 0.93),
        "training_options": {"members": PRACTISED, "shares": (1.5, 1.0, 1.5, 1.0, 2.0, 1.0)},
        "ppo": {"learning_rate": 4e-3, "beta2": 0.99, "minibatch": 2048},
    }

    members: tuple[Task, ...] = dataclasses.field(
        default_factory=lambda: tuple(each["task"] for each in PRACTISED)
    )
    """The tasks; the sensor `standard` knows these six."""

    @property
    def asked(self) -> tuple[Target, ...]:
        """To succeed in every task, and to be near where it stays: less than each task asks."""
        asked = list[Target]()
        for name, task in self.named.items():
            least = LANDED if isinstance(task, Landing) else FLOWN
            asked.append(Target(f"{name}_success_rate", f"{name}: successful", least, True))
            if task.keeps_place and "target_velocity" not in task.observation:
                words = f"{name}: error over the last 2 s"
                asked.append(Target(f"{name}_position_error_m", words, NEAR))
        return tuple(asked)
