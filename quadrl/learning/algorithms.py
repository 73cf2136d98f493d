"""The algorithm of a training, made by the name that its settings have."""

from __future__ import annotations

from typing import Any

from quadrl.learning import environments
from quadrl.learning.algorithm import Algorithm
from quadrl.learning.apg import APG
from quadrl.learning.config import TrainConfig
from quadrl.learning.dagger import Dagger
from quadrl.learning.ppo import PPO
from quadrl.learning.settings import DaggerConfig
from quadrl.learning.trpo import TRPO
from quadrl.learning.vpg import VPG

ALGORITHMS = {"ppo": PPO, "trpo": TRPO, "vpg": VPG}


def make_algorithm(
    config: TrainConfig, env: environments.TrainingEnv, actor: Any, critic: Any
) -> Algorithm:
    """Make the algorithm of a training."""
    own = getattr(config, config.algo)
    if isinstance(env, environments.RecordingEnv):
        return APG(actor, critic, own, env, config.gamma, config.reward_scale)
    if isinstance(own, DaggerConfig):
        return Dagger(actor, critic, own, env)
    return ALGORITHMS[config.algo](actor, critic, own)
