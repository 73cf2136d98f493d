"""Race: through the gates of a track in order, as fast as possible."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array, namespace, norm, zeros
from quadrl.base.trace import look_up
from quadrl.core import rewards
from quadrl.core.snapshot import Rollout
from quadrl.core.task import EpisodeEnd, Snapshot, Target
from quadrl.engines.rng import Rng, hovering
from quadrl.engines.state import Start
from quadrl.tasks.gates import Course, GateRace
from quadrl.tasks.tracks import Track


@dataclasses.dataclass(frozen=True)
class Race(GateRace):
    """Fly through all gates of a track, in order and in their direction, for some laps."""

    name = "race"
    compiled = True
    asks = "fly through the gates of a track in order, as fast as possible"
    starts = "at rest within 0.1 m of the track's start, any heading, tilted up to 0.3 rad"
    ends = (
        "through the last gate (success); through the frame of the next gate, on the ground, more "
        "than 5 m farther from the next gate than when it passed the previous one"
    )
    solved = "through every gate of every lap"
    targets = (
        Target("success_rate", "successful", 0.95, True),
        Target("in_time_rate", "within 6 s", 0.95, True),
        Target("race_time_mean_s", "to the last gate", 6.0),
    )
    # No aircraft has the thrust for it within its usual action scale.
    trained_on = "racer"
    # Gradients through the physics find the way in minutes; PPO does not in millions of steps.
    trained_by = "apg"
    training = {"vehicle_options": {"action_scale": 1250.0}}
    training_with = {
        "apg": {
            "steps": 640_000,
            # A policy that learns with more noise saturates its actions: its mean action flies
            # differently, and fails.
            "initial_deviation": 0.1,
            # From starts at rest alone, later gates and second laps are learned late.
            "training_options": {"laps": 3, "flying": 0.5, "margin": 0.2},
        },
    }

    variants = {
        # As a racer flies: commands 15 to 45 ms late, another mass, lag and thrust, real air.
        "robust": {
            **{"algo": "ppo", "weather": "calm", "aerodynamics": "full"},
            "randomization": {
                **{"mass": (0.88, 1.12), "thrust": (0.94, 1.06), "lag": (0.7, 1.5)},
                **{"command_delay": (0.015, 0.045), "rotors": (0.97, 1.03)},
                "centre_of_mass": None,
            },
            # What moves it is no wind, but its own speed.
            "observe": {"disturbance": None, "sensors": None},
            "task_options": None,
            **{"hidden": (128, 128), "critic_hidden": (128, 128), "initial_deviation": 0.5},
            **{"num_envs": 2048, "rollout": 12.8, "steps": 16_000_000},
            **{"gamma": 0.963, "gae_lambda": 0.95},
            "ppo": {"learning_rate": 1e-3, "minibatch": 16_384},
            "training_options": {
                **{"laps": 3, "flying": 0.95, "margin": 0.2, "crash_weight": 30.0},
                **{"miss_weight": 5.0, "pass_weight": 20.0, "progress_weight": 20.0},
                "low_weight": 1.0,
            },
        }
    }

    track: str = "split_s"
    """Name of the track: airsim, alphapilot or split_s."""
    gates: tuple[tuple[float, ...], ...] | None = None
    """Your own gates: x, y, z [m], heading and climb [deg] of the way through each; by default the
    gates of the track."""
    start: tuple[float, ...] = ()
    """Start of the race [m]; () for the start of the track, or 5 m before the first of your own
    gates."""
    opening: float = 0.0
    """Edge length of the openings [m]; 0 for the value of the track."""
    frame: float = 0.0
    """Outer edge length of the frames [m]; 0 for the value of the track."""
    flying: float = 0.0
    """Share of the episodes that begin in flight, on the way to a random gate."""
    flying_speed: float = 5.0
    """Largest start speed of these episodes, towards the gate [m/s]."""

    @functools.cached_property
    def course(self) -> Track:
        """The track that is flown."""
        return Track.of(self.track, self.gates, self.start, self.opening, self.frame)

    def begin(self, rng: Rng, parameters: Parameters) -> tuple[Start, Course]:
        """At rest at the start, tilted; or, in training, on the way to a random gate."""
        track, count = self.course, len(self.course.gates)
        gate = rng.uniform(0.0, float(count))
        xp = namespace(gate)
        gate, flies = xp.floor(gate), rng.uniform(0.0, 1.0) < self.flying
        rest, away = rng.vector(self.radius), rng.vector(track.opening / 2)
        gate = xp.where(flies, gate, zeros(gate))
        goal = look_up(track.centre, gate)
        last = look_up(np.roll(track.centre, 1, axis=0), gate)
        first = look_up(np.array([track.start]), zeros(gate)) + rest
        between = last + rng.uniform(0.0, 1.0)[..., None] * (goal - last) + away
        position = xp.where(flies[..., None], between, first)
        leg = norm(goal - position)
        speed = xp.where(flies, rng.uniform(0.0, self.flying_speed), zeros(leg))
        start = Start(
            position=position,
            quaternion=rng.attitude(self.tilt),
            velocity=(speed / leg)[..., None] * (goal - position),
            body_rate=zeros(position),
            rotor_speed=hovering(position, parameters),
        )
        none = zeros(gate)
        through, left = (look_up(track.axes[:, k], gate) for k in range(2))
        return start, Course(goal, gate, through, left, none, none, zeros(position), none)

    def reward(self, before: Snapshot, now: Snapshot, end: EpisodeEnd) -> dict[str, Array]:
        """Nearer to the next gate, and what its passage is worth."""
        progress = rewards.weighted(self, ["progress"], before, now)
        return progress | self.passage(before, now, end)

    def metrics(self, rollout: Rollout) -> dict[str, float]:
        """Also the share that is through within 6 s, and the largest body rates."""
        in_time = rollout.is_success & (np.nanmax(rollout.remembered["time"], 0) <= 6.0)
        rates = np.nanmax(np.abs(rollout.body_rate), (0, 1)).tolist()
        names = (f"largest_{axis}_rate_rad_s" for axis in ("roll", "pitch", "yaw"))
        whole = dict(zip(names, rates, strict=True)) | {"in_time_rate": float(in_time.mean())}
        return super().metrics(rollout) | whole

    def markers(self, now: Snapshot) -> Sequence[Primitive]:
        """The gates; the next one in another colour."""
        track = self.course
        return [*track.drawn(int(now.task.gate[0]), track.centre, track.axes)]

    def gate(self, task: Any, number: Array) -> tuple[Array, Array, Array]:
        """Gates with some numbers (N,): centres [m], and unit vectors through them and left."""
        track = self.course
        centre, through, left = track.centre, track.axes[:, 0], track.axes[:, 1]
        return look_up(centre, number), look_up(through, number), look_up(left, number)
