"""Write the generated parts of README.md and docs/ from the code and from what was measured."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

from scripts.reports import (
    any_aircraft,
    code,
    crosscheck,
    flights,
    forest,
    gpu,
    measure,
    one_policy,
    robustness,
    shipping,
    task_pages,
    world,
)
from scripts.reports.report import DOCS, REPOSITORY, Parts


def pages(check: bool = False) -> None:
    """Write the generated parts of every page.

    Args:
        check: Write nothing; exit with 1 and a message if a page would change.
    """
    modules = (any_aircraft, code, crosscheck, flights, forest, gpu, measure, one_policy,
               robustness, shipping, task_pages, world)  # fmt: skip
    parts = {name: part for module in modules for name, part in module.PARTS.items()}
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
        part = parts[found[1]]()
        if page.parent != DOCS:
            link = re.compile(r"\]\((?!#|\w+:)([^)#]+)")
            part = link.sub(lambda x: f"]({os.path.relpath(DOCS / x[1], page.parent)}", part)
        return f"<!-- begin {found[1]} -->\n\n{part}\n\n<!-- end {found[1]} -->"

    pattern = r"<!-- begin ([\w-]+) -->.*?<!-- end \1 -->"
    return re.sub(pattern, make, page.read_text(), flags=re.DOTALL)
