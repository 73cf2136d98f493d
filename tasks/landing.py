"""Landing: touch down on a pad, smoothly, and come to rest."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from quadrl.rotation import Array, namespace, square_norm
from quadrl.state import Start, State
from quadrl.task import Draw, Errors, Fields, Marker, Measures, Outcome, Task, reward_share
from quadrl.vehicle import Vehicle

if TYPE_CHECKING:
    from quadrl.learning.evaluate import Record


@dataclasses.dataclass
class Touchdown(Fields):
    """What has happened so far."""

    down: Array  # (...) 1 once a foot has touched, 0 before
    speed: Array  # (...) [m/s], at the last control step
    rest: Array  # (...) control steps at rest on the pad, without a break


@dataclasses.dataclass(frozen=True)
class Landing(Task[Touchdown]):
    """Land on the pad; the origin of the frame is where the aircraft's centre comes to rest."""

    name = "landing"
    asks = "touch down smoothly on a pad, without a crash and without sinking into its own wash"
    starts = "3 m up, within 1.5 m sideways, at rest, any heading"
    ends = (
        "at rest on the pad (success); sinking faster than 2 m/s along the body's axis; rotor or "
        "hull strikes, touchdown faster than 0.5 m/s or tilted more than 15 degrees; more than "
        "5 m away"
    )
    solved = "at rest on the pad, upright"
    heading_matters = True
    contact = True

    altitude: float = 0.0
    """Height of the origin above the ground [m]; that of the aircraft on its feet at least."""
    survival_weight: float = 0.0
    """Reward for each step: none, or it would hover over the pad rather than come to rest."""
    speed_weight: float = 5.0
    """Reward for a m/s of speed lost."""
    spin_weight: float = 10.0
    """Reward for a rad/s of body rate lost; with less it may turn for ever and never rest."""
    haste_weight: float = 60.0
    """Cost of sinking a m/s faster than a gentle approach, at each step: more than its progress."""
    gentle_speed: float = 0.1
    """Sink rate of a gentle approach at the pad [m/s]."""
    gentle_rate: float = 0.6
    """What each metre of height adds to it [1/s]."""
    success_weight: float = 100.0
    """Reward for coming to rest on the pad; with 200 it hurries and touches down faster."""
    failure_weight: float = 300.0
    """Cost of a crash: more than the progress of a dive to the ground."""
    start_height: float = 3.0
    """Height of the start over the pad [m]."""
    start_offset: float = 1.5
    """Largest distance of the start from the pad's axis [m]."""
    max_sink: float = 2.0
    """Speed along the negative body z axis that ends the episode: its own rotor wash [m/s]."""
    max_touchdown: float = 0.5
    """Largest speed of a touchdown [m/s]."""
    max_tilt: float = math.radians(15.0)
    """Largest tilt of a touchdown [rad]."""
    max_distance: float = 5.0
    """Distance from the pad that ends the episode [m]."""
    pad_radius: float = 0.5
    """Radius of the pad [m]."""
    rest_time: float = 0.25
    """How long the aircraft has to be at rest [s]."""

    def sample(self, draw: Draw, vehicle: Vehicle) -> tuple[Start, Touchdown]:
        """Level and at rest, high over the pad and beside its axis."""
        offset = draw.uniform(0.0, self.start_offset)
        xp, zero = namespace(offset), namespace(offset).zeros_like(offset)
        up = xp.stack([zero, zero, zero + self.start_height], axis=-1)
        position = up + offset[..., None] * draw.level_direction()
        fields = Touchdown(goal=xp.zeros_like(position), down=zero, speed=zero, rest=zero)
        return draw.level_start(position, vehicle), fields

    def terminated(
        self, state: State, measures: Measures, fields: Touchdown, vehicle: Vehicle
    ) -> Array:
        """Crashed, in its own wash, away, or at rest for long enough."""
        strikes, stands = self.strikes_ground(state, vehicle), self.stands(state, vehicle)
        tilted = state.cos_tilt < math.cos(self.max_tilt)
        # The speed of a touchdown is that of the last control step in the air.
        hard = (fields.down == 0) & (fields.speed > self.max_touchdown)
        sinks = state.body_velocity[..., 2] < -self.max_sink
        away = measures.distance > self.max_distance
        rested = self._rest(state, fields, vehicle) * vehicle.control_step >= self.rest_time
        return strikes | (stands & (tilted | hard)) | sinks | away | rested

    def success(
        self, state: State, fields: Touchdown, errors: Errors, terminated: Array, truncated: Array
    ) -> Array:
        """At rest on the pad: the only way in which a soft, upright, unmoving end comes about."""
        return terminated & state.at_rest & (fields.down > 0) & self._over_pad(state)

    def update(
        self, state: State, measures: Measures, fields: Touchdown, vehicle: Vehicle
    ) -> Touchdown:
        """Remember the touchdown, the speed and how long the aircraft has been at rest."""
        stands, xp = self.stands(state, vehicle), namespace(fields.down)
        return Touchdown(
            goal=fields.goal,
            down=xp.where(stands, xp.ones_like(fields.down), fields.down),
            speed=measures.speed,
            rest=self._rest(state, fields, vehicle),
        )

    def reward(
        self,
        before: Measures,
        now: Measures,
        rotor_command: Array,
        outcome: Outcome,
        vehicle: Vehicle,
    ) -> dict[str, Array]:
        """The common terms, the haste of the approach, and what the end is worth."""
        terms = super().reward(before, now, rotor_command, outcome, vehicle)
        xp, zero = namespace(now.distance), 0.0 * now.distance
        height = abs(now.to_goal[..., 2])
        # Not the speed: exploration gives some in every direction, which would cost most near the
        # ground and keep it in the air.
        sink = (abs(before.to_goal[..., 2]) - height) / vehicle.control_step
        haste = sink - (self.gentle_speed + self.gentle_rate * height)
        weight = self.haste_weight * reward_share(vehicle)
        terms["haste"] = -weight * xp.where(haste > 0, haste, 0.0 * haste)
        terms["success"] = xp.where(outcome.succeeded, zero + self.success_weight, zero)
        terms["failure"] = xp.where(outcome.failed, zero - self.failure_weight, zero)
        return terms

    def markers(self, fields: Touchdown) -> Sequence[Marker]:
        """The pad."""
        return [Marker("pad", size=self.pad_radius, rgba=(0.95, 0.95, 0.95, 1.0))]

    def figures(self, record: Record) -> dict[str, float]:
        """Speed of the touchdowns, the crashes, and the time that a landing takes."""
        down = record.position[..., 2] < 0.01
        first = down.argmax(0)
        flights = np.flatnonzero(down.any(0) & (first > 0))
        speed = np.linalg.norm(record.velocity[first[flights] - 1, flights], axis=-1)
        landed = record.length[record.is_success] * record.control_step
        return {
            "touchdown_speed_median_m_s": float(np.median(speed)) if len(speed) else math.nan,
            "touchdown_speed_max_m_s": float(speed.max()) if len(speed) else math.nan,
            "crash_rate": float((record.terminated & ~record.is_success).mean()),
            "landing_time_mean_s": float(landed.mean()) if len(landed) else math.nan,
        }

    def _rest(self, state: State, fields: Touchdown, vehicle: Vehicle) -> Array:
        """Control steps at rest on the pad, this one included."""
        rests = self.stands(state, vehicle) & state.at_rest & self._over_pad(state)
        xp = namespace(fields.rest)
        return xp.where(rests, fields.rest + 1, xp.zeros_like(fields.rest))

    def _over_pad(self, state: State) -> Array:
        return square_norm(state.position[..., :2]) < self.pad_radius**2
