"""Copy trained policies into the assets, and fly those that are there: `ship` and `shipped`."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Collection
from functools import partial
from pathlib import Path
from typing import Any

from quadrl import tasks
from quadrl.base.errors import QuadrlError
from quadrl.base.files import write_json
from quadrl.base.units import quantity
from quadrl.core.catalogue import kind as kind_of
from quadrl.core.scenario import UNDISTURBED, Scenario
from quadrl.core.solved import missed
from quadrl.core.task import Task
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.policy import SHIPPED, SHIPPED_AS, Policy
from quadrl.evaluation.policy_file import FILE
from quadrl.evaluation.rollout import fly, summarize
from quadrl.learning.command import command
from quadrl.learning.config import TrainConfig
from quadrl.learning.defaults import usual_vehicle
from scripts.reports import report
from scripts.reports.report import FIGURES, Result, Runs, block, say

EPISODES = 2000
RACES = ("lsy_race", "race")  # the goal is the next gate: the distance from it is no error
SHIPS = """`quadrl.Policy.pretrained("{name}", algo="{by}")` and `quadrl render {name}` fly them. A
policy is a safetensors file, with a .json of all its settings beside it, in
`quadrl/assets/policies`.

"""
ON_A_PAGE = """In the conditions of the training, but for the targets that are missed: [how and
where they flew](results.md#policies-that-ship). Rows "as flown" have one disturbance that real
aircraft meet."""
POLICIES = """The mean action in {flown} fresh episodes, in the conditions of the training. The last
column lists the targets of the task that the policy misses in the same number of undisturbed
episodes. {source}"""
MADE = ("algo", "seed", "run", "variant", "steps", "rotors")
"""What a policy says of its training beside the scenario."""
AS_FLOWN: dict[str, Any] = {  # each alone, by the policies of tasks that have no robust one
    "as flown, 10 ms late": {"randomization": {"command_delay": 0.01}},
    "as flown, 20 ms late": {"randomization": {"command_delay": 0.02}},
    "as flown, real air": {"aerodynamics": "full"},
    "as flown, randomization `light`": {"randomization": "light"},
}


def engine_of(task: Task) -> dict[str, Any]:
    """Among solids free flight, which is MuJoCo near each and needs a tenth of its time."""
    return {"engine": "free_flight"} if task.solids() else {}


def ship(runs: Runs, out: Path = SHIPPED) -> None:
    """Copy trained policies into assets/policies, where they come with the package.

    For each task, algorithm and variant it takes the run with the lowest seed, never the best one,
    and leaves it out if it misses a target of its task where nothing disturbs it:
    `scripts/report ship runs/paper/*`.

    Args:
        runs: Run folders.
        out: Where the policies go; by default the assets.
    """
    found = [(TrainConfig.of_folder(run), run) for run in runs if (run / FILE).is_file()]
    if not found:
        sys.exit("none of the folders holds a finished run")
    chosen: dict[str, tuple[TrainConfig, Path]] = {}
    for config, run in sorted(found, key=lambda each: each[0].seed):
        kind = SHIPPED_AS.get(config.algo, config.algo)
        if config.variant != "ideal":
            whole = config.named()
            usual = usual_vehicle(kind_of(config.task), config.variant)
            kind = "_".join((whole["variant"], whole["vehicle"])).removesuffix(f"_{usual}")
        chosen.setdefault(f"{config.task}_{kind}", (config, run))
    for name, (config, run) in sorted(chosen.items()):
        say(f"{name}: {copied(run, config, out / f'{name}.safetensors')}")


def copied(run: Path, config: TrainConfig, file: Path) -> str:
    """Copy a policy with its configuration, its metrics and the command that makes it again."""
    try:
        said = command(config)
    except QuadrlError as error:
        return f"left out, {run}: {error}"
    policy, engine = Policy.load(run), engine_of(config.base.task)
    calm: Any = {**UNDISTURBED, **engine}
    metrics, still = (
        summarize(fly(policy, episodes=EPISODES, **given)) for given in (engine, calm)
    )
    flown = f"seed {config.seed}, {100 * metrics['success_rate']:.1f} % of {EPISODES} successful"
    if short := missed(config.base.task.asked, still):
        for old in (file, file.with_suffix(".json")):
            old.unlink(missing_ok=True)
        return f"left out, misses what its task asks: {flown}; {short}"
    file.parent.mkdir(parents=True, exist_ok=True)
    policy.save(file)
    beside = {"command": said, "evaluation": metrics, "config": config.resolved()}
    write_json(file.with_suffix(".json"), beside)
    return flown


def renew() -> None:
    """Write the policies in assets/policies anew, with the numbers that their names mean today.

    It is for a release with other numbers of an aircraft or a task that the policies still fly.
    What they were trained with beside those, and the networks, stay as they are.
    """
    for file in sorted(SHIPPED.glob("*.safetensors")):
        policy, beside = Policy.load(file), json.loads(file.with_suffix(".json").read_text())
        was, changed = policy.metadata, policy.metadata["changed"]
        named = {**policy.conditions, "vehicle": was["vehicle"]["name"]}
        for what, of in (("task", was["task_options"]), ("vehicle", was["vehicle"])):
            named[f"{what}_options"] = {name: of[name] for name in changed[what]}
        record = Scenario.of(named).to_json()
        made = {name: was[name] for name in MADE if name in was}
        dataclasses.replace(policy, metadata=made | record).save(file)
        beside["config"]["scenario"] = record
        write_json(file.with_suffix(".json"), beside)


def shipped(episodes: int = EPISODES, only: tuple[str, ...] = ()) -> None:
    """Fly every policy that comes with quadrl, as it was trained and where nothing disturbs it.

    Args:
        episodes: Flights of each in each condition.
        only: Names of policies, beside what was measured of the others; by default all.
    """
    names = sorted(file.stem for file in SHIPPED.glob("*.safetensors"))
    cases = {name: partial(reached, name, episodes) for name in names}
    report.gather("shipped", "policy", cases, only)


def reached(name: str, episodes: int) -> dict[str, list[Result]]:
    """What a policy reaches in the conditions of its training, in none, and in real ones."""
    engine = engine_of(flown := Policy.pretrained(name).scenario.task)

    def metrics(**given: Any) -> Result:
        return evaluate(name, episodes=episodes, **engine | given).metrics

    found, still, targets = metrics(), metrics(**UNDISTURBED), flown.asked
    robust = (SHIPPED / f"{found['task']}_robust.safetensors").exists()
    alone = {} if robust or found["task"] not in tasks.TASKS else AS_FLOWN  # has no page
    shown = {"task", *FIGURES, *(target.metric for target in targets)}
    late = {words: few(metrics(**x), shown) for words, x in alone.items()}
    if len(flown.parts) > 1:  # of its members what is asked
        found, still = few(found, shown), few(still, shown)
    say(f"{name}: {missed(targets, still)}")
    return {"rows": [found | {"episodes": episodes, "undisturbed": still, "as_flown": late}]}


def few(metrics: Result, names: Collection[str]) -> Result:
    """The figures that are shown."""
    return {name: value for name, value in metrics.items() if name in names}


def policies(name: str = "") -> str:
    """The policies that ship for a task, or for every one: how they fly and what they miss."""
    result, rows = report.load("shipped"), []
    own = [x for x in tasks.TASKS[name].targets if x.metric not in FIGURES] if name else []
    figures = (*FIGURES, *(x.metric for x in own))
    flown = [row for row in result["rows"] if name in ("", row["task"])]

    def cells(found: Any) -> list[str]:
        without = "position_error_m" * (found.get("task") in RACES)
        return [quantity(x, found[x]) if x in found and x != without else "" for x in figures]

    for row in flown:
        made = json.loads((SHIPPED / f"{row['policy']}.json").read_text())["command"]
        asked = Policy.pretrained(row["policy"]).scenario.task.asked
        still = missed(asked, row["undisturbed"]) or "none"
        rows.append((f"`{row['policy']}`", f"`{made}`", *cells(row), still))
        if name:
            rows += [(words, "", *cells(of), "") for words, of in row["as_flown"].items()]
    if not rows:
        return "None comes with quadrl."
    head = ("policy", "made by", *FIGURES.values(), *(x.words for x in own), "targets missed")
    if name:
        how = SHIPS.format(name=name, by=tasks.TASKS[name].trained_by)
        return how + block(head, rows, ON_A_PAGE)
    counts = " or ".join(f"{n:,}" for n in sorted({row["episodes"] for row in flown}))
    note = POLICIES.format(flown=counts, source=report.source(result, flown))
    return block(head, rows, note)


PARTS: report.Parts = {"shipped": policies}
