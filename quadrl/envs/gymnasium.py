"""Gymnasium: one aircraft, or a native vector of many.

The observation is the flat float32 vector of the task's terms (`environment.layout` has the slice
of each name); the action is Box(-1, 1, (k,)), and `control_mode` says what it means. The `info` of
a step holds `reward_terms`, `is_success`, `error` [m] and `diverged`; with a randomization it and
that of a reset hold `drawn`, and `privileged` on request. A new -vN is for new numbers.
"""

# pyright: reportIncompatibleVariableOverride=false
# `spec` is a property here: Gymnasium sets it after the environment is made.

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import HumanRendering, TimeLimit

from quadrl.base import validation
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import Seed
from quadrl.core.environment import Environment, Transition
from quadrl.core.task import Task
from quadrl.envs.common import LAST, PICTURE, Changing, Named, episode_info, make
from quadrl.rendering.pictures import Pictures

Array = np.ndarray
Info = dict[str, Any]


class _Shared(Changing):
    """What the single environment and the vector share."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}
    environment: Environment
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """How `gym.make` made it, with the steps after which the task itself ends an episode."""
        if self._spec is not None:
            self._spec.max_episode_steps = self.environment.time_limit_steps
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec.additional_wrappers = () if isinstance(self, VectorEnv) else LAST
        self._spec = spec

    def change(self, **conditions: Any) -> None:
        """Change options before the next reset, as `quadrl.core.environment.Environment.change`."""
        super().change(**conditions)
        if self._spec is not None:
            self._spec.kwargs |= conditions

    def __getattr__(self, name: str) -> Any:
        """What is flown, by the names of its options."""
        own: Environment | None = vars(self).get("environment")
        for part in (own.task, own.scenario) if own else ():
            if name in (field.name for field in dataclasses.fields(part)):
                return getattr(part, name)
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def _make(
        self,
        task: str | Task,
        num_envs: int,
        *,
        reward_terms: bool = True,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        camera: str = "follow",
        **settings: Any,
    ) -> tuple[gym.spaces.Box, gym.spaces.Box]:
        """Make the environment; returns the spaces of one aircraft."""
        if render_mode is not None:
            validation.choice("render_mode", render_mode, self.metadata["render_modes"])
        also = ("render_mode", *PICTURE)
        environment = self.environment = make(task, num_envs, also, **settings)
        self._pictures = Pictures(environment, camera, width, height)
        self.render_mode, self._terms_wanted = render_mode, reward_terms
        fps = round(1 / environment.vehicle.control_timestep)
        self.metadata = self.metadata | {"render_fps": fps}
        return (
            gym.spaces.Box(-np.inf, np.inf, (environment.size,), np.float32),
            gym.spaces.Box(-1.0, 1.0, (environment.action_size,), np.float32),
        )

    def _values(self, now: Transition) -> Info:
        """Entries of the info of a step, arrays (N,)."""
        values: Info = {"is_success": now.is_success, "error": now.error, "diverged": now.diverged}
        if self._terms_wanted:
            values["reward_terms"] = Named(now.reward_terms)
        return values


class QuadrotorEnv(_Shared, gym.Env):
    """One aircraft: `gym.make("quadrl/Hover-v0")`.

    `spec.max_episode_steps` is the task's time limit in steps, and so is the argument
    `max_episode_steps` of `gym.make`.
    """

    in_window = False
    """Whether `gym.make` shows it in a window."""

    def __init__(self, task: str | Task = "hover", **settings: Any) -> None:
        """Make the environment.

        Args:
            task: A name of the catalogue or a task.
            **settings: Those of `quadrl.envs.common.make`; `reward_terms` (whether `info` holds
                them); `render_mode` (None or "rgb_array"; `gym.make` takes "human" too), `width`,
                `height` [pixels] and `camera` (a name of `quadrl.rendering`) of a picture.
        """
        settings = {"num_threads": 1} | settings
        self.observation_space, self.action_space = self._make(task, 1, **settings)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Array, Info]:
        """Begin an episode; a seed starts the sequence of episodes anew.

        Options are arrays of the start, by names of `engines.state.Start`:
        {"position": (0, 0, 1)}.
        """
        begun = self.environment.reset(start=options, seed=seed)
        super().reset(seed=seed)
        observation = self.environment.flatten(begun)[0]
        info = episode_info(self.environment)
        return observation, {name: value[0] for name, value in info.items()}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, Info]:
        """Fly one control step; an action (k,) that is not finite raises a QuadrlError."""
        # An array needs no copy for its leading axis; anything else is the environment's to judge.
        now = self.environment.step(action[None] if isinstance(action, np.ndarray) else (action,))
        observation = self.environment.flatten(now.observation)[0]
        # Scalars of NumPy, which TorchRL reads; flags as arrays, which Gymnasium's vectors stack.
        values = (self._values(now) | episode_info(self.environment)).items()
        info = {k: np.array(v[0]) if v.dtype == bool else v[0] for k, v in values}
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
    TorchRL's GymWrapper takes DISABLED and SAME_STEP.
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

    def reset(self, *, seed: Seed = None, options: Info | None = None) -> tuple[Array, Info]:
        """Begin an episode in every row, or in those of `options["reset_mask"]`.

        Args:
            seed: Row i gets seed + i or, of a sequence, seed[i]; None there leaves a row its own.
            options: `reset_mask`, (N,) bool; and arrays (N, k) or (k,) of the start, as above.

        Returns:
            The observations of all rows (N, size) float32, and the info of the rows that began.
        """
        start = dict(options or {})
        rows = np.asarray(start.pop("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if rows.dtype != bool or rows.shape != (self.num_envs,) or not rows.any():
            allowed = f"an array of {self.num_envs} bool, at least one of them True"
            raise QuadrlError(name="reset_mask", value=rows, allowed=allowed)
        self._begin(rows, start, seed)
        return self._observation.copy(), _masked(episode_info(self.environment), rows)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, Info]:
        """Fly one control step in every row; actions (N, k)."""
        now, mode = self.environment.step(actions), self.autoreset_mode
        self._observation = self.environment.flatten(now.observation)
        resting, flown = self._resting, ~self._resting
        reward = np.where(flown, now.reward, 0.0)
        terminated, truncated = now.terminated & flown, now.truncated & flown
        ended, values = terminated | truncated, self._values(now)
        last = episode_info(self.environment)
        if mode == AutoresetMode.SAME_STEP and ended.any():
            final = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(ended):
                final[i] = self._observation[i].copy()
            info = _masked(values, ~ended) | {"final_obs": final, "_final_obs": ended}
            info |= {"final_info": _masked(values | last, ended), "_final_info": ended.copy()}
            self._begin(ended)
        else:
            info = _masked(values, flown)
            if resting.any():
                self._begin(resting)
            self._resting = ended & (mode == AutoresetMode.NEXT_STEP)
        if last:
            info |= _masked(episode_info(self.environment), np.ones(self.num_envs, dtype=bool))
        return self._observation.copy(), reward, terminated, truncated, info

    def _begin(self, rows: Array, start: Info | None = None, seed: Seed = None) -> None:
        """Begin an episode in some rows (N,) bool."""
        begun = self.environment.reset(rows, start, seed)
        self._observation[rows] = self.environment.flatten(begun)
        self._resting = self._resting & ~rows

    def render(self) -> tuple[Array, ...] | None:
        """A picture (height, width, 3) uint8 of each aircraft, or None without a render mode."""
        rows = range(self.num_envs)
        return None if self.render_mode is None else tuple(map(self._pictures.frame, rows))

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """As SyncVectorEnv: an attribute of each row's environment, called if it can be.

        The rows share their environment, so that all but `render` gives the same N times.

        Raises:
            QuadrlError: It is `reset`, `step` or `close`, which no row has of its own.
        """
        if name in ("reset", "step", "close"):
            raise QuadrlError(f"call {name} of the vector itself", name="name", value=name)
        spaces = ("observation_space", "action_space")
        value: Any = getattr(self, f"single_{name}" if name in spaces else name)
        value = value(*args, **kwargs) if callable(value) else value
        return value if name == "render" and value else (value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """As SyncVectorEnv: an attribute of each row's environment."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """As SyncVectorEnv, but the rows share it: one value, or the same N times."""
        each = values if isinstance(values, (list, tuple)) else [values] * self.num_envs
        if len(each) != self.num_envs or any(not np.array_equal(v, each[0]) for v in each):
            allowed = f"one value, or the same {self.num_envs} times"
            raise QuadrlError(name=name, value=values, allowed=allowed)
        setattr(self, name, each[0])

    def close_extras(self, **_: Any) -> None:
        """Free the renderer."""
        self._pictures.close()


def limited(env: gym.Env[Array, Array]) -> gym.Env[Array, Array]:
    """Take the steps of Gymnasium's TimeLimit for the task's time limit.

    The wrapper itself knows nothing of success, cannot make an episode longer, and calls a crash on
    the last step a time-out as well.
    """
    own: Any = env.unwrapped
    if isinstance(env, TimeLimit):
        # What its spec says, which wrappers below would note from before the change.
        own.change(max_episode_steps=env._max_episode_steps)
        env = env.env
    if own.in_window:
        own.spec.kwargs["render_mode"] = own.render_mode  # the wrapper's is noted beside it
        env = HumanRendering(env)
    return env


MODES = ["human", "rgb_array"]


def make_one(
    task: str | Task = "hover", render_mode: str | None = None, **settings: Any
) -> gym.Env[Array, Array]:
    """What `gym.make` calls: a QuadrotorEnv, in a window where the render mode is "human"."""
    if render_mode is not None:
        validation.choice("render_mode", render_mode, MODES)
    windowed = render_mode == "human"
    made = QuadrotorEnv(task, render_mode="rgb_array" if windowed else render_mode, **settings)
    made.in_window = windowed  # Gymnasium's wrapper for it goes around the others
    return made


# Gymnasium reads from it which wrapper a render mode needs.
make_one.metadata = QuadrotorEnv.metadata | {"render_modes": MODES}  # type: ignore[attr-defined]


def _masked(values: Info, rows: Array) -> Info:
    """Arrays (N,), 0 outside of `rows` (N,) bool, and a mask per name."""
    info: Info = {f"_{name}": rows.copy() for name in values}
    for name, value in values.items():
        info[name] = value.copy()
        info[name][~rows] = 0
    return info
