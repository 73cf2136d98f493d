"""Writes the generated parts of README.md and docs/; with --check it only compares."""

from __future__ import annotations

import sys

import tyro

from scripts.reports import describe, examples, paper, peers, report, speed, step_size, training
from scripts.reports.report import table

MODULES = (describe, examples, paper, peers, speed, step_size, training)


def main(check: bool = False) -> None:
    """Write every page.

    Args:
        check: Write nothing; exit with 1 and a message if a page would change.
    """
    parts: dict = {"figures": figures}
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
    hover = [
        run
        for run in result["runs"]
        if [run[x] for x in ("task", "vehicle", "engine")] == ["hover", "paper", "free_flight"]
    ]
    took = [run["training_s"] for run in hover]
    solved = sum(run["metrics"]["success_rate"] == 1 for run in hover)
    rows = [(
        "hover, from nothing to a trained policy",
        f"{min(took):.1f} to {max(took):.1f} s; {solved} of {len(hover)} seeds succeed in all of "
        f"{result['episodes']} episodes",
        "`scripts/report training`"
    )]  # fmt: skip
    for row in measured["rates"]:
        if row["target"]:
            share = f"{row['share']:.2f} times bare `mj_step` on {row['of']}"
            rows.append((f"{row['what']}", f"{row['rate']:,.0f} control steps/s; {share}",
                         "`quadrl benchmark`"))  # fmt: skip
    sources = f"{report.source(measured)} The row of hover at commit {result['commit']}."
    return f"{table(('what', 'figure', 'command'), rows)}\n\n{sources}"


if __name__ == "__main__":
    tyro.cli(main)
