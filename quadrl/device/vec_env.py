"""rsl_rl's environment on a GPU, without a copy."""

# pyright: reportIncompatibleVariableOverride=false
from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from quadrl.base.errors import QuadrlError
from quadrl.device.batch import Slot
from quadrl.device.envs import batch_of
from quadrl.envs.rsl_rl import QuadrotorVecEnv


class DeviceVecEnv(QuadrotorVecEnv):
    """QuadrotorVecEnv whose aircraft fly where its tensors are.

    What `step` returns are views of one of two slots, which the second step after fills again.
    """

    def __init__(
        self,
        task: Any = "hover",
        num_envs: int = 1,
        seed: int | None = None,
        device: str | torch.device = "cuda",
        **settings: Any,
    ) -> None:
        """Make N environments; arguments as for QuadrotorVecEnv, and the `precision`.

        Raises:
            QuadrlError: As `Batch` does.
        """
        vars(self)["batch"] = batch_of(task, num_envs, seed, device, settings | {"slots": 2})
        self.batch: Any
        self.environment = self.batch.environment
        self.num_envs, self.num_actions = num_envs, self.environment.action_size
        self.device, self._turn, self._begun = self.batch.device, 1, False
        self._lengths: Any = torch.zeros(num_envs, dtype=torch.int64, device=self.device)

    @property
    def episode_length_buf(self) -> Tensor:
        """As of QuadrotorVecEnv."""
        return self._lengths.clone()

    @episode_length_buf.setter
    def episode_length_buf(self, lengths: Tensor) -> None:
        given = torch.as_tensor(lengths, device=self.device)
        kind = not (given.is_floating_point() or given.dtype == torch.bool)
        if given.shape != (self.num_envs,) or not kind or bool((given < 0).any()):
            allowed = f"{self.num_envs} whole numbers from 0 on"
            raise QuadrlError(name="episode_length_buf", value=lengths, allowed=allowed)
        self._lengths = given.long()

    def get_observations(self) -> TensorDict:
        """The observations now; the first call begins the first episodes."""
        if not self._begun:
            self.reset()
        slot: Slot = self.batch.slots[self._turn]
        return self._groups_of(slot.observation, slot.privileged)

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Begin an episode in every row; returns the observations and nothing further."""
        self.batch.reset()
        self._begun, self._turn = True, 1
        self._lengths.zero_()
        return self.get_observations(), {}

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """As of QuadrotorVecEnv, but that `final_obs` and `log` are of every step."""
        self._turn = 1 - self._turn
        slot: Slot = self.batch.slots[self._turn]
        slot.action.copy_(actions)
        self.batch.step(self._turn)
        self._lengths += 1
        late = ~slot.over & (self._lengths >= self.max_episode_length)
        over = slot.over | late
        extras: dict[str, Any] = {"time_outs": over & ~slot.terminated}
        extras["final_obs"] = self._groups_of(slot.final, slot.final_privileged)
        ended = slot.over.sum().clamp(min=1)
        named = {"success": slot.success, "error": slot.error}
        extras["log"] = {k: (x * slot.over).sum() / ended for k, x in named.items()}
        self.batch.reset(late, self._turn)
        self._lengths.masked_fill_(over, 0)
        seen = self._groups_of(slot.observation, slot.privileged)
        return seen, slot.reward, over.long(), extras

    def _groups_of(self, observation: Tensor, privileged: Tensor) -> TensorDict:
        groups = {"policy": observation} | ({"critic": privileged} if privileged.shape[1] else {})
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)
