"""Pictures of flights in progress, one at a time."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np

from quadrl.base.errors import RenderingUnavailable
from quadrl.base.rotation import Array, norm
from quadrl.base.validation import number
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.core.trajectory import outcome
from quadrl.engines import mjcf
from quadrl.rendering.camera import MOVING, eased, keeping, moving_camera, moving_views
from quadrl.rendering.drawing import TRAIL_SECONDS, streaks
from quadrl.rendering.overlay import Panel, flight_lines, task_title
from quadrl.rendering.scene import Renderer


class Pictures:
    """Draws the aircraft of an environment; opens the renderer at the first picture.

    The camera is eased from one picture of an episode to the next. A panel with time, error, speed,
    reward, wind, horizon, rotor speeds and, at its end, the outcome of the episode is laid over
    pictures that are large enough (from about 370 x 280 pixels on), where Pillow is installed.
    """

    def __init__(self, environment: Environment, camera: str, width: int, height: int) -> None:
        """Note what to draw, on pictures of width x height pixels."""
        self._environment, self._camera = environment, camera
        self._width = number("width", width, 1, whole=True)
        self._height = number("height", height, 1, whole=True)
        self._drawn: Scenario | None = None
        self._renderer: Renderer | None = None
        self._panel: Panel | None = None
        self._flights: dict[int, LiveFlight] = {}  # by row

    def __getstate__(self) -> dict[str, Any]:
        """For pickle and deepcopy: a copy opens a renderer of its own."""
        return self.__dict__ | {"_renderer": None, "_panel": None}

    def frame(self, row: int = 0) -> np.ndarray:
        """The picture (height, width, 3) uint8 of one aircraft.

        Raises:
            RenderingUnavailable: This machine has no graphics library.
            QuadrlError: There is no such camera.
        """
        if self._drawn is not self._environment.scenario:  # not yet, or it was changed
            self.close()
            self._drawn = self._environment.scenario
        self._renderer = renderer = self._renderer or self._open()
        flight = self._flights.setdefault(row, LiveFlight(self._camera))
        picture = flight.picture(renderer, self._environment, row)
        if self._panel is not None:
            self._panel.draw(picture, *self._values(row))
        return picture

    def _open(self) -> Renderer:
        vehicle, task = self._environment.vehicle, self._environment.task
        model = self._environment.scenario.compile_model()
        renderer = Renderer(model, self._width, self._height)
        with contextlib.suppress(RenderingUnavailable):  # without Pillow
            colours = [mjcf.rotor_colour(rotor.position) for rotor in vehicle.rotors]
            windy = not self._environment.scenario.calm
            panel = Panel(self._height, task_title(task.name), colours, windy)
            self._panel = panel if panel.fits(self._width, self._height) else None
        return renderer

    def _values(self, row: int) -> tuple[Any, ...]:
        """Arguments of `Panel.draw` for a row: all after the picture."""
        environment = self._environment
        now, done, reward, end = environment.snapshot, environment.transition, 0.0, ""
        time, error = float(now.time[row]), environment.task.error(now)[row]
        if done is not None and time > 0:  # it is of this episode
            error, reward = done.error[row], done.reward[row]
            end = outcome(done.terminated[row], done.truncated[row], done.is_success[row])
        wind = None if environment.scenario.calm else float(norm(environment.engine.wind[row]))
        moment = time, float(error), float(now.state.speed[row]), float(reward)
        values = flight_lines(*moment, wind)
        shares = now.state.rotor_speed[row] / environment.vehicle.max_speed
        attitude, events = environment.engine.qpos[row][3:7], environment.happening(row)
        return [*values.values()], shares, attitude, end, events

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = self._panel = None


class LiveFlight:
    """Draws a flight in progress; keeps camera, trail and rotor angles between two pictures."""

    def __init__(self, camera: str) -> None:
        """Begin with nothing drawn yet."""
        self._camera = camera
        self._time = math.inf
        self._view = np.zeros(6)
        self._angles = np.zeros(0)
        self._drift = np.zeros(3)
        self._trail: list[tuple[float, Array]] = []

    def picture(self, renderer: Renderer, environment: Environment, row: int) -> Array:
        """Draw a row of an environment as it is now, (height, width, 3) colours.

        If the time since its episode began goes back or is 0, this is another flight.
        """
        time, qpos = float(environment.snapshot.time[row]), environment.engine.qpos[row]
        goal, markers = environment.goals()[row], environment.markers(row)
        position, camera = np.array(qpos[:3]), self._camera
        rotor_speed = environment.snapshot.state.rotor_speed[row]
        seconds = time - self._time
        if begins := seconds < 0 or time == 0:  # an episode may end before its second picture
            seconds, self._trail, self._drift = 0.0, [], np.zeros(3)
            self._angles = np.zeros(len(rotor_speed))
        self._angles = self._angles + renderer.spins * rotor_speed * seconds
        if not self._trail or seconds > 0:
            self._trail.append((time, position))
        self._trail = [point for point in self._trail if point[0] >= time - TRAIL_SECONDS]
        shown: Any = camera
        if camera in MOVING:
            seen = qpos[None], goal[None], [markers]
            view = moving_views(camera, *seen, renderer.scale, renderer.aspect)[0]
            self._view = view if begins else eased(view, self._view, seconds)
            size = renderer.scale, renderer.aspect
            shown = moving_camera(keeping(self._view[None], position[None], *size)[0])
        if not environment.scenario.calm:
            wind = environment.engine.wind[row]  # since the last picture
            self._drift = self._drift + wind * seconds
            markers = (*markers, *streaks(position, wind, self._drift, renderer.scale))
        self._time = time
        return renderer.frame(
            qpos,
            camera=shown,
            rotor_angles=self._angles,
            goal=goal,
            trail=np.array([point for _, point in self._trail]),
            markers=markers,
        )
