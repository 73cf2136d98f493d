"""Whether aircraft touch the ground, from snapshots; the physics of contact is MuJoCo's."""

from __future__ import annotations

from quadrl.base.rotation import Array, cross, dot, namespace
from quadrl.conditions.world import centre_of_discs, depth_of_discs, depth_of_feet, depth_of_hull
from quadrl.core.snapshot import Snapshot

CONTACT_HEIGHT = 0.005  # [m], of the lowest foot at which the aircraft counts as standing


def touches_ground(now: Snapshot, *, bounces: bool = False) -> Array:
    """Whether an aircraft that should fly has touched the ground, (N,) bool.

    Args:
        now: The snapshot.
        bounces: Whether the ground stops aircraft, which then may have left it again.

    Where there are solids, the ground is one, too: whatever part is on it has touched it.
    """
    if not bounces and now.world is not None and now.world.places:
        return stands(now) | strikes_ground(now)
    if bounces:  # an aircraft that lies on its back or its side is on the ground, too
        return (_lowest(now) < now.parameters.ground_clearance) | strikes_ground(now)
    return now.state.height < now.parameters.ground_clearance


def stands(now: Snapshot) -> Array:
    """Whether a foot is on the ground, (N,) bool."""
    depth = depth_of_feet(now.state.rotation[..., 2, :], now.parameters)
    return now.state.height - depth < CONTACT_HEIGHT


def strikes_ground(now: Snapshot) -> Array:
    """Whether the hull or a rotor has hit the ground, (N,) bool."""
    xp, up = namespace(now.state.height), now.state.rotation[..., 2, :]
    # A disc that rises now may have bounced in this control step.
    turning = cross(now.state.body_rate[..., None, :], centre_of_discs(now.parameters))
    swing = dot(up[..., None, :], turning)
    rising = xp.maximum(now.state.velocity[..., 2, None] + swing, 0.0 * swing)
    risen = rising * now.parameters.control_timestep
    deepest = xp.max(depth_of_discs(up, now.parameters) + risen, axis=-1)
    return (now.state.height < deepest) | (_lowest(now) < depth_of_hull(up, now.parameters))


def _lowest(now: Snapshot) -> Array:
    """The height [m] from which an aircraft that rises may have risen in this control step."""
    rising = namespace(now.state.height).maximum(now.state.velocity[..., 2], 0.0 * now.state.height)
    return now.state.height - rising * now.parameters.control_timestep
