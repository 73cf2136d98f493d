"""The gates and poles of the LSY race; their places change in each episode."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array, cross, dot, filled, namespace, norm, stack, to_body, zeros
from quadrl.engines.rng import Rng
from quadrl.engines.state import State
from quadrl.tasks.boxes import gap
from quadrl.tasks.gates import Course
from quadrl.tasks.tracks import OTHER, Track, attitude

NEAR = 0.7  # [m], within which it is seen where a gate or a pole truly stands
ASIDE = 0.15, 0.15, 0.1  # [m], by how much gates may be elsewhere along x, y and z
ASIDE_POLE = 0.15, 0.15, 0.05  # [m], the same of poles, whose tops are higher or lower
LEANING = 0.05, 0.1, 0.2  # [rad], by how much gates roll, pitch and turn at most
POLE, HIGH = 0.015, 0.8  # [m], radius of a pole and half its length, without its round ends
WOOD = (0.55, 0.45, 0.35, 1.0)
STAND, DEPTH = (0.05, 0.05, 0.5), 0.01  # [m], half of the edges of a stand, of a frame's depth
BOX = 0.07, 0.07, 0.02  # [m], half of the edges of the box that collides (drone-models: cf21B_500)


@dataclasses.dataclass(frozen=True)
class Arena(Course):
    """The progress of the race, and where G gates and P poles truly stand."""

    gates: Array  # (N, 9 G) centre [m], unit vectors through each gate and to its left
    poles: Array  # (N, 3 P) x, y and height of the top [m] of each pole
    size: Array  # (N,) of the box that stands for the aircraft in collisions, over that of BOX
    seen: Array  # (N, G + P) 1 for gates and poles that have been near, 0 for others

    @property
    def frames(self) -> list[tuple[Array, Array, Array]]:
        """Centre, and unit vectors through it and to its left, of each gate, (N, 3) each."""
        rows = [self.gates[..., k : k + 9] for k in range(0, self.gates.shape[-1], 9)]
        return [(row[..., :3], row[..., 3:6], row[..., 6:]) for row in rows]

    @property
    def tops(self) -> list[tuple[Array, ...]]:
        """East, north and height of the top of each pole, (N,) each."""
        columns = [self.poles[..., k] for k in range(self.poles.shape[-1])]
        return [tuple(columns[k : k + 3]) for k in range(0, len(columns), 3)]

    def frame(self, number: Array) -> tuple[Array, Array, Array]:
        """The gates with some numbers (N,), as `frames` has them."""
        (centre, through, left), *others = self.frames
        for k, other in enumerate(others, 1):
            this, xp = (number == k)[..., None], namespace(number)
            centre, through, left = (
                xp.where(this, own, before)
                for own, before in zip(other, (centre, through, left), strict=True)
            )
        return centre, through, left

    def seen_from(self, place: Array) -> Array:
        """`seen`, with what is near a place (N, 3) added."""
        xp, seen = namespace(place), list[Array]()
        gates = [(centre[..., 0], centre[..., 1]) for centre, *_ in self.frames]
        for k, (x, y) in enumerate([*gates, *(top[:2] for top in self.tops)]):
            near = _length(place[..., 0] - x, place[..., 1] - y) < NEAR
            seen.append(xp.where(near, 0 * x + 1, self.seen[..., k]))
        return stack(*seen)

    def guessed(self, track: Track) -> Arena:
        """The arena as the aircraft knows it: what has not been near stands where it should."""
        xp, (gates, poles) = namespace(self.size), nominal(track)
        near = [self.seen[..., k] > 0 for k in range(self.seen.shape[-1])]
        places = [xp.where(near[k // 9], self.gates[..., k], gates[k]) for k in range(len(gates))]
        rest = near[len(track.gates) :]
        stand = [xp.where(rest[k // 3], self.poles[..., k], poles[k]) for k in range(len(poles))]
        return dataclasses.replace(self, gates=stack(*places), poles=stack(*stand))

    def ways_to_poles(self, state: State) -> Array:
        """The way to the top of each pole, x, y and z, body frame, (N, 3 P) [m]."""
        ways = [stack(*top) - state.position for top in self.tops]
        away = [to_body(state.rotation, way) for way in ways]
        return stack(*(way[..., k] for way in away for k in range(3)))

    def drawn(self, track: Track) -> list[Primitive]:
        """Gates with their stands and poles, as the first row has them."""
        gates = [[vector[0] for vector in gate] for gate in self.frames]
        centre = [gate[0] for gate in gates]
        axes = [(through, left, np.cross(through, left)) for _, through, left in gates]
        shown = [*track.drawn(int(self.gate[0]), centre, axes)]
        for x, y, top in ([float(part[0]) for part in pole] for pole in self.tops):
            shown.append(Primitive("cylinder", (POLE, top / 2, 0.0), (x, y, top / 2), rgba=OTHER))
        for middle, turned in zip(centre, axes, strict=True):
            high = middle[2] - track.frame / 2
            place = middle - (track.frame / 2 + high / 2) * turned[2]
            size = *STAND[:2], high / 2
            shown.append(Primitive("box", size, place, attitude(turned), WOOD, glow=0.2))
        return shown

    def clearance(self, state: State, track: Track) -> Array:
        """Lower bound of the distance from the aircraft's box to what stands here, (N,) [m].

        It is negative where the box touches a pole, a frame or a stand, and nowhere else.
        """
        xp, place, own = namespace(self.size), state.position[..., None, :], state.rotation
        half = [self.size[..., None] * edge for edge in BOX]  # (N, 1), and all else (N, G or P)
        tops = place - self.poles.reshape(*self.size.shape, -1, 3)
        off = [tops[..., 0], tops[..., 1], tops[..., 2] + HIGH]
        turn = [[own[..., k, i, None] for i in range(3)] for k in range(3)]
        gaps = [gap(off, turn, half, (0.0, 0.0, HIGH), POLE)]
        frames = self.gates.reshape(*self.size.shape, -1, 3, 3)
        centre, through, left = (frames[..., k, :] for k in range(3))
        axes = through, left, cross(through, left)
        off = [dot(place - centre, axis) for axis in axes]
        turn = [[dot(axis, own[..., None, :, i]) for i in range(3)] for axis in axes]
        wide, outer = (track.frame - track.opening) / 4, track.frame / 2
        gaps.append(gap([*off[:2], off[2] + outer + STAND[2]], turn, half, STAND))
        for k in (1, 2):  # of a frame's four sides the box can reach the two nearer ones
            beside, size = [*off], [DEPTH, outer, outer]
            size[k], middle = wide, filled(outer - wide, off[k])
            beside[k] = off[k] - xp.where(off[k] < 0, -middle, middle)
            gaps.append(gap(beside, turn, half, size))
        return xp.min(xp.concat(gaps, axis=-1), axis=-1)


@functools.cache
def nominal(track: Track) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Where gates and poles should be, rows as `Arena` has them, (9 G,) and (3 P,)."""
    gates = np.concatenate([track.centre, track.axes[:, 0], track.axes[:, 1]], axis=1)
    return tuple(gates.ravel().tolist()), tuple(sum(track.poles, ()))


def furnished(rng: Rng, track: Track, off: float, boxes: tuple[float, float]) -> Arena:
    """An arena before the start of an episode.

    Args:
        rng: Draws where everything stands.
        track: Where it should.
        off: 1 where it stands elsewhere, 0 where it does not.
        boxes: Smallest and largest box, over that of BOX.
    """
    count, (gates, poles) = len(track.gates), nominal(track)
    shift = rng.uniform(-off, off, 6 * count + len(poles))
    size = rng.uniform(*boxes)
    rows: list[Array] = []
    for k in range(count):
        x, y, z, east, north = gates[9 * k : 9 * k + 5]
        by = [most * shift[..., 6 * k + i] for i, most in enumerate((*ASIDE, *LEANING))]
        rows += [x + by[0], y + by[1], z + by[2], *_leaning(east, north, *by[3:])]
    aside = ASIDE_POLE * (len(poles) // 3)
    stand = [poles[k] + aside[k] * shift[..., 6 * count + k] for k in range(len(poles))]
    one = zeros(shift[..., 0])
    three, seen = stack(one, one, one), zeros(shift[..., : count + len(poles) // 3])
    course = Course(three, one, three, three, one, one, three, one)
    return Arena(**vars(course), gates=stack(*rows), poles=stack(*stand), size=size, seen=seen)


def _leaning(east: float, north: float, roll: Array, pitch: Array, turn: Array) -> list[Array]:
    """Unit vectors through a gate and to its left, (N,) each component.

    Args:
        east: Of the way through it as it should be, which is level.
        north: The same.
        roll: About that way [rad], (N,).
        pitch: Down, about what is to its left [rad], (N,).
        turn: Counter-clockwise from above [rad], (N,).
    """
    xp = namespace(turn)
    (a, b), (c, d), (e, f) = ((xp.cos(x), xp.sin(x)) for x in (turn, pitch, roll))
    cosine, sine = east * a - north * b, north * a + east * b
    across = d * f
    through = [cosine * c, sine * c, -d]
    return [*through, cosine * across - sine * e, sine * across + cosine * e, c * f]


def _length(*parts: Array) -> Array:
    """Length of vectors by their components, (N,)."""
    return norm(stack(*parts))
