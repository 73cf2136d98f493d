"""LSY race: through four small gates among poles; their places change in each episode."""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Sequence
from typing import Any, cast

from quadrl.aircraft.parameters import Parameters
from quadrl.base.primitives import Primitive
from quadrl.base.rotation import (
    Array,
    dot,
    filled,
    namespace,
    norm,
    quaternion_from_heading_and_tilt,
    stack,
    zeros,
)
from quadrl.base.validation import number
from quadrl.core import rewards
from quadrl.core.observation import ObservationTerm
from quadrl.core.snapshot import Potentials
from quadrl.core.task import EpisodeEnd, Snapshot, Target
from quadrl.engines.rng import FULL_TURN, Rng, hovering
from quadrl.engines.state import Start
from quadrl.tasks.arena import Arena, furnished
from quadrl.tasks.gates import GateRace
from quadrl.tasks.tracks import Track, known

LIMITS = 3.0, 3.0, 2.5  # [m], along x, y and z, beyond which a race ends
# An aircraft farther than STRAIGHT [m] from the gate's axis is led through a point up to LEAD [m]
# before the gate.
STRAIGHT, LEAD = 0.05, 0.3
MOST = 1.9  # size of the box at which it would reach both sides of an opening at once
ROOM = 0.15  # [m], about the box, in which a flight costs more
SPEED = 1.0  # [m/s], most at a start in flight; much faster ones end in the pole behind gate three
# The first training finds the way. From the start alone the last gates are hardly seen, and a
# policy that seldom gets through a gate learns to wait before it: some episodes have a smaller box.
FINDS = {"flying": 0.95, "least_box": 0.3, "box": 1.0, "crash_weight": 20.0, "paid_speed": 2.0}
# The second one flies it with more room than the rules ask for.
WITH_ROOM = {"flying": 0.5, "least_box": 0.7, "box": 1.2, "crash_weight": 60.0, "paid_speed": 2.4}


@dataclasses.dataclass(slots=True)
class Distances(Potentials):
    """What the reward is made of, and what ends a race."""

    clearance: Array  # (N,) [m], of the box about the aircraft, as `Arena.clearance` gives it


@dataclasses.dataclass(frozen=True)
class LsyRace(GateRace):
    """Fly the course of LSY's drone racing of summer 2026."""

    name, version = "lsy_race", 2
    compiled = True
    asks = "fly through four small gates among poles; their places change in each episode"
    starts = (
        "at rest up to 3 cm above the ground, the rotors too, within 0.1 m of the start, level and "
        "heading east within 6 degrees"
    )
    solved = "through every gate"
    ends = (
        "through the last gate (success); a box of 14 by 14 by 4 cm about the aircraft against a "
        "pole, a frame or a stand; on the ground after half a second; 3 m from the middle or 2.5 m "
        "high"
    )
    targets = (
        Target("success_rate", "successful", 0.8, True),
        Target("race_time_mean_s", "to the last gate", 4.65),
    )
    contact, on_ground = True, 0.5
    trained_on = "cf21B_500"
    trained_by = "ppo"
    training = {
        "vehicle_options": {"action_scale": 640.0},
        "aerodynamics": "full",  # of which this aircraft has what the competition simulates
        # As the competition draws them: up to 5 g and 1e-6 kg m^2, and forces of up to 0.1 N.
        "randomization": {
            "mass": (0.885, 1.115),
            "inertia": (0.96, 1.04),
            "pushes": {"rate": 500.0, "velocity": 0.0146},
        },
    }
    training_with = {
        "ppo": {
            "steps": 6_400_000,
            "gamma": 0.963,
            "phases": ({"algo": "ppo", "training_options": FINDS},),
            # Where time costs nothing, the race times of trainings differ by a second.
            "training_options": {"time_weight": 0.5, **WITH_ROOM},
        }
    }
    observation = {
        **GateRace.observation,
        "poles": ObservationTerm(12, "m", "to each pole, x, y and z, body frame", "R^T (top - p)"),
    }

    time_limit: float = 15.0
    progress_weight: float = 20.0
    """Reward for each metre that the path to the next gate gets shorter."""
    paid_speed: float = 2.0
    """Speed up to which progress is rewarded [m/s]; a higher one brings more collisions."""
    pass_weight: float = 20.0
    crash_weight: float = 20.0
    low_weight: float = 0.0
    room_weight: float = 1.0
    """Cost, for each 0.05 s, of flying so near to a pole or a frame that the box touches it; it
    falls to nothing 0.15 m away."""
    time_weight: float = 0.0
    """Cost of each 0.05 s."""
    margin: float = -0.025
    """How far from the edge of an opening the aircraft's centre has to pass [m]: the competition
    counts what passes a square of 0.45 m."""
    box: float = 1.0
    """Size of the box that stands for the aircraft in collisions, over the competition's of 14 by
    14 by 4 cm."""
    least_box: float = 1.0
    """Smallest size of this box; each episode draws one between `least_box` and `box`."""
    level: int = 2
    """Level of the competition. At 2, gates and poles are moved by up to 0.15 m, and gates lean by
    up to 0.1 rad and turn by up to 0.2 rad; the policy sees the true place within 0.7 m. At 0 and 1
    they have their nominal places."""
    radius: float = 0.1
    """Largest distance from the start [m], along x and y."""
    tilt: float = 0.1
    """Largest tilt, and largest heading error from east, at the start [rad]."""
    flying: float = 0.0
    """Share of the episodes that begin in flight, in the middle of one of the first gates."""

    def __post_init__(self) -> None:
        """Validate the level."""
        super().__post_init__()
        number(f"{self.name} level", self.level, 0, 2, whole=True)
        number(f"{self.name} box", self.box, 0, MOST)
        number(f"{self.name} least_box", self.least_box, 0, self.box)

    @functools.cached_property
    def course(self) -> Track:
        """The track that is flown, as it should be."""
        return known("lsy")

    def begin(self, rng: Rng, parameters: Parameters) -> tuple[Start, Arena]:
        """At rest at the start; or, in training, in flight, in the middle of a gate."""
        off = 1.0 if self.level == 2 else 0.0
        arena = furnished(rng, self.course, off, (self.least_box, self.box))
        where, u = namespace(arena.gates), [rng.uniform(-1.0, 1.0) for _ in range(5)]
        flies = rng.uniform(0.0, 1.0) < self.flying
        middle = rng.uniform(0.0, len(self.course.gates) - 1.0)
        last = where.floor(middle)
        centre, through, _ = self.gate(arena, last)
        gate = where.where(flies, last + 1, 0 * last)
        goal, ahead, left = self.gate(arena, gate)
        rest = self.radius * u[0], self.radius * u[1], 0.02 * abs(u[2])
        rest = (at + aside for at, aside in zip(self.course.start, rest, strict=True))
        position = where.where(flies[..., None], centre, stack(*rest))
        speed = where.where(flies, rng.uniform(0.0, SPEED), zeros(last))
        bearing = self.tilt * u[3] + where.where(flies, FULL_TURN * u[4], zeros(last))
        turning = hovering(position, parameters)
        tilt = rng.uniform(0.0, self.tilt), rng.uniform(0.0, FULL_TURN)
        start = Start(
            position=position,
            quaternion=quaternion_from_heading_and_tilt(bearing, *tilt),
            velocity=speed[..., None] * through,
            body_rate=zeros(position),
            rotor_speed=where.where(flies[..., None], turning, zeros(turning)),
        )
        begun: dict[str, Array] = {"goal": goal, "through": ahead, "left": left, "gate": gate}
        return start, dataclasses.replace(arena, passed=gate, **begun)

    def measure(self, now: Snapshot) -> Distances:
        """The usual distances, and what is free about the aircraft, which is worked out once."""
        known: Any = now.potentials  # of this moment, if a passage has changed the goal
        room = known.clearance if known is not None else now.task.clearance(now.state, self.course)
        x = super().measure(now)
        return Distances(x.to_goal, x.distance, x.attitude, x.speed, x.angular_speed, room)

    def update(self, before: Snapshot, now: Snapshot) -> Arena:
        """Go on to the next gate when this one is passed, and remember what has been near."""
        arena = cast(Arena, super().update(before, now))
        return dataclasses.replace(arena, seen=arena.seen_from(now.state.position))

    def observe(self, now: Snapshot) -> dict[str, Array]:
        """Gates and poles, where they were seen or else where they should be."""
        state, arena = now.state, now.task.guessed(self.course)
        seen = super().observe(dataclasses.replace(now, task=arena))
        return seen | {"poles": arena.ways_to_poles(state)}

    def reward(self, before: Snapshot, now: Snapshot, end: EpisodeEnd) -> dict[str, Array]:
        """Nearer to the next gate, what its passage is worth, and away from poles and frames."""
        time, xp = rewards.time_share(now.parameters), namespace(now.time)
        close = xp.clip(1 - cast(Distances, now.potentials).clearance / ROOM, 0.0, 1.0)
        nearer = self._way_left(now.task, before.state.position)
        nearer = nearer - self._way_left(now.task, now.state.position)
        nearer = xp.clip(nearer, None, self.paid_speed * now.parameters.control_timestep)
        return {
            "progress": self.progress_weight * nearer,
            **self.passage(before, now, end),
            "room": -self.room_weight * time * close,
            "time": filled(-self.time_weight * time, close),
        }

    def gate(self, task: Any, number: Array) -> tuple[Array, Array, Array]:
        """Gates with some numbers (N,), where they stand in the episode."""
        return task.frame(number)

    def markers(self, now: Snapshot) -> Sequence[Primitive]:
        """The gates with their stands and the poles, where they stand."""
        return now.task.drawn(self.course)

    def _failures(self, now: Snapshot) -> dict[str, Array]:
        """Against something, on the ground, or beyond the limits, (N,) bool each."""
        struck = cast(Distances, now.potentials).clearance < 0
        outside = (abs(now.state.position[..., k]) > limit for k, limit in enumerate(LIMITS))
        beyond = functools.reduce(operator.or_, outside)
        return {"struck": struck, "beyond_limits": beyond, **super()._failures(now)}

    def _way_left(self, task: Any, place: Array) -> Array:
        """Way to the next gate [m], (N,); from aside or behind by a place before it."""
        off, xp = place - task.goal, namespace(place)
        along = dot(off, task.through)
        aside = norm(off - along[..., None] * task.through)
        lead = xp.clip(aside + 2 * xp.clip(along, 0.0, None) - STRAIGHT, 0.0, LEAD)
        return norm(off + lead[..., None] * task.through) + lead
