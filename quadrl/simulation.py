"""Aircraft advanced together: the engines behind one interface.

A simulation has a leading shape, () for one aircraft or (N,) for a batch, and a State of that
shape. It takes rotor commands, advances some physics steps, and says which aircraft diverged. The
engine is MuJoCo; with "flight" the aircraft that can touch nothing are flown by `quadrl.flight`.
"""

from __future__ import annotations

import abc
from typing import Any, Literal

import mujoco
import numpy as np
from mujoco.batch import Batch

from quadrl import native
from quadrl.flight import FIELDS, EngineError, Flight
from quadrl.rotation import norm
from quadrl.state import ROWS, TABLE_ROWS, Start, State
from quadrl.task import TaskError
from quadrl.vehicle import MARK, MARK_SLOT, ROTORS, Vehicle

COORDINATES = ("position", "quaternion", "velocity", "body_rate", "rotor_speed")
Engine = Literal["mujoco", "flight"]
ENGINES: tuple[Engine, ...] = ("mujoco", "flight")
Rows = np.ndarray | None
"""Numbers (n,) of aircraft in a batch; None for all of them, or for the one."""


class Simulation(abc.ABC):
    """Common part: the table of the state, filled from rows of generalised coordinates."""

    def __init__(self, vehicle: Vehicle, shape: tuple[int, ...], altitude: float) -> None:
        """Set up the tables.

        Args:
            vehicle: The aircraft.
            shape: () or (N,).
            altitude: Height of the origin of the task's frame above the ground [m].
        """
        self.vehicle = vehicle
        self.shape = shape
        self.origin = np.array([0.0, 0.0, altitude])  # (3,) [m], world
        # Two frames in turn: the last state stays whole while the next one is computed.
        self._frames = [_Frame(shape) for _ in range(2)]
        self._kernel = native.library().quadrl_state
        self._count = shape[0] if shape else 1
        self._bind()
        # Addresses never change, and looking them up costs a single environment more than the rest.
        self._coordinates = (
            *(array.ctypes.data for array in (self.qpos, self.qvel, self.act)),
            self.qpos.strides[0] // 8 if shape else 0,
            self.origin.ctypes.data,
            vehicle.resolved_speed,
            vehicle.resolved_spin,
        )

    @property
    def state(self) -> State:
        """The current state (live views)."""
        return self._frames[0].state

    @abc.abstractmethod
    def _bind(self) -> None:
        """Set self.qpos (..., 7), qvel (..., 6), act (..., 4), ctrl (..., 4): live views."""

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray

    @property
    @abc.abstractmethod
    def wind(self) -> np.ndarray:
        """Velocity of the air (..., 3) [m/s], world frame; live, zero unless it is written."""

    @abc.abstractmethod
    def advance(self, steps: int | None = None) -> None:
        """Some physics steps with the commands in `ctrl`; None for those of a control step."""

    @abc.abstractmethod
    def clear(self, rows: Rows) -> None:
        """Reset the engine's own memory of some aircraft (warm starts, warnings)."""

    def read(self) -> np.ndarray | None:
        """Compute the state after `advance`.

        Returns:
            None when all went well; else which aircraft diverged (shape of the simulation, bool):
            a number that is not finite or that MuJoCo calls unstable, or faster than the physics
            step resolves (`Vehicle.resolved_speed`, `resolved_spin`). Those keep their last good
            state.
        """
        self._frames.reverse()
        if not self._fill(None):
            return None
        table, last = (frame.table for frame in self._frames)
        sound = (np.abs(table[: ROWS["time"]]) < mujoco.mjMAXVAL).all(axis=0)
        sound &= table[ROWS["speed"]] <= self.vehicle.resolved_speed
        broken = ~(sound & (table[ROWS["spin"]] <= self.vehicle.resolved_spin))
        if self.shape:
            rows = np.flatnonzero(broken)
            table[:, rows] = last[:, rows]
            self.clear(rows)
            self._write(rows, State.of_table(table[:, rows]))
        else:
            table[:] = last
            self.clear(None)
            self._write(None, self.state)
        return broken

    def place(self, rows: Rows, start: Start) -> State:
        """Put aircraft where an episode begins.

        Args:
            rows: Which aircraft.
            start: Arrays (n, k), or (k,) for a single one.

        Returns:
            The state of those aircraft.

        Raises:
            TaskError: The start is what `read` calls diverged.
        """
        self.clear(rows)
        self._write(rows, start)
        if self._fill(rows):
            raise TaskError(self._complaint(start))
        if rows is None:
            self._frames[0].table[ROWS["time"]] = 0.0
            return self.state
        self._frames[0].table[ROWS["time"], rows] = 0.0
        return State.of_table(self._frames[0].table[:, rows])

    def _complaint(self, start: Start) -> str:
        """What is wrong with a start."""
        step = f"; a shorter physics_step than {self.vehicle.physics_step} s resolves more"
        fastest = {
            "velocity": (self.vehicle.resolved_speed, step),
            "body_rate": (self.vehicle.resolved_spin, step),
        }
        for name, part in vars(start).items():
            limit, advice = fastest.get(name, (np.inf, ""))
            if not ((np.abs(part) < mujoco.mjMAXVAL).all() and (norm(part) <= limit).all()):
                break
        else:  # with the height of the origin added
            name, limit, advice = "position", np.inf, ""
        return (
            f"the task's sample gives {name} that is not finite, or larger than "
            f"{min(limit, mujoco.mjMAXVAL):g}{advice}"
        )

    def save(self) -> dict[str, np.ndarray]:
        """Everything that the next step depends on, as arrays."""
        return {"table": self._frames[0].table.copy(), **self._save()}

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Take up what `save` gave."""
        self._frames[0].table[:] = saved["table"]
        self._restore(saved)

    @abc.abstractmethod
    def _save(self) -> dict[str, np.ndarray]: ...

    @abc.abstractmethod
    def _restore(self, saved: dict[str, np.ndarray]) -> None: ...

    def _write(self, rows: Rows, start: Start | State) -> None:
        index: Any = ... if rows is None else rows
        self.qpos[index] = np.concatenate([start.position + self.origin, start.quaternion], axis=-1)
        self.qvel[index] = np.concatenate([start.velocity, start.body_rate], axis=-1)
        self.act[index] = start.rotor_speed

    def _fill(self, rows: Rows) -> int:
        """Run the C kernel; how many aircraft hold numbers that are not finite or too large."""
        count, address = (self._count, None) if rows is None else (len(rows), rows.ctypes.data)
        frame = self._frames[0]
        return self._kernel(count, address, *self._coordinates, frame.address, frame.columns)


class _Frame:
    """One table of state with its named views and its address."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        count = shape[0] if shape else 1
        # A cache line more than a round number of them: rows a power of two apart evict each other.
        self.columns = count + 8 * (1 + count // 8 % 2) if shape else 1
        whole = np.zeros((TABLE_ROWS, self.columns))
        self.table = whole[:, :count] if shape else whole[:, 0]
        self.state = State.of_table(self.table)
        self.address = self.table.ctypes.data


class BatchSimulation(Simulation):
    """N aircraft on all cores with MuJoCo's native batch."""

    def __init__(
        self,
        vehicle: Vehicle,
        num_envs: int,
        *,
        altitude: float,
        contact: bool = False,
        num_threads: int = 0,
        engine: Engine = "mujoco",
    ) -> None:
        """Compile the lean model and make the batch.

        Args:
            vehicle: The aircraft.
            num_envs: N, at least 1.
            altitude: Height of the origin of the task's frame above the ground [m].
            contact: Whether the aircraft can touch the ground.
            num_threads: Threads to step on; 0 for every core.
            engine: One of ENGINES.
        """
        self.model = vehicle.compile_lean(contact=contact)
        self.batch = Batch(self.model, num_envs, nthread=num_threads)
        super().__init__(vehicle, (num_envs,), altitude)
        self._flight: Flight | None = None
        if engine == "flight":
            fields = {name: self.batch.bind(name) for name in FIELDS}
            self._flight = Flight(self.model, fields, self.batch.nthread)

    def _bind(self) -> None:
        self.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._fresh = self.batch.state[0].copy()
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.act, self.ctrl = self.batch.bind("act"), self.batch.bind("ctrl")

    @property
    def wind(self) -> np.ndarray:
        """Velocity of the air (N, 3) [m/s], world frame; live, zero unless it is written."""
        wind = self.batch.expand("opt.wind")
        if self._flight:
            self._flight.wind = wind
        return wind

    def advance(self, steps: int | None = None) -> None:
        """Some physics steps of every aircraft; None for those of a control step.

        Raises:
            NativeError: The rotor callbacks were taken away.
        """
        steps = steps or self.vehicle.substeps
        near = None
        if self._flight and (near := self._flight.advance(steps)) is None:
            return
        native.check_installed()
        self.batch.step(near, nstep=steps)

    def clear(self, rows: Rows) -> None:
        """Reset the warm starts and the warnings of some aircraft."""
        # What Batch.reset does, in a tenth of its time: a row is all that it keeps of an aircraft.
        self.batch.state[rows] = self._fresh
        self.batch.warning[rows] = 0

    def _save(self) -> dict[str, np.ndarray]:
        return {"rows": self.batch.state.copy()}

    def _restore(self, saved: dict[str, np.ndarray]) -> None:
        self.batch.state[:] = saved["rows"]


class SingleSimulation(Simulation):
    """One aircraft in an MjData, stepped by `mj_step` or by whoever owns the data."""

    def __init__(
        self,
        vehicle: Vehicle,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        *,
        altitude: float,
        engine: Engine = "mujoco",
    ) -> None:
        """Wrap a model of the vehicle and its data.

        Raises:
            EngineError: The model is not one that `Vehicle.compile` makes, or could make.
        """
        _check_model(model, vehicle)
        self.model, self.data = model, data
        super().__init__(vehicle, (), altitude)
        self._flight: Flight | None = None
        if engine == "flight":
            fields = {name: getattr(data, name) for name in FIELDS if name != "time"}
            self._flight = Flight(model, fields, 1)
            self._flight.wind = model.opt.wind

    def _bind(self) -> None:
        data = self.data
        self.qpos, self.qvel, self.act, self.ctrl = data.qpos, data.qvel, data.act, data.ctrl

    @property
    def wind(self) -> np.ndarray:
        """Velocity of the air (3,) [m/s], world frame; live, zero unless it is written."""
        return self.model.opt.wind

    def advance(self, steps: int | None = None) -> None:
        """Some physics steps; None for those of a control step.

        Raises:
            NativeError: The rotor callbacks were taken away.
        """
        steps = steps or self.vehicle.substeps
        if not self.fly(steps):
            native.check_installed()
            mujoco.mj_step(self.model, self.data, steps)

    def fly(self, steps: int) -> bool:
        """Advance in free flight, if that is the engine and there is nothing to touch; whether."""
        if self._flight is None or self._flight.advance(steps) is not None:
            return False
        self.data.time += steps * self.model.opt.timestep
        return True

    def clear(self, rows: Rows) -> None:
        """Reset the data: warm start, warnings, time."""
        mujoco.mj_resetData(self.model, self.data)

    def _save(self) -> dict[str, np.ndarray]:
        spec = mujoco.mjtState.mjSTATE_INTEGRATION
        row = np.empty(mujoco.mj_stateSize(self.model, spec))
        mujoco.mj_getState(self.model, self.data, row, spec)
        return {"rows": row}

    def _restore(self, saved: dict[str, np.ndarray]) -> None:
        spec = mujoco.mjtState.mjSTATE_INTEGRATION
        mujoco.mj_setState(self.model, self.data, saved["rows"], spec)


def _check_model(model: mujoco.MjModel, vehicle: Vehicle) -> None:
    """Refuse a model whose coordinates are not the aircraft's alone, or that would fly wrongly."""
    sizes = (model.nq, model.nv, model.na, model.nu) == (7, 6, ROTORS, ROTORS)
    marked = model.nuser_body >= 3 and model.nbody > 1 and (model.body_user[:, 0] == MARK).any()
    rotors = sizes and (model.actuator_dynprm[:, MARK_SLOT] == MARK).all()
    step = model.opt.timestep
    for right, what in (
        (sizes, "7 positions, 6 velocities and four rotors, and nothing else that moves"),
        (marked and rotors, "the parameters of an aircraft: begin with Vehicle.spec"),
        (
            step == vehicle.physics_step,
            f"the vehicle's step, {vehicle.physics_step} s (not {step})",
        ),
    ):
        if not right:
            raise EngineError(f"a model to fly needs {what}")
