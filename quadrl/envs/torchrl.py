"""Door three: a batched TorchRL environment.

Not imported with `import quadrl`, since it needs torch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from quadrl import tasks
from quadrl.environment import Environment
from quadrl.simulation import Engine
from quadrl.task import Task
from quadrl.vehicle import Vehicle

FLAGS = ("done", "terminated", "truncated", "is_success")


class QuadrotorEnv(EnvBase):
    """N aircraft, batch size [N]; observation (N, size) float32, action (N, 4) in [-1, 1].

    Simulated on the CPU, whatever the device of the tensors. Beside the observation stand
    `is_success`, `error` [m] and, when asked for, the named `reward_terms`.
    """

    def __init__(
        self,
        task: str | Task = "hover",
        num_envs: int = 1,
        seed: int | None = None,
        device: str | torch.device = "cpu",
        *,
        vehicle: Vehicle | None = None,
        action: str = "rotor",
        num_threads: int = 0,
        engine: Engine = "mujoco",
        reward_terms: bool = False,
        **options: Any,  # noqa: ANN401 - of the task's own types
    ) -> None:
        """Make the environments.

        Args:
            task: A name of the catalogue or a task.
            num_envs: N.
            seed: Aircraft i is seeded with seed + i.
            device: Of the tensors.
            vehicle: The aircraft; None for the paper's.
            action: What actions mean, a name of `quadrl.interfaces.INTERFACES`.
            num_threads: Threads of the simulation; 0 for every core.
            engine: "mujoco", or "flight": free flight wherever there is nothing to touch.
            reward_terms: Whether to give the named terms of the reward (they cost time).
            **options: Fields of the task.

        Raises:
            ValueError: Unknown task, interface or option, or an impossible number of environments.
        """
        self.environment = Environment(
            tasks.make(task, **options),
            num_envs=num_envs,
            seed=seed,
            vehicle=vehicle,
            num_threads=num_threads,
            engine=engine,
            action=action,
        )
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self._terms = self.environment.term_names if reward_terms else ()
        shape, column = torch.Size([num_envs]), torch.Size([num_envs, 1])
        vector = torch.Size([num_envs, self.environment.size])
        actions = torch.Size([num_envs, self.environment.interface.size])
        parts: dict[str, Any] = {
            "observation": Unbounded(vector, dtype=torch.float32),
            "is_success": Binary(shape=column, dtype=torch.bool),
            "error": Unbounded(column, dtype=torch.float32),
        }
        if self._terms:
            terms = {name: Unbounded(column) for name in self._terms}
            parts["reward_terms"] = Composite(terms, shape=shape)
        self.observation_spec = Composite(parts, shape=shape).to(self.device)
        self.action_spec = Bounded(-1.0, 1.0, actions, dtype=torch.float32).to(self.device)
        self.reward_spec = Unbounded(column, dtype=torch.float32).to(self.device)
        self.done_spec = Composite(
            {flag: Binary(shape=column, dtype=torch.bool) for flag in FLAGS[:3]}, shape=shape
        ).to(self.device)
        self._restored = False

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Go on where `environment.save` was called: the next full reset returns that moment."""
        self._observation = self.environment.flatten(self.environment.restore(saved))
        self._restored = True

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:  # noqa: ANN401
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None and not mask.all():
            rows = mask.reshape(-1).cpu().numpy()
            self._observation[rows] = self.environment.flatten(self.environment.reset(rows))
        elif not self._restored:
            self._observation = self.environment.flatten(self.environment.reset())
        flags = {flag: torch.zeros(self.num_envs, 1, dtype=torch.bool) for flag in FLAGS}
        zeros = {name: torch.zeros(self.num_envs, 1) for name in ("error", *self._terms)}
        return self._pack(flags | {"error": zeros.pop("error")}, zeros)

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begin anew where episodes are over.

        It gives what EnvBase gives, whose generality would cost more than the whole step.
        """
        over = tensordict.get("done")
        values = dict(tensordict.items())
        some = bool(over.any() and not over.all())
        if not some or not all(isinstance(x, torch.Tensor) for x in values.values()):
            return super().maybe_reset(tensordict)
        fresh = self._reset(TensorDict({"_reset": over}, batch_size=self.batch_size))
        kept = values.keys() - set(fresh.keys()) | {"error"}
        for name in kept:  # what a policy remembers (a recurrent state) ends with its episode
            rows = over.reshape(-1, *[1] * (values[name].ndim - 1))
            fresh.set(name, values[name].masked_fill(rows, 0))
        return tensordict.update(fresh)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._restored = False
        now = self.environment.step(tensordict["action"].detach().cpu())
        self._observation = self.environment.flatten(now.observation)
        columns = {
            "reward": now.reward.astype(np.float32),
            "done": now.terminated | now.truncated,
            "terminated": now.terminated,
            "truncated": now.truncated,
            "is_success": now.is_success,
            "error": now.error.astype(np.float32),
        }
        terms = {name: now.reward_terms[name].astype(np.float32) for name in self._terms}
        return self._pack(
            {name: torch.from_numpy(column[:, None]) for name, column in columns.items()},
            {name: torch.from_numpy(column[:, None]) for name, column in terms.items()},
        )

    def _pack(
        self, columns: dict[str, torch.Tensor], terms: dict[str, torch.Tensor]
    ) -> TensorDictBase:
        content: dict[str, Any] = {"observation": torch.from_numpy(self._observation.copy())}
        content |= columns
        if terms:
            content["reward_terms"] = TensorDict(terms, batch_size=self.batch_size)
        packed = TensorDict(content, batch_size=self.batch_size)
        return packed if self.device.type == "cpu" else packed.to(self.device)

    def _set_seed(self, seed: int | None) -> None:
        self.environment.seed(seed)

    @property
    def num_envs(self) -> int:
        """N."""
        return self.environment.num_envs
