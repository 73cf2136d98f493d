"""What the measuring programs of this folder share; each of them runs in its peer's environment.

A program makes everything it measures, says in one line of JSON what that is, and then answers
each line "ROW SECONDS" of its standard input with a measurement of that row, as one line of JSON.
So one who asks several programs in turn measures them side by side.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import Any

import numpy as np

# Some peers write to standard output, from C too and when they are imported: so the programs import
# this first, the answers keep standard output, and all else goes to standard error.
ANSWERS = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)

CHUNK = 10
"""Control steps of a single environment between two looks at the clock."""
FLIGHT = 16
"""Control steps under random commands until bare aircraft are put back."""

Work = Callable[[], tuple[int, int]]
"""Flies some control steps; says how many (all aircraft together) and how many episodes ended."""


@dataclasses.dataclass(frozen=True)
class Facts:
    """What a system computes."""

    control_step: float
    """Time between two actions [s]."""
    physics_step: float
    """Step of the integrator [s]."""
    integrator: str
    """Its method."""
    precision: str
    """Type of the state."""
    model: str
    """What is modelled, and what an action commands."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One thing that is measured."""

    system: str
    """The peer and how it is set up; rows of one system differ only in the two below."""
    what: str
    """one (environment), batch (of environments) or physics (the simulator without a task)."""
    aircraft: int
    """How many at once."""
    make: Callable[[], tuple[Facts, Work]]
    """Makes it; the time this takes, and the first work, is reported apart."""


def arguments() -> list[int]:
    """The sizes of the batches."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--num-envs", type=int, nargs="+", default=[1024])
    return parser.parse_args().num_envs


def serve(rows: list[Row], packages: tuple[str, ...]) -> None:
    """Make the rows, say what there is, and measure whatever is asked for."""
    works, described = [], []
    for row in rows:
        began = time.perf_counter()
        facts, work = row.make()
        work()
        prepared = time.perf_counter() - began
        works.append(work)
        described.append({
            "system": row.system,
            "what": row.what,
            "aircraft": row.aircraft,
            **dataclasses.asdict(facts),
            "substeps": round(facts.control_step / facts.physics_step),
            "prepare_s": prepared,
        })  # fmt: skip
    versions = {name: version(name) for name in packages}
    answer({"python": sys.version.split()[0], "versions": versions, "rows": described})
    for line in sys.stdin:
        row, seconds = line.split()
        answer(measure(works[int(row)], float(seconds)))


def measure(work: Work, seconds: float) -> dict[str, float]:
    """Fly until the time is over: control steps, episodes that ended, seconds."""
    steps = ended = 0
    began = time.perf_counter()
    while (elapsed := time.perf_counter() - began) < seconds or not steps:
        flown, over = work()
        steps += flown
        ended += over
    return {"steps": steps, "ended": ended, "seconds": elapsed}


def answer(said: dict[str, Any]) -> None:
    """One line of JSON."""
    print(json.dumps(said), file=ANSWERS)


def cycle(low: Any, high: Any, shape: tuple[int, ...]) -> Iterator[np.ndarray]:
    """Random numbers of a shape, over and over; drawing them is not measured."""
    return itertools.cycle(np.random.default_rng(0).uniform(low, high, (64, *shape)))


def actions(space: Any) -> Iterator[np.ndarray]:
    """Random actions in a Box."""
    drawn = itertools.islice(cycle(space.low, space.high, space.shape), 64)
    return itertools.cycle([action.astype(space.dtype) for action in drawn])


def fly_one(env: Any) -> Work:
    """A Gymnasium environment, reset when its episode ends."""
    env.reset(seed=0)
    chosen = actions(env.action_space)

    def work() -> tuple[int, int]:
        ended = 0
        for _ in range(CHUNK):
            _, _, terminated, truncated, _ = env.step(next(chosen))
            if terminated or truncated:
                ended += 1
                env.reset()
        return CHUNK, ended

    return work


def fly_batch(env: Any) -> Work:
    """A Gymnasium vector that resets a row on the step after its end; that step is none."""
    env.reset(seed=0)
    chosen = actions(env.action_space)

    def work() -> tuple[int, int]:
        _, _, terminated, truncated, _ = env.step(next(chosen))
        ended = int(np.count_nonzero(terminated | truncated))
        return env.num_envs - ended, ended

    return work
