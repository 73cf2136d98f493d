"""Observations of N aircraft: the task's entries of the estimated state, and sensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.base import records
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array
from quadrl.conditions.event_process import Events
from quadrl.conditions.observing import Observing
from quadrl.conditions.process import Process
from quadrl.conditions.randomizer import Randomizer
from quadrl.conditions.scene import Scene
from quadrl.conditions.sensor import Channel, EstimatedState, Moment, Sizes
from quadrl.conditions.world import World
from quadrl.core.observation import ObservationTerm, layout
from quadrl.core.snapshot import Snapshot
from quadrl.core.task import Task
from quadrl.core.transition import Transition, observe
from quadrl.engines.engine import Engine
from quadrl.engines.state import State


class Observer(Process):
    """Observes N aircraft with errors, delays, further sensors and histories."""

    name = "observer"

    def __init__(
        self,
        options: Observing,
        task: Task,
        engine: Engine,
        actions: int,
        randomizer: Randomizer,
        events: Events | None = None,
    ) -> None:
        """Lay out the observation.

        Args:
            options: Options of the observation.
            task: The task.
            engine: Flies the aircraft.
            actions: Numbers in an action.
            randomizer: Randomizer of those aircraft.
            events: What happens to them in flight, where something does.

        Raises:
            QuadrlError: The delay or the rate of a sensor does not fit the control step, or it has
                the name of an entry of the task.
        """
        self._task, self._engine, self._randomizer, self._events = task, engine, randomizer, events
        vehicle, rotors = engine.vehicle, engine.vehicle.rotor_count
        timestep, sampler = vehicle.control_timestep, randomizer.sampler
        self._specified = Parameters.of(parameters.rows(vehicle), timestep)
        self._far = Scene(()).nothing_near(engine.num_envs)
        sensors = options.made(task.sensors, uncertain=sampler.randomization.uncertain)
        self.frame = EstimatedState(engine) if "estimate" in sensors else None
        """Table of the estimated state; None where the true one is seen."""
        hidden = {name for sensor in sensors.values() for name in sensor.hides}
        self.terms = {k: term for k, term in task.observation.items() if k not in hidden}
        """The entries of the observation in the order of the flat vector."""
        self._own = tuple(self.terms)
        entries, truth = (
            sum(term.width(rotors) for term in terms.values())
            for terms in (self.terms, task.observation)
        )
        happening = events.width if events else 0
        sizes = Sizes(rotors, actions, entries, truth, len(sampler.spread), happening)
        measured = [sensor for sensor in sensors.values() if sensor.measured]
        observed = sum(sensor.width(sizes) for sensor in measured)
        sizes = dataclasses.replace(sizes, observed=observed)
        # In the order in which they sense.
        self._channels = {k: Channel(s, sizes, randomizer, timestep) for k, s in sensors.items()}
        channels = self._channels.values()
        others = [c for c in channels if c.sensor.shown and c.sensor.name != "state"]
        self.sensors = [*sensors.values()]
        """The sensors in that order."""
        self._early = [channel for channel in channels if not channel.sensor.last]
        late = [channel for channel in channels if channel.sensor.last]
        # The task's entries come first; the other sensors are given what is measured.
        self._last = sorted(late, key=lambda channel: not channel.sensor.measured)
        self._measured = [self._channels["state"], *(c for c in others if c.sensor.measured)]
        self._known = [channel for channel in others if not channel.sensor.measured]
        for channel in (*self._measured[1:], *self._known):
            sensor = channel.sensor
            if sensor.name in task.observation:
                allowed = f"a name that no entry of the task {task.name} has"
                raise QuadrlError(name="sensor", value=sensor.name, allowed=allowed)
            meaning = str(type(sensor).__doc__).partition("\n")[0]
            term = ObservationTerm(channel.width, sensor.unit, meaning, sensor.formula)
            self.terms[sensor.name] = term
        self.layout = layout(self.terms, rotors)
        """Where each of them stands in it."""
        self.sensed: dict[str, Array] = {}
        """What the sensors give now that a task can see, (N, size) by name."""
        self.observation: dict[str, Array] = {}
        """The last one, its entries views of `flat`."""
        width = observed + sum(channel.width for channel in self._known)
        self.flat = np.zeros((engine.num_envs, width))
        """The same as vectors."""

    @property
    def privileged(self) -> Array | None:
        """The observation for the critic alone (N, p), where the options ask for it."""
        channel = self._channels.get("privileged")
        return channel and channel.seen

    def follow(self, command: Array, seconds: float) -> None:
        """Let modelled rotors follow commands (N, R) [rad/s] for a time [s]."""
        for channel in self._early:
            channel.follow(self._specified, command, seconds)

    def first(self, rows: np.ndarray, now: Snapshot) -> dict[str, Array]:
        """Begin episodes (n,) and return their first observation, from their snapshot (n, ...)."""
        moment = self._moment(now.state, now.action, rows, now.world)
        for channel in self._early:
            channel.begin(moment)
        self._show_sensed()
        now.sensed = {name: array[rows] for name, array in self.sensed.items()}
        truth = self._task.observe(now)
        seen = observe(self._task, now, moment.state) if self.frame else truth
        self._look(Channel.begin, moment, seen, truth)
        flat = self._present()[rows]
        return {name: flat[:, part] for name, part in self.layout.items()}

    def sense(self, action: Array, world: World | None) -> None:
        """Estimate the state and let the sensors measure, after a control step with an action."""
        self._now = self._moment(self._engine.state, action, None, world)
        for channel in self._early:
            channel.step(self._now)
        self._show_sensed()

    def observe(self, done: Transition) -> dict[str, Array]:
        """Return the observation of all rows, from the transition that followed `sense`."""
        self._look(Channel.step, self._now, done.observation, done.truth)
        return self.again()

    def again(self) -> dict[str, Array]:
        """Return the present observation of all rows again."""
        self.flat = flat = self._present()
        self.observation = {name: flat[:, part] for name, part in self.layout.items()}
        return self.observation

    def _moment(
        self, true: State, action: Array, rows: np.ndarray | None, world: World | None
    ) -> Moment:
        chosen = slice(None) if rows is None else rows
        seen = self._engine.wind[chosen], action, self._specified, self._randomizer, rows
        about = world or records.mapped(lambda array: array[chosen], self._far)
        given = true, true, true.rotor_speed, *seen, self.frame
        return Moment(*given, events=self._events, world=about)

    def _look(
        self,
        act: Callable[[Channel, Moment], None],
        now: Moment,
        entries: Mapping[str, Array],
        truth: Mapping[str, Array],
    ) -> None:
        """Let those sensors begin or step that look at the task's entries."""
        now.entries = np.concatenate([entries[name] for name in self._own], axis=-1)
        now.estimated, now.truth = entries, truth
        for channel in self._last:
            if not channel.sensor.measured and now.observed is None:
                observed = self._observed()
                now.observed = observed if now.rows is None else observed[now.rows]
            act(channel, now)

    def _show_sensed(self) -> None:
        early = ((channel.sensor, channel.seen) for channel in self._early)
        self.sensed = {sensor.name: seen for sensor, seen in early if sensor.shown}

    def _observed(self) -> Array:
        """What is measured, as it is seen, (N, m)."""
        return np.concatenate([channel.seen for channel in self._measured], axis=-1)

    def _present(self) -> Array:
        """The flat observation (N, size)."""
        known = (channel.seen for channel in self._known)
        return np.concatenate([self._observed(), *known], axis=-1)

    def save(self) -> dict[str, np.ndarray]:
        """Copies of what is remembered."""
        parts = (channel.save() for channel in self._channels.values())
        return {name: array for part in parts for name, array in part.items()}

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        """Restore what `save` returned."""
        for channel in self._channels.values():
            channel.restore(saved)
        self._show_sensed()
