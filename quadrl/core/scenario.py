"""A scenario: what is flown, with which aircraft and in which conditions, as one record.

Names, JSON and options become a scenario once, where they come in: at the three APIs, in the
functions of Python and on the command line. From there on only the scenario is passed on.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Unpack, cast

import mujoco
from typing_extensions import TypedDict

from quadrl.aircraft import presets, specification
from quadrl.aircraft.aerodynamics import FULL, Aerodynamics
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base import validation
from quadrl.base.errors import QuadrlError
from quadrl.base.records import as_json, tuples
from quadrl.conditions import events as happens
from quadrl.conditions import observing, randomizations
from quadrl.conditions.event import Event
from quadrl.conditions.events import Happens
from quadrl.conditions.observing import Observed, Observing
from quadrl.conditions.randomization import Randomization
from quadrl.conditions.randomizations import RANDOMIZATIONS, Randomized
from quadrl.conditions.weather import WEATHERS, Weather, Weathered
from quadrl.control import modes
from quadrl.core import catalogue
from quadrl.core.task import Task
from quadrl.engines import mjcf
from quadrl.engines.air import LOWEST, mean_wind
from quadrl.engines.engine import ENGINES, Engine, EngineName


class Conditions(TypedDict, total=False, extra_items=Any):
    """Keywords that make a scenario; what is None or left out stays as it is.

    Further keywords are options of the task, such as `time_limit=5`. The help of the command line
    shows the docstrings.
    """

    task_options: Mapping[str, Any] | None
    """Options of the task, such as time_limit=5."""
    vehicle: str | Vehicle | Mapping[str, Any] | None
    """The aircraft: a name of `quadrl.VEHICLES`, or a .json file that quadrl identify wrote; in
    Python also a Vehicle, or changed fields of one."""
    vehicle_options: Mapping[str, Any] | None
    """Changed numbers of the aircraft, such as mass=0.7 action_scale=90."""
    aerodynamics: str | Aerodynamics | Mapping[str, Any] | None
    """Effects of the air on the rotors: none, full, or a comma-separated list of effects; in Python
    also an Aerodynamics. By default the effects of the aircraft; in wind, the full set if it has
    none."""
    weather: Weathered
    """The weather: calm, steady, light, moderate or severe, or JSON such as '{"wind_speed": 5}'; in
    Python also a Weather, or some of its fields."""
    randomization: Randomized
    """Randomization of each aircraft at each reset: none, light or full, or JSON such as '{"mass":
    [0.8, 1.2]}'; in Python also a Randomization, or some of its fields."""
    events: Happens
    """What happens in flight, with options: battery, rotor_failure, rotor_damage, payload or
    gust_front, such as battery rotor_failure='{"at": 3}'; or none. In Python also a name, or
    several."""
    observe: Observed
    """Options of the observation: fields of `quadrl.Observing`, such as action_history=2."""
    control_mode: str | None
    """Meaning of the actions: rotor, share, thrust_body_rate, velocity or position."""
    engine: EngineName | Engine | None
    """The engine: mujoco, or free_flight (which uses MuJoCo only near the ground and solids);
    `Environment` also accepts an engine object."""
    control_timestep: float | None
    """Time between two actions [s]; by default that of the aircraft."""
    max_episode_steps: int | None
    """Time limit of an episode in control steps, in place of the task's option time_limit."""


_effects = functools.partial(validation.record, "aerodynamics", kind=Aerodynamics)
_engine = functools.partial(validation.choice, "engine", choices=ENGINES)


def _condition(default: Any, parse: Callable[[Any], Any], given: str = "", **more: Any) -> Any:
    """A field, with what may be given for it.

    Args:
        default: What stands for its default; None, in files an empty text or record, for nothing.
        parse: Makes its value of what is given.
        given: How commands take it: as a "name", as a name or "json", as "pairs" of names and
            values, which add to the default ones; else as the type of its keyword says.
        **more: The `names` that there are, an `example` of JSON, and in pairs the value of a name
            `alone`.
    """
    usual: Any = default if default is not None else {} if given == "pairs" else ""
    metadata = {"parse": parse, "given": given, "usual": usual, **more}
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True)
class Scenario:
    """What is flown and how; `of` makes one, and `to_json` gives back what `of` takes.

    To add a condition, add a field here and its keyword, with its type and what help says of it, to
    `Conditions`.
    """

    task: Task = dataclasses.field(metadata={"parse": catalogue.make})
    """The task with its options."""
    vehicle: Vehicle = _condition("paper", specification.resolve, "name", names=presets.VEHICLES)
    """The aircraft as it is specified; `aircraft` is what flies."""
    aerodynamics: str | Aerodynamics | None = _condition(None, _effects, "name")
    """Effects of the air that were asked for, or that wind brings; None for the aircraft's own."""
    weather: Weather = _condition(
        "calm", Weather.of, "json", names=WEATHERS, example={"wind_speed": 5}
    )
    """What the wind is like."""
    randomization: Randomization = _condition(
        "none", randomizations.resolve, "json", names=RANDOMIZATIONS, example={"mass": [0.8, 1.2]}
    )
    """What is drawn for each aircraft at each reset and disturbs it."""
    events: Mapping[str, Event] = _condition(None, happens.resolve, "pairs", alone={})
    """What happens to aircraft in flight, by name."""
    observe: Observing = _condition(None, observing.resolve, "pairs")
    """Options of the observation."""
    control_mode: str = _condition("rotor", modes.named, "name", names=modes.CONTROL_MODES)
    """What actions mean."""
    engine: EngineName = _condition("mujoco", _engine, "name", names=ENGINES)
    """What flies it."""

    def __post_init__(self) -> None:
        """Parse and validate each field."""
        for field in dataclasses.fields(self):
            value = field.metadata["parse"](getattr(self, field.name))
            object.__setattr__(self, field.name, value)
        own = self.aerodynamics is not None or self.vehicle.aerodynamics.effects
        if not (own or self.calm):
            _check_in_wind(self.vehicle)
            object.__setattr__(self, "aerodynamics", FULL)
        wind = self.weather.wind_speed * self.randomization.wind[1] + self.weather.gust_speed
        wind += sum(event.strongest_wind for event in self.events.values())
        if wind > (resolved := self.aircraft.resolved_speed):
            reason = "faster air carries the aircraft off at a speed that its step does not resolve"
            allowed = f"mean wind and gust together up to {resolved:.3g} m/s, for this aircraft"
            raise QuadrlError(reason, name="weather", value=f"{wind:g} m/s", allowed=allowed)

    @classmethod
    def of(
        cls,
        given: str | Task | Scenario | Mapping[str, Any],
        also: Iterable[str] = (),
        /,
        *,
        task: str | Task | None = None,
        **keywords: Unpack[Conditions],
    ) -> Scenario:
        """Make a scenario of what a caller gives, or change one.

        If the name of the task or the aircraft stays the same, its options stay, too. Another
        aircraft, given by its name, flies in the air that was asked for. A Vehicle brings its own
        air; with one that has none, wind that acted by drag alone goes on doing so.

        Args:
            given: The name of a task, a task, a scenario, or a mapping as `to_json` has it: it is
                flown with the numbers in it, whatever its names mean today, and a number that it
                lacks is the default of its field.
            also: Further keywords of the caller, listed when an unknown one is refused.
            task: Another task, or its name; None for the one that is given.
            **keywords: What differs from it.

        Raises:
            QuadrlError: A name or a keyword is unknown, or a value is impossible.
        """
        if isinstance(given, Scenario):
            if task is None and not keywords:
                return given
            whole: dict[str, Any] = {f.name: getattr(given, f.name) for f in FIELDS}
        else:
            whole = _recorded(given) if isinstance(given, Mapping) else {"task": given}
        file = whole.pop("file", None)
        new: dict[str, Any] = {"task": task, **keywords}
        new = {k: value for k, value in new.items() if value is not None or k not in KEYWORDS}
        for name in ("task", "vehicle"):
            if name in new and new[name] == getattr(there := whole.get(name), "name", there):
                del new[name]
            elif name in new:
                whole.pop(f"{name}_options", None)
        if isinstance(flies := new.get("vehicle"), Vehicle):
            if whole.get("aerodynamics") != "none" or flies.aerodynamics.effects:
                whole.pop("aerodynamics", None)
        options = {**whole.pop("task_options", {}), **new.pop("task_options", {})}
        vehicle_options = {**whole.pop("vehicle_options", {}), **new.pop("vehicle_options", {})}
        whole |= new
        others = {name: whole.pop(name) for name in list(whole) if name not in KEYWORDS}
        vehicle = specification.resolve(whole.get("vehicle"), vehicle_options)
        if (timestep := whole.pop("control_timestep", None)) is not None:
            vehicle = dataclasses.replace(vehicle, control_timestep=timestep)
        if (steps := whole.pop("max_episode_steps", None)) is not None:
            steps = validation.number("max_episode_steps", steps, 1, whole=True)
            others["time_limit"] = steps * vehicle.control_timestep
        if file and isinstance(wanted := whole["task"], str) and wanted not in catalogue.TASKS:
            allowed = f"a task of {file}, with which it was saved: give --import {file}"
            raise QuadrlError(name="task", value=wanted, allowed=allowed)
        kind = catalogue.kind(whole["task"])
        known = [field.name for field in dataclasses.fields(kind)]
        validation.keys(f"{kind.name} option", others, [*KEYWORDS, *also, *known], tried=bool(also))
        made = catalogue.make(whole["task"], **tuples(options | others))
        whole |= {"task": made, "vehicle": vehicle}
        return cls(**{name: value for name, value in whole.items() if value is not None})

    def to_json(self) -> dict[str, Any]:
        """All of it, as JSON can hold it; `of` makes the same scenario, whatever names mean then.

        Returns:
            The keywords of `of`, with every option of the task and every field of the aircraft and
            the conditions; `aircraft`, in its air, where that was asked for by a name; `changed`,
            what in task and vehicle was not what their names meant; and `file`, the name of that in
            which a task of one's own is defined.
        """
        found: dict[str, Any] = {"task": self.task.name, "task_options": self.task.to_json()}
        values = {field.name: getattr(self, field.name) for field in FIELDS[1:]}
        found |= {name: as_json(value) for name, value in values.items() if value is not None}
        if isinstance(self.aerodynamics, str):
            found["aircraft"] = as_json(self.aircraft)
        known = presets.VEHICLES.get(self.vehicle.name, self.vehicle)
        usual = self.task.usual()
        pairs = {"task": (found["task_options"], usual), "vehicle": (found["vehicle"], known)}
        found["changed"] = {name: _differing(*pair) for name, pair in pairs.items()}
        if not (kind := type(self.task)).__module__.startswith("quadrl."):
            with contextlib.suppress(OSError, TypeError):  # of a notebook
                found["file"] = Path(inspect.getfile(kind)).name
        return found

    @functools.cached_property
    def aircraft(self) -> Vehicle:
        """The vehicle in its air: what flies."""
        return presets.with_effects(self.vehicle, self.aerodynamics)

    @property
    def altitude(self) -> float:
        """Height of the origin of the task's frame above the ground [m]."""
        return max(self.task.altitude, self.aircraft.ground_clearance)

    @property
    def calm(self) -> bool:
        """Whether the air never moves."""
        fronts = (event.strongest_wind for event in self.events.values())
        return self.weather.calm and not any(fronts)

    @property
    def mean_wind(self) -> float:
        """The mean wind where the task flies, taken 3 m above the ground at least [m/s]."""
        blows, height = self.weather, max(self.altitude, LOWEST)
        return float(mean_wind(blows.wind_speed, blows.roughness, height))

    @property
    def lands(self) -> bool:
        """Whether the task is over on the ground: it may be touched, and nothing else is there."""
        return self.task.contact and not self.task.solids()

    def compile_model(self, *, drawn: bool = True) -> mujoco.MjModel:
        """The model of the aircraft in the world of the task, to draw, or lean, to simulate."""
        flies, task = self.aircraft, self.task
        return mjcf.compile_model(flies, contact=task.contact, drawn=drawn, scene=task.build)


FIELDS = dataclasses.fields(Scenario)
UNDISTURBED: Mapping[str, Any] = {"weather": "calm", "randomization": "none", "events": "none"}
"""Conditions of a flight that nothing disturbs."""
_OPTIONS: Mapping[str, Any] = {"given": "pairs", "usual": {}}
GIVEN: dict[str, Mapping[str, Any]] = {field.name: field.metadata for field in FIELDS[1:]}
GIVEN["task_options"] = GIVEN["vehicle_options"] = _OPTIONS
"""How the conditions of a training are given, by keyword: see `_condition`."""
KEYWORDS = ("task", *Conditions.__annotations__)
"""The keywords of `Scenario.of`."""
RECORDED = (*KEYWORDS, "aircraft", "changed", "file")
"""What `Scenario.to_json` may have."""


def _recorded(given: Mapping[str, Any]) -> dict[str, Any]:
    """What `Scenario.to_json` gave, with its aircraft made of its own numbers alone."""
    whole = {name: value for name, value in given.items() if name != "changed"}
    flew, fields = whole.pop("aircraft", None), whole.get("vehicle")
    if isinstance(fields, Mapping):
        whole["vehicle"] = specification.resolve(cast(Mapping[str, Any], fields), whole=True)
        if flew is not None:
            flew = specification.resolve(flew, whole=True)
            with contextlib.suppress(QuadrlError):
                if presets.with_effects(whole["vehicle"], whole.get("aerodynamics")) == flew:
                    return whole
            whole["vehicle"] = flew  # the full set of its name is another one today
    return whole


def _check_in_wind(vehicle: Vehicle) -> None:
    """Refuse wind for an aircraft without effects of the air whose full set cannot be had.

    Raises:
        QuadrlError: The full set is not known or not possible.
    """
    try:
        specification.check_known(vehicle)
        presets.in_real_air(vehicle)
    except QuadrlError as error:
        reason = f"wind acts on the rotors too: {error}"
        allowed = "the aircraft's own Aerodynamics, or 'none' for wind that acts by drag alone"
        raise QuadrlError(reason, name="aerodynamics", value=FULL, allowed=allowed) from error


def _differing(own: Mapping[str, Any], usual: Any) -> list[str]:
    """The names of the fields of a record, as JSON has it, that are not those of the usual one."""
    return [name for name, value in as_json(usual).items() if own[name] != value]
