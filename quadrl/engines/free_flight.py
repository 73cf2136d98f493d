"""Free flight: the equations of motion alone, integrated in C.

Away from everything that it could touch, an aircraft follows an ordinary differential equation.
`native/free_flight.c` integrates it by the Runge-Kutta method on the very rows that MuJoCo steps,
so an aircraft passes from one engine to the other with every bit of its state. It shares the forces
(`native/aero.h`) and the bytes of the parameters with MuJoCo's callbacks.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from quadrl.aircraft.parameters import MAX_ROTORS, ROTOR, ROW_SIZE, numbers
from quadrl.base.errors import QuadrlError
from quadrl.engines import native
from quadrl.engines.solids import MARGIN, Solids, geoms_of_solids
from quadrl.engines.threads import LANES, Threads

FIELDS = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart", "userdata")
"""Arrays of mjData that free flight reads or writes."""


class FreeFlight:
    """Advances the rows of a simulation in place."""

    def __init__(
        self,
        model: mujoco.MjModel,
        fields: dict[str, np.ndarray],
        ceiling: np.ndarray,
        table: np.ndarray,
        threads: Threads,
        solids: Solids,
        step: float,
    ) -> None:
        """Check the model and take the addresses.

        Args:
            model: A model of `quadrl.engines.mjcf`.
            fields: Live arrays (N, k) of FIELDS, all with one stride between aircraft.
            ceiling: Largest commands (N, R) [rad/s], live.
            table: Rows of parameters (N,), or one (1,) for all, which is live.
            threads: Threads to fly on.
            solids: The solids about the aircraft.
            step: Physics step [s].

        Raises:
            QuadrlError: The model holds something that free flight does not know.
        """
        _check(model)
        self._kernel, self._threads = native.library().quadrl_free_flight, threads
        self.world = world(model, step)
        self.near = np.zeros(len(fields["qpos"]), dtype=np.int8)
        """Marks of the aircraft that were left to MuJoCo."""
        # As the kernels read them: the row, or blocks of LANES rows side by side.
        self.parameters, block, rotors = table, 0, fields["act"].shape[1]
        if len(table) > 1:
            block = LANES * (ROW_SIZE - (MAX_ROTORS - rotors) * ROTOR.itemsize // 8)
            self.parameters = np.empty((-(-len(table) // LANES), block // LANES, LANES))
            self.parameters[:] = numbers(table[:1])[0, : block // LANES, None]
            self.write(np.arange(len(table)), table)
        live, about = [fields[name] for name in FIELDS], (solids.table, solids.nearby)
        arrays = (*live, ceiling, self.parameters, self.world, self.near, *about)
        sizes = (live[0].strides[0] // 8, block, rotors, len(solids.geoms))
        self._alive = arrays  # the kernel knows their addresses
        self.rows = native.struct(*arrays, *sizes)
        """It as `Rows` in native/flight.h."""
        self._address = self.rows.ctypes.data

    def write(self, rows: np.ndarray, table: np.ndarray) -> None:
        """Take parameters (n,) of some aircraft (n,)."""
        if (blocks := self.parameters).ndim > 1:
            blocks[rows // LANES, :, rows % LANES] = numbers(table)[:, : blocks.shape[1]]

    def advance(self, steps: int) -> np.ndarray | None:
        """Fly some physics steps.

        Returns:
            None, or the numbers of the aircraft that could touch something meanwhile, which were
            left to MuJoCo.
        """
        address = self._address
        marked = self._threads.call(lambda first, end: self._kernel(address, first, end, steps))
        return np.flatnonzero(self.near) if marked else None


def world(model: mujoco.MjModel, step: float) -> np.ndarray:
    """The kernel's World: physics step, as given [s], gravity along z [m/s^2], floor and reach [m].

    An aircraft may touch the ground if its centre of mass is below the floor, and a solid if it is
    within the reach of it.
    """
    own = model.geom_bodyid == 1
    # Everything of the aircraft lies in a sphere of this radius about its centre of mass.
    radii = np.linalg.norm(model.geom_pos[own], axis=-1) + model.geom_rbound[own]
    reach, floor = radii.max(initial=0.0), -math.inf
    if ((model.geom_contype != 0) | (model.geom_conaffinity != 0)).any():
        ground = ~own
        ground[geoms_of_solids(model)] = False
        floor = model.geom_pos[ground, 2].max(initial=0.0) + reach + MARGIN
    return np.array([step, model.opt.gravity[2], floor, reach + MARGIN])


def _check(model: mujoco.MjModel) -> None:
    """Refuse a model that the equations do not describe."""
    free = model.njnt == 1 and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    rotors = (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_USER).all()
    obstacles = [
        model.geom(k).name or f"number {k}"
        for k in np.setdiff1d(np.flatnonzero(model.geom_bodyid != 1), geoms_of_solids(model))
        if (model.geom_contype[k] or model.geom_conaffinity[k])
        and (model.geom_type[k] != mujoco.mjtGeom.mjGEOM_PLANE or model.geom_quat[k, 1:3].any())
    ]
    turned = not (model.body_iquat[-1] == (1, 0, 0, 0)).all() or model.body_ipos[-1].any()
    for wrong, what in (
        (model.nbody != 2 or not free, "a single body on a free joint"),
        (not rotors or model.neq or model.ntendon, "rotors as actuators and no constraints"),
        (obstacles, f"level ground and no obstacle (here: {', '.join(obstacles)})"),
        (turned, "a body frame at the centre of mass, along the principal axes"),
    ):
        if wrong:
            reason, allowed = f"free flight supports only {what}", "'mujoco' for this model"
            raise QuadrlError(reason, name="engine", value="free_flight", allowed=allowed)
