"""Parts of the pages that come from the code itself: tasks, actions, observations, aircraft."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Iterable
from typing import Any

from quadrl import VEHICLES, cli, tasks
from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.cli.tasks import observation_rows, reward_rows, settings
from quadrl.control import CONTROL_MODES
from quadrl.learning.defaults import own_settings
from quadrl.learning.description import describe, describe_action
from scripts.reports.report import Parts, asked, table


def task_table(**columns: str) -> str:
    """Attributes of each task by the heads of the columns."""
    rows = (
        (f"[`{name}`](tasks/{name}.md)", *(shown(getattr(task, x)) for x in columns.values()))
        for name, task in tasks.TASKS.items()
    )
    return table(("task", *columns), rows)


def shown(value: str | float) -> str:
    """A text, or a number without zeros at its end."""
    return value if isinstance(value, str) else f"{value:g}"


def training_table() -> str:
    """What each task is trained with and what a policy must reach."""
    rows = []
    for name, task in tasks.TASKS.items():
        words = " ".join(f"`{setting}`" for setting in settings(own_settings(task)))
        targets = "; ".join(f"{target.words}: {asked(target)}" for target in task.targets)
        rows.append((f"`{name}`", words, targets))
    return table(("task", "settings other than the defaults", "counts as trained"), rows)


def control_modes() -> str:
    """What the control modes ask for, and how much of it on each aircraft."""
    rows = []
    for name, kind in CONTROL_MODES.items():
        modes = [kind(vehicle) for vehicle in VEHICLES.values()]
        terms = [(f"{term.name}: {term.meaning}", term.unit) for term in modes[0].terms]
        if not kind.has_loops:  # as many terms as rotors, and all alike
            terms = [("one number per rotor: its speed command, from hover", terms[0][1])]
        for k, term in enumerate(terms):
            scales = (f"{mode.scale[k]:.3g}" for mode in modes)
            rows.append((f"`{name}`" if k == 0 else "", *term, *scales))
    scales = (f"scale, {name}" for name in VEHICLES)
    return table(("`control_mode=`", "what it asks for", "unit", *scales), rows)


def observation() -> str:
    """The entries of the flat observation."""
    head = ("observation", "numbers", "unit", "meaning and frame")
    return table(head, coded(observation_rows(described())))


def reward() -> str:
    """The terms of the reward and their weights."""
    head = ("reward", "meaning", "weight", "where it differs")
    return table(head, coded(reward_rows(described())))


def described() -> list[dict[str, Any]]:
    """What `quadrl tasks` shows of each task."""
    return [describe(tasks.make(name)) for name in tasks.TASKS]


def coded(rows: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Rows with their names as code."""
    return [(f"`{name}`", *rest) for name, *rest in rows]


def vehicles() -> str:
    """The aircraft that come with quadrl."""
    rows = []
    for name, v in VEHICLES.items():
        thrust = sum(r.thrust_coefficient * r.max_speed**2 * r.axis[2] for r in v.rotors)
        cells = [f"`{name}`", f"{v.mass:g} kg", v.rotor_count, f"{v.size:.3g} m"]
        cells.append(f"{1 / v.rotors[0].lag_up:.3g} s, {1 / v.rotors[0].lag_down:.3g} s")
        cells.append(f"{thrust / (v.mass * GRAVITY):.2g}")
        rows.append([*cells, f"{v.physics_timestep:g} s, {v.control_timestep:g} s"])
    head = ["vehicle", "mass", "rotors", "arm", "time constants, up and down"]
    return table([*head, "thrust over weight", "physics and control step"], rows)


def commands() -> str:
    """The subcommands."""
    rows = []
    for kind in typing.get_args(cli.Command):
        text = (inspect.getdoc(typing.get_args(kind)[0]) or "").partition("\n")[0]
        rows.append((f"`quadrl {kind.__metadata__[0].name}`", text))
    return table(("command", "what it does"), rows)


TEXTS = {"asks": "asks", "starts": "starts", "ends early": "ends", "solved": "solved"}
PARTS: Parts = {
    "task-list": lambda: task_table(asks="asks", solved="solved"),
    "tasks": lambda: task_table(**TEXTS, **{"time limit [s]": "time_limit"}),
    "training-defaults": training_table,
    "action": lambda: f"{describe_action(Vehicle())}.",
    "control-modes": control_modes,
    "observation": observation,
    "reward": reward,
    "vehicles": vehicles,
    "commands": commands,
}
