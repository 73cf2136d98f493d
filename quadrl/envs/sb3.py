"""Stable-Baselines3: a native batch as its VecEnv. It needs stable-baselines3, thus torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from quadrl.base.extras import needed

with needed("quadrl.envs.sb3"):
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices

from quadrl.base.errors import QuadrlError
from quadrl.core.task import Task
from quadrl.envs.common import Changing
from quadrl.envs.gymnasium import QuadrotorVectorEnv

Array = np.ndarray


class QuadrotorVecEnv(Changing, VecEnv):
    """N aircraft on all cores: `PPO("MlpPolicy", QuadrotorVecEnv("hover", 64))`.

    A row begins anew in the step that ends its episode. The info of a row is empty while its
    episode goes on; at the end it holds what Gymnasium's info holds, `terminal_observation` and
    `TimeLimit.truncated`.
    """

    def __init__(
        self,
        task: str | Task = "hover",
        num_envs: int = 1,
        *,
        reward_terms: bool = False,
        **settings: Any,
    ) -> None:
        """Make N environments.

        Args:
            task: A name of the catalogue or a task.
            num_envs: Number of aircraft, N.
            reward_terms: Whether infos hold the terms of the reward.
            **settings: Those of `quadrl.envs.gymnasium.QuadrotorVectorEnv`, but `autoreset_mode`.

        Raises:
            QuadrlError: Unknown name or impossible value.
        """
        self.envs = QuadrotorVectorEnv(
            task, num_envs, autoreset_mode="SameStep", reward_terms=reward_terms, **settings
        )
        single = self.envs.single_observation_space, self.envs.single_action_space
        super().__init__(num_envs, *single)
        self.metadata, self.environment = self.envs.metadata, self.envs.environment
        self._actions = np.zeros((num_envs, self.envs.environment.action_size))

    def reset(self) -> Array:
        """Begin an episode in every row, with the seeds and options that were set."""
        options = {name: [given[name] for given in self._options] for name in self._options[0]}
        seeds = None if self._seeds[0] is None else self._seeds
        observation, _ = self.envs.reset(seed=seeds, options=options)
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: Array) -> None:
        """Keep the actions (N, k) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Array, Array, Array, list[dict[str, Any]]]:
        """Fly one control step."""
        observation, reward, terminated, truncated, info = self.envs.step(self._actions)
        over, infos = terminated | truncated, [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(over):
            end = {k: v[i] for k, v in info["final_info"].items() if not k.startswith("_")}
            infos[i] = end | {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
            }
        return observation, reward.astype(np.float32), over, infos

    def get_images(self) -> Sequence[Array | None]:
        """A picture (height, width, 3) uint8 of each aircraft."""
        return self.envs.render() or [None] * self.num_envs

    def close(self) -> None:
        """Free the renderer."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of each row's environment."""
        return self._of_rows(self.envs.get_attr(attr_name), indices)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of every row's environment, which they share."""
        if len(list(self._get_indices(indices))) != self.num_envs:
            allowed = "None: the rows share their environment"
            raise QuadrlError(name="indices", value=indices, allowed=allowed)
        self.envs.set_attr(attr_name, [value] * self.num_envs)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of each row's environment."""
        values = self.envs.call(method_name, *method_args, **method_kwargs)
        return self._of_rows(values, indices)

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """False: a row has no wrapper of its own."""
        return self._of_rows([False] * self.num_envs, indices)

    def _of_rows(self, values: Sequence[Any], indices: VecEnvIndices) -> list[Any]:
        return [values[i] for i in self._get_indices(indices)]
