"""The core of every API: a task and an engine make transitions.

An environment owns N rows: seeds, episodes, and the snapshot that the engine and the pure
functions of `core/transition.py` bring forward. It never resets a row by itself.
Row i of a batch seeded with s is the single environment seeded with s + i.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, Unpack, cast

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base import machine, records, validation
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import SOLIDS, Seed
from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array
from quadrl.conditions.event_process import Events, scales
from quadrl.conditions.observing import Observing
from quadrl.conditions.randomization import NONE
from quadrl.conditions.randomizer import Randomizer
from quadrl.conditions.sampler import AircraftSampler
from quadrl.conditions.scene import Scene
from quadrl.conditions.weather import WeatherProcess
from quadrl.conditions.world import World
from quadrl.control import modes
from quadrl.control.autopilot import Autopilot
from quadrl.control.trim import trimmed
from quadrl.core import rules, saving, transition
from quadrl.core.compiled import compiled, sources
from quadrl.core.markers import Marker
from quadrl.core.observation import layout
from quadrl.core.observer import Observer
from quadrl.core.scenario import KEYWORDS, Conditions, Scenario
from quadrl.core.senses import Senses
from quadrl.core.step import Inputs, Step, WrittenStep
from quadrl.core.task import Snapshot, Task
from quadrl.core.transition import Clock, Episode, Observation, Transition
from quadrl.engines import mujoco
from quadrl.engines.engine import Engine
from quadrl.engines.rng import Rng
from quadrl.engines.state import Start

LIVE = ("seeds", "transition")
"""Attributes of an environment that are no part of what it was made of."""


class Environment(saving.Copied):
    """A task flown by N aircraft; a single one is N = 1."""

    def __init__(
        self,
        task: str | Task | Scenario | Mapping[str, Any],
        *,
        num_envs: int = 1,
        seed: Seed = None,
        num_threads: int = 0,
        **conditions: Unpack[Conditions],
    ) -> None:
        """Make the engine and seed the rows.

        Args:
            task: A name of the catalogue, a task, or a whole scenario, as `Scenario.of` takes it.
            num_envs: Number of aircraft N.
            seed: As `seed` takes it.
            num_threads: Threads of a batch; 0 for every core.
            **conditions: As `quadrl.core.scenario.Conditions` has them. Of an engine that is made
                already, vehicle and N count.

        Raises:
            QuadrlError: An unknown name or an impossible value.
            NativeError: The rotor callbacks cannot be built or installed.
        """
        if isinstance(engine := conditions.get("engine"), Engine):
            conditions["engine"] = engine.name
        self.scenario = Scenario.of(task, **conditions)
        """What is flown and how."""
        if isinstance(engine, Engine) and engine.vehicle != self.scenario.aircraft:
            flown = engine.vehicle
            own: Any = {"vehicle": flown, "aerodynamics": flown.aerodynamics}
            self.scenario = dataclasses.replace(self.scenario, **own)
        self.task, self.vehicle = self.scenario.task, self.scenario.aircraft
        self.observing, self.weather = self.scenario.observe, self.scenario.weather
        sampler = AircraftSampler(self.scenario.randomization, self.vehicle)
        self.randomization = sampler.randomization
        per_row = self.randomization.per_row or scales(self.scenario.events)
        if not isinstance(engine, Engine):
            validation.number("num_envs", num_envs, 1, mujoco.MAX_ENVS, whole=True)
            single = row_memory(self.task, self.vehicle, sampler, self.observing, per_row)
            machine.check_memory(f"num_envs = {num_envs}", num_envs * single)
            world = self.vehicle, self.scenario.compile_model(drawn=False), num_envs
            settings: Any = {"num_threads": num_threads, "per_row": per_row}
            altitude = self.scenario.altitude
            engine = mujoco.make(self.scenario.engine, *world, altitude=altitude, **settings)
        elif per_row and len(engine.parameters) < engine.num_envs:
            allowed = "made with per_row=True, since aircraft differ"
            raise QuadrlError(name="engine", value=engine, allowed=allowed)
        self.engine, self.num_envs, self.origin = engine, engine.num_envs, engine.origin
        self.control_mode = modes.kind(self.scenario.control_mode)(self.vehicle)
        self.action_size = self.control_mode.size
        timestep = self.vehicle.control_timestep
        self._clock = Clock.of(self.task, timestep)
        self.time_limit_steps = self._clock.time_limit_steps
        lasts = self.time_limit_steps * timestep
        self.sees_true_parameters = self.task.true_parameters and self.randomization.per_row
        nominal = parameters.rows(self.vehicle)
        self.seen_rows = engine.parameters if self.sees_true_parameters else nominal
        """Rows of parameters, (N,) or (1,), that the task sees; live."""
        self._parameters, seen = (Parameters.of(k, timestep) for k in (self.seen_rows, nominal))
        checked = rules.check_values(self.task, seen, self.action_size, self.origin[2])
        self.term_names, self.end_names = checked
        """Names of the reward's terms, and of what ends episodes, in their order."""
        senses = self.observing != Observing() or bool(self.task.sensors)
        active = senses or self.randomization != NONE
        self.randomizer = Randomizer(sampler, engine, active=active)
        self.blowing = WeatherProcess.of(self.weather, engine, lasts)
        self.events: Events | None = None  # what happens in flight, where something does
        if happening := self.scenario.events:
            given = engine, sampler, lasts
            self.events = Events(happening, *given, calm=self.blowing is None)
        self.observer: Observer | None = None  # the task then observes the true state
        if senses or self.randomization.uncertain:
            happening = self.events.width if self.events else 0
            flown = self.observing, self.task, self.vehicle, self.action_size, sampler, happening
            senses = Senses(*flown, self.origin, loops=self.control_mode.has_loops)
            self.observer = Observer(senses, engine, self.randomizer, self.events)
        rays = self.observer.senses.rays if self.observer else {}
        self.scene = Scene(self.task.solids(), rays)
        self.scene.check(engine)
        terms = self.observer.senses.terms if self.observer else self.task.observation
        self.layout = layout(terms, self.vehicle.rotor_count)
        """Where each named term of the observation stands in the flat vector."""
        self.size = max(part.stop for part in self.layout.values())
        self._solids_move = self.task.moves
        self._solids_leave = self._solids_move or type(self.task).place is not Task.place
        if self.scene.solids and not self._solids_leave:
            declared = self.scene.poses({}, self.num_envs, self.origin)
            engine.solids.place(np.arange(self.num_envs), declared)
        self.stepwise = self.control_mode.has_loops or self.randomizer.late or self._solids_move
        """Whether a control step is flown in parts, which `control` prepares."""
        self.plain = not (self.randomizer.active or self.observer or self.scene.solids)
        self.plain &= not self.weather.wind_speed
        """Whether an episode begins as the task says, and nothing else begins with it."""
        follows = self.control_mode.has_loops and bool(self.observer and self.observer.follows)
        self._parted = self._solids_move or follows
        """Whether Python acts within a control step."""
        acting = self.randomizer, self.blowing, self.events, self.observer
        self._processes = [process for process in acting if process]
        self._all = np.arange(self.num_envs)
        self.seeds = saving.Seeds(*np.zeros((2, self.num_envs), np.int64))
        """Which episode each row flies."""
        self._step: Step | None = None  # from the first reset on
        taken, self._still = np.zeros((2, self.num_envs, self.action_size))
        self._inputs = Inputs(taken, np.zeros(engine.ctrl.shape), np.zeros(self.num_envs, bool))
        self.transition: Transition | None = None  # what the last step gave
        loops, given = self.control_mode.has_loops, (self.control_mode, engine, self._inputs.action)
        self.autopilot = Autopilot(*given) if loops else None
        """What flies the loops of the control mode; None where it has none."""
        self._flown = 0  # physics steps of this control step that `control` has commanded
        self._moves: list[np.ndarray] = []  # where solids are after each of its physics steps
        self.seed(seed)
        # Attributes that stay, and those that would be taken for options.
        self._made = frozenset(vars(self)).difference(LIVE).union(self.options)

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuse to assign to what an environment was made of: the rest of it would not follow."""
        made = vars(self).get("_made")
        if made and name[0] != "_" and name in made:
            allowed = f"given to `change`, as in change({name}=...), before a reset"
            raise QuadrlError(name=name, value=value, allowed=allowed)
        super().__setattr__(name, value)

    @property
    def options(self) -> tuple[str, ...]:
        """Keywords of `change`: conditions, and options of the task."""
        return (*KEYWORDS, *(field.name for field in dataclasses.fields(self.task)))

    def change(self, **conditions: Any) -> None:
        """Change options of the task or conditions; the next call has to be a reset of all rows.

        The episodes that follow are the next ones of the rows' seeds.

        Args:
            **conditions: What differs, as `Scenario.of` takes it.

        Raises:
            QuadrlError: A name is unknown, a value is impossible, or it takes another observation,
                action, reward or control step. Nothing has changed then.
        """
        scenario, given = Scenario.of(self.scenario, **conditions), self._made_with[1]
        held = isinstance(given.get("engine"), Engine)
        again = {k: given[k] for k in ("engine", "num_threads")[not held :] if k in given}
        fresh = Environment(scenario, num_envs=self.num_envs, **again)

        def kept(made: Environment, flown: Scenario) -> tuple[Any, ...]:
            seen, acts = (made.layout, made.term_names), (flown.control_mode, made.action_size)
            world = type(flown.task), flown.aircraft, flown.engine, flown.altitude
            return *seen, *acts, flown.vehicle.control_timestep, *(world if held else ())

        if kept(fresh, scenario) != kept(self, self.scenario):
            also = ", aircraft, engine and altitude, which are its engine's" if held else ""
            allowed = f"such that observation, action, reward and control step{also} stay"
            raise QuadrlError("make another one", name="change", value=conditions, allowed=allowed)
        fresh.seeds = self.seeds
        vars(self).clear()
        vars(self).update(vars(fresh))

    def seed(self, seed: Seed = None) -> Seed:
        """Let the next reset begin the first episode of a seed; return the seed.

        Args:
            seed: With a number row i gets seed + i; with a sequence seed[i], or keeps its own where
                that is None. Without one the operating system gives a number.

        Raises:
            QuadrlError: A seed is not a whole number from 0 on, or there are not N of them.
        """
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        self.seeds = self.seeds.renewed(seed, self._all)
        return seed

    def reset(
        self,
        rows: np.ndarray | None = None,
        start: Mapping[str, Any] | None = None,
        seed: Seed = None,
    ) -> Observation:
        """Begin an episode.

        In a mean wind, a start at rest and level becomes one in trim with the same heading.

        Args:
            rows: Numbers (n,) or mask (N,) of the aircraft that begin one; None for all.
            start: Arrays (N, k) or (k,) by names of `engines.state.Start`, in place of the task's.
            seed: A new seed for those aircraft, as `seed` takes it; None to keep their seeds.

        Returns:
            The observation of those aircraft, terms (n, k).

        Raises:
            QuadrlError: A number of an aircraft is out of range or occurs twice, the task gives
                arrays of the wrong shape, or no aircraft can have that start. Nothing has changed
                then.
        """
        if self.engine.forked:
            self.make_anew()
        rows = self._all if rows is None else validation.rows(rows, self.num_envs)
        if self._step is None and len(rows) < self.num_envs:
            raise RuntimeError("the first reset must be of every aircraft")
        if not len(rows):
            return {name: np.zeros((0, at.stop - at.start)) for name, at in self.layout.items()}
        seeds = self.seeds if seed is None else self.seeds.renewed(seed, rows)
        place = seeds.keys[rows], seeds.episodes[rows]
        if self.plain and not start and self._step is not None:
            if (observation := self._step.start(rows, *place)) is not None:
                self.seeds = seeds
                for process in self._processes:
                    process.begin(rows, *place, self.randomizer.sample(*place))
                self.seeds.episodes[rows] += 1
                return observation
        drawn, seen = self.randomizer.sample(*place), self._parameters
        if drawn.table is not None and self.sees_true_parameters:
            seen = Parameters.of(drawn.table, self._clock.control_timestep)
        begun, task_state = self.task.begin(Rng(*place), seen)
        # Up to here nothing is written, and `place` refuses before it writes.
        begun = begun.replaced(start or {}, rows, self.num_envs)
        if start:
            self._refuse_underground(start, begun)
        if self.blowing and self.weather.wind_speed and not {*(start or ())} - {"position"}:
            height = begun.position[:, 2] + self.origin[2]
            mean = self.blowing.mean_wind(*place, height, drawn)
            begun = trimmed(self.vehicle, begun, mean)
        task_state = self.task.remember(begun, task_state)
        poses = None  # of the solids, where they do not stay
        if self._solids_leave:
            placed = self.task.place(Rng(*place, SOLIDS), begun, task_state)
            poses = self.scene.poses(placed, len(rows), self.origin)
        # Practice of a task in which they touch may begin in one, and is over at once.
        if self.scene.solids and ("position" in (start or ()) or not self.task.contact):
            self.scene.check_start(self.engine, rows, begun, poses)
        state = self.engine.place(rows, begun, drawn.table, poses)
        self.seeds = seeds
        for process in self._processes:
            process.begin(rows, *place, drawn)
        world, observer, still = self._world(rows), self.observer, self._still
        look = observer.look(state, still[: len(rows)], world, rows) if observer else None
        given = task_state, seen, self.action_size, world, look
        now, episode, observation = transition.begin(self.task, state, *given)
        if observer and look:
            observer.keep(look.after, rows)
        self.seeds.episodes[rows] += 1
        if len(rows) == self.num_envs:
            self._take(now, episode)
        else:
            records.put(self.snapshot, rows, now)
            records.put(self.episode, rows, episode)
            self.snapshot.sensed = self.sensed
        return observation

    def _refuse_underground(self, given: Mapping[str, Any], start: Start) -> None:
        """Refuse a position that was given if it is below the ground."""
        lowest = -float(self.origin[2])  # [m], from the origin of the task's frame
        if "position" in given and (start.position[:, 2] < lowest).any():
            allowed = f"above the ground, at z of at least {lowest:g}"
            raise QuadrlError(name="position", value=given["position"], allowed=allowed)

    @property
    def snapshot(self) -> Snapshot:
        """What tasks see now: live, valid until the next step."""
        return self.control_step.snapshot

    @property
    def episode(self) -> Episode:
        """How far the episodes are: as live as the snapshot."""
        return self.control_step.episode

    @property
    def has_begun(self) -> bool:
        """Whether there was a reset."""
        return self._step is not None

    @property
    def control_step(self) -> Step:
        """Its control step, from the first reset on."""
        if self._step is None:
            raise RuntimeError("call reset first: there is no episode yet")
        return self._step

    @property
    def not_compiled(self) -> str:
        """Why the task's step is not compiled; empty where it is, from the first reset on."""
        return self.control_step.not_compiled

    def written(self) -> WrittenStep:
        """Its control step as it is written, before a reset begins it."""
        flown = self.engine, self._inputs, self.observer, self.control_mode.has_loops
        return WrittenStep(self.task, self._clock, *flown, self.randomizer)

    def sources(self) -> list[str]:
        """The C of its control step, while that runs as it is written."""
        return sources(cast(WrittenStep, self.control_step), self.seen_rows, self.control_mode)

    def _take(self, now: Snapshot, episode: Episode) -> None:
        """Make a snapshot of all rows the present one."""
        # What a task remembers must not be a view of buffers that the next steps write.
        now.task, now.parameters = records.owned(now.task), self._parameters
        now.sensed = self.sensed
        if self._step is None:
            self._step = compiled(self.written(), now, episode, self.seen_rows, self.control_mode)
        self._step.begin(now, episode)

    def step(self, action: Array) -> Transition:
        """Fly one control step.

        Args:
            action: (N, k), clipped to [-1, 1]; the control mode defines its meaning.

        Returns:
            The transition. An aircraft whose episode is over flies on until it is reset.

        Raises:
            QuadrlError: Wrong shape or kind, or a number that is not finite; or the task gave a
                reward that is not finite.
            RuntimeError: There was no reset before.
        """
        _ = self.control_step  # refuse what has not begun; it may be made anew now
        self._accept(action)
        if not self._parted and self.control_step.fly():
            return self.finish()
        self._command()
        for steps in self.commands():
            self.engine.advance(steps)
        return self.finish()

    def commands(self) -> Iterator[int]:
        """Command the rotors through a control step that `begin` began.

        Yields:
            For how many physics steps, which the engine flies before the next command.
        """
        left = self.vehicle.substeps
        while left:
            steps = self.control(left) if self.stepwise else left
            yield steps
            left -= steps

    def _accept(self, action: Array) -> None:
        """Take the action of a control step that begins, and let the conditions act."""
        if self.engine.forked:
            self.make_anew()
        taken = self._inputs.action
        self._moves = self._solids_ahead() if self._solids_move else []
        taken[:] = validation.action(action, (self.num_envs, self.action_size))
        for process in self._processes:
            process.act()
        self.engine.check_air()
        if self.scene.solids:
            self.engine.hits[:] = 0.0
        self._flown, self._inputs.diverged[:] = 0, False

    def begin(self, action: Array) -> None:
        """Do the first half of a step: command the rotors, or set the setpoint of the loops."""
        self._accept(action)
        self._command()

    def _command(self) -> None:
        taken, command = self._inputs.action, self._inputs.command
        if self.autopilot:
            command[:] = 0.0
            self.autopilot.begin()
        else:
            command[:] = self.control_mode.values(taken)
            self.engine.command(command)

    def control(self, most: int) -> int:
        """Command the rotors and move the solids, where that happens within a control step.

        Returns:
            For how many physics steps, of `most` that are left.
        """
        command, steps = self._inputs.command, min(most, self.randomizer.held[self._flown])
        if self.autopilot:
            command, steps = self.autopilot.command(), 1
            self._inputs.command[:] += command / self.vehicle.substeps  # their mean counts
            if self.observer:
                self.observer.follow(command, self.vehicle.physics_timestep)
        if self._solids_move:
            steps = 1
            self.engine.solids.move(self._moves[self._flown], self.vehicle.physics_timestep)
        self._flown += steps
        self.engine.command(self.randomizer.delayed(command, steps))
        return steps

    def _solids_ahead(self) -> list[np.ndarray]:
        """Where solids are after each physics step of this control step, checked before it."""
        vehicle, last, poses = self.vehicle, self.engine.solids.poses, list[np.ndarray]()
        begun = self.episode.steps * vehicle.control_timestep
        for k in range(vehicle.substeps):
            placed = self.task.move(self.snapshot.task, begun + (k + 1) * vehicle.physics_timestep)
            made = self.scene.poses(placed, self.num_envs, self.origin, last)
            self.scene.check_move(last, made, vehicle.physics_timestep)
            poses.append(last := made)
        return poses

    def finish(self) -> Transition:
        """Do the second half of a step, after the engine has advanced."""
        self._read()
        done = self.control_step.finish(self._world())
        rules.check_reward(self.task, done)
        self.transition = done
        return done

    def _world(self, rows: np.ndarray | None = None) -> World | None:
        """The world about some aircraft (n,), or all; None where there is nothing to measure."""
        world = self.scene.world(self.engine, rows)
        return self.observer.ranged(world, rows) if self.observer and self.scene.rays else world

    def _read(self) -> None:
        """Compute the state, and note which aircraft have diverged."""
        if (diverged := self.control_step.read()) is not None:
            self.randomizer.forget(diverged)

    def flatten(self, observation: Observation) -> np.ndarray:
        """The terms of an observation as vectors (n, size), float32."""
        return self.control_step.flatten(observation)

    @property
    def privileged(self) -> Array | None:
        """The observation for the critic alone (N, p); None unless `observe` asks for it."""
        return self.observer.privileged if self.observer else None

    @property
    def sensed(self) -> Mapping[str, Array]:
        """What the sensors that `observe` or the task asks for give now, (N, size) by name."""
        return self.observer.sensed if self.observer else {}

    def goals(self) -> np.ndarray:
        """Where each aircraft should be, (N, 3) [m], world frame."""
        return self.task.goal(self.snapshot) + self.origin

    def markers(self, row: int = 0) -> tuple[Marker | Primitive, ...]:
        """What is drawn beside an aircraft, world frame: its task's markers, and the solids."""
        alone = records.mapped(lambda array: array[row : row + 1], self.snapshot)
        asked = (marker.moved(self.origin) for marker in self.task.markers(alone))
        return (*asked, *self.scene.primitives(self.engine, row))

    def happening(self, row: int = 0) -> str:
        """What pictures say of the events in the flight of an aircraft."""
        return self.events.told(row) if self.events else ""

    def memory(self) -> saving.Memory:
        """All that the next steps depend on, by parts."""
        begun, parts = self.control_step, self._processes
        return saving.Memory(self.engine, self.seeds, begun.snapshot, begun.episode, parts)

    def save(self) -> dict[str, np.ndarray]:
        """Return all that the next steps depend on, as arrays: `restore` continues bit for bit."""
        return self.memory().save()

    def restore(self, saved: Mapping[str, np.ndarray]) -> Observation:
        """Restore a state that `save` returned; return the observation of that moment.

        Raises:
            QuadrlError: It is the state of another environment; nothing has changed then.
        """
        if fresh := not self.has_begun:
            self.reset()  # makes the records, which are filled below
            self.seeds.episodes[:] = 0  # that episode does not count
        try:
            saved = self.memory().fitted(saved)
            self.memory().check(saved)
        except QuadrlError:
            self._step = None if fresh else self._step
            raise
        now, episode = self.memory().restore(saved)
        now.sensed = self.sensed
        now.world = self._world()
        now.potentials = self.task.measure(now)
        self._take(now, episode)
        return self.observer.again() if self.observer else self.task.observe(now)


def row_memory(
    task: Task, vehicle: Vehicle, sampler: AircraftSampler, seen: Observing, per_row: bool
) -> float:
    """Least memory that one more aircraft takes [bytes], as measured, plus that of histories."""
    rotors, (command, *ages) = vehicle.rotor_count, (most for _, most in sampler.delays.values())
    aged, late = max(ages), command + round(vehicle.dead_time / vehicle.physics_timestep)
    late += vehicle.substeps * (sampler.randomization.command_jitter[1] > 0)
    single = sum(term.width(rotors) for term in task.observation.values())
    sensors = seen.made(task.sensors)
    names = "observation_history", "action_history"
    observations, actions = (getattr(sensors.get(name), "length", 0) for name in names)
    kept = single * (1 + observations) + 13 * aged + rotors * max(late, aged)
    flat = single * (1 + observations) + rotors * actions
    return 3_000 + 5_000 * per_row + 8 * (kept + 2 * flat)
