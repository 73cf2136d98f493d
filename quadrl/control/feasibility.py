"""Feasibility: whether actions can carry an aircraft, turn it, and respond in time.

In most control modes commands stay within hover plus and minus `Vehicle.action_scale`
(`ControlMode.reach`), with the hover speeds of the specified aircraft. An aircraft that a
randomization draws may need more to hover level and still; then no policy can keep it in the air.
"""

from __future__ import annotations

import functools
import itertools
import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.parameters import Parameters
from quadrl.aircraft.rotors import GRAVITY, mixer
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.philox import PARAMETERS
from quadrl.base.rotation import Array
from quadrl.conditions.randomization import AFFECTS, Randomization
from quadrl.conditions.randomizations import Randomized
from quadrl.conditions.sampler import DAMAGED, AircraftSampler
from quadrl.conditions.weather import Weather
from quadrl.control import modes, trim
from quadrl.engines.dynamics import Motion, derivative
from quadrl.engines.rng import uniform

MARGIN = 1.2
"""Largest thrust over weight that an aircraft needs to be flown. At 1.2 the thrust carries the
weight at a tilt of 33 degrees, or climbs with g / 5; the presets have at least 1.33."""
FEW = 0.02
"""Share of drawn aircraft that may be unable to hover without a warning. Tasks ask for a success of
98 to 100 %, which a larger share rules out."""
SAMPLES, CORNERS = 1024, 256
LANDS = 0.9
"""Lift over weight on the ground, at an action of -1, that is suggested for an aircraft to land."""
SURE = 1e-9
"""Relative tolerance for rounding."""
BISECTIONS = 24
BY_HOVER = AFFECTS.keys() - {"inertia", "inertia_axes", "drag", "inflow", "lag", "rotor_inertia"}
"""Fields of a randomization that change the hover speeds or the largest speeds of rotors."""


class Reach:
    """The exact range of thrust without a moment that the rotors of some aircraft (n,) can give.

    Rotors between a lowest and a highest speed give the wrenches of a zonotope: the mixer times a
    box of squared speeds. A wrench is in it if it lies between its facets, each of which is
    parallel to the columns of three rotors. This also holds for more than four rotors, which can
    share the weight in many ways.
    """

    def __init__(self, vehicle: Vehicle, table: np.ndarray | None = None) -> None:
        """Take rows of parameters (n,); None for those of the vehicle itself."""
        table = parameters.rows(vehicle) if table is None else table
        self.vehicle = vehicle
        rotor = table["rotor"][:, : vehicle.rotor_count]
        rows = mixer(rotor)  # (n, 4, R)
        size = np.abs(rows).max(axis=-1, keepdims=True)
        rows = rows / size
        triples = [*itertools.combinations(range(vehicle.rotor_count), 3)]
        spanned = np.moveaxis(rows[:, :, np.array(triples)], 1, -1)  # (n, F, 3, 4)
        # The facets' normals: the cross product of three vectors in four dimensions.
        normal = np.stack(
            [(-1) ** k * np.linalg.det(np.delete(spanned, k, axis=-1)) for k in range(4)], axis=-1
        )
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        # Three columns in a plane span no facet; their normal is zero, which bounds nothing.
        normal = np.where(length > SURE, normal / np.maximum(length, SURE), 0.0)
        normal = normal * np.where(normal[..., :1] < 0, -1.0, 1.0)
        self._across = normal @ rows  # (n, F, R)
        self._weight = normal[..., 0] * (parameters.hover_thrust(table) / size[:, 0, 0])[:, None]
        moment = table["steady_moment"] / size[:, 1:, 0]  # which the rotors balance
        self._held = (normal[..., 1:] * moment[:, None]).sum(axis=-1)  # (n, F)
        self._max_speed = np.minimum(rotor["max_speed"], vehicle.max_speed)  # (n, R) [rad/s]
        self.hover_speed = rotor["hover_speed"]
        """Hover speeds (n, R) [rad/s] of the drawn aircraft."""
        room = vehicle.max_speed - vehicle.hover_speed
        self.room = float(room.min())
        """Largest action scale [rad/s] that commands no speed above a rotor's largest."""
        self.most = float(max(room.max(), vehicle.hover_speed.max()))
        """An action scale [rad/s] with which actions command every speed of the rotors."""

    def speeds(self, scale: Array | float) -> tuple[Array, Array]:
        """Lowest and highest rotor speeds (n, R) [rad/s] for an action scale [rad/s], or (n, 1)."""
        high = np.minimum(self.vehicle.hover_speed + scale, self._max_speed)
        low = np.minimum(np.maximum(self.vehicle.hover_speed - scale, 0.0), high)
        return low, high

    def loads(self, scale: Array | float) -> tuple[Array, Array]:
        """Smallest and largest thrust without a moment over the weight, (n,) each.

        The largest is below the smallest where there is none.
        """
        low, high = (speed[:, None] ** 2 for speed in self.speeds(scale))
        middle = (self._across * (high + low) / 2).sum(axis=-1) + self._held  # (n, F)
        room = (np.abs(self._across) * (high - low) / 2).sum(axis=-1)
        level = self._weight <= SURE * self._weight.max(axis=-1, keepdims=True)
        weight = np.where(level, 1.0, self._weight)
        least = np.where(level, 0.0, (middle - room) / weight)
        most = np.where(level, np.inf, (middle + room) / weight)
        rounding = SURE * np.abs(self._across).max() * self.most**2
        shut = (level & (np.abs(middle) > room + rounding)).any(axis=-1)
        return least.max(axis=-1), np.where(shut, 0.0, most.min(axis=-1))

    def carries(self, scale: Array | float, margin: float = 1.0) -> Array:
        """Whether thrusts from the weight over a margin to the margin times it exist, (n,)."""
        least, most = self.loads(scale)
        return (least * margin <= 1 + SURE) & (most * (1 + SURE) >= margin)

    def scale(self) -> float:
        """The smallest action scale with which each aircraft has the MARGIN [rad/s].

        Rounded up to two digits. Where not even the rotors' limits give it, the smallest with which
        an action of 1 commands the largest speeds.
        """
        low, high = 0.0, self.most
        if not self.carries(high, MARGIN).all():
            return float((self.vehicle.max_speed - self.vehicle.hover_speed).max())
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            low, high = (low, middle) if self.carries(middle, MARGIN).all() else (middle, high)
        digit = 10.0 ** (math.floor(math.log10(high)) - 1)
        return max(high, min(math.ceil(high / digit - SURE) * digit, self.room))


def samples(sampler: AircraftSampler) -> tuple[np.ndarray, np.ndarray]:
    """Rows of parameters of sampled aircraft, and of some at corners of the ranges."""
    keys = np.arange(SAMPLES)
    shares = uniform(keys, np.zeros_like(keys), PARAMETERS, 0, len(sampler.names))
    corners = np.where(shares[:CORNERS] < 0.5, 0.0, 1 - SURE)
    return sampler.table(sampler.sample(shares)), sampler.table(sampler.sample(corners))


def unreached(vehicle: Vehicle, sampler: AircraftSampler) -> tuple[float, str, float]:
    """The share of drawn aircraft that cannot hover level and still, from a fixed sample.

    Returns:
        The share; what the worst aircraft of the sample lacks, in words; the action scale [rad/s]
        with which each has the MARGIN, also in the corners of the ranges, or as much as its rotors
        can give. With a share of 0 the text is empty, and the action scale is the vehicle's.
    """
    if not sampler.randomization.per_row:
        return 0.0, "", vehicle.action_scale
    drawn, corners = samples(sampler)
    reach, scale = Reach(vehicle, drawn), vehicle.action_scale
    share = 1 - float(reach.carries(scale).mean())
    if share == 0:
        return 0.0, "", scale
    (low, high), hover = reach.speeds(scale), reach.hover_speed
    beyond = np.maximum(hover - high, low - hover)
    worst = np.unravel_index(np.argmax(beyond), beyond.shape)
    end, given = (1, high[worst]) if hover[worst] > high[worst] else (-1, low[worst])
    lack = (
        f"rotor {worst[1] + 1} of the worst one needs {hover[worst]:.1f} rad/s, and an action of "
        f"{end} commands {given:.1f} rad/s"
    )
    enough = Reach(vehicle, np.concatenate([drawn, corners])).scale()
    return share, lack, enough


def held_command(vehicle: Vehicle, control_mode: str) -> float:
    """Time for which the rotors hold a command [s].

    The loops of every mode but "rotor" command at each physics step.
    """
    looped = modes.kind(control_mode).has_loops
    return vehicle.physics_timestep if looped else vehicle.control_timestep


def warn_of_unreached(
    vehicle: Vehicle,
    randomization: Randomized,
    control_mode: str = "rotor",
    wind: float = 0.0,
    lands: bool = False,
) -> None:
    """Warn the caller's caller of faults that no policy can compensate.

    More than a FEW of the drawn aircraft cannot hover, at least half of the actions are clipped at
    the largest speed, an action lasts longer than the rotors take to follow it, the mean wind
    [m/s] is stronger than actions can hold against, or the aircraft is to land and cannot.

    Raises:
        QuadrlError: The randomization does not fit the aircraft.
    """
    reach, scale = Reach(vehicle), vehicle.action_scale
    vehicle = modes.kind(control_mode).reach(vehicle)
    if 2 * reach.room < scale:
        said = f"action_scale = {scale:g}: actions over {reach.room / scale:.2g} change nothing"
        _warn(f"{said}, since the rotors turn no faster; quadrl check suggests another")
    if wind and wind > (held := held_wind(vehicle, vehicle.action_scale)):
        said = f"the mean wind of {wind:.3g} m/s carries every aircraft off, whatever the policy"
        said += f": an action of 1 holds it in {held:.3g} m/s at most"
        limits = held_wind(vehicle, reach.most)
        _warn(f"{said}, the rotors at their limits in {limits:.3g} m/s; ask for weaker weather")
    if lands and (lack := cannot_land(vehicle)):
        _warn(f"action_scale = {vehicle.action_scale:g}: {lack}")
    lag = max(1 / min(rotor.lag_up, rotor.lag_down) for rotor in vehicle.rotors)
    if held_command(vehicle, control_mode) > lag:
        said = f"control_timestep = {vehicle.control_timestep:g}: an action lasts longer"
        _warn(f"{said} than the rotors take to follow it, {lag:.2g} s; see quadrl check")
    share, lack, enough = unreached(vehicle, AircraftSampler(randomization, vehicle))
    if share > FEW:
        said = (
            f"{100 * share:.0f} % of the drawn aircraft cannot hover level and still, whatever the "
            f"policy: {lack}; train with --vehicle-options action_scale={enough:.3g}"
        )
        _warn(said)


def _warn(said: str) -> None:
    warnings.warn(said, QuadrlWarning, stacklevel=4)


@functools.lru_cache
def limit(
    at: Callable[[float], Randomization | Weather], usual: float, end: float, vehicle: Vehicle
) -> float | None:
    """The level of a disturbance beyond which no policy can hover, outwards from the usual one.

    Args:
        at: The randomization or weather of a level.
        usual: The level without a disturbance.
        end: The last level on one side; the search goes up to eight times as far.
        vehicle: The aircraft, with the action scale that it flies with.

    Returns:
        The level; None where actions suffice at every level, or where no level changes the hover.
    """

    def able(given: Any) -> bool:
        try:
            sampler = AircraftSampler(given, vehicle)
        except QuadrlError:  # even at their limits the rotors do not carry the aircraft
            return False
        drawn = np.tile(sampler.low, (vehicle.rotor_count, 1))
        sampler.columns(drawn, DAMAGED)[:, 0] = np.arange(vehicle.rotor_count)
        return bool(Reach(vehicle, sampler.table(drawn)).carries(vehicle.action_scale).any())

    if end == usual or not BY_HOVER.intersection(getattr(at(end), "given", dict)()):
        return None
    near = usual
    for farther in (1, 2, 4, 8):
        far = usual + farther * (end - usual)
        try:
            given = at(far)
        except QuadrlError:  # there is no such level
            return None
        if not able(given):
            for _ in range(BISECTIONS):
                middle = (near + far) / 2
                near, far = (middle, far) if able(at(middle)) else (near, middle)
            return far
        near = far
    return None


def held_wind(vehicle: Vehicle, scale: float) -> float:
    """Strongest steady wind [m/s] that the actions of an action scale [rad/s] hold.

    With the scale `Reach.most` it is that of the rotors at their limits.
    """
    low, high = (tuple(speed[0].tolist()) for speed in Reach(vehicle).speeds(scale))
    return trim.held_wind(vehicle, low, high)


def cannot_land(vehicle: Vehicle) -> str:
    """What keeps an aircraft off the ground, and the cure, in words; empty if nothing does."""
    lift, over = lift_on_feet(vehicle, vehicle.action_scale), lift_on_feet(vehicle, 0.0)
    if lift < 1:
        return ""
    enough = 1 - math.sqrt(LANDS / over)  # of the hover speed, since lift follows its square
    enough = 2 * math.ceil(enough * float(vehicle.hover_speed.max()) / 2)
    lifts = f"on the ground an action of -1 still lifts {lift:.2f} times the weight"
    return f"{lifts}, so that no policy can land; give action_scale={enough} or more"


def lift_on_feet(vehicle: Vehicle, scale: float) -> float:
    """Lift of an aircraft that stands on its feet in calm air at an action of -1, over its weight.

    Actions have the scale [rad/s]. In real air the ground adds to the lift.
    """
    p = Parameters.of(parameters.rows(vehicle), vehicle.control_timestep)
    low, _ = Reach(vehicle).speeds(scale)
    still = np.zeros((1, 3))
    height = np.array([[0.0, 0.0, vehicle.ground_clearance]])
    motion = Motion(height, np.array([[1.0, 0.0, 0.0, 0.0]]), still, still, low)
    rate = derivative(p, motion, low, still, -GRAVITY, vehicle.aerodynamics.effects)
    return 1 + float(rate.velocity[0, 2]) / GRAVITY
