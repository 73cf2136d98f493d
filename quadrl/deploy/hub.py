"""A policy with its model card, in the form that model hubs show: a folder to upload."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadrl.base.errors import QuadrlError
from quadrl.base.units import length, percent
from quadrl.conditions.randomization import NONE
from quadrl.core.scenario import UNDISTURBED
from quadrl.deploy.crosscheck import crosscheck, fitting
from quadrl.deploy.simulators import there
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.policy_file import FILE
from quadrl.evaluation.robustness import robustness

Result = tuple[str, dict[str, Any]]
"""Conditions in words, and the figures of the flights in them."""
EPISODES = 100  # of each row of a card; none of them is of a training
FLOWN: dict[str, tuple[Mapping[str, Any], str]] = {
    "as trained": ({}, ""),
    "nothing disturbs it": (UNDISTURBED, " --weather calm --randomization none"),
    "commands 20 ms late": (
        {**UNDISTURBED, "randomization": {"command_delay": 0.02}},
        " --weather calm --randomization '{\"command_delay\": 0.02}'",
    ),
    "10 % heavier": (
        {**UNDISTURBED, "randomization": {"mass": 1.1}},
        " --weather calm --randomization '{\"mass\": 1.1}'",
    ),
}
"""Conditions of flight in a card, and the options of `quadrl evaluate` for them."""
CARD = """# {name}

A network that flies a quadrotor in simulation: {asks}. It was trained with
quadrl {quadrl}, and no aircraft is known to have flown it: every figure here is of a simulation.

## What it reaches

{episodes} flights each, made as this card was written:

{reached}

## What it withstands

Each disturbance alone, {episodes} flights a level; `quadrl robustness {file}` draws it.

{withstands}

## In simulators of others

{elsewhere}

## How it was trained

{trained}

| what was drawn in training | range or size |
| --- | --- |
{drawn}

**What is not in this table was the same in every episode of the training**, so nothing says what
the policy does where it differs: {same}.

## What it sees

{size} numbers every {milliseconds:g} ms, in this order, normalised within the network:

{sees}

## What it does

{does}

## Before an aircraft

- `quadrl export {file} --to c` (or `crazyflie`, `px4`) writes it for a board, and refuses if the
  policy sees what a board does not know.
- Your aircraft is not the one above: `quadrl identify LOG` measures how far it is off. Then test on
  the bench without propellers, then on a tether, with a switch that stops the motors in your hand.

```python
from quadrl import Policy

policy = Policy.load("{file}")
```
"""


def files(policy: Policy, metadata: Mapping[str, str]) -> dict[str, bytes]:
    """The files of the folder by their paths: the policy, and README.md, its card.

    Args:
        policy: The policy.
        metadata: As `quadrl.deploy.export.described` gives it.
    """
    own = policy.scenario
    made = (policy.metadata.get(key) for key in ("algo", "variant"))
    facts = [*filter(None, made), own.vehicle.name]
    name = "_".join([policy.task, *facts])
    results = _results(policy)
    header = {
        "library_name": "quadrl",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "robotics", "quadrotor", "mujoco", policy.task, *facts],
        "model-index": [{"name": name, "results": [_result(policy, *row) for row in results]}],
    }
    # JSON is YAML, too, and needs no library.
    front = "".join(f"{key}: {json.dumps(value)}\n" for key, value in header.items())
    text = f"---\n{front}---\n\n{card(policy, metadata, name, results)}"
    with tempfile.TemporaryDirectory() as folder:
        policy.save(kept := Path(folder) / FILE)
        return {"README.md": text.encode(), FILE: kept.read_bytes()}


def card(
    policy: Policy,
    metadata: Mapping[str, str],
    name: str,
    results: list[Result],
) -> str:
    """The text of a card."""
    own, about = policy.scenario, policy.metadata
    drawn = own.randomization.given()
    air = {k: v for k, v in vars(own.weather).items() if v and not own.weather.calm}
    rows = [f"| {k} | {_words(v)} |" for k, v in {**drawn, **air}.items()]
    same = [k for k in vars(NONE) if k not in drawn]
    layers = "-".join(str(x) for x in (policy.size, *(len(bias) for bias in policy.biases)))
    memory = f", a memory of {policy.state_size}" if policy.memory else ""
    trained = (
        f"Task `{policy.task}`, aircraft `{own.vehicle.name}` ({1000 * own.vehicle.mass:.4g} g), "
        f"algorithm {about.get('algo', 'unknown')}, variant {about.get('variant', 'ideal')}, seed "
        f"{about.get('seed', 'unknown')}, {about.get('steps', 0):,} control steps when it was "
        f"kept. Layers {layers}{memory}; the last holds means and log-variances. All settings are "
        f"in `{FILE}`."
    )
    reached: list[tuple[str, ...]] = [
        ("flown", "successful", "to the end", "error over the last 2 s", "command")
    ]
    for words, got in results:
        command = f"`quadrl evaluate {FILE} --episodes {EPISODES}{FLOWN[words][1]}`"
        shares = percent(got["success_rate"]), percent(got["survival_rate"])
        reached.append((words, *shares, length(got["position_error_m"]), command))
    sees: list[tuple[str, ...]] = [("numbers", "entry", "unit", "meaning")]
    for one in json.loads(metadata["observation"]):
        sees.append((f"{one['first']} to {one['last']}", one["name"], one["unit"], one["meaning"]))
    does: list[tuple[str, ...]] = [("number", "unit", "meaning", "at -1", "at 0", "at 1")]
    for one in json.loads(metadata["action"]):
        ends = (one["at_0"] + change for change in (one["change_down"], 0.0, one["change"]))
        does.append((one["name"], one["unit"], one["meaning"], *(f"{x:.4g}" for x in ends)))
    withstands = robustness(policy, episodes=EPISODES, recovery=False, progress=False)
    return CARD.format(
        name=name, asks=own.task.asks, quadrl=json.loads(metadata["quadrl"]), episodes=EPISODES,
        reached=_rows(reached), withstands=_rows(withstands.table), elsewhere=_elsewhere(policy),
        trained=trained, drawn="\n".join(rows) or "| nothing | |", same=", ".join(same),
        size=policy.size, sees=_rows(sees), does=_rows(does), file=FILE,
        milliseconds=1000 * own.vehicle.control_timestep,
    )  # fmt: skip


def _results(policy: Policy) -> list[Result]:
    """Fly it in each of the conditions; where its training had none, not twice in the same."""
    rows = [*FLOWN.items()][policy.scenario.randomization == NONE :]
    return [(words, evaluate(policy, episodes=EPISODES, **how).metrics) for words, (how, _) in rows]


def _elsewhere(policy: Policy) -> str:
    """What it reaches in the simulators that are installed here, or why it was not flown."""
    here = [name for name in fitting(policy) if there(name)]
    try:
        if not here:
            raise QuadrlError(f"not installed; `quadrl crosscheck {FILE}` does it, and flies there")
        found = crosscheck(policy, simulators=here)
    except QuadrlError as error:
        return f"It was not flown there: {error}."
    rows: list[tuple[str, ...]] = [("flown in", "aircraft", "late", "successful", "error", "fell")]
    for row in found.rows:
        reached = percent(row.success_rate), length(row.position_error_m), percent(row.fall_rate)
        rows.append((row.flown_in, row.aircraft, f"{1000 * row.delay:g} ms", *reached))
    return _rows(rows)


def _rows(rows: Sequence[Sequence[str]]) -> str:
    """A table; the first row is its head."""
    lines = [" | ".join(row) for row in (rows[0], ["---"] * len(rows[0]), *rows[1:])]
    return "\n".join(f"| {line} |" for line in lines)


def _result(policy: Policy, words: str, got: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the index that hubs read."""
    task = {"type": "reinforcement-learning", "name": words}
    flown = {"type": f"quadrl/{policy.task}", "name": f"{policy.task}, {words}"}
    metrics = [{"type": key, "value": got[key]} for key in ("success_rate", "position_error_m")]
    return {"task": task, "dataset": flown, "metrics": metrics}


def _words(value: Any) -> str:
    """A range, a size, or several by name."""
    if isinstance(value, dict):
        return ", ".join(f"{k} {x:g}" for k, x in value.items() if x)
    return " to ".join(f"{x:g}" for x in value) if isinstance(value, (list, tuple)) else f"{value}"
