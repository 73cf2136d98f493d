"""The pages of the tasks, from the code and from what was measured."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from quadrl import tasks
from quadrl.aircraft.vehicle import Vehicle
from quadrl.cli.tasks import settings
from quadrl.core.task import Task
from quadrl.evaluation.policy import SHIPPED
from quadrl.learning.defaults import own_settings
from quadrl.learning.description import describe
from scripts.reports import report, training
from scripts.reports.report import Parts, asked, factor, number, table

ATTITUDE = ("roll", "pitch", "yaw")
AXES = ("x", "y", "z")


def page(name: str) -> str:
    """Everything about a task, in the order of Gymnasium's pages."""
    task = tasks.make(name)
    told, vehicle = describe(task), Vehicle()
    sections = {
        "Action": actions(vehicle),
        "Observation": observations(task, told),
        "Reward": rewards(told),
        "Start": f"{sentence(told['starts'])} The options below change it; see also "
        "[uncertain aircraft](robustness.md).",
        "End": ends(told, vehicle),
        "Options": options(told),
        "Training": trained(name, task),
        "Policies": policies(name, task),
    }
    parts = [opening(name, told, vehicle)]
    return "\n\n".join([*parts, *(f"## {head}\n\n{text}" for head, text in sections.items())])


def opening(name: str, told: dict[str, Any], vehicle: Vehicle) -> str:
    """The picture, what it is about, and how to make it."""
    camel = "".join(word.capitalize() for word in name.split("_"))
    steps = round(told["time_limit"] / vehicle.control_timestep)
    size = told["observation"][-1]["last"] + 1
    rows = [
        ("action space", f"`Box(-1.0, 1.0, ({vehicle.rotor_count},), float32)`"),
        ("observation space", f"`Box(-inf, inf, ({size},), float32)`"),
        ("time limit", f"{told['time_limit']:g} s: {steps} control steps of "
         f"{vehicle.control_timestep:g} s"),
        ("Gymnasium", f'`gymnasium.make("quadrl/{camel}-v0")`, `gymnasium.make_vec(...)`'),
        ("dm_control", f'`quadrl.load("{name}")`'),
        ("TorchRL", f'`QuadrotorEnv("{name}", num_envs=1024)`'),
        ("source", f"[tasks/{name}.py](../tasks/{name}.py)"),
    ]  # fmt: skip
    text = f"{sentence(told['asks'])}\n\n{table(('property', 'value'), rows)}"
    if (report.IMAGES / "tasks" / f"{name}.jpg").exists():
        text = f"![Four moments of a flight](images/tasks/{name}.jpg)\n\n{text}"
    fly, make = "env.action_space.sample()", ""
    if (SHIPPED / f"{name}_ppo.safetensors").exists():
        fly, make = "policy(observation)", f'policy = quadrl.Policy.pretrained("{name}")\n'
    return f"""{text}

```python
import gymnasium
import quadrl

env = gymnasium.make("quadrl/{camel}-v0")
{make}observation, info = env.reset(seed=0)
for _ in range(10):
    observation, reward, terminated, truncated, info = env.step({fly})
print(info["error"], info["reward_terms"])
```"""


def actions(vehicle: Vehicle) -> str:
    """The entries of the action."""
    limits = [vehicle.rotor_command(np.full((1, vehicle.rotor_count), x))[0] for x in (-1, 0, 1)]
    rows = [
        (k, f"speed command of rotor {k + 1}", ", ".join(f"{x:g}" for x in rotor.position[:2]),
         *(f"{limit[k]:.1f}" for limit in limits))
        for k, rotor in enumerate(vehicle.rotors)
    ]  # fmt: skip
    head = ("number", "sets", "rotor at x, y [m]", "at -1 [rad/s]", "at 0 (hover)", "at 1")
    return (
        f"{table(head, rows)}\n\nActions outside of [-1, 1] are clipped. With `control_mode=` the "
        "same task takes thrust and body rates, velocities or positions, and with `vehicle=` "
        "another aircraft: see [actions](actions.md) and [aircraft](aircraft.md)."
    )


def observations(task: Task, told: dict[str, Any]) -> str:
    """Every entry of the observation."""
    rows = []
    for term in told["observation"]:
        name, count = term["name"], term["last"] - term["first"] + 1
        if task.observation[name].per_rotor:
            entries = tuple(f"rotor {k + 1}" for k in range(count))
        elif count == len(AXES):
            entries = ATTITUDE if name.endswith("attitude") else AXES
        else:
            entries = tuple(map(str, range(1, count + 1)))
        for k, entry in enumerate(entries):
            meaning = term["meaning"] if k == 0 else ""
            rows.append((term["first"] + k, f"`{name}`", entry, term["unit"], meaning))
    return table(("number", "term", "entry", "unit", "meaning and frame"), rows) + (
        "\n\nThe numbers have no bounds. dm_control gives the terms by name. World frame: x east, "
        "y north, z up; body frame: x forward, y left, z up. The unit 1 is none."
    )


def rewards(told: dict[str, Any]) -> str:
    """Every term of the reward."""
    rows = [
        (
            f"`{x['name']}`",
            "" if x["weight"] is None else f"{x['weight']:g}",
            sentence(x["meaning"]),
        )
        for x in told["reward"]
    ]
    return table(("term", "weight", "meaning"), rows) + (
        "\n\nThe reward is their sum. The weights are options: `survival_weight=5`, for example. "
        '`info["reward_terms"]` has the terms of a step.'
    )


def ends(told: dict[str, Any], vehicle: Vehicle) -> str:
    """What ends an episode, and what is success."""
    rows = [
        ("terminated", f"{told['ends']}; or flies faster than the physics step resolves "
         "(`diverged`)"),
        ("truncated", f"{told['time_limit']:g} s are over; never together with terminated"),
        ("`is_success`", told["solved"]),
    ]  # fmt: skip
    return table(("end", "when"), rows)


def options(told: dict[str, Any]) -> str:
    """The options other than the weights of the reward."""
    limit = {"name": "time_limit", "value": told["time_limit"], "meaning": "Of an episode [s]"}
    rows = [
        (f"`{x['name']}`", shown(x["value"]), sentence(x["meaning"]))
        for x in (limit, *told["options"])
    ]
    return table(("option", "default", "meaning"), rows)


def trained(name: str, task: Task) -> str:
    """Settings, what a policy must reach and what trainings reach, and their curves."""
    own = " ".join(f"`{setting}`" for setting in settings(own_settings(task)))
    text = (
        f"`quadrl train {name}` trains with "
        + (f"{own} and otherwise " if own else "")
        + "the [default settings](settings.md). A training counts as successful when the mean "
        f"action reaches this in {training.EPISODES} fresh episodes:"
    )
    try:
        rows, seeds = training.reached(report.load("training"), name)
        head = ("figure", "asked", *(f"seed {seed}" for seed in seeds), "geometric controller")
        text += (
            f"\n\n{table(head, rows)}\n\n[All trainings](results.md) says where this was measured."
        )
    except FileNotFoundError:
        rows = [(target.words, asked(target)) for target in task.targets]
        text += f"\n\n{table(('figure', 'asked'), rows)}"
    return "\n\n".join([text, *curves(name)])


def curves(name: str) -> Iterator[str]:
    """The curves that have been drawn."""
    try:
        drawn = report.load("curves")["tasks"].get(name, {})
    except FileNotFoundError:
        drawn = {}
    if drawn:
        seeds = "; ".join(
            f"{algo.upper()}, seeds {', '.join(map(str, drawn[algo]))}" for algo in drawn
        )
        yield f"![Return and success over the control steps](images/curves/{name}.png)"
        yield f"*Median and range over the seeds ({seeds}; `scripts/report curves`).*"
    for picture in (report.IMAGES / "paper").glob(f"figure_[0-9]_{name}.png"):
        yield f"![Learning curves of three algorithms](images/paper/{picture.name})"
        yield "*The three algorithms in [the paper's experiments](paper.md).*"


def policies(name: str, task: Task) -> str:
    """The policies that ship."""
    rows, episodes = [], set()
    for file in sorted(SHIPPED.glob(f"{name}_*.json")):
        beside, algo = json.loads(file.read_text()), file.stem.removeprefix(f"{name}_")
        measured = beside["evaluation"]
        episodes.add(measured["episodes"])
        reached = (f"{number(factor(x) * measured[x.metric])} {x.unit}" for x in task.targets)
        rows.append((f"`{algo}`", f"`{beside['command']}`", *reached))
    if not rows:
        return "None comes with quadrl."
    head = ("algo", "made by", *(target.words for target in task.targets))
    flown = " and ".join(map(str, sorted(episodes)))
    return (
        f'`quadrl.Policy.pretrained("{name}", algo="ppo")` and `quadrl render {name}` fly them. '
        f"The mean action reaches, in {flown} fresh episodes:\n\n{table(head, rows)}\n\n"
        "A policy is a safetensors file, with a .json of all its settings beside it, in "
        "`quadrl/assets/policies`."
    )


def sentence(text: str) -> str:
    """With a capital and a full stop."""
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def shown(value: Any) -> str:
    """The default of an option."""
    if value is None:
        return ""
    return f"{value:g}" if isinstance(value, float) else f"`{value}`"


PARTS: Parts = {f"task-{name}": functools.partial(page, name) for name in tasks.TASKS}
