"""A recorded flight, as it is drawn."""

# pyright: standard
# SciPy has no types.
from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array
from quadrl.core.markers import Marker

Shown = tuple[Marker | Primitive, ...]
FASTEST_GOAL = 10.0  # [m/s]; one that moves faster has jumped


SUCCESS, FAILURE, TIME_OVER = "successful", "failed", "time over"


def outcome(terminated: Any, truncated: Any, is_success: Any) -> str:
    """How an episode ended, in plain words; empty while it goes on."""
    if is_success:
        return SUCCESS
    return FAILURE if terminated else TIME_OVER if truncated else ""


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """A flight of T states of an aircraft with R rotors."""

    time: Array  # (T,) [s], increasing
    qpos: Array  # (T, 7) position [m] and attitude (w, x, y, z), world frame
    rotor_speed: Array  # (T, R) [rad/s]
    error: Array  # (T,) [m], distance from the goal
    reward: Array  # (T,)
    goal: Array  # (T, 3) [m], world frame
    control_timestep: float  # [s]
    max_rotor_speed: Array | float  # (R,) or one for all [rad/s]
    task: str  # its name
    # World frame; one tuple per state, or one for all.
    markers: Sequence[Shown] = ((),)
    events: Sequence[str] = ("",)  # what has happened to the aircraft; one per state, or for all
    outcome: str = ""  # how the episode ended, shown with the last state
    wind: Array | None = None  # (T, 3) [m/s], world frame; None for calm air
    # What was flown, as `Scenario.to_json` gives it; pictures and videos carry it.
    scenario: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def resampled(self, fps: float) -> Trajectory:
        """The same flight at `fps` states a second; a goal that jumps is not interpolated."""
        from scipy.interpolate import PchipInterpolator, make_interp_spline
        from scipy.spatial.transform import Rotation, Slerp

        if len(self.time) < 2:
            return self
        time = np.arange(self.time[0], self.time[-1] + 1e-9, 1 / fps).clip(max=self.time[-1])
        before = np.searchsorted(self.time, time, side="right") - 1
        after = np.minimum(before + 1, len(self.time) - 1)

        def linear(values: Array) -> Array:
            return make_interp_spline(self.time, values, k=1)(time)

        stride = np.linalg.norm(self.goal[after] - self.goal[before], axis=-1, keepdims=True)
        jump = stride > FASTEST_GOAL * self.control_timestep
        attitude = Slerp(self.time, Rotation.from_quat(self.qpos[:, 3:], scalar_first=True))(time)
        position = PchipInterpolator(self.time, self.qpos[:, :3])(time)
        markers = self.markers
        if len(markers) > 1:
            shares = linear(np.arange(float(len(self.time)))) - before
            between = zip(before, after, shares, strict=True)
            markers = [_between(markers[k], markers[n], share) for k, n, share in between]
        return dataclasses.replace(
            self,
            time=time,
            qpos=np.concatenate([position, attitude.as_quat(scalar_first=True)], axis=1),
            rotor_speed=linear(self.rotor_speed),
            error=linear(self.error),
            reward=self.reward[before],
            goal=np.where(jump, self.goal[before], linear(self.goal)),
            markers=markers,
            events=[self.events[k] for k in before] if len(self.events) > 1 else self.events,
            wind=None if self.wind is None else linear(self.wind),
        )


def _between(before: Shown, after: Shown, share: float) -> Shown:
    """What is drawn between two states; markers with an end stay until they jump, as solids do."""
    kinds = [[getattr(one, "kind", None) for one in shown] for shown in (before, after)]
    if before is after or kinds[0] != kinds[1]:
        return before
    between: list[Marker | Primitive] = []
    for one, other in zip(before, after, strict=True):
        if isinstance(one, Marker) and isinstance(other, Marker) and not one.end:
            way = np.subtract(other.position, one.position)
            one = dataclasses.replace(one, position=tuple(one.position + share * way))
        between.append(one)
    return tuple(between)
