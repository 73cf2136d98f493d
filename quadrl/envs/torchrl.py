"""TorchRL: a batched environment. It needs torch, so `import quadrl` leaves it out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from quadrl.base.extras import needed

with needed("quadrl.envs.torchrl"):
    import torch
    from tensordict import TensorDict, TensorDictBase
    from torchrl.data import Binary, Bounded, Composite, Unbounded
    from torchrl.envs import EnvBase

from quadrl.base.errors import QuadrlError
from quadrl.core.batch import Batch
from quadrl.core.task import Task
from quadrl.core.transition import Transition
from quadrl.envs.common import PICTURE, Changing, make
from quadrl.envs.on_device import OnDevice, asks, batch_of
from quadrl.rendering.pictures import Pictures

DONE = ("done", "terminated", "truncated")


class QuadrotorEnv(Changing, EnvBase):
    """N aircraft, batch size [N]; observation (N, size) float32, action (N, k) in [-1, 1].

    With the device cuda and `engine="free_flight"` the GPU simulates them, in single precision
    unless `precision="float64"` is given, and without pixels or starts; else the CPU, whatever the
    device of the tensors. `is_success`, `error` [m] and, on request, the named `reward_terms`
    and `pixels` stand beside the observation. `reset(start=...)` takes a start as
    `quadrl.core.environment.Environment.reset` does. TorchRL's PixelRenderTransform and
    VideoRecorder draw with `render`.
    """

    def __init__(
        self,
        task: str | Task = "hover",
        num_envs: int = 1,
        seed: int | None = None,
        device: str | torch.device = "cpu",
        *,
        reward_terms: bool = False,
        from_pixels: bool = False,
        width: int = 640,
        height: int = 480,
        camera: str = "follow",
        **settings: Any,
    ) -> None:
        """Make the environments.

        Args:
            task: A name of the catalogue or a task.
            num_envs: Number of aircraft, N.
            seed: Row i is seeded with seed + i; None for one from the system.
            device: Device of the tensors.
            reward_terms: Whether to give the named terms of the reward (they cost time).
            from_pixels: Whether to give pictures, `pixels` (N, height, width, 3) uint8.
            width: Width of a picture [pixels].
            height: Height of a picture [pixels].
            camera: A name of `quadrl.rendering`.
            **settings: Those of `quadrl.envs.common.make`.

        Raises:
            QuadrlError: Unknown name or impossible value.
        """
        also = ("from_pixels", *PICTURE)
        self._flown: OnDevice | None = None
        if asks(task, device, settings):
            if from_pixels:
                allowed = "False on a GPU, where free flight has none"
                raise QuadrlError(name="from_pixels", value=True, allowed=allowed)
            batch = batch_of(task, num_envs, seed, device, settings)
            self.environment = batch.environment
            terms = batch.environment.term_names if reward_terms else ()
            self._flown = OnDevice(batch, terms)
        else:
            self.environment = make(task, num_envs, also, seed=seed, **settings)
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self._terms = self.environment.term_names if reward_terms else ()
        shape, column = torch.Size([num_envs]), torch.Size([num_envs, 1])
        vector = torch.Size([num_envs, self.environment.size])
        actions = torch.Size([num_envs, self.environment.action_size])
        entries: dict[str, Any] = {
            "observation": Unbounded(vector, dtype=torch.float32),
            "is_success": Binary(shape=column, dtype=torch.bool),
            "error": Unbounded(column, dtype=torch.float32),
        }
        if (privileged := self.environment.privileged) is not None:
            wide = torch.Size([num_envs, privileged.shape[1]])
            entries["privileged"] = Unbounded(wide, dtype=torch.float32)
        if self._terms:
            terms = {name: Unbounded(column) for name in self._terms}
            entries["reward_terms"] = Composite(terms, shape=shape)
        self._pictures = Pictures(self.environment, camera, width, height)
        self._from_pixels = from_pixels
        if from_pixels:
            picture = torch.Size([num_envs, height, width, 3])
            entries["pixels"] = Bounded(0, 255, picture, dtype=torch.uint8)
        done = {flag: Binary(shape=column, dtype=torch.bool) for flag in DONE}
        self.observation_spec = Composite(entries, shape=shape).to(self.device)
        self.action_spec = Bounded(-1.0, 1.0, actions, dtype=torch.float32).to(self.device)
        self.reward_spec = Unbounded(column, dtype=torch.float32).to(self.device)
        self.done_spec = Composite(done, shape=shape).to(self.device)
        self._restored = False

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Restore what `environment.save` returned, or `batch.save` of aircraft on a GPU.

        The next full reset returns that moment.
        """
        if self._flown:
            return self._flown.restore(saved)
        self._observation = self.environment.flatten(self.environment.restore(saved))
        self._restored = True

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        start: Mapping[str, Any] | None = None,
        **_: Any,
    ) -> TensorDictBase:
        if self._flown:
            return self._flown.reset(tensordict, start)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None and not mask.all():
            self._begin(mask, start)
        elif start or not self._restored:
            self._observation = self.environment.flatten(self.environment.reset(start=start))
        flags = {name: torch.zeros(self.num_envs, 1, dtype=torch.bool) for name in DONE}
        flags["is_success"] = torch.zeros_like(flags["done"])
        zeros = {name: torch.zeros(self.num_envs, 1) for name in ("error", *self._terms)}
        return self._pack(flags | {"error": zeros.pop("error")}, zeros)

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begin anew where episodes are over.

        The result is that of EnvBase, whose generality would cost more than the whole step.
        """
        if self._flown:
            return self._flown.maybe_reset(tensordict)
        over = tensordict.get("done")
        values = dict(tensordict.items())
        some = bool(over.any() and not over.all())
        if not some or not all(isinstance(x, torch.Tensor) for x in values.values()):
            return super().maybe_reset(tensordict)
        self._begin(over)
        seen = self._seen()
        for name, value in values.items():  # what a policy remembers ends with its episode, too
            rows = over.reshape(-1, *[1] * (value.ndim - 1))
            fresh = seen[name].to(value.device) if name in seen else value.masked_fill(rows, 0)
            tensordict.set(name, fresh)
        return tensordict

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._flown:
            return self._flown.step(tensordict["action"])
        self._restored = False
        now = self._fly(tensordict["action"].detach().cpu())
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

    def _fly(self, action: torch.Tensor) -> Transition:
        return self.environment.step(action)

    def _begin(self, over: torch.Tensor, start: Mapping[str, Any] | None = None) -> None:
        """Begin an episode of the aircraft of a mask (N, 1)."""
        rows = over.reshape(-1).cpu().numpy()
        self._observation[rows] = self.environment.flatten(self.environment.reset(rows, start))

    def _seen(self) -> dict[str, torch.Tensor]:
        """Entries of the observation now."""
        seen = {"observation": torch.from_numpy(self._observation.copy())}
        if (privileged := self.environment.privileged) is not None:
            seen["privileged"] = torch.from_numpy(privileged.astype(np.float32))
        if self._from_pixels:
            seen["pixels"] = torch.from_numpy(self.render())
        return seen

    def _pack(
        self, columns: dict[str, torch.Tensor], terms: dict[str, torch.Tensor]
    ) -> TensorDictBase:
        content: dict[str, Any] = self._seen() | columns
        if terms:
            content["reward_terms"] = TensorDict(terms, batch_size=self.batch_size)
        packed = TensorDict(content, batch_size=self.batch_size)
        return packed if self.device.type == "cpu" else packed.to(self.device)

    def render(self) -> np.ndarray:
        """A picture of each aircraft, (N, height, width, 3) uint8.

        Raises:
            QuadrlError: They are on a GPU.
        """
        if self._flown:
            raise QuadrlError("aircraft on a GPU are drawn from `batch.row`, by an Environment")
        return np.stack([self._pictures.frame(row) for row in range(self.num_envs)])

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the renderer."""
        self._pictures.close()
        super().close(raise_if_closed=raise_if_closed)

    def _set_seed(self, seed: int | None) -> None:
        (self._flown.batch if self._flown else self.environment).seed(seed)

    @property
    def batch(self) -> Batch | None:
        """The aircraft, where they fly on a GPU; `environment` then has one of them."""
        return self._flown.batch if self._flown else None

    @property
    def num_envs(self) -> int:
        """N."""
        return (self._flown.batch if self._flown else self.environment).num_envs
