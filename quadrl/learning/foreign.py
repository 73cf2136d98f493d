"""What other programs call things, and what they are called here: the one table of such names."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable

from quadrl.base.errors import UnknownKeyword
from quadrl.base.validation import keys
from quadrl.learning.settings import ALGORITHM_CONFIGS, USUAL

SB3 = "Stable-Baselines3 has it, and trains on quadrl.envs.sb3.QuadrotorVecEnv"
ALGORITHMS = {"sac": SB3, "td3": SB3, "ddpg": SB3, "a2c": "vpg", "pg": "vpg"}
COMMANDS = {
    **{"list": "tasks", "eval": "evaluate", "test": "evaluate", "play": "view", "video": "render"},
    "compare": "quadrl study FILE --compare success_rate compares algorithms and settings",
    "new-task": "a task is a Python file of your own that --import names: see docs/own_task.md",
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
    "out": "name run_name exp_name experiment_name save_dir output logdir log_dir folder",
    "from_run": "init_from load pretrained checkpoint load_run",
}
"""Names here, of which the first counts that the training has; and names elsewhere."""
OTHERWISE = {
    "the task comes first, by its name alone: hover": "task env env_id",
    "a file of quadrl study holds settings of trainings": "config cfg",
    "a run folder holds TensorBoard's files, and quadrl.train(on_progress=...) hands over each row":
        "tensorboard log logger wandb track",
}  # fmt: skip
"""What to do instead, where there is no such setting."""


def setting(name: str, algo: str, *, guess: bool = True) -> str:
    """Find what a setting is called in a training with an algorithm; or guess it, if misspelt.

    Returns:
        Its name, as `ppo.learning_rate`; or what to do instead, in words; "" if nothing is like it.
    """
    word = name.lower().replace("-", "_").rpartition(".")[2]
    own = {one.name: f"{algo}.{one.name}" for one in dataclasses.fields(ALGORITHM_CONFIGS[algo])}
    known = {one: one for one in USUAL} | {"out": "out"} | own
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
