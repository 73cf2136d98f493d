"""What the APIs share: an environment from one set of keywords, and pictures of it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from typing import Any, Unpack

import numpy as np

from quadrl.base.errors import RenderingUnavailable
from quadrl.base.rotation import norm
from quadrl.base.validation import number
from quadrl.core.environment import Environment
from quadrl.core.scenario import Conditions, Scenario
from quadrl.core.task import Task
from quadrl.core.trajectory import outcome
from quadrl.engines import mjcf
from quadrl.rendering import Renderer
from quadrl.rendering.overlay import Panel, flight_lines, task_title
from quadrl.rendering.pictures import LiveFlight

OWN = ("num_threads", "seed", "reward_terms")
"""Keywords of every API beside those of a scenario."""
PICTURE = ("width", "height", "camera")
"""Keywords of the pictures that an API draws."""


def make(
    task: str | Task | Scenario,
    num_envs: int,
    also: Iterable[str] = (),
    *,
    seed: int | None = None,
    num_threads: int = 0,
    **conditions: Unpack[Conditions],
) -> Environment:
    """Make an environment.

    Args:
        task: A name of the catalogue, a task, or a whole scenario.
        num_envs: Number of aircraft, N.
        also: Keywords that the API takes itself.
        seed: Row i is seeded with seed + i; None for one from the system.
        num_threads: Threads of the simulation; 0 for every core.
        **conditions: `vehicle`, `weather`, `randomization` and the others, as
            `quadrl.core.scenario.Conditions` has them, and options of the task.

    Raises:
        QuadrlError: Unknown name or impossible value.
    """
    scenario = Scenario.of(task, [*OWN, *also], **conditions)
    return Environment(scenario, num_envs=num_envs, seed=seed, num_threads=num_threads)


def episode_info(environment: Environment) -> dict[str, np.ndarray]:
    """Entries of `info` that last for an episode, arrays (N, k); by default there are none.

    Returns:
        drawn: what was drawn for each aircraft, with names; privileged: for the critic alone.
    """
    values: dict[str, np.ndarray] = {}
    if environment.randomizer.active and (shown := environment.randomizer.shown()):
        values["drawn"] = Named(shown)
    if environment.observer and (privileged := environment.privileged) is not None:
        values["privileged"] = privileged.astype(np.float32)
    return values


class Pictures:
    """Draws the aircraft of an environment; opens the renderer at the first picture.

    The camera is eased from one picture of an episode to the next. A panel with time, error, speed,
    reward, wind, horizon, rotor speeds and, at its end, the outcome of the episode is laid over
    pictures that are large enough (from about 370 x 280 pixels on), where Pillow is installed.
    """

    def __init__(
        self,
        environment: Environment,
        camera: str,
        width: int,
        height: int,
        *,
        overlay: bool = True,
    ) -> None:
        """Note what to draw, on pictures of width x height pixels, with or without the panel."""
        self._environment, self._camera = environment, camera
        self._width = number("width", width, 1, whole=True)
        self._height = number("height", height, 1, whole=True)
        self._overlay = overlay
        self._renderer: Any = None
        self._panel: Any = None
        self._flights: dict[int, Any] = {}  # by row

    def __getstate__(self) -> dict[str, Any]:
        """For pickle and deepcopy: a copy opens a renderer of its own."""
        return self.__dict__ | {"_renderer": None, "_panel": None}

    def frame(self, row: int = 0) -> np.ndarray:
        """The picture (height, width, 3) uint8 of one aircraft.

        Raises:
            RenderingUnavailable: This machine has no graphics library.
            QuadrlError: There is no such camera.
        """
        environment = self._environment
        if self._renderer is None:
            self._open()
        flight = self._flights.setdefault(row, LiveFlight(self._camera))
        now, qpos = environment.snapshot, environment.engine.qpos[row]
        time, speeds = float(now.time[row]), now.state.rotor_speed[row]
        goal, markers = environment.goals()[row], environment.markers(row)
        wind = None if environment.weather.calm else environment.engine.wind[row]
        picture = flight.picture(self._renderer, time, qpos, speeds, goal, markers, wind)
        if self._panel is not None:
            self._panel.draw(picture, *self._values(row, time))
        return picture

    def _open(self) -> None:
        vehicle, task = self._environment.vehicle, self._environment.task
        model = self._environment.scenario.compile_model()
        self._renderer = Renderer(model, self._width, self._height)
        if self._overlay:
            with contextlib.suppress(RenderingUnavailable):  # without Pillow
                colours = [mjcf.rotor_colour(rotor.position) for rotor in vehicle.rotors]
                windy = not self._environment.weather.calm
                panel = Panel(self._height, task_title(task.name), colours, windy)
                self._panel = panel if panel.fits(self._width, self._height) else None

    def _values(self, row: int, time: float) -> tuple[Any, ...]:
        """What the panel shows of a row: values, rotor speeds, attitude, outcome."""
        environment = self._environment
        now, done, reward, end = environment.snapshot, environment.transition, 0.0, ""
        error = environment.task.error(now)[row]
        if done is not None and time > 0:  # it is of this episode
            error, reward = done.error[row], done.reward[row]
            end = outcome(done.terminated[row], done.truncated[row], done.is_success[row])
        calm = environment.weather.calm
        wind = None if calm else float(norm(environment.engine.wind[row]))
        moment = time, float(error), float(now.state.speed[row]), float(reward)
        values = flight_lines(*moment, wind)
        shares = now.state.rotor_speed[row] / environment.vehicle.max_speed
        return [*values.values()], shares, environment.engine.qpos[row][3:7], end

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = self._panel = None


class Named(np.ndarray):
    """Numbers (k,) or (N, k): an array whose last axis has names, as the terms of the reward.

    `terms["progress"]` and `terms.items()` work as in a dict; clients that read numbers alone, as
    TorchRL's, see the array.
    """

    names: tuple[str, ...]

    def __new__(cls, terms: Mapping[str, np.ndarray]) -> Named:
        """Stack numbers, each () or (N,)."""
        stacked = np.array([*terms.values()]).T.view(cls)  # a quarter of the time of `stack`
        stacked.names = tuple(terms)
        return stacked

    def __array_finalize__(self, other: Any) -> None:
        self.names = getattr(other, "names", ())

    def __reduce__(self) -> Any:
        return Named, (dict(self.items()),)

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, str):
            if key not in self.names:
                raise KeyError(f"{key}; the names are {', '.join(self.names)}")
            return self.view(np.ndarray)[..., self.names.index(key)]
        return super().__getitem__(key)

    def keys(self) -> tuple[str, ...]:
        """The names."""
        return self.names

    def values(self) -> list[np.ndarray]:
        """The numbers."""
        return [self[name] for name in self.names]

    def items(self) -> list[tuple[str, np.ndarray]]:
        """Names and numbers."""
        return list(zip(self.names, self.values(), strict=True))
