"""The geometric controller with its gains tuned for uncertain aircraft in wind.

It is the yardstick of policies that are trained for the same: tuned on the same distribution, with
a budget that is said. A proportional controller leaves a lasting error in a lasting wind or with a
mass that it does not know, so an integral of the position error is among the gains.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import tyro

from quadrl import tasks
from quadrl.control import Gains, GeometricController
from quadrl.evaluation import evaluate
from quadrl.learning.defaults import WIDE
from quadrl.randomization import Errors, Randomization
from quadrl.reading import Reading
from quadrl.rotation import Array, norm
from quadrl.task import Task
from quadrl.vehicle import Vehicle, resolve
from scripts.reports import report
from scripts.reports.report import say

UNCERTAIN = Randomization(
    mass=(0.8, 1.2), command_delay=(0.02, 0.02), noise=Errors(1e-3, 1e-3, 2e-3, 2e-3)
)
"""Unknown mass, late commands, and an estimate with the noise of the preset "light"."""
BANDWIDTHS = (1.1, 1.3, 1.6, 1.9)  # `level` and `height` of the gains
INTEGRALS = (0.0, 0.5, 1.0, 1.5)  # [1/s]
NEAR = 0.5  # [m], distance within which errors are summed up: a long way is no lasting error
MOST = 1.0  # [m], of the sum along each axis
SEARCH, FRESH = 300, 100_300  # first episode of those that the gains are chosen by, and of others


class Integrating(GeometricController):
    """The geometric controller, towards a place beyond the goal by the sum of past errors."""

    def __init__(self, vehicle: Vehicle, task: Task, gains: Gains, integral: float) -> None:
        """Take the gains, and the rate of the integral [1/s]; it flies one batch of episodes."""
        super().__init__(vehicle, task, gains)
        self._rate = integral * vehicle.control_timestep
        self._sum: Array | float = 0.0  # (N, 3) [m], world frame

    def action(self, reading: Reading, offset: Array, velocity: Array) -> Array:
        """The action (N, R) towards a place at an offset, which moves at a velocity."""
        near = (norm(offset) < NEAR)[:, None]
        self._sum = np.clip(self._sum + self._rate * near * offset, -MOST, MOST)
        return super().action(reading, offset + self._sum, velocity)


def main(
    names: Sequence[str] = ("hover", "random_waypoint"),
    weather: str = "light",
    episodes: int = 200,
    fresh: int = 1000,
) -> None:
    """Try every setting, and fly the best one in fresh episodes.

    Args:
        names: The tasks.
        weather: Of the episodes.
        episodes: By which a setting is judged.
        fresh: In which the best one is measured.
    """
    found: dict[str, Any] = {}
    for name in names:
        tried = [
            {"bandwidth": b, "integral": i, **flown(name, b, i, weather, episodes, SEARCH)}
            for b in BANDWIDTHS
            for i in INTEGRALS
        ]
        best = max(tried, key=lambda x: (x["success_rate"], -x["position_error_m"]))
        again = flown(name, best["bandwidth"], best["integral"], weather, fresh, FRESH)
        found[name] = {"tried": tried, "best": {**best, "fresh": again}}
        say(f"{name}: best {best}; fresh {again}")
    settings = {"weather": weather, "episodes": episodes, "fresh_episodes": fresh}
    report.save("tuning", {**settings, "randomization": UNCERTAIN.given(), "tasks": found})


def controller_of(task: Task, vehicle: Vehicle, bandwidth: float, integral: float) -> Integrating:
    """The controller of a setting."""
    gains = Gains(**{**task.gains, "level": bandwidth, "height": bandwidth})
    return Integrating(vehicle, task, gains, integral)


def flown(
    name: str, bandwidth: float, integral: float, weather: str, episodes: int, seed: int
) -> dict[str, float]:
    """What one setting reaches in episodes from a seed on."""
    task, vehicle = tasks.make(name), resolve(None, {"action_scale": WIDE})
    controller = controller_of(task, vehicle, bandwidth, integral)
    chosen: Any = {"episodes": episodes, "seed": seed, "vehicle": vehicle}
    result = evaluate(controller, task, weather=weather, randomization=UNCERTAIN, **chosen)
    kept = ("success_rate", "survival_rate", "position_error_m")
    reached = {key: result.metrics[key] for key in kept}
    say(f"{name}, bandwidth {bandwidth}, integral {integral}: {reached}")
    return reached


if __name__ == "__main__":
    tyro.cli(main)
