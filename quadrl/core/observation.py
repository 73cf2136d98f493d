"""Named entries of observations: what each is, and where it stands in the flat vector."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping

from quadrl.base.rotation import Array, to_body
from quadrl.core.snapshot import Snapshot


@dataclasses.dataclass(frozen=True)
class ObservationTerm:
    """One named entry of the observation."""

    size: int
    """Numbers in it; per rotor where `per_rotor`."""
    unit: str
    meaning: str
    """And the frame."""
    formula: str = ""
    """How it follows from the estimated state, for exports: as `Sensor.formula`."""
    per_rotor: bool = False

    def width(self, rotors: int) -> int:
        """Numbers in it for an aircraft with some rotors."""
        return self.size * rotors if self.per_rotor else self.size


def layout(terms: Mapping[str, ObservationTerm], rotors: int) -> dict[str, slice]:
    """Where each term stands in the flat vector of an aircraft with some rotors."""
    ends = list(itertools.accumulate(term.width(rotors) for term in terms.values()))
    return dict(zip(terms, map(slice, [0, *ends], ends), strict=False))


MOTION = {
    "velocity": ObservationTerm(3, "m/s", "body frame", "R^T v"),
    "body_rate": ObservationTerm(3, "rad/s", "angular velocity, body frame", "body_rate"),
    "rotor_speed": ObservationTerm(
        1, "1", "rotor speed as a share of the largest", "speed / max_speed", per_rotor=True
    ),
    "goal": ObservationTerm(3, "m", "from the aircraft to the goal, body frame", "R^T (goal - p)"),
}
"""What `observed_motion` gives: the part that depends neither on a place nor on a heading."""

ANGLES = "(atan2(R32, R33), -asin(R31), atan2(R21, R11))"
OBSERVATION = {
    "position": ObservationTerm(3, "m", "world frame, from the origin of the task's frame", "p"),
    "sin_attitude": ObservationTerm(3, "1", "sine of roll, pitch and yaw (Z-Y-X)", f"sin {ANGLES}"),
    "cos_attitude": ObservationTerm(3, "1", "cosine of roll, pitch and yaw", f"cos {ANGLES}"),
    **MOTION,
}
"""The observation of every task, in the order of the flat vector."""

TARGET_VELOCITY = {
    "target_velocity": ObservationTerm(
        3,
        "m/s",
        "of the target relative to the aircraft, body frame",
        "R^T (velocity of the target - v)",
    )
}
"""What tasks with a moving target add at the end."""
TRACKS = {
    "goal": ObservationTerm(3, "m", "place of the target, task frame"),
    "target_velocity": ObservationTerm(3, "m/s", "of the target, world frame"),
}
"""What is measured of a moving target; `Task.tracks`."""

TARGET_MOTION = {
    "target_acceleration": ObservationTerm(3, "m/s^2", "of the target, body frame", "R^T a"),
    "target_jerk": ObservationTerm(3, "m/s^3", "of the target, body frame", "R^T j"),
}
"""What tasks add behind it with which controllers fly ahead of their errors."""

ROTATION = {
    "rotation": ObservationTerm(
        9, "1", "rotation matrix from body to world, row by row", "R, row by row"
    )
}
"""What tasks add that fly in any attitude, `State.rotation_entries`: the sines and cosines of roll
and yaw jump where the pitch passes 90 degrees."""


def observed_motion(now: Snapshot) -> dict[str, Array]:
    """The aircraft's motion and the way to the goal, as it sees them itself."""
    state = now.state
    return {
        "velocity": state.body_velocity,
        "body_rate": state.body_rate,
        "rotor_speed": state.rotor_speed / now.parameters.rotor.max_speed,
        "goal": to_body(state.rotation, now.potentials.to_goal),
    }
