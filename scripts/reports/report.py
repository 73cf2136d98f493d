"""What all reports share: results on disk, Markdown tables, and the generated parts of pages."""

from __future__ import annotations

import json
import math
import os
import re
import statistics
import subprocess
import sys
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from quadrl.core.task import Target
from quadrl.learning import benchmark

REPOSITORY = Path(__file__).resolve().parents[2]
DOCS, RUNS = REPOSITORY / "docs", REPOSITORY / "runs"
RESULTS, IMAGES = DOCS / "results", DOCS / "images"
CODE = ("quadrl", "tasks", "assets", "scripts")  # what a result depends on
PATHS = [str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(PATHS)}
"""Environment variables with which a process imports this repository's package."""

Result = dict[str, Any]
Parts = Mapping[str, Callable[[], str]]
"""Parts of pages by name; a part that raises FileNotFoundError has not been measured yet."""


def say(text: object) -> None:
    """Progress, apart from the results."""
    print(text, file=sys.stderr, flush=True)


def load(name: str) -> Result:
    """What was measured last.

    Raises:
        FileNotFoundError: Nothing was.
    """
    return json.loads((RESULTS / f"{name}.json").read_text())


def commit() -> str:
    """The commit that is checked out; "-dirty" if what results depend on differs from it."""
    git = ("git", "-C", str(REPOSITORY))
    known = subprocess.run((*git, "describe", "--always"), capture_output=True, text=True).stdout
    changed = subprocess.run((*git, "diff", "--quiet", "HEAD", "--", *CODE)).returncode == 1
    return (known.strip() or "unknown") + "-dirty" * changed


def save(name: str, result: Result) -> None:
    """Keep a result, with the machine and the commit that it was measured on."""
    whole = {"machine": benchmark.machine(), "commit": commit(), **rounded(result)}
    text = json.dumps(whole, indent=1)
    # A list of numbers takes one line, not one per number.
    text = re.sub(r"\[\s+([^\[\]{}\"]*?)\s+\]", lambda m: f"[{' '.join(m[1].split())}]", text)
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / f"{name}.json").write_text(text + "\n")


def others(name: str, part: str, tasks: Collection[str]) -> list[Result]:
    """Kept rows of other tasks than these, each with the commit at which it was measured."""
    before = load(name)
    return [{"commit": before["commit"]} | row for row in before[part] if row["task"] not in tasks]


def commits(rows: Iterable[Result]) -> Result:
    """The commits of rows, as `source` names them."""
    return {"commit": " and ".join(sorted({row["commit"] for row in rows}))}


def rounded(value: Any) -> Any:
    """The same value with five digits, and None for what is not a finite number."""
    if isinstance(value, dict):
        return {name: rounded(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [rounded(part) for part in value]
    if isinstance(value, float):
        return float(f"{value:.5g}") if math.isfinite(value) else None
    return value


def source(result: Result) -> str:
    """Where and on what a result was measured, in one line."""
    note = f", {result['note']}" if "note" in result else ""
    machine = benchmark.summary(result)
    return f"Machine: {machine}. Measured at commit {result['commit']}{note}."


def table(head: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table."""
    lines = [[str(cell).replace("|", "\\|") for cell in row] for row in (head, *rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join(f"| {' | '.join(cells)} |".replace("|  |", "| |") for cells in lines)


def number(value: float | None, digits: int = 3) -> str:
    """A number in few digits and without an exponent."""
    if value is None or not math.isfinite(value):
        return "none"
    if 0 < abs(value) < 1e-3:
        return "under 0.001" if value > 0 else "over -0.001"
    return f"{value:,.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"


def spread(values: Iterable[float], unit: str = "", factor: float = 1.0, digits: int = 3) -> str:
    """The median of the seeds, with the lowest and the highest in brackets."""
    known = sorted(factor * x for x in values if math.isfinite(x))
    if not known:
        return "none"
    middle, low, high = (number(x, digits) for x in (statistics.median(known), known[0], known[-1]))
    between = f" ({low} to {high})" if low != high else ""
    return f"{middle}{between} {unit}".rstrip()


def factor(target: Target) -> float:
    """From the unit of a target's metric to the one that it is shown in."""
    return {"%": 100.0, "cm": 100.0}.get(target.unit, 1.0)


def asked(target: Target) -> str:
    """What a target asks, in its unit."""
    word = "at least" if target.at_least else "at most"
    return f"{word} {factor(target) * target.limit:g} {target.unit}"


def pages() -> list[Path]:
    """All pages that may have generated parts."""
    return [REPOSITORY / "README.md", *sorted(DOCS.rglob("*.md"))]


def written(page: Path, parts: Parts) -> str:
    """The text of a page, each part from `<!-- begin NAME -->` to `<!-- end NAME -->` made anew.

    Links in parts are relative to docs/; they are adapted to a page elsewhere.

    Raises:
        KeyError: The page has a part that nothing makes.
    """

    def adapted(link: re.Match[str]) -> str:
        return f"]({os.path.relpath(DOCS / link[1], page.parent)}"

    def make(found: re.Match[str]) -> str:
        try:
            part = parts[found[1]]()
        except FileNotFoundError as error:
            report = Path(str(error.filename)).stem
            part = f"Not measured yet: run `scripts/report {report}`."
        if page.parent != DOCS:
            part = re.sub(r"\]\((?!#|\w+:)([^)#]+)", adapted, part)
        return f"<!-- begin {found[1]} -->\n\n{part}\n\n<!-- end {found[1]} -->"

    pattern = r"<!-- begin ([\w-]+) -->.*?<!-- end \1 -->"
    return re.sub(pattern, make, page.read_text(), flags=re.DOTALL)
