"""Door one: the domain `quadrotor` the dm_control way.

`load` has dm_control's own signature; `register` puts the domain among dm_control's, so that
`dm_control.suite.load("quadrotor", "hover")` and TorchRL's `DMControlEnv` find it.
"""

# pyright: reportIncompatibleMethodOverride=false
# To a type checker dm_control's abstract methods, without annotations, return None.

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
import sys
from collections.abc import Callable, Generator
from typing import Any

import mujoco as _mujoco
import numpy as np
from dm_control import mujoco
from dm_control.mujoco import wrapper
from dm_control.rl import control
from dm_control.suite import base
from dm_control.utils import containers
from dm_env import specs

from quadrl import interfaces, native, tasks
from quadrl.environment import Environment, Transition
from quadrl.simulation import ENGINES, Engine, SingleSimulation
from quadrl.task import Task, check_choices
from quadrl.vehicle import Vehicle, resolve

DOMAIN = "quadrotor"
SUITE = containers.TaggedTasks()
ENVIRONMENT_KWARGS = (
    "time_limit",
    "control_timestep",
    "n_sub_steps",
    "flat_observation",
    "legacy_step",
)

ALL_TASKS: tuple[tuple[str, str], ...]
"""(domain, task) pairs, as dm_control.suite has them."""
TASKS_BY_DOMAIN: dict[str, tuple[str, ...]]
"""The task names of the domain."""
BENCHMARKING: tuple[tuple[str, str], ...] = ()
"""Empty: dm_control asks of these that every reward lies in [0, 1], and the paper's do not."""


class Physics(mujoco.Physics):
    """The complete model of the aircraft, drawn parts included."""

    simulation: SingleSimulation | None = None
    """Flies it, where free flight is the engine; None before the first episode."""
    inner_loop: Callable[[], None] | None = None
    """Commands the rotors before each physics step, during the control steps of an action interface
    with loops."""

    def step(self, nstep: int = 1) -> None:
        """Advance by physics steps.

        Raises:
            NativeError: The rotor callbacks were taken away.
        """
        if self.inner_loop is None:
            self._advance(nstep)
            return
        for _ in range(nstep):
            self.inner_loop()
            self._advance(1)

    def _advance(self, steps: int) -> None:
        if self.simulation is not None and self.simulation.fly(steps):
            self.forward()  # what is drawn and measured belongs to the new state
            return
        native.check_installed()
        super().step(steps)

    @contextlib.contextmanager
    def check_invalid_state(self) -> Generator[None]:
        """Nothing: a divergence ends the episode, which is the task's to report."""
        yield


class QuadrotorTask(base.Task):
    """A task of the catalogue in dm_control's terms."""

    def __init__(
        self,
        task: Task,
        vehicle: Vehicle,
        random: Any = None,  # noqa: ANN401
        action: str = "rotor",
        engine: Engine = "mujoco",
    ) -> None:
        """Wrap a task.

        Args:
            task: The task.
            vehicle: The aircraft.
            random: Seed, RandomState or None, as dm_control has it. A seed gives the episodes
                that every other door gives with it.
            action: What actions mean, a name of `quadrl.interfaces.INTERFACES`.
            engine: "mujoco", or "flight": free flight wherever there is nothing to touch.
        """
        super().__init__(random)
        is_seed = isinstance(random, (int, np.integer))
        self._seed = int(random) if is_seed else int(self.random.randint(2**31))
        check_choices([engine], ENGINES, "engine")
        self._task, self._vehicle = task, vehicle
        self._engine: Engine = engine
        self._interface = interfaces.make(action, vehicle)
        self._environment: Any = None  # an Environment from the first episode on
        self._physics: Physics | None = None
        self._observation = {name: np.zeros(p.size) for name, p in task.observation.items()}
        self.transition: Transition | None = None
        """The last step with its named reward terms and success; None after a reset."""

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """The entries of the action interface, -1 to 1."""
        names = "\t".join(entry.name for entry in self._interface.entries)
        bound = np.ones(self._interface.size)
        return specs.BoundedArray(bound.shape, np.float64, -bound, bound, name=names)

    def initialize_episode(self, physics: Physics) -> None:
        """Begin an episode."""
        if self._environment is None or self._physics is not physics:
            altitude = self._task.origin_height(self._vehicle)
            simulation = physics.simulation = SingleSimulation(
                self._vehicle,
                physics.model.ptr,
                physics.data.ptr,
                altitude=altitude,
                engine=self._engine,
            )
            environment = Environment(
                self._task, seed=self._seed, simulation=simulation, action=self._interface.name
            )
            if self._environment is not None:
                environment.generators = self._environment.generators
            self._environment, self._physics = environment, physics
        self._observation, self.transition = self._environment.reset(), None
        super().after_step(physics)  # colours the reward

    def before_step(self, action: np.ndarray, physics: Physics) -> None:
        """Hand the action to the rotors, or to the loops."""
        self._environment.begin(action)
        if self._interface.has_loops:
            physics.inner_loop = self._environment.control

    def after_step(self, physics: Physics) -> None:
        """Work out the transition."""
        physics.inner_loop = None  # outside of a control step there is no setpoint
        now = self.transition = self._environment.finish()
        self._observation = now.observation
        super().after_step(physics)

    def get_observation(self, physics: Physics) -> dict[str, np.ndarray]:
        """Named parts, float64."""
        return collections.OrderedDict((k, np.array(v)) for k, v in self._observation.items())

    def get_reward(self, physics: Physics) -> float:
        """The reward of the last step."""
        return float(self.transition.reward) if self.transition else 0.0

    def get_termination(self, physics: Physics) -> float | None:
        """Discount at the end: 0 for terminated, 1 for truncated; None before."""
        now = self.transition
        if now is None or not (now.terminated or now.truncated):
            return None
        return 0.0 if now.terminated else 1.0


def make(
    task: str | Task,
    time_limit: float | None = None,
    random: Any = None,  # noqa: ANN401 - what dm_control takes
    environment_kwargs: dict[str, Any] | None = None,
    vehicle: Vehicle | None = None,
    action: str = "rotor",
    engine: Engine = "mujoco",
    **options: Any,  # noqa: ANN401
) -> control.Environment:
    """Build the environment of a task.

    Args:
        task: A name of the catalogue or a task.
        time_limit: Horizon of an episode [s]; None for the task's.
        random: Seed, RandomState or None.
        environment_kwargs: As `load` has them.
        vehicle: The aircraft; None for the paper's.
        action: What actions mean, a name of `quadrl.interfaces.INTERFACES`.
        engine: "mujoco", or "flight": free flight wherever there is nothing to touch.
        **options: Fields of the task.

    Raises:
        OptionError: Unknown task, interface or option; the message lists the choices.
        ValueError: Both control_timestep and n_sub_steps are given.
    """
    settings = dict(environment_kwargs or {})
    check_choices(settings, ENVIRONMENT_KWARGS, "environment_kwargs entry")
    # The task keeps the clock, not dm_control: there a time limit hides a crash on the last step.
    if (limit := settings.pop("time_limit", time_limit)) is not None:
        options["horizon"] = limit
    task, vehicle = tasks.make(task, **options), resolve(vehicle)
    control_step = settings.pop("control_timestep", None)
    if (substeps := settings.pop("n_sub_steps", None)) is not None:
        if control_step is not None:
            raise ValueError("both control_timestep and n_sub_steps were given; give one")
        control_step = substeps * vehicle.physics_step
    if control_step is not None:
        vehicle = dataclasses.replace(vehicle, control_step=control_step)
    model = vehicle.compile(contact=task.contact)
    # A simulation that diverges must not pass for a fresh one.
    model.opt.disableflags |= int(_mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return control.Environment(
        Physics.from_model(wrapper.MjModel(model)),
        QuadrotorTask(task, vehicle, random, action, engine),
        n_sub_steps=vehicle.substeps,
        **settings,
    )


def load(
    domain_name: str,
    task_name: str,
    task_kwargs: dict[str, Any] | None = None,
    environment_kwargs: dict[str, Any] | None = None,
    visualize_reward: bool = False,
) -> control.Environment:
    """Load an environment as `dm_control.suite.load` does.

    Args:
        domain_name: "quadrotor".
        task_name: A name of the catalogue.
        task_kwargs: `random` (seed), `time_limit` [s], `vehicle`, `action` (what actions mean, a
            name of `quadrl.interfaces.INTERFACES`), `engine` ("mujoco" or "flight"), and any field
            of the task.
        environment_kwargs: `time_limit` and `control_timestep` [s], `n_sub_steps`,
            `flat_observation`, `legacy_step`: those of `dm_control.rl.control.Environment`.
        visualize_reward: Colour the aircraft by its reward, clipped to [0, 1].

    Raises:
        OptionError: Unknown domain, task or option; the message lists the choices.
    """
    check_choices([domain_name], [DOMAIN], "domain")
    check_choices([task_name], tasks.TASKS, "task")
    environment = make(task_name, environment_kwargs=environment_kwargs, **(task_kwargs or {}))
    environment.task.visualize_reward = visualize_reward
    return environment


def register() -> None:
    """Put the domain, with every task of the catalogue, among dm_control's own (idempotent)."""
    from dm_control import suite

    for name in tasks.TASKS:
        if name not in SUITE:
            factory = functools.partial(make, name)
            factory.__name__ = name  # type: ignore[attr-defined]
            SUITE.add()(factory)
    suite._DOMAINS[DOMAIN] = sys.modules[__name__]
    suite.ALL_TASKS = suite._get_tasks(tag=None)
    suite.BENCHMARKING = suite._get_tasks("benchmarking")
    suite.EASY, suite.HARD = suite._get_tasks("easy"), suite._get_tasks("hard")
    suite.EXTRA = tuple(sorted(set(suite.ALL_TASKS) - set(suite.BENCHMARKING)))
    suite.NO_REWARD_VIZ = suite._get_tasks("no_reward_visualization")
    suite.REWARD_VIZ = tuple(sorted(set(suite.ALL_TASKS) - set(suite.NO_REWARD_VIZ)))
    suite.TASKS_BY_DOMAIN = suite._get_tasks_by_domain(suite.ALL_TASKS)


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """The constants that grow with the catalogue."""
    if name == "ALL_TASKS":
        return tuple((DOMAIN, task) for task in tasks.TASKS)
    if name == "TASKS_BY_DOMAIN":
        return {DOMAIN: tuple(tasks.TASKS)}
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
