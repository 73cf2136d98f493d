"""Whether aircraft touch the ground, from snapshots; the physics of contact is MuJoCo's."""

from __future__ import annotations

from quadrl.base.rotation import Array, cross, dot, namespace, norm
from quadrl.core.snapshot import Snapshot

CONTACT_HEIGHT = 0.005  # [m], of the lowest foot at which the aircraft counts as standing


def touches_ground(now: Snapshot, *, bounces: bool = False) -> Array:
    """Whether an aircraft that should fly has touched the ground, (N,) bool.

    Args:
        now: The snapshot.
        bounces: Whether the ground stops aircraft, which then may have left it again.
    """
    lowest = _lowest(now) if bounces else now.state.height
    return lowest < now.parameters.ground_clearance


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
    # A disc that rises now may have bounced in this control step.
    swing = dot(up[..., None, :], cross(now.state.body_rate[..., None, :], centre))
    rising = xp.maximum(now.state.velocity[..., 2, None] + swing, 0.0 * swing)
    risen = rising * now.parameters.control_timestep
    deepest = xp.max(edge - above + risen, axis=-1)
    return (now.state.height < deepest) | (_lowest(now) < depth)


def _lowest(now: Snapshot) -> Array:
    """The height [m] from which an aircraft that rises may have risen in this control step."""
    rising = namespace(now.state.height).maximum(now.state.velocity[..., 2], 0.0 * now.state.height)
    return now.state.height - rising * now.parameters.control_timestep
