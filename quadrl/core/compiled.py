"""A compiled control step: commands, physics and the task's part in one pass over rows, in C.

`native/free_flight.c` drives it; what it calls is traced from the control mode and from the task
(`core/program.py`). One aircraft alone would spend more time in eighty calls of NumPy than in its
simulation, and many aircraft would pass through memory many times. A class of tasks asks for it
with `compiled = True`: what the functions read besides their arguments then stays as it is when
they are called. A task whose functions do more than arithmetic runs as it is written, with the same
results.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from typing import cast

import numpy as np

from quadrl.base.errors import NativeError
from quadrl.base.philox import MEMBERS, START
from quadrl.base.rotation import Array
from quadrl.base.trace import NotCompilable
from quadrl.conditions.world import World
from quadrl.control.autopilot import Laws
from quadrl.control.mode import ControlMode
from quadrl.core.program import FLAGS, Program
from quadrl.core.senses import arrays
from quadrl.core.snapshot import Snapshot
from quadrl.core.step import Step, WrittenStep
from quadrl.core.tables import Page, Tables
from quadrl.core.transition import Episode, Observation, Transition
from quadrl.engines import native

ENDS, FINISHES = 1, 2
"""Parts of a control step after its physics, and LEFT, BROKEN, why an aircraft is marked: as in
native/free_flight.c."""
LEFT, BROKEN = 1, 2
MARKED = (1 << 32) - 1


def compiled(
    step: WrittenStep,
    now: Snapshot,
    episode: Episode,
    parameters: np.ndarray,
    mode: ControlMode,
) -> Step:
    """Compile the step of a task that asks for it; report a task once for which it is not possible.

    A class asks for itself, not for those that change its functions.

    Args:
        step: The step as it is written.
        now: Any snapshot of the task.
        episode: Any of its episodes.
        parameters: Rows that the task sees, (N,) or (1,), read live.
        mode: The control mode that flies.
    """
    if not step.task.asks_compiled:
        step.not_compiled = "its class does not say `compiled = True`"
        return step
    if step.observer and (reason := step.observer.not_compilable):
        step.not_compiled = reason
        return step
    try:
        return CompiledStep(step, now, episode, parameters, mode)
    except NotCompilable as error:
        step.report_not_compiled(str(error))
        return step


def sources(step: WrittenStep, parameters: np.ndarray, mode: ControlMode) -> list[str]:
    """The C that a compiled step needs, to be compiled before; arguments as for `compiled`.

    Raises:
        NotCompilable: The functions of the task do more than arithmetic.
    """
    program = Program(step, step.snapshot, step.episode, parameters)
    functions = [*Laws(mode, step.engine).functions(), program.function]
    with contextlib.suppress(NotCompilable):
        functions.append(program.start)
    return [function.source for function in functions]


class CompiledStep(Step):
    """A control step of N rows, in C.

    The snapshot, the episode and the observation stand in two tables in turn, as the engine's
    motions do. The rest of a transition has a table of its own: a row for each term of the reward
    and each end of the task, for the sum of the terms, for the error, and one for the flags, a byte
    each.
    """

    def __init__(
        self,
        written: WrittenStep,
        now: Snapshot,
        episode: Episode,
        parameters: np.ndarray,
        mode: ControlMode,
    ) -> None:
        """Trace and compile.

        Args:
            written: The same step as it is written.
            now: Any snapshot of the task, with those parameters.
            episode: Any of its episodes.
            parameters: Rows that the task sees, (N,) or (1,), read live.
            mode: The control mode that flies.

        Raises:
            NotCompilable: The functions of the task do more than arithmetic, or there is no
                compiler.
        """
        flown = written.engine, written.inputs, written.observer, written.loops
        super().__init__(written.task, written.clock, *flown, written.randomizer)
        self._parameters, engine = now.parameters, self.engine
        self.program = program = Program(written, now, episode, parameters)
        functions = Laws(mode, engine).functions()
        try:
            self.tables = Tables(program, functions, engine, self.inputs, parameters)
        except NativeError as error:
            raise NotCompilable(str(error).partition("\n")[0]) from error
        # Where nobody has to measure solids in between, the task's part follows at once.
        self._ends = ENDS | (0 if program.world.end else FINISHES)
        self._substeps = engine.vehicle.substeps
        self._into = 0  # the page that the present step fills
        self._flown = False
        self._broken: np.ndarray | None = None
        self._observation: dict[str, Array] = {}

    def begin(self, now: Snapshot, episode: Episode) -> None:
        """Make a snapshot of all rows the present one."""
        page = self.tables.pages[self.engine.turn]
        for into, array in zip(page.kept, self.program.leaves(now, episode), strict=True):
            into[:] = array
        if observer := self.observer:
            for into, array in zip(*map(arrays, (page.memory, observer.kept)), strict=True):
                into[:] = array
        self._show(page, now.world)

    def start(self, rows: np.ndarray, keys: np.ndarray, episodes: np.ndarray) -> Observation | None:
        """Begin episodes (n,) of aircraft as they are specified, in air that is at rest.

        Returns:
            The observation of those aircraft, terms (n, k); None, and nothing has changed, where
            the functions of the task have to begin them.
        """
        if (starts := self._starts) is None:
            return None
        function, places, count = self.program.start, starts, len(rows)
        words, room = np.array((rows, keys, episodes)), np.empty((count, function.width))
        ids, keyed, numbered = (native.address(words) + k * words.strides[0] for k in range(3))
        step, into, library = self.tables.address, native.address(room), native.library()
        given = places.ctypes.data, len(places), ids, count
        drawn = keyed, numbered, START, self.program.drawn, MEMBERS
        if library.quadrl_begin(step, *given, *drawn, into):
            return None
        self.engine.clear(rows)
        library.quadrl_place(step, ids, count, into, function.width, self.program.kept.end)
        self.engine.show(rows)
        seen = self.program.seen.views(room[:, self.engine.motions.shape[-1] :].T)
        return dict(zip(self.program.observed, seen, strict=False))

    @functools.cached_property
    def _starts(self) -> np.ndarray | None:
        """The places that starts read; None where they cannot be compiled."""
        try:
            return self.tables.begin_by(self.program.start)
        except (NotCompilable, NativeError):
            return None

    def fly(self) -> bool:
        """Command and fly the aircraft through a control step; False where that is not its part."""
        engine = self.engine
        if engine.name != "free_flight":
            return False
        self._turn()
        self.randomizer.passed()
        if self._call(None, self._ends, 0, self._substeps):
            marked = np.flatnonzero(engine.near)
            kinds = engine.near[marked]
            self._mend(np.concatenate([marked[kinds == BROKEN], self._land(marked[kinds == LEFT])]))
        else:
            for first, end in self._pieces():
                engine.passed(end - first)
        self._flown = True
        engine.take_turn()
        return True

    def _land(self, left: np.ndarray) -> np.ndarray:
        """Fly aircraft (n,) that may touch something; return those that have diverged."""
        if not len(left):
            return left
        for first, end in self._pieces():
            if self._call(left, 0, first, end):
                self.engine.touch(left[self.engine.near[left] != 0], end - first)
            else:
                self.engine.passed(end - first)
        self._call(left, self._ends)
        return left[self.engine.near[left] == BROKEN]

    def _pieces(self) -> Iterator[tuple[int, int]]:
        """The physics steps that are flown at once: the first one, and the one after the last."""
        first = 0
        while first < self._substeps:
            yield first, (first := first + int(self.tables.held[first]))

    def _call(self, rows: np.ndarray | None, parts: int, first: int = 0, end: int = 0) -> int:
        """Do physics steps and parts of a control step of some aircraft; how many are marked."""
        step = self.tables.steps[self._into].ctypes.data
        return self.engine.control_step(step, rows, parts, first, end) & MARKED

    def _turn(self) -> None:
        """Let the present step fill the other page."""
        self._into = 1 - self.engine.turn
        self._rest = self.tables.fresh(self._into)

    def _mend(self, broken: np.ndarray) -> None:
        """Note aircraft that have diverged."""
        if not len(broken):
            return
        self.engine.mend(broken)
        self._broken = np.zeros(self.engine.num_envs, bool)
        self._broken[broken] = True
        self.note_diverged(broken)
        self.randomizer.forget(broken)
        if self._ends & FINISHES:
            self._call(broken, FINISHES)

    def read(self) -> np.ndarray | None:
        """Take the motion at the end of a control step; which aircraft have diverged, or None."""
        if not self._flown:
            self._turn()
            if self._call(None, self._ends):
                self._mend(np.flatnonzero(self.engine.near))
            self.engine.take_turn()
        self._flown, (broken, self._broken) = False, (self._broken, None)
        return broken

    def finish(self, world: World | None) -> Transition:
        """Bring the snapshot forward to the engine's state, as `transition.finish` does."""
        tables, count = self.tables, self.engine.num_envs
        page, last = tables.pages[self._into], tables.pages[1 - self._into]
        if not self._ends & FINISHES:
            # A reset since the last step has given its rows what is about them then.
            for about, into in ((self._present.world, last), (world, page)):
                tables.take(cast(World, about), into)
            self._call(None, FINISHES)
        self._show(page, world)
        self._observation = page.observation.copy()
        *named, reward, error = self._rest[:-1, :count]
        terms = named[: len(self.program.rewarded)]
        ends = self._rest[len(terms) : -3, :count] != 0.0
        flags = self._rest[-1].view(np.bool_).reshape(-1, tables.columns)[:, :count]
        return Transition(
            observation=self._observation,
            reward=reward,
            reward_terms=dict(zip(self.program.rewarded, terms, strict=True)),
            ends=dict(zip(self.program.ended, ends, strict=True)),
            error=error,
            truth=page.truth or self._observation,
            **dict(zip(FLAGS, flags, strict=False)),
        )

    def _show(self, page: Page, world: World | None) -> None:
        """Make a table the present one."""
        if observer := self.observer:
            observer.kept = page.memory
            page.now.sensed = observer.sensed
        page.now.world = world
        page.now.parameters = self._parameters
        self._present, self.episode = page.now, page.episode

    @property
    def snapshot(self) -> Snapshot:  # type: ignore[override]
        """What tasks see now: live, valid until the next step."""
        self._present.state = self.engine.state
        return self._present

    def flatten(self, observation: dict[str, Array]) -> np.ndarray:
        """The terms of an observation as vectors (n, size), float32."""
        if observation is self._observation:
            return self.tables.pages[self.engine.turn].vectors.astype(np.float32, order="C")
        return super().flatten(observation)
