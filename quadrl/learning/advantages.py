"""Advantages of a batch, by generalised advantage estimation (Schulman et al. 2016)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.objectives.value import GAE
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from quadrl.learning.config import TrainConfig

LEAST = 1e-4
"""Deviation that advantages are divided by at least, as in torchrl."""
FOLLOWS = 0.02
"""How much of the way to the returns of a batch their running mean and deviation go."""


class Advantages:
    """Advantages of mean 0 and deviation 1, and the targets of the critic.

    Of several tasks in one, each has its own discount, its advantages are normalised alone, and so
    are its returns, which the critic learns (van Hasselt et al. 2016): otherwise a task whose
    rewards are small beside those of the others, or vary less, is learned last or lost again.
    """

    def __init__(self, config: TrainConfig, device: torch.device) -> None:
        """Take the discounts and lambda of a training, and where its batches are."""
        usual: Any = {"gamma": config.gamma, "lmbda": config.gae_lambda, "value_network": None}
        self._of_one = GAE(**usual, average_gae=True)
        tasks = len(config.training_scenario.task.parts)
        self._gammas = config.gammas or (config.gamma,) * tasks
        self._lambda = config.gae_lambda
        mean, deviation = torch.zeros(2, tasks, device=device)
        self.returns = {"mean": mean, "deviation": deviation}
        """Running ones of the returns of each task; a deviation is 0 before its first batch."""

    def __call__(self, batch: TensorDictBase, which: np.ndarray) -> None:
        """Add advantage and value_target to a batch (N, T) with the critic's values.

        Args:
            batch: Transitions.
            which: The number of the task of each, (N, T), from 0 on.
        """
        if len(self._gammas) == 1:
            self._of_one(batch)
            return
        now: Any = batch
        after = now["next"]
        mean, deviation = self.returns.values()
        own = torch.from_numpy(which).to(mean.device)[..., None]
        gamma = torch.tensor(self._gammas, device=mean.device)[own]
        values = (mean[own] + deviation[own] * x["state_value"] for x in (now, after))
        given = (*values, *(after[name] for name in ("reward", "done", "terminated")))
        found = vec_generalized_advantage_estimate(gamma, self._lambda, *given)
        advantage, returns = found
        for k in range(len(self._gammas)):
            if (of := own == k).any():
                part = advantage[of]
                advantage[of] = (part - part.mean()) / part.std(correction=0).clamp(min=LEAST)
                self._follow(k, returns[of])
        batch["advantage"] = advantage
        batch["value_target"] = (returns - mean[own]) / deviation[own]

    def _follow(self, task: int, returns: torch.Tensor) -> None:
        """Let the running mean and deviation of a task follow its returns."""
        was, deviation = (of[task].clone() for of in self.returns.values())
        share = FOLLOWS if deviation else 1.0
        mean = was + share * (returns.mean() - was)
        spread = (returns - was).square().mean() - (mean - was).square()
        square = (1 - share) * deviation.square() + share * spread
        self.returns["mean"][task] = mean
        self.returns["deviation"][task] = square.sqrt().clamp(min=LEAST)


def add_values(batch: Any, critic: TensorDictModuleBase) -> None:
    """Add the critic's values of all states and of the states after them.

    Within an episode the state after a step is the next one of the batch, whose value is known.
    """
    value = critic(batch)["state_value"]
    ends = batch["next", "done"][..., 0].clone()
    ends[:, -1] = True
    after = torch.roll(value, -1, dims=1)
    after[ends] = critic(batch["next"].select(*critic.in_keys)[ends])["state_value"]
    batch["next", "state_value"] = after
