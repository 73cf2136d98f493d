"""MuJoCo's own viewer, for one aircraft, where there is a screen."""

from __future__ import annotations

import queue
import time
import warnings

import glfw
import mujoco
import numpy as np

from quadrl.base.errors import QuadrlError, RenderingUnavailable
from quadrl.engines import mjcf
from quadrl.engines.mujoco import DataEngine
from quadrl.rendering.live import shapes
from quadrl.rendering.live.flight import Flight

FRAME = 1 / 60  # [s]
LINE = 0.003  # [m], half the width of markers' lines
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

    What the mouse pulls (double click, then Ctrl and the right button) is pulled in the flight.

    Raises:
        RenderingUnavailable: There is no screen, or MuJoCo cannot open a window on it.
        QuadrlError: There is more than one aircraft.
    """
    engine = flight.environment.engine
    if not isinstance(engine, DataEngine):
        raise QuadrlError(name="num_envs", value=engine.num_envs, allowed="1 with --native")
    check_screen()
    from mujoco import viewer

    model = mjcf.compile_model(flight.vehicle, contact=flight.task.contact, scene=flight.task.scene)
    shown, pressed = mujoco.MjData(model), queue.SimpleQueue()
    _place(flight, model, shown)
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
                _place(flight, model, shown)
                _draw_markers(flight, window.user_scn)
            window.sync()
            time.sleep(max(0.0, FRAME - (time.perf_counter() - now)))


def _place(flight: Flight, model: mujoco.MjModel, shown: mujoco.MjData) -> None:
    """Put the drawn aircraft where the flight is, with its blades turned."""
    pose = flight.drawn()[0]
    shown.qpos[:7] = pose[:7]
    for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):
        stage(model, shown)
    for rotor, angle in enumerate(pose[7:]):
        shapes.turn_blades(model, shown, rotor, float(angle))


def _draw_markers(flight: Flight, scene: mujoco.MjvScene) -> None:
    """Markers as shapes of MuJoCo's, as many as the window takes."""
    kinds, sketch = mujoco.mjtGeom, shapes.sketch([(m, np.zeros(3)) for m in flight.markers(0)])
    scene.ngeom = 0

    def add(kind: mujoco.mjtGeom, size: float, place: np.ndarray, rgba: np.ndarray) -> int:
        if scene.ngeom < scene.maxgeom:
            geom = scene.geoms[scene.ngeom]
            flat = np.eye(3).ravel()
            mujoco.mjv_initGeom(geom, kind, np.full(3, size), place, flat, rgba.astype(np.float32))
            scene.ngeom += 1
        return scene.ngeom - 1

    for ball in sketch.balls:
        add(kinds.mjGEOM_SPHERE, ball[3], ball[:3], ball[4:])
    for (begin, end), colours in zip(sketch.lines, sketch.colours, strict=True):
        line = add(kinds.mjGEOM_CAPSULE, LINE, begin, np.append(colours[0], 1.0))
        mujoco.mjv_connector(scene.geoms[line], kinds.mjGEOM_CAPSULE, LINE, begin, end)
