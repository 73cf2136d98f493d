"""`quadrl evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from quadrl.base.errors import QuadrlError
from quadrl.base.files import in_a_folder
from quadrl.base.units import quantity
from quadrl.cli import choices
from quadrl.cli.console import console, make_table, print_json, say
from quadrl.cli.flown import Flown, flies
from quadrl.evaluation.evaluate import Evaluation, evaluate

SHOWN = {
    "success_rate": "successful",
    "survival_rate": "to the end",
    "position_error_m": "error",
    "yaw_rate_rad_s": "turning",
    "return_mean": "return",
}
"""Figures of a comparison, and their heads."""


@choices.command
class Evaluate(Flown):
    """Evaluate the mean action of a policy, or a controller, in fresh episodes; or of several."""

    policy: Annotated[  # pyright: ignore[reportIncompatibleVariableOverride] - others take one
        Positional[tuple[str, ...]], arg(metavar="[POLICY ...]")
    ] = ()
    """A run folder, a .safetensors file, or the name of a shipped policy: a task's name or, for
    example, hover_robust (write ./NAME for a folder of that name). Conditions that are not given
    are those of its training. Several, of one task, are compared in one table."""
    episodes: int = 100
    """Number of episodes."""
    sampled: bool = False
    """Draw the actions of a policy as in training, instead of taking their mean."""
    csv: Path | None = None
    """Also write a table with one row per flight to this file."""
    states: Path | None = None
    """Also write the states of the flights to this file: a table with one row per control step,
    from each start on."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print the metrics, beside those of the geometric controller."""
        for path in filter(None, (self.csv, self.states)):
            in_a_folder(path)
        if len(self.policy) > 1:
            self._compare()
            return
        flown = self._fly(*self.policy)
        first, columns = flown.metrics, {self.controller or "policy": flown.metrics}
        if self.controller != "geometric" and not self.json:
            columns["geometric controller"] = flown.yardstick().metrics
        written = ((self.csv, flown.save_csv), (self.states, flown.save_states))
        files = [save(path) for path, save in written if path is not None]
        if self.json:
            print_json(first)
            return
        rows = [
            (name, *(quantity(name, column[name]) for column in columns.values())) for name in first
        ]
        console.print(make_table([("", *columns), *rows], numbers=len(columns)))
        for path in files:
            say(f"wrote {path}")

    def _fly(self, policy: str = "") -> Evaluation:
        """Evaluate one."""
        flown = {"episodes": self.episodes, "seed": self.seed, "sampled": self.sampled}
        flying = flies(policy, self.controller, self.algo)
        return evaluate(flying, self.task or None, **flown, **self.conditions())

    def _compare(self) -> None:
        """Print a row for each of several."""
        if files := [str(path) for path in (self.csv, self.states) if path]:
            raise QuadrlError(name="file", value=files[0], allowed="left out beside several")
        flown = {policy: self._fly(policy) for policy in self.policy}
        if len(known := {one.task.name for one in flown.values()}) > 1:
            tasks, allowed = ", ".join(sorted(known)), "one for all in a table: give --task"
            raise QuadrlError(name="task", value=tasks, allowed=allowed)
        if self.json:
            print_json({name: one.metrics for name, one in flown.items()})
            return
        shown = [name for name in SHOWN if all(name in one.metrics for one in flown.values())]
        rows = (
            (policy, *(quantity(name, one.metrics[name]) for name in shown))
            for policy, one in flown.items()
        )
        head = ("policy", *(SHOWN[name] for name in shown))
        console.print(make_table([head, *rows], numbers=len(shown)))
        say(f"{self.episodes} episodes of {known.pop()} each, the same for all")
