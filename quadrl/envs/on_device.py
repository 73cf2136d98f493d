"""What TorchRL's environment does where its aircraft fly on a GPU, on the tensors of the step."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from quadrl.base.errors import QuadrlError
from quadrl.core.batch import Batch, Slot
from quadrl.core.scenario import Scenario
from quadrl.envs.common import OWN


def batch_of(task: Any, num_envs: int, seed: Any, device: Any, settings: dict[str, Any]) -> Batch:
    """The batch of an API, from its keywords."""
    own = {name: settings.pop(name) for name in ("precision", "slots") if name in settings}
    settings.pop("num_threads", None)  # nothing is simulated on them
    scenario = Scenario.of(task, (*OWN, "device", "precision"), **settings)
    return Batch(scenario, num_envs, seed, device, **own)


def asks(task: Any, device: Any, settings: dict[str, Any]) -> bool:
    """Whether a GPU simulates, by the keywords of an API: the device cuda, and free flight."""
    engine = settings.get("engine") or getattr(task, "engine", None)
    return engine == "free_flight" and torch.device(device).type == "cuda"


class OnDevice:
    """The aircraft of a QuadrotorEnv in a batch, whose rows begin anew in the step itself."""

    def __init__(self, batch: Batch, terms: tuple[str, ...]) -> None:
        """Take them, and the names of the terms of the reward that are given."""
        self.batch, self._terms = batch, terms
        self._fresh = torch.ones(batch.num_envs, dtype=torch.bool, device=batch.device)
        self._begun = self._restored = False

    def restore(self, saved: dict[str, Any]) -> None:
        """Restore what `batch.save` returned: the next full reset returns that moment."""
        self.batch.restore(saved)
        self._restored = self._begun = True

    def reset(self, tensordict: TensorDictBase | None, start: Any) -> TensorDictBase:
        """Begin episodes, as EnvBase does.

        Raises:
            QuadrlError: A start is given.
        """
        if start:
            allowed = "None on a GPU, where episodes begin as the task says"
            raise QuadrlError(name="start", value=start, allowed=allowed)
        mask: Any = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None and self._begun:
            mask = mask.reshape(-1)
            self.batch.reset(mask & ~self._fresh)  # the others have begun within the step
            self._fresh |= mask
        elif not self._restored:
            self.batch.reset()
            self._fresh.fill_(True)
        self._begun, self._restored = True, False
        zero = torch.zeros(self.batch.num_envs, 1, device=self.batch.device)
        flags = ("done", "terminated", "truncated", "is_success")
        entries = {name: zero.bool() for name in flags} | {"error": zero}
        terms = zero.T.expand(max(1, len(self._terms)), -1)
        return self._packed(self._present(), entries, terms)

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begin anew where episodes are over, which the step has done; nothing waits for it."""
        over, seen = tensordict.get("done").reshape(-1), self._present()
        self._fresh |= over
        for name, value in tensordict.items():
            rows = over.reshape(-1, *[1] * (value.ndim - 1))
            tensordict.set(name, seen[name] if name in seen else value.masked_fill(rows, 0))
        return tensordict

    def step(self, action: Tensor) -> TensorDictBase:
        """Fly a control step.

        Raises:
            QuadrlError: The actions are of another shape, or on another device.
        """
        self.batch.take(action)
        self._restored = False
        self.batch.step()
        # Those of the next step will be others.
        now = self.batch.slot(action, self.batch.out[0].clone(), self.batch.flags[0].clone())
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
        content: dict[str, Any] = {name: x.float() for name, x in seen.items() if x.shape[1]}
        content |= {k: x if x.dtype == torch.bool else x.float() for k, x in entries.items()}
        size = [self.batch.num_envs]
        if self._terms:
            own = {k: x[:, None].float() for k, x in zip(self._terms, terms, strict=True)}
            content["reward_terms"] = TensorDict(own, batch_size=size)
        return TensorDict(content, batch_size=size, device=self.batch.device)
