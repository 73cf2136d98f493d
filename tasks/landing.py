"""Landing: touch down on a pad, smoothly, and come to rest."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array, namespace, norm, square_norm, stack, zeros
from quadrl.control.reading import Reading
from quadrl.core import rewards
from quadrl.core.contact import stands, strikes_ground
from quadrl.core.markers import Marker
from quadrl.core.snapshot import Rollout, statistic
from quadrl.core.task import TURNING, EpisodeEnd, Snapshot, Target, Task, TaskState, heads_east
from quadrl.engines.rng import Rng
from quadrl.engines.state import REST_SPEED, Start
from quadrl.tasks.approach import descent

PAD = (0.95, 0.95, 0.95, 1.0)


@dataclasses.dataclass(frozen=True)
class Touchdown(TaskState):
    """The touchdown so far."""

    down: Array  # (N,) 1 once a foot has touched, 0 before
    speed: Array  # (N,) [m/s], at the last control step
    rest: Array  # (N,) control steps at rest on the pad, without a break


@dataclasses.dataclass(frozen=True)
class Landing(Task):
    """Land on the pad; the origin of the frame is where the aircraft's centre comes to rest."""

    name, version = "landing", 1
    compiled = True
    asks = "touch down smoothly on a pad, without a crash and without sinking into its own wash"
    starts = "3 m up, within 1.5 m sideways, at rest, any heading"
    ends = (
        "at rest on the pad (success); sinking faster than 2 m/s along the body's axis; rotor or "
        "hull strikes, touchdown faster than 0.5 m/s or tilted more than 15 degrees; more than "
        "5 m away"
    )
    solved = "at rest on the pad, upright, within 10 degrees of east"
    targets = (
        Target("success_rate", "successful", 0.98, True),
        Target("crash_rate", "crashes", 0.0),
        Target("touchdown_speed_median_m_s", "touchdown, median", 0.3),
        TURNING,  # while it comes down: on its feet it rests
    )
    training = {"gamma": 0.98, "steps": 2_621_440}
    training_with = {
        # With the task's own weight, two of four policies came down before they had turned east.
        "ppo": {"training_options": {"attitude_weight": 100.0}, "ppo": {"beta2": 0.99}},
        # With the task's own weights it learns to stay in the air.
        "trpo": {"training_options": {"attitude_weight": 60.0, "progress_weight": 200.0}},
        # Chosen by a search: docs/paper.md.
        "vpg": {
            "num_envs": 128,
            "rollout": 16,
            "gae_lambda": 0.99,
            "vpg": {"learning_rate": 7.4e-4, "critic_rate": 1.6e-3},
        },
    }
    # With the wide action scale of that variant, actions as random as usual end in a crash before
    # anything is learned.
    variants = {
        "robust": {
            "gamma": 0.97,
            "initial_deviation": 0.4,
            # Otherwise it keeps turning on aircraft whose rotors have no inertia to turn against.
            "randomization": {"rotor_inertia": (0.01, 1.2)},
            "task_options": {"progress_weight": 200.0, "attitude_weight": 60.0},
            "training_options": {"attitude_weight": 60.0},
        }
    }
    heading_matters = True
    keeps_place = False
    contact = True

    altitude: float = 0.0
    """Height of the origin above the ground [m]; at least the height of the aircraft's centre when
    it stands on its feet."""
    survival_weight: float = 0.0
    """Reward per 0.05 s; zero, since with a reward the policy would hover over the pad instead of
    coming to rest."""
    speed_weight: float = 5.0
    """Reward per m/s by which the speed falls."""
    spin_weight: float = 10.0
    """Reward per rad/s by which the body rate falls; with smaller values the aircraft keeps
    turning."""
    haste_weight: float = 60.0
    """Cost per 0.05 s of sinking 1 m/s faster than a gentle approach; larger than the progress
    reward."""
    gentle_speed: float = 0.1
    """Sink rate of a gentle approach at the pad [m/s]."""
    gentle_rate: float = 0.6
    """Increase of the gentle sink rate per metre of height [1/s]."""
    success_weight: float = 100.0
    """Reward for coming to rest on the pad; with 200 the policy hurries and touches down faster."""
    failure_weight: float = 300.0
    """Cost of a failure; larger than the progress of a dive to the ground."""
    start_height: float = 3.0
    """Height of the start over the pad [m]."""
    start_offset: float = 1.5
    """Largest distance of the start from the pad's axis [m]."""
    max_sink: float = 2.0
    """Speed along the negative body z axis that ends the episode [m/s]; beyond it the aircraft is
    in its own rotor wash."""
    max_touchdown: float = 0.5
    """Largest speed of a touchdown [m/s]."""
    max_tilt: float = math.radians(15.0)
    """Largest tilt of a touchdown [rad]."""
    max_distance: float = 5.0
    """Distance from the pad that ends the episode [m]."""
    pad_radius: float = 0.5
    """Radius of the pad [m]."""
    heading_tolerance: float = math.radians(10.0)
    """Largest angle off east at the end that counts as success [rad]."""
    rest_time: float = 0.25
    """How long the aircraft has to be at rest [s]."""

    def begin(self, rng: Rng, parameters: Parameters) -> tuple[Start, TaskState]:
        """Level and at rest, high over the pad and beside its axis."""
        offset = rng.uniform(0.0, self.start_offset)
        zero = namespace(offset).zeros_like(offset)
        up = stack(zero, zero, zero + self.start_height)
        position = up + offset[..., None] * rng.level_direction()
        state = Touchdown(goal=0 * position, down=zero, speed=0 * zero, rest=0 * zero)
        return rng.level_start(position, parameters), state

    def remember(self, start: Start, drawn: Any) -> TaskState:
        """The speed with which it begins."""
        return dataclasses.replace(drawn, speed=norm(start.velocity))

    def terminated(self, now: Snapshot) -> dict[str, Array]:
        """Crashed, in its own wash, away, or at rest for long enough."""
        state, down = now.state, stands(now)
        tilted = state.cos_tilt < math.cos(self.max_tilt)
        # The speed of a touchdown is that of the last control step in the air.
        hard = (now.task.down == 0) & (now.task.speed > self.max_touchdown)
        sinks = state.body_velocity[..., 2] < -self.max_sink
        away = now.potentials.distance > self.max_distance
        crashed = strikes_ground(now) | (down & (tilted | hard))
        return {"crashed": crashed, "own_wash": sinks, "away": away, "at_rest": self._rested(now)}

    def succeeded(self, now: Snapshot, end: EpisodeEnd) -> Array:
        """At rest on the pad for long enough, upright, on its feet alone, and heading east."""
        upright = now.state.cos_tilt >= math.cos(self.max_tilt)
        stood = end.terminated & self._rested(now) & upright & ~strikes_ground(now)
        return stood & heads_east(now, self.heading_tolerance)

    def update(self, before: Snapshot, now: Snapshot) -> TaskState:
        """Remember the touchdown, the speed and how long the aircraft has been at rest."""
        down = now.task.down
        xp = namespace(down)
        return Touchdown(
            goal=now.task.goal,
            down=xp.where(stands(now), xp.ones_like(down), down),
            speed=now.potentials.speed,
            rest=self._rest(now),
        )

    def reward(self, before: Snapshot, now: Snapshot, end: EpisodeEnd) -> dict[str, Array]:
        """Down to the pad, level and heading east, without haste, and what the end is worth."""
        height, last = (abs(shot.potentials.to_goal[..., 2]) for shot in (now, before))
        # Not the speed: exploration adds some in every direction, which would cost most near the
        # ground, and the aircraft would stay in the air.
        sink = (last - height) / now.parameters.control_timestep
        haste = sink - (self.gentle_speed + self.gentle_rate * height)
        cost = self.haste_weight * rewards.time_share(now.parameters)
        terms = "progress", "attitude", "speed", "spin", "control", "survival", "smoothness"
        return {
            **rewards.weighted(self, terms, before, now),
            "haste": -cost * namespace(haste).where(haste > 0, haste, zeros(height)),
            "success": rewards.once(self.success_weight, end.succeeded, now),
            "failure": rewards.once(-self.failure_weight, end.failed, now),
        }

    def guide(self, reading: Reading) -> tuple[Array, Array]:
        """Over the pad, then down, slower the lower, once it heads east; then it presses on."""
        return descent(reading, self.heading_tolerance)

    def markers(self, now: Snapshot) -> Sequence[Marker | Primitive]:
        """The pad."""
        return [Marker("pad", size=self.pad_radius, rgba=PAD)]

    def metrics(self, rollout: Rollout) -> dict[str, float]:
        """Speed of the touchdowns, the crashes, and the time that a landing takes."""
        down = rollout.position[..., 2] < 0.01
        first = down.argmax(0)
        flights = np.flatnonzero(down.any(0) & (first > 0))
        speed = np.linalg.norm(rollout.velocity[first[flights] - 1, flights], axis=-1)
        last = rollout.length, np.arange(len(rollout.length))
        still = norm(rollout.velocity[last]) < REST_SPEED
        crashed = rollout.terminated & ~rollout.is_success & ~(still & down[last])
        return {
            "touchdown_speed_median_m_s": statistic(np.median, speed),
            "touchdown_speed_max_m_s": statistic(np.max, speed),
            "crash_rate": float(crashed.mean()),
            "landing_time_mean_s": statistic(np.mean, rollout.success_time),
        }

    def _rest(self, now: Snapshot) -> Array:
        """Control steps at rest on the pad, this one included, (N,)."""
        rest = now.task.rest
        return namespace(rest).where(self._rests(now), rest + 1, 0 * rest)

    def _rests(self, now: Snapshot) -> Array:
        """Whether it is at rest on the pad, (N,) bool."""
        over_pad = square_norm(now.state.position[..., :2]) < self.pad_radius**2
        return stands(now) & now.state.at_rest & over_pad

    def _rested(self, now: Snapshot) -> Array:
        """Whether it has been at rest on the pad for long enough, (N,) bool."""
        return self._rest(now) * now.parameters.control_timestep >= self.rest_time
