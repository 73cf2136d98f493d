"""Door one: the domain `quadrotor` the dm_control way.

`load` has dm_control's own signature; `register` puts the domain among dm_control's, so that
`dm_control.suite.load("quadrotor", "hover")` and TorchRL's `DMControlEnv` find it.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import sys
from typing import Any

import mujoco as _mujoco
import numpy as np
from dm_control import mujoco
from dm_control.rl import control
from dm_control.suite import base
from dm_control.utils import containers
from dm_env import specs

from quadrl import native, tasks
from quadrl.environment import Environment, Transition
from quadrl.simulation import SingleSimulation
from quadrl.task import Task, check_choices
from quadrl.vehicle import ROTORS, Vehicle

DOMAIN = "quadrotor"
SUITE = containers.TaggedTasks()


class Physics(mujoco.Physics):
    """The complete model of the aircraft, drawn parts included."""

    def step(self, nstep: int = 1) -> None:
        """Advance by physics steps; a divergence is the task's to report, not an exception.

        Raises:
            NativeError: The rotor callbacks were taken away.
        """
        native.check_installed()
        with self.suppress_physics_errors():
            super().step(nstep)

    def after_reset(self) -> None:
        """Compute the derived fields, and leave the solver's warm start as a reset leaves it."""
        super().after_reset()
        self.data.qacc_warmstart[:] = 0.0


class QuadrotorTask(base.Task):
    """A task of the catalogue in dm_control's terms."""

    def __init__(self, task: Task, vehicle: Vehicle, random: Any = None) -> None:
        """Wrap a task.

        Args:
            task: The task.
            vehicle: The aircraft.
            random: Seed, RandomState or None, as dm_control has it. A seed gives the episodes
                that every other door gives with it.
        """
        super().__init__(random)
        is_seed = isinstance(random, (int, np.integer))
        self._seed = int(random) if is_seed else int(self.random.randint(2**31))
        self._task, self._vehicle = task, vehicle
        self._environment: Environment | None = None
        self._physics: Physics | None = None
        self._transition: Transition | None = None

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """Four rotors, -1 to 1."""
        names = "\t".join(f"rotor_{k + 1}" for k in range(ROTORS))
        return specs.BoundedArray((ROTORS,), np.float64, -1.0, 1.0, name=names)

    def initialize_episode(self, physics: Physics) -> None:
        """Begin an episode."""
        if self._environment is None or self._physics is not physics:
            simulation = SingleSimulation(
                self._vehicle, physics.model.ptr, physics.data.ptr, altitude=self._task.altitude
            )
            environment = Environment(self._task, seed=self._seed, simulation=simulation)
            if self._environment is not None:
                environment.generators = self._environment.generators
            self._environment, self._physics = environment, physics
        self._observation = self._environment.reset()
        self._transition = None

    def before_step(self, action: np.ndarray, physics: Physics) -> None:
        """Hand the action to the rotors."""
        self._environment.begin(action)

    def after_step(self, physics: Physics) -> None:
        """Work out the transition."""
        self._transition = self._environment.finish()
        self._observation = self._transition.observation
        if self.visualize_reward:
            colours, closeness = physics.named.model.mat_rgba, 1 / (1 + self._transition.error)
            plain, highlight = colours["self_default"], colours["self_highlight"]
            colours["self"] = plain + closeness**4 * (highlight - plain)

    def get_observation(self, physics: Physics) -> dict[str, np.ndarray]:
        """Named parts, float64."""
        return collections.OrderedDict((k, np.array(v)) for k, v in self._observation.items())

    def get_reward(self, physics: Physics) -> float:
        """The reward of the last step."""
        return float(self._transition.reward) if self._transition else 0.0

    def get_termination(self, physics: Physics) -> float | None:
        """Discount at the end: 0 for terminated, 1 for truncated; None before."""
        if self._transition is None or not (
            self._transition.terminated or self._transition.truncated
        ):
            return None
        return 0.0 if self._transition.terminated else 1.0

    @property
    def transition(self) -> Transition | None:
        """The last transition with its named reward terms and success; None after a reset."""
        return self._transition


def _make(
    name: str,
    time_limit: float | None = None,
    random: Any = None,
    environment_kwargs: dict[str, Any] | None = None,
    vehicle: Vehicle | None = None,
    **options: Any,
) -> control.Environment:
    """Build the environment of a task; options are the task's fields."""
    settings = dict(environment_kwargs or {})
    if (limit := settings.pop("time_limit", time_limit)) is not None:
        options["horizon"] = limit
    task = tasks.make(name, **options)
    vehicle = vehicle or Vehicle()
    control_step = settings.pop("control_timestep", None)
    if (substeps := settings.pop("n_sub_steps", None)) is not None:
        control_step = substeps * vehicle.physics_step
    if control_step is not None:
        vehicle = dataclasses.replace(vehicle, control_step=control_step)
    model = vehicle.compile(contact=task.contact)
    # A simulation that diverges must not pass for a fresh one.
    model.opt.disableflags |= int(_mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return control.Environment(
        Physics.from_model(model),
        QuadrotorTask(task, vehicle, random),
        n_sub_steps=vehicle.substeps,  # the task keeps the clock: a crash on the last step counts
        **settings,
    )


def _collect() -> None:
    """Put every task of the catalogue into SUITE, and the constants after it."""
    global ALL_TASKS, TASKS_BY_DOMAIN
    for name in tasks.TASKS:
        if name not in SUITE:
            factory = functools.partial(_make, name)
            factory.__name__ = name  # type: ignore[attr-defined]
            SUITE.add()(factory)
    ALL_TASKS = tuple((DOMAIN, name) for name in SUITE)
    TASKS_BY_DOMAIN = {DOMAIN: tuple(SUITE)}


ALL_TASKS: tuple[tuple[str, str], ...] = ()
"""(domain, task) pairs, as dm_control.suite has them."""
BENCHMARKING: tuple[tuple[str, str], ...] = ()
"""Empty: dm_control asks of these that every reward lies in [0, 1], and the paper's do not."""
TASKS_BY_DOMAIN: dict[str, tuple[str, ...]] = {}
"""The task names of the domain."""
_collect()


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
        task_kwargs: `random` (seed), `time_limit` [s], `vehicle`, and any field of the task.
        environment_kwargs: For `dm_control.rl.control.Environment`.
        visualize_reward: Colour the hull by how close the aircraft is to what is asked.

    Raises:
        ValueError: Unknown domain, task or option; the message lists the choices.
    """
    check_choices([domain_name], [DOMAIN], "domain")
    check_choices([task_name], tasks.TASKS, "task")
    environment = _make(task_name, environment_kwargs=environment_kwargs, **(task_kwargs or {}))
    environment.task.visualize_reward = visualize_reward
    return environment


def register() -> None:
    """Put the domain, with every task of the catalogue, among dm_control's own (idempotent)."""
    from dm_control import suite

    _collect()
    suite._DOMAINS[DOMAIN] = sys.modules[__name__]
    suite.ALL_TASKS = suite._get_tasks(tag=None)
    suite.BENCHMARKING = suite._get_tasks("benchmarking")
    suite.EASY, suite.HARD = suite._get_tasks("easy"), suite._get_tasks("hard")
    suite.EXTRA = tuple(sorted(set(suite.ALL_TASKS) - set(suite.BENCHMARKING)))
    suite.NO_REWARD_VIZ = suite._get_tasks("no_reward_visualization")
    suite.REWARD_VIZ = tuple(sorted(set(suite.ALL_TASKS) - set(suite.NO_REWARD_VIZ)))
    suite.TASKS_BY_DOMAIN = suite._get_tasks_by_domain(suite.ALL_TASKS)
