"""The observations at the goals of a task, where policies that hold the goal stand still."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.conditions import sensors, targets
from quadrl.core.environment import Environment
from quadrl.core.scenario import UNDISTURBED
from quadrl.learning.config import TrainConfig

DRAWN = 16  # goal states of a task that are compared, about
YAW = 2  # place of the yaw among the three angles
ROUNDING = 1e-5  # of observations in single precision


@dataclasses.dataclass(frozen=True)
class GoalState:
    """The observation at rest at the goal."""

    seen: np.ndarray
    """(size,) float32."""
    looks: np.ndarray
    """Which of its numbers a policy may look at, a mask (size,)."""
    others: tuple[int, ...] = ()
    """Of several tasks in one: the flags of those without this goal state."""


def goal_state(config: TrainConfig) -> GoalState:
    """Find the observation at rest at the goal, and which of its numbers a policy may look at.

    It may not look at what differs between goal states: the position in the world, in place of
    which it sees the way to the goal, and the yaw where the heading is free. What is left is the
    same however the aircraft is turned about the vertical.

    Of several tasks in one those count that stay at a goal, and a policy may not look at which of
    them it flies: they are one task near it. Where a heading matters to any task, it looks at the
    yaw in all.

    Raises:
        QuadrlError: The observations of the goal states differ in anything else, or no task stays
            at a goal.
    """
    scenario = config.scenario
    given = {**scenario.task.sensors, **scenario.observe.sensors}
    exact = {name: {**options, **sensors.SENSORS[name].exact} for name, options in given.items()}
    observe = dataclasses.replace(scenario.observe, sensors=exact)
    calm: Any = {**UNDISTURBED, "observe": observe}
    tasks = scenario.task.parts
    drawn = DRAWN * len(tasks) ** 2
    environment = Environment(scenario, num_envs=drawn, seed=0, **calm)
    environment.reset()
    goals = environment.goals() - environment.origin
    free = not any(task.heading_matters for task in tasks)
    yaw = np.linspace(-3.0, 3.0, drawn) if free else np.zeros(drawn)
    level = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=-1)
    start = {"position": goals, "quaternion": level}
    start |= {"velocity": np.zeros(3), "body_rate": np.zeros(3)}
    start |= {"rotor_speed": environment.vehicle.hover_speed}
    environment.seed(0)  # the same episodes, which have the same goals
    seen = environment.flatten(environment.reset(start=start))
    looks, places = np.ones(environment.size, dtype=bool), environment.layout
    looks[places.get("position", slice(0))] = False
    if free:
        for name in ("sin_attitude", "cos_attitude"):
            looks[places[name].start + YAW] = False
    name, others = scenario.task.name, ()
    if len(tasks) > 1:
        stays = [one.keeps_place and "target_velocity" not in one.observation for one in tasks]
        seen = seen[np.array(stays)[environment.snapshot.task.which.astype(int)]]
        if not len(seen):
            raise _refused(f"no task of {name} stays at a goal")
        flags = np.arange(environment.size)[told_by(places)]
        own = (seen[:, flags] == 1).any(0)
        looks[flags[own]], others = False, tuple(flags[~own].tolist())
    differs = looks & (np.ptp(seen, axis=0) > ROUNDING)
    if differs.any():
        entries = [entry for entry, place in places.items() if differs[place].any()]
        raise _refused(f"goal states of {name} differ in {', '.join(entries) or 'the history'}")
    return GoalState(seen[0], looks, others)


def _refused(reason: str) -> QuadrlError:
    return QuadrlError(reason, name="holds_goal", value=True, allowed="False for this task")


def told_by(layout: Mapping[str, slice]) -> slice:
    """Which numbers of an observation are flags of the tasks, of several in one; none if none are.

    Args:
        layout: The place of each entry.
    """
    standard = layout.get(targets.Standard.name, slice(0, 0))
    return layout.get("task", slice(standard.start + targets.MOTION, standard.stop))
