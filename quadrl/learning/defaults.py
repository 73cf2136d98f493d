"""Defaults of the settings of a training: three layers, each over the last.

1. field: the default of a field of `TrainConfig` or of an algorithm, with what that algorithm
   changes of the former (`AlgorithmConfig.training`).
2. task x algorithm: `Task.training`, and `Task.training_with` for the algorithm.
3. variant: `VARIANTS`, with the aircraft of `OF_VEHICLE`, and `Task.variants`.

A policy with a memory cannot have all of them: see `WITH_MEMORY`.

Every layer states the settings of `PER_STEP` for the control rate of the paper's aircraft. An
aircraft that is controlled more often looks as far ahead in seconds, collects as many seconds in a
batch, and trains for as many: `at_rate` reads a layer for it. A variant may have a rate of its own.
"""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Callable, Iterator
from typing import Any

from quadrl.aircraft.presets import VEHICLES
from quadrl.base.validation import IN_A_FILE, choice, keys
from quadrl.conditions.randomizations import RANDOMIZATIONS
from quadrl.core import catalogue
from quadrl.core.scenario import GIVEN
from quadrl.core.task import Task
from quadrl.learning.settings import ALGORITHM_CONFIGS, PAIRED, USUAL

CHOSEN = ("task", "algo", "seed", "vehicle", "variant")
"""Settings that the other defaults depend on, or that have no better default than another."""


def _discount(gamma: float, often: float) -> float:
    return round(gamma ** (1 / often), 4)


PER_STEP: dict[str, Callable[[Any, float], Any]] = {
    "gamma": _discount,
    "gammas": lambda gammas, often: tuple(_discount(gamma, often) for gamma in gammas),
    "rollout": lambda steps, often: max(1, round(steps * often)),
    "steps": lambda steps, often: round(steps * often),
}
"""Settings that count control steps, and their values at `often` times the control rate."""
VARIANTS: dict[str, dict[str, Any]] = {
    "ideal": {},
    "robust": {
        "weather": "light",
        "randomization": {
            "mass": (0.8, 1.2),
            "lag": (0.5, 2.2),
            "command_delay": (0.0, 0.06),
            # The strength of the effects of the air on the rotors is uncertain too; if it is always
            # full, policies learn to cope with late commands less well.
            "inflow": (0.01, 1.2),
            "drag": (0.5, 1.5),
            "noise": dataclasses.asdict(RANDOMIZATIONS["light"].noise),
            # Rotors differ, since nothing else in the training makes the aim necessary.
            "rotors": (0.96, 1.04),
            "centre_of_mass": 0.002,
        },
        # Commands arrive late: what was sent belongs to the state. Mass and wind show as
        # acceleration, and what they leave of the offset in its sum. No aircraft measures the
        # speeds of its rotors.
        "observe": {
            "action_history": 2,
            "disturbance": True,
            "rotor_speed": "estimated",
            "privileged": True,
            # The offset by a gust passes, and needs another answer than one that lasts. Smoothed
            # over more than a control step, the disturbance shows gusts too late.
            "sensors": {"aim": {"beside_goal": True}, "disturbance": {"smoothing": 0.02}},
        },
        "holds_goal": False,  # in wind an aircraft stays at the goal only with a tilt
        # The critic sees the gusts, so it judges an action better than many noisy steps do.
        "gae_lambda": 0.9,
        "gamma": 0.95,  # with a shorter horizon heavy aircraft begin to swing, and fall
        "ppo": {"learning_rate": 3e-3, "beta2": 0.999},
        "steps": 16_384_000,
        # A lasting error costs only (1 - gamma) of its weight: with the tasks' own weights these
        # policies spin, head wrong with another mass, and stay off the goal in wind. Without
        # smoothness_weight actions jump between their limits on aircraft with quick rotors.
        "task_options": {
            "spin_weight": 10.0,
            "attitude_weight": 75.0,
            "progress_weight": 300.0,
            "smoothness_weight": 10.0,
        },
    },
    "raptor": {
        "vehicle": "racer",  # motors as PX4 has them, which the paper's aircraft has not
        "control_mode": "share",
        "vehicle_options": {"control_timestep": 0.01},
        "weather": {"wind_speed": 1.0},
        "randomization": {
            "mass": (0.8, 1.2),
            "lag": (0.7, 1.5),
            "command_delay": (0.0, 0.025),
            "drag": (0.5, 1.5),
            "noise": dataclasses.asdict(RANDOMIZATIONS["light"].noise),
            "rotors": (0.99, 1.01),
        },
        "observe": {
            "action_history": 1,
            "rotation": True,
            "rotor_speed": "none",
            "privileged": True,
            "sensors": {"offset": {}},
        },
        "memory": "raptor",
        "memory_width": 16,
        "hidden": (),
        "initial_deviation": 0.2,
        "num_envs": 512,
        "rollout": 6.4,
        "gae_lambda": 0.97,
        "gamma": 0.95,
        "ppo": {"learning_rate": 2e-3, "beta2": 0.999, "minibatch": 4096},
        "steps": 1_000_000,
        "task_options": {
            "spin_weight": 10.0,
            "attitude_weight": 75.0,
            "progress_weight": 300.0,
            "smoothness_weight": 10.0,
        },
    },
    "any": {
        "vehicle": "racer",  # its layout; all else is drawn
        "control_mode": "share_of_x",
        "vehicle_options": {"control_timestep": 0.02},
        "weather": {"wind_speed": 1.0},
        "randomization": {
            "sizes": {
                "mass": (0.025, 2.0),
                "thrust_to_weight": (1.5, 5.0),
                "angular_acceleration": (100.0, 900.0),
                "lag": (0.02, 0.2),
            },
            "torque": (0.5, 1.6),  # yaw, beside roll and pitch
            "inertia_axes": (0.85, 1.18),
            "command_delay": (0.0, 0.03),  # 20 ms, and the dead time of the aircraft
            "drag": (0.0, 2.0),
            "inflow": (0.01, 1.2),
            "flapping": (0.0, 1.5),
            "rotors": (0.98, 1.02),
            "noise": dataclasses.asdict(RANDOMIZATIONS["light"].noise),
        },
        "observe": {"action_history": 2, "rotor_speed": "none", "sensors": {"level": {}}},
        "memory": "gru",
        "holds_goal": False,  # where hover is, it has to find out
        "hidden": (64,),
        "steps": 1_638_400,
    },
}
"""Settings that go together."""
WIDE = 90.0
"""Action scale of the paper's aircraft in the variant robust [rad/s]: with its own, 35, the rotors
lift at most 1.33 times the specified weight, too little for one that is 20 % heavier in wind."""
_SMALL: dict[str, Any] = {
    "weather": {"wind_speed": 2.0},  # in light weather, 7.7 m/s, they do not learn to stay up
    "randomization": {
        "lag": (0.5, 2.0),
        "command_delay": (0.0, 0.04),
        "centre_of_mass": 0.0005,
        # Other simulators leave it out, and a policy that leans on it circles or falls there.
        "flapping": (0.0, 1.2),
    },
    "observe": {"action_history": 4},  # as many as can be on their way at their control rate
    # The wider layer of hover and random_waypoint has not been tried with this wind.
    "hidden": (128,),
    "task_options": {"spin_weight": 10.0},
    "steps": 3_276_800,  # hover circles after twice as many
}
OF_VEHICLE: dict[tuple[str, str], dict[str, Any]] = {
    ("robust", "paper"): {"vehicle_options": {"action_scale": WIDE}},
    # rotorpy's own has 5.8 times the torque, and does not stand 20 ms without that drawn.
    ("robust", "crazyflie"): {
        **_SMALL,
        "randomization": {**_SMALL["randomization"], "torque": (0.7, 6.5)},
    },
    ("robust", "crazyflie_brushless"): _SMALL,
}
"""Settings of a variant for one aircraft."""
WITH_MEMORY: dict[str, Any] = {
    "holds_goal": False,  # the state of the memory differs at the goal
    "ppo": {"fused": False},
}
"""Settings of a policy with a memory, over all layers."""


def usual_vehicle(task: type[Task], variant: str | None) -> str:
    """The aircraft that a variant of a task is trained on if none is named."""
    return VARIANTS.get(variant or "", {}).get("vehicle", task.trained_on)


def training_defaults(
    task: str, algo: str, vehicle: str, variant: str, memory: str | None = None
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the defaults of the fields of `TrainConfig`, and the layer of each.

    Args:
        task: Name of the task.
        algo: Name of the algorithm.
        vehicle: Name of the aircraft.
        variant: A name of `VARIANTS`.
        memory: Memory of the policy; None for that of the layers.

    Returns:
        The values, those of an algorithm as a dict; and the label of the layer by the name of the
        setting, as in `flat`.

    Raises:
        QuadrlError: The task, the vehicle, the variant or a setting in `Task.training`,
            `Task.training_with` or `Task.variants` is unknown.
    """
    kind = catalogue.kind(task)
    shared = VARIANTS[choice("variant", variant, VARIANTS)]
    choice("vehicle", vehicle, VEHICLES, IN_A_FILE)
    check_stated(kind)
    fields, own = merged(USUAL), _unusual(kind, algo)
    if own.get("vehicle", "paper") != vehicle:  # the numbers of another aircraft
        own.pop("vehicle_options", None)
    task_own, its = kind.variants.get(variant, {}), OF_VEHICLE.get((variant, vehicle), {})
    # What a task states is for the aircraft that it is trained on.
    varied = (shared, its, task_own) if vehicle == kind.trained_on else (shared, task_own, its)
    layers = {
        "field": merged(fields, ALGORITHM_CONFIGS[algo].training),
        f"{task} x {algo}": own,
        f"variant {variant}": merged(*varied),
    }
    if (memory or merged(*layers.values())["memory"]) != "none":
        layers["memory"] = WITH_MEMORY
    options = merged(*layers.values()).get("vehicle_options", {})
    timestep = options.get("control_timestep", VEHICLES[vehicle].control_timestep)
    values: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for label, layer in layers.items():
        read = at_rate(layer, timestep)
        values = merged(values, read)
        sources |= {
            name: label if layer.get(name) == read.get(name) else f"{label}, at its control rate"
            for name, _ in flat(read)
        }
    # What other algorithms are tuned to does nothing.
    values |= {name: fields[name] for name in ALGORITHM_CONFIGS if name != algo}
    return values, sources


def check_stated(task: type[Task]) -> None:
    """Refuse an unknown setting in `Task.training`, `Task.training_with` or `Task.variants`.

    Raises:
        QuadrlError: The message lists the settings.
    """
    stated = merged(task.training, *task.training_with.values())
    known = [name for name in USUAL if name not in CHOSEN]
    keys(f"training default of {task.name}", stated, known)
    varied = merged(*task.variants.values())
    keys(f"training default of {task.name}", varied, [*known, "algo"])


def at_rate(layer: dict[str, Any], timestep: float) -> dict[str, Any]:
    """Convert a layer's settings to a control timestep [s]: the same times in seconds."""
    often = round(VEHICLES["paper"].control_timestep / timestep, 9)
    if often == 1:
        return layer
    return layer | {name: PER_STEP[name](layer[name], often) for name in PER_STEP if name in layer}


def own_settings(task: Task | type[Task]) -> dict[str, Any]:
    """Return the settings that have other defaults with a task and its own algorithm.

    They are as `quadrl train` takes them, at the control rate of the aircraft that the task is
    trained on.
    """
    timestep = VEHICLES[task.trained_on].control_timestep
    return at_rate(_unusual(task, task.trained_by), timestep)


def _unusual(task: Task | type[Task], algo: str) -> dict[str, Any]:
    """Return the same with any algorithm, at the control rate of the paper's aircraft."""
    chosen = {"vehicle": task.trained_on, "algo": task.trained_by}
    unusual = {name: own for name, own in chosen.items() if own != USUAL[name]}
    return merged(unusual, task.training, task.training_with.get(algo, {}))


def merged(*settings: dict[str, Any]) -> dict[str, Any]:
    """Merge settings: later ones replace earlier ones; dicts are merged, at every depth.

    None takes away what an earlier one has, such as a sensor of a variant.
    """
    whole: dict[str, Any] = {}
    for given in settings:
        for name, value in given.items():
            old = whole.get(name)
            if value is None and old is not None:
                del whole[name]
                continue
            if isinstance(old, dict) and isinstance(value, dict):
                value = merged(old, value)
            whole[name] = value
    return whole


def flat(settings: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Iterate over nested settings by names as `ppo.learning_rate`; an empty dict is a value."""
    for name, value in settings.items():
        if isinstance(value, dict) and value:
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def written(values: dict[str, Any], prefix: str = "--") -> Iterator[str]:
    """Nested settings as `quadrl train` takes them."""
    for name, value in values.items():
        word = prefix + name.replace("_", "-")
        if name in PAIRED:
            yield " ".join((word, *(_pair(option, given) for option, given in value.items())))
        elif isinstance(value, dict) and GIVEN.get(name, {}).get("given") == "json":
            yield f"{word} '{json.dumps(value)}'"
        elif isinstance(value, dict):
            yield from written(value, f"{word}.")
        elif isinstance(value, bool):
            yield prefix + "no-" * (not value) + word.removeprefix(prefix)
        elif name == "phases":
            yield f"{word} {shlex.quote(json.dumps(value))}"
        elif isinstance(value, tuple | list):
            yield " ".join((word, *map(str, value)))
        else:
            yield f"{word} {value}"


def _pair(option: str, value: Any) -> str:
    """NAME=VALUE as the command reads it: a text as it is, anything else as JSON."""
    return shlex.quote(f"{option}={value if isinstance(value, str) else json.dumps(value)}")
