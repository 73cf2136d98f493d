"""The paper's policy, with a memory or without, and a critic as TorchRL modules."""

from __future__ import annotations

import itertools
import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import GRUCell, IndependentNormal, ProbabilisticActor, recurrent_mode

from quadrl.base.machine import check_memory
from quadrl.evaluation.policy import LOG_VARIANCE
from quadrl.evaluation.policy_file import CLIP
from quadrl.learning.config import TrainConfig
from quadrl.learning.fused import Plain
from quadrl.learning.goal import GoalState, goal_state
from quadrl.learning.normaliser import Normaliser

STATE, BEGINS = "recurrent_state", "is_init"
"""What a policy with a memory reads beside the observation, by TorchRL's names: its state before
the observation, and whether an episode begins with it."""
PRIVILEGED = "privileged"
"""The observation for the critic alone, if the environment gives one."""


class MeanAndDeviation(nn.Module):
    """The last step of the paper's policy: mean and log-variance of a normal distribution."""

    def forward(self, output: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and standard deviation (..., actions) from outputs (..., 2 * actions)."""
        mean, log_variance = output.chunk(2, -1)
        return mean, (0.5 * log_variance.clamp(*LOG_VARIANCE)).exp()


class HoldsGoal(nn.Module):
    """A network minus its output at the goal, where the mean action is then 0, which is hover.

    Of several tasks in one, nothing is subtracted in those without that goal.
    """

    at_goal: torch.Tensor  # (size,), an observation
    looks: torch.Tensor  # (size,), 1 for numbers that the network sees, 0 for the others

    def __init__(self, normaliser: Normaliser, network: nn.Sequential, goal: GoalState) -> None:
        """Keep normaliser, network and goal."""
        super().__init__()
        self.normaliser, self.network, self.others = normaliser, network, [*goal.others]
        self.last = MeanAndDeviation()
        self.register_buffer("at_goal", torch.from_numpy(goal.seen).float())
        self.register_buffer("looks", torch.from_numpy(goal.looks).float())

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and standard deviation of the actions (..., k) for observations (..., size)."""
        seen = self.seen(observation)
        mean, deviation = self.last(self.network(seen))
        return mean - self.share(seen) * self.mean_at_goal(), deviation

    def seen(self, observation: torch.Tensor) -> torch.Tensor:
        """Return what the network reads of observations (..., size)."""
        return self.looks * self.normaliser(observation)

    def share(self, seen: torch.Tensor) -> torch.Tensor:
        """Whether the mean at the goal counts, 1 or 0 (..., 1), where (..., size) is read."""
        # The flag of another task, 0 or 1, is below or above 0 once its mean is subtracted.
        return (seen[..., self.others] <= 0).all(-1, keepdim=True).to(seen)

    def mean_at_goal(self) -> torch.Tensor:
        """Return the mean at the goal, (k,)."""
        return self.last(self.network(self.seen(self.at_goal)))[0]


class Memory(nn.Module):
    """A gated recurrent unit beside a network: its state joins the normalised observation.

    It follows TorchRL's recurrent mode. With a layer before the unit, the network reads the state
    alone.
    """

    def __init__(
        self, normaliser: Normaliser, width: int, network: nn.Module, *, alone: bool = False
    ) -> None:
        """Keep a network that reads (normalised observation, state), and make the unit."""
        super().__init__()
        self.normaliser, self.network = normaliser, network
        size = len(normaliser.mean)
        self.first = nn.Linear(size, width) if alone else None
        self.cell = GRUCell(width if alone else size, width)

    def forward(
        self, observation: torch.Tensor, state: torch.Tensor, begins: torch.Tensor | None
    ) -> tuple[torch.Tensor, ...]:
        """Return the outputs of the network, and the next state of the unit.

        In TorchRL's recurrent mode it takes sequences, reads only the first state of each, and
        returns no next state.

        Args:
            observation: (N, size), or (N, T, size).
            state: Before the observation, (N, width), or (N, T, width); zero as an episode begins.
            begins: For sequences, whether an episode begins with the observation, (N, T, 1).
        """
        seen = self.normaliser(observation)
        if self.first is not None:
            seen = self.first(seen).relu()
        if not recurrent_mode():
            state = self.cell(seen, state)
            return *self.network(self._read(seen, state)), state
        assert begins is not None
        return self.network(self._read(seen, self._states(seen, state[:, 0], begins[..., 0])))

    def _states(
        self, seen: torch.Tensor, state: torch.Tensor, begins: torch.Tensor
    ) -> torch.Tensor:
        """The states (N, T, width) after sequences (N, T, size), in one call of torch's unit.

        What follows a begin (N, T) within a sequence is one more sequence, with a state of zero.
        """
        count, steps = begins.shape
        rows, times = begins.nonzero(as_tuple=True)
        place = torch.arange(steps, device=seen.device)
        later = seen[rows[:, None], (times[:, None] + place).clamp(max=steps - 1)]
        first = torch.cat([state, state.new_zeros(len(rows), state.shape[1])])[None]
        cell = self.cell
        weights = [cell.weight_ih, cell.weight_hh, cell.bias_ih, cell.bias_hh]
        how = True, 1, 0.0, self.training, False, True  # biases, layers, ..., batch first
        states, _ = torch.gru(torch.cat([seen, later]), first, weights, *how)
        # Which sequence a state is of: the number of the last begin of its row, 0 for none.
        begun = torch.zeros_like(begins, dtype=torch.long)
        begun[rows, times] = torch.arange(1, len(rows) + 1, device=seen.device)
        begun = begun.cummax(1).values
        since = torch.cat([times.new_zeros(1), times])[begun]
        own = torch.arange(count, device=seen.device)[:, None].expand_as(begun)
        return states[torch.where(begun > 0, begun + count - 1, own), place - since]

    def _read(self, seen: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        return state if self.first is not None else torch.cat([seen, state], -1)


class Informed(nn.Module):
    """A network that reads the observation and the privileged one, both normalised."""

    def __init__(self, normalisers: list[Normaliser], network: nn.Module) -> None:
        """Keep the normaliser of each, and the network that reads both."""
        super().__init__()
        self.normalisers, self.network = nn.ModuleList(normalisers), network

    def forward(self, *observations: torch.Tensor) -> torch.Tensor:
        """The network's output for observations (..., size of each)."""
        pairs = zip(self.normalisers, observations, strict=True)
        return self.network(torch.cat([module(seen) for module, seen in pairs], -1))


class Entries(TensorDictModule):
    """A network that reads named entries, and writes its output or outputs as named entries.

    At each write in a TensorDictModule's forward, tensordict 0.14 looks for other packages, which
    costs a tenth of a gradient step; this forward only writes.
    """

    plain: Plain | None = None
    """The parts of the network, if it is one of plain layers."""

    def forward(  # pyright: ignore[reportIncompatibleVariableOverride] - the base wraps it
        self, tensordict: TensorDictBase, **_: Any
    ) -> TensorDictBase:
        """Add the entries."""
        outputs = self.module(*(tensordict.get(name) for name in self.in_keys))
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        for name, output in zip(self.out_keys, outputs, strict=False):  # a sequence gives fewer
            tensordict.set(name, output)
        return tensordict


def make_network(inputs: int, hidden: tuple[int, ...], outputs: int, gain: float) -> nn.Sequential:
    """Make linear layers with tanh between them.

    Weights are orthogonal and biases zero; `gain` scales the last layer's weights.
    """
    widths = (inputs, *hidden, outputs)
    layers = [nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else 2**0.5)
        nn.init.zeros_(layer.bias)
    between = [module for layer in layers[:-1] for module in (layer, nn.Tanh())]
    return nn.Sequential(*between, layers[-1])


def make_actor_critic(
    size: int, actions: int, config: TrainConfig, privileged: int = 0
) -> tuple[ProbabilisticActor, Entries, dict[str, Normaliser]]:
    """Make actor, critic, and their normalisers by the name of the entry.

    The critic reads the observation and, if there is one, the privileged observation. It has no
    memory: with the state of the actor as an input, whose meaning changes as the actor learns,
    policies for hover ended with errors of 6 to 12 cm instead of 2 to 3.

    Args:
        size: Numbers in an observation.
        actions: Numbers in an action, k.
        config: Gives the widths of the layers and the deviation of the first actions.
        privileged: Numbers in the privileged observation; 0 for none.
    """
    remembered = config.memory_width if config.memory != "none" else 0
    alone = config.memory == "raptor"
    normaliser = Normaliser(size, math.inf if alone else CLIP)  # mc_raptor clips no normalised one
    normalisers = {"observation": normaliser}
    inputs = remembered + size * (not alone)
    network = make_network(inputs, config.hidden, 2 * actions, gain=0.01)
    bias: Any = network[-1].bias
    with torch.no_grad():
        bias[actions:] = 2 * torch.tensor(config.initial_deviation).log()
    layers = [*network][::2]
    if remembered:
        network.append(MeanAndDeviation())
        policy = Memory(normaliser, remembered, network, alone=alone)
        given = ["loc", "scale", ("next", STATE)]
        entries = Entries(policy, ["observation", STATE, BEGINS], given)
    else:
        goal = HoldsGoal(normaliser, network, goal_state(config)) if config.holds_goal else None
        policy = goal or nn.Sequential(normaliser, *network, MeanAndDeviation())
        entries = Entries(policy, ["observation"], ["loc", "scale"])
        entries.plain = Plain({"observation": goal.seen if goal else normaliser}, layers, goal)
    actor = ProbabilisticActor(
        entries,
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        distribution_kwargs={"validate_args": False},
        return_log_prob=True,
    )
    if privileged:
        normalisers[PRIVILEGED] = Normaliser(privileged)
    network = make_network(size + privileged, config.critic_hidden, 1, gain=1.0)
    first = [*normalisers.values()]
    value = Informed(first, network) if privileged else nn.Sequential(*first, *network)
    critic = Entries(value, [*normalisers], ["state_value"])
    critic.plain = Plain(normalisers, [*network][::2])
    return actor, critic, normalisers


def check_fits(config: TrainConfig, size: int) -> None:
    """Refuse networks and batches that do not fit into memory, for observations of a size.

    A weight takes four numbers, with its gradient and Adam's two. A transition takes some ten times
    its observation and 1 kB more, as was measured.
    """
    for name, hidden in (("hidden", config.hidden), ("critic_hidden", config.critic_hidden)):
        widths = (size, *hidden, 1)
        weights = sum(a * b for a, b in itertools.pairwise(widths))
        check_memory(f"{name} = {hidden}", 16.0 * weights)
    batch = config.num_envs * config.rollout
    check_memory(f"num_envs * rollout = {batch}", batch * (40.0 * size + 1000))
