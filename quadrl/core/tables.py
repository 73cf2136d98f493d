"""Where the numbers of a compiled control step stand, for `native/free_flight.c`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadrl.aircraft.parameters import ROW_SIZE
from quadrl.base import records
from quadrl.conditions.world import World
from quadrl.core.program import MAX_DRAWN, Program
from quadrl.core.step import Inputs
from quadrl.engines import native
from quadrl.engines.engine import Engine
from quadrl.engines.rowwise import RowFunction
from quadrl.engines.state import padded

START, REST = 7, 16
"""Indices of `start` and of `rest` in `Step` of native/free_flight.c; `flags` follows."""
Place = tuple[int, int, int]
"""Address of a number of the first row, stride between rows, and which one it is."""


class Page:
    """A table of all that a step gives, a row per number, and its named views."""

    def __init__(self, program: Program, whole: np.ndarray, count: int) -> None:
        """Lay out a table for N rows."""
        self.whole, columns = whole, whole.shape[1]
        table = self.whole[:, :count]
        self.world = np.empty((program.world.end + 1, columns))  # at least a row has an address
        self.kept = program.kept.views(table)
        self.memory = program.memory(table)
        self.now, self.episode = program.records(table)
        seen, names = program.seen.views(table), program.observed
        self.observation = dict(zip(names, seen, strict=False))
        self.truth = dict(zip(program.entries, seen[len(names) :], strict=False))
        size = sum(array.shape[1] for array in self.observation.values())
        self.vectors = table[program.remembered.end : program.remembered.end + size].T


class Tables:
    """Two pages that steps fill in turn, as they do the engine's motions."""

    def __init__(
        self,
        program: Program,
        functions: Sequence[RowFunction],
        engine: Engine,
        inputs: Inputs,
        parameters: np.ndarray,
    ) -> None:
        """Lay out the tables.

        Args:
            program: The task's part.
            functions: Setpoint and rotor commands of the control mode, to compile.
            engine: The engine.
            inputs: What a control step is flown with.
            parameters: Rows that the task sees, (N,) or (1,), read live.

        Raises:
            NativeError: There is no compiler, or it refused a source.
        """
        self._program, self._engine, self._parameters = program, engine, parameters
        self.count, self.columns = engine.num_envs, padded(engine.num_envs)
        # In one piece, since the system gives large pages of memory only to what is large.
        both = np.empty((2, program.seen.end, self.columns))
        self.pages = tuple(Page(program, whole, self.count) for whole in both)
        setpoint = np.zeros((self.count, functions[0].width))
        made, limits = [*functions, program.function], engine.limits
        structs = [function.struct() for function in made]
        sizes = inputs.action.shape[1], limits.shape[1] if len(limits) > 1 else 0
        named = len(program.rewarded) + len(program.ended)
        sizes = *sizes, program.seen.end, named, self.columns
        loops, randomizer = program.written.loops, program.written.randomizer
        more, late = (loops, engine.vehicle.substeps), randomizer.rows if randomizer.late else None
        self.held = np.array([1] * len(randomizer.held) if loops else randomizer.held)
        """For each physics step of a control step, how many are flown at once from there on."""
        self.steps: list[np.ndarray] = []
        """A `Step` of native/free_flight.c for each page."""
        senses = _senses(program, engine)
        # C has the addresses.
        self._alive: list[object] = [made, structs, setpoint, engine.rows, *senses]
        for turn, page in enumerate(self.pages):
            places = self._places(turn, inputs)
            flown = inputs.action, limits, engine.motions[turn], setpoint, inputs.command
            filled = inputs.diverged, places, page.whole, None, None, len(places)
            about = engine.rows, late, senses[0] if senses else None, self.held
            step = native.struct(*about, *structs, None, *flown, *filled, *sizes, *more)
            self.steps.append(step)
            self._alive.append(places)
        self._wanted = self._read_of_world()

    @property
    def address(self) -> int:
        """Address of the `Step` whose page is the present one."""
        return self.steps[self._engine.turn].ctypes.data

    def fresh(self, turn: int) -> np.ndarray:
        """A table for what else a step of a page gives: terms, ends, reward, error and flags."""
        named = len(self._program.rewarded) + len(self._program.ended)
        rest = np.empty((named + 3, self.columns))
        first = native.address(rest)
        self.steps[turn][REST : REST + 2] = first, first + 8 * self.columns * (len(rest) - 1)
        return rest

    def begin_by(self, start: RowFunction) -> np.ndarray:
        """Let episodes begin by a function; return the places that it reads.

        These are of parameters, which come last in it.

        Raises:
            NativeError: There is no compiler, or it refused the source.
        """
        struct = start.struct()
        for step in self.steps:
            step[START] = struct.ctypes.data
        self._alive += [start, struct]
        row, stride = self._parameters.ctypes.data, self._stride
        return _read([(row + 8 * k, stride, 1 + MAX_DRAWN + k) for k in range(ROW_SIZE)], start)

    @property
    def _stride(self) -> int:
        table = self._parameters
        return table.strides[0] // 8 if len(table) > 1 else 0

    def _places(self, turn: int, inputs: Inputs) -> np.ndarray:
        """The places of what the task's part reads in a step that fills a page."""
        motions, page, other = self._engine.motions, self.pages[turn], self.pages[1 - turn]
        columns, parts, wind = self.columns, self._program.parts, self._engine.wind
        observer = self._program.written.observer
        given = [*observer.given.values()] if observer else []
        tables: dict[str, tuple[np.ndarray, int, int]] = {  # strides between rows and numbers
            "last_motion": (motions[1 - turn], motions.shape[-1], 1),
            "action": (inputs.action, inputs.action.shape[1], 1),
            "command": (inputs.command, inputs.command.shape[1], 1),
            "was": (other.whole, 1, columns),
            "last_world": (other.world, 1, columns),
            "world": (page.world, 1, columns),
            "parameters": (self._parameters, self._stride, 1),
            "wind": (wind, wind.strides[0] // 8, 1),
        }
        number, places = self._first, list[Place]()
        for name, count in parts.items():
            arrays = [(*tables[name], count)] if name in tables else []
            arrays = arrays or [(a, a.shape[1], 1, a.shape[1]) for a in given]
            for array, across, along, width in arrays:
                first = array.ctypes.data
                places += [(first + 8 * k * along, across, number + k) for k in range(width)]
                number += width
        return _read(places, self._program.function)

    @property
    def _first(self) -> int:
        """Which number of the task's part is the first one that has a place."""
        return self._engine.motions.shape[-1] + 1 + sum(self._program.sensed.values())

    def _read_of_world(self) -> list[tuple[int, np.ndarray]]:
        """Where each array of the world begins in its table, and which places are read."""
        first, found = self._first, set[int]()
        for name, count in self._program.parts.items():
            if name in ("world", "last_world"):
                read = (k - first for k in self._program.function.places)
                found |= {k for k in read if 0 <= k < count}
            first += count
        numbers = np.arange(self._program.world.end)[:, None]
        places = [array.ravel().tolist() for array in self._program.world.views(numbers)]
        read = ([k for k in own if k in found] for own in places)
        firsts = (own[0] if own else 0 for own in places)
        return [(k, np.array(own, int)) for k, own in zip(firsts, read, strict=True)]

    def take(self, world: World, page: Page) -> None:
        """Write what the task's part reads of solids into a page.

        Only that is copied: of a hundred solids a task may look at one.
        """
        for array, (first, places) in zip(records.leaves(world), self._wanted, strict=True):
            if places.size:
                numbers = array.reshape(self.count, -1)[:, places - first]
                page.world[places, : self.count] = numbers.T


def _senses(program: Program, engine: Engine) -> list[np.ndarray]:
    """What sensors are given, as `Senses` of native/free_flight.c; then arrays that it points to.

    Empty where nobody observes.
    """
    if not (observer := program.written.observer):
        return []
    source = program.written.randomizer
    draws = np.array([*observer.senses.draws.values()], np.int64).reshape(-1, 2)
    ages = source.ages if len(source.past) else None
    given = *source.place, source.steps, ages, draws
    return [native.struct(*given, len(draws), engine.num_envs), draws]


def _read(places: list[Place], function: RowFunction) -> np.ndarray:
    """Those that a function reads, as `Place`s of native/free_flight.c, (n, 3)."""
    at = function.places
    read = [(first, stride, at[number]) for first, stride, number in places if number in at]
    return np.array(read, np.int64).reshape(-1, 3)
