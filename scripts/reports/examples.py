"""Trains hover with `quadrl train` and with each of docs/examples in the same wall clock.

Run it on a machine that does nothing else. For each seed, each example gets the seconds that
`quadrl train hover --engine mujoco` took from its first step to the saved policy, once with its
library's settings and once with quadrl's.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import tyro

from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import EVALUATION
from quadrl.studies.plan import PlannedRun
from scripts.reports import evaluation, report
from scripts.reports.report import ENVIRONMENT, Result, say, table

EXAMPLES = ("torchrl_ppo", "cleanrl_ppo", "sb3_ppo")
FIGURES = ("episodes", "success_rate", "survival_rate", "position_error_m")


def ours() -> dict[str, list[str]]:
    """Options that give each example quadrl's settings for hover, as far as it has them."""
    config = TrainConfig("hover")
    options = {"num-envs": config.num_envs, "num-steps": config.rollout, "gamma": config.gamma}
    options |= {"minibatch": config.ppo.minibatch, "epochs": config.ppo.epochs}
    options |= {"learning-rate": config.ppo.learning_rate}
    common = [text for name, value in options.items() for text in (f"--{name}", str(value))]
    # CleanRL and Stable-Baselines3 normalise the rewards; TorchRL and CleanRL anneal anyway.
    scale = ["--reward-scale", str(config.reward_scale)]
    ends = {"torchrl_ppo": scale, "cleanrl_ppo": [], "sb3_ppo": ["--anneal"]}
    return {name: [*common, *end] for name, end in ends.items()}


def main(
    seeds: tuple[int, ...] = (90, 91, 92),
    examples: tuple[str, ...] = EXAMPLES,
    steps: int | None = None,
) -> None:
    """Train everything in turn, `quadrl train` with its own or other steps, and write it down."""
    options, runs = ours(), []
    for seed in seeds:
        runs.append(train(seed, steps))
        seconds = runs[-1]["seconds"]
        for name in examples:
            for settings, given in (("library", []), ("quadrl", options[name])):
                runs.append(follow(name, seed, seconds, given) | {"settings": settings})
                say(runs[-1])
    report.save("examples", {"options": options, "runs": runs})


def train(seed: int, steps: int | None) -> Result:
    """A run of `quadrl train hover` in MuJoCo, where the examples fly too."""
    with tempfile.TemporaryDirectory() as scratch:
        run = PlannedRun(
            TrainConfig("hover", engine="mujoco", seed=seed, steps=steps), Path(scratch) / "run"
        )
        options = ("--engine=mujoco", f"--seed={seed}", f"--steps={run.config.steps}", "--no-video")
        call(sys.executable, "-m", "quadrl", "train", "hover", *options, f"--out={run.folder}")
        summary = json.loads((run.folder / EVALUATION).read_text())
        trained = evaluation.trained(run)
    known = {"example": "quadrl train", "settings": "quadrl", "seed": seed}
    known |= {"steps": trained["steps"], "seconds": trained["training_s"]}
    return known | {name: summary[name] for name in FIGURES}


def follow(name: str, seed: int, seconds: float, options: list[str]) -> Result:
    """A run of an example."""
    path = report.DOCS / "examples" / f"{name}.py"
    limits = ("--seed", str(seed), "--seconds", str(seconds))
    run = json.loads(call(sys.executable, str(path), *limits, *options))
    return {"example": name} | {key: run[key] for key in ("seed", "steps", "seconds", *FIGURES)}


def call(*command: str) -> str:
    """Standard output of a command, with this repository's package."""
    return subprocess.check_output(command, env=ENVIRONMENT, text=True)


def compared() -> str:
    """Hover by the examples beside `quadrl train`, all seeds together."""
    result = report.load("examples")
    groups: dict[tuple[str, str], list[Result]] = {}
    for run in result["runs"]:
        groups.setdefault((run["example"], run["settings"]), []).append(run)
    rows = []
    for (name, settings), runs in groups.items():
        shares = (sum(run[f"{x}_rate"] for run in runs) for x in ("survival", "success"))
        errors = ", ".join(f"{100 * run['position_error_m']:.1f}" for run in runs)
        rows.append((
            f"[`{name}`](examples/{name}.py)" if name in EXAMPLES else f"`{name}`",
            f"{settings}'s",
            f"{sum(run['seconds'] for run in runs) / len(runs):.1f} s",
            f"{sum(run['steps'] for run in runs) // len(runs):,}",
            *(f"{100 * share / len(runs):.0f} %" for share in shares),
            f"{errors} cm"
        ))  # fmt: skip
    head = ["trained by", "settings", "wall clock", "control steps", "flown to the end"]
    head += ["successful", "error by seed"]
    return f"{table(head, rows)}\n\n{report.source(result)}"


PARTS: report.Parts = {"examples": compared}

if __name__ == "__main__":
    tyro.cli(main)
