"""Observations of N aircraft: the task's entries of the estimated state, sensors, histories."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, to_body
from quadrl.conditions.estimate import StateEstimate
from quadrl.conditions.observing import Observing
from quadrl.conditions.randomization import NONE
from quadrl.conditions.randomizer import Randomizer
from quadrl.conditions.sampler import AircraftSampler
from quadrl.conditions.sensors import Channel, Moment
from quadrl.core.observation import ObservationTerm, layout
from quadrl.core.snapshot import Snapshot
from quadrl.core.task import Task
from quadrl.core.transition import Transition, observe
from quadrl.engines.engine import Engine
from quadrl.engines.state import State


def make(
    sampler: AircraftSampler, options: Observing, task: Task, engine: Engine, actions: int
) -> tuple[Randomizer, Observer | None, Mapping[str, ObservationTerm]]:
    """Make the randomizer, the observer and the entries of the observation.

    Args:
        sampler: Samples what is drawn.
        options: Options of the observation.
        task: The task.
        engine: Flies the aircraft.
        actions: Numbers in an action.
    """
    given, observes = sampler.randomization, options != Observing() or bool(task.sensors)
    randomizer = Randomizer(sampler, engine, active=observes or given != NONE)
    observes |= given.uncertain or sampler.delays[1][1] > 0
    observer = Observer(options, task, engine, actions, randomizer) if observes else None
    return randomizer, observer, observer.terms if observer else task.observation


class Observer:
    """Observes N aircraft with errors, delays, further sensors and histories."""

    def __init__(
        self, options: Observing, task: Task, engine: Engine, actions: int, randomizer: Randomizer
    ) -> None:
        """Lay out the observation.

        Args:
            options: Options of the observation.
            task: The task.
            engine: Flies the aircraft.
            actions: Numbers in an action.
            randomizer: Randomizer of those aircraft.

        Raises:
            QuadrlError: The delay or the rate of a sensor does not fit the control step, or it has
                the name of an entry of the task.
        """
        self._task, self._engine, self._randomizer = task, engine, randomizer
        vehicle, rotors = engine.vehicle, engine.vehicle.rotor_count
        timestep, (count, _) = vehicle.control_timestep, engine.ctrl.shape
        self._specified = Parameters.of(parameters.rows(vehicle), timestep)
        sensors = options.made(task.sensors)
        modelled = options.rotor_speed == "estimated"
        modelled |= options.rotor_speed == "none" and "disturbance" in sensors
        uncertain = modelled or randomizer.sampler.randomization.uncertain
        self._estimate = StateEstimate(engine, randomizer, modelled=modelled) if uncertain else None
        self.frame = self._estimate and self._estimate.frame
        """Table of the estimated state; None where the true one is seen."""
        own = dict(task.observation)
        if options.rotor_speed == "none":
            own.pop("rotor_speed", None)
        self._own = tuple(own)
        entries = sensors.pop("state")
        width = sum(term.width(rotors) for term in own.values())
        self._entries = Channel(entries, width, randomizer, timestep)
        self._sensors, terms = {}, {}
        for name, sensor in sensors.items():
            if name in task.observation:
                allowed = f"a name that no entry of the task {task.name} has"
                raise QuadrlError(name="sensor", value=name, allowed=allowed)
            self._sensors[name] = Channel(sensor, sensor.width(actions), randomizer, timestep)
            meaning = str(type(sensor).__doc__).partition("\n")[0]
            terms[name] = ObservationTerm(sensor.width(actions), sensor.unit, meaning)
        self._late = [name for name in terms if sensors[name].measured]
        self._known = [name for name in terms if not sensors[name].measured]
        self.terms = own | {name: terms[name] for name in (*self._late, *self._known)}
        """The entries of the observation in the order of the flat vector."""
        self._further = options.observation_history
        single = width + sum(terms[name].size for name in self._late)
        if self._further:
            meaning = f"the {self._further} observations before, the newest first"
            self.terms["observation_history"] = ObservationTerm(self._further * single, "", meaning)
        self.layout = layout(self.terms, rotors)
        """Where each of them stands in it."""
        # The newest first: as many as the oldest that is looked at asks for.
        self._past = np.zeros((1 + randomizer.sampler.delays[1][1] + self._further, count, single))
        self._rows = np.arange(count)
        self.sensed: dict[str, Array] = {}
        """What the sensors give now, (N, size) by name."""
        self.observation: dict[str, Array] = {}
        """The last one, its entries views of `flat`."""
        self.flat = np.zeros((count, sum(part.stop - part.start for part in self.layout.values())))
        """The same as vectors."""
        self._critic = Critic(task, engine, randomizer) if options.privileged else None

    @property
    def privileged(self) -> Array | None:
        """The observation for the critic alone (N, p), where the options ask for it."""
        return self._critic and self._critic.seen

    def follow(self, command: Array, seconds: float) -> None:
        """Let the modelled rotor speeds follow commands (N, R) [rad/s] for a time [s]."""
        if self._estimate:
            self._estimate.follow(command, seconds)

    # ------------------------------------------------------------------------- the start

    def begin(self, rows: np.ndarray, now: Snapshot) -> dict[str, Array]:
        """The first observation of episodes (n,), from their snapshot (n, ...)."""
        state = self._estimate.begin(rows) if self._estimate else now.state
        moment = self._moment(now.state, state, self._engine.wind[rows], now.action)
        for channel in self._sensors.values():
            channel.begin(rows, moment)
        self._sensed()
        now.sensed = {name: array[rows] for name, array in self.sensed.items()}
        truth = self._task.observe(now)
        seen = observe(self._task, now, state) if self._estimate else truth
        moment.entries = self._joined(seen)
        self._entries.begin(rows, moment)
        past = self._past.copy()
        past[:, rows] = self._single()[rows]
        self._past = past
        if self._critic:
            self._critic.renew(truth, now.state, rows)
        flat = self._present()[rows]
        return {name: flat[:, part] for name, part in self.layout.items()}

    # ------------------------------------------------------------------------- each step

    def sense(self, action: Array) -> None:
        """Estimate the state and let the sensors measure, after a control step with an action."""
        true = self._engine.state
        state = self._estimate.update() if self._estimate else true
        self._now = self._moment(true, state, self._engine.wind, action)
        for channel in self._sensors.values():
            channel.step(self._now)
        self._sensed()

    def observe(self, done: Transition) -> dict[str, Array]:
        """The observation of all, from the transition that followed `sense`."""
        self._now.entries = self._joined(done.observation)
        self._entries.step(self._now)
        self._past = np.concatenate([self._single()[None], self._past[:-1]])
        if self._critic:
            self._critic.renew(done.truth, self._engine.state, self._rows)
        return self._show()

    def again(self, now: Snapshot) -> dict[str, Array]:
        """The present observation of all once more, after `restore`."""
        if self._critic:
            self._critic.renew(self._task.observe(now), now.state, self._rows)
        return self._show()

    # ------------------------------------------------------------------------- the parts

    def _moment(self, true: State, state: State, wind: Array, action: Array) -> Moment:
        return Moment(true, state, wind, action, self._specified, np.zeros((len(action), 0)), {})

    def _joined(self, entries: Mapping[str, Array]) -> Array:
        return np.concatenate([entries[name] for name in self._own], axis=-1)

    def _sensed(self) -> None:
        self.sensed = {name: channel.seen for name, channel in self._sensors.items()}

    def _single(self) -> Array:
        """What is measured at one moment, (N, single)."""
        sensed = (self.sensed[name] for name in self._late)
        return np.concatenate([self._entries.seen, *sensed], axis=-1)

    def _present(self) -> Array:
        """The flat observation (N, size): as late as it is, with what is remembered."""
        timestep = self._engine.vehicle.control_timestep
        age = np.rint(self._randomizer.column("observation_delay") / timestep).astype(np.int64)
        now, *before = (self._past[age + k, self._rows] for k in range(1 + self._further))
        known = (self.sensed[name] for name in self._known)
        return np.concatenate([now, *known, *before], axis=-1)

    def _show(self) -> dict[str, Array]:
        self.flat = flat = self._present()
        self.observation = {name: flat[:, part] for name, part in self.layout.items()}
        return self.observation

    def save(self) -> dict[str, np.ndarray]:
        """Copies of what is remembered."""
        saved = {"past": np.array(self._past)}
        if self._estimate:
            saved["rotor_speed"] = np.array(self._estimate.rotor_speed)
        for channel in (self._entries, *self._sensors.values()):
            saved |= channel.save()
        return saved

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        """Restore what `save` returned."""
        self._past = np.array(saved["past"])
        if self._estimate:
            self._estimate.rotor_speed = np.array(saved["rotor_speed"])
        for channel in (self._entries, *self._sensors.values()):
            channel.restore(saved)
        self._sensed()


class Critic:
    """The privileged observation: the task's true entries, what was drawn, and the wind.

    What was drawn lies between -1 and 1 in its range; the wind [m/s] is in the body frame.
    """

    def __init__(self, task: Task, engine: Engine, randomizer: Randomizer) -> None:
        """Begin with zeros."""
        self._engine, self._randomizer = engine, randomizer
        rotors, drawn = engine.vehicle.rotor_count, len(randomizer.sampler.spread)
        width = sum(term.width(rotors) for term in task.observation.values()) + drawn + 3
        self.seen = np.zeros((engine.num_envs, width))
        """(N, p), replaced and never changed."""

    def renew(self, truth: Mapping[str, Array], state: State, rows: np.ndarray) -> None:
        """Renew that of some aircraft (n,), or of all."""
        drawn = self._randomizer.sampler.scaled(self._randomizer.drawn[rows])
        wind = to_body(state.rotation, self._engine.wind[rows])
        self.seen = self.seen.copy()
        self.seen[rows] = np.concatenate([*truth.values(), drawn, wind], axis=-1)
