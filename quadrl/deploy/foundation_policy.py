"""RAPTOR's published policy, which flies any quadrotor: a yardstick of another project's.

Eschmann, Albani and Loianno, "RAPTOR: A Foundation Policy for Quadrotor Control", 2025; the weights
are those of the package `foundation-policy` (`python -m pip install foundation-policy`), which
quadrl does not need. It commands the motors of a Crazyflie in turn, and is told no heading.

    policy = quadrl.Policy.pretrained("hover")
    scenario = commanding(policy.scenario)
    quadrl.evaluate(Raptor(scenario), scenario)
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadrl.base.rotation import to_world
from quadrl.control.reading import Reading
from quadrl.core.scenario import Scenario

MOTORS = np.radians([-45, -135, 135, 45])  # bearings of the motors that RAPTOR commands, in turn
NEAREST, SLOWEST = 0.5, 1.0  # [m], [m/s]: what PX4's module clips its input to


def installed() -> bool:
    """Whether the package with the weights is there."""
    return importlib.util.find_spec("foundation_policy") is not None


class Raptor:
    """RAPTOR's published policy (the package foundation-policy) on an aircraft, every 10 ms."""

    control_mode = "rotor"

    def __init__(self, scenario: Scenario) -> None:
        """Load it, and turn its frame so that the rotors are at the corners."""
        self.policy: Any = importlib.import_module("foundation_policy").Raptor()
        self.policy.reset()
        self.vehicle = vehicle = scenario.vehicle
        self.terms = scenario.task.observation
        bearing = np.array([np.arctan2(one.position[1], one.position[0]) for one in vehicle.rotors])
        ahead = np.abs(bearing).min() < 0.1
        self.frame = Rotation.from_euler("z", np.pi / 4 if ahead else 0.0)
        apart = np.exp(1j * (bearing - ahead * np.pi / 4 - MOTORS[:, None]))
        self.order = np.abs(apart - 1).argmin(axis=1)
        self.last: np.ndarray | None = None

    def read(self, observation: np.ndarray) -> Reading:
        """What it is told of observations (N, size)."""
        return Reading.of(observation.astype(float), self.terms, self.vehicle)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (N, 4) of quadrl for observations (N, size): to the goal, or along with it."""
        reading = self.read(observation)
        back = self.frame.inv()
        offset = np.clip(-back.apply(reading.to_goal), -NEAREST, NEAREST)
        faster = back.apply(reading.velocity - reading.target_velocity)
        velocity, rate = np.clip(faster, -SLOWEST, SLOWEST), back.apply(reading.body_rate)
        turned = back * Rotation.from_matrix(reading.rotation) * self.frame
        last = np.zeros((len(observation), 4)) if self.last is None else self.last
        parts = offset, turned.as_matrix().reshape(-1, 9), velocity, rate, last
        asked = np.clip(self.policy.evaluate_step(np.concatenate(parts, axis=1)), -1, 1)
        self.last, speed = asked, np.empty_like(asked)
        speed[:, self.order] = (asked + 1) / 2
        change = speed * self.vehicle.max_speed - self.vehicle.hover_speed
        return change / self.vehicle.action_scale


def commanding(scenario: Scenario) -> Scenario:
    """The scenario of that policy: all that it sees, every 10 ms, and all speeds of the rotors."""
    vehicle = scenario.vehicle
    hover, most = vehicle.hover_speed, vehicle.max_speed
    scale = float(np.maximum(hover, most - hover).max())
    reaching = dataclasses.replace(vehicle, action_scale=scale, control_timestep=0.01)
    own: Any = {"control_mode": "rotor", "observe": {}, "aerodynamics": scenario.aerodynamics}
    return Scenario.of(scenario, vehicle=reaching, **own)


class Facing(Raptor):
    """RAPTOR's policy, told that each flight begins heading east: it holds the heading of then."""

    begun: np.ndarray | None = None  # (N,) [rad], heading of the first observation

    def read(self, observation: np.ndarray) -> Reading:
        """What it is told of observations (N, size)."""
        reading = super().read(observation)
        east, north = reading.heading.T
        begun = np.arctan2(north, east) if self.begun is None else self.begun
        self.begun, turn = begun, Rotation.from_euler("z", -begun[:, None]).as_matrix()
        vectors = reading.to_goal, reading.velocity, reading.target_velocity
        to_goal, velocity, target = (to_world(turn, vector) for vector in vectors)
        turned = {"to_goal": to_goal, "velocity": velocity, "target_velocity": target}
        return dataclasses.replace(reading, rotation=turn @ reading.rotation, **turned)
