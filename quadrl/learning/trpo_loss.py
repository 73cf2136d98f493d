"""The loss of TRPO (Schulman et al. 2015) in the manner of TorchRL's losses, which have none.

It uses nothing of quadrl.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    dispatch,
)
from torch import Tensor
from torch.distributions import Distribution, kl_divergence
from torchrl.modules.distributions.utils import has_analytic_kl
from torchrl.objectives.ppo import PPOLoss, _check_advantage_broadcast
from torchrl.objectives.utils import _maybe_add_or_extend_key, _sum_td_features


class TRPOLoss(PPOLoss):
    """TRPO loss: the surrogate objective and the divergence that bounds its step.

    The forward gives the terms of equation 14 of "Trust Region Policy Optimization",
    https://arxiv.org/abs/1502.05477: ``loss_objective``, the negative surrogate
    (importance-weighted advantage), and ``kl``, the KL divergence of the policy that acted from
    the present one. Both carry gradients: the update takes the gradient of the surrogate, and its
    Fisher matrix is the Hessian of ``kl``. The critic is trained on ``loss_critic``. ``ESS``, the
    share of the samples that are effective, is for the log.

    The policy that acted is built from the distribution parameters in the input (``loc`` and
    ``scale``, ``logits``, whatever the actor's distribution reads), so the data must keep them.

    Args:
        actor_network (ProbabilisticTensorDictSequential): the policy.
        critic_network (TensorDictModule, optional): the critic. Without it there is no
            ``loss_critic``, and the input must hold the advantage.

    Keyword Args:
        samples_mc_kl (int, optional): number of actions that are drawn for each state to estimate
            a divergence without closed form. With ``0`` the estimate takes the actions in the
            input, which makes it a function of the parameters alone, as a line search needs it.
            Defaults to ``0``.
        entropy_bonus (bool, optional): if ``True``, ``entropy`` and ``loss_entropy`` are given
            too. Defaults to ``False``.
        **kwargs: any other keyword argument of :class:`~torchrl.objectives.PPOLoss`:
            ``critic_coeff``, ``loss_critic_type``, ``normalize_advantage``, ``separate_losses``,
            ``functional``, ``reduction``, ``clip_value``, ... ``delay_actor`` is refused: the
            divergence is from the policy that acted.

    .. note::
      An advantage that is absent is computed by the value estimator, which
      :meth:`~.make_value_estimator` replaces.

    .. note::
      Where :mod:`torch.distributions` has no closed form of the divergence, the estimate is the
      mean of ``r - 1 - log(r)``, with ``r`` the present probability over the acting one. It is
      unbiased and never negative, and its Hessian at the acting policy is positive semidefinite.
      The mean of ``-log(r)`` alone is neither.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torch import nn
        >>> from torchrl.modules import IndependentNormal, NormalParamExtractor
        >>> from torchrl.modules import ProbabilisticActor, ValueOperator
        >>> from quadrl.learning.trpo_loss import TRPOLoss
        >>> net = nn.Sequential(nn.Linear(3, 4), NormalParamExtractor())
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
        ...     in_keys=["loc", "scale"],
        ...     distribution_class=IndependentNormal,
        ...     return_log_prob=True,
        ... )
        >>> critic = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
        >>> loss = TRPOLoss(actor, critic)
        >>> data = actor(TensorDict({"observation": torch.randn(5, 3)}, [5])).detach()
        >>> data["next"] = TensorDict(
        ...     {
        ...         "observation": torch.randn(5, 3),
        ...         "reward": torch.randn(5, 1),
        ...         "done": torch.zeros(5, 1, dtype=torch.bool),
        ...         "terminated": torch.zeros(5, 1, dtype=torch.bool),
        ...     },
        ...     [5],
        ... )
        >>> losses = loss(data)
        >>> losses["kl"].item()
        0.0
        >>> losses["loss_objective"].backward()
    """

    _schedulable_buffers = frozenset({"entropy_coeff", "critic_coeff", "clip_value"})

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential | None = None,
        critic_network: TensorDictModule | None = None,
        *,
        samples_mc_kl: int = 0,
        entropy_bonus: bool = False,
        **kwargs: Any,
    ) -> None:
        if kwargs.get("delay_actor"):
            raise ValueError("TRPOLoss has no proximal policy: leave delay_actor out.")
        if samples_mc_kl < 0:
            raise ValueError(f"samples_mc_kl must be 0 or more, got {samples_mc_kl}.")
        super().__init__(actor_network, critic_network, entropy_bonus=entropy_bonus, **kwargs)
        self.samples_mc_kl = samples_mc_kl

    def _set_in_keys(self) -> None:
        keys: list[Any] = []
        names: Any = self.tensor_keys
        _maybe_add_or_extend_key(keys, self.actor_network.in_keys)
        _maybe_add_or_extend_key(keys, self._distribution_keys())
        _maybe_add_or_extend_key(keys, names.action)
        _maybe_add_or_extend_key(keys, names.sample_log_prob)
        if self.critic_network is not None:
            _maybe_add_or_extend_key(keys, self.critic_network.in_keys)
            _maybe_add_or_extend_key(keys, self.actor_network.in_keys, "next")
            _maybe_add_or_extend_key(keys, self.critic_network.in_keys, "next")
            for name in (names.reward, names.done, names.terminated):
                _maybe_add_or_extend_key(keys, name, "next")
        # Last, since a call with positional arguments may leave them out.
        _maybe_add_or_extend_key(keys, names.advantage)
        if self.critic_network is not None:
            _maybe_add_or_extend_key(keys, names.value_target)
        self._in_keys = list(dict.fromkeys(keys))

    def _distribution_keys(self) -> list[Any]:
        """What the last probabilistic module of the actor reads."""
        for module in reversed(list(self.actor_network.modules())):
            if isinstance(module, ProbabilisticTensorDictModule):
                return list(module.in_keys)
        raise RuntimeError("Could not find the probabilistic module in the actor.")

    @property
    def out_keys(self) -> list[Any]:
        """Names of the outputs, in the order in which a call with tensors returns them."""
        if self._out_keys is None:
            keys = ["loss_objective", "kl"]
            if self.entropy_bonus:
                keys += ["entropy", "loss_entropy"]
            if self._has_critic:
                keys.append("loss_critic")
                if self.clip_value:
                    keys.append("value_clip_fraction")
            self._out_keys = keys
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[Any]) -> None:
        self._out_keys = values

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms by name, reduced as ``reduction`` says."""
        tensordict = self._with_advantage(tensordict)
        terms, distribution = self._policy_terms(tensordict)
        if self.entropy_bonus:
            batch_size = tensordict.get(self.tensor_keys.advantage).shape[:-1]
            entropy = self._get_entropy(distribution, adv_shape=batch_size)
            weighted = self._weighted_loss_entropy(entropy)
            terms["loss_entropy"] = self._reduce_loss(weighted, tensordict).squeeze(-1)
            if is_tensor_collection(entropy):
                terms["composite_entropy"] = entropy.detach()
                entropy = _sum_td_features(entropy)
            terms["entropy"] = entropy.detach().mean()
        if self._has_critic:
            critic, clipped, explained = self.loss_critic(tensordict)
            terms["loss_critic"] = self._reduce_loss(critic, tensordict).squeeze(-1)
            if clipped is not None:
                terms["value_clip_fraction"] = clipped
            if explained is not None:
                terms["explained_variance"] = explained
        networks = ("actor_network_params", "critic_network_params")
        targets = tuple(f"target_{name}" for name in networks)
        out = TensorDict(terms)
        self._clear_weakrefs(tensordict, out, *networks, *targets)
        return out

    def surrogate_and_kl(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """The surrogate and the divergence alone, reduced, for each trial of a line search."""
        terms, _ = self._policy_terms(self._with_advantage(tensordict))
        return -terms["loss_objective"], terms["kl"]

    def _with_advantage(self, tensordict: TensorDictBase) -> TensorDictBase:
        """A shallow copy with the advantage, computed where it is absent, and normalised."""
        tensordict = tensordict.clone(False)
        advantage = tensordict.get(self.tensor_keys.advantage, None)
        absent = advantage is None
        if absent:
            if self.critic_network is None:
                raise KeyError(
                    f"The input has no {self.tensor_keys.advantage!r}, and without a critic "
                    "TRPOLoss cannot compute it."
                )
            self.value_estimator(
                tensordict,
                params=self._cached_critic_network_params_detached,
                target_params=self.target_critic_network_params,
            )
            advantage = tensordict.get(self.tensor_keys.advantage)
        advantage = self._maybe_normalize_advantage(advantage, tensordict, update_norm=absent)
        return tensordict.set(self.tensor_keys.advantage, advantage)

    def _policy_terms(self, tensordict: TensorDictBase) -> tuple[dict[str, Any], Distribution]:
        """Negative surrogate, divergence and effective sample size, and the present policy."""
        absent = [key for key in self._distribution_keys() if tensordict.get(key, None) is None]
        if absent:
            raise KeyError(
                f"The input has no {absent}, parameters of the policy that acted, which TRPOLoss "
                "needs: keep them in the data."
            )
        # Before the actor runs, which writes the present parameters.
        acting = self.actor_network.build_dist_from_params(tensordict.clone(False))
        advantage = tensordict.get(self.tensor_keys.advantage)
        action = tensordict if isinstance(acting, CompositeDistribution) else None
        if action is None:
            action = tensordict.get(self.tensor_keys.action)
        # The actor writes into the copy alone.
        log_ratio, present, _, correction = self._log_weight(
            tensordict.clone(False), adv_shape=advantage.shape[:-1]
        )
        _check_advantage_broadcast(advantage, log_ratio)
        if correction is not None:  # a ratio above max_importance_ratio
            log_ratio = log_ratio + correction
        kl = self._divergence(acting, present, action, advantage.ndim - 1).unsqueeze(-1)
        loss = -log_ratio.exp() * advantage
        weights = log_ratio.detach().flatten()
        effective = (2 * weights.logsumexp(0) - (2 * weights).logsumexp(0)).exp() / len(weights)
        terms = {
            "loss_objective": self._reduce_loss(loss, tensordict).squeeze(-1),
            "kl": self._reduce_loss(kl, tensordict).squeeze(-1),
            "ESS": effective,
        }
        return terms, present

    def _divergence(
        self, acting: Distribution, present: Distribution, action: Any, dims: int
    ) -> Tensor:
        """KL divergence of the acting policy from the present one, of the shape of the batch.

        Args:
            acting: From the parameters in the data.
            present: With a graph.
            action: The actions in the data.
            dims: Of the batch; over those beyond, the divergence is summed.
        """
        if isinstance(acting, CompositeDistribution) and isinstance(present, CompositeDistribution):
            parts = [
                self._divergence(part, present.dists[name], action.get(name), dims)
                for name, part in acting.dists.items()
            ]
            return torch.stack(parts).sum(0)
        if has_analytic_kl(acting, present):
            return _summed(kl_divergence(acting, present), dims)
        samples = self.samples_mc_kl
        # Scored by both in the same way, so that what rounding does to an action cancels out.
        drawn = acting.sample((samples,)) if samples else action.unsqueeze(0)
        log_ratio = _summed(present.log_prob(drawn) - acting.log_prob(drawn), dims + 1)
        return (log_ratio.expm1() - log_ratio).mean(0)


def _summed(tensor: Tensor, dims: int) -> Tensor:
    """The sum over the dimensions after the first ones."""
    return tensor.flatten(dims).sum(-1) if tensor.ndim > dims else tensor
