"""What is sensed of aircraft, in which order, and how it becomes an observation: pure functions.

`Senses` are the sensors of an environment in their order. `Look` lets them look, once: with numbers
of N aircraft, or with the symbols of one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base import records
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import NOISE
from quadrl.base.rotation import Array, namespace
from quadrl.conditions.observing import Observing
from quadrl.conditions.randomization import NONE
from quadrl.conditions.sampler import AircraftSampler
from quadrl.conditions.scene import Scene
from quadrl.conditions.sensor import VALUES, Channel, Memory, Moment, Sizes
from quadrl.conditions.world import World
from quadrl.core.observation import ObservationTerm, layout
from quadrl.core.task import Task
from quadrl.engines.state import State

Kept = dict[str, Memory]
"""What each sensor remembers of n aircraft, by its name."""
ERRORS = 12
"""Numbers with errors in an estimate of the state."""


class Senses:
    """The sensors of a task's aircraft in the order in which they sense."""

    def __init__(
        self,
        options: Observing,
        task: Task,
        vehicle: Vehicle,
        actions: int,
        sampler: AircraftSampler,
        happening: int,
        origin: Array,
        *,
        loops: bool,
    ) -> None:
        """Lay out the observation.

        Args:
            options: Options of the observation.
            task: The task.
            vehicle: The aircraft as it is specified.
            actions: Numbers in an action.
            sampler: Draws aircraft and errors.
            happening: Numbers of what events do.
            origin: Of the task's frame, (3,) [m], world frame.
            loops: Whether commands change with each physics step, and not once in a control step.

        Raises:
            QuadrlError: The delay or the rate of a sensor does not fit the control step, or it has
                the name of an entry of the task.
        """
        rotors, timestep = vehicle.rotor_count, vehicle.control_timestep
        self._specified = Parameters.of(parameters.rows(vehicle), timestep)
        self.loops = loops
        """Whether commands change with each physics step, and somebody calls `followed` for it."""
        sensors = options.made(task.sensors, uncertain=sampler.randomization.uncertain)
        self._tasks = tuple(one.name for one in task.parts)
        for sensor in sensors.values():
            sensor.check(self._tasks)
        self.rays = {name: sensor.rays for name, sensor in sensors.items()}
        """Rays that are measured for them, by name; None for most."""
        self._origin, self._far = origin, Scene((), self.rays).nothing_near(1)
        self.estimates = "estimate" in sensors
        """Whether an estimate of the state is seen, and not the true one."""
        hidden = {name for sensor in sensors.values() for name in sensor.hides}
        self.terms = {k: term for k, term in task.observation.items() if k not in hidden}
        """The entries of the observation in the order of the flat vector."""
        self.own = tuple(self.terms)
        """Those of the task."""
        entries, truth = (
            sum(term.width(rotors) for term in terms.values())
            for terms in (self.terms, task.observation)
        )
        sizes = Sizes(rotors, actions, entries, truth, len(sampler.spread), happening)
        measured = [sensor for sensor in sensors.values() if sensor.measured]
        observed = sum(sensor.width(sizes) for sensor in measured)
        sizes = dataclasses.replace(sizes, observed=observed)
        self.channels = {k: Channel(s, sizes, timestep) for k, s in sensors.items()}
        """The output of each sensor, by name."""
        channels = self.channels.values()
        others = [c for c in channels if c.sensor.shown and c.sensor.name != "state"]
        self.sensors = [*sensors.values()]
        """The sensors in their order."""
        self.early = [channel for channel in channels if not channel.sensor.last]
        """Those that do not read what the task makes of the state."""
        late = [channel for channel in channels if channel.sensor.last]
        # The task's entries come first; the other sensors are given what is measured.
        self.late = sorted(late, key=lambda channel: not channel.sensor.measured)
        """The others, in the order in which they look."""
        self._measured = [self.channels["state"], *(c for c in others if c.sensor.measured)]
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
        self.size = observed + sum(channel.width for channel in self._known)
        """Numbers in an observation."""
        self.draws = {
            name: (channel.stream, drawn)
            for name, channel in self.channels.items()
            if (drawn := channel.sensor.drawn(channel.width))
        }
        """Streams and numbers of the errors that are drawn in each control step, by sensor."""
        self._noise = sampler.randomization.noise
        if self.estimates and self._noise != NONE.noise:
            self.draws["estimate"] = NOISE, ERRORS
        self.biases = {name: c.width for name, c in self.channels.items() if c.sensor.bias}
        """Numbers of the errors that last for an episode, by sensor."""
        self.given = {"estimate": ERRORS, "drawn": sizes.drawn, "happening": happening}
        self.given |= {"airframe": 16 if "airframe" in sensors else 0} | self.biases
        """Numbers of an aircraft that sensors are given beside its flight, by name: errors of the
        estimate that last, what was drawn, what events do, lasting errors by sensor."""

    def shown(self, kept: Kept) -> dict[str, Array]:
        """What the sensors give that a task can see, (n, size) by name, of what is remembered."""
        early = ((channel, channel.sensor.name) for channel in self.early if channel.sensor.shown)
        return {name: channel.seen(kept[name]) for channel, name in early}

    def measured(self, kept: Kept) -> Array:
        """What is measured, as it is seen, (n, m), of what is remembered."""
        return _side_by_side([c.seen(kept[c.sensor.name]) for c in self._measured])

    def flat(self, kept: Kept) -> Array:
        """The observation as vectors (n, size), of what is remembered."""
        known = [c.seen(kept[c.sensor.name]) for c in self._known]
        return _side_by_side([self.measured(kept), *known])

    def named(self, flat: Array) -> dict[str, Array]:
        """The entries of vectors (n, size) by name."""
        return {name: flat[:, part] for name, part in self.layout.items()}

    def followed(self, kept: Kept, command: Array, seconds: float) -> Kept:
        """What modelled rotors remember after commands (n, R) [rad/s] for a time [s]."""
        found: Kept = {}
        for sensor in (channel.sensor for channel in self.early if channel.sensor.follows):
            memory = kept[sensor.name]
            own = {key: array for key, array in memory.items() if key != VALUES}
            own = sensor.follow(own, self._specified, command, seconds)
            found[sensor.name] = {VALUES: memory[VALUES], **own}
        return found

    def moment(
        self,
        true: State,
        world: World | None,
        action: Array,
        wind: Array,
        steps: Array,
        aged: Array,
        given: Mapping[str, Array],
        normal: Mapping[str, Array],
    ) -> Moment:
        """What sensors may read, of n aircraft, of numbers or of symbols.

        Args:
            true: Their state.
            world: The world about them; None where the task declares no solids.
            action: What they did, (n, k).
            wind: (n, 3) [m/s], world frame.
            steps: Control steps (n,) since the start.
            aged: Their coordinates as old as is drawn, (n, 13).
            given: As `Observer.given`.
            normal: Normal numbers (n, k) for `draws`, by sensor.
        """
        errors = given["estimate"]
        if "estimate" in normal:
            errors = errors + self._noise.sizes * normal["estimate"]
        return Moment(
            true=true,
            action=action,
            wind=wind,
            parameters=self._specified,
            world=world or records.mapped(lambda array: array.repeat(len(wind), 0), self._far),
            origin=self._origin,
            tasks=self._tasks,
            steps=steps,
            aged=aged,
            errors=errors,
            drawn=given["drawn"],
            happening=given["happening"],
            airframe=given["airframe"],
            bias=given,
            normal=normal,
            state=true,
            rotor_speed=true.rotor_speed,
        )


class Look:
    """A look of all sensors: as episodes begin, or after a control step.

    It is a function of what it is made with, numbers or symbols: `transition.begin` and `finish`
    call its parts.
    """

    def __init__(self, senses: Senses, now: Moment, before: Kept | None) -> None:
        """Take what sensors may read, and what they remember; None where episodes begin."""
        self._senses, self._now, self._before = senses, now, before
        self.after: Kept = {}
        """What they remember from now on."""

    def sense(self, command: Array | None = None) -> tuple[State | None, dict[str, Array]]:
        """Let the sensors look that do not read what the task makes of the state.

        Args:
            command: Mean command (n, R) [rad/s] of the control step.

        Returns:
            The estimated state, None where the true one is seen, and what the task can see.
        """
        senses, now = self._senses, self._now
        if self._before is not None and not senses.loops:
            seconds = float(now.parameters.control_timestep)
            self._before = self._before | senses.followed(self._before, command, seconds)
        for channel in senses.early:
            self._take(channel)
        return now.state if senses.estimates else None, senses.shown(self.after)

    def observe(self, entries: Mapping[str, Array], truth: Mapping[str, Array]) -> dict[str, Array]:
        """Let the others look; return what policies observe, (n, k) by name.

        Args:
            entries: The task's entries of the estimated state, (n, k) by name.
            truth: The same of the true state.
        """
        senses, now = self._senses, self._now
        now.entries = _side_by_side([entries[name] for name in senses.own] or [now.wind[:, :0]])
        now.estimated, now.truth = entries, truth
        for channel in senses.late:
            if not channel.sensor.measured and now.observed is None:
                now.observed = senses.measured(self.after)
            self._take(channel)
        return senses.named(senses.flat(self.after))

    def _take(self, channel: Channel) -> None:
        """Let a sensor look, and tell the others what is seen."""
        name, now = channel.sensor.name, self._now
        if self._before is None:
            after = channel.begin(now)
        else:
            after = channel.step(self._before[name], now)
        self.after[name] = after
        channel.sensor.tell(now, channel.seen(after))


def arrays(kept: Kept) -> list[Array]:
    """All that is remembered, one array after the other."""
    return [array for memory in kept.values() for array in memory.values()]


def filled(like: Kept, given: Iterator[Array]) -> Kept:
    """The same with other arrays, in the order of `arrays`."""
    return {name: {key: next(given) for key in memory} for name, memory in like.items()}


def _side_by_side(parts: list[Array]) -> Array:
    return namespace(parts[0]).concatenate(parts, axis=-1)
