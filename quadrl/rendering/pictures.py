"""Pictures of a flight in progress, one at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array
from quadrl.core.markers import Marker
from quadrl.rendering.camera import MOVING, eased, keeping, moving_camera, moving_views
from quadrl.rendering.drawing import TRAIL_SECONDS, streaks
from quadrl.rendering.scene import Renderer


class LiveFlight:
    """What is kept between two pictures of a flight: camera, trail, angles of the rotors."""

    def __init__(self, camera: str) -> None:
        """Nothing has been seen yet."""
        self._camera = camera
        self._time = math.inf
        self._view = np.zeros(6)
        self._angles = np.zeros(0)
        self._drift = np.zeros(3)
        self._trail: list[tuple[float, Array]] = []

    def picture(
        self,
        renderer: Renderer,
        time: float,
        qpos: Array,
        rotor_speed: Array,
        goal: Array,
        markers: Sequence[Marker | Primitive],
        wind: Array | None = None,
    ) -> Array:
        """Draw the flight as it is now.

        Args:
            renderer: What draws.
            time: Since the episode began [s]; if it goes back or is 0, this is another flight.
            qpos: (7,) position [m] and attitude (w, x, y, z), world frame.
            rotor_speed: (R,) [rad/s].
            goal: (3,) [m], world frame.
            markers: World frame.
            wind: (3,) [m/s], world frame, since the last picture; None for calm air.

        Returns:
            (height, width, 3) colours.
        """
        position, camera = np.array(qpos[:3]), self._camera
        seconds = time - self._time
        begins = seconds < 0 or time == 0  # an episode may end before its second picture
        if begins:
            self._trail, self._angles = [], np.zeros(len(rotor_speed))
            self._drift = np.zeros(3)
        else:
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
        if wind is not None:
            self._drift = self._drift + wind * max(seconds, 0.0)
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
