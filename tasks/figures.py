"""What a trajectory follows: named figures, the curve of a file, and random curves."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.rotors import GRAVITY
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array, namespace, stack
from quadrl.engines.rng import FULL_TURN, Rng
from quadrl.tasks.recordings import Recorded, smoothed
from quadrl.tasks.reference_rows import SURE, apart
from quadrl.tasks.references import AXES, PIECE, WAVES, Reference, Table, pieces

SINES = {
    # SimpleFlight: 2 m x 1 m, begun in the crossing, where it is fastest.
    "lemniscate": (5.5, ((1.0, 1, math.pi), (0.5, 2, math.pi), (0.0, 1, 0.0))),
    # crazyflow: east and up.
    "vertical": (10.0, ((1.0, 1, 0.0), (0.0, 1, 0.0), (0.5, 2, 0.0))),
}
"""Figures of one sine in each coordinate: the usual period [s]; amplitude [m], turns in a period,
and phase [rad] of each."""
FIGURES = ("random", *SINES, "zigzag", "pentagram", "polynomial")
SHORTEST, LOWEST = 1.0, 0.3  # period of a figure [s]; height of a reference above the ground [m]
TRACKS, SEED = 32, 0  # curves of a figure that is drawn once and for all
SLOWEST, FASTEST = 0.2, 4.5  # [rad/s], sines of a random curve
ROUNDING = 1e-3  # [m], by which smoothing may bring a curve out of its room
CLIMB = 0.3  # share of the largest acceleration with which it climbs and sinks


@dataclasses.dataclass(frozen=True)
class Figure(Table):
    """A figure, the curve of a file, or random curves."""

    name: str  # one of FIGURES, or the file of a record
    cycle: float  # [s], a period, for which it is looked at
    acceleration: float  # [m/s^2], the largest of a random curve
    extent: float  # [m], its largest distance from its middle along each axis

    @classmethod
    def of(cls, figure: str | Recorded, seconds: float, *others: float) -> Figure:
        """Make the curves of a figure, or the one of a csv file.

        Args:
            figure: One of FIGURES, or what was recorded of a file.
            seconds: For which it is flown.
            *others: Cycle, acceleration and extent.
        """
        made, count, turns = np.zeros((1, 4, AXES)), 1, None
        if figure in ("zigzag", "pentagram"):
            points = _drawn(1.0, 1.5, 0.0, seconds) if figure == "zigzag" else _star(seconds)
            made, count = pieces(*points, 1, seconds)
        elif figure == "polynomial":
            made, count = pieces(*_drawn(1.5, 4.0, 0.5, seconds), 5, seconds)
        elif isinstance(figure, Recorded):
            times, points = figure.points()
            whole, count = pieces(times[None], points[None], 3, seconds)
            made = np.ascontiguousarray(whole[..., :AXES])
            if whole.shape[-1] > AXES:
                turns = np.ascontiguousarray(whole[..., AXES])
                turns.flags.writeable = False
        made.flags.writeable = False
        name = figure.file if isinstance(figure, Recorded) else figure
        return cls(made, count, turns, name, *others)

    def reference(self, rng: Rng, like: Array) -> Reference:
        """The references of episodes, rows as in an array (N, 3)."""
        if self.name == "random":
            return self._random(rng)
        zero, track = 0 * like[..., 0], 0 * like[..., 0]
        if (tracks := len(self.pieces) // self.count) > 1:
            track = namespace(like).floor(rng.uniform(0.0, tracks))
        return Reference(0 * like, *_sines(self.name, self.cycle, zero), track)

    def sampled(self, order: int) -> np.ndarray:
        """Places [m] or accelerations [m/s^2] (its derivative 0 or 2), (n, 3)."""
        if self.name == "random":
            most = np.array((1.0, 0.0, CLIMB) if order else (1.5, 1.5, 1.5))
            return np.array([most, -most]) * (self.acceleration if order else self.extent)
        if self.name in SINES:
            none = np.zeros(1, dtype=int)
            one = self.reference(Rng(none, none), np.zeros((1, AXES)))
            return self.at(one, np.linspace(0.0, self.cycle, 400), order)
        return self.pieces[:, order] * math.factorial(order)

    def check_room(self, task: str, box: float, lowest: float) -> None:
        """Refuse what leaves the box [m] of a task or sinks below a height [m].

        Raises:
            QuadrlError: The message says how far it goes.
        """
        place = self.sampled(0)
        most = np.abs(place).max(axis=0)
        if most.max() > box + ROUNDING or place[:, 2].min() < lowest - ROUNDING:
            texts = (max(apart(x, box), apart(x, -lowest), key=len) for x in most)
            reason = f"it goes {', '.join(texts)} m far in x, y and z"
            allowed = f"such that it stays within {box:g} m (box), {LOWEST:g} m above the ground"
            random = self.name == "random"
            option, value = ("extent", self.extent) if random else ("figure", self.name)
            raise QuadrlError(reason, name=f"{task} {option}", value=value, allowed=allowed)

    def check_thrust(self, task: str, parameters: Parameters) -> None:
        """Refuse what asks for more thrust than an aircraft has.

        Raises:
            QuadrlError: The message has both [weights].
        """
        rotor, up = parameters.rotor, np.array([0.0, 0.0, GRAVITY])
        thrust = (rotor.thrust_coefficient * rotor.max_speed**2).sum(axis=-1) / parameters.mass
        asked, there = self._weights(up), float(thrust.min()) / GRAVITY
        if asked > there * (1 + SURE):
            texts = apart(asked, there), apart(there, asked)
            reason = f"it asks for {texts[0]} weights of thrust, and the aircraft has {texts[1]}"
            blamed = {"random": ("acceleration", self.acceleration, "smaller")}
            blamed |= dict.fromkeys(SINES, ("period", self.cycle, "longer"))
            usual = "figure", self.name, "a slower one"
            if self.name not in FIGURES and (calm := self._calm(up, there)):
                remedy = f"without noise or corners, as figure_tolerance={calm:g} makes it"
                usual = "figure", self.name, remedy
            option, value, allowed = blamed.get(self.name, usual)
            raise QuadrlError(reason, name=f"{task} {option}", value=value, allowed=allowed)

    def _weights(self, up: np.ndarray) -> float:
        return float(np.linalg.norm(self.sampled(2) + up, axis=-1).max()) / GRAVITY

    def _calm(self, up: np.ndarray, there: float) -> float:
        """The first tolerance [m] with which the curve of a file is feasible; 0 for too fast."""
        last = max(5, np.flatnonzero(self.pieces[:, 1].any(axis=-1)).max(initial=0) + 2)
        times, place = PIECE * np.arange(last), self.pieces[:last, 0]
        for tolerance in (1e-3, 2e-3, 5e-3, 1e-2):
            calmer = smoothed(times, place, tolerance)[2]
            made, count = pieces(times[None], calmer[None], 3, times[-1])
            if dataclasses.replace(self, pieces=made, count=count)._weights(up) <= there:
                return tolerance
        return 0.0

    def _random(self, rng: Rng) -> Reference:
        """Two sines in each coordinate, from slow ones to those of the largest acceleration."""
        bearing, split = rng.uniform(0.0, FULL_TURN), rng.uniform(0.0, 1.0, AXES)
        xp = namespace(bearing)
        sides = (abs(xp.cos(bearing)), abs(xp.sin(bearing)), 0 * bearing + CLIMB)
        parts = ((split[..., k], 1 - split[..., k]) for k in range(AXES))
        halves = (side * part for side, pair in zip(sides, parts, strict=True) for part in pair)
        share = stack(*halves)
        peak = self.acceleration * rng.uniform(0.0, 1.0)[..., None] * share
        amplitude = self.extent / WAVES * rng.uniform(0.1, 1.0, AXES * WAVES)
        return Reference(
            goal=self.extent * rng.uniform(-0.5, 0.5, AXES),
            amplitude=amplitude,
            frequency=xp.sqrt(xp.clip(peak / amplitude, SLOWEST**2, FASTEST**2)),
            phase=rng.uniform(0.0, FULL_TURN, AXES * WAVES),
            track=0 * bearing,
        )


def _sines(figure: str, period: float, zero: Array) -> tuple[Array, Array, Array]:
    """Amplitude, frequency and phase of a figure, none for one of a table; for zeros (N,)."""
    waves = SINES[figure][1] if figure in SINES else ((0.0, 1, 0.0),) * AXES
    turn = math.tau / period  # [rad/s]
    pairs = (((size, turns * turn, phase), (0.0, turn, 0.0)) for size, turns, phase in waves)
    rows = zip(*(wave for pair in pairs for wave in pair), strict=True)
    amplitude, frequency, phase = (stack(*(zero + x for x in row)) for row in rows)
    return amplitude, frequency, phase


def _drawn(
    shortest: float, longest: float, height: float, seconds: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points within 1 m east and north and a height up, with legs of some duration [s]."""
    draw, count = np.random.default_rng(SEED), math.ceil(seconds / shortest) + 6
    # In whole pieces: a corner is where two of them meet.
    shape = TRACKS, count
    steps = draw.integers(round(shortest / PIECE), round(longest / PIECE), shape, endpoint=True)
    times = PIECE * np.cumsum(steps, axis=1)
    return times - times[:, :1], draw.uniform(-1, 1, (*shape, AXES)) * [1.0, 1.0, height]


def _star(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """SimpleFlight's pentagram, within 0.7 m, at 1 m/s, again and again."""
    leg = PIECE * round(2 * 0.7 * math.sin(math.tau / 5) / PIECE)  # whole pieces
    corner = np.arange(math.ceil(seconds / leg) + 2)
    angle = math.pi / 2 + 2 * math.tau / 5 * corner
    points = 0.7 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return leg * corner[None], points[None]
