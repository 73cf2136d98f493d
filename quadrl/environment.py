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
from quadrl.control import modes
from quadrl.engines import mujoco
from quadrl.engines.engine import Engine, EngineName
from quadrl.errors import QuadrlError
from quadrl.markers import Marker
from quadrl.parameters import Parameters
from quadrl.randomization import Ranges
from quadrl.rng import PARAMETERS, Rng, check_seed
from quadrl.rotation import Array
from quadrl.task import Snapshot, Task, layout
from quadrl.transition import Clock, Episode, Observation, Transition
from quadrl.vehicle import Vehicle, resolve

MOMENT = ("action", "rotor_command", "time")
"""Arrays of a snapshot that are its own."""


class Environment:
    """A task flown by N aircraft; a single one is N = 1."""

    snapshot: Snapshot
    """What tasks see now: live, valid until the next step."""

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
            QuadrlError: An unknown name, or a value that cannot be.
            NativeError: The rotor callbacks cannot be built or installed.
        """
        self.task = tasks.make(task)
        self.vehicle = engine.vehicle if isinstance(engine, Engine) else resolve(vehicle)
        self.ranges = Ranges(self.vehicle, ranges) if ranges else None
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
        self.engine, self.num_envs, self.origin = engine, engine.num_envs, engine.origin
        self.control_mode = modes.make(control_mode, self.vehicle)
        self.action_size = self.control_mode.size
        timestep = self.vehicle.control_timestep
        self.time_limit_steps = max(1, round(self.task.time_limit / timestep))
        settle = min(max(1, round(self.task.settle_time / timestep)), self.time_limit_steps)
        self._clock = Clock(timestep, self.time_limit_steps, settle)
        nominal = Parameters.of(parameters.rows(self.vehicle), timestep)
        nominal = nominal.map(np.ascontiguousarray)  # NumPy is faster with these
        height = float(self.origin[2])
        self.term_names = transition.check_task(self.task, nominal, self.action_size, height)
        """Names of the reward's terms, in their order."""
        self.layout = layout(self.task.observation, self.vehicle.rotor_count)
        """Where each named term of the observation stands in the flat vector."""
        self.size = max(part.stop for part in self.layout.values())
        self._true = self.task.true_parameters and self._per_row
        self._parameters = Parameters.of(engine.parameters, timestep) if self._true else nominal
        self._keys = np.zeros(self.num_envs, dtype=np.int64)  # (N,) seed of each row
        self._episodes = np.zeros(self.num_envs, dtype=np.int64)  # (N,) begun since it was seeded
        self._episode: Episode | None = None
        self._setpoint: Any = None
        self._command: Any = None
        self._flown = 0  # physics steps of this control step that the mode's loops have flown
        self._diverged: np.ndarray | None = None  # in them
        self.seed(seed)

    def seed(self, seed: int | None = None, rows: np.ndarray | None = None) -> int:
        """Begin the episodes of a seed anew: row i gets seed + i; rows (n,) or None for all.

        Raises:
            QuadrlError: The seed is no whole number from 0 on.
        """
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        seed = check_seed(seed)
        rows = np.arange(self.num_envs) if rows is None else validation.rows(rows, self.num_envs)
        self._keys[rows], self._episodes[rows] = seed + rows, 0
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
        rows = np.arange(self.num_envs) if rows is None else validation.rows(rows, self.num_envs)
        if self._episode is None and len(rows) < self.num_envs:
            raise RuntimeError("the first reset must be of every aircraft")
        place = self._keys[rows], self._episodes[rows]
        seen = self._draw(rows, Rng(*place, PARAMETERS))
        start, task_state = self.task.begin(Rng(*place), seen)
        state = self.engine.place(rows, start)
        if self.ranges is not None:
            self.engine.air[rows] = self._air
        now, episode = transition.begin(self.task, state, task_state, seen, self.action_size)
        self._episodes[rows] += 1
        if len(rows) == self.num_envs:
            now.parameters = self._parameters
            self._keep(now)
            self._episode = episode
        else:
            records.put(self.snapshot, rows, now)
            records.put(self._episode, rows, episode)
        return self.task.observe(now)

    def _draw(self, rows: np.ndarray, rng: Rng) -> Parameters:
        """Draw the parameters of rows that begin; returns those that the task may see."""
        if self.ranges is None:
            return self._parameters
        table, self._air = self.ranges.draw(rng, len(rows))
        if self._per_row:
            self.engine.write_parameters(rows, table)
        return (
            Parameters.of(table, self._clock.control_timestep) if self._true else self._parameters
        )

    def _keep(self, now: Snapshot) -> None:
        """Take a snapshot as the present one."""
        if self._episode is None or now.task is not self.snapshot.task:
            # What a task remembers must not be a view of buffers that the next steps write.
            now.task = records.owned(now.task)
        self.snapshot = now

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
        self._action = action = validation.action(action, (self.num_envs, self.action_size))
        self._setpoint = self.control_mode.setpoint(self.engine.state, action)
        self._flown, self._diverged = 0, None
        if self.control_mode.has_loops:
            self._command = np.zeros_like(self.engine.ctrl)
            # The loops read the state at every physics step, past the life of its buffers.
            self.snapshot = records.copied(self.snapshot)
        else:
            self._command = self.engine.ctrl[:] = self._setpoint

    def control(self) -> None:
        """Before each physics step of a control mode with loops: the commands to the rotors.

        The reward sees their mean over the control step.
        """
        if self._flown:
            self._note(self.engine.read())
        command = self.control_mode.rotor_command(self.engine.state, self._setpoint)
        self.engine.ctrl[:] = command
        self._command += command / self.vehicle.substeps
        self._flown += 1

    def _note(self, diverged: np.ndarray | None) -> None:
        if diverged is not None:
            self._diverged = diverged if self._diverged is None else self._diverged | diverged

    def finish(self) -> Transition:
        """Second half of a step, after the engine has advanced."""
        self._note(self.engine.read())
        assert self._episode is not None
        now, self._episode, done = transition.finish(
            *(self.task, self._clock, self._episode, self.snapshot, self.engine.state),
            *(self._action, self._command, self._diverged),
        )
        if np.count_nonzero(np.isfinite(done.reward)) < self.num_envs:
            row = int(np.flatnonzero(~np.isfinite(done.reward))[0])
            values = {name: float(term[row]) for name, term in done.reward_terms.items()}
            name = f"{self.task.name} reward of aircraft {row}"
            raise QuadrlError(name=name, value=values, allowed="finite in every term")
        self._keep(now)
        return done

    def flatten(self, observation: Observation) -> np.ndarray:
        """The terms of an observation as vectors (n, size), float32."""
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
        name = "engine.parameters"
        if not (self._per_row or np.array_equal(saved[name], own[name])):
            reason = "what was saved is of another aircraft"
            raise QuadrlError(reason, name=name, value=saved[name], allowed="this aircraft's")
        prefix = "engine."
        self.engine.restore({k[len(prefix) :]: v for k, v in saved.items() if k.startswith(prefix)})
        self._keys[:], self._episodes[:] = saved["keys"], saved["episodes"]
        self._episode = episode = records.of_arrays("episode", self._episode, saved)
        episode.longest = int(episode.steps.max())
        task_state = records.of_arrays("task", self.snapshot.task, saved)
        action, command, time = (np.array(saved[name]) for name in MOMENT)
        now = Snapshot(self.engine.state, task_state, self._parameters, action, command, time)
        now.potentials = self.task.measure(now)
        self._keep(now)
        return self.task.observe(now)
