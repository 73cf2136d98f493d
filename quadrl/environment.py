"""The core of every door: a task and a simulation make transitions.

One environment flies one aircraft (`num_envs=None`, arrays without a leading axis) or a batch.
It keeps the clock, the generators and the episode's fields; it resets what it is told to and
never by itself. Aircraft i of a batch seeded with s is the single environment seeded with s + i.
"""

from __future__ import annotations

import dataclasses
import math
import reprlib
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from quadrl import interfaces, tasks
from quadrl.errors import QuadrlError
from quadrl.rotation import Array
from quadrl.simulation import (
    ENGINES,
    BatchSimulation,
    Engine,
    Rows,
    Simulation,
    SingleSimulation,
)
from quadrl.state import Start, State
from quadrl.task import (
    EPISODE_DRAWS,
    Draw,
    Errors,
    Fields,
    Marker,
    Measures,
    OptionError,
    Outcome,
    Task,
    TaskError,
    check_choices,
    total,
)
from quadrl.vehicle import ROTORS, Vehicle, resolve

Observation = dict[str, Array]
MAX_ENVS = 1 << 20
MAX_THREADS = 1024


class ActionError(QuadrlError, ValueError):
    """An action of the wrong shape or kind, or with a number that is not finite."""


@dataclasses.dataclass(slots=True)
class Transition:
    """What one control step gave; arrays (...) of the environment's shape, one row an aircraft.

    The parts of the observation are live views: copy them before the next step or reset.
    """

    observation: Observation
    """Named parts (..., k) in the task's order."""
    reward: Array
    """The sum of the terms."""
    reward_terms: dict[str, Array]
    """Named terms of the reward."""
    terminated: Array
    """bool: over by failure, or by success where the task says so."""
    truncated: Array
    """bool: over by the clock; never together with terminated."""
    is_success: Array
    """bool: over, and what was asked is done."""
    diverged: Array
    """bool: the simulation broke down, or flew faster than its step resolves; the state is the last
    good one, and terminated is set."""
    error: Array
    """The task's error [m]."""


class Environment:
    """A task flown by a vehicle in a simulation."""

    def __init__(
        self,
        task: str | Task,
        *,
        num_envs: int | None = None,
        seed: int | None = None,
        vehicle: Vehicle | None = None,
        num_threads: int = 0,
        engine: Engine = "mujoco",
        simulation: Simulation | None = None,
        action: str = "rotor",
    ) -> None:
        """Make the simulation and seed the generators.

        Args:
            task: A name of the catalogue or a task.
            num_envs: Number of aircraft N; None for one without a leading axis.
            seed: Aircraft i is seeded with seed + i; None draws one from the system.
            vehicle: The aircraft; None for the paper's.
            num_threads: Threads of a batch; 0 for every core.
            engine: "mujoco", or "flight": free flight wherever there is nothing to touch.
            simulation: Use this one instead of making one (then N is its own).
            action: What actions mean, a name of `interfaces.INTERFACES`.

        Raises:
            ValueError: Unknown task or interface, or a number of aircraft that cannot be.
            NativeError: The rotor callbacks cannot be built or installed.
        """
        self.task = tasks.make(task)
        self.vehicle = simulation.vehicle if simulation and vehicle is None else resolve(vehicle)
        if simulation is None:
            check_choices([engine], ENGINES, "engine")
            simulation = _simulation(self.task, self.vehicle, num_envs, num_threads, engine)
        self.simulation = simulation
        self.shape = simulation.shape
        self.interface = interfaces.make(action, self.vehicle)
        self._action_shape = (*self.shape, self.interface.size)
        self.num_envs = self.shape[0] if self.shape else 1
        self.horizon_steps = max(1, round(self.task.horizon / self.vehicle.control_step))
        settle_steps = round(self.task.settle / self.vehicle.control_step)
        self._settle_steps = min(max(1, settle_steps), self.horizon_steps)
        self.layout: dict[str, slice] = {}
        """Where each named part of the observation stands in the flat vector."""
        self.size = 0
        for name, part in self.task.observation.items():
            self.layout[name] = slice(self.size, self.size + part.size)
            self.size += part.size
        self.generators: list[np.random.Generator] = []
        self.seed(seed)
        self._steps: Any = None
        self.fields: Fields
        self._measures: Measures
        self._command: np.ndarray
        self._setpoint: np.ndarray
        self._flown = 0  # physics steps of this control step that the interface's loops have flown
        self._diverged: np.ndarray | None = None  # in them

    def seed(self, seed: int | None = None) -> int:
        """Give every aircraft a new generator; returns the seed of the first.

        Raises:
            OptionError: The seed is no whole number, or a negative one.
        """
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        check_seed(seed)
        self.generators = [np.random.default_rng(seed + i) for i in range(self.num_envs)]
        return seed

    def reset(self, rows: Rows = None) -> Observation:
        """Begin an episode.

        Args:
            rows: Numbers (n,) or mask (N,) of the aircraft that begin one; None for all.

        Returns:
            The observation of those aircraft, parts (n, k), or (k,) for a single one.

        Raises:
            OptionError: A number of an aircraft that is not there, or one twice.
            TaskError: The task gives arrays of the wrong shape, or a start that no aircraft can
                have.
        """
        rows = None if rows is None else self._checked(rows)
        if self._steps is None and rows is not None and len(rows) < self.num_envs:
            raise RuntimeError("the first reset must be of every aircraft")
        everyone = rows is None or len(rows) == self.num_envs
        if self.shape and rows is None:
            rows = np.arange(self.num_envs)
        start, fields = self.task.sample(Draw(self._draw_block(rows)), self.vehicle)
        self._check_start(start, () if rows is None else (len(rows),))
        state = self.simulation.place(rows, start)
        measures = self.task.measure(state, fields)
        if self._steps is None:
            self._check_task(start, state, measures, fields)
        observation = self.task.observe(state, measures, fields, self.vehicle)
        if everyone or rows is None:
            self.fields, self._measures = fields, measures
            # For one aircraft a number of Python's own: cheaper than an array without axes.
            self._steps = np.zeros(self.shape, dtype=np.int64) if self.shape else 0
            self._error_sum, self._final_sum = np.zeros(self.shape), np.zeros(self.shape)
        else:
            _put(self.fields, rows, fields)
            _put(self._measures, rows, measures)
            steps: Any = self._steps
            steps[rows] = 0
            self._error_sum[rows] = self._final_sum[rows] = 0.0
        return observation

    def step(self, action: Array) -> Transition:
        """Fly one control step.

        Args:
            action: (..., 4), what it means is the interface's; clipped to [-1, 1].

        Returns:
            The transition. An aircraft whose episode is over flies on until it is reset.

        Raises:
            ActionError: Wrong shape or kind, or a number that is not finite.
            TaskError: The task gave a reward that is not finite.
            RuntimeError: There was no reset before.
        """
        self.begin(action)
        if self.interface.has_loops:
            for _ in range(self.vehicle.substeps):
                self.control()
                self.simulation.advance(1)
        else:
            self.simulation.advance()
        return self.finish()

    def begin(self, action: Array) -> None:
        """First half of a step: the commands to the rotors, or the setpoint of the loops."""
        if self._steps is None:
            raise RuntimeError("call reset before the first step")
        action = _as_numbers(action)
        if action.shape != self._action_shape:
            raise ActionError(
                f"an action of shape {action.shape} was given; {self._action_shape} is expected"
            )
        if self.shape:
            sound = np.isfinite(action).all()
        else:
            sound = all(map(math.isfinite, action.tolist()))
        if not sound:
            where = np.argwhere(~np.isfinite(action))[0]
            raise ActionError(
                f"action{where.tolist()} is {action[tuple(where)]}: every number must be finite"
            )
        if self.interface.has_loops:
            self._setpoint = self.interface.setpoint(self.simulation.state, action)
            self._command = np.zeros_like(self.simulation.ctrl)
            self._flown, self._diverged = 0, None
            return
        self._command = self.vehicle.rotor_command(action)
        self.simulation.ctrl[...] = self._command

    def control(self) -> None:
        """Before each physics step of an interface with loops: the commands to the rotors.

        The reward sees their mean over the control step.
        """
        if self._flown and (diverged := self.simulation.read()) is not None:
            self._diverged = diverged if self._diverged is None else self._diverged | diverged
        command = self.interface.rotor_command(self.simulation.state, self._setpoint)
        self.simulation.ctrl[...] = command
        self._command += command / self.vehicle.substeps
        self._flown += 1

    def finish(self) -> Transition:
        """Second half of a step, after the simulation has advanced."""
        task, vehicle = self.task, self.vehicle
        diverged = self.simulation.read()
        if self._diverged is not None:
            diverged = self._diverged if diverged is None else self._diverged | diverged
        self._steps = self._steps + 1
        state = self.simulation.state
        state.time[...] = self._steps * vehicle.control_step
        measures = task.measure(state, self.fields)
        terminated = task.terminated(state, measures, self.fields, vehicle)
        if diverged is None:
            diverged = np.zeros(self.shape, dtype=bool) if self.shape else np.False_
        else:
            terminated = terminated | diverged
        late = self._steps >= self.horizon_steps
        truncated = late & ~terminated if self.shape else np.bool_(late and not terminated)
        error = task.error(state, measures, self.fields)
        is_success = self._judge(state, error, terminated, truncated) & ~diverged
        outcome = Outcome(failed=terminated & ~is_success, succeeded=is_success)
        terms = task.reward(self._measures, measures, self._command, outcome, vehicle)
        fields = task.update(state, measures, self.fields, vehicle)
        if fields is not self.fields:
            self.fields, measures = fields, task.measure(state, fields)
        self._measures = measures
        reward, observation = total(terms), task.observe(state, measures, fields, vehicle)
        # One number that is not finite makes the sum so: cheaper than a test of each.
        if not math.isfinite(np.add.reduce(reward) if self.shape else reward):
            row = np.flatnonzero(~np.isfinite(np.ravel(reward)))[:1]
            values = {k: float(np.ravel(term)[row][0]) for k, term in terms.items()}
            raise TaskError(
                f"{task.name}: the reward of aircraft {row[0]} is not finite; its terms are "
                f"{values}"
            )
        return Transition(
            observation=observation,
            reward=reward,
            reward_terms=terms,
            terminated=terminated,
            truncated=truncated,
            is_success=is_success,
            diverged=diverged,
            error=error,
        )

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names of the reward's terms, in their order."""
        return self.task.term_names(self.vehicle)

    def flatten(self, observation: Observation, out: np.ndarray | None = None) -> np.ndarray:
        """The parts of an observation as one vector (..., size), float32 unless `out` is given."""
        parts = list(observation.values())
        if not self.shape:
            return np.concatenate(parts, out=out, dtype=None if out is not None else np.float32)
        if out is None:
            out = np.empty((len(parts[0]), self.size), dtype=np.float32)
        for part, columns in zip(parts, self.layout.values(), strict=True):
            out[:, columns] = part
        return out

    def markers(self, row: int = 0) -> tuple[Marker, ...]:
        """What the task asks to be drawn of one aircraft's episode, world frame."""
        fields = self.fields
        if self.shape:
            values = {f.name: getattr(fields, f.name)[row] for f in _fields(fields)}
            fields = type(fields)(**values)
        return tuple(m.moved(self.simulation.origin) for m in self.task.markers(fields))

    def save(self) -> dict[str, np.ndarray]:
        """Everything that the next steps depend on, as arrays: `restore` continues bit for bit."""
        saved = {f"simulation.{k}": v for k, v in self.simulation.save().items()}
        saved |= {"steps": self._steps, "error": self._error_sum, "final": self._final_sum}
        for name, record in (("fields", self.fields), ("measures", self._measures)):
            saved |= {f"{name}.{f.name}": getattr(record, f.name) for f in _fields(record)}
        saved["generators"] = np.array([_generator_words(g) for g in self.generators])
        return {name: np.array(value) for name, value in saved.items()}

    def restore(self, saved: dict[str, np.ndarray]) -> Observation:
        """Take up what `save` gave; returns the observation of that moment.

        Raises:
            OptionError: It is not of such an environment.
        """
        if self._steps is None:
            self.reset()  # makes the records, which are filled below
        for name, own in self.save().items():
            kept = saved.get(name)
            if kept is None or (kept.shape, kept.dtype) != (own.shape, own.dtype):
                found = "nothing" if kept is None else f"{kept.dtype} of shape {kept.shape}"
                raise OptionError(
                    f"what was saved is of another environment: {name} is {found}, and {own.dtype} "
                    f"of shape {own.shape} is expected"
                )
        prefix = "simulation."
        self.simulation.restore(
            {k.removeprefix(prefix): v for k, v in saved.items() if k.startswith(prefix)}
        )
        self._steps = saved["steps"].copy() if self.shape else int(saved["steps"])
        self._error_sum, self._final_sum = saved["error"].copy(), saved["final"].copy()
        for name in ("fields", "measures"):
            record = getattr(self, "fields" if name == "fields" else "_measures")
            values = {f.name: saved[f"{name}.{f.name}"].copy() for f in _fields(record)}
            setattr(self, "fields" if name == "fields" else "_measures", type(record)(**values))
        for generator, words in zip(self.generators, saved["generators"], strict=True):
            _set_generator_words(generator, words)
        state = self.simulation.state
        return self.task.observe(state, self._measures, self.fields, self.vehicle)

    def _judge(self, state: State, error: Array, terminated: Array, truncated: Array) -> Array:
        """Add up the errors, and decide on the episodes that end now."""
        self._error_sum = self._error_sum + error
        settling = self._steps > self.horizon_steps - self._settle_steps
        if settling is not False:
            self._final_sum = self._final_sum + error * settling
        over: Any = terminated | truncated
        if not (over.any() if self.shape else over):
            return over
        errors = Errors(
            final=self._final_sum / self._settle_steps, mean=self._error_sum / self._steps
        )
        return over & self.task.success(state, self.fields, errors, terminated, truncated)

    def _check_start(self, start: Start, shape: tuple[int, ...]) -> None:
        """Refuse a start of other shapes (NumPy would repeat it), or that no aircraft can have."""
        for name, columns in _START.items():
            value = np.asarray(getattr(start, name))
            if value.shape != (*shape, columns):
                raise TaskError(
                    f"{self.task.name}: sample gives {name} of shape {value.shape}, "
                    f"{(*shape, columns)} is expected"
                )
        length = np.square(start.quaternion).sum(-1)
        if not (np.abs(length - 1) < 1e-6).all():
            raise TaskError(
                f"{self.task.name}: sample gives a quaternion of length {np.max(length) ** 0.5:g}; "
                "1 is expected"
            )

    def _check_task(self, start: Start, state: State, measures: Measures, fields: Fields) -> None:
        """Refuse a task whose functions give other shapes or kinds of numbers than they should.

        Done once, at the first reset: they are pure, so a call more changes nothing.
        """
        task, vehicle = self.task, self.vehicle
        terminated = task.terminated(state, measures, fields, vehicle)
        self._check_array("terminated", terminated, self.shape, "b")
        error = task.error(state, measures, fields)
        self._check_array("error", error, self.shape, "fiu")
        errors = Errors(final=error, mean=error)
        success = task.success(state, fields, errors, terminated, np.logical_not(terminated))
        self._check_array("success", success, self.shape, "b")
        outcome = Outcome(failed=terminated, succeeded=success)
        terms = task.reward(measures, measures, start.rotor_speed, outcome, vehicle)
        for name, term in terms.items():
            self._check_array(f"the reward's term {name!r}", term, self.shape, "fiu")
        observation = task.observe(state, measures, fields, vehicle)
        if list(observation) != list(task.observation):
            raise TaskError(
                f"{task.name}: observe gives {', '.join(observation)}; declared are "
                f"{', '.join(task.observation)}, in this order"
            )
        for name, part in task.observation.items():
            self._check_array(f"part {name!r}", observation[name], (*self.shape, part.size), "fiu")

    def _check_array(self, what: str, value: Any, shape: tuple[int, ...], kinds: str) -> None:
        array = np.asarray(value)
        if array.shape != shape or array.dtype.kind not in kinds:
            raise TaskError(
                f"{self.task.name}: {what} has shape {array.shape} and dtype {array.dtype}; "
                f"{'bool' if kinds == 'b' else 'numbers'} of shape {shape} are expected"
            )

    def _checked(self, rows: np.ndarray) -> np.ndarray:
        """Numbers of aircraft, in order, from numbers or a mask."""
        given = np.asarray(rows)
        if given.dtype == bool and given.shape == self.shape:
            return np.flatnonzero(given)
        whole = given.ndim == 1 and (given.dtype.kind in "iu" or len(given) == 0)
        numbers = np.unique(given) if whole else np.zeros(0, dtype=np.int64)
        within = len(numbers) == 0 or (numbers[0] >= 0 and numbers[-1] < self.num_envs)
        if not self.shape or not whole or len(numbers) != len(given) or not within:
            raise OptionError(
                f"rows = {reprlib.repr(given.tolist())}: different numbers from 0 to "
                f"{self.num_envs - 1} are allowed, or a mask of shape {self.shape}"
            )
        return numbers.astype(np.int64)

    def _draw_block(self, rows: Rows) -> np.ndarray:
        if rows is None:
            return self.generators[0].random(EPISODE_DRAWS)
        block = np.empty((len(rows), EPISODE_DRAWS))
        for into, row in zip(block, rows, strict=True):
            self.generators[row].random(out=into)
        return block


def _simulation(
    task: Task, vehicle: Vehicle, num_envs: int | None, num_threads: int, engine: Engine
) -> Simulation:
    altitude = task.origin_height(vehicle)
    if num_envs is None:
        model = vehicle.compile_lean(contact=task.contact)
        data = mujoco.MjData(model)
        return SingleSimulation(vehicle, model, data, altitude=altitude, engine=engine)
    if not isinstance(num_envs, (int, np.integer)) or not 1 <= num_envs <= MAX_ENVS:
        raise OptionError(
            f"num_envs = {num_envs!r}: a whole number from 1 to {MAX_ENVS} is allowed"
        )
    if not isinstance(num_threads, (int, np.integer)) or not 0 <= num_threads <= MAX_THREADS:
        raise OptionError(
            f"num_threads = {num_threads!r}: a whole number from 0 to {MAX_THREADS} is allowed"
        )
    return BatchSimulation(
        vehicle,
        int(num_envs),
        altitude=altitude,
        contact=task.contact,
        num_threads=num_threads,
        engine=engine,
    )


def check_seed(seed: object) -> None:
    """Refuse what no generator can be seeded with.

    Raises:
        OptionError: It is no whole number, or a negative one.
    """
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise OptionError(f"seed = {seed!r}: a whole number from 0 on is allowed")


_START = {"position": 3, "quaternion": 4, "velocity": 3, "body_rate": 3, "rotor_speed": ROTORS}
"""What `Start` holds, and its numbers an aircraft."""


def _as_numbers(action: Any) -> np.ndarray:
    """An action in double precision; what NumPy would only convert with a loss is refused."""
    try:
        array = np.asarray(action)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ActionError(f"an action that is no array of numbers was given: {error}") from error
    if array.dtype.char not in "fd" and not np.can_cast(array.dtype, np.float64):
        raise ActionError(
            f"an action of dtype {array.dtype} was given; real numbers are expected, such as "
            "float32 or float64"
        )
    return array.astype(np.float64, copy=False)


def _fields(record: Any) -> Sequence[dataclasses.Field]:
    return dataclasses.fields(record)


def _put(record: Any, rows: Rows, new: Any) -> None:
    """Write rows of a record of arrays."""
    for field in _fields(record):
        getattr(record, field.name)[rows] = getattr(new, field.name)


def _generator_words(generator: np.random.Generator) -> list[np.uint64]:
    """The state of a PCG64 generator as six 64-bit words."""
    state: Any = generator.bit_generator.state
    mask = (1 << 64) - 1
    words = [
        w for n in (state["state"]["state"], state["state"]["inc"]) for w in (n >> 64, n & mask)
    ]
    return [np.uint64(w) for w in (*words, state["has_uint32"], state["uinteger"])]


def _set_generator_words(generator: np.random.Generator, words: np.ndarray) -> None:
    high, low, inc_high, inc_low, has, value = (int(w) for w in words)
    generator.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": high << 64 | low, "inc": inc_high << 64 | inc_low},
        "has_uint32": has,
        "uinteger": value,
    }
