"""The observations of N aircraft: what their sensors are given and remember."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quadrl.aircraft.quadrotor import authority
from quadrl.base.rotation import Array
from quadrl.conditions.event_process import Events
from quadrl.conditions.process import Process
from quadrl.conditions.randomizer import Randomizer
from quadrl.conditions.sampler import Drawn
from quadrl.conditions.sensors import StateEstimate
from quadrl.conditions.world import World
from quadrl.core.senses import ERRORS, Kept, Look, Senses, arrays, filled
from quadrl.engines.engine import Engine
from quadrl.engines.rng import normal, uniform
from quadrl.engines.state import State

MAX_REMEMBERED = 250
"""Most numbers that sensors remember in a step that is compiled. With 136, 1,024 aircraft take a
quarter of the time and the compiler 3 s; with 276, 0.8 of it and 8 s; with 488 more time than in
NumPy."""


class Observer(Process):
    """Lets the sensors of N aircraft look, with errors, delays and histories."""

    name = "observer"

    def __init__(
        self,
        senses: Senses,
        engine: Engine,
        randomizer: Randomizer,
        events: Events | None = None,
    ) -> None:
        """Set up the arrays.

        Args:
            senses: The sensors.
            engine: Flies the aircraft.
            randomizer: Randomizer of those aircraft.
            events: What happens to them in flight, where something does.
        """
        self.senses, self._engine = senses, engine
        self._randomizer, self._events, count = randomizer, events, engine.num_envs
        self.given = {name: np.zeros((count, width)) for name, width in senses.given.items()}
        """What sensors are given that no control step changes, (N, k) by name as in `Senses`,
        live."""
        self.kept: Kept = {}
        """What is remembered now; views of tables that the next steps fill."""

    @property
    def not_compilable(self) -> str:
        """Why a control step with these sensors is not compiled; empty where it may be."""
        own = (sensor.name for sensor in self.senses.sensors if not sensor.asks_compiled)
        if name := next(own, ""):
            return f"the class of the sensor {name} does not say `compiled = True`"
        count = sum(array[0].size for array in arrays(self.kept))
        return f"its sensors remember {count} numbers" if count > MAX_REMEMBERED else ""

    @property
    def privileged(self) -> Array | None:
        """The observation for the critic alone (N, p), where the options ask for it."""
        if not (channel := self.senses.channels.get("privileged")):
            return None
        if not self.kept:  # nothing was observed yet
            return np.zeros((self._engine.num_envs, channel.width))
        return np.array(channel.seen(self.kept["privileged"]))

    @property
    def sensed(self) -> dict[str, Array]:
        """What the sensors give now that a task can see, (N, size) by name."""
        return self.senses.shown(self.kept)

    @property
    def estimate(self) -> State | None:
        """The estimated state; None where the true one is seen."""
        if not self.senses.estimates:
            return None
        seen = self.senses.channels["estimate"].seen(self.kept["estimate"])
        return StateEstimate.state(seen, self._engine.origin)

    def again(self) -> dict[str, Array]:
        """Return the present observation of all rows again."""
        return self.senses.named(self.senses.flat(self.kept))

    def begin(self, rows: np.ndarray, keys: np.ndarray, episodes: np.ndarray, drawn: Drawn) -> None:
        """Begin episodes (n,): draw the errors that last."""
        self._note(rows)
        for name in self.senses.biases:
            channel = self.senses.channels[name]
            shares = uniform(keys, episodes, channel.stream + 1, 0, channel.width)
            self.given[name][rows] = channel.sensor.bias * (2 * shares - 1)

    def act(self) -> None:
        """Take what events do in the control step that begins."""
        if self._events:
            self.given["happening"][:] = self._events.seen(None)

    def _note(self, rows: np.ndarray) -> None:
        """Note what was drawn for aircraft (n,), and what events do to them."""
        drawn, sampler = self._randomizer.drawn[rows], self._randomizer.sampler
        self.given["estimate"][rows] = sampler.columns(drawn, "position_bias_x", ERRORS)
        self.given["drawn"][rows] = sampler.scaled(drawn)
        if self.given["airframe"].size:
            begun = self._engine.begun
            self.given["airframe"][rows] = authority(begun[rows] if len(begun) > 1 else begun)
        if self._events:
            self.given["happening"][rows] = self._events.seen(rows)

    @property
    def follows(self) -> bool:
        """Whether a sensor follows the commands to the rotors."""
        return any(channel.sensor.follows for channel in self.senses.early)

    def follow(self, command: Array, seconds: float) -> None:
        """Let modelled rotors follow commands (N, R) [rad/s] for a time [s]."""
        for name, memory in self.senses.followed(self.kept, command, seconds).items():
            for key, array in memory.items():
                self.kept[name][key][:] = array

    def save(self) -> dict[str, np.ndarray]:
        """Copies of what is remembered."""
        lasting = {f"{name}.bias": self.given[name] for name in self.senses.biases}
        own = {f"{name}.{k}": a for name, memory in self.kept.items() for k, a in memory.items()}
        # In C's order, as every file format wants them.
        return {name: np.array(array, order="C") for name, array in (own | lasting).items()}

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        """Restore what `save` returned."""
        self._note(np.arange(self._engine.num_envs))
        for name in self.senses.biases:
            self.given[name][:] = saved[f"{name}.bias"]
        for name, memory in self.kept.items():
            for key, array in memory.items():
                array[:] = saved[f"{name}.{key}"]

    def ranged(self, world: World | None, rows: np.ndarray | None = None) -> World | None:
        """The world about some aircraft (n,), or all, with what is read along rays in it."""
        chosen = slice(None) if rows is None else rows
        (keys, episodes), steps = self._randomizer.place[:, chosen], self._randomizer.steps[chosen]
        for name, rays in self.senses.rays.items():
            if world is not None and rays is not None:
                stream, part = self.senses.channels[name].stream, world.beams[name]
                normals = normal(keys, episodes, steps, stream, rays.drawn) if rays.drawn else keys
                bias = self.given[name][chosen, : rays.count] if name in self.senses.biases else 0.0
                world.rays[:, part] = rays.read(world.rays[:, part], bias, normals)
        return world

    def look(
        self, true: State, action: Array, world: World | None, rows: np.ndarray | None = None
    ) -> Look:
        """A look at some aircraft whose episodes begin (n,), or at all after a control step.

        Args:
            true: Their state.
            action: What they did, (n, k).
            world: The world about them; None where the task declares no solids.
            rows: Which they are; None for all.
        """
        chosen = slice(None) if rows is None else rows
        source, wind = self._randomizer, self._engine.wind
        (keys, episodes), steps = source.place[:, chosen], source.steps[chosen]
        given = {name: array[chosen] for name, array in self.given.items()}
        errors = {
            name: normal(keys, episodes, steps, stream, width)
            for name, (stream, width) in self.senses.draws.items()
        }
        seen = action, wind[chosen], steps, source.aged(chosen), given, errors
        now = self.senses.moment(true, world, *seen)
        return Look(self.senses, now, None if rows is not None else self.kept)

    def keep(self, after: Kept, rows: np.ndarray | None = None) -> None:
        """Keep what a look at some aircraft (n,), or at all, has left in memory."""
        if rows is not None and self.kept:
            for name, memory in after.items():
                for key, array in memory.items():
                    self.kept[name][key][rows] = array
        else:
            self.kept = filled(after, (a if a.base is None else a.copy() for a in arrays(after)))
