"""`quadrl evaluate`."""

from __future__ import annotations

import dataclasses

from quadrl.cli.console import console, make_table
from quadrl.cli.flown import Flown
from quadrl.control import make as make_controller
from quadrl.rollout import evaluate


@dataclasses.dataclass(frozen=True)
class Evaluate(Flown):
    """Evaluate the mean action of a policy, or a controller, in fresh episodes."""

    episodes: int = 100
    """Number of episodes."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print the metrics, beside those of the geometric controller."""
        controller, task, vehicle = self.setting()
        flown = {self.controller or "policy": controller}
        if self.controller != "geometric" and not self.json:
            flown["geometric controller"] = make_controller("geometric", task, vehicle)
        columns = {
            name: evaluate(one, task, episodes=self.episodes, seed=self.seed, vehicle=vehicle)[0]
            for name, one in flown.items()
        }
        first = next(iter(columns.values()))
        if self.json:
            console.print_json(data=first, indent=None)
            return
        rows = [(name, *(_text(metrics[name]) for metrics in columns.values())) for name in first]
        console.print(make_table(("", *columns), rows, numbers=len(columns)))


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
