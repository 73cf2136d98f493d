"""Memory over time, and of environments that are opened and closed again and again.

Run it on a machine that does nothing else. It exits with 1 if an API leaks.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import tyro

import quadrl
from quadrl.engines.mujoco import ENGINES
from quadrl.environment import Environment
from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.errors import RenderingUnavailable
from scripts.reports import report
from scripts.reports.cost import alone, resident, step
from scripts.reports.report import Result, say, table

SOAK_ENVS = 256
WARM_UP = 0.2  # share of a soak; the slope is that of the rest
KEPT = 20
LEAK = 0.25  # share of what an open environment takes; each closed one that leaves more leaks


def main(seconds: float = 600.0, count: int = 1000) -> None:
    """Measure and write down.

    Args:
        seconds: Length of the soak.
        count: Environments of each API.
    """
    result: Result = {"soak": alone(soak, seconds), "leak": []}
    for what in OPENED:
        try:
            result["leak"].append(alone(growth, what, count))
            say(result["leak"][-1])
        except RenderingUnavailable as error:
            say(f"{what}: {error}")
    report.save("memory", result)
    sys.exit("; ".join(f"{row['what']} leaks" for row in result["leak"] if leaks(row)) or None)


def soak(seconds: float) -> Result:
    """Both engines in one process under random actions, and the growth of its memory."""
    environments = [Environment("landing", num_envs=SOAK_ENVS, engine=name) for name in ENGINES]
    rng, size = np.random.default_rng(0), environments[0].action_size
    for environment in environments:
        environment.reset()
    curve: list[tuple[float, float]] = []  # [s], [kB], every second
    began, steps, episodes = time.perf_counter(), 0, 0
    while (passed := time.perf_counter() - began) < seconds:
        if passed >= len(curve):
            curve.append((passed, resident()))
        for environment in environments:
            episodes += step(environment, rng.uniform(-1, 1, (SOAK_ENVS, size)))
        steps += len(environments) * SOAK_ENVS
    known = {"seconds": seconds, "control_steps": steps, "episodes": episodes}
    return known | {"slope_kb_min": slope(curve), "memory_mb": curve[-1][1] / 1024}


def slope(curve: list[tuple[float, float]]) -> float:
    """Growth after the warm-up by least squares [kB/min]."""
    time_s, memory = np.array(curve).T
    late = time_s > WARM_UP * time_s[-1]
    return float(60 * np.polyfit(time_s[late], memory[late], 1)[0])


def growth(what: str, count: int) -> Result:
    """Memory of this process as environments are opened and closed, after some uncounted ones.

    Some are kept open at the end, which says how much one that leaked would have taken.
    """
    marks = []
    for number in (max(10, count // 10), count // 2, count - count // 2):
        for _ in range(number):
            getattr(OPENED[what](), "close", lambda: None)()  # an Environment needs none
        marks.append(resident(trim=True))
    kept = [OPENED[what]() for _ in range(KEPT)]
    open_kb = (resident(trim=True) - marks[-1]) / len(kept)
    return {"what": what, "count": count, "marks_kb": marks, "open_kb": open_kb}


def leaks(row: Result) -> bool:
    """Whether the second half grew: the first half may still settle."""
    _, middle, after = row["marks_kb"]
    return (after - middle) / (row["count"] / 2) > LEAK * row["open_kb"]


def flown(env: Any, *size: int, **seed: int) -> Any:
    """An environment after a reset and a step with actions of zero."""
    env.reset(**seed)
    env.step(np.zeros((*size, 4), np.float32))
    return env


def after(env: Any, method: str, *arguments: Any) -> Any:
    """An environment after a call of a method."""
    getattr(env, method)(*arguments)
    return env


PICTURE: dict[str, Any] = {"render_mode": "rgb_array", "width": 64, "height": 48}
FREE_FLIGHT = {"num_envs": 512, "num_threads": 2, "engine": "free_flight"}
OPENED: dict[str, Callable[[], Any]] = {
    "Environment": lambda: flown(Environment("landing", seed=0), 1),
    "Environment of 512, free flight": lambda: flown(Environment("landing", **FREE_FLIGHT), 512),
    "quadrl.load": lambda: flown(quadrl.load("landing")),
    "gym.make": lambda: flown(gym.make("quadrl/Landing-v0"), seed=0),
    "gym.make_vec of 8": lambda: flown(gym.make_vec("quadrl/Landing-v0", num_envs=8), 8, seed=0),
    "QuadrotorEnv of 8": lambda: after(QuadrotorEnv("landing", 8), "rollout", 1),
    "gym.make, a picture drawn": lambda: after(
        flown(gym.make("quadrl/Landing-v0", **PICTURE), seed=0), "render"
    ),
}


def soaked() -> str:
    """The slope."""
    soak = report.load("memory")["soak"]
    return (
        f"{soak['control_steps']:,} control steps and {soak['episodes']:,} episodes in "
        f"{soak['seconds']:.0f} s; after the first fifth, memory changes by "
        f"{soak['slope_kb_min']:+.1f} kB/min at {soak['memory_mb']:.0f} MB."
    )


def leaked() -> str:
    """Memory by API."""
    result = report.load("memory")
    rows = (
        (
            row["what"],
            f"{row['count']:,}",
            *(f"{mark / 1024:.1f}" for mark in row["marks_kb"]),
            f"{(row['marks_kb'][-1] - row['marks_kb'][0]) / row['count']:.2f}",
            f"{row['open_kb']:.0f}",
        )
        for row in result["leak"]
    )
    head = ["environment", "opened and closed", "before [MB]", "half-way [MB]", "after [MB]"]
    head += ["left by each [kB]", "taken by an open one [kB]"]
    return f"{table(head, rows)}\n\n{report.source(result)}"


PARTS: report.Parts = {"soak": soaked, "leak": leaked}

if __name__ == "__main__":
    tyro.cli(main)
