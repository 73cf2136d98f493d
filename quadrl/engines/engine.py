"""The interface of engines: rows of coordinates, commands, air and parameters, and a State.

An engine takes rotor commands, advances some physics steps, and reports which aircraft diverged.
"""

from __future__ import annotations

import abc
import functools
from collections.abc import Iterator
from typing import Literal

import mujoco
import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import norm
from quadrl.engines import native
from quadrl.engines.adjoint import Leg
from quadrl.engines.free_flight import FreeFlight
from quadrl.engines.solids import Solids
from quadrl.engines.state import FIRST, Frame, Start, State
from quadrl.engines.threads import Threads

EngineName = Literal["mujoco", "free_flight"]
ENGINES: tuple[EngineName, ...] = ("mujoco", "free_flight")


class Engine(abc.ABC):
    """Base of the engines: the table of the state, filled from rows of generalised coordinates."""

    name: EngineName
    model: mujoco.MjModel
    qpos: np.ndarray  # (N, 7), live
    qvel: np.ndarray  # (N, 6)
    act: np.ndarray  # (N, R) rotor speeds [rad/s]
    ctrl: np.ndarray  # (N, R) rotor commands [rad/s]
    air: np.ndarray  # (N, AIR) rows of air; saved and restored with the rest
    wind: np.ndarray  # (N, 3) [m/s], world frame: the first numbers of `air`
    parameters: np.ndarray  # (N,) rows, or (1,) where all are the same
    begun: np.ndarray  # the same when the episodes began, before anything changed in flight
    forked = False  # whether it was made before this process was forked, which lacks its threads

    def __init__(
        self,
        vehicle: Vehicle,
        fields: dict[str, np.ndarray],
        altitude: float,
        name: EngineName,
        threads: int,
    ) -> None:
        """Set up the tables.

        Args:
            vehicle: The aircraft as it is specified.
            fields: Live arrays (N, k) by the names of mjData.
            altitude: Height of the origin of the task's frame above the ground [m].
            name: One of ENGINES.
            threads: Threads to fly on.
        """
        self.vehicle, self.name, self.num_envs = vehicle, name, len(fields["qpos"])
        self.origin = np.array([0.0, 0.0, altitude])  # (3,) [m], world
        self.qpos, self.qvel, self.act, self.ctrl = (
            fields[k] for k in ("qpos", "qvel", "act", "ctrl")
        )
        self.air = fields["userdata"][:, : parameters.AIR]
        self.wind = self.air[:, :3]
        self.ceiling = np.full(self.ctrl.shape, np.inf)
        """Largest commands (N, R) [rad/s] that the rotors take, live; for what limits them in
        flight."""
        self._threads = Threads(self.num_envs, threads)
        placed = self.model, self.num_envs, self.origin, self._model_field
        self.solids = Solids(*placed, self._threads)
        self.hits, self.feet = (
            fields["userdata"][:, parameters.AIR :][:, part]
            for part in (np.s_[: parameters.HIT], np.s_[parameters.HIT :])
        )
        """Hits (N, HIT) of this control step and touches of feet (N, FEET) in this episode, live;
        (N, 0) in a world without solids."""
        rows = self._model_field("body_user")[:, 1]
        self.parameters = rows.view(parameters.AIRCRAFT)[:, 0]
        self.begun = self.parameters.copy()
        flown = self.model, fields, self.ceiling, self.parameters, self._threads, self.solids
        step = vehicle.physics_timestep
        self._free_flight = FreeFlight(*flown, step) if name == "free_flight" else None
        self.finer = round(step / self.model.opt.timestep)
        """Steps of the model in a physics step."""
        # Two frames in turn: the last state stays whole while the next one is computed.
        self.frames = [Frame(self.num_envs, vehicle.rotor_count) for _ in range(2)]
        self._middle: Frame | None = None
        self.motions = np.zeros((2, self.num_envs, 13 + vehicle.rotor_count))
        """qpos, qvel and rotor speeds at the end of a control step and of the one before, in turn:
        those that compiled steps leave, and those of resets."""
        self.turn = 0
        """Which of them is the present one."""
        self._behind = False  # whether the frame is to be filled from it
        library = native.library()
        self._step = library.quadrl_step
        self._kernel, self._first_unsound = library.quadrl_state, library.quadrl_unsound_air
        self.limits = parameters.limits(self.parameters)
        """Largest speed [m/s] and body rate [rad/s] of each aircraft, (N or 1, 2), live."""
        arrays = (self.qpos, self.qvel, self.act, self.origin, self.limits, self.air)
        stride = self.limits.shape[1] if len(self.limits) > 1 else 0
        sizes = stride, self.frames[0].columns, vehicle.rotor_count
        # As `Rows` in native/state.c.
        self._rows = native.struct(*arrays, self.qpos.strides[0] // 8, *sizes)
        self._address = self._rows.ctypes.data
        self._motions = [
            native.struct(*np.split(motion, [7, 13], axis=1), *arrays[3:], motion.shape[1], *sizes)
            for motion in self.motions
        ]

    @property
    def state(self) -> State:
        """The current state, views of live buffers that are valid for one more step."""
        if self._behind:
            self.frames.reverse()
            motion = self._motions[self.turn].ctypes.data
            self._kernel(motion, self.num_envs, None, self.frames[0].address)
            self._behind = False
        return self.frames[0].state

    @functools.cached_property
    def near(self) -> np.ndarray:
        """Marks (N,) int8 of a control step in C: left to MuJoCo, or broken."""
        flies = self._free_flight
        return np.zeros(self.num_envs, np.int8) if flies is None else flies.near

    @functools.cached_property
    def rows(self) -> np.ndarray:
        """The simulation as `Rows` in native/flight.h."""
        if self._free_flight is not None:
            return self._free_flight.rows
        self._kept = parameters.numbers(self.parameters[:1])
        fields = self.qpos, self.qvel, self.act, self.ctrl, None, self.air, self.ceiling
        sizes = self.qpos.strides[0] // 8, 0, self.vehicle.rotor_count, 0
        return native.struct(*fields, self._kept, None, self.near, None, None, *sizes)

    def command(self, wanted: np.ndarray) -> None:
        """Command the rotors, (N, R) [rad/s], within the ceiling."""
        np.minimum(wanted, self.ceiling, out=self.ctrl)

    def control_step(
        self, step: int, rows: np.ndarray | None, parts: int, begin: int, end: int
    ) -> int:
        """Call `quadrl_step` of native/free_flight.c.

        Args:
            step: Address of its `Step`.
            rows: Which aircraft, (n,) int64; None for all.
            parts: Which parts of the control step.
            begin: The first of the physics steps.
            end: The one after the last of them.

        Returns:
            As it does.
        """
        if rows is not None:
            return self._step(step, rows.ctypes.data, 0, len(rows), parts, begin, end)
        done = parts, begin, end
        return self._threads.call(lambda at, last: self._step(step, None, at, last, *done))

    def show(self, rows: np.ndarray) -> None:
        """Let the state of aircraft (n,) be that of their motion, which was replaced."""
        if not self._behind:
            motion, ids = self._motions[self.turn].ctypes.data, rows.ctypes.data
            self._kernel(motion, len(rows), ids, self.frames[0].address)

    def take_turn(self) -> None:
        """Let the other of `motions` be the present one, which a control step has filled."""
        self.turn, self._behind = 1 - self.turn, True
        self.solids.arrive()

    @abc.abstractmethod
    def _model_field(self, name: str) -> np.ndarray:
        """A field of the model with a leading axis (N or 1), live."""

    def write_parameters(self, rows: np.ndarray, table: np.ndarray) -> None:
        """Give some aircraft (n,) parameters (n,), also in flight; MuJoCo's own fields follow."""
        rotor = table["rotor"][:, : self.vehicle.rotor_count]
        mass, inertia = table["mass"][:, None], table["inertia"]
        # As MuJoCo computes them from mass and inertia when it compiles a model.
        weights = np.concatenate([1 / mass, (1 / inertia).mean(1, keepdims=True)], axis=1)
        ratio = rotor["torque_coefficient"] / rotor["thrust_coefficient"]
        for name, place, value in (
            ("body_user", np.s_[:, 1], parameters.numbers(table)),
            ("body_mass", np.s_[:, 1], mass[:, 0]),
            ("body_subtreemass", np.s_[:, :2], mass),
            ("body_inertia", np.s_[:, 1], inertia),
            ("dof_M0", np.s_[:], np.concatenate([np.tile(mass, 3), inertia], axis=1)),
            ("dof_invweight0", np.s_[:], np.repeat(weights, 3, axis=1)),
            ("body_invweight0", np.s_[:, 1], weights),
            ("actuator_gear", np.s_[:, :, 5], -rotor["spin"] * ratio),
            ("actuator_ctrlrange", np.s_[:, :, 1], rotor["max_speed"]),
        ):
            field = self._model_field(name)
            field[place][rows] = value
        self._model_field("site_pos")[np.ix_(rows, self.model.actuator_trnid[:, 0])] = rotor[
            "position"
        ]
        self.limits[rows] = parameters.limits(table)
        if self._free_flight is not None:
            self._free_flight.write(rows, table)

    @abc.abstractmethod
    def advance(self, steps: int) -> None:
        """Fly some physics steps with the commands in `ctrl`."""

    @abc.abstractmethod
    def touch(self, rows: np.ndarray | None, steps: int) -> None:
        """Let MuJoCo fly some physics steps of aircraft (n,) that may touch something, or of all.

        Raises:
            NativeError: The rotor callbacks were removed.
        """

    def passed(self, steps: int) -> None:
        """Count physics steps that were not flown by MuJoCo."""
        return

    def contact_steps(self, steps: int, rows: np.ndarray | None = None) -> Iterator[int]:
        """Put solids that move where they are in each step of the model.

        Args:
            steps: Physics steps; solids move in the first of them.
            rows: Which aircraft MuJoCo flies, (n,); None for all.

        Yields:
            Steps of the model, which MuJoCo is to fly then.
        """
        if not self.solids.moves:
            yield steps * self.finer
            return
        rows = np.arange(self.num_envs) if rows is None else rows
        for k in range(steps * self.finer):
            self.solids.stand(rows, min((k + 0.5) / self.finer, 1.0))  # then they have arrived
            yield 1

    def leg(self, steps: int) -> Leg:
        """Copy the state, commands, air and parameters of the next steps, for their derivatives.

        Raises:
            QuadrlError: The engine is not free flight.
        """
        if (flies := self._free_flight) is None:
            reason = "MuJoCo's steps have no derivatives here"
            raise QuadrlError(reason, name="engine", value=self.name, allowed="'free_flight'")
        start = np.concatenate([self.qpos, self.qvel, self.act], axis=1)
        own = len(self.parameters) > 1  # a reset may change them
        table = flies.parameters.copy() if own else flies.parameters
        return Leg(start, self.ctrl.copy(), self.air.copy(), table, flies.world, steps)

    @abc.abstractmethod
    def clear(self, rows: np.ndarray) -> None:
        """Reset MuJoCo's warm starts and warnings of some aircraft, and their air."""

    def read(self) -> np.ndarray | None:
        """Compute the state after `advance`.

        Returns:
            None when all went well; else which aircraft diverged, (N,) bool: a number that is not
            finite or that MuJoCo calls unstable, or faster than the physics step resolves
            (`Vehicle.resolved_speed`, `resolved_turn`). Those keep their last good state.
        """
        self.frames.reverse()
        self.solids.arrive()
        self._behind = False
        if not self._fill(None):
            return None
        table, last = (frame.table for frame in self.frames)
        sound = (np.abs(table) < mujoco.mjMAXVAL).all(axis=0)
        sound &= table[FIRST["speed"]] <= self.limits[:, 0]
        broken = ~(sound & (table[FIRST["angular_speed"]] <= self.limits[:, 1]))
        rows = np.flatnonzero(broken)
        table[:, rows] = last[:, rows]
        self._mend(rows, State.of_table(table[:, rows]))
        return broken

    def mend(self, rows: np.ndarray) -> None:
        """Give aircraft (n,) that diverged in a compiled step their last good motion.

        It comes before the turn.

        Raises:
            QuadrlError: One of them has a parameter that is not finite.
        """
        motion, last = self.motions[1 - self.turn], self.motions[self.turn]
        motion[rows] = last[rows]
        position, *rest = np.split(motion[rows], [3, 7, 10, 13], axis=1)
        self._mend(rows, Start(position - self.origin, *rest))

    def _mend(self, rows: np.ndarray, good: Start | State) -> None:
        air = self.air[rows]
        self.clear(rows)
        self.air[rows] = air
        self._write(rows, good)
        self._check_parameters(rows)

    def peek(self) -> State:
        """The state in the middle of a control step, in separate buffers, unchecked."""
        if self._middle is None:
            self._middle = Frame(self.num_envs, self.vehicle.rotor_count)
        self._kernel(self._address, self.num_envs, None, self._middle.address)
        return self._middle.state

    def _check_parameters(self, rows: np.ndarray) -> None:
        """Refuse parameters that are not finite: with them aircraft diverge at every step."""
        table = self.parameters if len(self.parameters) == 1 else self.parameters[rows]
        for name in parameters.AIRCRAFT.names or ():
            if not np.isfinite(table[name].copy().view(np.float64)).all():
                value = table[name].tolist()
                raise QuadrlError(
                    name=f"engine.parameters[{name!r}]", value=value, allowed="finite"
                )

    def check_air(self) -> None:
        """Refuse air that is not finite, since users may write to `wind` and `air`.

        Raises:
            QuadrlError: The message names the aircraft.
        """
        if (row := self._first_unsound(self._address, self.num_envs)) >= 0:
            blows = not np.isfinite(self.wind[row]).all()
            name, array = ("wind", self.wind) if blows else ("air", self.air)
            value = array[row].tolist()
            raise QuadrlError(name=f"engine.{name}[{row}]", value=value, allowed="finite")

    def place(
        self,
        rows: np.ndarray,
        start: Start,
        table: np.ndarray | None = None,
        solids: np.ndarray | None = None,
    ) -> State:
        """Put aircraft where an episode begins, in calm air.

        Args:
            rows: Which aircraft, (n,).
            start: Their starts, arrays (n, k).
            table: New parameters (n,) for them; None to keep theirs.
            solids: Poses (n, K, 7) of the geoms of solids, as `Solids.place` takes them; None to
                keep theirs.

        Returns:
            The state of those aircraft.

        Raises:
            QuadrlError: `read` would call the start diverged; then nothing has changed.
        """
        self._check_start(rows, start, table)
        if table is not None:
            self.write_parameters(rows, table)
            self.begun[rows] = table
        if solids is not None:
            self.solids.place(rows, solids)
        self.clear(rows)
        self._write(rows, start)
        self._fill(rows)
        self._note(rows)
        if len(rows) == self.num_envs:
            self._behind = False
            return self.state
        return State.of_table(self.frames[0].table[:, rows])

    def _check_start(self, rows: np.ndarray, start: Start, table: np.ndarray | None) -> None:
        """Refuse a start that the physics step does not resolve, by the rules of native/state.c."""
        limits = self.limits if table is None else parameters.limits(table)
        limits = limits if len(limits) in (1, len(rows)) else limits[rows]
        most = np.array([mujoco.mjMAXVAL])
        step = f"a physics_timestep shorter than {self.vehicle.physics_timestep} s resolves more"
        for name, part, limit, advice in (
            ("velocity", start.velocity, limits[:, 0], step),
            ("body_rate", start.body_rate, limits[:, 1], step),
            ("quaternion", start.quaternion, most, ""),
            ("rotor_speed", start.rotor_speed, most, ""),
            ("position", start.position + self.origin, most, ""),
        ):
            if not ((np.abs(part) < most).all() and (norm(part) <= limit).all()):
                value, allowed = getattr(start, name), f"finite, and at most {limit.min():g}"
                raise QuadrlError(advice, name=f"{name} at the start", value=value, allowed=allowed)

    @abc.abstractmethod
    def save(self) -> dict[str, np.ndarray]:
        """All arrays that the next step depends on."""

    @abc.abstractmethod
    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Restore what `save` returned."""

    def _restore_state(self, saved: dict[str, np.ndarray]) -> None:
        table = parameters.named(saved["parameters"])
        if not np.array_equal(table, self.parameters):
            self.write_parameters(np.arange(len(table)), table)
        self.begun[:] = parameters.named(saved["begun"])
        if "solids" in saved:
            self.solids.restore(saved["solids"])
        self._fill(None)
        self._note(np.arange(self.num_envs))
        self._behind = False

    def _saved(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """The result of `save`, from the rows of the simulation."""
        both = {"parameters": self.parameters, "begun": self.begun}
        saved = {"rows": rows} | {k: parameters.numbers(v).copy() for k, v in both.items()}
        saved["layout"] = parameters.LAYOUT
        return saved | ({"solids": self.solids.save()} if len(self.solids.geoms) else {})

    def clearance(self, rows: np.ndarray | None = None) -> np.ndarray:
        """Lower bound of each aircraft's distance to a solid, (n,) [m]; infinite without solids."""
        if rows is None and self.forked:
            rows = np.arange(self.num_envs)  # this way takes no threads
        return self.solids.clearance(self.qpos, rows)

    def _write(self, rows: np.ndarray, start: Start | State) -> None:
        self.qpos[rows] = np.concatenate([start.position + self.origin, start.quaternion], axis=-1)
        self.qvel[rows] = np.concatenate([start.velocity, start.body_rate], axis=-1)
        self.act[rows] = start.rotor_speed

    def _note(self, rows: np.ndarray) -> None:
        """Keep the motion of aircraft (n,) as the present one."""
        parts = self.qpos[rows], self.qvel[rows], self.act[rows]
        self.motions[self.turn, rows] = np.concatenate(parts, axis=1)

    def _fill(self, rows: np.ndarray | None) -> int:
        """Run the C kernel, and return how many aircraft are not sound."""
        count, ids = (self.num_envs, None) if rows is None else (len(rows), rows.ctypes.data)
        return self._kernel(self._address, count, ids, self.frames[0].address)
