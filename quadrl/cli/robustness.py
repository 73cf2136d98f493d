"""`quadrl robustness`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from quadrl.base.errors import QuadrlError
from quadrl.base.extras import needed
from quadrl.base.validation import choice
from quadrl.cli import choices
from quadrl.cli.console import console, going_on, make_table, print_json, say
from quadrl.cli.flown import Conditioned, policy_named
from quadrl.control import CONTROLLERS
from quadrl.evaluation.robustness import robustness


@choices.command
class Robustness(Conditioned):
    """Fly policies or controllers in graded disturbances, and map the starts they recover from."""

    policies: Positional[tuple[str, ...]] = ()
    """Run folders, .safetensors files, or names of shipped policies: a task's name or, for example,
    hover_robust (write ./NAME for a folder of that name)."""
    controller: Annotated[
        UseAppendAction[tuple[choices.ControllerName, ...]],
        arg(help_behavior_hint="(repeatable)"),
    ] = ()
    """A controller to fly as well: geometric or lqr."""
    task: choices.TaskName = ""
    """The task; by default the one that the first policy was trained for, and hover for a
    controller."""
    disturbances: tuple[str, ...] = ()
    """Names of the disturbances; by default all."""
    recovery: bool = True
    """Also fly the recovery maps."""
    episodes: int = 300
    """Flights of each level; a cell of a recovery map has a tenth of them."""
    seed: int = 0
    """Seed of the episodes, between 0 and 2^32 - 1."""
    out: Path = Path("robustness")
    """Folder for the pictures (.png, .pdf), the numbers (.json) and the table (.csv). Until they
    are written, it keeps the finished flights, so that the same command can resume."""
    json: bool = False
    """Print the numbers as one JSON object and nothing else."""

    def run(self) -> None:
        """Fly, print where half of the flights fail, and write the files."""
        if not (self.policies or self.controller):
            raise QuadrlError(
                "give policies (run folders, .safetensors files, or names of tasks), or "
                f"--controller {' or '.join(CONTROLLERS)}"
            )
        flown = [policy_named(name) for name in self.policies]
        flown += [choice("controller", name, CONTROLLERS) for name in self.controller]
        with going_on(), needed("quadrl robustness", "matplotlib"):
            card = robustness(
                flown,
                self.task or None,
                episodes=self.episodes,
                seed=self.seed,
                recovery=self.recovery,
                keep=self.out,
                progress=not (self.json or console.quiet),
                disturbances=self.disturbances or None,
                **self.conditions(),
            )
        paths = card.save(self.out)
        if self.json:
            print_json(card.found)
            return
        console.print(make_table(card.table, numbers=len(card.found["flown"])))
        if card.reach:
            say(card.reach)
        for path in paths:
            say(f"wrote {path}")
