"""Draw the tasks and a training in motion.

The policy that ships for a task, of its own algorithm, flies it, in the aircraft of its trainings.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from quadrl import tasks
from quadrl.base.progress import Progress
from quadrl.core.scenario import Scenario
from quadrl.core.trajectory import Trajectory
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly
from quadrl.learning.config import TrainConfig
from quadrl.learning.train import Training
from quadrl.rendering import render_trajectory
from quadrl.rendering.camera import moving_camera
from quadrl.rendering.overlay import grid
from scripts.reports.report import IMAGES

SIZE = (360, 203)  # [pixels]
SETTLED = 0.05  # of the largest distance from the last position: little happens after that
LONGEST = 6.0  # [s] of a task's flight that are shown
OPTIONS: dict[str, dict[str, Any]] = {  # of the task as it is shown: a wall, sea state 4, an eight
    "perching": {"least_incline": math.pi / 2},
    "deck_landing": {"lowest_waves": 1.25, "highest_waves": 2.5},
    "trajectory": {"figure": "lemniscate"},
}
CAMERA: dict[str, Any] = {  # of a whole track, and near the eight of a small aircraft
    "race": moving_camera(np.array((2.3, 0.0, 1.5, 20.0, 120.0, -25.0))),
    "trajectory": moving_camera(np.array((0.0, 0.0, 2.95, 1.95, 75.0, -32.0))),
}
FASTEST = ("deck_landing", "lsy_race", "perching", "race")
RACED = 300  # flights of those, the fastest of which is shown
# The training: four policies fly the same start.
SEED, SHARES = 225, (0.0, 0.12, 0.3, 1.0)  # of the training
RELEASED: dict[str, Any] = {"radius": 1.2, "tilt": 0.3, "max_distance": 6.0, "time_limit": 6.0}
PANEL = (400, 225)  # [pixels]
FPS, LAST = 12.5, 1.5  # [1/s], [s] that the end is shown
QUALITY = 30  # a task is then under 250 kB


def pictures(only: tuple[str, ...] = (*tasks.TASKS, "learning")) -> None:
    """Draw the tasks and a training in motion.

    Args:
        only: What to draw.
    """
    (IMAGES / "tasks").mkdir(exist_ok=True)
    moving: Any = {"save_all": True, "duration": round(1000 / FPS), "loop": 0}  # for ever
    for name in only:
        first, *others = learning() if name == "learning" else flight(name)
        file = IMAGES / ("learning.webp" if name == "learning" else f"tasks/{name}.webp")
        first.save(file, append_images=others, quality=QUALITY, method=6, **moving)


def learning() -> Iterator[Image.Image]:
    """Frames of four policies of one training of hover, from the same start, side by side."""
    config = TrainConfig("hover", seed=SEED, evaluations=0)
    scenario = Scenario.of("hover", **RELEASED)
    wanted = [max(1, round(share * config.iterations)) for share in SHARES]
    panels: list[list[np.ndarray]] = []

    def show(progress: Progress) -> None:
        if progress.iteration not in wanted:
            return
        flown = fly(training.policy(), scenario, episodes=1, seed=5)
        name = f"after {progress.iteration * config.num_envs * config.rollout:,} control steps"
        pictures = drawn(flown.trajectory(scenario.aircraft), scenario, PANEL, name)
        frames = [np.asarray(picture) for picture in pictures]
        if flown.terminated[0]:
            frames.append((frames[-1] * 0.45).astype(np.uint8))
        panels.append(frames)

    with tempfile.TemporaryDirectory() as folder:
        training = Training(config, Path(folder, "run"))
        training.run(show)
    for k in range(max(map(len, panels)) + round(LAST * FPS)):
        yield Image.fromarray(grid([frames[min(k, len(frames) - 1)] for frames in panels]))


def flight(name: str) -> Iterator[Image.Image]:
    """Frames of a flight of a task, until little happens."""
    policy, scenario = Policy.pretrained(name), TrainConfig(name).scenario
    shown: Any = scenario.task.replace(**OPTIONS.get(name, {}))
    scenario = dataclasses.replace(scenario, task=shown)
    raced = fly(policy, scenario, episodes=RACED if name in FASTEST else 1)
    fastest = int(np.where(raced.is_success, raced.length, np.inf).argmin())
    # Alone, since a rollout has the markers of its first flight.
    flown = fly(policy, scenario, episodes=1, seed=fastest).trajectory(scenario.aircraft)
    away = np.linalg.norm(flown.qpos[:, :3] - flown.qpos[-1, :3], axis=1)
    settled = flown.time[np.flatnonzero(away > SETTLED * away.max())[-1]]
    end = settled + LAST
    first = max(end - LONGEST, 0.0) if shown.contact else 0.0  # the touch is what counts
    how: Any = {"speed_trail": name in ("lsy_race", "race"), "camera": CAMERA.get(name, "follow")}
    if name == "trajectory":  # the last round, after which the first picture fits again
        first, end = shown.time_limit - shown.cycle, shown.time_limit
    how["times"] = np.arange(first, min(end, first + LONGEST), 1.0 / FPS)
    words = name.replace("_", " ")
    if how["speed_trail"]:
        speed = np.linalg.norm(np.gradient(flown.qpos[:, :3], flown.time, axis=0), axis=1)
        words += f", trail: blue at rest, yellow at {speed.max():.0f} m/s"
    yield from drawn(flown, scenario, SIZE, words, enlarged=2, **how)


def drawn(
    flown: Trajectory, scenario: Scenario, size: tuple[int, int], name: str,
    enlarged: int = 1, **how: Any,
) -> Iterator[Image.Image]:  # fmt: skip
    """Pictures of a flight with a name in the corner; drawn larger they have smooth edges."""
    width, height = (enlarged * pixels for pixels in size)
    how |= {"fps": FPS, "width": width, "height": height, "overlay": False}
    font = ImageFont.load_default(15)
    for frame in render_trajectory(flown, scenario.compile_model(), **how):
        picture = Image.fromarray(frame).resize(size, Image.Resampling.LANCZOS)
        outline = {"stroke_width": 2, "stroke_fill": (20, 30, 45)}
        ImageDraw.Draw(picture).text((10, 8), name, (255, 255, 255), font, **outline)
        yield picture
