"""Fly policies through graded disturbances, each alone, for their robustness card."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from quadrl import control
from quadrl.aircraft.aerodynamics import NONE
from quadrl.aircraft.specification import resolve
from quadrl.base.errors import QuadrlError
from quadrl.base.progress import ProgressBar
from quadrl.base.validation import choice, number
from quadrl.conditions.sampler import AircraftSampler
from quadrl.control.feasibility import limit
from quadrl.core.scenario import UNDISTURBED, Conditions, Scenario
from quadrl.core.task import Task
from quadrl.evaluation.cache import ResultCache
from quadrl.evaluation.card import QUARTILES, Card, half_level, wilson
from quadrl.evaluation.disturbances import DISTURBANCES, Disturbance, disturbed
from quadrl.evaluation.evaluate import setting
from quadrl.evaluation.in_flight import Controller
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.recovery import MAPS, recovered
from quadrl.evaluation.rollout import (
    BEHAVIOUR,
    EVALUATION_SEED,
    MAX_EPISODES,
    MAX_SEED,
    flights,
    fly,
    means_of_behaviour,
)

WORLD = ("vehicle", "aerodynamics", *UNDISTURBED, "engine")
"""Fields of the first one's scenario in which the others fly too, beside the task."""
CELL_SHARE = 10  # a cell of a recovery map has this part of the flights of a level


def robustness(
    controller: Any,
    task: str | Task | Scenario | None = None,
    *,
    episodes: int = 300,
    seed: int = 0,
    disturbances: Iterable[str] | None = None,
    recovery: bool = True,
    progress: bool = True,
    keep: str | Path | None = None,
    **conditions: Unpack[Conditions],
) -> Card:
    """Fly policies or controllers through graded disturbances, each alone, and map recoveries.

    All fly the same task with the same aircraft, through the same episodes. The weather and the
    randomization that a policy was trained in do not count: beside those that are given, a level
    is all that disturbs its flights. Wind blows in real air, unless `aerodynamics` says otherwise.

    Args:
        controller: A policy or a controller, as `quadrl.evaluate` takes it; a list of them; or a
            mapping of names to them.
        task: A task or its name, or a whole scenario; by default the task of the first.
        episodes: Flights of each level; a cell of a recovery map has a tenth of them.
        seed: Seed of the episodes.
        disturbances: Names of `DISTURBANCES`; by default all.
        recovery: Whether to fly the recovery maps.
        progress: Whether to show a progress bar.
        keep: A folder in which each level and each map is kept as soon as it is flown, until the
            card is saved; a call with the same conditions that follows one that was stopped takes
            them from there. What a function of your own flies is not kept.
        **conditions: As `quadrl.evaluate` takes them; by default the aircraft of the first, and
            free flight unless the task touches the ground.

    Raises:
        QuadrlError: Something is unknown, out of range, or does not fit together.
    """
    seed = number("seed", seed, 0, MAX_SEED, whole=True)
    number("episodes", episodes, 1, MAX_EPISODES, whole=True)
    names = DISTURBANCES if disturbances is None else disturbances
    chosen = [DISTURBANCES[choice("disturbance", name, DISTURBANCES)] for name in names]
    flown = _flown(controller, task, **conditions)
    first = next(iter(flown.values()))[1]
    levels = sum(len(one.levels) - 1 for one in chosen) + 1
    total = len(flown) * (levels + recovery * len(MAPS))
    found: dict[str, Any] = {
        "task": first.task.name,
        "vehicle": first.vehicle.name,
        "seed": seed,
        "episodes": episodes,
        "engine": first.engine,
        "flown": [*flown],
        "scenarios": {name: scenario.to_json() for name, (_, scenario) in flown.items()},
        "axes": {},
        "recovery": {},
    }
    worlds: dict[tuple[str, str], list[Scenario]] = {}
    for one in chosen:
        axis = {name: getattr(one, name) for name in ("label", "unit", "levels", "usual")}
        axis = found["axes"][one.name] = {**axis, "flown": {}, "reach": {}}
        ends = one.levels[0], one.levels[-1]
        for name, (_, scenario) in flown.items():
            reach = [limit(one.at, one.usual, end, scenario.aircraft) for end in ends]
            axis["reach"][name] = reach
            worlds[name, one.name] = [disturbed(scenario, one.at(level)) for level in one.levels]
    done, kept = 0, ResultCache(None if keep is None else Path(keep))
    fresh: Any = {"episodes": episodes, "seed": EVALUATION_SEED + seed}

    with ProgressBar() as bar:

        def count(text: str) -> None:
            nonlocal done
            if progress:
                bar.update(done, total, text)
            done += 1

        for name, (flies, scenario) in flown.items():
            count(f"{name}, undisturbed")
            undisturbed = kept(measured, flies, scenario, **fresh)
            for one in chosen:
                at = [undisturbed] * len(one.levels)
                for k, level in enumerate(one.levels):
                    if level != one.usual:
                        count(f"{name}, {one.label}")
                        there = worlds[name, one.name][k]
                        at[k] = kept(measured, flies, there, **fresh)
                found["axes"][one.name]["flown"][name] = _summary(one, at)
        for chart in MAPS.values() if recovery else ():
            sides = {side: vars(getattr(chart, side)) for side in "xy"}
            entry = found["recovery"][chart.name] = {**sides, "flown": {}}
            for name, (flies, scenario) in flown.items():
                count(f"{name}, {chart.name}")
                fresh["episodes"] = max(1, episodes // CELL_SHARE)
                entry["flown"][name] = kept(recovered, flies, scenario, chart, **fresh)
        if progress:
            bar.update(total, total, "flown")
    return Card(json.loads(json.dumps(found)), kept)  # tuples as lists, as in the file


def measured(
    controller: Controller, scenario: Scenario, *, episodes: int, seed: int
) -> dict[str, Any] | None:
    """Success with its interval, quartiles of the error [m], behaviour; None where none hovers."""
    try:
        AircraftSampler(scenario.randomization, scenario.aircraft)
    except QuadrlError:  # the aircraft cannot exist, or hardly fly
        return None
    rollout = fly(controller, scenario, episodes=episodes, seed=seed)
    reached = flights(rollout)
    ways = means_of_behaviour(reached)
    success = int(reached["success"].sum())
    low, high = wilson(success, episodes)
    errors = np.quantile(reached["position_error_m"], QUARTILES).tolist()
    found = {"success": success / episodes, "low": low, "high": high, "error_m": errors}
    return found | {name: ways.get(name) for name in BEHAVIOUR}


def _summary(one: Disturbance, at: list[dict[str, Any] | None]) -> dict[str, Any]:
    """What was reached at the levels of a disturbance, and where half fail."""
    names = ("success", "low", "high", "error_m", *BEHAVIOUR)
    columns = {name: [level[name] if level else None for level in at] for name in names}
    start, shares = one.levels.index(one.usual), columns["success"]
    below = half_level(one.levels[start::-1], shares[start::-1])
    above = half_level(one.levels[start:], shares[start:])
    return {**columns, "half": [below, above]}


def _flown(
    controller: Any, task: str | Task | Scenario | None, **conditions: Unpack[Conditions]
) -> dict[str, tuple[Controller, Scenario]]:
    """What flies and what it flies, by names that differ.

    Task and aircraft are those of the first, but an action means what it meant in a policy's
    training, and a policy observes what it observed there. Controllers know the rotor speeds as
    the policy does that knows least.
    """
    named = controller.items() if isinstance(controller, Mapping) else None
    several = controller if isinstance(controller, (list, tuple)) else [controller]
    pairs = list(named or ((None, one) for one in several))
    if not pairs:
        raise QuadrlError(name="controller", value=controller, allowed="at least one that flies")
    given: dict[str, Any] = {name: x for name, x in conditions.items() if x is not None}
    if not isinstance(task, Scenario):
        given = {**UNDISTURBED, **given}
    flown: dict[str, tuple[Controller, Scenario]] = {}
    asked = "aerodynamics" in given
    for name, one in pairs:
        own, flies, scenario = setting(one, task, **given)
        if scenario.aerodynamics == NONE and not asked:  # of its training
            scenario = dataclasses.replace(scenario, aerodynamics=None)
        if not flown:
            if "engine" not in given and not isinstance(task, Scenario):
                engine = "mujoco" if scenario.task.contact else "free_flight"
                scenario = dataclasses.replace(scenario, engine=engine)
            # The others get the task, the aircraft and the world as they are.
            observed = {name: given.get(name) for name in ("observe", "control_mode")}
            given = {name: getattr(scenario, name) for name in WORLD} | observed
            task = scenario.task
        if isinstance(flies, Policy):
            trained = Scenario.of(flies.conditions, task=scenario.task).vehicle
            if trained.name == scenario.vehicle.name:
                scale = {"action_scale": trained.action_scale}
                scenario = dataclasses.replace(scenario, vehicle=resolve(scenario.vehicle, scale))
        name, k = name or own, 2
        while name in flown:
            name, k = f"{own} {k}", k + 1
        flown[str(name)] = flies, scenario
    seen = [scenario.observe for _, scenario in flown.values()]
    seen = next((one for one in seen if one.rotor_speed != "true"), seen[0]).for_controller()
    for name, (flies, scenario) in flown.items():
        if isinstance(flies, control.Controller) and given.get("observe") is None:
            flown[name] = flies, dataclasses.replace(scenario, observe=seen)
    return flown
