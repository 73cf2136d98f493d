"""Copies trained policies into assets/policies, where they come with the package.

For each task, algorithm and variant it takes the run with the lowest seed among the folders, never
the best one, and leaves it out if it is not worth having: `scripts/report ship runs/paper/*`.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

import tyro

from quadrl.evaluation.policy import FILE, SHIPPED, SHIPPED_AS, Policy
from quadrl.evaluation.rollout import fly, summarize
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import FREE, write_json
from scripts.reports.report import say

EPISODES = 500
WORTH_HAVING = 0.9  # least share of successes


def main(runs: Annotated[tuple[Path, ...], tyro.conf.Positional], out: Path = SHIPPED) -> None:
    """Copy them.

    Args:
        runs: Run folders.
        out: Where the policies go; by default the assets.
    """
    found = [(TrainConfig.of_folder(run), run) for run in runs if (run / FILE).is_file()]
    if not found:
        sys.exit("none of the folders holds a finished run")
    chosen: dict[str, tuple[TrainConfig, Path]] = {}
    for config, run in sorted(found, key=lambda each: each[0].seed):
        kind = SHIPPED_AS.get(config.algo, config.algo)
        kind = kind if config.variant == "ideal" else config.variant
        chosen.setdefault(f"{config.task}_{kind}", (config, run))
    for name, (config, run) in sorted(chosen.items()):
        say(f"{name}: {ship(run, config, out / f'{name}.safetensors')}")


def ship(run: Path, config: TrainConfig, file: Path) -> str:
    """Copy a policy with its configuration, its metrics and the command that makes it again."""
    known = {name: getattr(config, name) for name in ("algo", "vehicle", "variant")}
    usual = TrainConfig(config.task, **known)
    free = {name: getattr(usual, name) for name in (*FREE, "seed", "engine")}
    if dataclasses.replace(config, **free) != usual:
        return f"left out, {run} has other settings than `quadrl train` gives"
    policy = Policy.load(run)
    rollout = fly(policy, config.make_task(), episodes=EPISODES, vehicle=config.make_vehicle())
    metrics = summarize(rollout)
    said = f"seed {config.seed}, {100 * metrics['success_rate']:.1f} %"
    if metrics["success_rate"] < WORTH_HAVING:
        for old in (file, file.with_suffix(".json")):
            old.unlink(missing_ok=True)
        return f"left out, not worth having: {said} of {EPISODES} successful"
    command = f"quadrl train {config.task} --algo {config.algo} --seed {config.seed}"
    command += "" if config.engine == usual.engine else f" --engine {config.engine}"
    command += "" if config.variant == "ideal" else f" --variant {config.variant}"
    file.parent.mkdir(parents=True, exist_ok=True)
    policy.save(file)
    beside = {"command": command, "evaluation": metrics, "config": config.resolved()}
    write_json(file.with_suffix(".json"), beside)
    return f"{said} of {EPISODES} successful"


if __name__ == "__main__":
    tyro.cli(main)
