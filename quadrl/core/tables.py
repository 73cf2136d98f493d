"""Where the numbers of a compiled control step stand, for `native/free_flight.c`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from quadrl.aircraft.parameters import ROW_SIZE
from quadrl.base.rotation import Array
from quadrl.conditions.world import World
from quadrl.core.program import MAX_DRAWN, Program
from quadrl.core.step import Inputs
from quadrl.engines import native
from quadrl.engines.engine import Engine
from quadrl.engines.rowwise import RowFunction
from quadrl.engines.state import padded

REST = 14
"""Index of `rest` in `Step` of native/free_flight.c; `flags` follows."""
Place = tuple[int, int, int]
"""Address of a number of the first row, stride between rows, and which one it is."""


class Page:
    """A table of all that a step gives, a row per number, and its named views."""

    def __init__(self, program: Program, whole: np.ndarray, count: int) -> None:
        """Lay out a table for N rows."""
        self.whole, columns = whole, whole.shape[1]
        table = self.whole[:, :count]
        sensed = np.empty((program.sensed.end + 1, columns))  # at least a row has an address
        self.sensed = sensed[:, :count]
        self.kept = program.kept.views(table)
        self.now, self.episode = program.records(table)
        seen, names = program.seen.views(table), program.observed
        self.observation = dict(zip(names, seen, strict=False))
        self.truth = dict(zip(names, seen[len(names) :], strict=False))
        size = sum(array.shape[1] for array in self.observation.values())
        self.vectors = table[program.kept.end : program.kept.end + size].T


class Tables:
    """Two pages that steps fill in turn, as they do the engine's motions."""

    def __init__(
        self,
        program: Program,
        functions: Sequence[RowFunction],
        engine: Engine,
        inputs: Inputs,
        estimate: np.ndarray | None,
        parameters: np.ndarray,
    ) -> None:
        """Lay out the tables.

        Args:
            program: The task's part.
            functions: Setpoint and rotor commands of the control mode, to compile.
            engine: The engine.
            inputs: What a control step is flown with.
            estimate: Coordinates (N, 13 + R) of the state that is observed; None for the true one.
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
        sizes = *sizes, program.seen.end, len(program.rewarded), self.columns
        loops, randomizer = program.written.loops, program.written.randomizer
        more, late = (loops, engine.vehicle.substeps), randomizer.rows if randomizer.late else None
        self.held = np.array([1] * len(randomizer.held) if loops else randomizer.held)
        """For each physics step of a control step, how many are flown at once from there on."""
        self.steps: list[np.ndarray] = []
        """A `Step` of native/free_flight.c for each page."""
        self._alive: list[object] = [made, structs, setpoint, engine.rows]  # C has the addresses
        for turn, page in enumerate(self.pages):
            places = self._places(turn, inputs, estimate)
            flown = inputs.action, limits, engine.motions[turn], setpoint, inputs.command
            filled = inputs.diverged, places, page.whole, None, None, len(places)
            about = engine.rows, late, self.held
            step = native.struct(*about, *structs, *flown, *filled, *sizes, *more)
            self.steps.append(step)
            self._alive.append(places)
        self._wanted = self._read_of_sensed()

    @property
    def address(self) -> int:
        """Address of the `Step` whose page is the present one."""
        return self.steps[self._engine.turn].ctypes.data

    def fresh(self, turn: int) -> np.ndarray:
        """A table for what else a step gives, that fills a page: terms, reward, error and flags."""
        rest = np.empty((len(self._program.rewarded) + 3, self.columns))
        first = native.address(rest)
        self.steps[turn][REST : REST + 2] = first, first + 8 * self.columns * (len(rest) - 1)
        return rest

    def places_of(self, start: RowFunction) -> np.ndarray:
        """The places of the parameters that a function of a start reads, which come last in it."""
        row, stride = self._parameters.ctypes.data, self._stride
        return _read([(row + 8 * k, stride, 1 + MAX_DRAWN + k) for k in range(ROW_SIZE)], start)

    @property
    def _stride(self) -> int:
        table = self._parameters
        return table.strides[0] // 8 if len(table) > 1 else 0

    def _places(self, turn: int, inputs: Inputs, estimate: np.ndarray | None) -> np.ndarray:
        """The places of what the task's part reads in a step that fills a page."""
        motions, page, other = self._engine.motions, self.pages[turn], self.pages[1 - turn]
        motion, columns, parts = motions.shape[-1], self.columns, self._program.parts
        tables: dict[str, tuple[np.ndarray, int, int]] = {  # strides between rows and numbers
            "last_motion": (motions[1 - turn], motion, 1),
            "action": (inputs.action, inputs.action.shape[1], 1),
            "command": (inputs.command, inputs.command.shape[1], 1),
            "was": (other.whole, 1, columns),
            "last_sensed": (other.sensed, 1, columns),
            "sensed": (page.sensed, 1, columns),
            "estimate": (motions[turn] if estimate is None else estimate, motion, 1),
            "parameters": (self._parameters, self._stride, 1),
        }
        number, places = motion + 1, list[Place]()
        for name, count in parts.items():
            array, across, along = tables[name]
            first = array.ctypes.data
            places += [(first + 8 * k * along, across, number + k) for k in range(count)]
            number += count
        return _read(places, self._program.function)

    def _read_of_sensed(self) -> list[tuple[int, np.ndarray]]:
        """Where each array begins in the tables of what is sensed, and which places are read."""
        first, found = self._engine.motions.shape[-1] + 1, set[int]()
        for name, count in self._program.parts.items():
            if name in ("sensed", "last_sensed"):
                read = (k - first for k in self._program.function.places)
                found |= {k for k in read if 0 <= k < count}
            first += count
        numbers = np.arange(self._program.sensed.end)[:, None]
        places = [array.ravel().tolist() for array in self._program.sensed.views(numbers)]
        return [(own[0], np.array([k for k in own if k in found], int)) for own in places]

    def take(self, sensed: Mapping[str, Array], world: World | None, page: Page) -> None:
        """Write what the task's part reads of sensors and solids into a page.

        Only that is copied: of a hundred solids a task may look at one.
        """
        given = self._program.sources(sensed, world)
        for array, (first, places) in zip(given, self._wanted, strict=True):
            if places.size:
                page.sensed[places] = array.reshape(self.count, -1)[:, places - first].T


def _read(places: list[Place], function: RowFunction) -> np.ndarray:
    """Those that a function reads, as `Place`s of native/free_flight.c, (n, 3)."""
    at = function.places
    read = [(first, stride, at[number]) for first, stride, number in places if number in at]
    return np.array(read, np.int64).reshape(-1, 3)
