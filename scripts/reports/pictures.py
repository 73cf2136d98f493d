"""Draw the tasks and a training in motion.

The policy that ships for a task, of its own algorithm, flies it, in the aircraft of its trainings.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from quadrl import tasks
from quadrl.base.progress import Progress
from quadrl.core.scenario import Scenario
from quadrl.evaluation.policy import SHIPPED, Policy
from quadrl.evaluation.rollout import fly
from quadrl.learning.config import TrainConfig
from quadrl.learning.train import Training
from quadrl.rendering import render_trajectory
from quadrl.rendering.overlay import grid
from scripts.reports.report import IMAGES

SHOWN = (360, 203)  # [pixels]; drawn twice as large, for smooth edges
SETTLED = 0.05  # of the largest distance from the last position: little happens after that
LONGEST = 6.0  # [s] of a task's flight that are shown
OPTIONS: dict[str, dict[str, float]] = {  # of the task as it is shown: a wall, sea state 4
    "perching": {"least_incline": math.pi / 2},
    "deck_landing": {"lowest_waves": 1.25, "highest_waves": 2.5},
}
FASTEST = ("deck_landing", "lsy_race", "perching", "race")
RACED = 300  # flights of those, the fastest of which is shown
# The training: four policies fly the same start.
SEED, SHARES = 225, (0.0, 0.12, 0.3, 1.0)  # of the training
RELEASED = {"radius": 1.2, "tilt": 0.3, "max_distance": 6.0, "time_limit": 6.0}
PANEL = (400, 225)  # [pixels]
FPS, LAST = 12.5, 1.5  # [1/s], [s] that the end is shown
QUALITY = 30  # a task is then under 250 kB
FLOWN = tuple(
    name
    for name, task in tasks.TASKS.items()
    if (SHIPPED / f"{name}_{task.trained_by}.safetensors").exists()
)


def pictures(only: tuple[str, ...] = (*FLOWN, "learning")) -> None:
    """Draw the tasks and a training in motion.

    Args:
        only: What to draw.
    """
    (IMAGES / "tasks").mkdir(exist_ok=True)
    for name in only:
        frames = learning() if name == "learning" else flight(name)
        save(frames, IMAGES / ("learning.webp" if name == "learning" else f"tasks/{name}.webp"))


def save(frames: Iterable[Image.Image], file: Path) -> None:
    """Write frames as a picture that moves for ever."""
    first, *others = frames
    moving: Any = {"save_all": True, "append_images": others, "duration": round(1000 / FPS)}
    first.save(file, loop=0, quality=QUALITY, method=6, **moving)


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
        yield Image.fromarray(grid([frames[min(k, len(frames) - 1)] for frames in panels]))


def panel(policy: Policy, name: str) -> list[np.ndarray]:
    """A flight of a policy until its end, with a name in the corner."""
    scenario = Scenario.of("hover", **RELEASED)
    rollout = fly(policy, scenario, episodes=1, seed=5)
    flight, model = rollout.trajectory(scenario.aircraft), scenario.compile_model()
    width, height = PANEL
    drawn = render_trajectory(flight, model, fps=FPS, width=width, height=height, overlay=False)
    frames = [np.asarray(named(Image.fromarray(frame), name)) for frame in drawn]
    early = rollout.terminated[0]
    return [*frames, (frames[-1] * 0.45).astype(np.uint8)] if early else frames


def named(image: Image.Image, name: str) -> Image.Image:
    """A picture with a name in its corner."""
    outline = {"stroke_width": 2, "stroke_fill": (20, 30, 45)}
    font = ImageFont.load_default(15)
    ImageDraw.Draw(image).text((10, 8), name, (255, 255, 255), font, **outline)
    return image


def flight(name: str) -> Iterator[Image.Image]:
    """Frames of a flight of a task, until little happens."""
    policy, scenario = Policy.pretrained(name), TrainConfig(name).scenario
    shown = scenario.task.replace(**OPTIONS.get(name, {}))
    scenario = dataclasses.replace(scenario, task=shown)
    raced = fly(policy, scenario, episodes=RACED if name in FASTEST else 1)
    fastest = int(np.where(raced.is_success, raced.length, np.inf).argmin())
    flight, model = raced.trajectory(scenario.aircraft, fastest), scenario.compile_model()
    away = np.linalg.norm(flight.qpos[:, :3] - flight.qpos[-1, :3], axis=1)
    settled = flight.time[np.flatnonzero(away > SETTLED * away.max())[-1]]
    end = settled + LAST
    first = max(end - LONGEST, 0.0) if shown.contact else 0.0  # the touch is what counts
    times = np.arange(first, min(end, first + LONGEST), 1.0 / FPS)
    width, height = (2 * size for size in SHOWN)
    how: Any = {"width": width, "height": height, "overlay": False}
    if name == "race":  # other cameras have gates before the aircraft
        how |= {"camera": "chase"}
    how["speed_trail"] = name in ("lsy_race", "race")
    for frame in render_trajectory(flight, model, fps=FPS, times=times, **how):
        small = Image.fromarray(frame).resize(SHOWN, Image.Resampling.LANCZOS)
        yield named(small, name.replace("_", " "))
