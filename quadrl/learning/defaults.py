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

import json
import shlex
from collections.abc import Callable, Iterator
from typing import Any

from quadrl.aircraft.presets import VEHICLES
from quadrl.base.validation import IN_A_FILE, choice, keys
from quadrl.core import catalogue
from quadrl.core.scenario import GIVEN
from quadrl.core.task import Task
from quadrl.learning import foreign
from quadrl.learning.settings import ALGORITHM_CONFIGS
from quadrl.learning.train_settings import PAIRED, USUAL
from quadrl.learning.variants import OF_VEHICLE, VARIANTS, WITH_MEMORY
from quadrl.tasks import TASKS

ALGORITHMS = tuple(ALGORITHM_CONFIGS)
ALIASES = {"gae": "vpg"}
"""The paper calls the plain policy gradient by the name of its advantages."""
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


def algorithm_of(task: str, algo: str | None, variant: str | None = None) -> str:
    """Name the algorithm that trains a task: the given one or, if that is None, the task's own."""
    kind = TASKS.get(task, Task)
    if algo is None:
        algo = kind.variants.get(variant or "", {}).get("algo", kind.trained_by)
    return choice("algo", ALIASES.get(str(algo), algo), ALGORITHMS, known_as=foreign.ALGORITHMS)


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
