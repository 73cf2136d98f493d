"""The loss of TRPO (Schulman et al. 2015) in the style of TorchRL, which has no loss for it.

This module uses nothing of quadrl.
"""

from __future__ import annotations

from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from torch import Tensor
from torch.distributions import Distribution, kl_divergence
from torchrl.modules.distributions.utils import has_analytic_kl
from torchrl.objectives.ppo import PPOLoss, _check_advantage_broadcast
from torchrl.objectives.utils import _maybe_add_or_extend_key


class TRPOLoss(PPOLoss):
    """The surrogate objective of TRPO and the divergence that bounds its step.

    The forward gives the terms of equation 14 of "Trust Region Policy Optimization",
    https://arxiv.org/abs/1502.05477: `loss_objective`, the negative surrogate (the advantage
    weighted by the ratio of the probabilities), and `kl`, the KL divergence of the policy that
    acted from the present one. Both carry gradients: the update takes the gradient of the
    surrogate, and its Fisher matrix is the Hessian of `kl`. The critic is trained on `loss_critic`.

    The policy that acted is built from the distribution parameters in the input (`loc` and `scale`,
    `logits`, whatever the actor's distribution reads), so the data must keep them. An advantage
    that is absent is computed by the value estimator, which `make_value_estimator` replaces.

    Where torch has no closed form of the divergence, its estimate is the mean of r - 1 - log(r)
    over the actions in the input, with r the present probability over the acting one. It is
    unbiased and never negative, and its Hessian at the acting policy is positive semidefinite. The
    mean of -log(r) alone is neither.
    """

    _schedulable_buffers = frozenset({"entropy_coeff", "critic_coeff", "clip_value"})

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential | None = None,
        critic_network: TensorDictModule | None = None,
        **settings: Any,
    ) -> None:
        """Keep the networks.

        Args:
            actor_network: The policy.
            critic_network: Without it there is no `loss_critic`, and the input must hold the
                advantage.
            **settings: Those of PPOLoss, except `delay_actor`, since the divergence is from the
                policy that acted, and `entropy_bonus`.

        Raises:
            ValueError: One of these two is given.
        """
        for name in ("delay_actor", "entropy_bonus"):
            if settings.get(name):
                raise ValueError(f"TRPOLoss has no {name}: leave it out.")
        super().__init__(actor_network, critic_network, entropy_bonus=False, **settings)
        # In the order in which a call with tensors returns them.
        self.out_keys = ["loss_objective", "kl", *["loss_critic"] * self._has_critic]

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        keys, names = sorted(self._in_keys, key=str), self.tensor_keys
        _maybe_add_or_extend_key(keys, self.actor_network.dist_params_keys)
        # At the end, since a call with positional arguments may leave them out.
        _maybe_add_or_extend_key(keys, names.advantage)
        if self.critic_network is not None:
            _maybe_add_or_extend_key(keys, names.value_target)
        self._in_keys = list(dict.fromkeys(keys))

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the terms by name, reduced as `reduction` says."""
        tensordict = self._with_advantage(tensordict)
        surrogate, kl = self._policy_terms(tensordict)
        terms = {"loss_objective": -surrogate, "kl": kl}
        if self._has_critic:
            critic = self.loss_critic(tensordict)[0]
            terms["loss_critic"] = self._reduce_loss(critic, tensordict).squeeze(-1)
        return TensorDict(terms)

    def surrogate_and_kl(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Compute the reduced surrogate and divergence alone, for each trial of a line search."""
        return self._policy_terms(self._with_advantage(tensordict))

    def _with_advantage(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Copy the input, with the advantage, which is normalised if the settings say so."""
        tensordict, key = tensordict.clone(False), self.tensor_keys.advantage
        absent = tensordict.get(key, None) is None
        if absent:
            if self.critic_network is None:
                reason = "and without a critic TRPOLoss cannot compute it."
                raise KeyError(f"The input has no {key!r}, {reason}")
            self.value_estimator(
                tensordict,
                params=self._cached_critic_network_params_detached,
                target_params=self.target_critic_network_params,
            )
        advantage: Any = tensordict.get(key)
        advantage = self._maybe_normalize_advantage(advantage, tensordict, update_norm=absent)
        return tensordict.set(key, advantage)

    def _policy_terms(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Compute surrogate and divergence, reduced."""
        needed = self.actor_network.dist_params_keys
        absent = [key for key in needed if tensordict.get(key, None) is None]
        if absent:
            raise KeyError(
                f"The input has no {absent}, parameters of the policy that acted, which TRPOLoss "
                "needs: keep them in the data."
            )
        # Before the actor runs, which writes the present parameters, into a copy.
        acting = self.actor_network.build_dist_from_params(tensordict.clone(False))
        advantage: Any = tensordict.get(self.tensor_keys.advantage)
        log_ratio, present, _, correction = self._log_weight(
            tensordict.clone(False), adv_shape=advantage.shape[:-1]
        )
        _check_advantage_broadcast(advantage, log_ratio)
        if correction is not None:  # a ratio above max_importance_ratio
            log_ratio = log_ratio + correction
        action: Any = tensordict.get(self.tensor_keys.action)
        kl = _divergence(acting, present, action, advantage.ndim - 1).unsqueeze(-1)
        surrogate, kl = (
            self._reduce_loss(x, tensordict).squeeze(-1) for x in (log_ratio.exp() * advantage, kl)
        )
        return surrogate, kl


def _divergence(acting: Distribution, present: Distribution, action: Tensor, dims: int) -> Tensor:
    """Compute the KL divergence of two policies, summed over dimensions after the first `dims`."""
    if has_analytic_kl(acting, present):
        each = kl_divergence(acting, present)
        return each.flatten(dims).sum(-1) if each.ndim > dims else each
    # Both score the action in the same way, so that its rounding errors cancel out.
    log_ratio = present.log_prob(action) - acting.log_prob(action)
    log_ratio = log_ratio.flatten(dims).sum(-1) if log_ratio.ndim > dims else log_ratio
    return log_ratio.expm1() - log_ratio
