"""Draws the pictures of the tasks, of wind, a training in motion, and with --run what it made.

The PPO policy that ships for a task flies it; the geometric controller flies what has no policy.
"""

from __future__ import annotations

import itertools
import math
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont
from scipy.integrate import cumulative_trapezoid

from quadrl import tasks
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.progress import Progress
from quadrl.conditions.weather import Weather
from quadrl.engines import mjcf
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.policy import SHIPPED, Policy
from quadrl.evaluation.rollout import Rollout, fly
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import LEARNING_CURVE
from quadrl.learning.show import plot
from quadrl.learning.train import Training
from quadrl.rendering import Renderer, render_trajectory
from scripts.reports.report import IMAGES

MOMENTS, DRAWN, SHOWN = 4, (640, 360), (320, 180)  # drawn larger, for smooth edges [pixels]
SETTLED = 0.05  # of the largest distance from the last position: little happens after that
# The flight of the first picture begins farther away than those of the training, to be seen.
RELEASE = {"radius": 2.6, "max_distance": 6.0, "tilt": 0.5}
EPISODES, SECONDS, POSES, FPS = 512, 8.0, 4, 60.0
SIZE = (1600, 500)  # [pixels]
CAMERA_DISTANCE, ELEVATION = 1.75, -16.0  # [m], [deg]
# The moving picture: four policies of one training fly the same start.
SHARES = (0.0, 0.12, 0.3, 1.0)  # of the training
RELEASED = {"radius": 1.2, "tilt": 0.3, "max_distance": 6.0, "time_limit": 6.0}
# Wind: a picture of policies in it, and the plot of a flight through a gust.
WINDY = (("landing", "light", 1.6), ("hover", "light", 5.0), ("hover", "severe", 1.0))
"""Task, weather and moment [s]."""
TILE = (640, 400)  # [pixels]
GUST = Weather(gust_speed=9.0, gust_time=2.0)
PANEL, PANEL_FPS, LAST = (400, 225), 12.5, 1.5  # [pixels], [1/s], [s] that the end is shown


def main(run: Path | None = None, seed: int = 225) -> None:
    """Draw them.

    Args:
        run: Folder of a training of hover, for its flight and its learning curve.
        seed: Of the training that the moving picture shows.
    """
    if run:
        rollout = fly(Policy.load(run), tasks.make("hover", **RELEASE), episodes=EPISODES, seed=5)
        picture = exposure(rollout, most_direct(rollout))
        Image.fromarray(picture).save(IMAGES / "hover.png", optimize=True)
        shutil.copy(run / LEARNING_CURVE, IMAGES)
    rows = {name: np.hstack(list(moments(name))) for name in tasks.TASKS}
    (IMAGES / "tasks").mkdir(exist_ok=True)
    for name, row in rows.items():
        Image.fromarray(row).save(IMAGES / "tasks" / f"{name}.jpg", quality=88, optimize=True)
    whole = np.vstack(list(rows.values()))
    Image.fromarray(whole).save(IMAGES / "tasks.jpg", quality=88, optimize=True)
    Image.fromarray(windy()).save(IMAGES / "wind.jpg", quality=88, optimize=True)
    path = plot(evaluate("hover", episodes=1, seed=4, weather=GUST)).save(IMAGES / "gust.png")
    Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)
    first, *others = learning(seed)
    first.save(
        IMAGES / "learning.webp",
        save_all=True,
        append_images=others,
        duration=round(1000 / PANEL_FPS),
        loop=0,
        quality=50,
        method=6,
    )


def windy() -> np.ndarray:
    """Policies in wind, side by side."""
    pictures = []
    for name, weather, moment in WINDY:
        flown = evaluate(name, episodes=1, seed=1, weather=weather)
        task, flight = flown.task, flown.rollout.trajectory(flown.vehicle)
        model = mjcf.compile_model(flown.vehicle, contact=task.contact, scene=task.scene)
        size = {"width": TILE[0], "height": TILE[1], "fine": True}
        pictures += list(render_trajectory(flight, model, times=[moment], **size))
    return np.hstack(pictures)


def learning(seed: int) -> Iterator[Image.Image]:
    """Frames of four policies of one training of hover, from the same start, side by side."""
    config = TrainConfig("hover", seed=seed)
    wanted = [max(1, round(share * config.iterations)) for share in SHARES]
    policies: list[Policy] = []

    def keep(progress: Progress) -> None:
        if progress.iteration in wanted:
            policies.append(training.policy())

    with tempfile.TemporaryDirectory() as folder:
        training = Training(config, Path(folder, "run"))
        training.run(keep)
    batch = config.num_envs * config.rollout
    names = [f"after {number * batch:,} control steps" for number in wanted]
    panels = [panel(*each) for each in zip(policies, names, strict=True)]
    count = max(map(len, panels)) + round(LAST * PANEL_FPS)
    for k in range(count):
        top, bottom = (
            np.hstack([frames[min(k, len(frames) - 1)] for frames in panels[i : i + 2]])
            for i in (0, 2)
        )
        yield Image.fromarray(np.vstack([top, bottom]))


def panel(policy: Policy, name: str) -> list[np.ndarray]:
    """A flight of a policy until its end, with a name in the corner."""
    vehicle, task = Vehicle(), tasks.make("hover", **RELEASED)
    rollout = fly(policy, task, episodes=1, seed=5)
    width, height = PANEL
    frames = render_trajectory(
        rollout.trajectory(vehicle),
        mjcf.compile_model(vehicle),
        fps=PANEL_FPS,
        width=width,
        height=height,
        overlay=False,
    )
    font, drawn = ImageFont.load_default(15), []
    for frame in frames:
        image = Image.fromarray(frame)
        ImageDraw.Draw(image).text(
            (10, 8), name, (255, 255, 255), font, stroke_width=2, stroke_fill=(20, 30, 45)
        )
        drawn.append(np.asarray(image))
    if rollout.terminated[0]:
        drawn.append((drawn[-1] * 0.45).astype(np.uint8))  # over
    return drawn


def moments(name: str) -> Iterator[np.ndarray]:
    """A few pictures of a flight of a task, until little happens."""
    task, file, vehicle = tasks.make(name), SHIPPED / f"{name}_ppo.safetensors", Vehicle()
    controller = Policy.load(file) if file.exists() else make_controller("geometric", task)
    rollout = fly(controller, task, episodes=1)
    flight = rollout.trajectory(vehicle)
    away = np.linalg.norm(flight.qpos[:, :3] - flight.qpos[-1, :3], axis=1)
    last = int(np.flatnonzero(away > SETTLED * away.max())[-1])
    fps = (MOMENTS - 0.9) / (flight.time[last] - flight.time[0])
    model = mjcf.compile_model(vehicle, contact=task.contact, scene=task.scene)
    every = math.ceil(1 / fps)  # one picture a second is the slowest that is drawn
    width, height = DRAWN
    frames = render_trajectory(flight, model, fps=fps * every, width=width, height=height)
    for frame in itertools.islice(frames, 0, MOMENTS * every, every):
        yield np.asarray(Image.fromarray(frame).resize(SHOWN, Image.Resampling.LANCZOS))


def most_direct(rollout: Rollout) -> int:
    """The flight of least detour among the long and level ones."""
    path = rollout.position[: round(SECONDS / rollout.control_timestep)]
    away = np.linalg.norm(path[0, :, :2], axis=-1)
    length = np.linalg.norm(np.diff(path, axis=0), axis=-1).sum(0)
    detour = length / np.linalg.norm(path[0], axis=-1)
    height = np.ptp(path[..., 2], axis=0)
    shown = (away > 2.2) & (height < 0.6) & rollout.is_success
    if not shown.any():
        raise SystemExit("this policy has no flight that would make a picture")
    return int(np.where(shown, detour, math.inf).argmin())


def exposure(rollout: Rollout, episode: int) -> np.ndarray:
    """Several moments of one flight in one picture, from the start on the left to the goal."""
    vehicle = Vehicle()
    model = mjcf.compile_model(vehicle)
    flight = rollout.trajectory(vehicle, episode).resampled(FPS)
    last = int(np.searchsorted(flight.time, SECONDS)) - 1
    position, goal = flight.qpos[: last + 1, :3], flight.goal[0]
    to_goal = goal - position[0]
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat = goal - 0.46 * to_goal
    camera.distance, camera.elevation = CAMERA_DISTANCE, ELEVATION
    camera.azimuth = math.degrees(math.atan2(to_goal[1], to_goal[0])) + 90.0
    left = np.linalg.norm(position - position[last], axis=1)
    shares = np.arange(POSES - 1, 0, -1) / (POSES - 1)
    chosen = [int(np.abs(left - left[0] * share).argmin()) for share in shares] + [last]
    spins = -np.sign(model.actuator_gear[:, 5])  # the aircraft feels the opposite torque
    angles = spins * cumulative_trapezoid(flight.rotor_speed, flight.time, axis=0, initial=0)
    absent = flight.qpos[0].copy()
    absent[2] += 1000.0
    with Renderer(model, *SIZE) as renderer:
        shared = {"camera": camera, "goal": goal, "trail": position}
        background = renderer.frame(absent, **shared).astype(float)
        picture = background.copy()
        for k in chosen:
            frame = renderer.frame(flight.qpos[k], rotor_angles=angles[k], **shared)
            change = np.abs(frame - background).max(axis=-1, keepdims=True)
            cover = np.clip((change - 4.0) / 14.0, 0.0, 1.0)  # noise stays out, edges stay smooth
            picture += cover * (frame - picture)
    return picture.round().clip(0, 255).astype(np.uint8)


if __name__ == "__main__":
    tyro.cli(main)
