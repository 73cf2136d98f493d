"""The task's part of a control step as a function of the numbers of a row.

The functions of a task are called with symbols (`quadrl.base.trace`): what `transition.finish`
makes of a motion, an action and what the task remembers becomes C, which a control step of
`native/free_flight.c` calls.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from quadrl.aircraft.parameters import ROW_SIZE, Parameters
from quadrl.base import records
from quadrl.base.philox import START
from quadrl.base.rotation import Array
from quadrl.base.trace import MAX_OPERATIONS, NotCompilable
from quadrl.conditions.world import World
from quadrl.core.senses import Kept, Look, arrays, filled
from quadrl.core.snapshot import Snapshot
from quadrl.core.step import WrittenStep
from quadrl.core.transition import Episode, Transition, begin, finish
from quadrl.engines.rng import Rng
from quadrl.engines.rowwise import RowFunction
from quadrl.engines.state import State

FLAGS = ("terminated", "truncated", "is_success", "diverged")
"""The last numbers that it gives; `BYTES` in native/free_flight.c."""
AGED = 13
"""Coordinates that may be older than the motion."""
MAX_DRAWN = 64
"""Most random numbers of a start that is compiled."""


class Draws(Rng):
    """Random numbers of the start of an episode that are symbols."""

    def __init__(self, read: Callable[[Array], Array], first: int = 0) -> None:
        """Begin with the first number.

        Args:
            read: Gives the symbols of the numbers at places (...).
            first: The place of the first one; with 1, the first one of MEMBERS is before it.
        """
        self.used, self._read = first, read

    def stream(self, number: int) -> Draws:
        """START again, or MEMBERS, from the first number on."""
        return Draws(self._read, int(number == START))

    def uniform(self, low: float, high: float, size: int | None = None) -> Array:
        """Numbers in [low, high): (1,), or (1, size)."""
        count = 1 if size is None else size
        drawn = self._read(np.arange(self.used, self.used + count)[None])
        self.used += count
        return low + (high - low) * (drawn[..., 0] if size is None else drawn)


class Program:
    """`transition.finish` for a row, compiled at its first use.

    It takes the motion (qpos, qvel and rotor speeds) and whether it has diverged; what sensors are
    given in this step (`sensed`); then the numbers of `parts`. It gives those that the next step
    looks at and those of the observation (`kept`, `remembered`, `seen`), the terms of the reward,
    the ends of the task, the sum of the terms, the error, and FLAGS.
    """

    def __init__(
        self, written: WrittenStep, now: Snapshot, episode: Episode, parameters: np.ndarray
    ) -> None:
        """Trace the functions.

        Args:
            written: The step as it is written.
            now: Any snapshot of the task.
            episode: Any of its episodes.
            parameters: Rows that the task sees, (N,) or (1,).

        Raises:
            NotCompilable: The functions of the task do more than arithmetic.
        """
        self.written, self.task = written, written.task
        # State, parameters and world have places of their own.
        self._like = dataclasses.replace(now, state=None, parameters=None, world=None)
        self._episode, self._world = episode, now.world
        kept = [*records.leaves(self._like), *records.leaves(episode)]
        observer = written.observer
        remembered = arrays(observer.kept) if observer else []
        if any(array.dtype != np.float64 for array in (*kept, *remembered)):
            raise NotCompilable("what it remembers is not all float64")
        self.kept = records.Columns(0, kept)
        """Where the numbers that the next step looks at stand in its table."""
        self.remembered = records.Columns(self.kept.end, remembered)
        """Where those that sensors look at stand in it."""
        self.world = records.Columns(0, records.leaves(now.world) if now.world else [])
        """Where the numbers of the solids about an aircraft stand in a table."""
        inputs, motion = written.inputs, written.engine.motions.shape[-1]
        self.sensed = dict.fromkeys(("steps", "aged", "normal"), 0)
        """How many numbers of each kind sensors are given, as in `Senses` of
        native/free_flight.c."""
        if observer:
            errors = sum(width for _, width in observer.senses.draws.values())
            aged = AGED if len(written.randomizer.past) else 0
            self.sensed = {"steps": 1, "aged": aged, "normal": errors}
        self.parts = {
            "last_motion": motion,
            "action": inputs.action.shape[1],
            "command": inputs.command.shape[1],
            "was": self.remembered.end,
            "last_world": self.world.end,
            "world": self.world.end,
            "parameters": ROW_SIZE,
            "wind": 3 if observer else 0,
            "given": sum(observer.senses.given.values()) if observer else 0,
        }
        """How many numbers of each kind it takes after those."""
        self._rotors = int(parameters["rotor_count"][0])
        widths = motion, 1, *self.sensed.values(), *self.parts.values()
        fixed = motion + 1 + sum(self.sensed.values())
        given: Any = {"sound": False, "max_operations": MAX_OPERATIONS, "fixed": fixed}
        made, again = (RowFunction(self._finish, *widths, **given) for _ in range(2))
        if (made.source, made.constants.tobytes()) != (again.source, again.constants.tobytes()):
            raise NotCompilable("it gives something else each time")
        self.function = made
        """The function itself."""
        self.drawn = 0
        """How many random numbers of START a start takes, once it was traced."""

    @functools.cached_property
    def start(self) -> RowFunction:
        """`Task.begin` up to the first observation, for a row.

        It takes random numbers, one of MEMBERS and MAX_DRAWN of START, and parameters. It gives a
        motion, and the numbers that `function` gives before the reward.

        Raises:
            NotCompilable: The starts of the task are more than arithmetic, or sensors begin with
                them.
        """
        if self.written.observer:
            raise NotCompilable("sensors begin as they are written")
        widths = 1 + MAX_DRAWN, ROW_SIZE
        given: Any = {"sound": False, "max_operations": MAX_OPERATIONS, "fixed": 1 + MAX_DRAWN}
        return RowFunction(self._start, *widths, **given)

    def _finish(
        self,
        motion: Array,
        diverged: Array,
        steps: Array,
        aged: Array,
        normal: Array,
        last: Array,
        action: Array,
        command: Array,
        was: Array,
        last_world: Array,
        world: Array,
        parameters: Array,
        wind: Array,
        given: Array,
    ) -> Array:
        """The step of a row, arrays (1, k) of symbols."""
        places = iter(self.kept.views(was.T))
        before, begun = (records.filled(like, places) for like in (self._like, self._episode))
        before.state = self._state(last)
        before.parameters = self._parameters(parameters)
        before.world, about = self._world_of(last_world), self._world_of(world)
        state, observer, look = self._state(motion), self.written.observer, None
        if observer:
            senses, kept = observer.senses, self.memory(was.T)
            before.sensed = senses.shown(kept)
            old = aged if aged.size else motion[:, :AGED]
            errors = {name: width for name, (_, width) in senses.draws.items()}
            drawn = _split(given, senses.given), _split(normal, errors)
            moment = senses.moment(state, about, action, wind, steps[:, 0], old, *drawn)
            look = Look(senses, moment, kept)
        after, ended, done = finish(
            *(self.task, self.written.clock, begun, before, state),
            *(action, command, diverged[:, 0] != 0.0, about, look),
        )
        after.state = after.parameters = after.world = None  # type: ignore[assignment]
        kept = [*records.leaves(after), *records.leaves(ended)]
        remembered = arrays(look.after) if look else []
        return np.array([*self._values(kept, remembered, done)], dtype=object)[None]

    def _start(self, drawn: Array, parameters: Array) -> Array:
        """The start of an episode, arrays (1, k) of symbols."""

        def read(places: Array) -> Array:
            self.drawn = max(self.drawn, *places.flat)
            return drawn[0, places]

        own = self._parameters(parameters)
        start, task_state = self.task.begin(Draws(read, 1), own)
        task_state = self.task.remember(start, task_state)
        parts = start.position + self.written.engine.origin, start.quaternion
        motion = np.concatenate(
            [*parts, start.velocity, start.body_rate, start.rotor_speed], axis=-1
        )
        state = self._state(motion)
        now, episode, seen = begin(self.task, state, task_state, own, self.parts["action"])
        now.state = now.parameters = None  # type: ignore[assignment]
        kept = [*records.leaves(now), *records.leaves(episode)]
        numbers = self._numbers(kept, [], [*seen.values()])
        return np.array([*motion[0], *numbers], dtype=object)[None]

    def _parameters(self, numbers: Array) -> Parameters:
        return Parameters.of_symbols(numbers, self.written.clock.control_timestep, self._rotors)

    def _state(self, motion: Array) -> State:
        origin = self.written.engine.origin
        parts = np.split(motion[:, 3:], [4, 7, 10], axis=1)
        height = float(origin[2])
        return State.of_coordinates(motion[:, :3] - origin, *parts, origin_height=height)

    def _values(
        self, kept: list[Array], remembered: list[Array], done: Transition
    ) -> Iterator[Any]:
        """All that it gives, a number after the other."""
        self.observed, self.rewarded = list(done.observation), list(done.reward_terms)
        self.entries, self.ended = list(done.truth), list(done.ends)
        truth = done.truth.values() if self.written.observer else ()
        seen = [*done.observation.values(), *truth]
        self.seen = records.Columns(self.remembered.end, seen)
        yield from self._numbers(kept, remembered, seen)
        flags = (getattr(done, name) for name in FLAGS)
        named = (*done.reward_terms.values(), *done.ends.values())
        for array in (*named, done.reward, done.error, *flags):
            yield np.asarray(array, dtype=object)[0]

    def _numbers(
        self, kept: list[Array], remembered: list[Array], seen: list[Array]
    ) -> Iterator[Any]:
        """Arrays as the numbers that stand in the table."""
        numbers = np.arange(self.seen.end)[:, None]
        given = (self.kept, kept), (self.remembered, remembered), (self.seen, seen)
        for columns, parts in given:
            for places, array in zip(columns.views(numbers), parts, strict=True):
                yield from np.broadcast_to(np.asarray(array, dtype=object), places.shape).ravel()

    def _world_of(self, numbers: Array) -> World | None:
        """The solids about an aircraft, from their numbers."""
        if self._world is None:
            return None
        world = records.filled(self._world, iter(self.world.views(numbers.T)))
        for name in ("touched", "landed", "held"):
            setattr(world, name, getattr(world, name) != 0.0)
        return world

    def memory(self, table: np.ndarray) -> Kept:
        """What sensors remember, as views of a table."""
        observer = self.written.observer
        views = iter(self.remembered.views(table))
        return filled(observer.kept, views) if observer else {}

    def records(self, table: np.ndarray) -> tuple[Snapshot, Episode]:
        """The snapshot, but for what has no place in the table, and the episode, as its views."""
        parts = iter(self.kept.views(table))
        now, episode = (records.filled(like, parts) for like in (self._like, self._episode))
        return now, episode

    def leaves(self, now: Snapshot, episode: Episode) -> list[np.ndarray]:
        """The arrays of a snapshot and its episode that stand in the table."""
        moment = dataclasses.replace(now, state=None, parameters=None, world=None)
        return [*records.leaves(moment), *records.leaves(episode)]


def _split(numbers: Array, widths: Mapping[str, int]) -> dict[str, Array]:
    """Numbers (1, k) side by side, by name."""
    ends = np.cumsum([0, *widths.values()])
    return {k: numbers[:, a:b] for k, a, b in zip(widths, ends, ends[1:], strict=False)}
