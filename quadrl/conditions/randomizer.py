"""Apply a randomization to rows of aircraft: their parameters, late and lost commands, and pushes.

All that the next steps depend on is in arrays that are saved and restored, and every random number
follows from the seed of its row, the episode and the control step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from quadrl.aircraft.parameters import numbers
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import LINK, PARAMETERS, PUSHES
from quadrl.base.rotation import Array
from quadrl.conditions.process import Process
from quadrl.conditions.randomization import AGES, OFF
from quadrl.conditions.sampler import AircraftSampler, Drawn
from quadrl.engines import native
from quadrl.engines.engine import Engine
from quadrl.engines.rng import uniform

SAVED = ("drawn", "place", "steps", "queue", "past", "newest", "last", "left")


class Randomizer(Process):
    """Randomizes N aircraft."""

    name = "randomizer"

    def __init__(self, sampler: AircraftSampler, engine: Engine, *, active: bool) -> None:
        """Set up the arrays.

        Args:
            sampler: The sampler of the randomization.
            engine: The engine that flies the aircraft.
            active: Whether anything depends on the drawn numbers; otherwise they are drawn only if
                commands are late or get lost.
        """
        self.sampler, self._engine = sampler, engine
        count, rotors = engine.ctrl.shape
        given, vehicle = sampler.randomization, engine.vehicle
        self._rows: np.ndarray = np.arange(count)
        self.drawn = np.tile(sampler.low, (count, 1))
        """Drawn numbers of the present episodes, (N, k), a column for each of `sampler.names`; the
        array is replaced, never changed."""
        self.place = np.zeros((2, count), np.int64)
        """Seeds and numbers of the present episodes."""
        self.steps = np.zeros(count, np.int64)
        """Control steps since their start."""
        self._pushes = given.pushes
        self.push_chance = -math.expm1(-given.pushes.rate * vehicle.control_timestep)
        self._dead = round(vehicle.dead_time / vehicle.physics_timestep)  # physics steps
        fewest, most = (self._dead + steps for steps in sampler.delays["command_delay"])
        self._aged = max(sampler.delays[name][1] for name in AGES)
        jitter = vehicle.substeps * (given.command_jitter[1] > 0)  # physics steps
        self.linked = jitter + sampler.outage[1] > 0
        self.late = self.linked or most + self._aged > 0
        """Whether commands pass a queue, or earlier motions are remembered."""
        each = range(vehicle.substeps)
        late = each if self._aged else {k % vehicle.substeps for k in range(fewest, most + 1)}
        ends = [k for k in each if k in late and k] + [vehicle.substeps]
        self.held = [next(end for end in ends if end > k) - k for k in each]
        """For each physics step of a control step, how many steps can be flown at once: until a
        command changes or a motion has to be remembered."""
        self.active = active or self.late
        # Long enough that a control step can be flown twice: see native/free_flight.c.
        length = max(most + jitter, self._aged) + vehicle.substeps
        self.queue = np.zeros((length, count, rotors))  # [rad/s]
        self.past = np.zeros((length if self._aged else 0, count, 13))  # qpos, qvel before it
        self.newest = np.zeros(1, np.int64)  # where in both
        self.last = np.zeros((count, rotors))  # commands that arrived last [rad/s]
        self.left = np.zeros(count, np.int64)  # control steps without a link, this one counted
        # Delays without jitter and in this control step [physics steps]; outages [control steps].
        self.usual_delay, self._delay, self.outages = np.zeros((3, count), np.int64)
        self.jitters, self.losses = np.zeros((2, count))  # their chances in a control step
        self.ages = np.zeros((len(AGES), count), np.int64)
        """Ages of the motion and of the body rate that are seen [physics steps]."""
        kept = self.queue, self.past if self._aged else None, self.last
        self.rows = native.struct(*kept, self._delay, self.newest, self.left, length, count)
        """What is late, as `Late` in native/free_flight.c; the arrays stay where they are."""

    def sample(self, keys: np.ndarray, episodes: np.ndarray) -> Drawn:
        """Draw the numbers of episodes (n,); nothing changes yet.

        Raises:
            QuadrlError: One of the aircraft cannot hover.
        """
        if not self.active:
            return Drawn()
        sampler, table = self.sampler, None
        drawn = sampler.sample(uniform(keys, episodes, PARAMETERS, 0, len(sampler.names)))
        if sampler.randomization.per_row:
            table = sampler.table(drawn)
            sampler.check_hover(table)
        own = sampler.randomization.wind != OFF
        return Drawn(drawn, table, sampler.columns(drawn, "wind")[:, 0] if own else None)

    def begin(self, rows: np.ndarray, keys: np.ndarray, episodes: np.ndarray, drawn: Drawn) -> None:
        """Begin episodes (n,); until the first command arrives, the rotors keep their speed."""
        if drawn.numbers is None:
            return
        self.place[:, rows], self.steps[rows] = (keys, episodes), 0
        self.drawn = self.drawn.copy()
        self.drawn[rows] = drawn.numbers
        self._set_delay()
        if self.late:
            self.queue[:, rows] = self.last[rows] = self._engine.act[rows]
            self.left[rows] = 0
            self.forget(rows)

    def forget(self, rows: np.ndarray) -> None:
        """Replace the remembered coordinates of aircraft by the present ones.

        Queued commands that are not finite become the present rotor speeds.
        """
        self.past[:, rows] = self._coordinates[rows]
        for sent in (*self.queue, self.last):
            sent[rows] = np.where(np.isfinite(sent[rows]), sent[rows], self._engine.act[rows])

    @property
    def _coordinates(self) -> Array:
        return np.concatenate([self._engine.qpos, self._engine.qvel], axis=1)

    def column(self, name: str) -> Array:
        """A drawn number of the present episodes by its name, (N,)."""
        return self.sampler.columns(self.drawn, name)[:, 0]

    def shown(self) -> dict[str, Array]:
        """The drawn values that differ between aircraft, (N,) by name."""
        return {self.sampler.names[k]: self.drawn[:, k] for k in self.sampler.spread}

    def scaled(self, rows: np.ndarray | None = None) -> Array:
        """The drawn values that differ, of some aircraft (n,) or of all, (n, d), from -1 to 1."""
        return self.sampler.scaled(self.drawn if rows is None else self.drawn[rows])

    def _set_delay(self) -> None:
        step = self._engine.vehicle.physics_timestep
        names = "command_delay", *AGES
        steps = [np.rint(self.column(name) / step).astype(np.int64) for name in names]
        self.usual_delay[:], self.ages[:] = self._dead + steps[0], steps[1:]
        self._delay[:] = self.usual_delay
        if self.linked:
            control = self._engine.vehicle.control_timestep
            often = control * self.column("command_loss")  # outages in a control step
            self.outages[:] = np.rint(self.column("loss_time") / control)
            # So that outages, and the gaps between them, make as many as are asked for.
            self.losses[:] = often / (1 + often - often * self.outages)
            self.jitters[:] = self.column("command_jitter")

    def delayed(self, command: Array, steps: int) -> Array:
        """Queue a command (N, R) [rad/s] for some physics steps; return the one that arrives."""
        if not self.late:
            return command
        length = len(self.queue)
        first = int(self.newest[0]) + 1
        self.queue[first % length] = command
        arrived = self.queue[(first - self._delay) % length, self._rows]
        arrived = np.where(self.left[:, None] > 0, self.last, arrived)
        self.last[:] = arrived
        for k in range(1, min(steps, length)):  # this may overwrite the one that arrives
            self.queue[(first + k) % length] = command
        if self._aged:
            self.past[first % length] = self._coordinates
        self.newest[0] = (first + steps - 1) % length
        return arrived

    def passed(self) -> None:
        """Count a control step whose commands are queued in C."""
        self.newest[0] = (self.newest[0] + self._engine.vehicle.substeps) % len(self.queue)

    def aged(self, rows: np.ndarray | slice) -> Array:
        """Coordinates of aircraft, of the drawn ages: of the motion, and of the body rate.

        Returns:
            (n, 13): position [m], world frame, quaternion, velocity [m/s], world frame, body rate
            [rad/s], body frame.
        """
        now = self._coordinates[rows]
        if not self._aged:
            return now
        # Each physics step remembers the coordinates before it.
        ages = self.ages[:, rows]
        past = self.past[(self.newest - ages + 1) % len(self.past), self._rows[rows]]
        motion, rate = np.where(ages[..., None], past, now)
        return np.concatenate([motion[:, :10], rate[:, 10:]], axis=1)

    def act(self) -> None:
        """Count a control step that begins: push aircraft and draw what their links do in it."""
        if not self.active:
            return
        keys, episodes = (array.ctypes.data for array in self.place)
        place = keys, episodes, self.steps.ctypes.data
        if self.linked:
            chances = self.jitters, self.losses, self.outages, self.usual_delay
            given = (array.ctypes.data for array in chances)
            found = self._delay.ctypes.data, self.left.ctypes.data
            substeps = self._engine.vehicle.substeps
            native.library().quadrl_link(len(self.steps), *place, LINK, *given, substeps, *found)
        if self.push_chance > 0:
            place = *place, PUSHES
            hit = self.push_chance, self._pushes.velocity, self._pushes.body_rate
            qvel = self._engine.qvel
            rows = qvel.ctypes.data, qvel.strides[0] // 8
            native.library().quadrl_push(len(self.steps), *place, *hit, *rows)
        self.steps += 1

    def save(self) -> dict[str, np.ndarray]:
        """Copies of the arrays; none where nothing depends on what is drawn."""
        return {name: np.array(getattr(self, name)) for name in SAVED if self.active}

    def fitted(self, saved: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """What was saved, with the last numbers if they were not drawn then: at their low ends."""
        drawn = saved.get("randomizer.drawn")
        if drawn is None or not self.active or drawn.ndim != 2:
            return saved
        if drawn.shape[1] >= self.drawn.shape[1]:
            return saved
        rest = np.tile(self.sampler.low[drawn.shape[1] :], (len(drawn), 1))
        link = {f"randomizer.{k}": 0 * getattr(self, k) for k in ("last", "left")}
        return {**link, **saved, "randomizer.drawn": np.concatenate([drawn, rest], axis=1)}

    def check(self, saved: Mapping[str, np.ndarray]) -> None:
        """Refuse aircraft and numbers that this randomization does not draw.

        Raises:
            QuadrlError: The message names the array.
        """
        table, own = saved["engine.begun"], numbers(self._engine.begun)
        drawn = self.sampler.randomization.per_row and self.sampler.explains(table)
        if not (drawn or np.array_equal(table, own)):
            reason = "the state was saved with another aircraft"
            raise QuadrlError(reason, name="engine.begun", value=table, allowed="this aircraft's")
        if not self.active:
            return
        drawn, newest, left = (saved[f"randomizer.{k}"] for k in ("drawn", "newest", "left"))
        for name, value, within in (
            ("drawn", drawn, self.sampler.contains(drawn)),
            ("newest", newest, ((newest >= 0) & (newest < len(self.queue))).all()),
            ("left", left, ((left >= 0) & (left <= self.sampler.outage[1])).all()),
        ):
            if not within:
                allowed = "of an environment with the same randomization"
                raise QuadrlError(name=f"randomizer.{name}", value=value, allowed=allowed)

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        """Restore what `save` returned."""
        self.drawn = self.drawn.copy()
        for name, value in saved.items():
            getattr(self, name)[:] = value
        self._set_delay()
