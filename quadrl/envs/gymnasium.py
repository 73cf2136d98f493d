"""Door two: Gymnasium, one aircraft or a native vector of them.

The observation is the flat float32 vector of the task's parts (`QuadrotorEnv.layout` says which
entry is what); the action is Box(-1, 1, (4,)). `info` carries `reward_terms`, `is_success`,
`error` [m] and `diverged`. A new version of an id (-vN) means that its numbers changed.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from quadrl import tasks
from quadrl.environment import Environment, Transition
from quadrl.task import Task
from quadrl.vehicle import ROTORS, Vehicle


def _task(task: str | Task, max_episode_steps: int | None, vehicle: Vehicle, **options: Any) -> Task:
    """The task with its options, its horizon as long as `max_episode_steps` control steps."""
    if max_episode_steps is not None:
        options["horizon"] = max_episode_steps * vehicle.control_step
    return tasks.make(task, **options)


def _spaces(size: int) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    return (
        gym.spaces.Box(-np.inf, np.inf, (size,), np.float32),
        gym.spaces.Box(-1.0, 1.0, (ROTORS,), np.float32),
    )


class QuadrotorEnv(gym.Env):
    """One aircraft. `gym.make("quadrl/Hover-v0")`."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(
        self,
        task: str | Task = "hover",
        *,
        render_mode: str | None = None,
        vehicle: Vehicle | None = None,
        max_episode_steps: int | None = None,
        width: int = 640,
        height: int = 480,
        camera: str = "track",
        **options: Any,
    ) -> None:
        """Make the environment.

        Args:
            task: A name of the catalogue or a task.
            render_mode: None or "rgb_array".
            vehicle: The aircraft; None for the paper's.
            max_episode_steps: Control steps of an episode; None for the task's horizon.
            width: Of a rendered frame [pixels].
            height: Of a rendered frame [pixels].
            camera: A camera of `quadrl.rendering`.
            **options: Fields of the task.

        Raises:
            ValueError: Unknown task, option or render mode.
        """
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode = {render_mode!r}: None or 'rgb_array' is allowed")
        vehicle = vehicle or Vehicle()
        self.environment = Environment(
            _task(task, max_episode_steps, vehicle, **options), vehicle=vehicle
        )
        self.observation_space, self.action_space = _spaces(self.environment.size)
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": round(1 / vehicle.control_step)}
        self._view = (width, height, camera)
        self._renderer: Any = None

    @property
    def layout(self) -> dict[str, slice]:
        """Where each named part stands in the observation."""
        return self.environment.layout

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; a seed starts the sequence of episodes anew."""
        super().reset(seed=seed)
        self.environment.generators = [self.np_random]
        return self.environment.flatten(self.environment.reset()), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Fly one control step.

        Raises:
            ActionError: Wrong shape, or a number that is not finite.
        """
        now = self.environment.step(action)
        return (
            self.environment.flatten(now.observation),
            float(now.reward),
            bool(now.terminated),
            bool(now.truncated),
            {
                "reward_terms": now.reward_terms,
                "is_success": bool(now.is_success),
                "error": float(now.error),
                "diverged": bool(now.diverged),
            },
        )

    def render(self) -> np.ndarray | None:
        """The current picture (height, width, 3) uint8, or None without a render mode.

        Raises:
            RenderingUnavailable: The machine has no EGL.
        """
        if self.render_mode is None:
            return None
        if self._renderer is None:
            from quadrl.rendering import Renderer

            width, height, self._camera = self._view
            model = self.environment.vehicle.compile(contact=self.environment.task.contact)
            self._renderer = Renderer(model, width=width, height=height)
        return self._renderer.frame(
            self.environment.simulation.qpos,
            camera=self._camera,
            markers=self.environment.markers(),
        )

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


class QuadrotorVectorEnv(VectorEnv):
    """Many aircraft on all cores. `gym.make_vec("quadrl/Hover-v0", num_envs=1024)`.

    Autoreset: NEXT_STEP (default; the step after an end ignores the action, resets, and gives
    reward 0), SAME_STEP (the end's own observation in `info["final_obs"]`), or DISABLED (reset with
    `options={"reset_mask": mask}`).
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        task: str | Task = "hover",
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        vehicle: Vehicle | None = None,
        max_episode_steps: int | None = None,
        num_threads: int = 0,
        **options: Any,
    ) -> None:
        """Make the environments; arguments as `QuadrotorEnv` and `Environment` have them."""
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        vehicle = vehicle or Vehicle()
        self.environment = Environment(
            _task(task, max_episode_steps, vehicle, **options),
            num_envs=num_envs,
            vehicle=vehicle,
            num_threads=num_threads,
        )
        self.num_envs = num_envs
        self.metadata = self.metadata | {"autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = _spaces(self.environment.size)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._over = np.zeros(num_envs, dtype=bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episodes, in all environments or in those of `options["reset_mask"]`.

        Environment i is seeded with seed + i.
        """
        if seed is not None:
            self.environment.seed(seed)
        mask = (options or {}).get("reset_mask")
        if mask is None:
            self._observation = self.environment.flatten(self.environment.reset())
            self._over[:] = False
            return self._observation.copy(), {}
        mask = np.asarray(mask)
        if mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"reset_mask must be bool of shape ({self.num_envs},), some of it True")
        self._reset_rows(mask)
        return self._observation.copy(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Fly one control step in every environment.

        Raises:
            ActionError: Wrong shape, or a number that is not finite.
        """
        resting = self._over if self.autoreset_mode == AutoresetMode.NEXT_STEP else None
        now = self.environment.step(actions)
        self._observation = self.environment.flatten(now.observation)
        info = _info(now)
        reward, terminated, truncated = now.reward, now.terminated, now.truncated
        if resting is not None and resting.any():
            self._reset_rows(resting.copy())
            reward = np.where(resting, 0.0, reward)
            terminated, truncated = terminated & ~resting, truncated & ~resting
            for name in ("is_success", "diverged"):
                info[name] = info[name] & ~resting
        self._over = terminated | truncated
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._over.any():
            over = self._over.copy()
            final, present = np.full(self.num_envs, None, dtype=object), over.copy()
            for i in np.flatnonzero(over):
                final[i] = self._observation[i].copy()
            ended = {k: v for k, v in info.items() if not k.startswith("_")}
            info |= {"final_obs": final, "_final_obs": present}
            info |= {"final_info": ended, "_final_info": present}
            self._reset_rows(over)
        return self._observation.copy(), reward, terminated, truncated, info

    def _reset_rows(self, mask: np.ndarray) -> None:
        self._observation[mask] = self.environment.flatten(self.environment.reset(mask))
        self._over[mask] = False


def _info(now: Transition) -> dict[str, Any]:
    """Gymnasium's vector convention: an array a name, and a mask of who has it."""
    everyone = np.ones(len(now.reward), dtype=bool)
    info = {
        "reward_terms": now.reward_terms | {f"_{name}": everyone for name in now.reward_terms},
        "is_success": now.is_success,
        "error": now.error.copy(),
        "diverged": now.diverged,
    }
    return info | {f"_{name}": everyone for name in info}


def register_ids() -> None:
    """Register every task of the catalogue as quadrl/<CamelCase>-v0 (idempotent)."""
    for name in tasks.TASKS:
        camel = "".join(word.capitalize() for word in name.split("_"))
        if (id := f"quadrl/{camel}-v0") not in gym.registry:
            gym.register(
                id=id,
                entry_point="quadrl.envs.gymnasium:QuadrotorEnv",
                vector_entry_point="quadrl.envs.gymnasium:QuadrotorVectorEnv",
                kwargs={"task": name},
            )
