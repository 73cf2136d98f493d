"""Evaluate a policy or a controller in episodes that no training has seen."""

from __future__ import annotations

import csv
import dataclasses
import html
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from quadrl import tasks
from quadrl.aircraft.aerodynamics import Aerodynamics
from quadrl.aircraft.presets import resolve, with_effects
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.files import write_whole
from quadrl.base.validation import number
from quadrl.conditions.observing import Observed
from quadrl.conditions.randomization import Randomized
from quadrl.conditions.weather import Weathered
from quadrl.control import CONTROLLERS
from quadrl.control.feasibility import warn_of_unreached
from quadrl.core.snapshot import Rollout
from quadrl.core.task import Task
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.policy import Policy, shipped
from quadrl.evaluation.rollout import (
    EVALUATION_SEED,
    MAX_EPISODES,
    MAX_SEED,
    Controller,
    flights,
    fly,
    summarize,
)

SAMPLING_SEED = 0  # of the actions drawn from a policy


@dataclasses.dataclass(frozen=True, repr=False)
class Evaluation:
    """What a policy or a controller reached over some episodes; a table in a notebook."""

    name: str
    """What flew."""
    task: Task
    vehicle: Vehicle
    seed: int
    """Of the episodes."""
    metrics: dict[str, Any]
    """Names of task and vehicle, the seed, and what `quadrl.evaluation.rollout.summarize` gives."""
    rollout: Rollout
    """The flights, step by step."""

    def __repr__(self) -> str:
        found = self.metrics
        return (
            f"{self.name} on {self.task.name}, {found['episodes']} episodes: "
            f"{100 * found['survival_rate']:.0f} % to the end, "
            f"{100 * found['success_rate']:.0f} % successful, error over the last 2 s "
            f"{100 * found['position_error_m']:.1f} cm"
        )

    def _repr_html_(self) -> str:
        rows = [("", self.name), *((name, shown(x)) for name, x in self.metrics.items())]
        return html_table(rows)

    def save_csv(self, path: str | Path) -> Path:
        """Write one row per flight: its seed and what `quadrl.evaluation.rollout.flights` gives."""
        columns = flights(self.rollout)
        text = io.StringIO(newline="")
        writer = csv.writer(text)
        writer.writerow(["episode", "seed", *columns])
        for i, row in enumerate(
            zip(*(column.tolist() for column in columns.values()), strict=True)
        ):
            cells = (f"{x:.6g}" if isinstance(x, float) else int(x) for x in row)
            writer.writerow([i, self.seed + i, *cells])
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text.getvalue().encode())
        return path


def evaluate(
    controller: Any,
    task: str | Task | None = None,
    *,
    episodes: int = 100,
    seed: int = 0,
    vehicle: Vehicle | str | None = None,
    aerodynamics: str | Aerodynamics | None = None,
    weather: Weathered = None,
    sampled: bool = False,
    randomization: Randomized = None,
    observe: Observed = None,
    **task_options: Any,
) -> Evaluation:
    """Fly a policy or a controller through episodes that no training has seen, in MuJoCo.

    Args:
        controller: What flies, as `setting` takes it.
        task: A task or its name; by default the one that the policy was trained for.
        episodes: Their number.
        seed: Of the episodes; the same ones for every controller.
        vehicle: The aircraft or its name; by default the one that the policy was trained with.
        aerodynamics: Effects of the air, as `quadrl.aircraft.presets.with_effects` takes them; by
            default those of the training.
        weather: A `Weather` or its name, one of `conditions.weather.WEATHERS`; by default that of
            the training.
        sampled: Whether to draw the actions of a policy, as in training, instead of their mean.
        randomization: What is drawn for each flight and disturbs it: a name of
            `quadrl.RANDOMIZATIONS` or a `quadrl.Randomization`; by default that of the training.
        observe: Options of the observation, for a function; a policy knows its own.
        **task_options: Options of the task that differ from the training's.

    Raises:
        QuadrlError: Something is unknown, out of range, or does not fit together.
    """
    seed = number("seed", seed, 0, MAX_SEED, whole=True)
    number("episodes", episodes, 1, MAX_EPISODES, whole=True)
    name, flown, task, vehicle = setting(
        controller, task, vehicle, task_options, aerodynamics=aerodynamics
    )
    if sampled:
        if not isinstance(flown, Policy):
            raise QuadrlError(name="sampled", value=True, allowed="False for a controller")
        flown = flown.flying(episodes, SAMPLING_SEED)
    own = getattr(flown, "conditions", {}).get("randomization")
    warn_of_unreached(vehicle, own if randomization is None else randomization)
    chosen: Any = {"episodes": episodes, "vehicle": vehicle, "weather": weather}
    chosen |= {"randomization": randomization, "observe": observe}
    rollout = fly(flown, task, seed=EVALUATION_SEED + seed, **chosen)
    metrics = {"task": task.name, "vehicle": vehicle.name, "seed": seed} | summarize(rollout)
    return Evaluation(name, task, vehicle, seed, metrics, rollout)


def setting(
    controller: Any,
    task: str | Task | None = None,
    vehicle: Vehicle | str | None = None,
    task_options: Mapping[str, Any] | None = None,
    algo: str = "ppo",
    aerodynamics: str | Aerodynamics | None = None,
) -> tuple[str, Controller, Task, Vehicle]:
    """What flies, what it flies, and with which aircraft.

    Args:
        controller: A `Policy`; what `quadrl.train` returned; a run folder or a .safetensors file;
            the name of a task, for the policy for it that comes with quadrl, or of such a policy
            (hover_robust); "geometric" or "lqr";
            or any function of flat observations (N, size) that gives actions (N, k).
        task: A task or its name; None for what the policy was trained for, hover for a controller.
        vehicle: The aircraft or its name; None for the policy's, the paper's for a controller.
        task_options: Options of the task that differ from the training's.
        algo: Which of the policies that come with quadrl.
        aerodynamics: Effects of the air on the aircraft; None for those that a policy was trained
            with, unless the aircraft is a Vehicle.

    Returns:
        A name for what flies, a function of observations, the task and the aircraft.

    Raises:
        QuadrlError: Something is unknown or missing.
    """
    options = dict(task_options or {})
    flown: Any = getattr(controller, "policy", controller)
    if isinstance(flown, str) and flown in CONTROLLERS:
        vehicle = with_effects(resolve(vehicle), aerodynamics)
        task = tasks.make(task or "hover", **options)
        return f"{flown} controller", make_controller(flown, task, vehicle), task, vehicle
    name = "policy" if isinstance(flown, Policy) else getattr(flown, "__name__", "controller")
    if isinstance(flown, (str, Path)):
        shipped = isinstance(flown, str) and comes_with_quadrl(flown)
        name, path = str(flown), flown
        flown = Policy.pretrained(str(path), algo) if shipped else Policy.load(path)
    if isinstance(flown, Policy):
        own = flown.metadata
        if task is None or task == flown.task:
            task, options = flown.task, own.get("task_options", {}) | options
        if vehicle is None or vehicle == own.get("vehicle"):
            vehicle, aerodynamics = flown.make_vehicle(aerodynamics), None
        elif aerodynamics is None and not isinstance(vehicle, Vehicle):
            aerodynamics = own.get("aerodynamics")
    elif not callable(flown):
        allowed = "a policy, a run, a path, the name of a task or a controller, or a function"
        raise QuadrlError(name="controller", value=flown, allowed=allowed)
    elif task is None:
        raise QuadrlError(name="task", value=None, allowed="given, for a function")
    vehicle = with_effects(resolve(vehicle), aerodynamics)
    return name, cast(Any, flown), tasks.make(task, **options), vehicle


def comes_with_quadrl(name: str) -> bool:
    """Whether a name is that of a task, or of a policy that comes with quadrl."""
    return name in tasks.TASKS or name in {file.stem for file in shipped()}


def html_table(rows: list[tuple[str, ...]]) -> str:
    """Rows of text as a table of a notebook; the first row is its head."""

    def line(cells: tuple[str, ...], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    body = "".join(line(row, "td") for row in rows[1:])
    return f"<table><thead>{line(rows[0], 'th')}</thead><tbody>{body}</tbody></table>"


def shown(value: object) -> str:
    """A metric as text."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
