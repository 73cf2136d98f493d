"""`quadrl runs`."""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path

from tyro.conf import Positional

from quadrl.base.errors import QuadrlError
from quadrl.base.units import quantity
from quadrl.cli import choices
from quadrl.cli.console import console, make_table, say
from quadrl.learning.folder import CONFIG, EVALUATION, is_earlier, read_config

AGES = {"d": 86_400, "h": 3_600, "min": 60, "s": 1}
"""Units of the age of a run [s]."""


@choices.command
class Runs:
    """List the runs in a folder, at any depth, the newest last."""

    folder: Positional[Path] = Path("runs")
    """Folder to look in."""

    def run(self) -> None:
        """Print a row for each run."""
        rows: list[tuple[str, ...]] = []
        found = [x for x in self.folder.rglob(CONFIG) if not is_earlier(x.parent)]
        for since, path in sorted((x.stat().st_mtime, x) for x in found):
            try:
                config = read_config(path.parent)
            except QuadrlError as error:
                say(f"left out: {error}")
                continue
            success = "none yet"
            with contextlib.suppress(OSError, ValueError, LookupError):
                reached = json.loads((path.parent / EVALUATION).read_text())
                success = quantity("success_rate", reached["success_rate"])
            known = (str(config[name]) for name in ("task", "algo", "seed"))
            name = str(path.parent.relative_to(self.folder))
            rows.append((name, *known, success, _age(time.time() - since)))
        if not rows:
            raise QuadrlError(f"there is no run in {self.folder}")
        say(f"in {self.folder}")
        head = ("run", "task", "algo", "seed", "success", "age")
        console.print(make_table([head, *rows], 3))


def _age(seconds: float) -> str:
    unit = next((unit for unit, size in AGES.items() if seconds >= size), "s")
    return f"{max(0.0, seconds) / AGES[unit]:.0f} {unit}"
