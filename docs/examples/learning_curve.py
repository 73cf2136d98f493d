"""The learning curve of one training: of an algorithm of quadrl, or of Stable-Baselines3's SAC.

    python docs/examples/learning_curve.py --algo sac --task hover

All are measured in one way. At points that lie evenly on a logarithmic scale the mean action flies
100 fresh episodes, in which the clock stands still. The clock is that of the processor: with one
thread it shows the wall clock of a core that does nothing else, also on one that does.

quadrl's algorithms have the task's own settings. SAC is unmodified, on the native batch. It learns
from every transition many times, so that its gradient steps take the time and not the flights.
"""

import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from quadrl.envs.sb3 import QuadrotorVecEnv
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.rollout import fly, summarize
from quadrl.learning.config import TrainConfig
from quadrl.learning.train import Training

ENGINE = "free_flight"
FIRST = 2000  # control steps of random actions, with which SAC begins


@dataclass
class Args:
    """What is trained; from `num_envs` on settings of SAC, which else has its library's."""

    task: str = "hover"  # name of the task
    algo: str = "ppo"  # ppo, trpo, vpg, apg, sac; or geometric, the controller
    seed: int = 0  # seed of the networks, the exploration and the episodes
    points: int = 24  # of the curve
    total_steps: int = 102_400  # control steps of all aircraft, after which SAC ends
    seconds: float = float("inf")  # processor time after which SAC ends, if that is earlier
    num_envs: int = 16  # aircraft flown together
    gradient_steps: int = 2  # for each control step of all of them
    batch_size: int = 256  # transitions in a gradient step
    learning_rate: float = 6e-3  # of Adam at the start; it falls linearly to zero
    gamma: float = 0.88  # discount of a control step
    tau: float = 0.01  # share of the networks that their slow copies take on
    width: int = 64  # of the two hidden layers of each network


class Curve:
    """What the mean action reaches as a training goes on."""

    def __init__(self, task: str, due: np.ndarray) -> None:
        """Take the control steps at which it is due; the clock starts."""
        self.task, self.due, self.found = task, due, []
        self.seconds, self.since = 0.0, time.process_time()

    def clock(self) -> float:
        """The processor time so far, less that of flights [s]."""
        return self.seconds + time.process_time() - self.since

    def look(self, steps: int, act: Callable[[], Callable], *, last: bool = False) -> None:
        """Fly what `act` makes, if that is due."""
        if not last and not (self.due <= steps).any():
            return
        self.seconds, self.due = self.clock(), self.due[self.due > steps]
        metrics = summarize(fly(act(), self.task, episodes=100, engine=ENGINE))
        self.found.append({"steps": steps, "seconds": round(self.seconds, 2)} | metrics)
        self.since = time.process_time()


def quadrl_curve(args: Args) -> list[dict]:
    """Train with quadrl."""
    config = TrainConfig(args.task, algo=args.algo, seed=args.seed, num_threads=1)
    batch = config.num_envs * config.rollout
    with tempfile.TemporaryDirectory() as folder:
        training = Training(config, Path(folder, "run"))
        curve = Curve(args.task, batch * np.geomspace(1, config.iterations, args.points).round())
        training.run(lambda progress: curve.look(progress.steps, training.policy))
    return curve.found


class Looking(BaseCallback):
    """Looks at SAC, and ends it when its time is over."""

    def __init__(self, args: Args, envs: VecNormalize) -> None:
        """Take the arguments, and what SAC trains in."""
        super().__init__()
        self.args, self.envs = args, envs

    def _on_training_start(self) -> None:
        due = np.geomspace(FIRST, self.args.total_steps, self.args.points)
        self.curve = Curve(self.args.task, due)

    def _on_step(self) -> bool:
        over = self.curve.clock() >= self.args.seconds
        self.curve.look(self.num_timesteps, lambda: self.mean_action, last=over)
        return not over

    def mean_action(self, observation: np.ndarray) -> np.ndarray:
        """The action without noise (N, 4)."""
        return self.model.predict(self.envs.normalize_obs(observation), deterministic=True)[0]


def geometric_curve(args: Args) -> list[dict]:
    """Fly the geometric controller, which learns nothing: one point."""
    curve = Curve(args.task, np.zeros(1))
    curve.look(0, lambda: make_controller("geometric", args.task))
    return curve.found


def sac_curve(args: Args) -> list[dict]:
    """Train with Stable-Baselines3's SAC."""
    batch = QuadrotorVecEnv(args.task, args.num_envs, engine=ENGINE, num_threads=1)
    envs = VecNormalize(VecMonitor(batch), gamma=args.gamma)
    model = SAC(
        "MlpPolicy",
        envs,
        learning_starts=FIRST,
        gradient_steps=args.gradient_steps,
        batch_size=args.batch_size,
        learning_rate=lambda left: args.learning_rate * left,  # of the training, from 1 to 0
        gamma=args.gamma,
        tau=args.tau,
        policy_kwargs={"net_arch": [args.width] * 2},
        seed=args.seed * args.num_envs,  # aircraft i gets this + i
        device="cpu",
    )
    looking = Looking(args, envs)
    model.learn(args.total_steps, callback=looking)
    return looking.curve.found


def main(args: Args) -> None:
    """Train; print one JSON object."""
    torch.set_num_threads(1)  # networks this small are slower with a second thread
    others = {"sac": sac_curve, "geometric": geometric_curve}
    curve = others.get(args.algo, quadrl_curve)(args)
    print(json.dumps({"task": args.task, "algo": args.algo, "seed": args.seed, "curve": curve}))


if __name__ == "__main__":
    main(tyro.cli(Args))
