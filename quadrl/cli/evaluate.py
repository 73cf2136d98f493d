"""`quadrl evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from quadrl.base.units import quantity
from quadrl.cli import choices
from quadrl.cli.console import console, make_table, say
from quadrl.cli.flown import Flown, yardstick
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
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print the metrics, beside those of the geometric controller."""
        _, controller, scenario = self.setting()
        name = self.controller or "policy"
        flown: dict[str, Any] = {name: controller}
        if self.controller != "geometric" and not self.json:
            flown["geometric controller"] = "geometric"
        evaluations = {
            name: evaluate(
                one,
                scenario if one is controller else yardstick(scenario),
                episodes=self.episodes,
                seed=self.seed,
                sampled=self.sampled and one is controller,
            )
            for name, one in flown.items()
        }
        first = evaluations[name].metrics
        if self.csv is not None:
            evaluations[name].save_csv(self.csv)
        if self.json:
            console.print_json(data=first, indent=None)
            return
        columns = [evaluation.metrics for evaluation in evaluations.values()]
        rows = [
            (metric, *(quantity(metric, column[metric]) for column in columns)) for metric in first
        ]
        console.print(make_table(("", *evaluations), rows, numbers=len(columns)))
        if self.csv is not None:
            say(f"wrote {self.csv}")
