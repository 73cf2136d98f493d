"""TorchRL's environment and rsl_rl's on a GPU: their tensors are those that the step fills."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from quadrl.base.errors import QuadrlError
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.device.batch import Batch, Slot
from quadrl.envs.common import OWN
from quadrl.envs.torchrl import DONE, QuadrotorEnv


def batch_of(task: Any, num_envs: int, seed: Any, device: Any, settings: dict[str, Any]) -> Batch:
    """The batch of an API, from its keywords."""
    also = {name: settings.pop(name) for name in ("precision", "slots") if name in settings}
    settings.pop("num_threads", None)  # nothing is simulated on them
    scenario = Scenario.of(task, (*OWN, "device", "precision"), **settings)
    return Batch(scenario, num_envs, seed, device, **also)


class DeviceEnv(QuadrotorEnv):
    """QuadrotorEnv whose aircraft fly where its tensors are; rows begin anew in the step itself.

    It has no pixels, `reset` takes no start, and what `environment` is has one aircraft.
    """

    batch: Batch

    def _make(
        self, task: Any, num_envs: int, also: Any, *, seed: Any, device: Any, **settings: Any
    ) -> Environment:
        vars(self)["batch"] = batch_of(task, num_envs, seed, device, settings)
        return self.batch.environment

    def __init__(self, *given: Any, **settings: Any) -> None:
        """Make the environments; arguments as for QuadrotorEnv, and the `precision`.

        Raises:
            QuadrlError: As `Batch` and QuadrotorEnv do, or pixels are asked for.
        """
        if settings.get("from_pixels"):
            allowed = "False on a GPU, where free flight has none"
            raise QuadrlError(name="from_pixels", value=True, allowed=allowed)
        super().__init__(*given, **settings)
        self._fresh = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        self._begun = False

    @property
    def num_envs(self) -> int:
        """N."""
        return self.batch.num_envs

    def save(self) -> dict[str, Any]:
        """All that the next steps depend on, for `restore`."""
        return self.batch.save()

    def restore(self, saved: dict[str, Any]) -> None:
        """Restore what `save` returned: the next full reset returns that moment."""
        self.batch.restore(saved)
        self._restored = self._begun = True

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, start: Any = None, **_: Any
    ) -> TensorDictBase:
        if start:
            allowed = "None on a GPU, where episodes begin as the task says"
            raise QuadrlError(name="start", value=start, allowed=allowed)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None and self._begun:
            mask = mask.reshape(-1)
            self.batch.reset(mask & ~self._fresh)  # the others have begun within the step
            self._fresh |= mask
        elif not self._restored:
            self.batch.reset()
            self._fresh.fill_(True)
        self._begun, self._restored = True, False
        zero = torch.zeros(self.num_envs, 1, device=self.device)
        entries = {name: zero.bool() for name in (*DONE, "is_success")}
        return self._packed(self._present(), entries | {"error": zero}, zero.T)

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begin anew where episodes are over, which the step has done; nothing waits for it."""
        over, seen = tensordict.get("done").reshape(-1), self._present()
        self._fresh |= over
        for name, value in tensordict.items():
            rows = over.reshape(-1, *[1] * (value.ndim - 1))
            tensordict.set(name, seen[name] if name in seen else value.masked_fill(rows, 0))
        return tensordict

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action: Tensor = tensordict["action"].detach()
        taken = self.batch.action[0]
        if action.shape != taken.shape or str(action.device) != str(taken.device):
            allowed = f"{tuple(taken.shape)} on {taken.device}"
            value = f"{tuple(action.shape)} on {action.device}"
            raise QuadrlError(name="action", value=value, allowed=allowed)
        taken.copy_(action)
        self._restored = False
        now = self.batch.step()
        # Those of the next step will be others.
        now = self.batch.slot(taken, self.batch.out[0].clone(), self.batch.flags[0].clone())
        self._fresh = now.over
        entries = {"reward": now.reward, "done": now.over, "terminated": now.terminated}
        entries |= {"truncated": now.truncated, "is_success": now.success, "error": now.error}
        seen = {"observation": now.final, "privileged": now.final_privileged}
        return self._packed(seen, {k: x[:, None] for k, x in entries.items()}, now.terms)

    def _present(self) -> dict[str, Tensor]:
        slot: Slot = self.batch.slots[0]
        seen = {"observation": slot.observation, "privileged": slot.privileged}
        return {name: x.to(torch.float32, copy=True) for name, x in seen.items()}

    def _packed(
        self, seen: dict[str, Tensor], entries: dict[str, Tensor], terms: Tensor
    ) -> TensorDictBase:
        named = {name: x.float() for name, x in seen.items() if x.shape[1]}
        content: dict[str, Any] = named | {
            k: x if x.dtype == torch.bool else x.float() for k, x in entries.items()
        }
        if self._terms:
            own = {k: terms[i % len(terms)][:, None].float() for i, k in enumerate(self._terms)}
            content["reward_terms"] = TensorDict(own, batch_size=self.batch_size)
        return TensorDict(content, batch_size=self.batch_size, device=self.device)

    def render(self) -> Any:
        """Refuse: no picture shows aircraft on a GPU.

        Raises:
            QuadrlError: Always; `batch.row` gives the state of one that an Environment restores.
        """
        raise QuadrlError("aircraft on a GPU are drawn from `batch.row`, by an Environment")

    def _set_seed(self, seed: int | None) -> None:
        self.batch.seed(seed)
