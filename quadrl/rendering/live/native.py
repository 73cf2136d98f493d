"""MuJoCo's own viewer, for one aircraft, where there is a screen."""

from __future__ import annotations

import contextlib
import queue
import time
import warnings

import glfw
import mujoco

from quadrl.base.errors import QuadrlError, RenderingUnavailable
from quadrl.engines.mujoco import DataEngine
from quadrl.rendering import drawing, scene
from quadrl.rendering.live.flight import Flight

FRAME = 1 / 60  # [s]
SPACE, RESET = 32, ord("R")  # keys, as GLFW numbers them


def check_screen() -> None:
    """Refuse a machine without a screen.

    Raises:
        RenderingUnavailable: There is none.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # GLFW's, about the missing screen
        found = glfw.init()
    if not found:
        raise RenderingUnavailable(
            "MuJoCo's viewer needs a screen: leave out --native and open the page in a browser"
        )
    glfw.terminate()


def run(flight: Flight) -> None:
    """Fly and draw until the window is closed; space pauses, R begins anew.

    The mouse pulls the aircraft in flight (double click, then Ctrl and the right button).

    Raises:
        RenderingUnavailable: MuJoCo cannot open a window on the screen.
        QuadrlError: There is more than one aircraft.
    """
    engine = flight.environment.engine
    if not isinstance(engine, DataEngine):
        raise QuadrlError(name="num_envs", value=engine.num_envs, allowed="1 with --native")
    from mujoco import viewer

    model = flight.scenario.compile_model()
    shown, pressed = mujoco.MjData(model), queue.SimpleQueue()
    _draw(flight, model, shown)
    try:
        window = viewer.launch_passive(
            model, shown, key_callback=pressed.put, show_left_ui=False, show_right_ui=False
        )
    except RuntimeError as error:  # on a Mac it says how to start Python
        raise RenderingUnavailable(f"MuJoCo's viewer cannot open a window: {error}") from error
    with window:
        window.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        window.cam.trackbodyid = model.body("aircraft").id
        window.cam.distance, window.cam.elevation = 2.0 * flight.vehicle.scale, -20.0
        last = time.perf_counter()
        while window.is_running():
            now = time.perf_counter()
            while not pressed.empty():
                key = pressed.get()
                if key == SPACE:
                    flight.paused = not flight.paused
                elif key == RESET:
                    flight.reset()
            engine.data.xfrc_applied[1] = shown.xfrc_applied[model.body("aircraft").id]
            flight.advance(now - last)
            last = now
            with window.lock():
                _draw(flight, model, shown, window.user_scn)
            window.sync()
            time.sleep(max(0.0, FRAME - (time.perf_counter() - now)))


def _draw(
    flight: Flight,
    model: mujoco.MjModel,
    shown: mujoco.MjData,
    beside: mujoco.MjvScene | None = None,
) -> None:
    """Put the drawn aircraft where the flight is, and markers beside it, as many as it takes."""
    pose = flight.drawn()[0]
    shown.qpos[:7] = pose[:7]
    scene.place(model, shown, pose[7:])
    if beside is not None:
        beside.ngeom = 0
        with contextlib.suppress(QuadrlError):
            scene.add(beside, drawing.markers(flight.markers(0)))
