"""PPO in one file, after the design of CleanRL's ppo_continuous_action.

    python docs/examples/cleanrl_ppo.py --seconds 25

Design and defaults: docs.cleanrl.dev, PPO (2,048 transitions a batch, minibatches of 64, 10 epochs,
normalised observations and rewards); the text is quadrl's own. What a native batch changes: 64
aircraft of 32 steps make the batch, and a time-out is bootstrapped with the value of the final
observation.
"""

import json
import time
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.wrappers.utils import RunningMeanStd
from gymnasium.wrappers.vector import NormalizeReward
from torch import nn
from torch.distributions import Independent, Normal

import quadrl  # noqa: F401 - registers the ids
from quadrl.evaluation.rollout import fly, summarize


@dataclass
class Args:
    """Settings; PPO's own are CleanRL's defaults."""

    task: str = "hover"  # name of the task
    seed: int = 0  # seed of the networks, the exploration and the episodes
    total_steps: int = 1_000_000  # control steps of all aircraft, after which the training ends
    seconds: float = float("inf")  # wall clock after which it ends, if that is earlier
    num_envs: int = 64  # aircraft flown together
    num_steps: int = 32  # control steps of each aircraft in a batch
    minibatch: int = 64  # transitions in a gradient step
    epochs: int = 10  # passes over each batch
    learning_rate: float = 3e-4  # of Adam at the start; it falls linearly to zero
    gamma: float = 0.99  # discount of a control step


def layers(size: int, outputs: int, gain: float) -> nn.Sequential:
    """Two hidden layers of 64 tanh units, orthogonal weights."""
    linear = [nn.Linear(size, 64), nn.Linear(64, 64), nn.Linear(64, outputs)]
    for layer, scale in zip(linear, (2**0.5, 2**0.5, gain), strict=True):
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(linear[0], nn.Tanh(), linear[1], nn.Tanh(), linear[2])


class Agent(nn.Module):
    """A Gaussian policy whose deviation does not depend on the observation, and a critic."""

    def __init__(self, size: int, actions: int) -> None:
        """Make the networks."""
        super().__init__()
        self.mean, self.critic = layers(size, actions, 0.01), layers(size, 1, 1.0)
        self.log_deviation = nn.Parameter(torch.zeros(actions))

    def policy(self, x: torch.Tensor) -> Independent:
        """The distribution of the actions (..., actions)."""
        return Independent(Normal(self.mean(x), self.log_deviation.exp()), 1)

    def value(self, x: torch.Tensor) -> torch.Tensor:
        """The values (...)."""
        return self.critic(x).squeeze(-1)


def main(args: Args) -> None:
    """Train, evaluate the mean action, print one JSON object."""
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)  # networks this small are slower with a second thread
    camel = "".join(word.capitalize() for word in args.task.split("_"))
    envs = gym.make_vec(
        f"quadrl/{camel}-v0", args.num_envs, autoreset_mode="SameStep", reward_terms=False
    )
    envs = NormalizeReward(envs, gamma=args.gamma)
    (size,), (actions,) = envs.single_observation_space.shape, envs.single_action_space.shape
    statistics = RunningMeanStd(shape=(size,))

    def normal(raw: np.ndarray) -> torch.Tensor:
        # Gymnasium's NormalizeObservation does not take SAME_STEP.
        scaled = (raw - statistics.mean) / np.sqrt(statistics.var + 1e-8)
        return torch.as_tensor(np.clip(scaled, -10, 10), dtype=torch.float32)

    agent = Agent(size, actions)
    optimiser = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5)
    shape = (args.num_steps, args.num_envs)
    observations, taken = torch.zeros(*shape, size), torch.zeros(*shape, actions)
    log_probs, values, rewards, over = (torch.zeros(shape) for _ in range(4))

    steps, began = 0, time.perf_counter()
    raw, _ = envs.reset(seed=args.seed * args.num_envs)  # aircraft i gets this + i
    statistics.update(raw)
    while True:
        seconds = time.perf_counter() - began
        if (spent := max(steps / args.total_steps, seconds / args.seconds)) >= 1:
            break
        optimiser.param_groups[0]["lr"] = args.learning_rate * (1 - spent)
        with torch.no_grad():
            for t in range(args.num_steps):
                observations[t] = x = normal(raw)
                policy = agent.policy(x)
                taken[t] = action = policy.sample()
                log_probs[t], values[t] = policy.log_prob(action), agent.value(x)
                raw, reward, terminated, truncated, infos = envs.step(action.numpy())
                statistics.update(raw)
                rewards[t] = torch.as_tensor(reward)
                over[t] = torch.as_tensor(terminated | truncated)
                if truncated.any():  # the flight would have gone on: its value counts
                    final = normal(np.stack(infos["final_obs"][truncated]))
                    rewards[t, truncated] += args.gamma * agent.value(final)
                steps += args.num_envs
            ahead, advantage = agent.value(normal(raw)), torch.zeros(args.num_envs)
            advantages = torch.zeros(shape)
            for t in reversed(range(args.num_steps)):
                delta = rewards[t] + args.gamma * ahead * (1 - over[t]) - values[t]
                advantage = delta + args.gamma * 0.95 * (1 - over[t]) * advantage
                advantages[t], ahead = advantage, values[t]

        batch = [
            whole.flatten(0, 1)
            for whole in (observations, taken, log_probs, values, advantages, advantages + values)
        ]
        for _ in range(args.epochs):
            for rows in torch.randperm(len(batch[0])).split(args.minibatch):
                x, action, old_log_prob, old_value, gain, target = (part[rows] for part in batch)
                ratio = (agent.policy(x).log_prob(action) - old_log_prob).exp()
                gain = (gain - gain.mean()) / (gain.std() + 1e-8)
                surrogate = torch.min(gain * ratio, gain * ratio.clamp(0.8, 1.2)).mean()
                value = agent.value(x)
                near = old_value + (value - old_value).clamp(-0.2, 0.2)
                error = torch.max((value - target) ** 2, (near - target) ** 2).mean()
                optimiser.zero_grad()
                (0.25 * error - surrogate).backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimiser.step()

    def mean_action(observation: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return agent.mean(normal(observation)).numpy()

    metrics = summarize(fly(mean_action, args.task, episodes=100))
    run = {"task": args.task, "seed": args.seed, "steps": steps, "seconds": round(seconds, 2)}
    print(json.dumps(run | metrics))


if __name__ == "__main__":
    main(tyro.cli(Args))
