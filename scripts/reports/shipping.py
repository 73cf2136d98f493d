"""Copy trained policies into the assets: `ship`."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Annotated, Any

import tyro

from quadrl import tasks
from quadrl.base.files import write_json
from quadrl.base.units import quantity
from quadrl.cli.tasks import settings
from quadrl.core.task import Target
from quadrl.evaluation.policy import SHIPPED, SHIPPED_AS, Policy
from quadrl.evaluation.policy_file import FILE
from quadrl.evaluation.rollout import fly, summarize
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import FREE
from scripts.reports.report import Result, say

EPISODES = 2000
CALM: Any = {"weather": "calm", "randomization": "none"}


def ship(runs: Annotated[tuple[Path, ...], tyro.conf.Positional], out: Path = SHIPPED) -> None:
    """Copy trained policies into assets/policies, where they come with the package.

    For each task, algorithm and variant it takes the run with the lowest seed, never the best one,
    and leaves it out if it misses a target of its task where nothing disturbs it:
    `scripts/report ship runs/paper/*`.

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
        if config.variant != "ideal":
            kind = "_".join((config.variant, config.vehicle)).removesuffix("_paper")
        chosen.setdefault(f"{config.task}_{kind}", (config, run))
    for name, (config, run) in sorted(chosen.items()):
        say(f"{name}: {copied(run, config, out / f'{name}.safetensors')}")


def unmet(task: str, metrics: Result) -> list[Target]:
    """The targets of a task that an evaluation misses."""
    return [target for target in tasks.TASKS[task].targets if not target.met(metrics)]


def copied(run: Path, config: TrainConfig, file: Path) -> str:
    """Copy a policy with its configuration, its metrics and the command that makes it again."""
    usual = TrainConfig(
        config.task, algo=config.algo, vehicle=config.vehicle, variant=config.variant
    )
    named = (*FREE, "seed", "engine", "from_run")
    if config.from_run:  # a second training
        named += ("randomization", "training_options")
    free = {name: getattr(usual, name) for name in named}
    if dataclasses.replace(config, **free) != usual:
        return f"left out, {run} has other settings than `quadrl train` gives"
    policy, given = Policy.load(run), {"vehicle": config.scenario.aircraft}
    metrics = summarize(fly(policy, config.scenario.task, episodes=EPISODES, **given))
    said = f"seed {config.seed}, {100 * metrics['success_rate']:.1f} % of {EPISODES}"
    still = summarize(fly(policy, config.scenario.task, episodes=EPISODES, **given, **CALM))
    missed = unmet(config.task, still)
    ways = "".join(f", {x.words} {quantity(x.metric, still[x.metric])}" for x in missed)
    if missed:
        for old in (file, file.with_suffix(".json")):
            old.unlink(missing_ok=True)
        return f"left out, misses what its task asks: {said} successful{ways}"
    drawn = config.randomization
    told = {
        "algo": (config.algo, None),
        "seed": (config.seed, None),
        "vehicle": (config.vehicle, TrainConfig.vehicle),
        "from": (config.from_run.partition("@")[0], ""),
        "randomization": (f"'{json.dumps(drawn)}'", f"'{json.dumps(usual.randomization)}'"),
        "training_options": (config.training_options, usual.training_options),
        "engine": (config.engine, usual.engine),
        "variant": (config.variant, "ideal"),
    }
    words = settings({name: value for name, (value, given) in told.items() if value != given})
    command = " ".join(("quadrl train", config.task, *words))
    file.parent.mkdir(parents=True, exist_ok=True)
    policy.save(file)
    beside = {"command": command, "evaluation": metrics, "config": config.resolved()}
    write_json(file.with_suffix(".json"), beside)
    return f"{said} successful"
