"""N aircraft on a device: one call for a control step of all, on torch's tensors."""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from quadrl.base import validation
from quadrl.base.errors import QuadrlError
from quadrl.base.machine import GIB
from quadrl.base.philox import Seed, seeds_of_rows
from quadrl.base.trace import NotCompilable
from quadrl.core.columns import Layout, uncovered
from quadrl.core.environment import Environment
from quadrl.core.launch import kernels, make_device
from quadrl.core.saving import Memory
from quadrl.core.scenario import Scenario
from quadrl.core.source import Precision, text
from quadrl.core.transition import Observation

MARKS = ("action", "reward", "start")
"""What may be no number, in the order of `marks` in native/kernel.h."""
FEWEST, MOST = 16_384, 65_536
"""Aircraft and starts that are drawn on the processor, where a start is more than arithmetic."""
MAX_AIRCRAFT = 1 << 30
HINT = "allowed: device 'cpu', or engine 'mujoco', which simulates on the CPU"


@dataclasses.dataclass(frozen=True, eq=False)
class Slot:
    """What a control step of N aircraft takes and gives, views of a batch's tensors."""

    action: Tensor  # (N, k), taken
    observation: Tensor  # (N, size), of the present moment
    final: Tensor  # (N, size), of the moment before rows began anew
    privileged: Tensor  # (N, p), of the present moment, for the critic alone
    final_privileged: Tensor  # (N, p), of the moment before rows began anew
    reward: Tensor  # (N,)
    error: Tensor  # (N,) [m]
    terms: Tensor  # (terms, N), of the reward
    over: Tensor  # (N,) bool: terminated or truncated
    terminated: Tensor  # (N,) bool
    truncated: Tensor  # (N,) bool
    success: Tensor  # (N,) bool
    diverged: Tensor  # (N,) bool
    ends: Tensor  # (ends, N) bool


class Batch:
    """N aircraft of a scenario, which begin anew in the step that ends their episode.

    Row i is the episode of seed s + i, as in `Environment`. A batch has one slot, which each step
    fills again, or several, for the steps of a rollout; the last has the present observation.
    """

    def __init__(
        self,
        scenario: Scenario,
        num_envs: int,
        seed: Seed = None,
        device: str | torch.device = "cuda",
        precision: Precision = "float32",
        slots: int = 1,
    ) -> None:
        """Compile the step, and make the tensors.

        Args:
            scenario: What is flown and how.
            num_envs: N.
            seed: As `Environment.seed` takes it.
            device: A GPU; or a CPU, for comparisons.
            precision: Of all that is computed.
            slots: For how many steps results are kept.

        Raises:
            QuadrlError: The device cannot be used, has too little memory, or does not fly that;
                nothing was allocated then.
        """
        validation.number("num_envs", num_envs, 1, MAX_AIRCRAFT, whole=True)
        self.scenario, self.num_envs, self.precision = scenario, num_envs, precision
        self.device = make_device(device)
        if scenario.engine != "free_flight":
            allowed = "'free_flight', the only one of a batch"
            raise QuadrlError(name="engine", value=scenario.engine, allowed=allowed)
        refused = f"device = {str(device)!r}"
        self.environment = Environment(scenario, num_envs=1, seed=0)
        """One of them on the CPU, for what is the same for all."""
        if why := uncovered(self.environment):
            raise QuadrlError(f"{refused}: free flight on a GPU has no {why}; {HINT}")
        self.environment.reset()
        if why := self.environment.not_compiled:
            raise QuadrlError(f"{refused}: the step is not compiled: {why}; {HINT}")
        seed = _chosen(seed)
        begun = self._drawn(seed) if Layout(self.environment).pooled else None
        try:
            whole = text(begun[0] if begun else self.environment, precision)
        except NotCompilable as error:
            raise QuadrlError(f"{refused}: the task is not compiled: {error}; {HINT}") from error
        self.layout = layout = Layout(begun[0] if begun else self.environment)
        self._run = kernels(whole, precision, self.device)
        dtype, actions = getattr(torch, precision), self.environment.action_size
        pool = layout.pool(*begun) if begun else np.zeros((1, 1))
        numbers = num_envs * (layout.rows + slots * (layout.out + actions)) + pool.size
        self._check_memory(numbers * dtype.itemsize + num_envs * (slots * layout.flags + 16))
        given: Any = {"dtype": dtype, "device": self.device}
        self.table = torch.zeros(layout.rows, num_envs, **given)
        self.action = torch.zeros(slots, num_envs, actions, **given)
        self.out = torch.zeros(slots, layout.out, num_envs, **given)
        self.flags = torch.zeros(
            slots, layout.flags, num_envs, dtype=torch.bool, device=self.device
        )
        """All of the slots, (slots, ..., N)."""
        self.keys, self.episodes = torch.zeros(2, num_envs, dtype=torch.int64, device=self.device)
        # A GPU writes into the memory of the processor, which reads it without waiting for it.
        on_gpu = self.device.type == "cuda"
        self._marks = torch.zeros(len(MARKS), dtype=torch.int32, pin_memory=on_gpu)
        self.slots = [
            self.slot(*parts) for parts in zip(self.action, self.out, self.flags, strict=True)
        ]
        self._columns = torch.as_tensor(pool).to(**given)
        """Columns with which episodes begin, where they do not begin on the device."""
        structs = [
            (self.table, self._columns, out, action, self.keys, self.episodes, flags, self._marks)
            for action, out, flags in zip(self.action, self.out, self.flags, strict=True)
        ]
        sizes = num_envs, self._columns.shape[1]
        addresses = [[*(tensor.data_ptr() for tensor in own), *sizes] for own in structs]
        self._structs = torch.tensor(addresses, dtype=torch.int64).to(self.device)
        """A `Batch` of native/kernel.h for each slot."""
        self._place(seed)

    def _drawn(self, seed: Seed) -> tuple[Environment, Observation]:
        """Environments whose episodes have just begun, and their first observations.

        Raises:
            QuadrlError: There is a seed for each row.
        """
        if not isinstance(seed, int):
            allowed = "one number where episodes begin with what a processor has drawn"
            raise QuadrlError(name="seed", value=seed, allowed=allowed)
        count = min(max(self.num_envs, FEWEST), MOST)
        made = Environment(self.scenario, num_envs=count, seed=seed)
        return made, made.reset()

    def slot(self, action: Tensor, out: Tensor, flags: Tensor) -> Slot:
        """Tensors as a slot: actions (N, k), what a step gives (rows, N) and flags (flags, N)."""
        seen, reward, own = self.layout.seen, self.layout.reward, self.layout.observed
        first = out[:own].T, out[seen : seen + own].T, out[own:seen].T, out[seen + own : reward].T
        named = *first, out[reward], out[reward + 1], out[reward + 2 :], *flags[:5], flags[5:]
        return Slot(*cast(Any, (action, *named)))

    def _check_memory(self, size: int) -> None:
        if self.device.type == "cuda":
            free, _ = torch.cuda.mem_get_info(self.device)
            if size > free:
                reason = f"num_envs = {self.num_envs} would take {size / GIB:.1f} GiB of the GPU"
                raise QuadrlError(f"{reason}, and {free / GIB:.1f} are free: ask for fewer")

    def seed(self, seed: Seed = None) -> None:
        """Let the next reset begin the first episode of a seed, as `Environment.seed` does."""
        seed = _chosen(seed)
        if self.layout.pooled:
            self._columns.copy_(torch.as_tensor(self.layout.pool(*self._drawn(seed))))
        self._place(seed)

    def _place(self, seed: Seed) -> None:
        rows, own = seeds_of_rows(seed, np.arange(self.num_envs), self.num_envs)
        keys, episodes = self.keys.cpu(), self.episodes.cpu()
        keys[rows], episodes[rows] = torch.as_tensor(np.asarray(own)), 0
        self.keys.copy_(keys)
        self.episodes.copy_(episodes)

    def reset(self, chosen: Tensor | None = None, slot: int = -1) -> Tensor:
        """Begin an episode of the aircraft of a mask (N,), or of all; return the observation.

        Args:
            chosen: The mask.
            slot: The slot that has the present observation.
        """
        mask = 0
        if chosen is not None:
            self._chosen = chosen.reshape(self.num_envs).to(self.device, torch.bool).contiguous()
            mask = self._chosen.data_ptr()
        self._run["start"](self.num_envs, self._address(slot), mask)
        return self.slots[slot].observation

    def _address(self, slot: int) -> int:
        return self._structs[slot].data_ptr()

    def take(self, action: Tensor, slot: int = 0) -> None:
        """Write actions (N, k) into a slot.

        Raises:
            QuadrlError: They are of another shape, or on another device.
        """
        taken = self.action[slot]
        if action.shape != taken.shape or str(action.device) != str(taken.device):
            allowed = f"{tuple(taken.shape)} on {taken.device}"
            value = f"{tuple(action.shape)} on {action.device}"
            raise QuadrlError(name="action", value=value, allowed=allowed)
        taken.copy_(action.detach())

    def step(self, slot: int = 0) -> Slot:
        """Fly a control step with the actions of a slot; return the slot.

        What was no number in an earlier step is told now, since nobody waits for the device.

        Raises:
            QuadrlError: Such an action, a reward or a start.
        """
        self.check()
        self.fly(slot)
        return self.slots[slot]

    def fly(self, slot: int) -> None:
        """Fly a control step with the actions of a slot; `check` tells what went wrong."""
        self._run["step"](self.num_envs, self._address(slot))

    def check(self) -> None:
        """Tell what was no number in the steps that the device has done.

        Raises:
            QuadrlError: The message names the first kind, and an aircraft.
        """
        marks: list[int] = cast(Any, self._marks).tolist()
        for what, row in zip(MARKS, marks, strict=True):
            if row:
                self._marks.zero_()
                allowed = f"finite; that of aircraft {row - 1} was not, in one of the last steps"
                raise QuadrlError(name=what, value="no number", allowed=allowed)

    def save(self) -> dict[str, np.ndarray]:
        """Return all that the next steps depend on, as arrays: `restore` continues bit for bit."""
        return {name: tensor.cpu().numpy() for name, tensor in self._kept.items()}

    @property
    def _kept(self) -> dict[str, Tensor]:
        own = {name: getattr(self, name) for name in ("table", "keys", "episodes")}
        return own | {"observed": self.out[-1, : self.layout.seen]}

    def restore(self, saved: dict[str, np.ndarray]) -> Tensor:
        """Restore what `save` returned; return the observation of that moment.

        Raises:
            QuadrlError: It is of another batch.
        """
        own = self.save()
        for name, array in own.items():
            given = saved.get(name)
            if given is None or (given.shape, given.dtype) != (array.shape, array.dtype):
                allowed = f"{array.dtype} {array.shape}"
                raise QuadrlError(name=name, value=getattr(given, "shape", None), allowed=allowed)
        for name, tensor in self._kept.items():
            tensor.copy_(torch.as_tensor(np.array(saved[name])))
        return self.slots[-1].observation

    def row(self, row: int) -> dict[str, np.ndarray]:
        """The state of an aircraft as one that an `Environment` of the scenario restores.

        Raises:
            QuadrlError: Its episode began with what was drawn for others.
        """
        if self.layout.pooled:
            raise QuadrlError("episodes that begin with what a processor has drawn cannot be saved")
        environment, layout = self.environment, self.layout
        column = self.table[:, row].double().cpu().numpy()[:, None]
        seeds = environment.seeds
        seeds.keys[0], seeds.episodes[0] = int(self.keys[row]), int(self.episodes[row])
        engine, motion = environment.engine, column[: layout.motion, 0]
        engine.clear(np.zeros(1, int))
        engine.qpos[0], engine.qvel[0], engine.act[0] = motion[:7], motion[7:13], motion[13:]
        now, episode = layout.program.records(column[layout.motion :])
        now.time = episode.steps * environment.vehicle.control_timestep  # in double precision
        own = environment.memory()
        memory: Memory = dataclasses.replace(own, snapshot=now, episode=episode)
        return memory.save()


def _chosen(seed: Seed) -> Seed:
    """A seed, one from the system where there is none."""
    return int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
