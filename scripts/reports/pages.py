"""Write the generated parts of README.md and docs/ from the code and from what was measured."""

from __future__ import annotations

import os
import re
import statistics
import sys
from pathlib import Path

from quadrl.learning.benchmark import ALL_CORES, ONE_CORE
from scripts.reports import code, measure, report, robustness, shipping, task_pages
from scripts.reports.report import DOCS, REPOSITORY, Parts, table


def pages(check: bool = False) -> None:
    """Write the generated parts of every page.

    Args:
        check: Write nothing; exit with 1 and a message if a page would change.
    """
    parts: dict = {"figures": figures, "claim": claim}
    for module in (code, measure, robustness, shipping, task_pages):
        parts |= module.PARTS
    stale = [page for page in all_pages() if written(page, parts) != page.read_text()]
    if check and stale:
        names = ", ".join(page.name for page in stale)
        sys.exit(f"{names}: not as `scripts/report pages` writes them")
    for page in stale:
        page.write_text(written(page, parts))


def all_pages() -> list[Path]:
    """All pages that may have generated parts."""
    return [REPOSITORY / "README.md", *sorted(DOCS.rglob("*.md"))]


def written(page: Path, parts: Parts) -> str:
    """The text of a page, each part from `<!-- begin NAME -->` to `<!-- end NAME -->` made anew.

    Links in parts are relative to docs/; they are adapted to a page elsewhere.

    Raises:
        KeyError: The page has a part that nothing makes.
    """

    def make(found: re.Match[str]) -> str:
        try:
            part = parts[found[1]]()
        except FileNotFoundError as error:
            name = Path(str(error.filename)).stem
            part = f"Not measured yet: run `scripts/report {name}`."
        if page.parent != DOCS:
            link = re.compile(r"\]\((?!#|\w+:)([^)#]+)")
            part = link.sub(lambda x: f"]({os.path.relpath(DOCS / x[1], page.parent)}", part)
        return f"<!-- begin {found[1]} -->\n\n{part}\n\n<!-- end {found[1]} -->"

    pattern = r"<!-- begin ([\w-]+) -->.*?<!-- end \1 -->"
    return re.sub(pattern, make, page.read_text(), flags=re.DOTALL)


def figures() -> str:
    """The figures of the README besides that of `claim`."""
    measured, rows = report.load("speed"), []
    for row in measured["rates"]:
        if row["target"] and row["of"] in (ALL_CORES, ONE_CORE):
            share = f"{row['share']:.2f} times bare `mj_step` on {row['of']}"
            rows.append((row["what"], f"{row['rate']:,.0f} control steps/s; {share}"))
    return f"{table(('`quadrl benchmark`', 'figure'), rows)}\n\n{report.source(measured)}"


def claim() -> str:
    """What hover takes and reaches, beside the command that shows it."""
    result = report.load("training")
    usual = {"task": "hover", "vehicle": "paper", "engine": "free_flight"}
    runs = [run for run in result["runs"] if usual.items() <= run.items()]
    took = [run["training_s"] for run in runs]
    error = [1000 * run["metrics"]["position_error_m"] for run in runs]
    solved = sum(run["metrics"]["success_rate"] == 1 for run in runs)
    cells = (
        "`quadrl train hover`",
        f"{statistics.median(took):.1f} s ({min(took):.1f} to {max(took):.1f} s)",
        f"100 % of {result['episodes']} fresh episodes with {solved} of {len(took)} seeds",
        f"{min(error):.1g} to {max(error):.1g} mm",
    )
    head = ("command", "from nothing to the policy", "success", "error over the last 2 s")
    where = f"{result['machine']['cores']} CPU cores without a GPU, in free flight"
    words = f"*Median and range of the seeds, on {where}. [All trainings](results.md).*"
    return f"{table(head, [cells])}\n\n{words}"
