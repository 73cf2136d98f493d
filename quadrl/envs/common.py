"""What the APIs share: an environment from one set of keywords, and pictures of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from quadrl import mjcf, tasks, validation
from quadrl.environment import Environment
from quadrl.task import Task
from quadrl.vehicle import Vehicle, resolve

ENVIRONMENT = ("control_mode", "engine", "ranges", "num_threads", "seed")
KEYWORDS = (*ENVIRONMENT, "vehicle", "max_episode_steps", "reward_terms")
"""Keywords beside the options of the task; those of `quadrl.environment.Environment` come first."""


def make(
    task: str | Task,
    num_envs: int,
    *,
    vehicle: Vehicle | str | None = None,
    max_episode_steps: int | None = None,
    **settings: Any,
) -> Environment:
    """Make an environment.

    Args:
        task: A name of the catalogue or a task.
        num_envs: N.
        vehicle: A name of `quadrl.VEHICLES` or a Vehicle; None for the paper's.
        max_episode_steps: The time limit in control steps, in place of `time_limit` [s].
        **settings: `control_mode` (what actions mean, a name of `quadrl.control.CONTROL_MODES`),
            `engine` ("mujoco", or "free_flight": no contact is computed where there is nothing to
            touch), `ranges` (of parameters that are drawn at each reset), `num_threads` (of the
            simulation; 0 for every core), `seed` (row i is seeded with seed + i; None for one from
            the system), and any option of the task.

    Raises:
        QuadrlError: Unknown name or impossible value.
    """
    vehicle = resolve(vehicle)
    own = {name: settings.pop(name) for name in ENVIRONMENT if name in settings}
    if max_episode_steps is not None:
        steps = validation.number("max_episode_steps", max_episode_steps, 1, whole=True)
        settings["time_limit"] = steps * vehicle.control_timestep
    return Environment(
        make_task(task, settings, KEYWORDS), num_envs=num_envs, vehicle=vehicle, **own
    )


def make_task(task: str | Task, options: Mapping[str, Any], keywords: Iterable[str]) -> Task:
    """A task with some options; the refusal of an unknown one lists the API's keywords as well."""
    task = tasks.make(task)
    names = [*keywords, *(field.name for field in dataclasses.fields(task))]
    validation.keys(f"{task.name} option", options, names)
    return task.replace(**options)


class Pictures:
    """Draws the aircraft of an environment; opens the renderer at the first picture."""

    def __init__(self, environment: Environment, camera: str, width: int, height: int) -> None:
        """Note what to draw, on pictures of width x height pixels."""
        self._environment, self._camera = environment, camera
        self._size = {"width": width, "height": height}
        self._renderer: Any = None

    def frame(self, row: int = 0) -> np.ndarray:
        """The picture (height, width, 3) uint8 of one aircraft.

        Raises:
            RenderingUnavailable: This machine has no graphics library.
        """
        environment, task = self._environment, self._environment.task
        if self._renderer is None:
            from quadrl.rendering import Renderer

            model = mjcf.compile_model(environment.vehicle, contact=task.contact, scene=task.scene)
            self._renderer = Renderer(model, **self._size)
        return self._renderer.frame(
            environment.engine.qpos[row],
            camera=self._camera,
            goal=environment.goals()[row],
            markers=environment.markers(row),
        )

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
