"""The geometric controller with its gains tuned for each task and each disturbance.

It is the yardstick of policies. A proportional controller leaves a lasting error in a lasting wind
or with a mass that it does not know, so an integral of the position error is among the gains.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import itertools
import multiprocessing
from collections.abc import Mapping
from typing import Any

import numpy as np
import tyro

from quadrl import tasks
from quadrl.aircraft.aerodynamics import EFFECTS
from quadrl.aircraft.presets import resolve, with_effects
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import Array, norm
from quadrl.conditions.randomization import RANDOMIZATIONS, Errors, Randomization
from quadrl.conditions.weather import WEATHERS
from quadrl.control import Gains, GeometricController
from quadrl.control.reading import Reading
from quadrl.core.task import Task
from quadrl.evaluation.rollout import fly, summarize
from quadrl.learning.defaults import WIDE
from scripts.reports import report
from scripts.reports.report import Result, say

UNCERTAIN = Randomization(
    mass=(0.8, 1.2), command_delay=(0.02, 0.02), noise=Errors(1e-3, 1e-3, 2e-3, 2e-3)
)
"""Unknown mass, late commands, and an estimate with the noise of the preset "light"."""
BANDWIDTHS = (0.9, 1.3, 1.9)  # `level` and `height` of the gains
INTEGRALS = (0.0, 0.5, 1.2)  # [1/s]
AROUND = ((0.8, 1.0), (1.2, 1.0), (1.0, 0.6), (1.0, 1.4), (0.8, 0.6), (1.2, 1.4), (1.2, 0.6))
"""Factors of the best of these; for an integral of none, of half the smallest one."""
NEAR = 0.5  # [m], distance within which errors are summed up: a long way is no lasting error
MOST = 1.0  # [m], of the sum along each axis
BOTH = ("hover", "random_waypoint")  # tasks that are flown in all of `UNCERTAIN` and wind as well
NEEDS_AIR = ("wind", "inflow")  # factors of what is off in calm air without effects
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


@dataclasses.dataclass(frozen=True)
class Condition:
    """What flights are disturbed by."""

    weather: str = "calm"
    randomization: Any = "none"
    aerodynamics: str = "none"
    vehicle: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Numbers of the paper's aircraft that differ."""

    def make_vehicle(self) -> Vehicle:
        """The aircraft in its air."""
        return with_effects(resolve(None, dict(self.vehicle)), self.aerodynamics)


def conditions(task: str) -> dict[str, Condition]:
    """The disturbances of a task by name: each alone, and all together."""
    found = {"nothing": Condition()}
    found |= {f"aerodynamics {e}": Condition(aerodynamics=e) for e in (*EFFECTS, "full")}
    found |= {f"weather {w}": Condition(w) for w in WEATHERS if w != "calm"}
    full = RANDOMIZATIONS["full"]
    for name in full.given():
        if name not in NEEDS_AIR:
            given: Any = {name: getattr(full, name)}
            found[f"{name} as in `full`"] = Condition(randomization=Randomization(**given))
    found |= {f"randomization {n}": Condition(randomization=n) for n in ("light", "full")}
    found["all together"] = Condition("light", "full", "full")
    if task in BOTH:
        found["uncertain"] = Condition("light", UNCERTAIN, vehicle={"action_scale": WIDE})
    return found


def main(names: tuple[str, ...] = tuple(tasks.TASKS), jobs: int = 2, episodes: int = 200) -> None:
    """Try every setting, and fly the best one in fresh episodes; write it down after each task.

    Args:
        names: The tasks; what was found for others is kept.
        jobs: Conditions at the same time.
        episodes: By which a setting is judged, and in which the best one is measured.
    """
    found: Result = {"command": "scripts/report tuning", "episodes": episodes, "tasks": {}}
    if (report.RESULTS / "tuning.json").exists():
        found["tasks"] = report.load("tuning")["tasks"]
    with concurrent.futures.ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        for name in names:
            known = conditions(name)
            search = functools.partial(searched, name, episodes)
            found["tasks"][name] = dict(zip(known, pool.map(search, known.values()), strict=True))
            for condition, best in found["tasks"][name].items():
                say(f"{name}, {condition}: {best['best']}")
            report.save("tuning", found)


def searched(name: str, episodes: int, condition: Condition) -> Result:
    """All settings of a task in a condition, and the best of them in fresh episodes."""
    vehicle = condition.make_vehicle()

    def measured(bandwidth: float, integral: float, first: int = SEARCH) -> Result:
        controller = controller_of(name, vehicle, bandwidth, integral)
        known = {"bandwidth": bandwidth, "integral": integral}
        return known | flown(controller, name, condition, episodes, first)

    def best(tried: list[Result]) -> Result:
        return max(tried, key=lambda x: (x["success_rate"], -x["position_error_m"]))

    tried = [measured(*pair) for pair in itertools.product(BANDWIDTHS, INTEGRALS)]
    bandwidth, integral = best(tried)["bandwidth"], best(tried)["integral"] or INTEGRALS[1] / 2
    tried += [measured(bandwidth * one, integral * other) for one, other in AROUND]
    chosen = best(tried)
    fresh = measured(chosen["bandwidth"], chosen["integral"], FRESH)
    return {"tried": tried, "best": {**chosen, "fresh": fresh}}


def tuned(name: str, condition: str, vehicle: Vehicle | None = None) -> Integrating:
    """The controller with the gains that were found for a task in a condition; for one flight."""
    best = report.load("tuning")["tasks"][name][condition]["best"]
    vehicle = vehicle or conditions(name)[condition].make_vehicle()
    return controller_of(name, vehicle, best["bandwidth"], best["integral"])


def controller_of(name: str, vehicle: Vehicle, bandwidth: float, integral: float) -> Integrating:
    """The controller of a setting; it knows the air that its aircraft was made for."""
    task = tasks.make(name)
    gains = Gains(**{**task.gains, "level": bandwidth, "height": bandwidth})
    return Integrating(vehicle, task, gains, integral)


def flown(
    controller: Any,
    name: str,
    condition: Condition,
    episodes: int,
    seed: int,
    vehicle: Vehicle | None = None,
) -> Result:
    """What a controller reaches in a condition, with its aircraft or another."""
    task = tasks.make(name)
    disturbed: Any = {"weather": condition.weather, "randomization": condition.randomization}
    engine: Any = "mujoco" if task.contact else "free_flight"
    disturbed |= {"vehicle": vehicle or condition.make_vehicle(), "engine": engine}
    reached = summarize(fly(controller, task, episodes=episodes, seed=seed, **disturbed))
    return {key: reached[key] for key in ("success_rate", "survival_rate", "position_error_m")}


if __name__ == "__main__":
    tyro.cli(main)
