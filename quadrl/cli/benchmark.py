"""`quadrl benchmark`."""

from __future__ import annotations

from quadrl.base.machine import in_a_line
from quadrl.base.validation import number
from quadrl.cli import choices
from quadrl.cli.console import console, make_table, print_json, say


@choices.command
class Benchmark:
    """Measure the speed of every layer in one run, as rates and as shares of others."""

    num_envs: int = 1024
    """Aircraft in the batch."""
    seconds: float = 0.2
    """Length of each measurement; short, since the speed of a machine drifts."""
    repeats: int = 30
    """Measurements of each layer; the layers take turns. The rate is the fastest one; the share is
    the median ratio to its reference in the same turn."""
    task: choices.TaskName = "hover"
    """The task that is flown."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Measure and print."""
        from quadrl.learning.benchmark import benchmark, rows

        number("seconds", self.seconds, positive=True)
        number("repeats", self.repeats, 1, whole=True)
        measured = benchmark(
            self.task, num_envs=self.num_envs, seconds=self.seconds, repeats=self.repeats
        )
        if self.json:
            print_json(measured)
            return
        console.print(make_table(rows(measured), numbers=5))
        say("\nsteps/s: control steps a second, the fastest of the repetitions")
        say(f"\n{in_a_line(measured['machine'])}")
