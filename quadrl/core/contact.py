"""Whether aircraft touch the ground, from snapshots; the physics of contact is MuJoCo's."""

from __future__ import annotations

from quadrl.base.rotation import Array, dot, namespace, norm
from quadrl.core.snapshot import Snapshot

CONTACT_HEIGHT = 0.005  # [m], of the lowest foot at which the aircraft counts as standing


def touches_ground(now: Snapshot) -> Array:
    """Whether an aircraft that should fly has touched the ground, (N,) bool."""
    return now.state.height < now.parameters.ground_clearance


def stands(now: Snapshot) -> Array:
    """Whether a foot is on the ground, (N,) bool."""
    up, foot = now.state.rotation[..., 2, :], now.parameters.foot
    # The lowest of four feet that mirror each other.
    depth = (
        abs(up[..., 0]) * foot[..., 0] + abs(up[..., 1]) * foot[..., 1] - up[..., 2] * foot[..., 2]
    )
    return now.state.height - depth < CONTACT_HEIGHT


def strikes_ground(now: Snapshot) -> Array:
    """Whether the hull or a rotor has hit the ground, (N,) bool."""
    xp, rotor = namespace(now.state.height), now.parameters.rotor
    up = now.state.rotation[..., 2, :]
    depth = norm(up * now.parameters.hull)
    centre = rotor.position + now.parameters.rotor_height[..., None, None] * rotor.axis
    above = dot(up[..., None, :], centre)  # (N, R) [m], of the discs' centres
    across = up[..., None, :] - dot(up[..., None, :], rotor.axis)[..., None] * rotor.axis
    edge = rotor.radius * norm(across)  # of what is in the plane of a disc
    deepest = xp.max(edge - above, axis=-1)
    return now.state.height < xp.maximum(depth, deepest)
