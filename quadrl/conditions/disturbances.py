"""What disturbs the rows of an environment: drawn parameters, late commands, pushes.

Everything that the next steps depend on stands in arrays that are saved and restored, and every
random number follows from the seed of its row, the episode and the control step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.philox import PARAMETERS, PUSHES
from quadrl.base.rotation import Array
from quadrl.conditions.draw import Draw
from quadrl.conditions.weather import Weather
from quadrl.engines import native
from quadrl.engines.engine import Engine
from quadrl.engines.rng import uniform


class Disturbances:
    """Of N aircraft."""

    def __init__(self, draw: Draw, engine: Engine, *, active: bool) -> None:
        """Set up the arrays.

        Args:
            draw: What is drawn.
            engine: Flies the aircraft.
            active: Whether anybody looks at what is drawn.
        """
        self.draw, self._engine = draw, engine
        self.active = active
        """Whether anything follows from what is drawn; nothing is drawn otherwise."""
        count, rotors = engine.ctrl.shape
        given, vehicle = draw.given, engine.vehicle
        self._rows = np.arange(count)
        self.drawn = np.tile(draw.low, (count, 1))
        """Numbers of the present episodes, (N, k), by `draw.names`; replaced, never changed."""
        self.place = np.zeros((2, count), np.int64)
        """Seeds and numbers of the present episodes."""
        self.steps = np.zeros(count, np.int64)
        """Control steps since their start."""
        self._pushes = given.pushes
        self._chance = -math.expm1(-given.pushes.rate * vehicle.control_timestep)
        longest = draw.delays[0][1]
        self.late = longest > 0
        """Whether commands pass a queue; the rotors then get one at each physics step."""
        self._queue = np.zeros((longest + 1, count, rotors))  # [rad/s]
        self._newest = np.zeros(1, np.int64)  # where in the queue
        self._delay = np.zeros(count, np.int64)  # [physics steps]

    def of_episodes(self, keys: np.ndarray, episodes: np.ndarray) -> Array | None:
        """What is drawn for episodes (n,), numbers (n, k); None where nobody looks at it."""
        if not self.active:
            return None
        return self.draw.of(uniform(keys, episodes, PARAMETERS, 0, len(self.draw.names)))

    def begin(
        self, rows: np.ndarray, keys: np.ndarray, episodes: np.ndarray, drawn: Array | None
    ) -> None:
        """Begin episodes (n,) with what `of_episodes` gave for them, the aircraft in their place.

        Until the first command arrives, the rotors keep their speed.
        """
        if drawn is None:
            return
        self.place[:, rows], self.steps[rows] = (keys, episodes), 0
        self.drawn = self.drawn.copy()
        self.drawn[rows] = drawn
        self._set_delay()
        if self.late:
            self._queue[:, rows] = self._engine.act[rows]

    def shown(self) -> dict[str, Array]:
        """What differs from aircraft to aircraft, (N,) by name."""
        return {self.draw.names[k]: self.drawn[:, k] for k in self.draw.spread}

    def _set_delay(self) -> None:
        delay = self.draw.columns(self.drawn, "command_delay")[:, 0]
        self._delay = np.rint(delay / self._engine.vehicle.physics_timestep).astype(np.int64)

    def wind_speed(self, rows: np.ndarray, weather: Weather) -> Array | None:
        """Of the weather of some aircraft (n,) [m/s]; None where it is the specified one."""
        if self.draw.given.wind == (1.0, 1.0):
            return None
        return weather.wind_speed * self.draw.columns(self.drawn[rows], "wind")[:, 0]

    def passed_on(self, command: Array) -> Array:
        """What the rotors get for a physics step (N, R) [rad/s], after what is commanded."""
        if not self.late:
            return command
        length = len(self._queue)
        self._newest[0] = newest = (self._newest[0] + 1) % length
        self._queue[newest] = command
        return self._queue[(newest - self._delay) % length, self._rows]

    def begin_step(self) -> None:
        """Count a control step that begins, and push the aircraft that chance hits."""
        if self._chance > 0:
            keys, episodes = (array.ctypes.data for array in self.place)
            place = keys, episodes, self.steps.ctypes.data, PUSHES
            hit = self._chance, self._pushes.velocity, self._pushes.body_rate
            qvel = self._engine.qvel
            rows = qvel.ctypes.data, qvel.strides[0] // 8
            native.library().quadrl_push(len(self.steps), *place, *hit, *rows)
        self.steps += 1

    def save(self) -> dict[str, np.ndarray]:
        """Copies of the arrays."""
        names = ("drawn", "place", "steps", "queue", "newest")
        return {name: np.array(getattr(self, _own(name))) for name in names}

    def check_saved(self, saved: Mapping[str, np.ndarray]) -> None:
        """Refuse what `save` cannot have given, under its names in a saved environment.

        Raises:
            QuadrlError: The message names the array.
        """
        numbers = saved["disturbances.drawn"]
        newest = saved["disturbances.newest"]
        for name, value, within in (
            ("drawn", numbers, self.draw.may_give(numbers)),
            ("newest", newest, ((newest >= 0) & (newest < len(self._queue))).all()),
        ):
            if not within:
                allowed = "of an environment with the same randomization"
                raise QuadrlError(name=f"disturbances.{name}", value=value, allowed=allowed)

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Take up what `save` gave."""
        for name, value in saved.items():
            setattr(self, _own(name), np.array(value))
        self._set_delay()


def _own(name: str) -> str:
    return f"_{name}" if name in ("queue", "newest") else name
