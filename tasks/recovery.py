"""Recovery: come to rest, level and in the air, after being thrown in any attitude."""

from __future__ import annotations

import dataclasses
import math

from quadrl.aircraft.parameters import Parameters
from quadrl.base.rotation import Array, namespace, norm, stack, zeros
from quadrl.core import rewards
from quadrl.core.contact import touches_ground
from quadrl.core.observation import MOTION, ROTATION, observed_motion
from quadrl.core.task import STILL, EpisodeEnd, Potentials, Snapshot, Target, Task, TaskState
from quadrl.engines.rng import Rng, hovering
from quadrl.engines.state import Start


@dataclasses.dataclass(frozen=True)
class Recovery(Task):
    """Level out, stop and stay off the ground, then fly back to the place above the start."""

    name = "recovery"
    compiled = True
    asks = "come to rest at the origin, 3 m above the ground, after a throw in any attitude"
    starts = "3 m above the ground, any attitude, thrown at up to 3 m/s and 6 rad/s"
    ends = "more than 20 m away, on the ground"
    solved = "in the air until the end, then level within 10 degrees, under 0.2 m/s and 0.5 rad/s"
    targets = (Target("success_rate", "successful", 0.95, True), *STILL)
    trained_on = "crazyflie"  # which can turn over within these heights
    training = {
        "vehicle_options": {"action_scale": 500.0},
        "training_options": {"lowest": 1.0, "highest": 4.0},
    }
    training_with = {
        # Smooth, since APG knows no dead time, with which a quick answer to the body rate chatters.
        "apg": {
            "steps": 245_760,
            "num_envs": 128,
            "gamma": 0.95,
            "gae_lambda": 0.95,
            "training_options": {"smoothness_weight": 10.0},
        },
        # APG finds how to turn over, which PPO from nothing hardly does; PPO adds the dead time.
        "ppo": {
            "phases": ({"algo": "apg"},),
            "steps": 400_000,
            "gamma": 0.95,
            "gae_lambda": 0.95,
            "ppo": {"learning_rate": 1e-3},
            "training_options": {
                "progress_weight": 200.0,
                "attitude_weight": 60.0,
                "speed_weight": 10.0,
                "spin_weight": 10.0,
                "smoothness_weight": 10.0,
            },
        },
    }
    variants = {
        "robust": {  # of the Crazyflie, indoors
            "weather": "calm",
            "aerodynamics": "full",
            # From 3 m there is no time to find out about an aircraft of any torque.
            "randomization": {
                **{"mass": (0.85, 1.15), "thrust": (0.88, 1.12), "lag": (0.6, 1.7)},
                **{"command_delay": (0.0, 0.03), "rotors": (0.97, 1.03), "torque": None},
            },
            # APG cannot begin with late commands and noise.
            "phases": ({"algo": "ppo", "ppo": {"learning_rate": 3e-3}},),
            "ppo": {"learning_rate": 1e-3},
        }
    }
    observation = ROTATION | MOTION

    time_limit: float = 5.0
    """Time limit of an episode [s]."""
    lowest: float = 3.0
    """Smallest height of the start above the ground [m]."""
    highest: float = 3.0
    """Largest height of the start above the ground [m]."""
    tilt: float = math.pi
    """Largest tilt at the start [rad]; the heading is any."""
    speed: float = 3.0
    """Largest speed at the start [m/s]."""
    spin: float = 6.0
    """Largest body rate at the start [rad/s]."""
    max_distance: float = 20.0
    """Distance from the origin that ends the episode [m]."""
    tilt_tolerance: float = math.radians(10.0)
    """Largest tilt at the end that counts as success [rad]."""
    speed_tolerance: float = 0.2
    """Largest speed at the end that counts as success [m/s]."""
    spin_tolerance: float = 0.5
    """Largest body rate at the end that counts as success [rad/s]."""

    def begin(self, rng: Rng, parameters: Parameters) -> tuple[Start, TaskState]:
        """Over or under the origin, in any attitude, in motion; the rotors at hover speed."""
        height = rng.uniform(self.lowest, self.highest) - self.altitude
        position = stack(zeros(height), zeros(height), height)
        start = Start(
            position=position,
            quaternion=rng.attitude(self.tilt),
            velocity=rng.vector(self.speed),
            body_rate=rng.vector(self.spin),
            rotor_speed=hovering(position, parameters),
        )
        return start, TaskState(goal=namespace(position).zeros_like(position))

    def measure(self, now: Snapshot) -> Potentials:
        """The attitude error is the chord from the body's z axis to the vertical, at most 2.

        Unlike the sum of |sin| and |cos - 1|, which falls again near 180 degrees, it grows with the
        tilt all the way.
        """
        axis = now.state.rotation[..., :, 2]  # (N, 3), body z in the world
        chord = norm(stack(axis[..., 0], axis[..., 1], 1 - axis[..., 2]))
        return dataclasses.replace(super().measure(now), attitude=chord)

    def observe(self, now: Snapshot) -> dict[str, Array]:
        """The aircraft's motion, its attitude as the rotation matrix, and the way to the origin.

        The height above the ground is in the last two.
        """
        return {"rotation": now.state.rotation_entries, **observed_motion(now)}

    def reward(self, before: Snapshot, now: Snapshot, end: EpisodeEnd) -> dict[str, Array]:
        """Upright, slower, nearer to the origin, at little effort, in the air."""
        terms = "progress", "attitude", "speed", "spin", "control", "survival", "smoothness"
        return rewards.weighted(self, terms, before, now)

    def terminated(self, now: Snapshot) -> dict[str, Array]:
        """Far away or on the ground."""
        away = now.potentials.distance > self.max_distance
        return {"away": away, "ground": touches_ground(now)}

    def succeeded(self, now: Snapshot, end: EpisodeEnd) -> Array:
        """Flying at the end, level and slow."""
        level = now.state.cos_tilt > math.cos(self.tilt_tolerance)
        slow = now.state.speed < self.speed_tolerance
        return end.truncated & level & slow & (now.state.angular_speed < self.spin_tolerance)
