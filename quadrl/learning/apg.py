"""Analytic policy gradients: through the physics, over short windows with a critic at their end.

The windows and their critic are those of SHAC (Xu et al. 2022). What is done with the gradient is
that of PODS (Mora et al. 2021): each action of the window is moved a little up it, and the policy
is fitted to the moved actions, which does not depend on how its weights are scaled. Unlike the
other algorithms this one knows the model: the derivatives of the flight and of the rewards.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.modules import ProbabilisticActor

from quadrl.learning.algorithm import Algorithm
from quadrl.learning.environments import RecordingEnv
from quadrl.learning.settings import APGConfig
from quadrl.learning.window import Window

FARTHEST = 2.0  # times the usual move of an action


class APG(Algorithm):
    """Epochs of the policy towards better actions on each window, then those of the critic."""

    whole = True

    def __init__(
        self,
        actor: ProbabilisticActor,
        critic: TensorDictModule,
        config: APGConfig,
        env: RecordingEnv,
        gamma: float,
        reward_scale: float,
    ) -> None:
        """Make the optimisers.

        Args:
            actor: The policy.
            critic: Says what comes after the end of a window.
            config: Settings.
            env: Flies the windows.
            gamma: Discount per control step.
            reward_scale: Factor on the rewards.
        """
        super().__init__(actor, critic, config)
        self._env, self._gamma, self._reward_scale = env, gamma, reward_scale
        self.add_optimiser("policy", actor, config.learning_rate)
        self.add_optimiser("critic", critic, config.critic_rate)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from one window (aircraft, time): epochs of the policy, then of the critic."""
        window = Window(self._env.environment, self._env.taken())
        seen = TensorDict({"observation": window.observation.float()}, len(window.observation))
        mean, deviation = self._distribution(seen)
        flown = batch["action"].transpose(0, 1).reshape(mean.shape)
        # The noise stays as it was drawn, however the policy changes.
        action = mean + deviation * ((flown - mean) / deviation).detach()
        earned = self._earned(window)
        by_action = window.vector_jacobian_product(earned, action, self._gamma)
        moves = self._moves(torch.from_numpy(by_action).float().reshape(mean.shape))
        better = (mean + moves).detach()
        aims = seen.detach().update({"better": better, "usual": deviation.log().detach()})
        for part in self.minibatches(aims, self.config.epochs):
            self.step(self._distance(part), "policy")
        return self.fit_critic(batch.reshape(-1))

    def _earned(self, window: Window) -> Tensor:
        """The rewards of a window and what the critic expects after it, ()."""
        goes_on = torch.from_numpy(window.goes_on)
        after = TensorDict({"observation": window.next_observation[goes_on].float()})
        value = self._gamma * self.critic(after)["state_value"].sum()
        return self._reward_scale * window.reward.sum() + value

    def _moves(self, by_action: Tensor) -> Tensor:
        """How far each action is moved, (n, k): `config.step` where the gradient is the median.

        At some moments the gradient is a thousand times as large as at others.
        """
        strength = by_action.norm(dim=-1, keepdim=True)
        moves = self.config.step * by_action / strength.median().clamp(min=1e-9)
        farthest = FARTHEST * self.config.step
        return moves * (farthest / moves.norm(dim=-1, keepdim=True).clamp(min=farthest))

    def _distance(self, aims: TensorDictBase) -> Tensor:
        """How far the policy is from the moved actions and from its usual deviation, ()."""
        mean, deviation = self._distribution(aims)
        off, wide = mean - aims["better"], deviation.log() - aims["usual"]
        return off.square().mean() + wide.square().mean()

    def _distribution(self, seen: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Mean and deviation of the actions (n, k)."""
        found: Any = self.actor.get_dist_params(seen.select("observation"))
        return found["loc"], found["scale"]
