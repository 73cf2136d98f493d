"""Gymnasium: one aircraft, or a native vector of many.

The observation is the flat float32 vector of the task's terms (`environment.layout` has the slice
of each name); the action is Box(-1, 1, (k,)), and `control_mode` says what it means. The `info` of
a step holds `reward_terms`, `is_success`, `error` [m] and `diverged`. A new -vN is for new numbers.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from quadrl import validation
from quadrl.environment import Transition
from quadrl.envs.common import Pictures, make
from quadrl.errors import QuadrlError
from quadrl.task import Task

Array = np.ndarray
Info = dict[str, Any]


class _Shared:
    """What the single environment and the vector share."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}

    def _make(
        self,
        task: str | Task,
        num_envs: int,
        *,
        reward_terms: bool = True,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        camera: str = "track",
        **settings: Any,
    ) -> tuple[gym.spaces.Box, gym.spaces.Box]:
        """Make the environment; returns the spaces of one aircraft."""
        if render_mode is not None:
            validation.choice("render_mode", render_mode, self.metadata["render_modes"])
        environment = self.environment = make(task, num_envs, **settings)
        self._pictures = Pictures(environment, camera, width, height)
        self.render_mode, self._terms_wanted = render_mode, reward_terms
        fps = round(1 / environment.vehicle.control_timestep)
        self.metadata = self.metadata | {"render_fps": fps}
        return (
            gym.spaces.Box(-np.inf, np.inf, (environment.size,), np.float32),
            gym.spaces.Box(-1.0, 1.0, (environment.action_size,), np.float32),
        )

    def _values(self, now: Transition) -> Info:
        """What the info of a step tells, arrays (N,)."""
        values: Info = {"is_success": now.is_success, "error": now.error, "diverged": now.diverged}
        return values | {"reward_terms": now.reward_terms} if self._terms_wanted else values


class QuadrotorEnv(_Shared, gym.Env):
    """One aircraft: `gym.make("quadrl/Hover-v0")`.

    `gym.make` keeps its argument `max_episode_steps` for a TimeLimit wrapper that knows nothing of
    success: give the task's option `time_limit` [s] instead.
    """

    def __init__(self, task: str | Task = "hover", **settings: Any) -> None:
        """Make the environment.

        Args:
            task: A name of the catalogue or a task.
            **settings: Those of `quadrl.envs.common.make`; `reward_terms` (whether `info` holds
                them); `render_mode` (None or "rgb_array"), `width`, `height` [pixels] and `camera`
                (a name of `quadrl.rendering`) of a picture.
        """
        settings = {"num_threads": 1} | settings
        self.observation_space, self.action_space = self._make(task, 1, **settings)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Array, Info]:
        """Begin an episode; a seed starts the sequence of episodes anew."""
        if seed is not None:
            self.environment.seed(seed)
        super().reset(seed=seed)
        return self.environment.flatten(self.environment.reset())[0], {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, Info]:
        """Fly one control step; an action (k,) that is not finite raises a QuadrlError."""
        # An array needs no copy for its leading axis; anything else is the environment's to judge.
        now = self.environment.step(action[None] if isinstance(action, np.ndarray) else (action,))
        observation = self.environment.flatten(now.observation)[0]
        info = _of_one(self._values(now))
        return observation, now.reward.item(), now.terminated.item(), now.truncated.item(), info

    def render(self) -> Array | None:
        """The current picture (height, width, 3) uint8, or None without a render mode."""
        return None if self.render_mode is None else self._pictures.frame()

    def close(self) -> None:
        """Free the renderer."""
        self._pictures.close()


class QuadrotorVectorEnv(_Shared, VectorEnv):
    """Many aircraft on all cores: `gym.make_vec("quadrl/Hover-v0", num_envs=1024)`.

    Autoreset follows Gymnasium's SyncVectorEnv. NEXT_STEP (default): the step after an end ignores
    the row's action, resets the row and gives it reward 0. SAME_STEP: `info["final_obs"]` and
    `info["final_info"]` hold the end's own observation and info. DISABLED: reset with
    `options={"reset_mask": mask}`. `info["_name"]` masks the rows that `info["name"]` holds for.
    TorchRL's GymWrapper takes DISABLED, and SAME_STEP with `reward_terms=False`: it cannot read an
    info within an info.
    """

    def __init__(
        self,
        task: str | Task = "hover",
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **settings: Any,
    ) -> None:
        """Make N environments; `autoreset_mode` may be a name, settings are those above."""
        modes = {mode.value: mode for mode in AutoresetMode} | dict(AutoresetMode.__members__)
        if not isinstance(autoreset_mode, AutoresetMode):
            autoreset_mode = modes[validation.choice("autoreset_mode", autoreset_mode, modes)]
        single = self._make(task, num_envs, **settings)
        self.num_envs, self.autoreset_mode = num_envs, autoreset_mode
        self.metadata = self.metadata | {"autoreset_mode": autoreset_mode}
        self.single_observation_space, self.single_action_space = single
        self.observation_space, self.action_space = (batch_space(s, num_envs) for s in single)
        self._observation = np.zeros((num_envs, self.environment.size), np.float32)
        self._resting = np.zeros(num_envs, dtype=bool)  # NEXT_STEP: reset at the next step

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Array, Info]:
        """Begin episodes in the rows of `options["reset_mask"]` (N,) bool, by default in all.

        Row i is seeded with seed + i.
        """
        rows = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if rows.dtype != bool or rows.shape != (self.num_envs,) or not rows.any():
            allowed = f"an array of {self.num_envs} bool, at least one of them True"
            raise QuadrlError(name="reset_mask", value=rows, allowed=allowed)
        if seed is not None:
            self.environment.seed(seed, rows)
        self._begin(rows)
        return self._observation.copy(), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Info]:
        """Fly one control step in every row; actions (N, k)."""
        now, mode = self.environment.step(actions), self.autoreset_mode
        self._observation = self.environment.flatten(now.observation)
        resting, flown = self._resting, ~self._resting
        reward = np.where(flown, now.reward, 0.0)
        terminated, truncated = now.terminated & flown, now.truncated & flown
        ended, values = terminated | truncated, self._values(now)
        if mode == AutoresetMode.SAME_STEP and ended.any():
            final = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(ended):
                final[i] = self._observation[i].copy()
            info = _masked(values, ~ended) | {"final_obs": final, "_final_obs": ended}
            info |= {"final_info": _masked(values, ended), "_final_info": ended.copy()}
            self._begin(ended)
        else:
            info = _masked(values, flown)
            if resting.any():
                self._begin(resting)
            self._resting = ended & (mode == AutoresetMode.NEXT_STEP)
        return self._observation.copy(), reward, terminated, truncated, info

    def _begin(self, rows: Array) -> None:
        """Begin an episode in some rows (N,) bool."""
        self._observation[rows] = self.environment.flatten(self.environment.reset(rows))
        self._resting = self._resting & ~rows

    def render(self) -> tuple[Array, ...] | None:
        """A picture (height, width, 3) uint8 of each aircraft, or None without a render mode."""
        rows = range(self.num_envs)
        return None if self.render_mode is None else tuple(map(self._pictures.frame, rows))

    def close_extras(self, **_: Any) -> None:
        """Free the renderer."""
        self._pictures.close()


def _of_one(values: Info) -> Info:
    """The values of the only row, as Python's own numbers."""
    return {k: _of_one(v) if isinstance(v, dict) else v.item() for k, v in values.items()}


def _masked(values: Info, rows: Array) -> Info:
    """Arrays (N,), 0 outside of `rows` (N,) bool, and a mask per name."""
    info: Info = {f"_{name}": rows.copy() for name in values}
    for name, value in values.items():
        nested = isinstance(value, dict)
        info[name] = _masked(value, rows) if nested else np.where(rows, value, np.zeros_like(value))
    return info
