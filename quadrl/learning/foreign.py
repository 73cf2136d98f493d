"""What other programs call things, and what they are called here: the one table of such names."""

from __future__ import annotations

import csv
import dataclasses
import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError, UnknownKeyword
from quadrl.base.validation import keys, resolved
from quadrl.learning.settings import ALGORITHM_CONFIGS
from quadrl.learning.train_settings import USUAL

SB3 = "Stable-Baselines3 has it, and trains on quadrl.envs.sb3.QuadrotorVecEnv"
ALGORITHMS = {"sac": SB3, "td3": SB3, "ddpg": SB3, "a2c": "vpg", "pg": "vpg"}
COMMANDS = {
    **{
        "list": "tasks",
        "eval": "evaluate",
        "test": "evaluate",
        "ls": "runs",
        "play": "view",
        "video": "render",
    },
    "compare": "quadrl study FILE --compare success_rate compares algorithms and settings",
    "new": "new-task",
}
"""Names here, or sentences that say what to do."""
SETTINGS = {
    "learning_rate max_kl": "learning_rate lr policy_lr actor_lr pi_lr step_size",
    "critic_rate learning_rate": "critic_rate critic_lr value_lr vf_lr",
    "minibatch": "batch_size minibatch_size mini_batch_size num_minibatches num_mini_batches",
    "epochs critic_epochs": "epochs n_epochs num_epochs update_epochs num_learning_epochs",
    "critic_epochs epochs": "critic_epochs train_v_iters",
    "entropy": "ent_coef entropy_coef entropy_cost",
    "critic": "vf_coef value_coef value_loss_coef",
    "clip": "clip_range clip_coef clip_param clip_ratio clip_epsilon",
    "max_gradient": "max_grad_norm grad_clip gradient_clip",
    "max_kl": "target_kl desired_kl",
    "steps": "total_timesteps timesteps total_steps n_timesteps max_steps max_iterations",
    "rollout": "n_steps num_steps num_steps_per_env rollout_length unroll_length horizon",
    "num_envs": "n_envs num_environments envs",
    "gamma": "discount discounting discount_factor",
    "gae_lambda": "lam lambda lmbda gae",
    "hidden": "net_arch hidden_sizes hidden_dims hidden_layers layers policy_kwargs",
    "initial_deviation": "log_std_init init_noise_std init_std action_std",
    "evaluations": "eval_every eval_freq eval_interval evaluate_every",
    "device": "gpu cuda accelerator",
    "num_threads": "n_jobs num_workers workers threads",
    "log": "logger wandb tensorboard track report_to",
    "out": "run_name exp_name experiment_name save_dir output logdir log_dir folder",
    "config": "cfg config_file yaml",
    "from_run": "init_from load pretrained checkpoint load_run",
}
"""Names here, of which the first counts that the training has; and names elsewhere."""
OTHERWISE = {
    "the task comes first, by its name alone: hover": "task env env_id",
}  # fmt: skip
"""What to do instead, where there is no such setting."""

COLUMNS = {
    "steps": "steps step total_timesteps time/total_timesteps global_step timesteps",
    "seconds": "seconds time/time_elapsed",
    "success": "success success_rate eval/success_rate rollout/success_rate",
    "return": "return return_mean eval/return_mean eval/mean_reward rollout/ep_rew_mean reward",
}
"""Columns of a learning curve, and what a csv calls them; the first that has numbers counts."""
EPISODES = 100
"""Episodes of a monitor.csv that make a point of its curve, as in Stable-Baselines3's own logs."""


def read_curve(path: Path) -> dict[str, np.ndarray]:
    """Read the learning curve that another program wrote.

    Args:
        path: A csv whose columns are named as COLUMNS has them, in any case, perhaps behind the
            name of a run, as in W&B's exports (`NAME - eval/success_rate`). A column `value` is the
            success where it stays within 0 and 1, else the return. Or a monitor.csv of
            Stable-Baselines3, whose rows are episodes of one environment.

    Returns:
        Arrays (n,) by the names of COLUMNS: steps, and those of the others that it has; NaN where
        a row has no number.

    Raises:
        QuadrlError: It has no such columns.
    """
    with open(path, newline="", errors="replace") as file:
        rows = [*csv.DictReader(line for line in file if not line.startswith("#"))]
    columns = {
        head.rpartition(" - ")[2].strip().lower(): np.array([_number(row[head]) for row in rows])
        for head in (rows[0] if rows else ())
        if head  # None has the cells beyond the head
    }
    known = {name: column for name, column in columns.items() if np.isfinite(column).any()}
    if {"r", "l", "t"} <= {*known}:
        sums, count = np.cumsum(known["r"]), np.arange(1, len(rows) + 1)
        sums[EPISODES:] -= sums[:-EPISODES].copy()
        mean = sums / np.minimum(count, EPISODES)
        return {"steps": np.cumsum(known["l"]), "seconds": known["t"], "return": mean}
    if "value" in known:
        share = 0 <= np.nanmin(known["value"]) and np.nanmax(known["value"]) <= 1
        known["success" if share else "return"] = known["value"]
    found = {
        name: known[head]
        for name, others in COLUMNS.items()
        for head in [next((other for other in others.split() if other in known), None)]
        if head
    }
    for needs in (("steps",), ("success", "return")):
        if not {*needs} & {*found}:
            names = " ".join(COLUMNS[name] for name in needs).split()
            raise QuadrlError(f"{path} has no column of {' or '.join(needs)}: {', '.join(names)}")
    order = np.argsort(found["steps"], kind="stable")[: np.isfinite(found["steps"]).sum()]
    return {name: column[order] for name, column in found.items()}


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return np.nan


def setting(name: str, algo: str, *, guess: bool = True) -> str:
    """Find what a setting is called in a training with an algorithm; or guess it, if misspelt.

    Returns:
        Its name, as `ppo.learning_rate`; or what to do instead, in words; "" if nothing is like it.
    """
    word = name.lower().replace("-", "_").rpartition(".")[2]
    own = {one.name: f"{algo}.{one.name}" for one in dataclasses.fields(ALGORITHM_CONFIGS[algo])}
    known = {one: one for one in USUAL} | {"out": "out", "config": "config"} | own
    known = {one: full for one, full in known.items() if one not in ("task", *ALGORITHM_CONFIGS)}
    for answer, elsewhere in SETTINGS.items():
        if word in elsewhere.split():
            return next((known[one] for one in (word, *answer.split()) if one in known), "")
    for answer, elsewhere in OTHERWISE.items():
        if word in elsewhere.split():
            return answer
    near = difflib.get_close_matches(word, known, n=1) if guess or word in known else []
    return known[near[0]] if near else ""


def refuse_unknown(what: str, given: Iterable[str], choices: Iterable[str], algo: str) -> None:
    """Refuse the first name of a setting that is none of the choices, and say what is meant.

    Raises:
        UnknownKeyword: The message lists the choices if nothing is like the name.
    """
    choices = [*choices]
    for name in given:
        if name not in choices and (meant := setting(name, algo)):
            group, dot, word = meant.partition(".")
            written = f', given as {group}={{"{word}": ...}}' if dot else ""
            hint = f"; {meant}" if " " in meant else f" (did you mean {meant}{written}?)"
            raise UnknownKeyword(name=what, value=name, allowed=f"a known one{hint}")
    keys(what, given, choices)


def refuse_idle(name: str, given: Any, usual: tuple[dict[str, Any], ...], algo: str) -> None:
    """Refuse settings of an algorithm that does not train, since they would do nothing.

    What is usual may be there: `dataclasses.replace` passes all fields on.

    Raises:
        QuadrlError: The message says what the setting may be called with that algorithm.
    """
    if not isinstance(given, dict):
        given = dataclasses.asdict(resolved(name, given, ALGORITHM_CONFIGS[name], word="setting"))
    for key, value in given.items():
        if value not in [layers.get(key) for layers in usual]:
            meant = setting(key, algo, guess=False)
            hint = f"did you mean {meant}?" if meant else ""
            allowed = f"left out with algo {algo}"
            raise QuadrlError(hint, name=f"{name}.{key}", value=value, allowed=allowed)
