"""The base of the algorithms: optimisers, the critic's epochs, saving, threads and generators."""

from __future__ import annotations

import abc
import contextlib
from collections.abc import Generator, Iterator, Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, set_recurrent_mode


class Algorithm(abc.ABC):
    """An update of the networks from batches; learning rates fall linearly to zero."""

    whole: ClassVar[bool] = False
    """Whether it learns from batches (aircraft, time), with the networks that flew them."""
    columns: ClassVar[tuple[str, ...]] = ()
    """Names of its metrics that no other algorithm has."""

    def __init__(
        self, actor: ProbabilisticActor, critic: TensorDictModuleBase, config: Any
    ) -> None:
        """Start without optimisers, with the networks and the settings of the algorithm."""
        self.actor, self.critic, self.config = actor, critic, config
        self.parameters = [*actor.parameters(), *critic.parameters()]
        self._optimisers: dict[str, torch.optim.Adam] = {}

    def add_optimiser(self, name: str, network: nn.Module, rate: float, **options: Any) -> None:
        """Let Adam optimise a network under a name, with an initial learning rate."""
        weights = [*network.parameters()]
        group: dict[str, Any] = {"params": weights, "initial_rate": rate, "lr": rate}
        if weights[0].is_cuda:  # such steps can be recorded
            group |= {"lr": torch.tensor(rate, device=weights[0].device), "capturable": True}
        self._optimisers[name] = torch.optim.Adam([group], eps=1e-5, **options)

    def update(self, batch: TensorDictBase, remaining: float) -> dict[str, float]:
        """Learn from a batch.

        Args:
            batch: (transitions,), or (aircraft, time) for a policy with a memory, with what actor
                and critic read, action, loc, scale, action_log_prob, advantage (normalised) and
                value_target.
            remaining: Share of the training that is left, 1 to 0.

        Returns:
            Metrics for the log.
        """
        self.set_rates(remaining)
        with set_recurrent_mode():
            return self.learn(batch)

    def set_rates(self, remaining: float) -> None:
        """Set the learning rates for the share of the training that is left, 1 to 0."""
        for adam in self._optimisers.values():
            for group in adam.param_groups:
                rate = group["initial_rate"] * remaining
                if isinstance(group["lr"], Tensor):  # a graph reads it
                    group["lr"].fill_(rate)
                else:
                    group["lr"] = rate

    @abc.abstractmethod
    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch at the present learning rates."""

    def step(self, loss: Tensor | Sequence[Tensor], *names: str) -> None:
        """Take a gradient step of each named optimiser, all on one loss.

        Args:
            loss: A scalar, or several whose sum it is.
            *names: Names of the optimisers.
        """
        for name in names:
            self._optimisers[name].zero_grad()
        torch.autograd.backward(loss)
        self.move(*names)

    def move(self, *names: str) -> None:
        """Take a step of each named optimiser along the present gradients.

        Each clips the norm of its own gradient: a critic that is far off, as at the start of a
        training, does not slow the policy down.
        """
        for adam in (self._optimisers[name] for name in names):
            if hasattr(self.config, "max_gradient"):
                own = adam.param_groups[0]["params"]
                nn.utils.clip_grad_norm_(own, self.config.max_gradient)
            adam.step()

    def minibatches(self, batch: TensorDictBase, epochs: int) -> Iterator[TensorDictBase]:
        """Iterate over minibatches of a batch, in `epochs` passes of another order each.

        A minibatch holds as many transitions as the settings say, or whole aircraft that have as
        many together.
        """
        rows = max(1, self.config.minibatch * len(batch) // batch.numel())
        for _ in range(epochs):
            order = torch.randperm(len(batch))
            # Takes a quarter of the time of indexing the batch.
            entries = {name: x.index_select(0, order.to(x.device)) for name, x in batch.items()}
            yield from TensorDict(entries, batch_size=batch.batch_size).split(rows)

    def fit_critic(self, batch: TensorDictBase) -> dict[str, float]:
        """Fit the critic to a batch in several passes; returns the last loss for the log."""
        entries = batch.select(*self.critic.in_keys, "value_target")
        loss = torch.zeros(())
        for part in self.minibatches(entries, self.config.critic_epochs):
            loss = (self.critic(part)["state_value"] - part["value_target"]).square().mean()
            self.step(loss, "critic")
        return {"critic_loss": loss.item()}

    def save(self) -> dict[str, Any]:
        """Return the tensors of the optimisers by optimiser, parameter and name."""
        return {
            name: {str(k): dict(v) for k, v in adam.state_dict()["state"].items()}
            for name, adam in self._optimisers.items()
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Restore what `save` returned; an optimiser that had made no step has no tensors."""
        for name, adam in self._optimisers.items():
            tensors = {int(k): v for k, v in saved.get(name, {}).items()}
            adam.load_state_dict(adam.state_dict() | {"state": tensors})


@contextlib.contextmanager
def one_thread() -> Generator[None]:
    """Let torch calculate with one thread, so that no bit depends on how many cores there are.

    Networks this small gain nothing from a second thread, and lose a lot when a core is busy.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def generators(device: torch.device) -> dict[str, Tensor]:
    """Return the state of each random number generator that a training on a device uses."""
    states = {"cpu": torch.get_rng_state()}
    return states | ({"cuda": torch.cuda.get_rng_state(device)} if device.type == "cuda" else {})


def set_generators(states: dict[str, Tensor], device: torch.device) -> None:
    """Set the generators to states of `generators`; one that is missing stays as it is."""
    if "cpu" in states:
        torch.set_rng_state(states["cpu"])
    if "cuda" in states and device.type == "cuda":
        torch.cuda.set_rng_state(states["cuda"], device)
