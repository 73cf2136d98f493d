"""rsl_rl: a native batch as its VecEnv. It needs rsl-rl-lib, thus torch."""

# pyright: reportIncompatibleVariableOverride=false
# `episode_length_buf` is a property here: what is set is checked.

from __future__ import annotations

from typing import Any

import numpy as np

from quadrl.base.extras import needed

with needed("quadrl.envs.rsl_rl"):
    from rsl_rl.env import VecEnv  # isort: skip
    import torch
    from tensordict import TensorDict
    from torch import Tensor

from quadrl.base.errors import QuadrlError
from quadrl.core.batch import Slot
from quadrl.core.scenario import Scenario
from quadrl.core.task import Task
from quadrl.envs.common import Changing, make
from quadrl.envs.on_device import asks, batch_of


class QuadrotorVecEnv(Changing, VecEnv):
    """N aircraft on all cores: `OnPolicyRunner(QuadrotorVecEnv("hover", 256), settings)`.

    Observations are a TensorDict with the group `policy` (N, size) and, with
    `observe={"privileged": True}`, the group `critic` (N, p): the privileged observation, in which
    the true one is. A row begins anew in the step that ends its episode. With the device cuda and
    `engine="free_flight"` the GPU simulates, and tensors are its own, filled again by the second
    step after (`DeviceVecEnv`); else the CPU does.
    """

    def __new__(
        cls, task: Any = "hover", num_envs: int = 1, seed: Any = None, device: Any = "cpu",
        **settings: Any,
    ) -> Any:  # fmt: skip
        """Choose who simulates."""
        return object.__new__(DeviceVecEnv if asks(task, device, settings) else cls)

    def __init__(
        self,
        task: str | Task = "hover",
        num_envs: int = 1,
        seed: int | None = None,
        device: str | torch.device = "cpu",
        **settings: Any,
    ) -> None:
        """Make N environments.

        Args:
            task: A name of the catalogue or a task.
            num_envs: N.
            seed: Row i is seeded with seed + i; None for one from the system.
            device: Of the tensors.
            **settings: Those of `quadrl.envs.common.make`.

        Raises:
            QuadrlError: Unknown name or impossible value.
        """
        self.environment = make(task, num_envs, ("device",), seed=seed, **settings)
        self.num_envs, self.num_actions = num_envs, self.environment.action_size
        self.device = torch.device(device)
        self._lengths = np.zeros(num_envs, np.int64)
        self._observation = np.zeros((num_envs, self.environment.size), np.float32)

    @property
    def max_episode_length(self) -> int:
        """The time limit in control steps."""
        return self.environment.time_limit_steps

    @property
    def cfg(self) -> Scenario:
        """What is flown and how."""
        return self.environment.scenario

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps of each row's episode (N,), a copy; set them to end episodes earlier.

        At `max_episode_length` an episode is over by the clock. `OnPolicyRunner.learn` sets random
        lengths at the start, so that the rows do not end together. The environment counts on its
        own: the task's time and its weather do not jump, and a row whose length is set back still
        ends with its time limit.
        """
        return torch.from_numpy(self._lengths.copy()).to(self.device)

    @episode_length_buf.setter
    def episode_length_buf(self, lengths: torch.Tensor) -> None:
        given = torch.as_tensor(lengths).cpu().numpy()
        if given.shape != (self.num_envs,) or given.dtype.kind not in "iu" or (given < 0).any():
            allowed = f"{self.num_envs} whole numbers from 0 on"
            raise QuadrlError(name="episode_length_buf", value=lengths, allowed=allowed)
        self._lengths = given.astype(np.int64)

    def get_observations(self) -> TensorDict:
        """The observations now; the first call begins the first episodes."""
        if not self.environment.has_begun:
            self.reset()
        return self._groups()

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Begin an episode in every row; returns the observations and nothing further."""
        self._begin(np.ones(self.num_envs, dtype=bool))
        return self._groups(), {}

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Fly one control step; actions (N, k) are clipped to [-1, 1].

        Returns:
            Observations, those of the new episode where one has ended; rewards (N,) float32; dones
            (N,) 0 or 1; and extras: `time_outs` (N,) bool, over by the clock; where an episode has
            ended also `final_obs`, the observations (N, ...) before any row began anew, and
            `log`, with `success` and `error` [m] of the episodes that ended by themselves.
        """
        now = self.environment.step(actions.detach().cpu())
        self._observation = self.environment.flatten(now.observation)
        self._lengths += 1
        itself = np.logical_or(now.terminated, now.truncated)
        over = itself | (self._lengths >= self.max_episode_length)
        extras: dict[str, Any] = {"time_outs": self._tensor(over & ~now.terminated)}
        if itself.any():
            ends = {"success": now.is_success, "error": now.error}
            log = {name: self._tensor(x[itself].astype(np.float32)) for name, x in ends.items()}
            extras["log"] = log
        if over.any():
            extras["final_obs"] = self._groups()
            self._begin(over)
        dones = self._tensor(over.astype(np.int64))
        return self._groups(), self._tensor(now.reward.astype(np.float32)), dones, extras

    def _begin(self, rows: np.ndarray) -> None:
        """Begin an episode in some rows (N,) bool."""
        self._observation[rows] = self.environment.flatten(self.environment.reset(rows))
        self._lengths[rows] = 0

    def _groups(self) -> TensorDict:
        """The groups of observations now, copied."""
        groups = {"policy": self._tensor(self._observation.copy())}
        if (privileged := self.environment.privileged) is not None:
            groups["critic"] = self._tensor(privileged.astype(np.float32))
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(array).to(self.device)


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
        own: Any = settings | {"slots": 2}
        self.batch = batch_of(task, num_envs, seed, device, own)
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
        self.batch.take(actions, self._turn)
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
