"""A GPU beside the processor: whether it flies the same, and how fast it is.

    found = compare(Scenario.of("hover", engine="free_flight"), "cuda")
    assert found.fine("rotor")

In double precision only the sines differ from the processor's; in single precision the motion is
compared step by step from the same state.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from quadrl.core.batch import Batch
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario

COMPARED = 256
"""Aircraft of a comparison."""
EXACT, NEAR, LOOSE = 1e-6, 1e-5, 1e-3
"""Largest differences, relative to 1 + the number: of flights in double precision, whose sines are
others than the processor's; and of the motion after a step in single precision, of all but one
aircraft in a hundred, without and with loops, which take roots of thrusts that are nearly zero."""
NEAR_SOLIDS = 1.0
"""Clearance [m] from which on MuJoCo has not flown an aircraft."""


@dataclasses.dataclass(frozen=True)
class Differences:
    """What a device flies otherwise than the processor."""

    flags: float
    """Ends and successes that differ, a count."""
    double: float
    """Largest difference of observations and rewards in double precision."""
    single: float
    """Difference of the motion after a step in single precision, of all but one in a hundred."""
    ends: float
    """Ends of episodes that were compared, a count."""

    def fine(self, control_mode: str) -> bool:
        """Whether that shows no fault, with the actions of a control mode."""
        near = NEAR if control_mode == "rotor" else LOOSE
        return self.flags == 0 and self.double < EXACT and self.single < near


def differs(found: torch.Tensor, expected: Any) -> torch.Tensor:
    """The largest difference of each row, relative to 1 + the number."""
    own, other = found.double().cpu(), torch.as_tensor(expected).double().cpu()
    return ((own - other).abs() / (1 + other.abs())).reshape(len(own), -1).amax(1)


def compare(scenario: Scenario, device: str, *, steps: int = 100) -> Differences:
    """Fly the same episodes on a device and on the processor, with random actions.

    Where starts are drawn on the processor, the first episode of each row is compared; and where
    there are solids, until one is near, since MuJoCo flies on the processor from there on.

    Args:
        scenario: What is flown, freely.
        device: As torch names it.
        steps: Control steps that are compared.

    Raises:
        QuadrlError: The device does not fly that.
    """
    given = scenario, COMPARED, 7, device
    exact, fast = Batch(*given, precision="float64"), Batch(*given, precision="float32")
    environment = Environment(given[0], num_envs=COMPARED, seed=7)
    for each in (environment, exact, fast):
        each.reset()
    rng, found = np.random.default_rng(0), {"flags": 0.0, "double": 0.0, "single": 0.0, "ends": 0.0}
    single: list[torch.Tensor] = []
    same, solids = np.ones(COMPARED, dtype=bool), bool(environment.scene.solids)
    for _ in range(steps):
        action = rng.normal(0, 0.4, (COMPARED, environment.action_size)).astype(np.float32)
        fast.table.copy_(exact.table)
        fast.episodes.copy_(exact.episodes)
        for batch in (exact, fast):
            batch.action[0].copy_(torch.from_numpy(action))
        now, done = exact.step(), environment.step(action)
        near = fast.step()
        if solids:
            same &= environment.engine.clearance() > NEAR_SOLIDS
        flags = np.stack([done.terminated, done.truncated, done.is_success, done.diverged])
        own = torch.stack([now.terminated, now.truncated, now.success, now.diverged])
        found["flags"] += float((own.cpu().numpy() != flags)[:, same].sum())
        seen = np.concatenate(list(done.observation.values()), -1)
        for own, expected in ((now.final, seen), (now.reward, done.reward)):
            worst = differs(own, expected)[torch.from_numpy(same)].amax() if same.any() else 0.0
            found["double"] = max(found["double"], float(worst))
        flying, motion = ~(now.over | near.over), slice(exact.layout.motion)
        single.append(differs(fast.table[motion].T, exact.table[motion].T)[flying.cpu()])
        over = flags[:2].any(0)
        found["ends"] += float((over & same).sum())
        if exact.layout.pooled:
            same &= ~over
        if over.any():
            environment.reset(np.asarray(over))
    found["single"] = float(torch.cat(single).quantile(0.99))
    return Differences(**found)


def seconds(call: Callable[[], None], times: int) -> float:
    """Time of a call, recorded as a graph, the median of seven rounds of some launches [s]."""
    call()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        call()
    graph.replay()
    rounds: list[float] = []
    for _ in range(7):
        begun, ended = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begun.record()
        for _ in range(times):
            graph.replay()
        ended.record()
        ended.synchronize()
        rounds.append(1e-3 * begun.elapsed_time(ended) / times)
    return sorted(rounds)[3]


def step_seconds(scenario: Scenario, count: int, steps: int = 20) -> float:
    """Time of a control step with random actions, episodes' starts included [s].

    Args:
        scenario: What is flown, freely.
        count: Aircraft.
        steps: Control steps of a launch.
    """
    batch = Batch(scenario, count, 0)
    batch.reset()
    batch.action.normal_(0, 0.3)
    for _ in range(200):  # until some episodes of all lengths are over
        batch.fly(0)

    def fly() -> None:
        for _ in range(steps):
            batch.fly(0)

    each = seconds(fly, 5) / steps
    batch.check()
    return each
