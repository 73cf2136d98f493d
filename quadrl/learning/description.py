"""Describe tasks in words and numbers, for the command line and the documentation."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.docstrings import docstrings
from quadrl.core.environment import Environment
from quadrl.core.task import Task
from quadrl.learning.defaults import own_settings


def describe(task: Task) -> dict[str, Any]:
    """Describe a task before it is flown with the paper's aircraft, as JSON can hold it.

    Returns:
        name, asks, starts, ends, solved (texts); time_limit [s]; training: settings that have other
        defaults with this task; observation: name, place, unit, meaning and formula of
        each term of the flat vector; action (text); reward: name, weight (None if there is no
        option for it) and meaning of each term; options: name, value and meaning of the others.
    """
    environment, texts = Environment(task, seed=0), docstrings(type(task))
    values = dataclasses.asdict(task)
    return {
        **{name: getattr(task, name) for name in ("name", "asks", "starts", "ends", "solved")},
        "time_limit": task.time_limit,
        "training": own_settings(task),
        "observation": describe_observation(environment),
        "action": describe_action(environment.vehicle),
        "reward": [
            {"name": term, "weight": values.get(f"{term}_weight"),
             "meaning": texts.get(f"{term}_weight", "")}
            for term in environment.term_names
        ],
        "options": [
            {"name": name, "value": value, "meaning": texts.get(name, "")}
            for name, value in values.items()
            if name != "time_limit" and not name.endswith("_weight")
        ],
    }  # fmt: skip


def describe_observation(environment: Environment) -> list[dict[str, Any]]:
    """Describe each term of the flat observation: name, place, unit, meaning and formula."""
    seen = (
        environment.observer.senses.terms if environment.observer else environment.task.observation
    )
    return [
        {"name": name, "first": where.start, "last": where.stop - 1, "unit": seen[name].unit,
         "meaning": seen[name].meaning, "formula": seen[name].formula}
        for name, where in environment.layout.items()
    ]  # fmt: skip


def describe_action(vehicle: Vehicle) -> str:
    """Describe the numbers of an action in the control mode "rotor"."""
    hover, fastest = (_span(speeds) for speeds in (vehicle.hover_speed, vehicle.max_speed))
    return (
        f"{vehicle.rotor_count} numbers in [-1, 1], one per rotor: the change of its speed command "
        f"from hover ({hover} rad/s), {vehicle.action_scale:g} rad/s at 1; commands stay between 0 "
        f"and {fastest} rad/s"
    )


def _span(values: np.ndarray) -> str:
    low, high = f"{values.min():.1f}", f"{values.max():.1f}"
    return low if low == high else f"{low} to {high}"
