"""Recovery maps: from which starts a policy brings its aircraft back.

A flight starts where the task starts it, but for what the map says. It has recovered if it never
touched the ground and its error, the mean over the last 2 s, is small; what ends an episode of the
task early does not end it. A task in which the aircraft touches the ground judges by its own
success.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from quadrl.base.rotation import quaternion_from_heading_and_tilt
from quadrl.core.contact import touches_ground
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.engines.state import State
from quadrl.evaluation.in_flight import Controller, begun
from quadrl.evaluation.rollout import FINAL_STRETCH

RECOVERED = 0.5  # [m], largest final error of a flight that has recovered; chosen

Draw = np.random.Generator
Starter = Callable[[np.ndarray, np.ndarray, State, float, Draw], dict[str, np.ndarray]]


@dataclasses.dataclass(frozen=True)
class Scale:
    """One side of a map."""

    label: str
    unit: str
    levels: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class RecoveryMap:
    """Starts that differ in two quantities."""

    name: str
    x: Scale
    y: Scale
    start: Starter
    """From x and y (N,), the task's own starts, the height of the origin of the task's frame above
    the ground [m] and random numbers: what differs, as `Environment.reset` takes it."""


def directions(count: int, draw: Draw) -> np.ndarray:
    """Unit vectors (count, 3), evenly over the sphere."""
    drawn = draw.normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)


def around(count: int, draw: Draw) -> np.ndarray:
    """Unit vectors (count, 3), evenly around the horizon."""
    bearing = 2 * np.pi * draw.random(count)
    return np.stack([np.cos(bearing), np.sin(bearing), np.zeros(count)], axis=-1)


def tilted(degrees: np.ndarray, own: State, draw: Draw) -> np.ndarray:
    """Attitudes (N, 4) with the task's own heading, tilted in any direction."""
    heading = np.arctan2(own.sin_attitude[:, 2], own.cos_attitude[:, 2])
    bearing = 2 * np.pi * draw.random(len(degrees))
    return quaternion_from_heading_and_tilt(heading, np.radians(degrees), bearing)


def _tumbling(x: np.ndarray, y: np.ndarray, own: State, height: float, draw: Draw) -> dict:
    rate = y[:, None] * directions(len(y), draw)
    return {"quaternion": tilted(x, own, draw), "body_rate": rate}


def _sideways(x: np.ndarray, y: np.ndarray, own: State, height: float, draw: Draw) -> dict:
    velocity = y[:, None] * around(len(y), draw)
    return {"quaternion": tilted(x, own, draw), "velocity": velocity}


def _falling(x: np.ndarray, y: np.ndarray, own: State, height: float, draw: Draw) -> dict:
    position, velocity = np.array(own.position), np.zeros((len(x), 3))
    position[:, 2], velocity[:, 2] = y - height, -x
    return {"position": position, "velocity": velocity}


TILT = Scale("tilt", "deg", tuple(np.arange(0.0, 181.0, 15.0)))
BODY_RATE = Scale("body rate", "rad/s", tuple(np.arange(0.0, 10.1)))
LEVEL_SPEED = Scale("level speed", "m/s", tuple(np.arange(0.0, 12.1)))
DESCENT_SPEED = Scale("descent speed", "m/s", tuple(np.arange(0.0, 6.1, 0.5)))
HEIGHT = Scale("height above the ground", "m", tuple(np.arange(0.5, 6.1, 0.5)))
MAPS = {
    one.name: one
    for one in (
        RecoveryMap("tumbling", TILT, BODY_RATE, _tumbling),
        RecoveryMap("sideways", TILT, LEVEL_SPEED, _sideways),
        RecoveryMap("falling", DESCENT_SPEED, HEIGHT, _falling),
    )
}
"""By name: tumbling thrown starts, flung sideways, and falling near the ground."""


def recovered(
    controller: Controller, scenario: Scenario, chart: RecoveryMap, *, episodes: int, seed: int
) -> np.ndarray:
    """Share of the flights that recover, (levels of y, levels of x).

    Args:
        controller: A policy or a controller.
        scenario: What is flown.
        chart: The map.
        episodes: Flights of each pair of levels, different ones for each pair.
        seed: Seed of the first aircraft.
    """
    y, x = np.meshgrid(chart.y.levels, chart.x.levels, indexing="ij")
    shape = (*x.shape, episodes)
    x, y = (np.broadcast_to(part[..., None], shape).reshape(-1) for part in (x, y))
    environment = Environment(scenario, num_envs=x.size, seed=seed)
    flown = begun(controller, environment)
    observation = begin(environment, chart, x, y, seed)
    steps = environment.time_limit_steps
    last = min(steps, round(FINAL_STRETCH / environment.vehicle.control_timestep))
    error, lost = np.zeros((2, x.size))
    over, succeeded = np.zeros((2, x.size), dtype=bool)
    for step in range(steps):
        now = environment.step(np.clip(flown(environment.flatten(observation)), -1.0, 1.0))
        observation = now.observation
        succeeded |= ~over & now.is_success
        over |= now.terminated | now.truncated
        lost += touches_ground(environment.snapshot) | now.diverged
        error += now.error * (step >= steps - last)
    back = succeeded if scenario.task.contact else (lost == 0) & (error / last < RECOVERED)
    return back.reshape(shape).mean(axis=-1)


def begin(
    environment: Environment, chart: RecoveryMap, x: np.ndarray, y: np.ndarray, seed: int
) -> Any:
    """Begin the flights of a map from x and y (N,); returns their first observation."""
    environment.reset()
    own, height = environment.snapshot.state, float(environment.origin[2])
    start = chart.start(x, y, own, height, np.random.default_rng(seed))
    environment.seed(seed)  # the same episodes again: goals and headings stay
    return environment.reset(start=start)
