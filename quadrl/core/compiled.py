"""The control step of a task, compiled: `transition.finish` as one loop over rows.

The functions of a task are called twice, with symbols (`quadrl.base.trace`); what they compute
becomes a C function, and NumPy's rows fly with it. One aircraft alone would spend more time in
eighty calls of NumPy than in its simulation. A class of tasks asks for it with `compiled = True`:
what the functions read besides their arguments then stays as it is when they are called. A task
whose functions do more than arithmetic runs as it is written, with the same results.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import warnings
import weakref
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from quadrl.aircraft.parameters import AIRCRAFT, ROW_SIZE, Parameters
from quadrl.base import records
from quadrl.base.errors import NativeError, QuadrlWarning
from quadrl.base.rotation import Array
from quadrl.base.trace import NotCompilable, Trace, symbolic
from quadrl.conditions.scene import Surroundings
from quadrl.core.snapshot import Snapshot
from quadrl.core.step import Step, WrittenStep
from quadrl.core.step_source import FLAGS, SOURCE, Rows
from quadrl.core.task import Task
from quadrl.core.transition import Episode, Transition, finish
from quadrl.engines import native
from quadrl.engines.native import compiling
from quadrl.engines.state import State, padded

MANY, FEW = 2048, 300
"""With more rows than that, a step of fewer operations (statements of C, of which hover has 201) is
faster in NumPy, by up to two fifths. What has more, such as a race (590), is up to 20 times slower
there."""
_REPORTED: weakref.WeakSet[type[Task]] = weakref.WeakSet()
"""Tasks that were reported as not compiled."""


def compiled(step: WrittenStep, now: Snapshot, episode: Episode, parameters: np.ndarray) -> Step:
    """Compile the step of a task that asks for it; report a task once for which it is not possible.

    A class asks for itself, not for those that change its functions.

    Args:
        step: The step as it is written.
        now: Any snapshot of the task.
        episode: Any of its episodes.
        parameters: Rows that the task sees, (N,) or (1,), read live.
    """
    if not vars(type(step.task)).get("compiled", False):
        step.not_compiled = "its class does not say `compiled = True`"
        return step
    try:
        return CompiledStep(step, now, episode, parameters)
    except _Faster as error:
        step.not_compiled = str(error)
        return step
    except NotCompilable as error:
        return _reported(step, str(error))


def _reported(step: WrittenStep, reason: str) -> WrittenStep:
    """Return the step as it is written; warn of the reason, once for each task."""
    step.not_compiled, task = reason, type(step.task)
    if task not in _REPORTED:
        _REPORTED.add(task)
        advice = "NumPy runs it; without `compiled = True` in the class nobody asks for more"
        message = f"the step of the task {task.name} is not compiled: {reason}; {advice}"
        warnings.warn(message, QuadrlWarning, stacklevel=2)
    return step


class _Faster(NotCompilable):
    """A step that is faster as it is written."""


class _Page:
    """A table of all that a step gives, a row per number, and its named views."""

    def __init__(self, step: CompiledStep, now: Snapshot, episode: Episode) -> None:
        """Lay out a table for records like those."""
        whole = np.empty((step.seen.end, step.columns))
        table = whole[:, : step.count]
        self.address = native.address(whole)
        sensed = np.empty((step.sensed.end + 1, step.columns))  # at least a row has an address
        self.sensed_address, self.sensed = native.address(sensed), sensed[:, : step.count]
        self.kept = step.kept.views(table)
        parts = iter(self.kept)
        self.now, self.episode = (records.filled(like, parts) for like in (now, episode))
        seen = step.seen.views(table)
        self.observation = dict(zip(step.observed, seen, strict=False))
        self.truth = dict(zip(step.observed, seen[len(step.observed) :], strict=False))
        size = sum(array.shape[1] for array in self.observation.values())
        self.vectors = table[step.kept.end : step.kept.end + size].T


class CompiledStep(Step):
    """A task's step for N rows, in C.

    The snapshot, the episode and the observation stand in two tables in turn, as an engine's state
    does. The rest of a transition has a table of its own: a row for each term of the reward, for
    their sum, for the error, and one for the flags, a byte each.
    """

    def __init__(
        self, written: WrittenStep, now: Snapshot, episode: Episode, parameters: np.ndarray
    ) -> None:
        """Trace and compile.

        Args:
            written: The same step as it is written.
            now: Any snapshot of the task, with those parameters.
            episode: Any of its episodes.
            parameters: Rows that the task sees, (N,) or (1,), read live.

        Raises:
            NotCompilable: The functions of the task do more than arithmetic, or there is no
                compiler.
        """
        world = written.engine, written.inputs, written.estimate, written.scene
        super().__init__(written.task, written.clock, *world)
        self._parameters = now.parameters
        self.count, self.columns = self.engine.num_envs, padded(self.engine.num_envs)
        # State, parameters and surroundings have tables of their own.
        like = dataclasses.replace(now, state=None, parameters=None, around=None)
        kept = [*records.leaves(like), *records.leaves(episode)]
        if any(array.dtype != np.float64 for array in kept):
            raise NotCompilable("what it remembers is not all float64")
        self.kept = records.Columns(0, kept)
        # Some sensors give what only policies see.
        self._shown = [name for name in self.task.sensors if name in now.sensed]
        self._around = now.around
        around = records.leaves(now.around) if now.around else []
        self.sensed = records.Columns(0, [*(now.sensed[name] for name in self._shown), *around])
        (trace, body), (again, other) = (self._traced(like, episode) for _ in range(2))
        constants = np.array([*trace.constants, 0.0])
        if body != other or constants.tobytes() != np.array([*again.constants, 0.0]).tobytes():
            raise NotCompilable("it gives something else each time")
        if self.count > MANY and body.count(";") < FEW:
            raise _Faster(f"NumPy is faster for {self.count} rows of so few operations")
        try:
            source = SOURCE.format(flags=self.flags, body=body)
            self._call = compiling.compile_generated(source).step
        except NativeError as error:
            raise NotCompilable(str(error).partition("\n")[0]) from error
        self._call.argtypes, self._call.restype = [ctypes.c_void_p, ctypes.c_int64], None
        self._constants = constants
        # Only what the body reads is copied: of a hundred solids a task may look at one.
        self._wanted = [
            (places[0], np.array([k for k in places if f"sensed[{k} * columns" in body], int))
            for numbers in self.sensed.views(np.arange(self.sensed.end)[:, None])
            for places in [numbers.ravel().tolist()]
        ]
        inputs = (getattr(self.inputs, f.name) for f in dataclasses.fields(self.inputs))
        self._arguments = Rows(
            *(array.ctypes.data for array in (self._constants, parameters, *inputs)),
            estimate=self.estimate.address if self.estimate else None,
            stride=parameters.strides[0] // 8 if len(parameters) > 1 else 0,
            columns=self.columns,
        )
        self._address = ctypes.addressof(self._arguments)
        self._pages = tuple(_Page(self, like, episode) for _ in range(2))
        self._observation: dict[str, np.ndarray] = {}

    def _traced(self, like: Snapshot, episode: Episode) -> tuple[Trace, str]:
        """The operations of a step, and the body of its loop."""
        trace = Trace()

        def read(place: str) -> Callable[[Any], Any]:
            return functools.partial(trace.read, place)

        # Arrays whose numbers say where they stand, made by what makes the views of real ones.
        own = Parameters.of(
            np.arange(float(ROW_SIZE)).view(AIRCRAFT),
            self.clock.control_timestep,
            self.inputs.command.shape[1],
        )
        states = State.of_table(np.arange(len(self.engine.frames[0].table))[:, None])
        state, last_state, estimate = (
            records.mapped(read(f"{name}[{{}} * columns + i]"), states)
            for name in ("state", "last_state", "estimate")
        )
        places = iter(self.kept.views(np.arange(self.kept.end)[:, None]))
        before, begun = (
            records.mapped(read("was[{} * columns + i]"), records.filled(record, places))
            for record in (like, episode)
        )
        before.state, before.parameters = last_state, own.map(read("p[i * stride + {}]"))
        sensors = self.sensed.views(np.arange(self.sensed.end)[:, None])
        action, command = (
            read(f"{name}[i * {size} + {{}}]")(np.arange(size)[None])
            for name in ("action", "command")
            for size in [getattr(self.inputs, name).shape[1]]
        )
        diverged = trace.inputs(np.array(["diverged[i]"], object), is_flag=True)
        given = (
            self.given(map(read(f"{name}[{{}} * columns + i]"), sensors))
            for name in ("last_sensed", "sensed")
        )
        (before.sensed, before.around), (sensed, around) = given
        for solids in filter(None, (before.around, around)):
            for name in ("touched", "landed", "held"):
                setattr(solids, name, getattr(solids, name) != 0.0)
        seen_from = estimate if self.estimate else None
        inputs = state, action, command, diverged, seen_from, around, sensed
        with symbolic():
            after, ended, done = finish(self.task, self.clock, begun, before, *inputs)
            after.state = after.parameters = after.around = None  # type: ignore[assignment]
            kept = [*records.leaves(after), *records.leaves(ended)]
            return trace, trace.body(self._outputs(kept, done))

    def given(self, arrays: Iterable[Any]) -> tuple[dict[str, Any], Surroundings | None]:
        """Arrange arrays as what the task sees: sensors by name, and the solids about aircraft."""
        rest = iter(arrays)
        sensed = {name: next(rest) for name in self._shown}
        return sensed, records.filled(self._around, rest) if self._around else None

    def _outputs(self, kept: list[Array], done: Transition) -> dict[str, Any]:
        """Map the places in the tables to what is written there."""
        self.observed, self._rewarded = list(done.observation), list(done.reward_terms)
        seen = [*done.observation.values(), *(done.truth.values() if self.estimate else ())]
        rest = [*done.reward_terms.values(), done.reward, done.error]
        self.seen = records.Columns(self.kept.end, seen)
        self.flags, outputs = len(rest), dict[str, Any]()
        numbers = np.arange(self.seen.end)[:, None]
        for columns, arrays in ((self.kept, kept), (self.seen, seen)):
            for places, array in zip(columns.views(numbers), arrays, strict=True):
                values = np.broadcast_to(np.asarray(array, dtype=object), places.shape)
                for place, value in zip(places.ravel(), values.ravel(), strict=True):
                    outputs[f"out[{place} * columns + i]"] = value
        for k, array in enumerate(rest):
            outputs[f"rest[{k} * columns + i]"] = np.asarray(array, dtype=object)[0]
        for k, name in enumerate(FLAGS):
            outputs[f"flags[{k} * columns + i]"] = np.asarray(getattr(done, name), dtype=object)[0]
        return outputs

    def begin(self, now: Snapshot, episode: Episode) -> None:
        """Make a snapshot of all rows the present one."""
        moment = dataclasses.replace(now, state=None, parameters=None, around=None)
        arrays = [*records.leaves(moment), *records.leaves(episode)]
        for into, array in zip(self._pages[0].kept, arrays, strict=True):
            into[:] = array
        self._show(self._pages[0], now.sensed, now.around)

    def finish(self, sensed: Mapping[str, np.ndarray]) -> Transition:
        """Bring the snapshot forward to the engine's state, as `transition.finish` does."""
        last, page = self._pages
        self._pages = page, last
        rows, (now, before) = self._arguments, self.engine.frames
        rows.state, rows.last_state = now.address, before.address
        around = self.scene.surroundings(self.engine) if self.scene.solids else None
        # A reset since the last step has given its rows what the sensors show then.
        self._take(self.snapshot.sensed, self.snapshot.around, last)
        self._take(sensed, around, page)
        rows.sensed, rows.last_sensed = page.sensed_address, last.sensed_address
        rest, count = np.empty((self.flags + 1, self.columns)), self.count
        rows.was, rows.out, rows.rest = last.address, page.address, native.address(rest)
        self._call(self._address, count)
        self._show(page, sensed, around)
        self._observation = page.observation.copy()
        *terms, reward, error = rest[:-1, :count]
        flags = rest[-1].view(np.bool_).reshape(-1, self.columns)[: len(FLAGS), :count]
        return Transition(
            observation=self._observation,
            reward=reward,
            reward_terms=dict(zip(self._rewarded, terms, strict=True)),
            error=error,
            truth=page.truth or self._observation,
            **dict(zip(FLAGS, flags, strict=True)),
        )

    def _take(
        self, sensed: Mapping[str, np.ndarray], around: Surroundings | None, page: _Page
    ) -> None:
        """Write what the compiled step reads of sensors and solids into its table."""
        given = [sensed[name] for name in self._shown] + (records.leaves(around) if around else [])
        for array, (first, places) in zip(given, self._wanted, strict=True):
            if places.size:
                page.sensed[places] = array.reshape(self.count, -1)[:, places - first].T

    def _show(
        self, page: _Page, sensed: Mapping[str, np.ndarray], around: Surroundings | None
    ) -> None:
        """Make a table the present one."""
        page.now.sensed, page.now.around = sensed, around
        page.now.state, page.now.parameters = self.engine.state, self._parameters
        self.snapshot, self.episode = page.now, page.episode

    def flatten(self, observation: dict[str, Array]) -> np.ndarray:
        """The terms of an observation as vectors (n, size), float32."""
        if observation is self._observation:
            return self._pages[0].vectors.astype(np.float32, order="C")
        return super().flatten(observation)
