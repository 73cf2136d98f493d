"""The second engine: free flight, integrated in C by the equations alone.

Away from everything that it could touch the aircraft is an ordinary differential equation.
`native/flight.c` integrates it by the Runge-Kutta method on the rows that MuJoCo itself steps, so
an aircraft passes from one engine to the other with every bit of its state. The parameters are
those of the compiled model, and the rotor equations are the callbacks' own (`native/equations.h`).
"""

from __future__ import annotations

import math
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial

import mujoco
import numpy as np

from quadrl import native
from quadrl.errors import QuadrlError
from quadrl.vehicle import ROTORS

FIELDS = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart")
"""Those of mjData that free flight reads or writes."""
ROWS_A_THREAD = 256
"""Aircraft that are worth a thread."""
MARGIN = 0.05
"""Clearance at which MuJoCo takes over [m]; more than what a contact's own margin is."""


class EngineError(QuadrlError, ValueError):
    """An engine that is not there, or a model that it cannot fly."""


class Flight:
    """Advances the rows of a simulation in place."""

    def __init__(self, model: mujoco.MjModel, fields: dict[str, np.ndarray], threads: int) -> None:
        """Read the parameters.

        Args:
            model: A model of `Vehicle.compile` or `compile_lean`.
            fields: Live arrays (N, k), or (k,) for one aircraft, of FIELDS; all with one stride
                between aircraft.
            threads: Threads to fly on.

        Raises:
            EngineError: The model holds something that free flight knows nothing of.
        """
        self._aircraft = parameters(model)
        self._kernel = native.library().quadrl_flight
        qpos = fields["qpos"]
        count, self._stride = (len(qpos), qpos.strides[0] // 8) if qpos.ndim > 1 else (1, 0)
        self._fields = fields  # kept alive: the kernel knows their addresses
        self._addresses = [fields[name].ctypes.data for name in FIELDS]
        self._near = np.zeros(count, dtype=np.int8)
        self.wind = np.zeros(3)
        parts = max(1, min(threads, count // ROWS_A_THREAD))
        ends = [count * k // parts for k in range(parts + 1)]
        self._parts = list(zip(ends, ends[1:], strict=False))
        self._pool = ThreadPoolExecutor(parts - 1) if parts > 1 else None

    @property
    def wind(self) -> np.ndarray:
        """Velocity of the air (3,) or (N, 3) [m/s], world frame; live."""
        return self._wind

    @wind.setter
    def wind(self, wind: np.ndarray) -> None:
        self._wind = wind
        self._air = (wind.ctypes.data, wind.strides[0] // 8 if wind.ndim > 1 else 0)

    def advance(self, steps: int) -> np.ndarray | None:
        """Fly some physics steps.

        Returns:
            None, or the numbers of the aircraft that could touch something meanwhile: they were
            left as they are, and are MuJoCo's.
        """
        fly = partial(self._fly, steps=steps)
        waiting: list[Future[int]] = []
        if self._pool is not None:  # ctypes lets go of the interpreter, so the parts fly together
            waiting = [self._pool.submit(fly, *part) for part in self._parts[1:]]
        marked = fly(*self._parts[0]) + sum(part.result() for part in waiting)
        return np.flatnonzero(self._near) if marked else None

    def _fly(self, first: int, last: int, steps: int) -> int:
        return self._kernel(
            *(first, last, steps, *self._addresses, self._stride),
            *(self._aircraft.ctypes.data, *self._air, self._near.ctypes.data),
        )


def parameters(model: mujoco.MjModel) -> np.ndarray:
    """What `native/flight.c` knows of an aircraft, read from its compiled model.

    Raises:
        EngineError: There are other bodies, joints, actuators or forces than those of the aircraft.
    """
    _check(model)
    rotors = model.actuator_trnid[:, 0]
    drag, moment = model.body_user[1, 1:3]
    # Everything of the aircraft lies in a sphere of this radius about its centre of mass.
    own = model.geom_bodyid == 1
    reach = np.linalg.norm(model.geom_pos[own], axis=-1) + model.geom_rbound[own]
    can_touch = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    ground = model.geom_pos[~own, 2].max(initial=0.0)
    floor = ground + reach.max(initial=0.0) + MARGIN if can_touch.any() else -math.inf
    listed = [
        *(model.opt.timestep, model.body_mass[1], *model.body_inertia[1], *model.opt.gravity),
        *model.actuator_gainprm[:, 0],
        *model.actuator_dynprm[:, 0],
        *model.site_pos[rotors, 0],
        *model.site_pos[rotors, 1],
        *(model.actuator_gear[:, 5] / model.actuator_gear[:, 2]),
        *(drag, moment, floor),
    ]
    packed = np.array(listed, dtype=np.float64)
    if len(packed) != native.library().quadrl_aircraft_size():
        raise native.NativeError("quadrl/flight.py and native/flight.c disagree on an aircraft")
    return packed


def _check(model: mujoco.MjModel) -> None:
    """Refuse what the equations do not describe."""
    free = model.njnt == 1 and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    rotors = model.nu == ROTORS and (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_USER).all()
    obstacles = [
        model.geom(k).name or f"number {k}"
        for k in np.flatnonzero(model.geom_bodyid != 1)
        if (model.geom_contype[k] or model.geom_conaffinity[k])
        and model.geom_type[k] != mujoco.mjtGeom.mjGEOM_PLANE
    ]
    turned = not (model.body_iquat[-1] == (1, 0, 0, 0)).all() or model.body_ipos[-1].any()
    for wrong, what in (
        (model.nbody != 2 or not free, "one aircraft on a free joint and no other body"),
        (not rotors or model.neq or model.ntendon, "its four rotors alone, and no constraint"),
        (obstacles, f"nothing to touch but level ground (there is {', '.join(obstacles)})"),
        (turned, "a centre of mass and principal axes that are the body's own"),
    ):
        if wrong:
            raise EngineError(f"engine='flight' flies {what}; use engine='mujoco' for this model")
