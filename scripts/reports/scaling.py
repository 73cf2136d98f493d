"""Measures what a second process and a second Ray node bring a study.

Run it on a machine that does nothing else and has at least two cores.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Generator
from pathlib import Path

import tyro

import quadrl
from scripts.reports import report
from scripts.reports.report import Result, say, table

STORE_BYTES = 100 << 20


def main(trainings: int = 8, steps: int = 200_000, most: int = 2) -> None:
    """Carry out the same study in every way, and write down the wall clocks.

    Args:
        trainings: Seeds of hover.
        steps: Control steps of each.
        most: Processes, or nodes with a CPU each, that 1 is compared with.
    """
    settings = {"steps": steps}
    study = {"tasks": ["hover"], "seeds": f"0:{trainings}", "episodes": 20, "settings": settings}
    rows = []
    for way in ("processes", "Ray nodes"):
        for count in (1, most):
            rows.append({"way": way, "count": count, "seconds": measured(study, way, count)})
            say(rows[-1])
    report.save("scaling", {"trainings": trainings, "steps": steps, "rows": rows})


def measured(study: Result, way: str, count: int) -> float:
    """Wall clock of a study [s], without the start of the cluster."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        given = {} if way == "processes" else {"ray": stack.enter_context(cluster(count))}
        began = time.perf_counter()
        found = quadrl.study(study, out=Path(folder, "study"), jobs=count, on_line=say, **given)
        if found.failed:
            raise SystemExit("; ".join(found.failed.values()))
        return time.perf_counter() - began


@contextlib.contextmanager
def cluster(count: int) -> Generator[str]:
    """The address of a cluster of nodes with a CPU each, all on this machine."""
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": report.ENVIRONMENT["PYTHONPATH"]}
    from ray.cluster_utils import Cluster

    small = {"object_store_memory": STORE_BYTES, "include_dashboard": False}
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **small})
    try:
        for _ in range(count):
            made.add_node(num_cpus=1, **small)
        yield made.address
    finally:
        made.shutdown()


def scaling() -> str:
    """Wall clocks relative to one process."""
    result = report.load("scaling")
    one = result["rows"][0]["seconds"]
    rows = [
        (f"{row['way']}: {row['count']}", f"{row['seconds']:.0f} s", f"{one / row['seconds']:.2f}")
        for row in result["rows"]
    ]
    words = (
        f"{result['trainings']} trainings of hover, {result['steps']:,} control steps each, one "
    )
    words += "thread each; the nodes are Ray's, on one machine."
    head = ("carried out by", "wall clock", "times as fast as one process")
    return f"{table(head, rows)}\n\n{words}  \n{report.source(result)}"


PARTS: report.Parts = {"scaling": scaling}

if __name__ == "__main__":
    tyro.cli(main)
