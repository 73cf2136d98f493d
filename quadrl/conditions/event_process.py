"""What events do to N aircraft: in C where they only compute, with their memory in one table."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import NativeError, QuadrlError
from quadrl.base.philox import EVENTS as STREAMS
from quadrl.base.rotation import Array, namespace
from quadrl.base.trace import NotCompilable
from quadrl.conditions.event import SPEED_LIMIT, WIND, Event, Happening
from quadrl.conditions.process import Process
from quadrl.conditions.sampler import AircraftSampler, Drawn
from quadrl.engines.engine import Engine
from quadrl.engines.rng import Rng
from quadrl.engines.rowwise import RowFunction


class Events(Process):
    """Lets events act on the aircraft of an engine."""

    name = "events"

    def __init__(
        self,
        events: Mapping[str, Event],
        engine: Engine,
        sampler: AircraftSampler,
        time_limit: float,
        *,
        calm: bool,
    ) -> None:
        """Check the events and set up the arrays.

        Args:
            events: The events by name.
            engine: Flies the aircraft; with rows of parameters for each if `scales` says so.
            sampler: Makes them.
            time_limit: Time limit of the episodes [s].
            calm: Whether nothing else writes the wind.

        Raises:
            QuadrlError: An event does not fit the aircraft or the episodes, or an aircraft could
                not hover at the start.
        """
        for event in events.values():
            event.check(engine.vehicle, time_limit)
        _check_hover(events, engine.vehicle, sampler)
        self._events, self._engine, self._calm = events, engine, calm
        self._time_limit, self._timestep = time_limit, engine.vehicle.control_timestep
        count, self._rotors = engine.ctrl.shape
        nobody = Rng(np.zeros(1, np.int64), np.zeros(1, np.int64))
        drawn = {f"{k}.{m}": k for k, event in events.items() for m in event.draw(nobody, 1.0)}
        own = parameters.rows(engine.vehicle)
        usual = {name: _usual(name, own) for event in events.values() for name in event.changes}
        self._usual = np.concatenate([*usual.values()])
        self._remembered = ["steps", *drawn]
        kept, width = len(self._remembered), len(self._usual)
        # What is remembered, in columns of those names, and what events do then, side by side.
        self._table = np.zeros((count, kept + width))
        self._table[:, kept:] = self._usual
        self._kept, self._effects = np.split(self._table, [kept], axis=1)
        ends = np.cumsum([len(part) for part in usual.values()])[:-1]
        self._parts = dict(zip(usual, np.split(self._effects, ends, axis=1), strict=True))
        self._scaled = [name for name in usual if name not in (SPEED_LIMIT, WIND)]
        self._written = np.full((count, sum(len(usual[n]) for n in self._scaled)), np.nan)
        self._all: np.ndarray = np.arange(count)
        # Where `_next` goes: beside the table, the ceiling of the engine and its wind.
        self._results: list[np.ndarray] = [self._table]
        self._results += [engine.ceiling] if SPEED_LIMIT in usual else []
        self._results += [engine.wind] if WIND in usual else []
        self._run = self._compiled() or self._written_run

    def _compiled(self) -> Callable[..., None] | None:
        """`_next` of some aircraft (n,), or of all, in C; None where that cannot be."""
        flies = self._engine
        row = parameters.numbers(flies.begun)
        row = np.broadcast_to(row, (flies.num_envs, parameters.ROW_SIZE))
        arrays = self._kept, flies.act, flies.wind, row
        sizes = [array.shape[1] for array in arrays]

        def following(kept: Array, speeds: Array, wind: Array, row: Array) -> Array:
            own = Parameters.of_symbols(row, self._timestep, self._rotors)
            return self._next(kept, speeds, wind, own)

        try:
            compiled = RowFunction(following, *sizes, fixed=sum(sizes[:-1]))
            return compiled.on(*arrays, *self._results, results=len(self._results))
        except (NotCompilable, NativeError):
            return None

    def _written_run(self, rows: np.ndarray | None = None) -> None:
        rows = self._all if rows is None else rows
        flies, own = self._engine, self._as_begun(rows)
        given = self._next(self._kept[rows], flies.act[rows], flies.wind[rows], own)
        ends = np.cumsum([array.shape[1] for array in self._results])[:-1]
        for array, part in zip(self._results, np.split(given, ends, axis=1), strict=True):
            array[rows] = part

    def _next(self, kept: Array, rotor_speed: Array, wind: Array, aircraft: Parameters) -> Array:
        """What is remembered (n, k) after a control step, what the events do in it, and results."""
        xp, effects, after = namespace(kept), dict[str, Array](), list[Array]()
        for name, event in self._events.items():
            now = self._happening(name, kept, rotor_speed, aircraft)
            for what, does in zip(event.changes, event.effect(now), strict=True):
                does = xp.broadcast_to(does, (len(kept), self._parts[what].shape[1]))
                if what in effects:
                    does = effects[what] + does if what == WIND else effects[what] * does
                effects[what] = does
            after += event.update(now).values()
        parts = [kept[:, :1] + 1.0, *(array[:, None] for array in after), *effects.values()]
        if SPEED_LIMIT in effects:
            parts.append(effects[SPEED_LIMIT] * aircraft.rotor.max_speed)
        if WIND in effects:
            parts.append(effects[WIND] if self._calm else wind + effects[WIND])
        return xp.concatenate(parts, axis=1)

    def _happening(
        self, name: str, kept: Array, rotor_speed: Array, aircraft: Parameters
    ) -> Happening:
        own = {
            key.removeprefix(f"{name}."): kept[:, k]
            for k, key in enumerate(self._remembered)
            if key.startswith(f"{name}.")
        }
        return Happening(self._timestep * kept[:, 0], rotor_speed, aircraft, own, self._timestep)

    def _as_begun(self, rows: np.ndarray) -> Parameters:
        """Aircraft (n,) as their episodes began."""
        begun = self._engine.begun
        return Parameters.of(begun[rows] if len(begun) > 1 else begun, self._timestep)

    @property
    def width(self) -> int:
        """How many numbers of an aircraft `seen` has."""
        return len(self._usual)

    def seen(self, rows: np.ndarray | None) -> Array:
        """What they do to aircraft (n,) now, or to all, (n, width): 0 where it is nothing.

        Factors of numbers and of the largest speeds less 1, and a wind [m/s], world frame.
        """
        return (self._effects if rows is None else self._effects[rows]) - self._usual

    def told(self, row: int) -> str:
        """What pictures say of an aircraft now."""
        chosen = np.array([row])
        seen = self._kept[chosen], self._engine.act[chosen], self._as_begun(chosen)
        words = (event.told(self._happening(k, *seen)) for k, event in self._events.items())
        return ", ".join(word for word in words if word)

    def begin(self, rows: np.ndarray, keys: np.ndarray, episodes: np.ndarray, drawn: Drawn) -> None:
        """Begin episodes (n,): draw what happens in them."""
        parts = [np.zeros(len(rows))]
        for name, event in self._events.items():
            rng = Rng(keys, episodes, STREAMS + (zlib.crc32(name.encode()) >> 3))
            parts += event.draw(rng, self._time_limit).values()
        self._kept[rows] = kept = np.stack(parts, axis=1)
        self._run(rows)
        self._kept[rows] = kept  # the first control step has not begun
        if self._scaled:
            self._scale(rows)

    def act(self) -> None:
        """Let them act in the control step that begins."""
        self._run()
        if self._scaled:
            self._scale(self._all)

    def _scale(self, rows: np.ndarray) -> None:
        """Write the numbers of those of the aircraft (n,) for which they have changed."""
        factors = np.concatenate([self._parts[name] for name in self._scaled], axis=1)[rows]
        differ = (factors != self._written[rows]).any(axis=1)
        if not differ.any():
            return
        rows = rows[differ]
        self._written[rows] = factors[differ]
        table = self._engine.begun[rows]
        for name in self._scaled:
            field = parameters.field(table, name)
            field[:] = self._parts[name][rows] * field
        if (changed := (self._written[rows] != 1.0).any(axis=1)).any():
            flown = table[changed]
            parameters.refresh(flown, self._engine.vehicle.physics_timestep)
            table[changed] = flown
        self._engine.write_parameters(rows, table)

    def save(self) -> dict[str, np.ndarray]:
        """What the events remember; what they did, the engine saves."""
        return {name: self._kept[:, k].copy() for k, name in enumerate(self._remembered)}

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        """Restore what `save` returned; the next control step applies it."""
        for k, name in enumerate(self._remembered):
            self._kept[:, k] = saved[name]
        self._written[:] = np.nan


def scales(events: Mapping[str, Event]) -> bool:
    """Whether one of the events changes numbers of an aircraft's row."""
    return any({*event.changes} - {SPEED_LIMIT, WIND} for event in events.values())


def _usual(name: str, own: np.ndarray) -> Array:
    """What an event does to the aircraft of a row where it does nothing, (k,)."""
    if name == WIND:
        return np.zeros(3)
    return np.ones(
        parameters.field(own, "rotor.max_speed" if name == SPEED_LIMIT else name)[0].size
    )


def _check_hover(events: Mapping[str, Event], vehicle: Vehicle, sampler: AircraftSampler) -> None:
    """Refuse events with which an aircraft could not hover at the start.

    Raises:
        QuadrlError: The message has the speed that a rotor would need.
    """
    heavy = math.prod(event.burden[0] for event in events.values())
    limit = math.prod(event.burden[1] for event in events.values())
    table = sampler.extremes.copy()
    table["mass"] *= heavy
    parameters.refresh(table, vehicle.physics_timestep)
    rotor = table["rotor"][:, : vehicle.rotor_count]
    needed = float((rotor["hover_speed"] / rotor["max_speed"]).max())
    if (heavy, limit) != (1.0, 1.0) and needed >= limit:
        said = ", ".join(name for name, event in events.items() if event.burden != (1.0, 1.0))
        reason = f"a rotor needs {needed:.3g} of its largest speed to hover, and has {limit:.3g}"
        allowed = "such that the aircraft can hover as its episode begins"
        raise QuadrlError(reason, name="events", value=said, allowed=allowed)
