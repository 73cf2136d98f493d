"""The world about aircraft, as sensors and tasks see it: solids, and the ground, a plane."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from quadrl.aircraft.parameters import Parameters
from quadrl.base.rotation import Array, dot, namespace, norm
from quadrl.base.validation import choice
from quadrl.engines.state import State

FAR = 1000.0  # [m]


@dataclasses.dataclass(slots=True)
class World:
    """What was measured of the K solids at the end of a control step, arrays (N, ...).

    The ground is apart, since it follows from the state: `above_ground`.
    """

    places: Mapping[str, int | slice]  # of solids among the K; a slice for one with a `count`
    beams: Mapping[str, slice]  # of sensors among the B rays
    position: Array  # (N, K, 3) [m] of their centres, task frame
    clearance: Array  # (N,) [m], free at least between the aircraft and the nearest solid
    touched: Array  # (N, K) bool, which one was touched fastest in this control step
    touch_speed: Array  # (N,) [m/s], of that touch towards the solid; 0 without one
    landed: Array  # (N,) bool, whether a foot has touched a solid
    touch: Array  # (N, 4) of that moment: speed into it and along it [m/s], cosine, rate [rad/s]
    held: Array  # (N,) bool, whether a foot has touched a solid that grips
    rays: Array  # (N, B) what is read along the rays of sensors: distances [m], or logarithms

    def solid(self, name: str) -> Array:
        """Centre of a solid, (N, 3) [m], task frame; (N, count, 3) of one with a `count`."""
        return self.position[..., self.places[choice("solid", name, self.places)], :]

    def ranges(self, name: str) -> Array:
        """What is read along the rays of a sensor, (N, B): how far a solid or the ground is."""
        return self.rays[..., self.beams[choice("sensor with rays", name, self.beams)]]


def above_ground(state: State, parameters: Parameters) -> Array:
    """Height of the lowest part of an aircraft above the ground, (N,) [m]; negative in it.

    Of hull, feet and rotor discs, as they end episodes: feet are points there, and discs flat.
    """
    xp, up = namespace(state.height), state.rotation[..., 2, :]
    depth = xp.maximum(depth_of_feet(up, parameters), depth_of_hull(up, parameters))
    depth = xp.maximum(depth, xp.max(depth_of_discs(up, parameters), axis=-1))
    return state.height - depth


def depth_of_feet(up: Array, parameters: Parameters) -> Array:
    """Depth of the lowest foot below the centre of mass, (N,) [m]; `up` is (N, 3), body frame."""
    x, y, z = (parameters.foot[..., k] for k in range(3))  # the other three mirror it
    return abs(up[..., 0]) * x + abs(up[..., 1]) * y - up[..., 2] * z


def depth_of_hull(up: Array, parameters: Parameters) -> Array:
    """The same of the hull."""
    return norm(up * parameters.hull)


def depth_of_discs(up: Array, parameters: Parameters) -> Array:
    """The same of the edge of each rotor disc, (N, R) [m]."""
    rotor, vertical = parameters.rotor, up[..., None, :]
    across = vertical - dot(vertical, rotor.axis)[..., None] * rotor.axis
    edge = rotor.radius * norm(across)  # of what is in the plane of a disc
    return edge - dot(vertical, centre_of_discs(parameters))


def centre_of_discs(parameters: Parameters) -> Array:
    """Centres of the rotor discs, (N, R, 3) [m], body frame."""
    rotor = parameters.rotor
    return rotor.position + parameters.rotor_height[..., None, None] * rotor.axis
