"""Evaluations along a training: what the mean action reaches, and which policy is the best so far.

They fly in the engine of the training, in episodes that neither trainings nor `quadrl.evaluate`
fly, so that an evaluation of the policy that they choose is one in fresh episodes. In a short
training most of their time would go into calls from Python; so several policies fly at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadrl.base.files import write_csv
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.evaluation.in_flight import Controller
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.policy_file import CLIP, arrays_of, parts_of
from quadrl.evaluation.rollout import final_error
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import EVALUATIONS, FIGURES, read_rows

SEED = 1 << 52
"""Of the episodes: beyond the seeds of every training, and below those of `quadrl.evaluate`."""
EPISODES = 10, 50
"""Fewest and most of an evaluation."""
SHARE = 1 / 8
"""Of the control steps of a training, that its evaluations fly together; with the fewest more."""
APART = 1000
"""Control steps of a training, of all aircraft, for each of a flight: flights take 2 % of the time
of PPO's shortest trainings then."""
HEAD = ("steps", "seconds", "episodes", *FIGURES)


class Kept(NamedTuple):
    """The policy that is kept, and what it reached."""

    steps: int
    policy: Policy
    success: float
    error: float  # [m]


class Evaluations:
    """The evaluations of a training, evenly over its iterations."""

    best: Kept | None = None
    """The one with the highest success, then the lowest error, then the latest."""

    on_row: Callable[[int, dict[str, float]], None]
    """Called with the iteration and the metrics of each evaluation."""

    def __init__(self, config: TrainConfig, folder: Path) -> None:
        """Make the environment of the evaluations of a training, whose rows go into its folder."""
        many, batch = config.evaluations, config.num_envs * config.rollout
        times = range(1, many + 1)
        self.due = {max(1, round(time * config.iterations / many)) for time in times}
        """The iterations after which there is one."""
        scenario = Scenario.of(config.scenario, engine=config.base.engine)
        limit = round(scenario.task.time_limit / scenario.vehicle.control_timestep)
        trained = config.iterations * batch
        self._count = int(np.clip(SHARE * trained / (many * limit), *EPISODES))
        together = 1 if config.until else -(-APART * limit * many // trained)
        self._together, self._until = min(together, len(self.due)), config.until
        self._file = folder / EVALUATIONS
        self._waiting: list[tuple[int, int, float, Policy]] = []
        self._rows: list[Any] = []
        rows, seeds = self._together * self._count, self._together * [*range(self._count)]
        self._seeds = [SEED + k for k in seeds]
        self._environment = Environment(scenario, num_envs=rows, num_threads=config.num_threads)
        self._environment.reset(seed=self._seeds)  # compiled here, and not in the training

    def begin(self, steps: int) -> None:
        """Go on after `steps` control steps: rows of later ones are made again."""
        self._rows = [row for row in read_rows(self._file, HEAD) if int(row[0]) <= steps]

    def add(self, iteration: int, steps: int, seconds: float, policy: Policy) -> None:
        """Evaluate the policy after an iteration, now or together with later ones."""
        self._waiting.append((iteration, steps, round(seconds, 3), policy))
        if len(self._waiting) == self._together:
            self.fly()

    @property
    def reached(self) -> bool:
        """Whether the last one reaches the figures that end the training early."""
        last = dict(zip(HEAD, map(float, self._rows[-1]), strict=True)) if self._rows else {}
        return bool(last and self._until) and all(
            last[name] <= asked if name == "error" else last[name] >= asked
            for name, asked in self._until.items()
        )

    def fly(self) -> None:
        """Fly the policies that wait, and write their rows."""
        if not self._waiting:
            return
        waiting, self._waiting = self._waiting, []
        flown = [policy for *_, policy in waiting]
        flown += (self._together - len(flown)) * flown[-1:]
        found = _means(self._environment, self._seeds, _beside(flown, self._count), len(flown))
        for (iteration, steps, seconds, policy), row in zip(waiting, found.tolist(), strict=False):
            self._rows.append([steps, seconds, self._count, *row])
            self.on_row(iteration, dict(zip(FIGURES.values(), row, strict=True)))
            success, _, error, _ = row
            kept = Kept(steps, policy, success, error)
            if self.best is None or _worth(kept) >= _worth(self.best):
                self.best = kept
        write_csv(self._file, HEAD, self._rows)

    def save(self) -> tuple[dict[str, np.ndarray], list[Any]]:
        """Return the arrays and the numbers of the best policy; nothing where there is none."""
        if (best := self.best) is None:
            return {}, []
        numbers = [best.steps, best.success, best.error, len(best.policy.weights)]
        return arrays_of(best.policy), numbers

    def restore(self, arrays: dict[str, np.ndarray], numbers: list[Any], task: str) -> None:
        """Restore what `save` returned in a training of a task."""
        steps, success, error, layers = numbers
        self.best = Kept(steps, Policy(**parts_of(arrays, layers), task=task), success, error)


def _worth(one: Kept) -> tuple[float, float]:
    return one.success, -one.error


def _means(
    environment: Environment, seeds: Sequence[int], controller: Controller, parts: int
) -> np.ndarray:
    """Fly an episode of each aircraft; FIGURES (parts, 4) of as many equal parts of them."""
    observation, count = environment.flatten(environment.reset(seed=seeds)), len(seeds)
    alive, gained, length = np.ones(count, bool), np.zeros(count), np.zeros(count, int)
    success, survived = np.zeros(count, bool), np.ones(count, bool)
    errors: list[np.ndarray] = []
    while alive.any():
        now = environment.step(controller(observation))
        observation = environment.flatten(now.observation)
        errors.append(now.error)
        gained += np.where(alive, now.reward, 0.0)
        length += alive
        success |= alive & now.is_success
        survived &= ~(alive & now.terminated & ~now.is_success)
        alive &= ~(now.terminated | now.truncated)
    error = final_error(np.array(errors), length, environment.vehicle.control_timestep)
    figures = np.array([success, survived, error, gained], dtype=float)
    return figures.reshape(len(FIGURES), parts, -1).mean(-1).T


def _beside(policies: Sequence[Policy], count: int) -> Controller:
    """Several policies alike, each for `count` aircraft, as one function of all observations."""
    if policies[0].memory:
        flying = [policy.flying(count) for policy in policies]
        for one in flying:
            one.reset()
        return lambda seen: np.concatenate(
            [one(part) for one, part in zip(flying, np.split(seen, len(flying)), strict=True)]
        )
    mean, deviation = (np.stack([getattr(p, k) for p in policies])[:, None]
                       for k in ("mean", "deviation"))  # fmt: skip
    layers = [
        tuple(np.stack(arrays) for arrays in zip(*layer, strict=True))
        for layer in zip(*(policy.mean_layers for policy in policies), strict=True)
    ]
    shape = len(policies), count, policies[0].size

    def act(seen: np.ndarray) -> np.ndarray:
        values = np.clip((seen.reshape(shape) - mean) / deviation, -CLIP, CLIP)
        for weight, bias in layers[:-1]:
            values = np.tanh(values @ weight.swapaxes(1, 2) + bias[:, None])
        weight, bias = layers[-1]
        values = values @ weight.swapaxes(1, 2) + bias[:, None]
        return np.clip(values, -1.0, 1.0).reshape(len(seen), -1)

    return act
