"""Writes the generated parts of README.md and docs/; with --check it only compares."""

from __future__ import annotations

import statistics
import sys

import tyro

from quadrl.learning.benchmark import ALL_CORES, ONE_CORE
from scripts.reports import (
    describe,
    goals,
    noise,
    paper,
    reference,
    report,
    robust,
    robustness,
    search,
    speed,
    task_pages,
    training,
)
from scripts.reports.report import table

MODULES = (
    describe, goals, noise, paper, reference, robust, robustness, search, speed, task_pages,
    training,
)  # fmt: skip


def main(check: bool = False) -> None:
    """Write every page.

    Args:
        check: Write nothing; exit with 1 and a message if a page would change.
    """
    parts: dict = {"figures": figures, "claim": claim}
    for module in MODULES:
        parts |= module.PARTS
    stale = [page for page in report.pages() if report.written(page, parts) != page.read_text()]
    if check and stale:
        names = ", ".join(page.name for page in stale)
        sys.exit(f"{names}: not as `scripts/report pages` writes them")
    for page in stale:
        page.write_text(report.written(page, parts))


def figures() -> str:
    """The five figures of the README."""
    result, measured = report.load("training"), report.load("speed")
    took, solved, _ = hover()
    rows = [(
        "hover, from nothing to a trained policy",
        f"{min(took):.1f} to {max(took):.1f} s; {solved} of {len(took)} seeds succeed in all of "
        f"{result['episodes']} episodes",
        "`scripts/report training`"
    )]  # fmt: skip
    for row in measured["rates"]:
        if row["target"] and row["of"] in (ALL_CORES, ONE_CORE):
            share = f"{row['share']:.2f} times bare `mj_step` on {row['of']}"
            rows.append((f"{row['what']}", f"{row['rate']:,.0f} control steps/s; {share}",
                         "`quadrl benchmark`"))  # fmt: skip
    at = report.commits(row for row in result["runs"] if row["task"] == "hover")["commit"]
    sources = f"{report.source(measured)} The row of hover at commit {at}."
    return f"{table(('what', 'figure', 'command'), rows)}\n\n{sources}"


def claim() -> str:
    """What hover takes and reaches, beside the command that shows it."""
    result = report.load("training")
    took, solved, error = hover()
    cells = (
        "`quadrl train hover`",
        f"{statistics.median(took):.1f} s ({min(took):.1f} to {max(took):.1f} s)",
        f"100 % of {result['episodes']} fresh episodes with {solved} of {len(took)} seeds",
        f"{min(error):.1g} to {max(error):.1g} mm",
    )
    head = ("command", "from nothing to the policy", "success", "error over the last 2 s")
    note = f" Measured {result['note']}." if "note" in result else ""
    where = f"{result['machine']['cores']} CPU cores without a GPU, in free flight"
    words = f"*Median and range of the seeds, on {where}. [All trainings](results.md).{note}*"
    return f"{table(head, [cells])}\n\n{words}"


def hover() -> tuple[list[float], int, list[float]]:
    """Of the trainings of hover: times [s], how many never fail, errors [mm]."""
    runs = [
        run
        for run in report.load("training")["runs"]
        if [run[x] for x in ("task", "vehicle", "engine")] == ["hover", "paper", "free_flight"]
    ]
    took = [run["training_s"] for run in runs]
    solved = sum(run["metrics"]["success_rate"] == 1 for run in runs)
    return took, solved, [1000 * run["metrics"]["position_error_m"] for run in runs]


if __name__ == "__main__":
    tyro.cli(main)
