"""What the settings of a training are where nothing is said."""

from __future__ import annotations

import dataclasses
from typing import Any

from quadrl import tasks
from quadrl.aircraft.presets import VEHICLES
from quadrl.base.validation import choice, keys
from quadrl.conditions.randomization import RANDOMIZATIONS
from quadrl.core.task import Task
from quadrl.learning.algorithm_config import ALGORITHM_CONFIGS

CHOSEN = ("task", "algo", "seed", "vehicle", "variant")
"""Settings that the defaults follow from, or that have no better default than another."""
PAIRS = ("task_options", "practice", "vehicle_options", "observe")
"""Settings that are dicts; what is given is added to the defaults."""
WIDE = 90.0
"""Action scale of the paper's aircraft in the variant robust [rad/s]: with its own, 35, the rotors
carry 1.33 times the specified weight at most, too little for one that is 20 % heavier in wind."""
VARIANTS: dict[str, dict[str, Any]] = {
    "ideal": {},
    "robust": {
        "weather": "light",
        "randomization": {
            "mass": (0.8, 1.2),
            "lag": (0.4, 2.5),
            "command_delay": (0.0, 0.06),
            "noise": dataclasses.asdict(RANDOMIZATIONS["light"].noise),
        },
        # Commands arrive late: what was sent belongs to the state. Mass and wind show as
        # acceleration.
        "observe": {"action_history": 2, "disturbance": True, "privileged": True},
        "holds_goal": False,  # in wind the goal is held with a tilt that the wind gives
        "gae_lambda": 0.95,
        "gamma": 0.95,  # with a shorter sight heavy aircraft begin to swing, and fall
        "ppo": {"learning_rate": 4e-3, "beta2": 0.999},
        # Without it actions alternate between their ends on aircraft with quick rotors.
        "task_options": {"smoothness_weight": 10.0},
    },
}
"""Settings that go together, on top of a task's own."""


def training_defaults(
    base: dict[str, Any], task: str, algo: str, vehicle: str, variant: str
) -> dict[str, Any]:
    """The fields of `TrainConfig` that a task is trained with unless something else is said.

    An aircraft that is controlled more often than the paper's looks as far ahead in seconds,
    collects as many seconds in a batch, and trains for as many.

    Args:
        base: The fields, as they are for a task that has none of its own.
        task: Name of the task.
        algo: Name of the algorithm.
        vehicle: Name of the aircraft.
        variant: A name of `VARIANTS`.

    Raises:
        QuadrlError: The task, the vehicle, the variant or a setting in `Task.training`,
            `Task.training_with` or `Task.variants` is unknown.
    """
    kind = tasks.TASKS[choice("task", task, tasks.TASKS)]
    shared = VARIANTS[choice("variant", variant, VARIANTS)]
    own = merged(own_settings(kind, algo), shared, kind.variants.get(variant, {}))
    keys(f"training default of {task}", own, [name for name in base if name not in CHOSEN])
    values = merged(base, ALGORITHM_CONFIGS[algo].training, own)
    values |= {"task": task, "algo": algo}
    for name, config in ALGORITHM_CONFIGS.items():
        values[name] = config(**own.get(name, {}))
    aircraft = VEHICLES[choice("vehicle", vehicle, VEHICLES)]
    if variant == "robust" and vehicle == "paper":
        values["vehicle_options"] = {"action_scale": WIDE} | values["vehicle_options"]
    often = round(VEHICLES["paper"].control_timestep / aircraft.control_timestep, 9)
    if often != 1:
        values["gamma"] = round(values["gamma"] ** (1 / often), 4)
        values["rollout"] = max(1, round(values["rollout"] * often))
        values["steps"] = round(values["steps"] * often)
    return values


def own_settings(task: Task | type[Task], algo: str = "ppo") -> dict[str, Any]:
    """Settings that have other defaults with a task and an algorithm."""
    return merged(task.training, task.training_with.get(algo, {}))


def merged(*settings: dict[str, Any]) -> dict[str, Any]:
    """Settings with later ones in place of earlier ones; dicts are added to each other."""
    whole: dict[str, Any] = {}
    for given in settings:
        for name, value in given.items():
            old = whole.get(name)
            if isinstance(old, dict) and isinstance(value, dict):
                value = old | value
            whole[name] = value
    return whole
