"""A whole run: train, evaluate, draw."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from quadrl import mjcf
from quadrl.errors import RenderingUnavailable
from quadrl.learning.config import TrainConfig
from quadrl.learning.figures import learning_curve, trajectory
from quadrl.learning.folder import EVALUATION, LEARNING_CURVE, TRAJECTORY, VIDEO, write_json
from quadrl.learning.train import Progress, Training
from quadrl.rollout import MAX_EPISODES, Rollout, evaluate
from quadrl.validation import number
from quadrl.vehicle import VEHICLES, Vehicle


def train(
    config: TrainConfig | None,
    folder: Path,
    *,
    episodes: int = 100,
    video: bool = True,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    report: Callable[[str], None] = lambda line: None,
) -> tuple[TrainConfig, dict[str, Any]]:
    """Train a policy, evaluate it in MuJoCo and draw it, into a run folder.

    Args:
        config: The settings; None to continue the run in the folder.
        folder: Of the run.
        episodes: Of the evaluation.
        video: Whether to draw a flight.
        on_progress: Is called after each iteration.
        report: Is told, in a line, what the user should know.

    Returns:
        The settings, and the metrics of the evaluation with the wall clock training_s.

    Raises:
        QuadrlError: A setting or the folder cannot be used, or the training diverged.
    """
    number("episodes", episodes, 1, MAX_EPISODES, whole=True)
    resume, config = config is None, config or TrainConfig.of_folder(folder)
    training = Training(config, folder, resume=resume)
    if resume:
        report(f"continuing {folder} at iteration {training.iteration}")
    policy, vehicle = training.run(on_progress), VEHICLES[config.vehicle]
    metrics, rollout = evaluate(policy, config.make_task(), episodes=episodes, vehicle=vehicle)
    metrics["training_s"] = round(training.seconds, 2)
    write_json(folder / EVALUATION, metrics)
    draw(folder, rollout, vehicle, video=video, report=report)
    return config, metrics


def draw(
    folder: Path, rollout: Rollout, vehicle: Vehicle, *, video: bool, report: Callable[[str], None]
) -> None:
    """Draw the pictures of a run; without a graphics library the video is left out, with a line."""
    learning_curve(folder, folder / LEARNING_CURVE)
    title = f"{rollout.task.name}: mean action of the policy"
    trajectory(rollout, title, folder / TRAJECTORY)
    if not video:
        return
    from quadrl.rendering import write_video

    try:
        model = mjcf.compile_model(vehicle, contact=rollout.task.contact, scene=rollout.task.scene)
        write_video(rollout.trajectory(vehicle), model, folder / VIDEO)
    except RenderingUnavailable as error:
        report(f"no video: {error}")
