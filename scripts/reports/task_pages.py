"""The pages of the tasks, from the code and from what was measured."""

from __future__ import annotations

import functools
from typing import Any

from quadrl import tasks
from quadrl.aircraft.vehicle import Vehicle
from quadrl.core.task import Task
from quadrl.evaluation.policy import SHIPPED
from quadrl.learning.defaults import own_settings, written
from quadrl.learning.description import describe, describe_action
from scripts.reports import measure, report, shipping
from scripts.reports.code import shown
from scripts.reports.report import Parts, table

PAGE = """{asks}

{facts}

```python
import gymnasium
import quadrl

{make}env = gymnasium.make("{id}"{given})
observation, info = env.reset(seed=0)
for _ in range(10):
    observation, reward, terminated, truncated, info = env.step({fly})
print(info["error"], info["reward_terms"])
```

## Action

{action}. Actions outside of [-1, 1] are clipped. With `control_mode=` the same task takes thrust
and body rates, velocities or positions, and with `vehicle=` another aircraft: see
[actions](actions.md) and [aircraft](aircraft.md).

## Observation

{observations}

The numbers have no bounds. dm_control gives the terms by name. World frame: x east, y north, z up;
body frame: x forward, y left, z up. The unit 1 means dimensionless.

## Reward

{rewards}

The reward is their sum. The weights are options: `survival_weight=5`, for example.
`info["reward_terms"]` has the terms of a step.

## Start

{starts} The options below change it; see also [uncertain aircraft](robustness.md).

## End

{ends}

## Options

{options}

## Training

`quadrl train {name}` trains with {own}the defaults that `quadrl train --help` lists. A training
counts as successful if the mean action meets these targets in {episodes} fresh episodes:

{reached}

[All trainings](results.md) names the machine and the commit.{curves}

## Policies

{policies}"""
SEEDS = "Median and range over the seeds of `scripts/report training`."
PAPER = "The three algorithms in [the paper's experiments](paper.md)."
PICTURES = {
    "curves/{name}.png": ("Return and success over the control steps", SEEDS),
    "paper/figure_[0-9]_{name}.png": ("Learning curves of three algorithms", PAPER),
}


def page(name: str) -> str:
    """Everything about a task, in the order of Gymnasium's pages."""
    task, vehicle = tasks.make(name), Vehicle()
    known = describe(task)
    limit, step = known["time_limit"], vehicle.control_timestep
    size = known["observation"][-1]["last"] + 1
    facts = [
        ("action space", f"`Box(-1.0, 1.0, ({vehicle.rotor_count},), float32)`"),
        ("observation space", f"`Box(-inf, inf, ({size},), float32)`"),
        ("time limit", f"{limit:g} s: {round(limit / step)} control steps of {step:g} s"),
        ("source", f"[tasks/{name}.py](../tasks/{name}.py)"),
    ]
    fast = "or flies faster than the physics step resolves (`diverged`)"
    ends = [
        ("terminated", f"{known['ends']}; {fast}"),
        ("truncated", f"{limit:g} s are over; never together with terminated"),
        ("`is_success`", known["solved"]),
    ]
    rewards = [
        (f"`{x['name']}`", "" if x["weight"] is None else f"{x['weight']:g}", line(x["meaning"]))
        for x in known["reward"]
    ]
    usual = {"name": "time_limit", "value": limit, "meaning": "Time limit of an episode [s]"}
    options = [
        (f"`{x['name']}`", f"`{shown(x['value'])}`", line(x["meaning"]))
        for x in (usual, *known["options"])
    ]
    own = " ".join(f"`{setting}`" for setting in written(own_settings(task)))
    other = "vehicle_options" in task.training  # its policy flies no other aircraft
    flies = (SHIPPED / f"{name}_{task.trained_by}.safetensors").exists()
    moving = f"![A flight of a policy that comes with quadrl](images/tasks/{name}.webp)\n\n"
    drawn = (report.IMAGES / "tasks" / f"{name}.webp").exists()
    return moving * drawn + PAGE.format(
        name=name,
        id=task.gymnasium_id(),
        make=f'policy = quadrl.Policy.pretrained("{name}")\n' if flies else "",
        given=", **policy.keywords" if flies and (other or task.trained_on != "paper") else "",
        fly="policy(observation)" if flies else "env.action_space.sample()",
        asks=line(known["asks"]),
        facts=table(("property", "value"), facts),
        action=describe_action(vehicle),
        observations=observations(task, known),
        rewards=table(("term", "weight", "meaning"), rewards),
        starts=line(known["starts"]),
        ends=table(("end", "when"), ends),
        options=table(("option", "default", "meaning"), options),
        own=f"{own} and otherwise " if own else "",
        episodes=measure.EPISODES,
        reached=measure.reached_table(name),
        curves="".join(
            f"\n\n![{about}](images/{picture.relative_to(report.IMAGES)})\n\n*{words}*"
            for pattern, (about, words) in PICTURES.items()
            for picture in report.IMAGES.glob(pattern.format(name=name))
        ),
        policies=shipping.policies(name),
    )


def observations(task: Task, known: dict[str, Any]) -> str:
    """Every term of the observation, with the numbers of its entries."""
    rows = []
    for term in known["observation"]:
        first, last, name = term["first"], term["last"], term["name"]
        count = last - first + 1
        entries = f"1 to {count}" if count > 1 else ""
        if name in task.observation and task.observation[name].per_rotor:  # else of a sensor
            entries = f"rotors {entries}"
        elif count == 3:
            entries = "roll, pitch, yaw" if name.endswith("attitude") else "x, y, z"
        numbers = f"{first} to {last}" if count > 1 else first
        rows.append((numbers, f"`{name}`", entries, term["unit"], term["meaning"]))
    return table(("numbers", "term", "entries", "unit", "meaning and frame"), rows)


def line(text: str) -> str:
    """With a capital and a full stop."""
    return f"{text[:1].upper()}{text[1:]}." if text else ""


PARTS: Parts = {f"task-{name}": functools.partial(page, name) for name in tasks.TASKS}
