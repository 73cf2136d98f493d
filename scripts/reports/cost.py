"""Time and memory of a batch against the number of aircraft, the threads, the task, the time limit.

Run it on a machine that does nothing else; it takes a minute.
"""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from quadrl import tasks
from quadrl.engines.mujoco import ENGINES, EngineName
from quadrl.environment import Environment
from scripts.reports import report
from scripts.reports.report import Result, say, table

COUNTS = (1, 4, 16, 64, 256, 1024, 4096, 16384)
COUNT = 1024  # aircraft where their number is not varied
THREADS = (1, 2)
TIME_LIMITS = (0.5, 2.0, 10.0, 40.0)  # [s]
SLICES, SLICE = 5, 0.08  # the fastest of that many measurements of that length [s] counts


def main() -> None:
    """Measure and write down."""
    jobs = {
        "aircraft": [("hover", n, t, None) for t in THREADS for n in COUNTS],
        "time_limit": [("hover", COUNT, THREADS[-1], limit) for limit in TIME_LIMITS],
        "tasks": [(task, COUNT, THREADS[-1], None) for task in tasks.TASKS],
    }
    measured = {
        name: [alone(cost, engine, *job) for engine in ENGINES for job in each]
        for name, each in jobs.items()
    }
    report.save("cost", measured)


def cost(engine: EngineName, task: str, count: int, threads: int, limit: float | None) -> Result:
    """Time and memory of a batch under random actions, with resets and observations."""
    Environment(task, num_envs=1, engine=engine).reset()  # what the first one loads is not counted
    gc.collect()
    before, made = resident(), tasks.make(task, **({"time_limit": limit} if limit else {}))
    environment = Environment(made, num_envs=count, seed=0, num_threads=threads, engine=engine)
    actions = np.random.default_rng(0).uniform(-1, 1, (16, count, environment.action_size))
    environment.flatten(environment.reset())
    times, steps = [], 0
    for _ in range(SLICES + 1):  # the first warms up
        began, done = time.perf_counter(), 0
        while done == 0 or time.perf_counter() - began < SLICE:
            step(environment, actions[steps % len(actions)])
            done, steps = done + 1, steps + 1
        times.append((time.perf_counter() - began) / done / count)
    row = {"task": task, "engine": engine, "aircraft": count, "threads": threads}
    row |= {"time_limit_s": made.time_limit, "observation": environment.size}
    row |= {"us": 1e6 * min(times[1:]), "memory_mb": (resident() - before) / 1024}
    say(row)
    return row


def step(environment: Environment, action: np.ndarray) -> int:
    """A control step of all, and a reset of the rows whose episode ended; how many did."""
    now = environment.step(action)
    environment.flatten(now.observation)
    over = np.asarray(now.terminated | now.truncated)
    if over.any():
        environment.flatten(environment.reset(over))
    return int(over.sum())


def resident(trim: bool = False) -> float:
    """Memory of this process [kB]; trimmed of what Python and the C library keep for later."""
    if trim:
        gc.collect()
        getattr(ctypes.CDLL(None), "malloc_trim", int)(0)  # glibc has it
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1024


def alone(function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function returns in a process of its own, so that its memory is its own."""
    with multiprocessing.get_context("fork").Pool(1) as pool:
        return pool.apply(function, arguments)


def shown() -> str:
    """Three tables."""
    result = report.load("cost")
    kinds = [(e, t, "us", "us") for e in ENGINES for t in THREADS]
    kinds += [(engine, 1, "MB", "memory_mb") for engine in ENGINES]
    head = ["aircraft", *(f"{e}, {t} thread{'s' * (t > 1)} [{u}]" for e, t, u, _ in kinds)]
    found = {(r["aircraft"], r["engine"], r["threads"]): r for r in result["aircraft"]}
    counts = dict.fromkeys(r["aircraft"] for r in result["aircraft"])
    rows = ((f"{n:,}", *(f"{found[n, e, t][k]:.3g}" for e, t, _, k in kinds)) for n in counts)
    tables = [table(head, rows)]
    for name, first, label in (
        ("time_limit", "time limit", "{time_limit_s:g} s"),
        ("tasks", "task, numbers in its observation", "`{task}`, {observation}"),
    ):
        times: dict[str, list[str]] = {}
        for row in result[name]:
            times.setdefault(label.format_map(row), []).append(f"{row['us']:.3g}")
        engines = (f"{engine} [us]" for engine in ENGINES)
        tables.append(table((first, *engines), ((name, *each) for name, each in times.items())))
    return "\n\n".join((*tables, report.source(result)))


PARTS: report.Parts = {"cost": shown}

if __name__ == "__main__":
    tyro.cli(main)
