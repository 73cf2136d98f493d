"""The environments of a training, the memory of a recurrent policy, and the collector."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Unbounded
from torchrl.modules import ProbabilisticActor

from quadrl.aircraft.aerodynamics import ROTOR_EFFECTS
from quadrl.base.errors import QuadrlWarning
from quadrl.core.transition import Transition
from quadrl.engines.adjoint import kernel
from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.learning.config import TrainConfig
from quadrl.learning.fused import BehaviourPolicy
from quadrl.learning.networks import STATE
from quadrl.learning.teacher import Teacher
from quadrl.learning.window import Moment, fly

with warnings.catch_warnings():
    # TorchRL 0.14 warns about its own classes at this import.
    warnings.filterwarnings("ignore", message=".*WeightUpdater.*", category=DeprecationWarning)
    from torchrl.collectors import Collector

SEED_STRIDE = 1 << 20
"""Distance between the seeds of two trainings: as many as there can be aircraft in one."""


class TrainingEnv(QuadrotorEnv):
    """Environments that keep what their steps say of episodes, for the log."""

    def __init__(self, *given: Any, **settings: Any) -> None:
        """Make the environments."""
        super().__init__(*given, **settings)
        self._told: list[tuple[Transition, np.ndarray]] = []
        self.teacher: Teacher | None = None
        """Who says before each step what it would do."""
        self._taught: list[np.ndarray] = []

    def save(self) -> dict[str, np.ndarray]:
        """All that the next steps depend on, for `restore`."""
        return self.environment.save()

    def told(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the T steps since the last call say of N aircraft.

        Returns:
            Reward terms (T, terms, N), ends (T, ends, N), and the number of the task that is flown,
            (N, T), 0 where there is one.
        """
        told, self._told = self._told, []
        terms = [[*now.reward_terms.values()] for now, _ in told]
        ends = [[*now.ended.values()] for now, _ in told]
        which = np.array([of for _, of in told], dtype=int)
        return np.array(terms), np.array(ends), which.reshape(-1, self.num_envs).T

    def taught(self) -> np.ndarray:
        """What the teacher would have done in the steps since the last call, (T, N, k)."""
        taught, self._taught = self._taught, []
        return np.array(taught)

    def _fly(self, action: torch.Tensor) -> Transition:
        if self.teacher:
            self._taught.append(self.teacher.action())
        return self._tell(super()._fly(action))

    def _tell(self, now: Transition) -> Transition:
        flown = self.environment.snapshot.task
        which = getattr(flown, "which", np.zeros(self.num_envs))
        self._told.append((now, which.astype(int)))
        return now


class RememberingEnv(TrainingEnv):
    """Environments with the states (N, width) of a recurrent policy; they are zero at a reset."""

    def __init__(self, width: int, *given: Any, **settings: Any) -> None:
        """Make the environments and states of a width."""
        super().__init__(*given, **settings)
        self._state = torch.zeros(self.num_envs, width, device=self.device)
        observation = self.observation_spec.clone()
        observation[STATE] = Unbounded(self._state.shape, device=self.device)
        self.observation_spec = observation

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """Restore what `environment.save` returned, and the states beside it."""
        super().restore({name: value for name, value in saved.items() if name != STATE})
        self._state = torch.from_numpy(saved[STATE]).to(self.device).reshape(self._state.shape)

    def _reset(self, tensordict: TensorDictBase | None = None, **given: Any) -> TensorDictBase:
        fresh = super()._reset(tensordict, **given)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or mask.all():  # otherwise the states of the others stay: see maybe_reset
            fresh.set(STATE, self._state if self._restored else torch.zeros_like(self._state))
        return fresh


class RecordingEnv(TrainingEnv):
    """Environments that record their steps, for the derivatives."""

    def __init__(self, *given: Any, **settings: Any) -> None:
        """Make the environments, and compile the reverse of their dynamics if it is missing."""
        super().__init__(*given, **settings)
        vehicle = self.environment.vehicle
        kernel(min(vehicle.aerodynamics.effects, ROTOR_EFFECTS), vehicle.rotor_count)
        if pilot := self.environment.autopilot:
            pilot.reversed.compile()
        self._moments: list[Moment] = []

    def taken(self) -> list[Moment]:
        """Return the steps since the last call."""
        moments, self._moments = self._moments, []
        return moments

    def _fly(self, action: torch.Tensor) -> Transition:
        moment, done = fly(self.environment, action.numpy())
        self._moments.append(moment)
        return self._tell(done)


ENDED = ("return", "length")
OUTCOMES = ("over", "success", "survival")


class EpisodeStatistics:
    """Return, length and reward terms of episodes that end; outcomes of those that must be over.

    Success, survival and the shares of the ends are those of the episodes that began between one
    and two time limits ago, all of which are over. The episodes that end in a batch are a biased
    sample: most of them have failed, or none where all began together and reach the time limit
    together.
    """

    def __init__(
        self,
        num_envs: int,
        time_limit_steps: int,
        rollout: int,
        terms: Sequence[str] = (),
        ends: Sequence[str] = (),
        device: torch.device | str = "cpu",
    ) -> None:
        """Begin with every aircraft at the start of an episode.

        Args:
            num_envs: Aircraft, N.
            time_limit_steps: Control steps after which an episode is over at the latest.
            rollout: Control steps of a batch.
            terms: Names of the terms of the reward.
            ends: Names of the ends of an episode.
            device: Where the batches are.
        """
        self._limit = time_limit_steps
        self._terms = [f"reward/{name}" for name in terms]
        self._ends = [f"end/{name}" for name in ends]
        whole: Any = {"dtype": torch.float64, "device": device}
        self._sums = torch.zeros(len(ENDED) + len(terms), num_envs, **whole)
        self.running: dict[str, torch.Tensor] = {"terms": self._sums[len(ENDED) :]}
        self.running |= zip(ENDED, self._sums, strict=False)
        ages = 2 * time_limit_steps + rollout
        self.running["outcomes"] = torch.zeros(ages, len(OUTCOMES) + len(ends), **whole)
        """Numbers of the `OUTCOMES` and ends of episodes, by the steps since they began."""

    @property
    def columns(self) -> list[str]:
        """Names of the metrics of terms and ends."""
        return [*self._terms, *self._ends]

    @torch.no_grad()
    def count(
        self, batch: Mapping[str, torch.Tensor], terms: torch.Tensor, ends: torch.Tensor
    ) -> dict[str, float]:
        """Include a batch, and return its metrics.

        Args:
            batch: reward, done, terminated, is_success and error (T, N).
            terms: The terms of its rewards, (T, terms, N).
            ends: How its episodes ended, (T, ends, N) bool.
        """
        names = ("reward", "done", "terminated", "is_success", "error")
        reward, done, terminated, success, error = (batch[name] for name in names)
        steps, outcomes = len(reward), self.running["outcomes"]
        last, aircraft = done.nonzero(as_tuple=True)  # of each episode that ends, in time's order
        times = torch.arange(steps, device=done.device)[:, None]
        begun = torch.where(done, times, -1).cummax(0).values  # the last end so far, -1 for none
        before = begun.roll(1, 0)
        before[0] = -1
        before, remained = before[last, aircraft], begun[-1]

        # Sums over the episodes that end; those of the others go on.
        values = torch.cat([torch.stack([reward, torch.ones_like(reward)]), terms.movedim(1, 0)])
        total, each = values.double().cumsum(1), torch.arange(done.shape[1], device=done.device)
        carried = torch.where(before < 0, self._sums[:, aircraft], -total[:, before, aircraft])
        ended = total[:, last, aircraft] + carried
        going = torch.where(remained < 0, self._sums, -total[:, remained, each])
        self._sums.copy_(total[:, -1] + going)
        outcomes[steps:], outcomes[:steps] = outcomes[:-steps].clone(), 0.0
        judged = torch.stack([done, success, ~terminated | success], -1)
        judged = torch.cat([judged, ends.movedim(1, -1)], -1)[last, aircraft]
        ages = ended[1].long() + steps - 1 - last
        outcomes.index_put_((ages,), judged.double(), accumulate=True)
        own = [reward.double().mean(), error.double().mean(), *ended.mean(1)]
        over = outcomes[self._limit :].sum(0)
        gained, missed, *kept = torch.cat([torch.stack(own), over]).tolist()
        metrics = {"episodes": float(len(last)), "reward": gained, "error": missed}
        if len(last):
            metrics |= dict(zip((*ENDED, *self._terms), kept, strict=False))
        over, *shares = kept[len(ENDED) + len(self._terms) :]
        if over:
            names = (*OUTCOMES[1:], *self._ends)
            metrics |= {k: share / over for k, share in zip(names, shares, strict=True)}
        return metrics


def make_env(config: TrainConfig, device: torch.device) -> TrainingEnv:
    """Make the environments of a training."""
    scenario = config.training_scenario
    if config.algo == "apg" and (late := scenario.vehicle.dead_time):
        said = f"apg trains without the dead time of the aircraft, {late:g} s, which has no"
        warnings.warn(f"{said} derivatives; evaluations fly with it", QuadrlWarning, stacklevel=2)
        prompt = dataclasses.replace(scenario.vehicle, dead_time=0.0)
        scenario = dataclasses.replace(scenario, vehicle=prompt)
    given: Any = scenario, config.num_envs, config.seed * SEED_STRIDE, device
    if config.algo == "apg":
        return RecordingEnv(*given, num_threads=config.num_threads)
    env = (
        TrainingEnv(*given, num_threads=config.num_threads)
        if config.memory == "none"
        else RememberingEnv(config.memory_width, *given, num_threads=config.num_threads)
    )
    env.teacher = Teacher(env.environment) if config.algo == "dagger" else None
    return env


def make_collector(env: QuadrotorEnv, actor: ProbabilisticActor, frames: int) -> Collector:
    """Make TorchRL's collector of `frames` steps a batch, without what a training does not use."""
    policy: Any = actor.module[0]
    return Collector(
        env,
        actor if policy.plain is None else BehaviourPolicy(policy.plain),
        frames_per_batch=frames,
        total_frames=-1,
        device=env.device,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
        use_buffers=False,
        trust_policy=True,
    )
