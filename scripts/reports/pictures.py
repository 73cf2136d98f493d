"""Draw the pictures of the tasks and of a training in motion.

The PPO policy that ships for a task flies it; the geometric controller flies what has no policy.
"""

from __future__ import annotations

import itertools
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
from quadrl.core.task import Task
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.policy import SHIPPED, Policy
from quadrl.evaluation.rollout import EVALUATION_SEED, fly
from quadrl.learning.config import TrainConfig
from quadrl.learning.train import Training
from quadrl.rendering import render_trajectory
from scripts.reports.report import IMAGES

MOMENTS, SHOWN = 4, (320, 180)  # [pixels]; drawn twice as large, for smooth edges
SETTLED = 0.05  # of the largest distance from the last position: little happens after that
# The moving picture: four policies of one training fly the same start.
SEED, SHARES = 225, (0.0, 0.12, 0.3, 1.0)  # of the training
RELEASED = {"radius": 1.2, "tilt": 0.3, "max_distance": 6.0, "time_limit": 6.0}
PANEL: Any = {"width": 400, "height": 225, "overlay": False}  # [pixels]
FPS, LAST = 12.5, 1.5  # [1/s], [s] that the end is shown


def pictures() -> None:
    """Draw the pictures of the tasks and of a training in motion."""
    rows = {name: np.hstack(list(moments(name))) for name in tasks.TASKS}
    (IMAGES / "tasks").mkdir(exist_ok=True)
    stills = {f"tasks/{name}": row for name, row in rows.items()}
    for name, picture in (*stills.items(), ("tasks", np.vstack([*rows.values()]))):
        Image.fromarray(picture).save(IMAGES / f"{name}.jpg", quality=88, optimize=True)
    first, *others = learning()
    moving: Any = {"save_all": True, "append_images": others, "duration": round(1000 / FPS)}
    first.save(IMAGES / "learning.webp", loop=0, quality=50, method=6, **moving)


def flown(flyer: Any, task: Task, seed: int = EVALUATION_SEED) -> tuple[Any, Any, bool]:
    """A flight, the model of what is drawn of it, and whether it ended early."""
    scenario = Scenario.of(task)
    rollout = fly(flyer, scenario, episodes=1, seed=seed)
    flight = rollout.trajectory(scenario.aircraft)
    return flight, scenario.compile_model(), bool(rollout.terminated[0])


def learning() -> Iterator[Image.Image]:
    """Frames of four policies of one training of hover, from the same start, side by side."""
    config = TrainConfig("hover", seed=SEED)
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
    count = max(map(len, panels)) + round(LAST * FPS)
    for k in range(count):
        top, bottom = (
            np.hstack([frames[min(k, len(frames) - 1)] for frames in panels[i : i + 2]])
            for i in (0, 2)
        )
        yield Image.fromarray(np.vstack([top, bottom]))


def panel(policy: Policy, name: str) -> list[np.ndarray]:
    """A flight of a policy until its end, with a name in the corner."""
    flight, model, early = flown(policy, tasks.make("hover", **RELEASED), 5)
    font, frames = ImageFont.load_default(15), []
    for frame in render_trajectory(flight, model, fps=FPS, **PANEL):
        image, outline = Image.fromarray(frame), {"stroke_width": 2, "stroke_fill": (20, 30, 45)}
        ImageDraw.Draw(image).text((10, 8), name, (255, 255, 255), font, **outline)
        frames.append(np.asarray(image))
    return [*frames, (frames[-1] * 0.45).astype(np.uint8)] if early else frames


def moments(name: str) -> Iterator[np.ndarray]:
    """A few pictures of a flight of a task, until little happens."""
    task, file = tasks.make(name), SHIPPED / f"{name}_ppo.safetensors"
    controller = Policy.load(file) if file.exists() else make_controller("geometric", task)
    flight, model, _ = flown(controller, task)
    away = np.linalg.norm(flight.qpos[:, :3] - flight.qpos[-1, :3], axis=1)
    last = int(np.flatnonzero(away > SETTLED * away.max())[-1])
    fps = (MOMENTS - 0.9) / (flight.time[last] - flight.time[0])
    every = math.ceil(1 / fps)  # one picture a second is the slowest that is drawn
    frames = render_trajectory(flight, model, fps=fps * every, width=640, height=360)
    for frame in itertools.islice(frames, 0, MOMENTS * every, every):
        yield np.asarray(Image.fromarray(frame).resize(SHOWN, Image.Resampling.LANCZOS))
