"""What all reports share: results on disk, and Markdown tables of them."""

from __future__ import annotations

import itertools
import json
import math
import re
import subprocess
import sys
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from quadrl.base.machine import in_a_line, machine

REPOSITORY = Path(__file__).resolve().parents[2]
DOCS, RUNS = REPOSITORY / "docs", REPOSITORY / "runs"
RESULTS, IMAGES = DOCS / "results", DOCS / "images"
CODE = ("quadrl", "tasks", "assets", "scripts")  # what a result depends on

FIGURES = {
    "success_rate": "successful",
    "position_error_m": "error over the last 2 s",
    "yaw_rate_rad_s": "yaw rate over the last 2 s",
    "circling_m_s": "circling over the last 2 s",
    "command_change_rate": "change of the commands",
    "saturated_rate": "commands at their limits",
    "least_height_m": "least height",
}
"""Of flights, and what tables call them."""

Result = dict[str, Any]
Runs = Annotated[tuple[Path, ...], tyro.conf.Positional]
Parts = Mapping[str, Callable[[], str]]
"""Parts of pages by name."""


def say(text: object) -> None:
    """Progress, apart from the results."""
    print(text, file=sys.stderr, flush=True)


def load(name: str) -> Result:
    """What was measured last."""

    def unpack(found: Result) -> Any:
        if found.keys() == {"columns", "rows"}:
            return [dict(zip(found["columns"], row, strict=True)) for row in found["rows"]]
        if found.keys() == {"tables"}:
            return [row for table in found["tables"] for row in table]
        return found

    return json.loads((RESULTS / f"{name}.json").read_text(), object_hook=unpack)


def commit() -> str:
    """The commit that is checked out; "-dirty" if what results depend on differs from it."""
    git = ("git", "-C", str(REPOSITORY))
    known = subprocess.run((*git, "describe", "--always"), capture_output=True, text=True).stdout
    changed = subprocess.run((*git, "diff", "--quiet", "HEAD", "--", *CODE)).returncode == 1
    return (known.strip() or "unknown") + "-dirty" * changed


def save(name: str, result: Result) -> None:
    """Keep a result, with the machine and the commit that it was measured on."""
    rest = {part: x for part, x in result.items() if part not in ("machine", "commit")}
    whole = {"machine": machine(), "commit": commit()} | rest
    # A line for each list and object.
    text = re.sub(r"(?<=[\[,:]) (?=[\[{])", "\n", json.dumps(packed(whole)))
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / f"{name}.json").write_text(text + "\n")


def packed(value: Any) -> Any:
    """The same value in five digits, None for what is not finite, rows of equal names as tables."""
    if isinstance(value, dict):
        return {name: packed(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        rows = [packed(part) for part in value]
        if not all(isinstance(row, dict) for row in rows):
            return rows
        tables = [
            {"columns": head, "rows": [[*row.values()] for row in alike]}
            for head, alike in itertools.groupby(rows, list)
        ]
        if 2 * len(tables) > len(rows):  # some two rows each, or fewer
            return rows
        return tables[0] if len(tables) == 1 else {"tables": tables}
    if isinstance(value, float):
        return float(f"{value:.5g}") if math.isfinite(value) else None
    return value


def gather(
    name: str,
    by: str,
    cases: Mapping[str, Callable[[], Mapping[str, list[Result]]]],
    only: Collection[str] = (),
    **others: Any,
) -> None:
    """Measure case by case, beside what was measured of other cases, and keep all in one order.

    It is saved after each case: a report that is stopped keeps what it has flown.

    Args:
        name: Of the result.
        by: The column that names the case.
        cases: What measures each: rows by the parts of the result.
        only: Cases to measure; by default all.
        **others: What the result has beside its rows.
    """
    before = load(name) if only and (RESULTS / f"{name}.json").exists() else {}
    parts: dict[str, dict[str, list[Result]]] = {}
    for part, rows in before.items():
        if isinstance(rows, list) and rows and by in rows[0]:
            parts[part] = grouped([{"commit": before["commit"]} | row for row in rows], by)

    def keep() -> None:
        ordered = {
            part: [row for case in cases for row in kept.get(case, ())]
            for part, kept in parts.items()
        }
        save(name, before | others | ordered)

    for case, measure in cases.items():
        if not only or case in only:
            for part, rows in measure().items():
                made = [{"commit": commit(), by: case} | row for row in rows]
                parts.setdefault(part, {})[case] = made
            say(f"{name}: {case}")
            keep()
    keep()


def grouped(rows: Iterable[Result], *by: str) -> dict[Any, list[Result]]:
    """Rows by the value of a column, or by those of several; the first seen is the first."""
    found: dict[Any, list[Result]] = {}
    for row in rows:
        values = tuple(row.get(name) for name in by)
        found.setdefault(values if len(by) > 1 else values[0], []).append(row)
    return found


def source(result: Result, rows: Iterable[Result] = ()) -> str:
    """Where and at which commits a result, or rows of it, was measured, in one line."""
    commits = sorted({row.get("commit", result["commit"]) for row in rows} or [result["commit"]])
    return f"Machine: {in_a_line(result['machine'])}. Measured at commit {' and '.join(commits)}."


def table(head: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table."""
    lines = [[str(cell).replace("|", "\\|") for cell in row] for row in (head, *rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join(f"| {' | '.join(cells)} |".replace("|  |", "| |") for cells in lines)


def block(
    head: Iterable[object], rows: Iterable[Iterable[object]], note: str = "",
    measured: Result | None = None, of: Iterable[Result] = (),
) -> str:  # fmt: skip
    """A table with a note, and where its result, or rows of it, was measured."""
    said = [note, source(measured, of) if measured else ""]
    return f"{table(head, rows)}\n\n{' '.join(filter(None, said))}".rstrip()
