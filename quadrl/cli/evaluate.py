"""`quadrl evaluate`."""

from __future__ import annotations

from pathlib import Path

from quadrl.base.files import in_a_folder
from quadrl.base.units import quantity
from quadrl.cli import choices
from quadrl.cli.console import console, make_table, print_json, say
from quadrl.cli.flown import Flown, flies
from quadrl.evaluation.evaluate import evaluate


@choices.command
class Evaluate(Flown):
    """Evaluate the mean action of a policy, or a controller, in fresh episodes."""

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
        flown = evaluate(
            flies(self.policy, self.controller, self.algo),
            self.task or None,
            episodes=self.episodes,
            seed=self.seed,
            sampled=self.sampled,
            **self.conditions(),
        )
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
