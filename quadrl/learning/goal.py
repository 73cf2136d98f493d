"""The observation at the goal of a task, where policies that hold the goal stand still."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.core.environment import Environment
from quadrl.core.scenario import UNDISTURBED
from quadrl.learning.config import TrainConfig

DRAWN = 16  # goal states that are compared
YAW = 2  # place of the yaw among the three angles
ROUNDING = 1e-5  # of observations in single precision


def goal_state(config: TrainConfig) -> tuple[np.ndarray, np.ndarray]:
    """Find the observation at rest at the goal, and which of its numbers a policy may look at.

    It may not look at what differs between goal states: the position in the world, in place of
    which it sees the way to the goal, and the yaw where the heading is free. What is left is the
    same however the aircraft is turned about the vertical.

    Returns:
        The observation (size,) float32, and a mask (size,) of the numbers that are looked at.

    Raises:
        QuadrlError: The observations of the task's goal states differ in anything else.
    """
    scenario = config.scenario
    sensors = {**scenario.task.sensors, **scenario.observe.sensors}
    exact = {name: {**options, "noise": 0.0, "bias": 0.0} for name, options in sensors.items()}
    observe = dataclasses.replace(scenario.observe, sensors=exact)
    calm: Any = {**UNDISTURBED, "observe": observe}
    environment = Environment(scenario, num_envs=DRAWN, seed=0, **calm)
    task, vehicle = environment.task, environment.vehicle
    environment.reset()
    goals = environment.goals() - environment.origin
    yaw = np.zeros(DRAWN) if task.heading_matters else np.linspace(-3.0, 3.0, DRAWN)
    level = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=-1)
    start = {"position": goals, "quaternion": level}
    start |= {"velocity": np.zeros(3), "body_rate": np.zeros(3), "rotor_speed": vehicle.hover_speed}
    environment.seed(0)  # the same episodes, which have the same goals
    seen = environment.flatten(environment.reset(start=start))
    looks = np.ones(environment.size, dtype=bool)
    places = environment.layout
    looks[places.get("position", slice(0))] = False
    if not task.heading_matters:
        for name in ("sin_attitude", "cos_attitude"):
            looks[places[name].start + YAW] = False
    differs = looks & (np.ptp(seen, axis=0) > ROUNDING)
    if differs.any():
        entries = [name for name, place in places.items() if differs[place].any()]
        reason = f"goal states of {task.name} differ in {', '.join(entries) or 'the history'}"
        raise QuadrlError(reason, name="holds_goal", value=True, allowed="False for this task")
    return seen[0], looks
