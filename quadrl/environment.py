"""The core of every API: a task and an engine make transitions.

An environment owns N rows: seeds, episodes, and the snapshot that the engine and the pure
functions of `quadrl.transition` bring forward. It resets what it is told to and never by itself.
Row i of a batch seeded with s is the single environment seeded with s + i.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from quadrl import parameters, records, tasks, transition, validation
from quadrl.compiled import MOMENT, CompiledStep
from quadrl.control import modes
from quadrl.engines import mujoco
from quadrl.engines.engine import Engine, EngineName
from quadrl.errors import QuadrlError
from quadrl.markers import Marker
from quadrl.parameters import Parameters
from quadrl.randomization import Ranges, check_saved
from quadrl.rng import PARAMETERS, Rng, check_seed
from quadrl.rotation import Array
from quadrl.task import Snapshot, Task, layout
from quadrl.transition import Clock, Episode, Observation, Transition
from quadrl.vehicle import Vehicle, resolve


class Environment:
    """A task flown by N aircraft; a single one is N = 1."""

    def __init__(
        self,
        task: str | Task,
        *,
        num_envs: int = 1,
        seed: int | None = None,
        vehicle: Vehicle | str | None = None,
        num_threads: int = 0,
        engine: EngineName | Engine = "mujoco",
        control_mode: str = "rotor",
        ranges: Mapping[str, Any] | None = None,
    ) -> None:
        """Make the engine and seed the rows.

        Args:
            task: A name of the catalogue or a task.
            num_envs: Number of aircraft N.
            seed: Row i is seeded with seed + i; None draws one from the system.
            vehicle: The aircraft or its name; None for the paper's.
            num_threads: Threads of a batch; 0 for every core.
            engine: "mujoco", "free_flight" (wherever there is nothing to touch), or an engine that
                is made already, whose vehicle and N count then.
            control_mode: What actions mean, a name of `control.modes.CONTROL_MODES`.
            ranges: Parameters and wind that are drawn for each row at each reset, as
                `quadrl.randomization.Ranges` takes them.

        Raises:
            QuadrlError: An unknown name or an impossible value.
            NativeError: The rotor callbacks cannot be built or installed.
        """
        self.task = tasks.make(task)
        self.vehicle = engine.vehicle if isinstance(engine, Engine) else resolve(vehicle)
        self.ranges = None if ranges is None else Ranges(self.vehicle, ranges)
        self._per_row = self.ranges is not None and self.ranges.per_row
        if not isinstance(engine, Engine):
            engine = mujoco.make(
                engine,
                self.vehicle,
                num_envs,
                altitude=max(self.task.altitude, self.vehicle.ground_clearance),
                contact=self.task.contact,
                scene=self.task.scene,
                num_threads=num_threads,
                per_row=self._per_row,
            )
        elif self._per_row and len(engine.parameters) < engine.num_envs:
            allowed = "made with per_row=True, since there are ranges"
            raise QuadrlError(name="engine", value=engine, allowed=allowed)
        self.engine, self.num_envs, self.origin = engine, engine.num_envs, engine.origin
        self.control_mode = modes.make(control_mode, self.vehicle)
        self.action_size = self.control_mode.size
        timestep = self.vehicle.control_timestep
        self.time_limit_steps = max(1, round(self.task.time_limit / timestep))
        settle = min(max(1, round(self.task.settle_time / timestep)), self.time_limit_steps)
        self._clock = Clock(timestep, self.time_limit_steps, settle)
        self._true = self.task.true_parameters and self._per_row
        nominal = parameters.rows(self.vehicle)
        self._rows = engine.parameters if self._true else nominal  # those that the task sees
        self._parameters, seen = (Parameters.of(k, timestep) for k in (self._rows, nominal))
        self.term_names = transition.check_task(self.task, seen, self.action_size, self.origin[2])
        """Names of the reward's terms, in their order."""
        self.layout = layout(self.task.observation, self.vehicle.rotor_count)
        """Where each named term of the observation stands in the flat vector."""
        self.size = max(part.stop for part in self.layout.values())
        self._all = np.arange(self.num_envs)
        self._keys = np.zeros(self.num_envs, dtype=np.int64)  # (N,) seed of each row
        self._episodes = np.zeros(self.num_envs, dtype=np.int64)  # (N,) begun since it was seeded
        self._episode: Episode | None = None
        self._snapshot: Snapshot | None = None
        self.compiled: CompiledStep | None = None
        """The task's step in C from the first reset on; None where it cannot be compiled."""
        self.not_compiled = ""  # why
        self._action = np.zeros((self.num_envs, self.action_size))
        self._command = np.zeros((self.num_envs, self.vehicle.rotor_count))  # [rad/s]
        self._setpoint: Any = None
        self._flown = 0  # physics steps of this control step that the mode's loops have flown
        self._diverged = np.zeros(self.num_envs, dtype=bool)  # in this control step
        self.seed(seed)

    def seed(self, seed: int | None = None, rows: np.ndarray | None = None) -> int:
        """Begin the episodes of a seed anew: row i gets seed + i; rows (n,) or None for all.

        Raises:
            QuadrlError: The seed is not a whole number from 0 on.
        """
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        seed = check_seed(seed)
        chosen = self._all if rows is None else validation.rows(rows, self.num_envs)
        self._keys[chosen], self._episodes[chosen] = seed + chosen, 0
        return seed

    def reset(self, rows: np.ndarray | None = None) -> Observation:
        """Begin an episode.

        Args:
            rows: Numbers (n,) or mask (N,) of the aircraft that begin one; None for all.

        Returns:
            The observation of those aircraft, terms (n, k).

        Raises:
            QuadrlError: A number of an aircraft that is not there, or one twice; or the task gives
                arrays of the wrong shape, or a start that no aircraft can have.
        """
        rows = self._all if rows is None else validation.rows(rows, self.num_envs)
        if self._episode is None and len(rows) < self.num_envs:
            raise RuntimeError("the first reset must be of every aircraft")
        place = self._keys[rows], self._episodes[rows]
        seen, air = self._parameters, None
        if self.ranges is not None:
            table, air = self.ranges.draw(Rng(*place, PARAMETERS), len(rows))
            if self._per_row:
                self.engine.write_parameters(rows, table)
            if self._true:
                seen = Parameters.of(table, self._clock.control_timestep)
        start, task_state = self.task.begin(Rng(*place), seen)
        state = self.engine.place(rows, start)
        if air is not None:
            self.engine.air[rows] = air
        now, episode = transition.begin(self.task, state, task_state, seen, self.action_size)
        self._episodes[rows] += 1
        if len(rows) == self.num_envs:
            self._take(now, episode)
        else:
            records.put(self.snapshot, rows, now)
            records.put(self._episode, rows, episode)
        return self.task.observe(now)

    @property
    def snapshot(self) -> Snapshot:
        """What tasks see now: live, valid until the next step."""
        if self._snapshot is None:
            assert self.compiled
            self._snapshot, self._episode = self.compiled.snapshot()
        return self._snapshot

    def _take(self, now: Snapshot, episode: Episode) -> None:
        """Take a snapshot of all rows as the present one."""
        # What a task remembers must not be a view of buffers that the next steps write.
        now.task, now.parameters = records.owned(now.task), self._parameters
        if self._episode is None and self.task.compiled:
            inputs = self._action, self._command, self._diverged
            loops = self.control_mode.has_loops
            rows = self.engine, self._rows, inputs
            try:
                self.compiled = CompiledStep(self.task, self._clock, *rows, now, episode, loops)
            except Exception as error:  # whatever the functions of a task raise
                self.not_compiled = str(error)
        self._snapshot, self._episode = now, episode
        if self.compiled:
            self.compiled.begin(now, episode)
            self._snapshot = None

    def step(self, action: Array) -> Transition:
        """Fly one control step.

        Args:
            action: (N, k), clipped to [-1, 1]; the control mode says what it means.

        Returns:
            The transition. An aircraft whose episode is over flies on until it is reset.

        Raises:
            QuadrlError: Wrong shape or kind, or a number that is not finite; or the task gave a
                reward that is not finite.
            RuntimeError: There was no reset before.
        """
        self.begin(action)
        if self.control_mode.has_loops:
            for _ in range(self.vehicle.substeps):
                self.control()
                self.engine.advance(1)
        else:
            self.engine.advance(self.vehicle.substeps)
        return self.finish()

    def begin(self, action: Array) -> None:
        """First half of a step: the commands to the rotors, or the setpoint of the loops."""
        if self._episode is None:
            raise RuntimeError("call reset before the first step")
        self._action[:] = validation.action(action, (self.num_envs, self.action_size))
        self._setpoint = self.control_mode.setpoint(self.engine.state, self._action)
        self._flown, self._diverged[:] = 0, False
        if self.control_mode.has_loops:
            self._command[:] = 0.0
            if not self.compiled:
                # The loops read the state at every physics step, past the life of its buffers.
                self._snapshot = records.copied(self._snapshot)
        else:
            self._command[:] = self.engine.ctrl[:] = self._setpoint

    def control(self) -> None:
        """Command the rotors before each physics step of a mode with loops; their mean counts."""
        if self._flown and (diverged := self.engine.read()) is not None:
            self._diverged |= diverged
        command = self.control_mode.rotor_command(self.engine.state, self._setpoint)
        self.engine.ctrl[:] = command
        self._command += command / self.vehicle.substeps
        self._flown += 1

    def finish(self) -> Transition:
        """Second half of a step, after the engine has advanced."""
        if (diverged := self.engine.read()) is not None:
            self._diverged |= diverged
        assert self._episode is not None
        if self.compiled:
            done, self._snapshot = self.compiled.finish(), None
        else:
            self._snapshot, self._episode, done = transition.finish(
                *(self.task, self._clock, self._episode, self.snapshot, self.engine.state),
                *(self._action.copy(), self._command.copy(), self._diverged.copy()),
            )
            self._snapshot.task = records.owned(self._snapshot.task)
        if np.count_nonzero(np.isfinite(done.reward)) < self.num_envs:
            row = int(np.flatnonzero(~np.isfinite(done.reward))[0])
            values = {name: float(term[row]) for name, term in done.reward_terms.items()}
            name = f"{self.task.name} reward of aircraft {row}"
            raise QuadrlError(name=name, value=values, allowed="finite in every term")
        return done

    def flatten(self, observation: Observation) -> np.ndarray:
        """The terms of an observation as vectors (n, size), float32."""
        if self.compiled and observation is self.compiled.observation:
            return self.compiled.flat()
        return np.concatenate(list(observation.values()), axis=-1, dtype=np.float32)

    def goals(self) -> np.ndarray:
        """Where each aircraft should be, (N, 3) [m], world frame."""
        return self.task.goal(self.snapshot) + self.origin

    def markers(self, row: int = 0) -> tuple[Marker, ...]:
        """What the task asks to be drawn of one aircraft's episode, world frame."""
        alone = records.mapped(lambda array: array[row : row + 1], self.snapshot)
        return tuple(marker.moved(self.origin) for marker in self.task.markers(alone))

    def save(self) -> dict[str, np.ndarray]:
        """Everything that the next steps depend on, as arrays: `restore` continues bit for bit."""
        if self._episode is None:
            raise RuntimeError("call reset before save")
        now = self.snapshot
        saved = {f"engine.{name}": value for name, value in self.engine.save().items()}
        saved |= records.arrays("task", now.task) | records.arrays("episode", self._episode)
        saved |= {name: np.array(getattr(now, name)) for name in MOMENT}
        return saved | {"keys": self._keys.copy(), "episodes": self._episodes.copy()}

    def restore(self, saved: dict[str, np.ndarray]) -> Observation:
        """Take up what `save` gave; returns the observation of that moment.

        Raises:
            QuadrlError: It is not of such an environment; nothing has changed then.
        """
        if self._episode is None:
            self.reset()  # makes the records, which are filled below
            self._episodes[:] = 0  # this episode does not count
        own = self.save()
        records.check_alike(saved, own)
        check_saved(self.ranges, saved, own)
        self.engine.restore({key.removeprefix("engine."): saved[key] for key in saved})
        self._keys[:], self._episodes[:] = saved["keys"], saved["episodes"]
        episode = records.of_arrays("episode", self._episode, saved)
        task_state = records.of_arrays("task", self.snapshot.task, saved)
        action, command, time = (np.array(saved[name]) for name in MOMENT)
        now = Snapshot(self.engine.state, task_state, self._parameters, action, command, time)
        now.potentials = self.task.measure(now)
        self._take(now, episode)
        return self.task.observe(now)
