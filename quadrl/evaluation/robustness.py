"""Fly policies through graded disturbances, each alone, for their robustness card."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.aircraft.aerodynamics import Aerodynamics
from quadrl.aircraft.presets import resolve
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.progress import ProgressBar
from quadrl.base.validation import choice, number
from quadrl.conditions.randomization import Randomization
from quadrl.conditions.sampler import AircraftSampler
from quadrl.conditions.weather import Weather
from quadrl.control.feasibility import limit
from quadrl.core.task import Task
from quadrl.engines.engine import EngineName
from quadrl.evaluation.axes import AXES, Axis
from quadrl.evaluation.card import QUARTILES, Card, half_level, wilson
from quadrl.evaluation.evaluate import setting
from quadrl.evaluation.kept import Kept
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.recovery import MAPS, recovered
from quadrl.evaluation.rollout import (
    EVALUATION_SEED,
    MAX_EPISODES,
    MAX_SEED,
    Controller,
    flights,
    fly,
)

CELL_SHARE = 10  # a cell of a recovery map has this part of the flights of a level


def robustness(
    controller: Any,
    task: str | Task | None = None,
    *,
    episodes: int = 300,
    seed: int = 0,
    vehicle: Vehicle | str | None = None,
    aerodynamics: str | Aerodynamics | None = None,
    engine: EngineName | None = None,
    axes: Iterable[str] | None = None,
    recovery: bool = True,
    progress: bool = True,
    keep: str | Path | None = None,
    **task_options: Any,
) -> Card:
    """Fly policies or controllers through graded disturbances, each alone, and map recoveries.

    All fly the same task with the same aircraft, through the same episodes. What a policy was
    trained in does not count: a level is all that disturbs its flights.

    Args:
        controller: What flies, as `quadrl.evaluate` takes it; a list of such; or a mapping of names
            to such.
        task: A task or its name; by default that of the first.
        episodes: Flights of each level; a cell of a recovery map has a tenth of them.
        seed: Of the episodes.
        vehicle: The aircraft or its name; by default that of the first.
        aerodynamics: Effects of the air; by default those of the first.
        engine: "free_flight" or "mujoco"; by default free flight, unless the task touches ground.
        axes: Names of the disturbances, of `quadrl.evaluation.axes.AXES`; by default all.
        recovery: Whether to fly the recovery maps.
        progress: Whether to show a progress bar.
        keep: A folder in which each level and each map is kept as soon as it is flown, until the
            card is saved; a call with the same conditions that follows one that was stopped takes
            them from there. What a function of your own flies is not kept.
        **task_options: Options of the task.

    Raises:
        QuadrlError: Something is unknown, out of range, or does not fit together.
    """
    seed = number("seed", seed, 0, MAX_SEED, whole=True)
    number("episodes", episodes, 1, MAX_EPISODES, whole=True)
    chosen = [AXES[choice("axis", name, AXES)] for name in (AXES if axes is None else axes)]
    flown, task, vehicles = _flyers(controller, task, vehicle, aerodynamics, task_options)
    vehicle = next(iter(vehicles.values()))
    engine = engine or ("mujoco" if task.contact else "free_flight")
    common: dict[str, Any] = {"engine": engine, "seed": EVALUATION_SEED + seed}
    levels = sum(len(axis.levels) - 1 for axis in chosen) + 1
    total = len(flown) * (levels + recovery * len(MAPS))
    found: dict[str, Any] = {"task": task.name, "vehicle": vehicle.name, "seed": seed}
    found |= {"episodes": episodes, "engine": engine, "flown": [*flown]}
    found |= {"axes": {axis.name: _described(axis) for axis in chosen}, "recovery": {}}
    for axis in chosen:
        found["axes"][axis.name]["reach"] = {name: _reach(axis, vehicles[name]) for name in flown}
    done, kept = 0, Kept(None if keep is None else Path(keep))

    with ProgressBar() as bar:

        def count(text: str) -> None:
            nonlocal done
            if progress:
                bar.update(done, total, text)
            done += 1

        for name, one in flown.items():
            count(f"{name}, undisturbed")
            alike: Any = common | {"vehicle": vehicles[name], "episodes": episodes}
            undisturbed = kept(measured, one, task, Randomization(), **alike)
            for axis in chosen:
                at = [undisturbed] * len(axis.levels)
                for k, level in enumerate(axis.levels):
                    if level != axis.usual:
                        count(f"{name}, {axis.label}")
                        at[k] = kept(measured, one, task, axis.at(level), **alike)
                found["axes"][axis.name]["flown"][name] = _summary(axis, at)
        for chart in MAPS.values() if recovery else ():
            sides = {side: vars(getattr(chart, side)) for side in "xy"}
            entry = found["recovery"][chart.name] = {**sides, "flown": {}}
            for name, one in flown.items():
                count(f"{name}, {chart.name}")
                alike = common | {"vehicle": vehicles[name]}
                each = max(1, episodes // CELL_SHARE)
                entry["flown"][name] = kept(recovered, one, task, chart, episodes=each, **alike)
        if progress:
            bar.update(total, total, "flown")
    return Card(json.loads(json.dumps(found)), kept)  # tuples as lists, as in the file


def measured(
    controller: Controller,
    task: Task,
    disturbed: Randomization | Weather,
    *,
    episodes: int,
    vehicle: Vehicle,
    **common: Any,
) -> dict[str, Any] | None:
    """Success with its interval, and quartiles of the error [m]; None where none can hover."""
    windy = isinstance(disturbed, Weather)
    weather, randomization = (disturbed, Randomization()) if windy else (Weather(), disturbed)
    try:
        AircraftSampler(randomization, vehicle)
    except QuadrlError:  # the aircraft cannot exist, or hardly fly
        return None
    given: dict[str, Any] = {"weather": weather, "randomization": randomization}
    rollout = fly(controller, task, episodes=episodes, vehicle=vehicle, **given, **common)
    flown = flights(rollout)
    success = int(flown["success"].sum())
    low, high = wilson(success, episodes)
    errors = np.quantile(flown["position_error_m"], QUARTILES).tolist()
    return {"success": success / episodes, "low": low, "high": high, "error_m": errors}


def _summary(axis: Axis, at: list[dict[str, Any] | None]) -> dict[str, Any]:
    """What was reached at the levels of an axis, and where half fail."""
    names = ("success", "low", "high", "error_m")
    columns = {name: [one[name] if one else None for one in at] for name in names}
    start, shares = axis.levels.index(axis.usual), columns["success"]
    below = half_level(axis.levels[start::-1], shares[start::-1])
    above = half_level(axis.levels[start:], shares[start:])
    return {**columns, "half": [below, above]}


def _reach(axis: Axis, vehicle: Vehicle) -> list[float | None]:
    """The levels under and over the usual one from which on no policy can hover."""
    ends = (axis.levels[0], axis.levels[-1])
    return [limit(axis.at, axis.usual, end, vehicle) for end in ends]


def _described(axis: Axis) -> dict[str, Any]:
    return {name: getattr(axis, name) for name in ("label", "unit", "levels", "usual")} | {
        "flown": {}
    }


def _flyers(
    controller: Any,
    task: str | Task | None,
    vehicle: Vehicle | str | None,
    aerodynamics: str | Aerodynamics | None,
    task_options: Mapping[str, Any],
) -> tuple[dict[str, Controller], Task, dict[str, Vehicle]]:
    """What flies and with which aircraft, by names that differ; the task is that of the first.

    The aircraft is that of the first too, but an action means what it meant in a policy's training.
    """
    named = controller.items() if isinstance(controller, Mapping) else None
    several = controller if isinstance(controller, (list, tuple)) else [controller]
    pairs = list(named or ((None, one) for one in several))
    if not pairs:
        raise QuadrlError(name="controller", value=controller, allowed="at least one that flies")
    flown: dict[str, Controller] = {}
    vehicles: dict[str, Vehicle] = {}
    for name, one in pairs:
        own, flies, task, flown_with = setting(
            one, task, vehicle, task_options, aerodynamics=aerodynamics
        )
        # The others get the task and the aircraft as they are.
        vehicle, task_options, aerodynamics = vehicle if flown else flown_with, {}, None
        name, k = name or own, 2
        while name in flown:
            name, k = f"{own} {k}", k + 1
        if isinstance(flies, Policy) and (own_one := flies.make_vehicle()).name == flown_with.name:
            flown_with = resolve(flown_with, {"action_scale": own_one.action_scale})
        flown[str(name)], vehicles[str(name)] = flies, flown_with
    return flown, task, vehicles  # type: ignore[return-value]
