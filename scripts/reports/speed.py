"""Keeps a benchmark for the pages; run it on a machine that does nothing else."""

from __future__ import annotations

import tyro

from quadrl.learning import benchmark
from scripts.reports import report
from scripts.reports.report import table


def main(repeats: int = 100, seconds: float = 0.2) -> None:
    """Measure and write down.

    Args:
        repeats: Measurements of each layer.
        seconds: Seconds of each measurement.
    """
    report.save("speed", benchmark.benchmark("hover", repeats=repeats, seconds=seconds))


def speed() -> str:
    """Every layer."""
    result = report.load("speed")
    head = ("what", "control steps/s", "median", "share", "of", "target")
    return f"{table(head, benchmark.rows(result))}\n\n{report.source(result)}"


PARTS: report.Parts = {"speed": speed}

if __name__ == "__main__":
    tyro.cli(main)
