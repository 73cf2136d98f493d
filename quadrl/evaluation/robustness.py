"""Fly policies through graded disturbances, each alone, for their robustness card."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from quadrl import control
from quadrl.aircraft.aerodynamics import NONE
from quadrl.aircraft.specification import resolve
from quadrl.base.errors import QuadrlError
from quadrl.base.progress import ProgressBar
from quadrl.base.validation import choice, number
from quadrl.conditions.randomization import Errors, Pushes, Randomization
from quadrl.conditions.randomizations import RANDOMIZATIONS
from quadrl.conditions.sampler import AircraftSampler
from quadrl.conditions.weather import Weather
from quadrl.control.feasibility import limit
from quadrl.core.scenario import UNDISTURBED, Conditions, Scenario
from quadrl.core.task import Task
from quadrl.evaluation.cache import ResultCache
from quadrl.evaluation.card import QUARTILES, Card, half_level, wilson
from quadrl.evaluation.evaluate import setting
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.recovery import MAPS, recovered
from quadrl.evaluation.rollout import (
    BEHAVIOUR,
    EVALUATION_SEED,
    MAX_EPISODES,
    MAX_SEED,
    Controller,
    flights,
    fly,
    means_of_behaviour,
)

WORLD = ("vehicle", "aerodynamics", *UNDISTURBED, "engine")
"""Fields of the first one's scenario in which the others fly too, beside the task."""
CELL_SHARE = 10  # a cell of a recovery map has this part of the flights of a level
PUSHES_PER_SECOND = 0.5  # chosen: about five in a flight of 10 s


@dataclasses.dataclass(frozen=True)
class Disturbance:
    """One disturbance, at levels that are the same for every policy."""

    name: str
    label: str
    unit: str
    levels: tuple[float, ...]
    """In rising order."""
    at: Callable[[float], Randomization | Weather]
    """What flights of a level are disturbed by."""
    usual: float = 0.0
    """The level at which nothing is disturbed; one of the levels."""


def _noise(times: float) -> Randomization:
    full = vars(RANDOMIZATIONS["full"].noise)
    return Randomization(noise=Errors(**{name: times * size for name, size in full.items()}))


def _pushes(speed: float) -> Randomization:
    pushes = Pushes(rate=PUSHES_PER_SECOND, velocity=speed, body_rate=speed)
    return Randomization(pushes=pushes if speed else Pushes())


def _exactly(name: str, value: float) -> Randomization:
    given: dict[str, Any] = {name: (value, value)}
    return Randomization(**given)


def _delay(milliseconds: float) -> Randomization:
    return _exactly("command_delay", milliseconds / 1000)


def _jitter(percent: float) -> Randomization:
    return _exactly("command_jitter", percent / 100)


def _outages(milliseconds: float) -> Randomization:
    given: dict[str, Any] = {"command_loss": 1.0, "loss_time": milliseconds / 1000}
    return Randomization(**given) if milliseconds else Randomization()


def _weather(name: str) -> Callable[[float], Weather]:
    return lambda level: Weather(**{name: level})


def _factor(name: str) -> Callable[[float], Randomization]:
    return lambda level: _exactly(name, level)


def _loss(name: str) -> Callable[[float], Randomization]:
    return lambda percent: _exactly(name, 1 - percent / 100)


WIND_SPEEDS = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
GUST_SPEEDS = (0.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0, 20.0)
MASSES = (0.8, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2, 1.3)
INERTIAS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)
LOSSES = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0)
DELAYS = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 70.0, 100.0)
JITTERS = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 75.0, 100.0)
OUTAGES = (0.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 800.0)
LAGS = (0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
NOISES = (0.0, 1.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0)
PUSHES = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
SPECIFIED = "of the specified"
DISTURBANCES = {
    one.name: one
    for one in (
        Disturbance("wind", "mean wind, turbulent", "m/s", WIND_SPEEDS, _weather("wind_speed")),
        Disturbance("gust", "one gust", "m/s", GUST_SPEEDS, _weather("gust_speed")),
        Disturbance("mass", "mass", SPECIFIED, MASSES, _factor("mass"), 1.0),
        Disturbance("inertia", "inertia", SPECIFIED, INERTIAS, _factor("inertia"), 1.0),
        Disturbance("thrust", "thrust lost", "%", LOSSES, _loss("thrust")),
        Disturbance("one_rotor", "thrust lost by one rotor", "%", LOSSES, _loss("one_rotor")),
        Disturbance("delay", "delay of commands", "ms", DELAYS, _delay),
        Disturbance("lag", "rotor lag", SPECIFIED, LAGS, _factor("lag"), 1.0),
        Disturbance("noise", "noise of the estimate", "of 'full'", NOISES, _noise),
        Disturbance("pushes", "pushes, 0.5 per second", "m/s", PUSHES, _pushes),
        Disturbance("jitter", "commands one step late", "%", JITTERS, _jitter),
        Disturbance("outages", "outages, 1 per second", "ms", OUTAGES, _outages),
    )
}
"""By name."""


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


def disturbed(scenario: Scenario, level: Randomization | Weather) -> Scenario:
    """A scenario with the change that a level stands for."""
    name = "weather" if isinstance(level, Weather) else "randomization"
    usual, changes = type(level)(), vars(level).items()
    changes = {field: value for field, value in changes if value != getattr(usual, field)}
    changed: Any = {name: dataclasses.replace(getattr(scenario, name), **changes)}
    return dataclasses.replace(scenario, **changed)


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
