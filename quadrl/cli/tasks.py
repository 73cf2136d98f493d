"""`quadrl tasks`."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

from rich.markup import escape
from tyro.conf import Positional

from quadrl.cli import choices
from quadrl.cli.console import console, make_table, print_json, say
from quadrl.learning.defaults import written
from quadrl.learning.description import describe
from quadrl.tasks import TASKS, make


@choices.command
class Tasks:
    """List the tasks, or describe one of them in full."""

    task: Positional[choices.TaskName] = ""
    """Name of a task, to describe it with its options; all tasks by default."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print goal, start, ends, observation, action and reward."""
        chosen = [self.task] if self.task else list(TASKS)
        described = [describe(make(name)) for name in chosen]
        if self.json:
            whole = {task["name"]: task for task in described}
            print_json(whole[self.task] if self.task else whole)
            return
        console.print(make_table([("task", "", ""), *_texts(described)]))
        head = ("observation", "numbers", "unit", "meaning and frame")
        console.print(make_table([head, *observation_rows(described)]))
        console.print(f"\n[bold]action[/bold]  {escape(described[0]['action'])}\n", highlight=False)
        head = ("reward", "meaning", "weight", "" if self.task else "where it differs")
        console.print(make_table([head, *reward_rows(described)]))
        if self.task:
            rows = [(o["name"], _text(o["value"]), o["meaning"]) for o in described[0]["options"]]
            console.print("", make_table([("option", "default", "meaning"), *rows]))
        else:
            say("\nquadrl tasks NAME shows the options of a task")


def _texts(described: list[dict[str, Any]]) -> Iterator[tuple[str, str, str]]:
    for task in described:
        yield task["name"], "asks", task["asks"]
        yield "", "start", task["starts"]
        yield "", "ends early", task["ends"]
        yield "", "solved", task["solved"]
        yield "", "time limit", f"{task['time_limit']:g} s"
        yield "", "trained with", ", ".join(written(task["training"])) or "the usual settings"
        yield "", "", ""


def observation_rows(described: list[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    """The terms of the flat observation by their numbers, and the tasks that have them there."""
    found: dict[str, list[dict[str, Any]]] = {}
    for task in described:
        for term in task["observation"]:
            others = found.setdefault(term["name"], [])
            others += [term] * (term not in others)
    for term in itertools.chain(*found.values()):
        having = [task["name"] for task in described if term in task["observation"]]
        rest = [task["name"] for task in described if task["name"] not in having]
        named = f"all but {', '.join(rest)}" if len(rest) < len(having) else ", ".join(having)
        where = f" (in {named})" if rest else ""
        numbers = f"{term['first']}..{term['last']}"
        yield term["name"], numbers, term["unit"], term["meaning"] + where


def reward_rows(described: list[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    """The terms of the reward, the weight that the first task has, and where another has one."""
    usual = {term["name"]: term["weight"] for term in described[0]["reward"]}
    found: dict[str, tuple[str, list[str]]] = {}
    for task in described:
        for term in task["reward"]:
            name, weight = term["name"], term["weight"]
            differs = found.setdefault(name, (term["meaning"], []))[1]
            if name not in usual or weight != usual[name]:
                differs.append(f"{task['name']} {_text(weight)}")
    for name, (meaning, differs) in found.items():
        yield name, meaning, _text(usual[name]) if name in usual else "", ", ".join(differs)


def _text(value: Any) -> str:
    if value is None:
        return "of the task"
    return f"{value:g}" if isinstance(value, float) else str(value)
