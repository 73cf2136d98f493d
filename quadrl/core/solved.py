"""What counts as a solved task: the figures of an evaluation that a policy has to reach."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

from quadrl.base.units import quantity


@dataclasses.dataclass(frozen=True)
class Target:
    """A figure of an evaluation that a policy has to reach for a task to count as solved."""

    metric: str
    """Name of the figure in `quadrl.evaluation.rollout.summarize`."""
    words: str
    """What it is."""
    limit: float
    """In the unit of the metric's name, in which it is shown too; shares as shares."""
    at_least: bool = False
    """Whether the figure must reach the limit, or stay under it."""

    def met(self, metrics: Mapping[str, Any]) -> bool:
        """Whether an evaluation reaches it; a figure that is missing or no number does not."""
        value = math.nan if (found := metrics.get(self.metric)) is None else found
        return value >= self.limit if self.at_least else value <= self.limit

    @property
    def asked(self) -> str:
        """What it asks, in its unit."""
        word = "at least" if self.at_least else "at most"
        return f"{word} {quantity(self.metric, float(self.limit))}"


def missed(targets: Iterable[Target], metrics: Mapping[str, Any]) -> str:
    """Which of some targets an evaluation misses, and by how much; "" if none."""
    words: list[str] = []
    for target in (target for target in targets if not target.met(metrics)):
        found = metrics.get(target.metric)
        said = f"{target.words} {quantity(target.metric, found)}, asked {target.asked}"
        if found is not None:
            gap = quantity(target.metric, float(abs(found - target.limit)))
            said += f": {gap} {'short' if target.at_least else 'over'}"
        words.append(said)
    return "; ".join(words)


TURNING = Target("yaw_rate_rad_s", "yaw rate over the last 2 s", 0.3)
STILL = (TURNING, Target("circling_m_s", "circling over the last 2 s", 0.05))
"""Targets of tasks that end at rest, beside the position: an aircraft that turns or circles has not
solved the task."""
