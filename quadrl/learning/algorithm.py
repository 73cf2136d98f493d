"""The base of the algorithms: optimisers, the critic's epochs, saving, threads and generators."""

from __future__ import annotations

import abc
import contextlib
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import Parameter
from torchrl.modules import set_recurrent_mode


class Algorithm(abc.ABC):
    """An update of the networks from batches; learning rates fall linearly to zero."""

    whole: ClassVar[bool] = False
    """Whether it learns from batches (aircraft, time), with the networks that flew them."""

    def __init__(self, config: Any) -> None:
        """Start without optimisers, with the settings of the algorithm."""
        self.config = config
        self.parameters: list[Parameter] = []
        self._optimisers: dict[str, tuple[torch.optim.Adam, list[Parameter], float]] = {}

    def add_optimiser(
        self, name: str, parameters: Iterable[Parameter], rate: float, **options: Any
    ) -> None:
        """Let Adam optimise some parameters under a name, with an initial learning rate."""
        own = list(parameters)
        self.parameters += own
        adam = torch.optim.Adam(own, lr=rate, eps=1e-5, **options)
        self._optimisers[name] = adam, own, rate

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
        for adam, _, rate in self._optimisers.values():
            for group in adam.param_groups:
                group["lr"] = rate * remaining
        with set_recurrent_mode():
            return self.learn(batch)

    @abc.abstractmethod
    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """The update at the present learning rates."""

    def step(self, loss: Tensor | Sequence[Tensor], *names: str) -> None:
        """One gradient step of each of the named optimisers, all on one loss.

        Args:
            loss: A scalar, or several whose sum it is.
            *names: Names of the optimisers.
        """
        for name in names:
            self._optimisers[name][0].zero_grad()
        torch.autograd.backward(loss)
        self.move(*names)

    def move(self, *names: str) -> None:
        """One step of each of the named optimisers along the gradients that there are.

        Each clips the norm of its own gradient: a critic that is far off, as at the begin of a
        training, does not hold the policy back.
        """
        for adam, parameters, _ in (self._optimisers[name] for name in names):
            if hasattr(self.config, "max_gradient"):
                torch.nn.utils.clip_grad_norm_(parameters, self.config.max_gradient)
            adam.step()

    def rows(self, batch: TensorDictBase) -> int:
        """Of a minibatch: transitions, or the aircraft that have as many."""
        return max(1, self.config.minibatch * len(batch) // batch.numel())

    def fit_critic(
        self, loss: Callable[[TensorDictBase], Tensor], batch: TensorDictBase
    ) -> dict[str, float]:
        """Passes of the optimiser "critic" over a batch; returns the last loss for the log."""
        value = torch.zeros(())
        for _ in range(self.config.critic_epochs):
            for part in shuffled(batch).split(self.rows(batch)):
                value = loss(part)
                self.step(value, "critic")
        return {"critic_loss": value.item()}

    def save(self) -> dict[str, Any]:
        """Tensors of the optimisers by optimiser, parameter and name."""
        return {
            name: {str(k): dict(v) for k, v in adam.state_dict()["state"].items()}
            for name, (adam, _, _) in self._optimisers.items()
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Continue from what `save` returned; an optimiser that had made no step has none."""
        for name, (adam, _, _) in self._optimisers.items():
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
    """The state of every random number generator that a training on a device draws from."""
    states = {"cpu": torch.get_rng_state()}
    return states | ({"cuda": torch.cuda.get_rng_state(device)} if device.type == "cuda" else {})


def set_generators(states: dict[str, Tensor], device: torch.device) -> None:
    """Set the generators to states of `generators`; one that is missing stays as it is."""
    if "cpu" in states:
        torch.set_rng_state(states["cpu"])
    if "cuda" in states and device.type == "cuda":
        torch.cuda.set_rng_state(states["cuda"], device)


def shuffled(batch: TensorDictBase) -> TensorDictBase:
    """The rows of a batch in another order, in a quarter of the time that indexing would take."""
    order = torch.randperm(len(batch))
    entries = {name: x.index_select(0, order.to(x.device)) for name, x in batch.items()}
    return TensorDict(entries, batch_size=batch.batch_size)
