"""The sea: waves that the wind has raised, how a boat on it moves, and how both look."""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from typing import NamedTuple

import numpy as np

from quadrl.aircraft.rotors import GRAVITY
from quadrl.base.primitives import Primitive
from quadrl.base.rotation import (
    Array,
    namespace,
    norm,
    quaternion_from_heading_and_tilt,
    stack,
    zeros,
)
from quadrl.conditions.solids import Box
from quadrl.core.task import TaskState
from quadrl.engines.rng import FULL_TURN, Rng

WAVES = 12  # that the sea is made of
RAREST = 1e-6  # of the share of the energy in longer waves: those are endless
STRIPS = 60  # of the water that is drawn
NEAREST, FARTHEST = (
    12.0,
    150.0,
)  # [m]: within the first they are about as wide, the second is the end
DEPTH = 0.15  # [m], of the middle of a strip below its surface
WATER = np.array([0.10, 0.34, 0.48, 1.0])
DECK = Box("deck", length=4.0, width=4.0, height=0.2, rgba=(0.38, 0.42, 0.46, 1.0))
FREEBOARD = 1.5  # [m], of the deck over the water
HULL = (0.24, 0.26, 0.30, 1.0)


@dataclasses.dataclass(frozen=True)
class Waves(TaskState):
    """The waves that move a boat."""

    amplitude: Array  # (N, WAVES) [m], with which they move it
    steepness: Array  # (N, WAVES) [rad], with which they tilt it
    frequency: Array  # (N, WAVES) [rad/s]
    phase: Array  # (N, WAVES) [rad]
    course: Array  # (N, 2) unit vector, east and north, of where they run to


class Motion(NamedTuple):
    """The motion of a boat's deck at a moment."""

    position: Array  # (N, 3) [m], of the middle of its surface
    velocity: Array  # (N, 3) [m/s]
    normal: Array  # (N, 3) unit vector out of it
    rate: Array  # (N, 3) [rad/s], angular velocity


def draw(rng: Rng, height: Array, size: tuple[float, float]) -> Waves:
    """Waves of some significant height (N,) [m] under a boat, its length and beam given [m].

    They are those of a sea that the wind has blown on for long: their energy is spread over the
    frequencies as Pierson and Moskowitz (1964) found, and each has as much of it.
    """
    xp = namespace(height)
    drawn = rng.uniform(0.0, 1.0, WAVES)
    longer = stack(*((drawn[..., k] + k) / WAVES for k in range(WAVES)))  # share of the energy
    peak = 0.4 * xp.sqrt(GRAVITY / height)  # [rad/s], of the most energy
    longer = xp.clip(longer, RAREST, 1 - RAREST)
    frequency = peak[..., None] * (-1.25 / xp.log(longer)) ** 0.25
    course = rng.level_direction()[..., :2]
    # A wave as short as the boat is up here and down there: it moves the boat less.
    wave_number = frequency * frequency / GRAVITY
    ahead, aside = (
        _mean(wave_number * (extent / 2 * course[..., k])[..., None])
        for k, extent in enumerate(size)
    )
    amplitude = (height / 4)[..., None] * math.sqrt(2 / WAVES) * ahead * aside
    return Waves(
        goal=stack(*3 * (zeros(height),)),
        amplitude=amplitude,
        steepness=amplitude * wave_number,
        frequency=frequency,
        phase=rng.uniform(0.0, FULL_TURN, WAVES),
        course=course,
    )


def deck(waves: Waves, time: Array) -> Motion:
    """How the deck moves at a time (N,) [s]: as the water would under the boat.

    Water at the surface of a deep sea goes around in circles, which are tilted as the wave is.
    """
    xp, none = namespace(time), zeros(time)
    angle = waves.frequency * time[..., None] + waves.phase
    sine, cosine = xp.sin(angle), xp.cos(angle)
    up, ahead = waves.amplitude * cosine, waves.amplitude * sine
    slope = waves.steepness * sine
    slope_rate = waves.steepness * waves.frequency * cosine
    faster, sinking = waves.frequency * up, waves.frequency * ahead
    sums = _sums(ahead, up, faster, sinking, slope, slope_rate)

    def along(way: Array, height: Array) -> Array:
        return stack(way * waves.course[..., 0], way * waves.course[..., 1], height)

    leans, turns = along(sums[4], none), along(sums[5], none)
    normal = stack(-leans[..., 0], -leans[..., 1], none + 1)
    normal = normal / norm(normal)[..., None]
    return Motion(
        position=along(sums[0], sums[1]),
        velocity=along(sums[2], -sums[3]),
        normal=normal,
        rate=stack(turns[..., 1], -turns[..., 0], none),
    )


def upright(normal: Array) -> Array:
    """Unit quaternions (N, 4) that turn upright to unit vectors (N, 3), the shortest way."""
    x, y, z = (normal[..., k] for k in range(3))
    turn = stack(1 + z, -y, x, 0 * x)
    return turn / norm(turn)[..., None]


def hull(deck: Motion, size: tuple[float, float]) -> Primitive:
    """The first boat below its deck, its length and beam given [m]."""
    below = deck.position[0] - (DECK.height + FREEBOARD / 2) * deck.normal[0]
    half = size[0] / 2, size[1] / 2, FREEBOARD / 2
    return Primitive("box", half, below, upright(deck.normal)[0], HULL, glow=0.0)


def water(waves: Waves, time: Array) -> list[Primitive]:
    """The water about the boat of one episode (N = 1): strips, as long as the crests of its waves.

    Each begins where the last one ends, so that there are no gaps between them.
    """
    edges = NEAREST * np.sinh(np.linspace(-1, 1, STRIPS + 1) * math.asinh(FARTHEST / NEAREST))
    wave_number = waves.frequency[0] ** 2 / GRAVITY
    # Far away the strips are wider than short waves, and have what is left of them in the mean.
    kept = _mean(wave_number * (np.gradient(edges) / 2)[:, None])
    phase = waves.phase - wave_number * edges[:, None]
    there = dataclasses.replace(waves, amplitude=waves.amplitude * kept, phase=phase)
    height = deck(there, time).position[:, 2]
    tilt, (east, north) = np.arctan2(np.diff(height), np.diff(edges)), waves.course[0]
    along = (edges[1:] + edges[:-1]) / 2 + DEPTH * np.sin(tilt)
    up = (height[1:] + height[:-1]) / 2 - DEPTH * np.cos(tilt) - FREEBOARD
    none, heading = 0 * tilt, math.atan2(north, east)
    halves = stack(np.diff(edges) / np.cos(tilt) / 2, none + FARTHEST, none + DEPTH)
    places = stack(along * east, along * north, up)
    attitudes = quaternion_from_heading_and_tilt(none + heading, -tilt, none + math.pi / 2)
    paler = np.clip(0.08 * (up + FREEBOARD), -0.08, 0.2)[:, None]
    colours = WATER + paler * (1.0, 1.0, 1.0, 0.0)
    strips = zip(halves, places, attitudes, colours, strict=True)
    return [Primitive("box", *strip, glow=0.2) for strip in strips]


def _sums(*parts: Array) -> list[Array]:
    """Of several arrays over the waves, (N, WAVES) to (N,) each; in order, so that C adds alike."""
    whole = stack(*parts)  # (N, WAVES, number of parts)
    total = functools.reduce(operator.add, (whole[..., k, :] for k in range(WAVES)))
    return [total[..., k] for k in range(len(parts))]


def _mean(half: Array) -> Array:
    """Share of a wave that is left in the mean over a length, half of it given as a phase [rad]."""
    xp = namespace(half)
    angle = xp.where(abs(half) < 1e-4, 0 * half + 1e-4, half)
    return xp.sin(angle) / angle
