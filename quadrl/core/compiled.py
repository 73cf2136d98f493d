"""The control step of a task, compiled: `transition.finish` as one loop over rows.

The functions of a task are called twice, with symbols (`quadrl.base.trace`); what they compute
becomes a C function, and NumPy's rows fly with it. One aircraft alone would spend more time in
eighty calls of NumPy than in its simulation. A task whose functions do more than arithmetic cannot
be compiled and is run as it is written, with the same results.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import itertools
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from quadrl.aircraft.parameters import AIRCRAFT, ROW_SIZE, Parameters
from quadrl.base import records
from quadrl.base.rotation import Array
from quadrl.base.trace import Trace
from quadrl.core.snapshot import Snapshot
from quadrl.core.task import Task
from quadrl.core.transition import Clock, Episode, Transition, finish
from quadrl.engines import native
from quadrl.engines.engine import Engine, Frame
from quadrl.engines.state import State

_ALONE = [object()]
FREE = sys.getrefcount(_ALONE[0])
"""References to what only one container holds, from there and from the question."""
SPARE = 4
"""Tables that are kept to be written to again."""
MOMENT = ("action", "rotor_command", "time")
"""Arrays of a snapshot that are its own."""
FLAGS = ("terminated", "truncated", "is_success", "diverged")
POINTERS = (
    *("constants", "parameters", "action", "command", "diverged"),
    *("state", "last_state", "estimate", "was", "out"),
)
SOURCE = """#include <math.h>
#include <stdint.h>
typedef struct {{
  const double *constants, *parameters, *action, *command;
  const uint8_t* diverged;
  const double *state, *last_state, *estimate, *was;
  double* out;
  int64_t stride, columns;
}} Rows;
__attribute__((visibility("default"))) void step(const Rows* rows, int64_t n) {{
  const double *restrict c = rows->constants, *restrict p = rows->parameters;
  const double *restrict action = rows->action, *restrict command = rows->command;
  const double *restrict state = rows->state, *restrict last_state = rows->last_state;
  const double *restrict estimate = rows->estimate, *restrict was = rows->was;
  const uint8_t* restrict diverged = rows->diverged;
  double* restrict out = rows->out;
  const int64_t stride = rows->stride, columns = rows->columns;
  uint8_t* restrict flags = (uint8_t*)(out + {flags} * columns);
  for (int64_t i = 0; i < n; ++i) {{
    {body}
  }}
}}
"""


class _Rows(ctypes.Structure):
    """Where the function finds its rows; as in SOURCE."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in POINTERS),
        *((name, ctypes.c_int64) for name in ("stride", "columns")),
    ]


class _Columns:
    """Where arrays (N, ...) stand in a table (rows, N), a row per number."""

    def __init__(self, first: int, arrays: list[Array]) -> None:
        """Lay them out from a row on, by their shapes."""
        self._places: list[tuple[Any, int, tuple[int, ...]]] = []
        self.end = first
        for array in arrays:
            tail = array.shape[1:]
            start, self.end = self.end, self.end + math.prod(tail)
            self._places.append((slice(start, self.end) if tail else start, len(tail), tail))

    def views(self, table: np.ndarray) -> list[np.ndarray]:
        """The arrays in a table."""
        return [
            table[place]
            if not axes
            else table[place].T
            if axes == 1
            else np.moveaxis(table[place].reshape(*tail, -1), -1, 0)
            for place, axes, tail in self._places
        ]


class CompiledStep:
    """A task's step for N rows.

    All that a step gives stands in a table of its own (rows, N): a row per number of the snapshot
    (but its state), of the episodes and of the transition; the last row holds flags, a byte each.
    """

    def __init__(
        self,
        task: Task,
        clock: Clock,
        engine: Engine,
        rows: np.ndarray,
        inputs: tuple[np.ndarray, np.ndarray, np.ndarray],
        now: Snapshot,
        episode: Episode,
        loops: bool,
        estimate: Frame | None = None,
    ) -> None:
        """Trace and compile.

        Args:
            task: The task.
            clock: Of its episodes.
            engine: Of the aircraft.
            rows: Of parameters that the task sees, (N,) or (1,), read live.
            inputs: Buffers of the action (N, k), of the rotor command (N, R) and of whether an
                aircraft diverged (N,), read live.
            now: Any snapshot of the task, with those parameters.
            episode: Any of its episodes.
            loops: Whether the control mode reads the state in the middle of a step.
            estimate: Table of the state that is observed, read live; None for the true one.

        Raises:
            Exception: Of any kind: the functions of the task do more than arithmetic.
        """
        self._engine, self._rows, self._inputs = engine, rows, inputs
        self._estimate = estimate
        self._table = self._last = np.empty(0)
        self._tables: list[tuple[np.ndarray, int]] = []  # with their addresses
        self.observation: dict[str, np.ndarray] = {}
        """Of the last step."""
        self._parameters = now.parameters
        self._kinds = type(now.potentials), type(now.task)
        kept = _arrays(now, episode)
        if any(array.dtype != np.float64 for array in kept):
            raise TypeError("only float64 is compiled")
        self._kept = _Columns(0, kept)
        (trace, body), (again, other) = (self._traced(task, clock) for _ in range(2))
        if (body, trace.constants) != (other, again.constants):
            raise TypeError("the task gives something else each time")
        if loops and "last_state[" in body:
            raise TypeError("the loops read the state in between, into the same memory")
        self._load(trace, SOURCE.format(flags=self._flags, body=body))

    def _traced(self, task: Task, clock: Clock) -> tuple[Trace, str]:
        """The operations of a step, and the body of its loop."""
        trace, engine = Trace(), self._engine

        def read(place: str) -> Callable[[Array], Array]:
            text = np.frompyfunc(lambda number: place.format(int(number)), 1, 1)
            return lambda numbers: trace.inputs(text(numbers))

        # Arrays whose numbers say where they stand, made by what makes the views of real ones.
        places = np.arange(float(ROW_SIZE)).view(AIRCRAFT)
        rotors = self._inputs[1].shape[1]
        own = Parameters.of(places, clock.control_timestep, rotors)
        states = np.arange(engine.frames[0].table.shape[0])[:, None]
        state, last_state, estimate = (
            records.mapped(read(f"{name}[{{}} * columns + i]"), State.of_table(states))
            for name in ("state", "last_state", "estimate")
        )
        estimated = (estimate,) if self._estimate else ()
        kept = self._kept.views(np.arange(self._kept.end)[:, None])
        before, begun = self._records([read("was[{} * columns + i]")(places) for places in kept])
        before.state, before.parameters = last_state, own.map(read("p[i * stride + {}]"))
        action, command = (
            read(f"{name}[i * {buffer.shape[1]} + {{}}]")(np.arange(buffer.shape[1])[None])
            for name, buffer in zip(("action", "command"), self._inputs, strict=False)
        )
        diverged = trace.inputs(np.array(["diverged[i]"], object), is_flag=True)
        inputs = (state, action, command, diverged, *estimated)
        after, ended, done = finish(task, clock, begun, before, *inputs)
        self._observed, self._rewarded = list(done.observation), list(done.reward_terms)
        given = [*done.observation.values(), *done.reward_terms.values(), done.reward, done.error]
        given += done.truth.values() if estimated else ()
        self._given = _Columns(self._kept.end, given)
        size = sum(array.shape[-1] for array in done.observation.values())
        self._vectors = slice(self._kept.end, self._kept.end + size)
        self._flags = self._given.end
        outputs: dict[str, Any] = {}
        numbers = np.arange(self._flags)[:, None]
        for columns, arrays in ((self._kept, _arrays(after, ended)), (self._given, given)):
            for places, array in zip(columns.views(numbers), arrays, strict=True):
                values = np.broadcast_to(np.asarray(array, dtype=object), places.shape)
                for place, value in zip(places.ravel(), values.ravel(), strict=True):
                    outputs[f"out[{place} * columns + i]"] = value
        for k, name in enumerate(FLAGS):
            outputs[f"flags[{k} * columns + i]"] = np.asarray(getattr(done, name), dtype=object)[0]
        return trace, trace.body(outputs)

    def _load(self, trace: Trace, source: str) -> None:
        """Compile, and note the addresses that stay."""
        self._constants = np.array([*trace.constants, 0.0])
        self._step = native.compile_generated(source).step
        self._step.argtypes, self._step.restype = [ctypes.c_void_p, ctypes.c_int64], None
        rows = self._rows
        self._arguments = _Rows(
            self._constants.ctypes.data,
            rows.ctypes.data,
            *(buffer.ctypes.data for buffer in self._inputs),
            estimate=self._estimate.address if self._estimate else None,
            stride=rows.strides[0] // 8 if len(rows) > 1 else 0,
            columns=self._engine.frames[0].columns,
        )
        self._address = ctypes.addressof(self._arguments)

    def begin(self, now: Snapshot, episode: Episode) -> None:
        """Take up a snapshot of all rows."""
        self.observation = {}
        self._new_table()
        own = self._kept.views(self._table[:, : self._engine.num_envs])
        for into, array in zip(own, _arrays(now, episode), strict=True):
            into[:] = array

    def finish(self) -> Transition:
        """As `transition.finish`, from the last step's snapshot to the engine's state."""
        self._new_table()
        rows, (now, last), observed = self._arguments, self._engine.frames, self._observed
        rows.state, rows.last_state = now.address, last.address
        count, columns = self._engine.num_envs, rows.columns
        self._step(self._address, count)
        given = self._given.views(self._table[:, :count])
        flags = self._table[self._flags].view(np.bool_).reshape(-1, columns)
        self.observation = dict(zip(observed, given, strict=False))
        terms = dict(zip(self._rewarded, given[len(observed) :], strict=False))
        reward, error, *true = given[len(observed) + len(terms) :]
        return Transition(
            observation=self.observation,
            reward=reward,
            reward_terms=terms,
            terminated=flags[0, :count],
            truncated=flags[1, :count],
            is_success=flags[2, :count],
            diverged=flags[3, :count],
            error=error,
            truth=dict(zip(observed, true, strict=True)) if true else self.observation,
        )

    def flat(self) -> np.ndarray:
        """The terms of `observation` as vectors (N, size), float32."""
        table = self._table[self._vectors, : self._engine.num_envs]
        return table.T.astype(np.float32, order="C")

    def snapshot(self) -> tuple[Snapshot, Episode]:
        """The snapshot after the last step, and how far its episodes are; live."""
        table = self._table[:, : self._engine.num_envs]
        now, episode = self._records(self._kept.views(table))
        now.state, now.parameters = self._engine.state, self._parameters
        return now, episode

    def _new_table(self) -> None:
        """Write to another table, and read the one of the step before."""
        # One that nobody holds an array of any more: fresh memory costs as much as the step.
        free = (each for each in self._tables if sys.getrefcount(each[0]) == FREE)
        found = next(free, None)
        if found is None:
            table = np.empty((self._flags + 1, self._arguments.columns))
            found = table, native.address(table)
            self._tables = [*self._tables[1 - SPARE :], found]
        self._last, self._table = self._table, found[0]  # both are held
        self._arguments.was, self._arguments.out = self._arguments.out, found[1]

    def _records(self, arrays: list[Any]) -> tuple[Snapshot, Episode]:
        """What `_arrays` took apart, without state and parameters."""
        parts = iter(arrays)
        potentials, task_state = (
            kind(*itertools.islice(parts, len(_names(kind)))) for kind in self._kinds
        )
        moment = itertools.islice(parts, len(MOMENT))
        now = Snapshot(None, task_state, None, *moment, potentials)  # type: ignore[arg-type]
        return now, Episode(*parts)


def _arrays(now: Snapshot, episode: Episode) -> list[Array]:
    """The arrays of a snapshot (but its state and its parameters) and of its episodes."""
    moment = [getattr(now, name) for name in MOMENT]
    return [*_values(now.potentials), *_values(now.task), *moment, *_values(episode)]


def _values(record: Any) -> list[Array]:
    return [getattr(record, name) for name in _names(type(record))]


@functools.cache
def _names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))
