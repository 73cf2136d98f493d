"""Landing on a moving deck: touch down on a boat that follows the waves, and come to rest on it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.base.errors import QuadrlError
from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array, dot, namespace, norm, stack, to_body, to_world, zeros
from quadrl.base.validation import number
from quadrl.conditions.solids import Pose, Solid
from quadrl.control.reading import Reading
from quadrl.core.markers import Marker
from quadrl.core.observation import OBSERVATION, TARGET_VELOCITY, TRACKS, ObservationTerm
from quadrl.core.snapshot import Rollout, statistic
from quadrl.core.task import EpisodeEnd, Snapshot, Target, TaskState, heads_east
from quadrl.engines.rng import Rng
from quadrl.engines.state import REST_SPEED, REST_TURN, Start
from quadrl.tasks import sea
from quadrl.tasks.landing import PAD, Landing
from quadrl.tasks.sea import DECK, Waves

WASH_MARGIN = 0.3  # [m/s], which the yardstick controllers keep from the fastest sinking
NORMAL = ObservationTerm(3, "1", "unit vector out of the deck, body frame", "R^T normal")


@dataclasses.dataclass(frozen=True)
class Sea(Waves):
    """The waves, and the touchdown."""

    down: Array  # (N,) 1 once a foot has touched the deck, 0 before
    speed: Array  # (N,) [m/s], of that touch, relative to the deck
    upright: Array  # (N,) cosine of the angle between the body's z axis and the normal then
    miss: Array  # (N,) [m], from the pad's centre then
    rest: Array  # (N,) control steps at rest on the pad, without a break


@dataclasses.dataclass(frozen=True)
class DeckLanding(Landing):
    """Land on the deck of a boat; the origin of the frame is where its pad lies in calm water."""

    name, version = "deck_landing", 1
    compiled = True
    asks = "touch down on the pad of a boat in waves of sea states 2 to 5, and stay on it"
    starts = "5 m up, within 1.5 m sideways, at rest, any heading"
    ends = (
        "at rest on the pad (success); sinking faster than 2 m/s along the body's axis; rotor or "
        "hull strikes; touchdown faster than 0.5 m/s or more than 15 degrees off the deck; in the "
        "water; more than 8 m away"
    )
    solved = "at rest on the pad for half a second, on the feet, within 10 degrees of east"
    targets = (
        Target("success_rate", "successful", 0.95, True),
        Target("touchdown_speed_median_m_s", "touchdown, median", 0.35),
    )
    training = {"gamma": 0.98, "steps": 8_192_000}
    training_with = {
        "ppo": {
            # As in landing, it would come down before it has turned; and following a deck that
            # sinks, it would fall into its own wash.
            "training_options": {"attitude_weight": 100.0, "max_sink": 1.7},
            "ppo": {"beta2": 0.99},
        },
    }
    variants = {}
    observation = {
        **{name: term for name, term in OBSERVATION.items() if name != "position"},
        **TARGET_VELOCITY,
        "normal": NORMAL,
    }
    tracks = TRACKS | {
        "goal": ObservationTerm(3, "m", "where its centre is on the middle of the pad, task frame"),
        "normal": ObservationTerm(3, "1", "unit vector out of the deck, world frame"),
    }

    time_limit: float = 20.0
    """Time limit of an episode [s]."""
    altitude: float = 6.0
    """Height of the pad over the ground of the world in calm water [m]."""
    start_height: float = 5.0
    """Height of the start over the origin [m]."""
    max_distance: float = 8.0
    """Distance from the pad that ends the episode [m]."""
    pad_radius: float = 1.0
    """Radius of the pad [m]."""
    rest_time: float = 0.5
    """How long the aircraft has to be at rest on the deck [s]."""
    lowest_waves: float = 0.1
    """Smallest significant wave height [m]: sea state 2 of WMO code table 3700."""
    highest_waves: float = 4.0
    """Largest significant wave height [m]: sea state 5."""
    boat_length: float = 12.0
    """Length of the boat [m], along x: shorter waves do not move it."""
    boat_beam: float = 4.0
    """Beam of the boat [m]."""

    def __post_init__(self) -> None:
        """Validate the waves and the boat."""
        super().__post_init__()
        for name in ("lowest_waves", "boat_length", "boat_beam"):
            number(f"{self.name} {name}", getattr(self, name), positive=True)
        if self.highest_waves < self.lowest_waves:
            allowed = f"at least lowest_waves, {self.lowest_waves:g}"
            name = f"{self.name} highest_waves"
            raise QuadrlError(name=name, value=self.highest_waves, allowed=allowed)

    def solids(self) -> Sequence[Solid]:
        """The deck."""
        return [DECK]

    def move(self, state: TaskState, time: Array) -> Mapping[str, Pose]:
        """The deck, as the waves have it."""
        deck = sea.deck(cast(Sea, state), time)
        place = deck.position - DECK.height / 2 * deck.normal
        return {"deck": Pose(place, sea.upright(deck.normal))}

    def begin(self, rng: Rng, parameters: Parameters) -> tuple[Start, Sea]:
        """Level and at rest, high over the deck and beside its axis."""
        start, _ = super().begin(rng, parameters)
        height = rng.uniform(self.lowest_waves, self.highest_waves)
        waves = sea.draw(rng, height, (self.boat_length, self.boat_beam))
        touchdown = ("down", "speed", "upright", "miss", "rest")
        return start, Sea(**vars(waves), **dict.fromkeys(touchdown, zeros(height)))

    def remember(self, start: Start, drawn: Any) -> TaskState:
        """Nothing of the start: the speed is that of the touchdown."""
        return drawn

    def goal(self, now: Snapshot) -> Array:
        """Where the aircraft's centre is when it stands on the pad."""
        deck = sea.deck(now.task, now.time)
        return deck.position - now.parameters.foot[..., 2:] * deck.normal

    def target_velocity(self, now: Snapshot) -> Array:
        """The velocity of the deck."""
        return sea.deck(now.task, now.time).velocity

    def observe(self, now: Snapshot) -> dict[str, Array]:
        """The aircraft's motion, and the deck as it sees it: its height over the water is not."""
        terms = super().observe(now)
        terms.pop("position")
        return {**terms, "normal": to_body(now.state.rotation, self.normal(now))}

    def normal(self, now: Snapshot) -> Array:
        """Unit vectors (N, 3) out of the deck."""
        return sea.deck(now.task, now.time).normal

    def terminated(self, now: Snapshot) -> dict[str, Array]:
        """Crashed, in its own wash, in the water, away, or at rest for long enough."""
        sinks = (now.state.body_velocity[..., 2] < -self.max_sink) & ~now.landed
        away = now.potentials.distance > self.max_distance
        wet = now.potentials.to_goal[..., 2] > sea.FREEBOARD
        failed = {"crashed": self._crashed(now), "own_wash": sinks, "away": away, "water": wet}
        return failed | {"at_rest": self._rested(now)}

    def succeeded(self, now: Snapshot, end: EpisodeEnd) -> Array:
        """At rest on the pad for long enough, and heading east."""
        rested = end.terminated & self._rested(now) & ~self._crashed(now)
        return rested & heads_east(now, self.heading_tolerance)

    def update(self, before: Snapshot, now: Snapshot) -> Sea:
        """Remember the touchdown, and how long the aircraft has been at rest."""
        task, xp = now.task, namespace(now.time)
        first = now.landed & (task.down == 0)
        into, along, cosine = (now.touch[..., k] for k in range(3))
        normal = self.normal(now)
        aside = now.potentials.to_goal - dot(now.potentials.to_goal, normal)[..., None] * normal
        return dataclasses.replace(
            task,
            down=xp.where(now.landed, 0 * task.down + 1, task.down),
            speed=xp.where(first, xp.sqrt(into * into + along * along), task.speed),
            upright=xp.where(first, cosine, task.upright),
            miss=xp.where(first, norm(aside), task.miss),
            rest=self._rest(now),
        )

    def guide(self, reading: Reading) -> tuple[Array, Array]:
        """As to a pad on the ground, and along with the deck, but not into its own wash."""
        offset, velocity = super().guide(reading)
        whole = velocity + reading.target_velocity
        least = namespace(whole).clip(whole[..., 2], WASH_MARGIN - self.max_sink, None)
        return offset, stack(whole[..., 0], whole[..., 1], least)

    def markers(self, now: Snapshot) -> Sequence[Marker | Primitive]:
        """The pad, as it lies on the deck."""
        deck = sea.deck(now.task, now.time)
        place, above = (tuple(deck.position[0] + k * deck.normal[0]) for k in (0.002, 1.0))
        pad = Marker("pad", place, self.pad_radius, PAD, above)
        hull = sea.hull(deck, (self.boat_length, self.boat_beam))
        return [pad, hull, *sea.water(now.task, now.time)]

    def metrics(self, rollout: Rollout) -> dict[str, float]:
        """The touchdowns, and the time that a landing takes."""
        last = rollout.length - 1, np.arange(len(rollout.length))
        names = "down", "speed", "upright", "miss"
        down, *numbers = (rollout.remembered[name][last] for name in names)
        speed, upright, miss = (each[down > 0] for each in numbers)
        tilt = statistic(np.median, np.arccos(np.clip(upright, -1, 1)))
        return {
            "touchdown_speed_median_m_s": statistic(np.median, speed),
            "touchdown_speed_max_m_s": statistic(np.max, speed),
            "touchdown_tilt_median_deg": math.degrees(tilt),
            "miss_median_m": statistic(np.median, miss),
            "landing_time_mean_s": statistic(np.mean, rollout.success_time),
        }

    def _crashed(self, now: Snapshot) -> Array:
        """Whether it struck with anything but its feet, touched down hard or tipped, (N,) bool."""
        into, along, cosine = (now.touch[..., k] for k in range(3))
        hard = into * into + along * along > self.max_touchdown**2
        normal = self.normal(now)
        upright = dot(now.state.rotation[..., :, 2], normal)
        least = math.cos(self.max_tilt)
        tipped = now.landed & (hard | (cosine < least) | (upright < least))
        return tipped | (now.touched[..., 0] & ~now.landed)

    def _rests(self, now: Snapshot) -> Array:
        """Whether it is at rest on the pad, (N,) bool."""
        state, rate = now.state, sea.deck(now.task, now.time).rate
        turn = norm(to_world(state.rotation, state.body_rate) - rate)
        still = (now.potentials.speed < REST_SPEED) & (turn < REST_TURN)
        over_pad = now.potentials.distance < self.pad_radius
        return now.touched[..., 0] & now.landed & still & over_pad
