"""What is seen of N aircraft: the estimated state, and the observation that policies get."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.rotors import GRAVITY
from quadrl.base.philox import NOISE
from quadrl.base.rotation import Array, to_body, to_world
from quadrl.conditions.observing import Observing
from quadrl.conditions.randomization import NONE
from quadrl.conditions.randomizer import Randomizer
from quadrl.conditions.sampler import AircraftSampler
from quadrl.core.observation import ObservationTerm, layout
from quadrl.core.snapshot import Snapshot
from quadrl.core.task import Task
from quadrl.core.transition import Transition, observe
from quadrl.engines import native
from quadrl.engines.dynamics import thrust_wrench
from quadrl.engines.engine import Engine, Frame
from quadrl.engines.state import State


def make(
    sampler: AircraftSampler, options: Observing, task: Task, engine: Engine, actions: int
) -> tuple[Randomizer, Observer | None, Mapping[str, ObservationTerm]]:
    """What disturbs aircraft, what sees them otherwise than the task says, and the entries.

    Args:
        sampler: Samples what is drawn.
        options: Of the observation.
        task: The task.
        engine: Flies the aircraft.
        actions: Numbers in an action.
    """
    given, observes = sampler.randomization, options != Observing()
    randomizer = Randomizer(sampler, engine, active=observes or given != NONE)
    observes |= (given.noise, given.bias) != (NONE.noise, NONE.bias) or sampler.delays[1][1] > 0
    observer = Observer(options, task, engine, actions, randomizer) if observes else None
    return randomizer, observer, observer.terms if observer else task.observation


class Observer:
    """Sees N aircraft: makes the estimated state, and the observation from the task's terms."""

    def __init__(
        self,
        options: Observing,
        task: Task,
        engine: Engine,
        actions: int,
        randomizer: Randomizer,
    ) -> None:
        """Lay out what is seen.

        Args:
            options: Of the observation.
            task: The task.
            engine: Flies the aircraft.
            actions: Numbers in an action.
            randomizer: Of those aircraft.
        """
        self._options, self._task = options, task
        self._engine, self._randomizer = engine, randomizer
        vehicle, count = engine.vehicle, engine.num_envs
        rotors, sampler = vehicle.rotor_count, randomizer.sampler
        given = sampler.randomization
        self._rows = np.arange(count)
        terms = dict(task.observation)
        if options.rotor_speed == "none":
            terms.pop("rotor_speed", None)
        if options.airspeed:
            terms["airspeed"] = ObservationTerm(3, "m/s", "velocity through the air, body frame")
        if options.disturbance:
            meaning = "acceleration that weight and specified thrust do not explain, body frame"
            terms["disturbance"] = ObservationTerm(3, "m/s^2", meaning)
        self._single = tuple(terms)
        single = sum(term.width(rotors) for term in terms.values())
        if many := options.action_history:
            meaning = f"the last {many} actions, the newest first"
            terms["action_history"] = ObservationTerm(many * actions, "1", meaning)
        if many := options.observation_history:
            meaning = f"the {many} observations before, the newest first"
            terms["observation_history"] = ObservationTerm(many * single, "", meaning)
        self.terms = terms
        """The entries of the observation in the order of the flat vector."""
        self.layout = layout(terms, rotors)
        """Where each of them stands in it."""
        self._size = sum(term.width(rotors) for term in terms.values())
        # The newest observation first: as many as the oldest that is looked at asks for.
        self._seen = np.zeros(
            (1 + sampler.delays[1][1] + options.observation_history, count, single)
        )
        self._actions = np.zeros((count, options.action_history * actions))
        self._noise, self._noisy = given.noise.sizes, given.noise != NONE.noise
        self._feels = options.disturbance
        unknown = options.rotor_speed == "none" and self._feels
        self._estimated = options.rotor_speed == "estimated" or unknown
        self._rotor_speed = np.zeros((count, rotors))  # [rad/s]
        self._lags = np.array([[r.lag_up, r.lag_down] for r in vehicle.rotors]).T  # [1/s]
        uncertain = self._noisy or given.bias != NONE.bias or self._estimated
        self.frame = Frame(count, rotors) if uncertain else None
        """Table of the estimated state; None where the true one is seen."""
        self._coordinates = np.zeros((count, 13 + rotors))
        nominal, self._library = parameters.rows(vehicle), native.library()
        self._limits = parameters.limits(nominal)
        if self.frame is not None:
            first = self._coordinates.ctypes.data
            places = [first, first + 7 * 8, first + 13 * 8, engine.origin.ctypes.data]
            places += [self._limits.ctypes.data, engine.air.ctypes.data]
            places += [self._coordinates.shape[1], 0]
            places += [self.frame.columns, rotors]
            self._seen_rows = np.array(places)  # as `Rows` in native/state.c
        self.observation: dict[str, Array] = {}
        """The last one, its entries views of `flat`."""
        self.flat = np.zeros((count, self._size))
        """The same as vectors."""
        self._specified = Parameters.of(nominal, vehicle.control_timestep)
        self._disturbance = np.zeros((count, 3))  # [m/s^2], world frame
        self._motion = np.zeros((count, 6))  # velocity, and acceleration by thrust, world frame
        self._scaled = np.zeros((count, len(sampler.spread)))
        width = (
            sum(term.width(rotors) for term in task.observation.values()) + len(sampler.spread) + 3
        )
        self.privileged = np.zeros((count, width)) if options.privileged else None
        """(N, p) for the critic alone, where the options ask for it."""

    # -------------------------------------------------------------------- the estimated state

    def follow(self, command: Array, seconds: float) -> None:
        """Let the estimate of the rotor speeds follow commands (N, R) [rad/s] for a time [s]."""
        if self._estimated:
            goal = np.minimum(command, self._engine.vehicle.max_speed)
            up, down = 1 - np.exp(-seconds * self._lags)
            speed = self._rotor_speed
            speed += np.where(goal > speed, up, down) * (goal - speed)

    def estimate(self, rows: np.ndarray | None = None) -> State | None:
        """The estimated state of some aircraft (n,), or of all; None where the true one is seen."""
        if self.frame is None:
            return None
        ids = None if rows is None else rows.ctypes.data
        count = len(self._rows) if rows is None else len(rows)
        source, own, engine = self._randomizer, self._coordinates, self._engine
        speed = self._rotor_speed if self._estimated else engine.act
        bias = source.sampler.columns(source.drawn, "position_bias_x", 12)
        arrays = (*source.place, source.steps, engine.qpos, engine.qvel, speed, self._noise, bias)
        strided = (engine.qpos, speed, bias, own)
        # As `Rows` in native/disturbances.c.
        where = np.array(
            [*(array.ctypes.data for array in (*arrays, own)),
             *(array.strides[0] // 8 for array in strided), speed.shape[1], self._noisy, NOISE]
        )  # fmt: skip
        self._library.quadrl_estimate(where.ctypes.data, count, ids)
        self._library.quadrl_state(self._seen_rows.ctypes.data, count, ids, self.frame.address)
        if rows is None:
            return self.frame.state
        return State.of_table(self.frame.table[:, rows])

    # -------------------------------------------------------------------- the observation

    def begin(self, rows: np.ndarray, now: Snapshot) -> dict[str, Array]:
        """The first observation of episodes (n,), from their snapshot (n, ...)."""
        self._rotor_speed[rows] = self._engine.act[rows]
        truth, estimate = self._task.observe(now), self.estimate(rows)
        seen = now.state if estimate is None else estimate
        terms = truth if estimate is None else observe(self._task, now, estimate)
        if self._feels:
            self._disturbance[rows], self._motion[rows] = 0.0, moving(self._specified, seen)
        self._seen[:, rows] = self._vector(terms, seen, rows)
        self._actions[rows] = 0.0
        self._tell(truth, now.state, rows, drawn=True)
        flat = self._present()[rows]
        return {name: flat[:, part] for name, part in self.layout.items()}

    def observe(self, done: Transition, action: Array) -> dict[str, Array]:
        """The observation of all after a control step with an action (N, k)."""
        if len(self._seen) > 1:
            self._seen[1:] = self._seen[:-1].copy()
        seen = self._engine.state if self.frame is None else self.frame.state
        if self._feels:
            last, self._motion = self._motion, moving(self._specified, seen)
            timestep = self._engine.vehicle.control_timestep
            self._disturbance = felt(self._disturbance, last, self._motion, timestep)
        self._seen[0] = self._vector(done.observation, seen, self._rows)
        if self._options.action_history:
            size = action.shape[1]
            self._actions[:, size:] = self._actions[:, :-size].copy()
            self._actions[:, :size] = np.clip(action, -1.0, 1.0)
        self._tell(done.truth, self._engine.state, self._rows)
        return self._show(self._present())

    def again(self, now: Snapshot) -> dict[str, Array]:
        """The present observation of all once more, after `restore`."""
        self._tell(self._task.observe(now), now.state, self._rows, drawn=True)
        return self._show(self._present())

    def _show(self, flat: Array) -> dict[str, Array]:
        self.flat = flat
        self.observation = {name: flat[:, part] for name, part in self.layout.items()}
        return self.observation

    def _vector(self, terms: Mapping[str, Array], state: State, rows: np.ndarray) -> Array:
        """What is seen at one moment, (n, single)."""
        if self._options.airspeed:
            through_air = state.velocity - self._engine.wind[rows]
            terms = {**terms, "airspeed": to_body(state.rotation, through_air)}
        if self._feels:
            felt = to_body(state.rotation, self._disturbance[rows])
            terms = {**terms, "disturbance": felt}
        return np.concatenate([terms[name] for name in self._single], axis=-1)

    def _present(self) -> Array:
        """The flat observation (N, size): as late as it is, with what is remembered."""
        source = self._randomizer
        delay = source.sampler.columns(source.drawn, "observation_delay")[:, 0]
        age = np.rint(delay / self._engine.vehicle.control_timestep).astype(np.int64)
        many = range(1 + self._options.observation_history)
        now, *before = (self._seen[age + k, self._rows] for k in many)
        return np.concatenate([now, self._actions, *before], axis=-1)

    def _tell(
        self, truth: Mapping[str, Array], state: State, rows: np.ndarray, *, drawn: bool = False
    ) -> None:
        """Renew the privileged observation of some aircraft (n,), and what was drawn for them."""
        if self.privileged is None:
            return
        if drawn:
            source = self._randomizer
            self._scaled[rows] = source.sampler.scaled(source.drawn[rows])
        wind = to_body(state.rotation, self._engine.wind[rows])
        fresh = np.concatenate([*truth.values(), self._scaled[rows], wind], axis=-1)
        if len(rows) < len(self._rows):
            fresh, part = self.privileged.copy(), fresh
            fresh[rows] = part
        self.privileged = fresh

    def save(self) -> dict[str, np.ndarray]:
        """Copies of what is remembered."""
        return {name: np.array(getattr(self, f"_{name}")) for name in REMEMBERED}

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Take up what `save` gave."""
        for name in REMEMBERED:
            setattr(self, f"_{name}", np.array(saved[name]))


def moving(specified: Parameters, state: State) -> Array:
    """Velocity [m/s] and the acceleration by the specified thrust [m/s^2], (n, 6), world frame."""
    force, _ = thrust_wrench(specified, state.rotor_speed)
    thrust = to_world(state.rotation, force / specified.mass[:, None])
    return np.concatenate([state.velocity, thrust], axis=-1)


def felt(disturbance: Array, last: Array, now: Array, timestep: float) -> Array:
    """The acceleration that weight and specified thrust do not explain, smoothed.

    Args:
        disturbance: The last one, (n, 3) [m/s^2], world frame.
        last: What `moving` gave a control step ago, (n, 6).
        now: What it gives now.
        timestep: Of control [s].
    """
    rate = (now[:, :3] - last[:, :3]) / timestep
    rate = rate - (0.5 * (now[:, 3:] + last[:, 3:]) + WEIGHT)
    return disturbance + (1 - math.exp(-timestep / SMOOTHING)) * (rate - disturbance)


REMEMBERED = ("seen", "actions", "rotor_speed", "disturbance", "motion")
WEIGHT = np.array([0.0, 0.0, -GRAVITY])
SMOOTHING = 0.1  # [s], of the acceleration that thrust does not explain
