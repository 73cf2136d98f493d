"""Says where the wall clock of a training goes, part by part, in either engine.

Run it on a machine that does nothing else. The parts are timed from outside, so that the training
is the one that everybody runs.
"""

from __future__ import annotations

import contextlib
import functools
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import torch
import tyro
from torchrl.objectives.value import GAE

from quadrl.engines.mujoco import ENGINES, BatchEngine
from quadrl.environment import Environment
from quadrl.learning.config import TrainConfig
from quadrl.learning.ppo import PPO
from quadrl.learning.train import Training
from scripts.reports import report
from scripts.reports.report import table

TIMED: dict[str, tuple[Any, str]] = {
    "simulation": (BatchEngine, "advance"),
    "steps": (Environment, "step"),
    "resets": (Environment, "reset"),
    "advantages": (GAE, "forward"),
    "gradient": (torch.Tensor, "backward"),
    "optimiser": (torch.optim.Adam, "step"),
    "update": (PPO, "update"),
    "checkpoints": (Training, "save"),
    "all": (Training, "run"),
}
"""Class and method; a part may lie within another."""


def main(task: str = "hover", steps: int | None = None) -> None:
    """Train, and write down where the time went.

    Args:
        task: Name of the task.
        steps: Control steps of the training; by default the task's own.
    """
    settings = {"steps": steps} if steps else {}
    configs = {engine: TrainConfig(task, engine=engine, **settings) for engine in ENGINES}
    seconds = {engine: profile(config) for engine, config in configs.items()}
    result = {"task": task, "steps": configs[ENGINES[0]].steps, "seconds": seconds}
    report.save("wall_clock", result)


def profile(config: TrainConfig) -> dict[str, float]:
    """Seconds of each part of a training, none of them counted twice; they add up to all of it."""
    took = dict.fromkeys(TIMED, 0.0)

    def timed(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(original)
        def call(*arguments: Any, **named: Any) -> Any:
            began = time.perf_counter()
            try:
                return original(*arguments, **named)
            finally:
                took[name] += time.perf_counter() - began

        return call

    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        for name, (kind, method) in TIMED.items():
            wrapped = timed(name, getattr(kind, method))
            stack.enter_context(mock.patch.object(kind, method, wrapped))
        Training(config, Path(folder) / "run").run()
    outer = ("steps", "resets", "advantages", "update", "checkpoints")
    return {
        "simulation": took["simulation"],
        "observation, reward, resets": took["steps"] + took["resets"] - took["simulation"],
        "policy, collector, log": took["all"] - sum(took[name] for name in outer),
        "advantages": took["advantages"],
        "loss": took["update"] - took["gradient"] - took["optimiser"],
        **{name: took[name] for name in ("gradient", "optimiser", "checkpoints", "all")},
    }


def shown() -> str:
    """The parts in both engines."""
    result = report.load("wall_clock")
    engines = result["seconds"]
    rows = (
        (part, *(f"{x[part]:.2f} s ({x[part] / x['all']:.0%})" for x in engines.values()))
        for part in next(iter(engines.values()))
    )
    head = (f"a training of {result['task']}, {result['steps']:,} steps", *engines)
    return f"{table(head, rows)}\n\n{report.source(result)}"


PARTS: report.Parts = {"wall-clock": shown}

if __name__ == "__main__":
    tyro.cli(main)
