"""PPO from TorchRL's parts, after the design of its sota-implementations for MuJoCo.

    python docs/examples/torchrl_ppo.py --seconds 25

Design and defaults: pytorch/rl, sota-implementations/ppo (2,048 transitions a batch, minibatches of
64, 10 epochs, normalised observations, advantages anew in each epoch, two optimisers); the text is
quadrl's own. What a native batch changes: 64 aircraft of 32 steps make the batch.
"""

import json
import logging
import time
import warnings
from dataclasses import dataclass

import numpy as np
import torch
import tyro
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import (
    ClipTransform,
    Compose,
    ExplorationType,
    RewardScaling,
    TransformedEnv,
    VecNormV2,
    set_exploration_type,
)
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.evaluation.rollout import fly, summarize

# TorchRL warns of its own classes, and that VecNormV2 over a batch is experimental.
warnings.filterwarnings("ignore", message=".*WeightUpdater.*", category=DeprecationWarning)
warnings.filterwarnings("ignore", message="Support of VecNormV2.*", category=UserWarning)
from torchrl.collectors import Collector  # noqa: E402


@dataclass
class Args:
    """Settings; PPO's own are the defaults of TorchRL's script."""

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
    reward_scale: float = 1.0  # factor on the rewards


def layers(size: int, outputs: int, gain: float) -> MLP:
    """Two hidden layers of 64 tanh units, orthogonal weights."""
    net = MLP(size, outputs, num_cells=[64, 64], activation_class=nn.Tanh)
    for layer in net:
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, gain)
            nn.init.zeros_(layer.bias)
    return net


def main(args: Args) -> None:
    """Train, evaluate the mean action, print one JSON object."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it writes to standard output
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)  # networks this small are slower with a second thread
    seed = args.seed * args.num_envs  # aircraft i gets this + i
    aircraft = QuadrotorEnv(args.task, args.num_envs, seed=seed)
    normalise = VecNormV2(["observation"], decay=0.99999, eps=1e-2, reduce_batch_dims=True)
    clip = ClipTransform(["observation"], low=-10, high=10)
    scale = RewardScaling(loc=0.0, scale=args.reward_scale)
    env = TransformedEnv(aircraft, Compose(normalise, clip, scale))
    size, space = env.observation_spec["observation"].shape[-1], env.action_spec_unbatched.space
    actions = space.low.shape[-1]

    net = nn.Sequential(layers(size, actions, 1.0), AddStateIndependentNormalScale(actions))
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.full_action_spec_unbatched,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": space.low, "high": space.high, "tanh_loc": False},
        return_log_prob=True,
    )
    critic = ValueOperator(layers(size, 1, 0.01), in_keys=["observation"])
    advantages = GAE(gamma=args.gamma, lmbda=0.95, value_network=critic, average_gae=False)
    loss = ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=0.2,
        entropy_coeff=0.0,
        critic_coeff=0.25,
        loss_critic_type="l2",
        normalize_advantage=True,
    )
    optimisers = [
        torch.optim.Adam(module.parameters(), lr=args.learning_rate, eps=1e-5)
        for module in (actor, critic)
    ]
    batch = args.num_envs * args.num_steps
    collector = Collector(
        env,
        actor,
        frames_per_batch=batch,
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(batch),
        sampler=SamplerWithoutReplacement(),
        batch_size=args.minibatch,
    )

    steps, spent, began = 0, 0.0, time.perf_counter()
    for data in collector:
        steps += data.numel()
        for optimiser in optimisers:
            optimiser.param_groups[0]["lr"] = args.learning_rate * (1 - spent)
        for _ in range(args.epochs):
            with torch.no_grad():
                advantages(data)
            buffer.extend(data.reshape(-1))
            for minibatch in buffer:
                losses = loss(minibatch)
                (losses["loss_objective"] + losses["loss_entropy"]).backward()
                losses["loss_critic"].backward()
                for optimiser in optimisers:
                    optimiser.step()
                    optimiser.zero_grad()
        seconds = time.perf_counter() - began
        if (spent := max(steps / args.total_steps, seconds / args.seconds)) >= 1:
            break
    collector.shutdown()

    statistics = normalise.to_observation_norm()

    def mean_action(observation: np.ndarray) -> np.ndarray:
        seen = TensorDict(observation=torch.from_numpy(observation), batch_size=len(observation))
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return actor(clip(statistics(seen)))["action"].numpy()

    metrics = summarize(fly(mean_action, args.task, episodes=100))
    run = {"task": args.task, "seed": args.seed, "steps": steps, "seconds": round(seconds, 2)}
    print(json.dumps(run | metrics))


if __name__ == "__main__":
    main(tyro.cli(Args))
