"""The engines: MuJoCo with rotor callbacks, alone or with free flight away from obstacles."""

from __future__ import annotations

import ctypes
import os
import weakref
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from quadrl.aircraft import parameters
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base import validation
from quadrl.base.errors import QuadrlError
from quadrl.engines import mjcf, native
from quadrl.engines.engine import ENGINES, Engine, EngineName
from quadrl.engines.free_flight import FIELDS
from quadrl.engines.mjcf import CONTACT_STEPS

MAX_ENVS = 1 << 20
MAX_THREADS = 1024
_BATCHES: weakref.WeakSet[BatchEngine] = weakref.WeakSet()


def _after_fork() -> None:
    """In a forked process, mark the engines, whose threads do not exist there."""
    for engine in list(_BATCHES):
        engine.forked = True
        # Never freed in this process, since that would also wait for the threads.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(engine.batch))
    _BATCHES.clear()


os.register_at_fork(after_in_child=_after_fork)


class BatchEngine(Engine):
    """N aircraft on all cores with MuJoCo's native batch."""

    def __init__(
        self,
        vehicle: Vehicle,
        num_envs: int,
        *,
        altitude: float,
        model: mujoco.MjModel | None = None,
        num_threads: int = 0,
        engine: EngineName = "mujoco",
        per_row: bool = False,
    ) -> None:
        """Make the batch.

        Args:
            vehicle: The aircraft.
            num_envs: N, at least 1.
            altitude: Height of the origin of the task's frame above the ground [m].
            model: The lean model of the aircraft in its world; None for a world without contacts.
            num_threads: Number of threads; 0 for every core.
            engine: One of ENGINES.
            per_row: Whether each aircraft has parameters of its own.
        """
        self.model = mjcf.compile_model(vehicle, drawn=False) if model is None else model
        self.batch = Batch(self.model, num_envs, nthread=num_threads)
        self.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._fresh = self.batch.state[0].copy()
        self._per_row = per_row
        _BATCHES.add(self)
        fields = {name: self.batch.bind(name) for name in FIELDS}
        super().__init__(vehicle, fields, altitude, engine, self.batch.nthread)

    def _model_field(self, name: str) -> np.ndarray:
        own = self._per_row or name.startswith("geom_")  # solids stand elsewhere in each row
        return self.batch.expand(name) if own else getattr(self.model, name)[None]

    def advance(self, steps: int) -> None:
        """Fly some physics steps of every aircraft with the commands in `ctrl`.

        Raises:
            NativeError: The rotor callbacks were removed.
            QuadrlError: The engine was made before this process was forked.
        """
        if self.forked:
            raise QuadrlError(
                "the engine was made before this process was forked, and its threads are not here: "
                "make it in this process, or start processes by spawn"
            )
        near = None
        if self._free_flight and (near := self._free_flight.advance(steps)) is None:
            return
        self.touch(near, steps)

    def touch(self, rows: np.ndarray | None, steps: int) -> None:
        """Let MuJoCo fly some physics steps of aircraft (n,) that may touch something, or of all.

        Raises:
            NativeError: The rotor callbacks were removed.
        """
        native.check_installed()
        for count in self.contact_steps(steps, rows):
            self.batch.step(rows, nstep=count)

    def clear(self, rows: np.ndarray) -> None:
        """Reset MuJoCo's warm starts and warnings of some aircraft."""
        # As Batch.reset does, in a tenth of its time: a row is all that it keeps of an aircraft.
        self.batch.state[rows] = self._fresh
        self.batch.warning[rows] = 0

    def save(self) -> dict[str, np.ndarray]:
        """Everything that the next step depends on, as arrays."""
        return self._saved(self.batch.state.copy())

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Restore a state that `save` gave."""
        self.batch.state[:] = saved["rows"]
        self._restore_state(saved)


class DataEngine(Engine):
    """One aircraft in an MjData, which `mj_step` or the owner of the data steps."""

    def __init__(
        self,
        vehicle: Vehicle,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        *,
        altitude: float,
        engine: EngineName = "mujoco",
    ) -> None:
        """Wrap a model of the vehicle and its data.

        Raises:
            QuadrlError: The model is not one that `quadrl.engines.mjcf` makes, or could make.
        """
        _check_model(model, vehicle)
        self.model, self.data = model, data
        fields = {name: getattr(data, name)[None] for name in FIELDS}
        super().__init__(vehicle, fields, altitude, engine, 1)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle and copy as an engine over the copied data, which the data's owner shares."""
        return _over, (self.vehicle, self.data, self.origin[2], self.name)

    def _model_field(self, name: str) -> np.ndarray:
        return getattr(self.model, name)[None]

    def advance(self, steps: int) -> None:
        """Fly some physics steps with the commands in `ctrl`.

        Raises:
            NativeError: The rotor callbacks were removed.
        """
        if not self.fly(steps):
            self.touch(None, steps)

    def touch(self, rows: np.ndarray | None, steps: int) -> None:
        """Let MuJoCo fly some physics steps.

        Raises:
            NativeError: The rotor callbacks were removed.
        """
        native.check_installed()
        for count in self.contact_steps(steps):
            mujoco.mj_step(self.model, self.data, count)

    def passed(self, steps: int) -> None:
        """Count physics steps that were not flown by MuJoCo."""
        self.data.time += steps * self.vehicle.physics_timestep

    def fly(self, steps: int) -> bool:
        """Advance in free flight if possible, and return whether it was.

        It is possible if that is the engine and the aircraft cannot touch anything.
        """
        if self._free_flight is None or self._free_flight.advance(steps) is not None:
            return False
        self.passed(steps)
        return True

    def clear(self, rows: np.ndarray) -> None:
        """Reset the data, with warm start, warnings and time."""
        mujoco.mj_resetData(self.model, self.data)

    def save(self) -> dict[str, np.ndarray]:
        """Everything that the next step depends on, as arrays."""
        spec = mujoco.mjtState.mjSTATE_INTEGRATION
        row = np.empty(mujoco.mj_stateSize(self.model, spec))
        mujoco.mj_getState(self.model, self.data, row, spec)
        return self._saved(row[None])

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Restore a state that `save` gave."""
        spec = mujoco.mjtState.mjSTATE_INTEGRATION
        mujoco.mj_setState(self.model, self.data, saved["rows"][0], spec)
        self._restore_state(saved)
        # Derived quantities are those of the new state; the warm start is the saved one.
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, saved["rows"][0], spec)


def _over(vehicle: Vehicle, data: mujoco.MjData, altitude: float, engine: EngineName) -> DataEngine:
    return DataEngine(vehicle, data.model, data, altitude=altitude, engine=engine)


def make(
    name: str,
    vehicle: Vehicle,
    model: mujoco.MjModel,
    num_envs: int = 1,
    *,
    altitude: float,
    num_threads: int = 0,
    per_row: bool = False,
) -> Engine:
    """Make the engine of a name for N aircraft in a world; arguments as for `BatchEngine`.

    Raises:
        QuadrlError: Unknown name or impossible count.
    """
    validation.choice("engine", name, ENGINES)
    validation.number("num_envs", num_envs, 1, MAX_ENVS, whole=True)
    validation.number("num_threads", num_threads, 0, MAX_THREADS, whole=True)
    world: Any = {"altitude": altitude, "engine": name}
    if num_envs > 1:
        world |= {"model": model, "num_threads": num_threads}
        return BatchEngine(vehicle, num_envs, per_row=per_row, **world)
    # One alone needs no pool of threads.
    return DataEngine(vehicle, model, mujoco.MjData(model), **world)


def _check_model(model: mujoco.MjModel, vehicle: Vehicle) -> None:
    """Refuse a model with other coordinates than the aircraft's, or one that would fly wrongly."""
    count = vehicle.rotor_count
    sizes = (model.nq, model.nv, model.na, model.nu) == (7, 6, count, count)
    row: Any = model.body_user[1] if model.nbody > 1 and model.nuser_body else [0.0]
    marked = model.nuser_body == parameters.ROW_SIZE and row[0] == parameters.MARK
    marked = marked and row.view(parameters.AIRCRAFT)["rotor_count"][0] == count
    rotors = sizes and (model.actuator_dynprm[:, native.MARK_SLOT] == parameters.MARK).all()
    finer, air = vehicle.physics_timestep / model.opt.timestep, parameters.AIR
    for right, what in (
        (sizes, f"7 positions, 6 velocities, {count} rotors, and nothing else that moves"),
        (marked and rotors, "the parameters of an aircraft: begin with quadrl.engines.mjcf.spec"),
        (model.nuserdata >= air, f"nuserdata of at least {air}, for the air"),
        (finer in (1, CONTACT_STEPS), f"the vehicle's step, {vehicle.physics_timestep} s"),
    ):
        if not right:
            raise QuadrlError(f"a model to fly needs {what}")
