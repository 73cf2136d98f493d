"""PPO whose batches come from several nodes of a Ray cluster, through TorchRL's RayCollector.

    python docs/examples/ray_collector.py --collectors 2 --steps 20000

Each collector is a Ray actor with a batch of aircraft of its own, all with the newest policy: the
collection is synchronous, and the batches stand in the order of the collectors. So the result
depends on the seed and the number of collectors alone. `--address 10.0.0.1:6379` takes the nodes of
a running cluster; without it Ray runs on this machine.
"""

import functools
import json
import logging
import os
import time
import warnings
from dataclasses import dataclass

import torch
import tyro
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.evaluation.rollout import fly, summarize

# TorchRL warns of its own classes.
warnings.filterwarnings("ignore", message=".*WeightUpdater.*", category=DeprecationWarning)
from torchrl.collectors.distributed import RayCollector  # noqa: E402

STORE_BYTES = 100 << 20  # of Ray's store on this machine: a batch is some MB


@dataclass
class Args:
    """Settings."""

    task: str = "hover"  # name of the task
    seed: int = 0  # seed of the networks, the exploration and the episodes
    collectors: int = 2  # Ray actors, with a CPU each
    address: str = "local"  # of the cluster
    num_envs: int = 128  # aircraft of each collector
    num_steps: int = 16  # control steps of each aircraft in a batch
    steps: int = 400_000  # control steps of all aircraft in the training
    minibatches: int = 4  # of each batch
    epochs: int = 5  # passes over each batch
    learning_rate: float = 3e-3  # of Adam at the start; it falls linearly to zero
    gamma: float = 0.93  # discount of a control step
    reward_scale: float = 0.01  # factor on the rewards
    episodes: int = 100  # of the evaluation


def make_env(task: str, num_envs: int, seed: int) -> QuadrotorEnv:
    """A collector's aircraft, and its noise: aircraft i gets the seed + i."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    return QuadrotorEnv(task, num_envs, seed=seed, num_threads=1)


def make_policy(env: QuadrotorEnv) -> tuple[ProbabilisticActor, ValueOperator]:
    """Actor and critic with two hidden layers of 64."""
    size, space = env.observation_spec["observation"].shape[-1], env.action_spec_unbatched.space
    hidden = {"num_cells": [64, 64], "activation_class": nn.Tanh}
    actions = space.low.shape[-1]
    net = nn.Sequential(MLP(size, actions, **hidden), AddStateIndependentNormalScale(actions))
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.full_action_spec_unbatched,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": space.low, "high": space.high, "tanh_loc": False},
        return_log_prob=True,
    )
    return actor, ValueOperator(MLP(size, 1, **hidden), in_keys=["observation"])


def main(args: Args) -> None:
    """Train, evaluate the mean action, print one JSON object."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it writes to standard output
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    local = {"num_cpus": args.collectors, "object_store_memory": STORE_BYTES}
    local |= {"include_dashboard": False}
    actor, critic = make_policy(make_env(args.task, 1, args.seed))
    # Each collector flies other episodes: seeds that are no neighbours.
    seeds = [args.seed + 1_000_000 * (k + 1) for k in range(args.collectors)]
    batch = args.collectors * args.num_envs * args.num_steps
    collector = RayCollector(
        [functools.partial(make_env, args.task, args.num_envs, seed) for seed in seeds],
        actor,
        frames_per_batch=batch,
        total_frames=args.steps,
        sync=True,
        update_after_each_batch=True,
        remote_configs={"num_cpus": 1},
        ray_init_config={"address": args.address, "logging_level": "error", "log_to_driver": False}
        | (local if args.address == "local" else {}),
    )
    advantages = GAE(gamma=args.gamma, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.0, critic_coeff=0.5)
    optimiser = torch.optim.Adam(loss.parameters(), lr=args.learning_rate)
    shuffle = torch.Generator().manual_seed(args.seed)
    steps, began = 0, time.perf_counter()
    for data in collector:
        steps += data.numel()
        optimiser.param_groups[0]["lr"] = args.learning_rate * max(0, 1 - steps / args.steps)
        data["next", "reward"] *= args.reward_scale
        with torch.no_grad():
            advantages(data)
        flat = data.reshape(-1)
        for _ in range(args.epochs):
            for rows in torch.randperm(len(flat), generator=shuffle).chunk(args.minibatches):
                losses = loss(flat[rows])
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
                optimiser.zero_grad()
    seconds = time.perf_counter() - began
    collector.shutdown()

    def mean_action(observation: object) -> object:
        with torch.no_grad():
            loc = actor.module[0](torch.as_tensor(observation))[0]
        return loc.tanh().numpy()  # the actions lie between -1 and 1

    metrics = summarize(fly(mean_action, args.task, episodes=args.episodes))
    run = {"task": args.task, "seed": args.seed, "steps": steps, "seconds": round(seconds, 2)}
    weight = sum(float(weight.double().sum()) for weight in actor.parameters())
    print(json.dumps(run | {"sum_of_weights": weight} | metrics))


if __name__ == "__main__":
    main(tyro.cli(Args))
