"""The weather: the parameters of the wind, and the process that generates it.

The wind is one vector per aircraft, in its row of air (`engine.air`). It changes once a control
step, before the physics.

- Mean wind over rough ground: U(h) = W20 ln(h/z0) / ln(6.096/z0) at the height h of the aircraft,
  zero up to h = z0.
- Turbulence: Dryden's spectra at low altitude (MIL-F-8785C, 3.7.2), along the mean wind, to its
  left and up. The filters are discretised exactly, so the spectra do not depend on the step. The
  mean wind at the task's altitude carries the turbulence past, whatever the aircraft does.
- One gust an episode: a pulse (1 - cos) at a random time.
- On demand, a noise of the lift of each rotor: independent first-order processes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from quadrl.aircraft.rotors import GRAVITY
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import WEATHER
from quadrl.base.rotation import Array, stack
from quadrl.base.validation import number, resolved
from quadrl.conditions.process import Process
from quadrl.conditions.sampler import Drawn
from quadrl.engines import native
from quadrl.engines.air import FIXED, ROWS, fixed_of, mean_wind
from quadrl.engines.rng import FULL_TURN, Rng

if TYPE_CHECKING:
    from quadrl.aircraft.vehicle import Vehicle
    from quadrl.engines.engine import Engine

MAX_WIND = 100.0  # [m/s]


@dataclasses.dataclass(frozen=True)
class Weather:
    """Parameters of the wind. The default is calm air."""

    wind_speed: float = 0.0
    """Mean wind at a height of 6.096 m (20 ft) [m/s]; turbulence grows with it."""
    turbulence: float = 1.0
    """Deviation of the turbulence over the standard's for this wind; 0 for a steady wind."""
    direction: float | None = None
    """Direction in which mean wind and gust blow, from east towards north [rad]; None to draw one
    for each of them in each episode."""
    roughness: float = 0.0457
    """Roughness length z0, below which there is no mean wind [m]. The default is 0.15 ft: open
    country."""
    gust_speed: float = 0.0
    """Peak speed of the gust, of which there is one in each episode [m/s]."""
    gust_time: float = 2.0
    """Duration of the gust [s]. Each episode draws its start."""

    def __post_init__(self) -> None:
        """Validate the numbers."""
        number("wind_speed", self.wind_speed, 0, MAX_WIND)
        number("turbulence", self.turbulence, 0, 10.0)
        if self.direction is not None:
            number("direction", self.direction)
        number("roughness", self.roughness, 1e-6, 1.0)
        number("gust_speed", self.gust_speed, 0, MAX_WIND)
        number("gust_time", self.gust_time, 1e-3, 1e6)

    @classmethod
    def of(cls, weather: str | Weather | Mapping[str, Any] | None) -> Weather:
        """Make a weather from a name, a mapping of fields or a weather; None is calm.

        Raises:
            QuadrlError: There is no such weather, or it has no such field.
        """
        return resolved("weather", "calm" if weather is None else weather, cls, WEATHERS)

    @property
    def calm(self) -> bool:
        """Whether the air never moves."""
        return self.wind_speed == 0 and self.gust_speed == 0


WEATHERS: dict[str, Weather] = {
    "calm": Weather(),
    "steady": Weather(wind_speed=5.0, turbulence=0.0),
    "light": Weather(wind_speed=7.72),
    "moderate": Weather(wind_speed=15.4),
    "severe": Weather(wind_speed=23.1),
}
"""Named weathers without a gust: calm, a wind without turbulence, and those with the turbulence of
MIL-F-8785C in 15, 30 and 45 knots."""


Weathered = str | Weather | Mapping[str, Any] | None
"""Types that `Weather.of` takes."""


def noise_time_of(vehicle: Vehicle) -> float:
    """Correlation time of the noise of the rotors' lift in the vortex ring state [s]; 0 for none.

    Ten times the time in which the induced velocity of hover crosses a rotor's radius (chosen).
    """
    air = vehicle.aerodynamics
    if not air.vortex_ring_noise:
        return 0.0
    radius = vehicle.rotors[0].disc
    thrust = vehicle.mass * GRAVITY / vehicle.rotor_count
    induced = math.sqrt(thrust / (2 * air.air_density * math.pi * radius**2))
    return 10 * radius / induced


class WeatherProcess(Process):
    """The weather of the aircraft of an engine, with a table of a column for each.

    An aircraft's weather depends only on its key and the number of its episode.
    """

    name = "weather"

    def __init__(
        self, weather: Weather, engine: Engine, time_limit: float, noise_time: float = 0.0
    ) -> None:
        """Set up the table.

        Args:
            weather: The weather.
            engine: The engine whose air is written.
            time_limit: Time limit of an episode [s], within which the gust blows.
            noise_time: Correlation time of the noise of each rotor's lift [s]; 0 for none.
        """
        self.weather = weather
        count, step = engine.num_envs, engine.vehicle.control_timestep
        self._setting = (
            weather.roughness,
            float(engine.origin[2]),
            step,
            noise_time,
            weather.turbulence,
        )
        self._latest = max(0.0, time_limit - weather.gust_time)
        # As wide as the engine's own tables, against set conflicts between rows.
        self._whole = np.zeros((len(ROWS), engine.frames[0].columns))
        self.table = self._whole[:, :count]
        self._streams = np.zeros((2, count), dtype=np.int64)
        self._varied = False
        self._write(slice(None), fixed_of(weather.wind_speed, *self._setting))
        self._engine = engine  # its buffers stay where they are
        arrays = (self._whole, *self._streams, engine.qpos[:, 2], engine.air)
        rotors = engine.vehicle.rotor_count if noise_time else 0
        sizes = self._whole.shape[1], engine.qpos.strides[0] // 8, rotors
        scales = np.array([1 / weather.roughness, step, 1 / weather.gust_time]).view(np.int64)
        # As `Rows` in native/weather.c, doubles by their bits.
        self._rows = native.struct(*arrays, *sizes, *scales)
        self._address = self._rows.ctypes.data
        self._kernel = native.library().quadrl_weather

    @classmethod
    def of(cls, weather: Weather, engine: Engine, time_limit: float) -> WeatherProcess | None:
        """The process; None in calm air."""
        noise_time = noise_time_of(engine.vehicle)
        if weather.calm and not noise_time:
            return None
        return cls(weather, engine, time_limit, noise_time)

    def begin(self, rows: np.ndarray, keys: np.ndarray, episodes: np.ndarray, drawn: Drawn) -> None:
        """Begin episodes (n,), and write their first air."""
        self._streams[:, rows] = keys, episodes
        if drawn.wind is not None:
            speed = self.weather.wind_speed * drawn.wind
            self._write(rows, fixed_of(speed, *self._setting))
            self._varied = True
        gust = self.weather.gust_speed
        bearing, gust_bearing, begins = self._drawn(keys, episodes)
        blows = {
            "east": np.cos(bearing),
            "north": np.sin(bearing),
            "gust_start": self._latest * begins,
            "gust_east": gust * np.cos(gust_bearing),
            "gust_north": gust * np.sin(gust_bearing),
        }
        self._write(rows, blows)
        self._kernel(self._address, len(rows), rows.ctypes.data, True)

    def mean_wind(self, keys: Array, episodes: Array, height: Array, drawn: Drawn) -> Array:
        """Mean wind (n, 2) [m/s] towards east and north, at heights (n,) [m] in episodes.

        The other arguments are as in `begin`.
        """
        speed = self.weather.wind_speed * (1.0 if drawn.wind is None else drawn.wind)
        mean = mean_wind(speed, self.weather.roughness, height)
        bearing, *_ = self._drawn(keys, episodes)
        return stack(mean * np.cos(bearing), mean * np.sin(bearing))

    def _drawn(self, keys: Array, episodes: Array) -> tuple[Array, Array, Array]:
        """Directions (n,) of mean wind and gust [rad], and when the gust begins, 0 to 1."""
        rng = Rng(keys, episodes, WEATHER)
        wind, gust, begins = (rng.uniform(0.0, 1.0) for _ in range(3))
        if self.weather.direction is not None:
            return (0.0 * wind + self.weather.direction,) * 2 + (begins,)
        return FULL_TURN * wind, FULL_TURN * gust, begins

    def act(self) -> None:
        """Advance the weather of all aircraft by a control step, and write their air."""
        self._kernel(self._address, self.table.shape[1], None, False)

    def _write(self, rows: Any, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            self.table[ROWS.index(name), rows] = value

    def save(self) -> dict[str, np.ndarray]:
        """All arrays that the next steps depend on."""
        return {"table": self.table.copy(), "streams": self._streams.copy()}

    def check(self, saved: Mapping[str, np.ndarray]) -> None:
        """Refuse arrays that were saved in another weather, or are not finite.

        Raises:
            QuadrlError: The message names the array.
        """
        table, fixed = saved["weather.table"], slice(0, len(FIXED))
        same = self._varied or np.array_equal(table[fixed], self.table[fixed])
        same &= np.array_equal(table[ROWS.index("steps")], saved["episode.steps"])
        if not (same and np.isfinite(table).all()):
            reason = "the state was saved in another weather"
            raise QuadrlError(reason, name="weather.table", value=table, allowed="this weather's")

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        """Restore what `save` returned; the engine restores its air itself."""
        self.table[:], self._streams[:] = saved["table"], saved["streams"]
