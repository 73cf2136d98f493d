"""Door two: Gymnasium, one aircraft or a native vector of them.

The observation is the flat float32 vector of the task's parts (`environment.layout` says which
entry is what); the action is Box(-1, 1, (4,)), and the option `action` says what it means. `info`
of a step carries `reward_terms`, `is_success`, `error` [m] and `diverged`. A new version of an id
(-vN) means other numbers.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from quadrl import tasks
from quadrl.environment import Environment, Transition, check_seed
from quadrl.simulation import Engine
from quadrl.task import OptionError, Task, check_choices, check_option
from quadrl.vehicle import Vehicle, resolve

Info = dict[str, Any]


class _Door:
    """What the single environment and the vector share: how they are made, and how they draw."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}

    def _make(
        self,
        task: str | Task,
        num_envs: int | None,
        *,
        vehicle: Vehicle | None = None,
        action: str = "rotor",
        max_episode_steps: int | None = None,
        num_threads: int = 0,
        engine: Engine = "mujoco",
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        camera: str = "track",
        reward_terms: bool = True,
        **options: Any,  # noqa: ANN401 - of the task's own types
    ) -> tuple[gym.spaces.Box, gym.spaces.Box]:
        """Make the environment; returns the spaces of one aircraft."""
        if render_mode not in (None, "rgb_array"):
            raise OptionError(f"unknown render_mode {render_mode!r}; choices: None, 'rgb_array'")
        vehicle = resolve(vehicle)
        if max_episode_steps is not None:
            check_option("environment", "max_episode_steps", max_episode_steps, 200)
            options["horizon"] = max_episode_steps * vehicle.control_step
        self.environment = Environment(
            tasks.make(task, **options),
            num_envs=num_envs,
            vehicle=vehicle,
            num_threads=num_threads,
            engine=engine,
            action=action,
        )
        self.render_mode, self._terms_wanted = render_mode, reward_terms
        self.metadata = self.metadata | {"render_fps": round(1 / vehicle.control_step)}
        self._camera, self._picture = camera, {"width": width, "height": height}
        self._renderer: Any = None
        return (
            gym.spaces.Box(-np.inf, np.inf, (self.environment.size,), np.float32),
            gym.spaces.Box(-1.0, 1.0, (self.environment.interface.size,), np.float32),
        )

    def _frame(self, row: int = 0) -> np.ndarray:
        """The picture (height, width, 3) of one aircraft, uint8."""
        environment, simulation = self.environment, self.environment.simulation
        if self._renderer is None:
            from quadrl.rendering import Renderer

            model = environment.vehicle.compile(contact=environment.task.contact)
            self._renderer = Renderer(model, **self._picture)
        goal = environment.task.goal(simulation.state, environment.fields) + simulation.origin
        return self._renderer.frame(
            simulation.qpos.reshape(-1, 7)[row],
            camera=self._camera,
            goal=goal.reshape(-1, 3)[row],
            markers=environment.markers(row),
        )

    def _close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


class QuadrotorEnv(_Door, gym.Env):
    """One aircraft. `gym.make("quadrl/Hover-v0")`.

    `gym.make` keeps its argument `max_episode_steps` to itself, for a TimeLimit that knows nothing
    of success: give `horizon` [s] instead.
    """

    def __init__(self, task: str | Task = "hover", **settings: Any) -> None:  # noqa: ANN401
        """Make the environment.

        Args:
            task: A name of the catalogue or a task.
            **settings: `vehicle` (None: the paper's); `action` (what actions mean: "rotor", or
                another name of `quadrl.interfaces.INTERFACES`); `max_episode_steps` (None: the
                task's horizon); `render_mode` (None or "rgb_array"), `width` and `height`
                [pixels] and `camera` (a camera of `quadrl.rendering`) of a picture;
                `reward_terms` (True: in `info`); any field of the task.

        Raises:
            OptionError: Unknown task, interface, option or render mode; the message lists what
                there is.
        """
        self.observation_space, self.action_space = self._make(task, None, **settings)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Begin an episode; a seed starts the sequence of episodes anew."""
        super().reset(seed=seed)
        self.environment.generators = [self.np_random]
        return self.environment.flatten(self.environment.reset()), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Fly one control step.

        Raises:
            ActionError: Wrong shape, or a number that is not finite.
        """
        now = self.environment.step(action)
        info: Info = {
            "is_success": bool(now.is_success),
            "error": float(now.error),
            "diverged": bool(now.diverged),
        }
        if self._terms_wanted:
            info["reward_terms"] = {name: float(term) for name, term in now.reward_terms.items()}
        observation = self.environment.flatten(now.observation)
        return observation, float(now.reward), bool(now.terminated), bool(now.truncated), info

    def render(self) -> np.ndarray | None:
        """The current picture (height, width, 3) uint8, or None without a render mode.

        Raises:
            RenderingUnavailable: There is nothing to draw with.
        """
        return None if self.render_mode is None else self._frame()

    def close(self) -> None:
        """Free the renderer."""
        self._close()


class QuadrotorVectorEnv(_Door, VectorEnv):
    """Many aircraft on all cores. `gym.make_vec("quadrl/Hover-v0", num_envs=1024)`.

    Autoreset as Gymnasium's SyncVectorEnv has it: NEXT_STEP (default; the step after an end ignores
    the row's action, resets it and gives reward 0), SAME_STEP (the end's own observation and info
    are `info["final_obs"]` and `info["final_info"]`), or DISABLED (reset with
    `options={"reset_mask": mask}`). `info["_name"]` says which rows `info["name"]` holds for.
    TorchRL's GymWrapper takes DISABLED, and SAME_STEP with `reward_terms=False`: it cannot read an
    info within an info.
    """

    def __init__(
        self,
        task: str | Task = "hover",
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **settings: Any,  # noqa: ANN401
    ) -> None:
        """Make the environments.

        Args:
            task: A name of the catalogue or a task.
            num_envs: N.
            autoreset_mode: Or its name.
            **settings: As `QuadrotorEnv` has them, and `num_threads` (0: every core).

        Raises:
            OptionError: Unknown task, interface, option or mode, or an impossible number of
                environments.
        """
        modes = {mode.value: mode for mode in AutoresetMode} | dict(AutoresetMode.__members__)
        if not isinstance(autoreset_mode, AutoresetMode):
            check_choices([autoreset_mode], modes, "autoreset mode")
            autoreset_mode = modes[autoreset_mode]
        self.single_observation_space, self.single_action_space = self._make(
            task, num_envs, **settings
        )
        self.num_envs, self.autoreset_mode = num_envs, autoreset_mode
        self.metadata = self.metadata | {"autoreset_mode": autoreset_mode}
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, Info]:
        """Begin episodes, in all environments or in those of `options["reset_mask"]`.

        Environment i is seeded with seed + i.
        """
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise OptionError(f"reset_mask: bool of shape ({self.num_envs},), some of it True")
        if seed is not None:
            check_seed(seed)
            for i in np.flatnonzero(mask):
                self.environment.generators[i] = np.random.default_rng(seed + int(i))
        if mask.all():
            self._observation = self.environment.flatten(self.environment.reset())
            self._over = np.zeros(self.num_envs, dtype=bool)
        else:
            self._renew(mask)
        return self._observation.copy(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """Fly one control step in every environment.

        Raises:
            ActionError: Wrong shape, or a number that is not finite.
        """
        now = self.environment.step(actions)
        self._observation = self.environment.flatten(now.observation)
        reward, terminated, truncated = now.reward, now.terminated, now.truncated
        last, self._over = self._over, np.logical_or(terminated, truncated)
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._over.any():
            over = self._over.copy()
            final = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(over):
                final[i] = self._observation[i].copy()
            info = self._info(now, ~over) | {"final_obs": final, "_final_obs": over}
            info |= {"final_info": self._info(now, over), "_final_info": over.copy()}
            self._renew(over)
        elif self.autoreset_mode == AutoresetMode.NEXT_STEP and last.any():
            info = self._info(now, ~last)
            reward = np.where(last, 0.0, reward)
            terminated, truncated = terminated & ~last, truncated & ~last
            self._renew(last)
        else:
            info = self._info(now, np.ones(self.num_envs, dtype=bool))
        return self._observation.copy(), reward, terminated, truncated, info

    def _info(self, now: Transition, rows: np.ndarray) -> Info:
        """A step's info for `rows` (N,) bool: an array a name, 0 elsewhere, and a mask a name."""

        def masked(**values: np.ndarray) -> Info:
            arrays = {k: np.where(rows, value, np.zeros_like(value)) for k, value in values.items()}
            return arrays | {f"_{name}": rows.copy() for name in values}

        info = masked(is_success=now.is_success, error=now.error, diverged=now.diverged)
        if self._terms_wanted:
            info |= {"reward_terms": masked(**now.reward_terms), "_reward_terms": rows.copy()}
        return info

    def _renew(self, rows: np.ndarray) -> None:
        """Begin an episode in some rows (N,) bool."""
        self._observation[rows] = self.environment.flatten(self.environment.reset(rows))
        self._over[rows] = False

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture (height, width, 3) uint8 of each aircraft, or None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(self._frame(row) for row in range(self.num_envs))

    def close_extras(self, **_: Any) -> None:  # noqa: ANN401
        """Free the renderer."""
        self._close()


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
                # The environment itself refuses a step before a reset and a bad action, and the
                # tests run Gymnasium's checks: the two wrappers would only cost time.
                order_enforce=False,
                disable_env_checker=True,
            )
