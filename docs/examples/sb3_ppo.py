"""Stable-Baselines3's PPO on a native batch of aircraft.

    python docs/examples/sb3_ppo.py --seconds 25

`PPO("MlpPolicy", "quadrl/Hover-v0")` works as it stands, one aircraft at a time. Stable-Baselines3
has an interface of its own for several; `QuadrotorVecEnv` gives it the whole batch at once, which
is about twice as fast as its DummyVecEnv. Settings: its PPO's defaults, but that 64 aircraft of 32
steps make the 2,048 transitions of a batch; VecNormalize, as its model zoo has it for MuJoCo.
"""

import json
import time
from dataclasses import dataclass

import numpy as np
import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from quadrl.envs.sb3 import QuadrotorVecEnv
from quadrl.evaluation.rollout import fly, summarize


@dataclass
class Args:
    """Settings; PPO's own are Stable-Baselines3's defaults."""

    task: str = "hover"  # name of the task
    seed: int = 0  # seed of the networks, the exploration and the episodes
    total_steps: int = 1_000_000  # control steps of all aircraft, after which the training ends
    seconds: float = float("inf")  # wall clock after which it ends, if that is earlier
    num_envs: int = 64  # aircraft flown together
    num_steps: int = 32  # control steps of each aircraft in a batch
    minibatch: int = 64  # transitions in a gradient step
    epochs: int = 10  # passes over each batch
    learning_rate: float = 3e-4  # of Adam
    anneal: bool = False  # let the learning rate fall linearly to zero
    gamma: float = 0.99  # discount of a control step


class Stopwatch(BaseCallback):
    """Ends the training when its wall clock is spent."""

    def __init__(self, args: Args) -> None:
        """Start the clock."""
        super().__init__()
        self.args, self.began = args, time.perf_counter()

    def elapsed(self) -> float:
        """Since the start [s]."""
        return time.perf_counter() - self.began

    def rate(self, remaining: float) -> float:
        """The learning rate, with `remaining` of the steps to go."""
        left = min(remaining, 1 - self.elapsed() / self.args.seconds)
        return self.args.learning_rate * max(left, 0.0)

    def _on_step(self) -> bool:
        return self.elapsed() < self.args.seconds


def main(args: Args) -> None:
    """Train, evaluate the mean action, print one JSON object."""
    torch.set_num_threads(1)  # networks this small are slower with a second thread
    envs = VecNormalize(VecMonitor(QuadrotorVecEnv(args.task, args.num_envs)), gamma=args.gamma)
    watch = Stopwatch(args)
    model = PPO(
        "MlpPolicy",
        envs,
        learning_rate=watch.rate if args.anneal else args.learning_rate,
        n_steps=args.num_steps,
        batch_size=args.minibatch,
        n_epochs=args.epochs,
        gamma=args.gamma,
        seed=args.seed * args.num_envs,  # aircraft i gets this + i
        device="cpu",
    )
    watch.began = time.perf_counter()
    model.learn(args.total_steps, callback=watch)
    seconds = watch.elapsed()

    def mean_action(observation: np.ndarray) -> np.ndarray:
        return model.predict(envs.normalize_obs(observation), deterministic=True)[0]

    metrics = summarize(fly(mean_action, args.task, episodes=100))
    run = {"task": args.task, "seed": args.seed, "steps": model.num_timesteps}
    print(json.dumps(run | {"seconds": round(seconds, 2)} | metrics))


if __name__ == "__main__":
    main(tyro.cli(Args))
