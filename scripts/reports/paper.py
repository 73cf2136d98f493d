"""The paper's sentences that were open, asked of the trainings of docs/studies/paper.toml."""

from __future__ import annotations

import dataclasses
import statistics
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.evaluation.card import wilson
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.policy import Policy
from quadrl.learning.comparison import LEVEL, compare
from quadrl.learning.plan import read_plan
from quadrl.learning.study import sum_up
from scripts.reports import report
from scripts.reports.report import DOCS, RUNS, Result, table

NAMES = {"ppo": "PPO", "trpo": "TRPO", "vpg": "GAE"}
FIGURES = ("success_rate", "return_mean", "position_error_m", "command_change_rate",
           "yaw_rate_rad_s", "circling_m_s", "solved_after_steps", "success_area",
           "success_lost")  # fmt: skip
WEIGHT_NOISE, WEIGHT_DRAWS = 0.2, 5  # of each neuron's weights, over their own length
SENTENCES = 8
"""Asked anew: they share the chance of a false verdict."""
ASKED = {
    "Overall, PPO and TRPO perform more consistently than GAE.": (
        ("solved_after_steps", "ppo", "vpg"), ("solved_after_steps", "trpo", "vpg")),
    "PPO is the most consistent of the three.": (
        ("solved_after_steps", "ppo", "vpg"), ("solved_after_steps", "ppo", "trpo")),
    "TRPO learns to fly more smoothly than PPO.": (("command_change_rate", "trpo", "ppo"),),
    "The reason may be that PPO's optimiser, Adam, finds sharper minima.": (
        ("return_lost", "trpo", "ppo"),),
    "GAE's performance varies more than that of the others.": (
        ("return_off_median", "ppo", "vpg"), ("return_off_median", "trpo", "vpg")),
    "GAE is prone to collapse during training.": (
        ("success_lost", "ppo", "vpg"), ("success_lost", "trpo", "vpg")),
    "GAE may be less suited to flight control.": (
        ("failure_rate", "ppo", "vpg"), ("failure_rate", "trpo", "vpg")),
    "Stochastic policies should be robust to disturbances such as wind.": (
        ("position_error_m_in_wind", "ppo noise", "ppo"),),
}  # fmt: skip
"""By sentence, the figures that it says are smaller, with whose and than whose."""


def paper(folder: Path = RUNS) -> None:
    """Measure the trainings of the paper's studies that are done, and write them down.

    Args:
        folder: Holds the folders of the studies, paper and paper_noise.
    """
    rows = []
    for study in ("paper", "paper_noise"):
        found = sum_up(read_plan(DOCS / "studies" / f"{study}.toml", folder / study), {})
        for run in found.runs:
            row: Result = {name: run[name] for name in ("task", "algo", "variant", "seed")}
            row |= {name: run["metrics"].get(name) for name in FIGURES}
            policy = Policy.load(folder / study / run["name"])
            row["return_lost"] = lost(policy, run["task"]) if study == "paper" else None
            windy: Result = {"success_rate": None, "position_error_m": None}
            if run["algo"] == "ppo":
                windy = blown(policy, run["task"])
            rows.append(row | {f"{name}_in_wind": windy[name] for name in windy})
    report.save("sentences", {"command": "quadrl study docs/studies/paper.toml", "runs": rows})


def blown(policy: Policy, task: str) -> Result:
    """Success and error in light wind, by drag only, with the state known."""
    air: Any = {"weather": "light", "aerodynamics": "none", "randomization": "none"}
    found = evaluate(policy, task, episodes=100, engine="free_flight", **air).metrics
    return {name: found[name] for name in ("success_rate", "position_error_m")}


def lost(policy: Policy, task: str) -> float:
    """The return that noise on each neuron's weights costs, of a share of their length.

    The directions are normalised by neuron (Li et al. 2018, "Visualizing the Loss Landscape").
    """
    generator, returns = np.random.default_rng(0), []
    for noise in (0.0, *[WEIGHT_NOISE] * WEIGHT_DRAWS):
        weights = []
        for weight in policy.weights:
            drawn = generator.standard_normal(weight.shape)
            length, own = (np.linalg.norm(x, axis=1, keepdims=True) for x in (drawn, weight))
            weights.append((weight + noise * drawn * own / length).astype(np.float32))
        noisy = dataclasses.replace(policy, weights=tuple(weights))
        flown = evaluate(noisy, task, episodes=50, engine="free_flight").metrics
        returns.append(flown["return_mean"])
    return returns[0] - statistics.fmean(returns[1:])


def measured() -> list[Result]:
    """The runs as a study has them, with two figures that follow from those of all."""
    kept: list[Result] = report.load("sentences")["runs"]
    returns: dict[tuple[str, ...], list[float]] = {}
    runs: list[Result] = []
    for run in kept:
        returns.setdefault((run["task"], run["algo"], run["variant"]), []).append(
            run["return_mean"]
        )
    for run in kept:
        known = {name: run.pop(name) for name in ("task", "algo", "variant", "seed")}
        middle = statistics.median(returns[known["task"], known["algo"], known["variant"]])
        off = {"return_off_median": abs(run["return_mean"] - middle)}
        runs.append(known | {"metrics": run | off | {"failure_rate": 1 - run["success_rate"]}})
    return runs


def questions() -> str:
    """What each comparison says."""
    rows = []
    for sentence, asked in ASKED.items():
        for figure, one, other in asked:
            found = compare(measured(), figure, one, other, LEVEL / SENTENCES)
            tasks = ", ".join(f"{chance:.2f}" for chance in found.by_task.values())
            chance = f"{found.chance:.2f} ({found.low:.2f} to {found.high:.2f}); {tasks}"
            names = f"{NAMES.get(one, one)} than {NAMES[other]}"
            power = f"{found.power_differs:.2f}, {found.power_equal:.2f}"
            rows.append((sentence, f"{figure}: {names}", chance, f"**{found.verdict}**", power))
    return table(("sentence", "smaller", "chance; by task", "verdict", "power"), rows)


def reached() -> str:
    """What the trainings reached."""
    runs, rows = report.load("sentences")["runs"], []
    for task in dict.fromkeys(run["task"] for run in runs):
        for algo, name in NAMES.items():
            of = (task, algo, "")
            own = [run for run in runs if (run["task"], run["algo"], run["variant"]) == of]
            solved = sum(run["solved_after_steps"] is not None for run in own)
            low, high = wilson(solved, len(own))
            steps = sorted(run["solved_after_steps"] or float("inf") for run in own)
            quarter = [steps[round(q * (len(steps) - 1))] for q in (0.25, 0.5, 0.75)]
            words = ", ".join("none" if x == float("inf") else f"{x / 1000:.0f}" for x in quarter)
            area, lost, ends, change = (
                statistics.fmean(run[figure] for run in own)
                for figure in (
                    "success_area",
                    "success_lost",
                    "success_rate",
                    "command_change_rate",
                )
            )
            rows.append((f"`{task}`", name, f"{solved} of {len(own)} ({100 * low:.0f} to "
                         f"{100 * high:.0f} %)", words, f"{area:.2f}", f"{100 * ends:.0f} %",
                         f"{100 * lost:.0f} points", f"{100 * change:.2g} %"))  # fmt: skip
    return table(("task", "policy", "seeds solved", "after thousand steps: quartiles",
                  "area under the curve", "success at the end", "lost", "change of command"),
                 rows)  # fmt: skip


PARTS = {"paper-questions": questions, "paper-reached": reached}
