"""dm_control: the physics and the task of the domain `quadrotor`; `quadrl.suite` loads them."""

# pyright: reportIncompatibleMethodOverride=false
# To a type checker dm_control's abstract methods, without annotations, return None.
# ruff: noqa: E402 - what draws is chosen before dm_control is imported.

from __future__ import annotations

import collections
import contextlib
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any, Unpack

from quadrl.base.shield import refuse_after_fork
from quadrl.rendering import gl
from quadrl.rendering.camera import FOLLOW, aircraft_scale, moving_views

try:
    gl.choose()
except ModuleNotFoundError as error:
    reason = "python -m pip install dm-control, with Python 3.12 or older"
    reason = f"dm_control's API needs dm-control: {reason}; every other API works without it"
    raise ImportError(reason) from error

import mujoco as _mujoco
import numpy as np
from dm_control import mujoco
from dm_control.mujoco import wrapper
from dm_control.rl import control
from dm_control.suite import base
from dm_env import specs

from quadrl.base import validation
from quadrl.base.errors import QuadrlError
from quadrl.core.environment import Environment, Transition
from quadrl.core.scenario import Conditions, Scenario
from quadrl.core.task import Task
from quadrl.engines import native
from quadrl.engines.mujoco import DataEngine
from quadrl.envs.common import Changing

ENVIRONMENT_KWARGS = "time_limit control_timestep n_sub_steps flat_observation legacy_step".split()


class Physics(mujoco.Physics):
    """The complete model of the aircraft, drawn parts included."""

    engine: DataEngine | None = None
    """Flies it where free flight is the engine; a copy has none."""
    inner_loop: Callable[[int], int] | None = None
    """`Environment.control` during control steps in which the rotors get more than one command."""
    in_view: Callable[[], tuple[np.ndarray, Sequence[Any]]] | None = None
    """The goal (3,) [m] and the markers that "follow" keeps in view; None before an episode."""

    def __getstate__(self) -> Any:
        """Copy for pickle and deepcopy."""
        return super().__getstate__(), self.engine, self.legacy_step, self.in_view

    def __setstate__(self, state: Any) -> None:
        """Restore what was copied."""
        data, self.engine, self.legacy_step, self.in_view = state
        super().__setstate__(data)

    def render(
        self, height: int = 240, width: int = 320, camera_id: Any = -1, **options: Any
    ) -> np.ndarray:
        """As in dm_control; "follow" moves with the aircraft and keeps the goal in view."""
        refuse_after_fork()
        if camera_id != FOLLOW or self.in_view is None:
            return super().render(height, width, camera_id, **options)  # type: ignore[arg-type]
        goal, markers = self.in_view()
        pose, scale = self.data.qpos[None, :7], aircraft_scale(self.model.ptr)
        view = moving_views(FOLLOW, pose, goal[None], [markers], scale)[0]
        callback = options.pop("scene_callback", None)
        camera = mujoco.MovableCamera(self, height, width, scene_callback=callback)
        camera.set_pose(view[:3], *view[3:])
        picture = camera.render(**options)
        camera._scene.free()
        return picture

    def step(self, nstep: int = 1) -> None:
        """Advance by steps of the model; a NativeError without the rotors' callbacks."""
        native.check_installed()
        if (engine := self.engine) is None:
            super().step(nstep)
            return
        left, rest = divmod(nstep, engine.finer)  # physics steps, and a part of one
        while left:
            steps = self.inner_loop(left) if self.inner_loop else left
            if engine.fly(steps):
                self.forward()  # what is drawn and measured belongs to the new state
            else:
                for count in engine.contact_steps(steps):
                    super().step(count)
            left -= steps
        if rest:
            super().step(rest)

    @contextlib.contextmanager
    def check_invalid_state(self) -> Generator[None]:
        """Check nothing: a divergence ends the episode, and the task reports it."""
        yield


class QuadrotorTask(Changing, base.Task):
    """A task of the catalogue as a dm_control task."""

    def __init__(self, environment: Environment, random: Any = None) -> None:
        """Wrap an environment of one aircraft.

        Args:
            environment: It flies in the Physics that the task is for.
            random: Seed, RandomState or None, as in dm_control. A seed gives the episodes that
                every other API gives with it.
        """
        given = None if isinstance(random, np.random.RandomState) else random
        environment.seed(given)
        super().__init__(random)
        if given is None:
            environment.seed(int(self.random.randint(2**31)))
        self.environment = environment
        """Of one aircraft."""
        layout = environment.layout.items()  # dm_control asks for a specification before a reset
        self._observation = {name: np.zeros((1, k.stop - k.start)) for name, k in layout}
        self.transition: Transition | None = None
        """The last step (N = 1) with its named reward terms and success; None after a reset."""
        self.start_at: Mapping[str, Any] | None = None
        """Start of the next episodes, as `Environment.reset` takes it; None for the task's."""

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """The terms of the control mode, each between -1 and 1."""
        names = "\t".join(term.name for term in self.environment.control_mode.terms)
        bound = np.ones(self.environment.action_size)
        return specs.BoundedArray(bound.shape, np.float64, -bound, bound, name=names)

    def initialize_episode(self, physics: Physics) -> None:
        """Begin an episode."""
        self._observation = self.environment.reset(start=self.start_at)
        self.transition = None
        physics.in_view = self.in_view
        super().after_step(physics)  # colours the reward

    def before_step(self, action: np.ndarray, physics: Physics) -> None:
        """Give the action to the rotors or to the control loops."""
        self.environment.begin(np.asarray(action)[None])
        if self.environment.stepwise:
            physics.inner_loop = self.environment.control

    def after_step(self, physics: Physics) -> None:
        """Compute the transition."""
        physics.inner_loop = None  # outside of a control step there is no setpoint
        now = self.transition = self.environment.finish()
        self._observation = now.observation
        super().after_step(physics)

    def in_view(self) -> tuple[np.ndarray, Sequence[Any]]:
        """The goal (3,) [m] and the markers that a camera should keep in view, world frame."""
        return self.environment.goals()[0], self.environment.markers()

    def get_observation(self, physics: Physics) -> dict[str, np.ndarray]:
        """Named terms, float64."""
        terms = self._observation.items()
        return collections.OrderedDict((name, np.array(value[0])) for name, value in terms)

    def get_reward(self, physics: Physics) -> float:
        """The reward of the last step."""
        return self.transition.reward.item() if self.transition else 0.0

    def get_termination(self, physics: Physics) -> float | None:
        """Discount at the end: 0 for terminated, 1 for truncated; None before."""
        now = self.transition
        if now is None or not (now.terminated[0] or now.truncated[0]):
            return None
        return 0.0 if now.terminated[0] else 1.0


def make(
    task: str | Task | Scenario,
    time_limit: float | None = None,
    random: Any = None,
    environment_kwargs: dict[str, Any] | None = None,
    **conditions: Unpack[Conditions],
) -> control.Environment:
    """Build the dm_control environment of a task.

    `task.environment.randomizer.shown()` gives what a randomization drew, and
    `task.environment.privileged` the observation for the critic alone.

    Args:
        task: A name of the catalogue, a task, or a whole scenario.
        time_limit: Time limit of an episode [s]; None for the task's.
        random: Seed, RandomState or None.
        environment_kwargs: As in `quadrl.suite.load`.
        **conditions: `vehicle`, `weather`, `randomization` and the others, as
            `quadrl.core.scenario.Conditions` has them, and options of the task.

    Raises:
        QuadrlError: Unknown name or impossible value.
    """
    settings = dict(environment_kwargs or {})
    validation.keys("environment_kwargs", settings, ENVIRONMENT_KWARGS)
    # The task keeps the clock, not dm_control: there a time limit hides a crash on the last step.
    if (limit := settings.pop("time_limit", time_limit)) is not None:
        conditions["time_limit"] = limit
    scenario = Scenario.of(task, ["random"], **conditions)
    timestep = settings.pop("control_timestep", None)
    if (substeps := settings.pop("n_sub_steps", None)) is not None:
        if timestep is not None:
            allowed = "absent where control_timestep is given"
            raise QuadrlError(name="n_sub_steps", value=substeps, allowed=allowed)
        substeps = validation.number("n_sub_steps", substeps, 1, whole=True)
        timestep = substeps * scenario.vehicle.physics_timestep
    scenario = Scenario.of(scenario, control_timestep=timestep)
    model = scenario.compile_model()
    # A simulation that diverges must not pass for a fresh one.
    model.opt.disableflags |= int(_mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    physics = Physics.from_model(wrapper.MjModel(model))
    vehicle, engine = scenario.aircraft, scenario.engine
    data = physics.data.ptr
    physics.engine = DataEngine(vehicle, model, data, altitude=scenario.altitude, engine=engine)
    environment = Environment(scenario, engine=physics.engine)
    quadrotor = QuadrotorTask(environment, random)
    steps = vehicle.substeps * physics.engine.finer
    return control.Environment(physics, quadrotor, n_sub_steps=steps, **settings)
