"""The APIs with one face, for tests of what they have in common."""

import importlib.util

import numpy as np
import torch
from helpers import needs_dm_control

from quadrl import envs
from quadrl.envs.gymnasium import QuadrotorEnv, QuadrotorVectorEnv
from quadrl.envs.sb3 import QuadrotorVecEnv
from quadrl.envs.torchrl import QuadrotorEnv as TorchEnv


class DmControl:
    """One aircraft by dm_control; a seed is given when it is made."""

    rows = 1

    def __init__(self, task="hover", seed=None, **settings):
        needs_dm_control()
        self.environment = envs.dm_control.make(task, random=seed, **settings)
        self.core = self.environment.task.environment

    def reset(self):
        return self.environment.reset()

    def step(self, actions):
        return self.environment.step(actions[0])

    def observation(self, given):
        return np.concatenate(list(given.observation.values()))[None]

    def terminated(self, given):
        return [given.last() and given.discount == 0.0]

    def copied(self, given):
        return {name: term.copy() for name, term in given.observation.items()} | {
            "reward": given.reward
        }


class Gymnasium:
    """One aircraft by Gymnasium."""

    rows = 1

    def __init__(self, task="hover", seed=None, **settings):
        self.environment, self.seed = QuadrotorEnv(task, **settings), seed
        self.core = self.environment.environment

    def reset(self):
        seed, self.seed = self.seed, None
        return self.environment.reset(seed=seed)

    def step(self, actions):
        return self.environment.step(actions[0])

    def observation(self, given):
        return given[0].reshape(self.rows, -1)

    def terminated(self, given):
        return np.reshape(given[2], self.rows).tolist()

    def copied(self, given):
        return {"observation": given[0].copy(), "rest": repr(given[1:])}


class Vector(Gymnasium):
    """Two aircraft by Gymnasium."""

    rows = 2

    def __init__(self, task="hover", seed=None, *, mode="DISABLED", **settings):
        self.environment = QuadrotorVectorEnv(task, 2, autoreset_mode=mode, **settings)
        self.core, self.seed = self.environment.environment, seed

    def step(self, actions):
        return self.environment.step(actions)


class TorchRL:
    """Two aircraft by TorchRL."""

    rows = 2

    def __init__(self, task="hover", seed=None, **settings):
        self.environment = TorchEnv(task, 2, seed=seed, reward_terms=True, **settings)
        self.core = self.environment.environment

    def reset(self):
        self.met = self.environment.reset()
        return self.met

    def step(self, actions):
        actions = torch.as_tensor(actions) if isinstance(actions, np.ndarray) else actions
        now = self.environment.step(self.met.clone().set("action", actions))
        return now["next"]

    def observation(self, given):
        return given["observation"].numpy()

    def terminated(self, given):
        return given["terminated"].flatten().tolist()

    def copied(self, given):
        return {name: term.clone().numpy() for name, term in given.items(True, True)}


class StableBaselines(Vector):
    """Two aircraft by Stable-Baselines3, which begins anew in the step of an end."""

    def __init__(self, task="hover", seed=None, **settings):
        self.environment = QuadrotorVecEnv(task, 2, reward_terms=True, **settings)
        self.core, self.seed = self.environment.envs.environment, seed

    def reset(self):
        if self.seed is not None:
            self.environment.seed(self.seed)
        self.seed = None
        return self.environment.reset(), [{}, {}]

    def observation(self, given):
        seen = given[0].copy()
        for row, info in zip(seen, given[-1], strict=True):
            row[:] = info.get("terminal_observation", row)
        return seen

    def terminated(self, given):
        return [k and not x["TimeLimit.truncated"] for k, x in zip(*given[2:], strict=True)]


class RslRl:
    """Two aircraft by rsl_rl, which begins anew in the step of an end."""

    rows = 2

    def __init__(self, task="hover", seed=None, **settings):
        self.environment = envs.rsl_rl.QuadrotorVecEnv(task, 2, seed=seed, **settings)
        self.core = self.environment.environment

    def reset(self):
        return self.environment.reset()

    def step(self, actions):
        return self.environment.step(torch.as_tensor(actions))

    def observation(self, given):
        return given[-1].get("final_obs", given[0])["policy"].numpy()

    def terminated(self, given):
        return ((given[2] == 1) & ~given[3]["time_outs"]).tolist()

    def copied(self, given):
        return given[0].clone().numpy() | {"rest": repr(given[1:])}


APIS = [DmControl, Gymnasium, Vector, TorchRL, StableBaselines]
if importlib.util.find_spec("rsl_rl"):
    APIS.append(RslRl)
