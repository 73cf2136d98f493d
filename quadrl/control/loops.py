"""The nested control loops of an aircraft, from its position to its rotors.

    position    v_d = approach velocity to p_d                               [m/s]
    velocity    f = k_v (v_d - v) + g e3 + k_D |v| v / m                     [m/s^2]
    attitude    omega_d = -k_R e_R(R, R_d(f, heading)),  T = m f . R e3      [rad/s], [N]
    body rate   M = J k_w (omega_d - omega) + omega x J omega + k_M |omega| omega    [N m]
    rotors      w_c = w + lead ((T, M) - w),  w the present thrust and moments

The geometric controller flies them at the control step, the control modes at the physics step. They
are those of Lee, Leok and McClamroch, "Geometric Tracking Control of a Quadrotor UAV on SE(3)",
CDC 2010, whose thrust and moment act at once; here they come from rotors that lag, with one command
a step, in a narrow range. So the gains place the poles of the whole chain, sampled and with the
lag, and each loop asks the next one only for what the rotors can give.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import numpy as np

from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import Array, norm, to_body
from quadrl.base.validation import number
from quadrl.control.allocation import Allocation, columns, product, within
from quadrl.control.reading import Motion, Reading
from quadrl.engines.state import State

MAX_HEADING_ERROR = 0.5  # [rad], of the desired heading from the present one
Controlled = Literal["position", "velocity", "body_rate"]
INTEGRATORS: dict[Controlled, tuple[int, int, int]] = {
    "position": (4, 2, 2),
    "velocity": (3, 1, 1),
    "body_rate": (1, 0, 1),
}
"""Integrators between the rotors and the controlled quantity: east and north, up, heading.

In "velocity" the rate of the heading is controlled, in "body_rate" the thrust.
"""
# n integrators behind the lag, and all n + 1 poles at p, make the rates of the two innermost loops
# n p / 2 and (n - 1) p / 3. With the largest angle a and the largest body rate sqrt(acc a) they ask
# for no more than the angular acceleration acc up to p^2 = ROOM[n] acc / a:
#   n = 1         p / 2 sqrt(acc a) = acc
#   n = 2, 3      n (n - 1) / 6 p^2 a = acc
#   n = 4         the same with a / 2, since `approach_velocity` brakes with half of it
ROOM = {1: 4.0, 2: 3.0, 3: 1.0, 4: 1.0}


@dataclasses.dataclass(frozen=True)
class Gains:
    """Bandwidths and limits as shares of what the aircraft can do, so that one set flies many.

    A bandwidth is a share of 1 / (slowest time constant of the rotors + time between two commands).
    """

    level: float = 1.3
    """Bandwidth of east and north: position, velocity, tilt, body rate and moment."""
    height: float = 1.3
    """Bandwidth of the altitude: position, velocity and thrust."""
    heading: float = 1.0
    """Bandwidth of the heading: angle, rate and moment."""
    authority: float = 0.8
    """Share of the largest linear and angular accelerations that is asked for, at most 1."""
    max_speed: float = 2.0
    """Largest speed towards the setpoint [m/s]."""
    max_tilt: float = 0.4
    """Largest tilt that is asked for [rad]; less where the thrust would not carry the weight."""

    def __post_init__(self) -> None:
        """Validate the gains."""
        for name, value in vars(self).items():
            high = {"authority": 1.0, "max_tilt": math.pi / 2}.get(name, math.inf)
            number(name, value, high=high, positive=True)


class Loops:
    """The nested loops for rows of one vehicle; they keep no memory."""

    def __init__(
        self,
        vehicle: Vehicle,
        timestep: float,
        controlled: Controlled,
        gains: Gains | None = None,
        share: float = 1.0,
    ) -> None:
        """Place the poles.

        Args:
            vehicle: The aircraft.
            timestep: Time between two commands to the rotors [s].
            controlled: Quantity that the outermost loop controls.
            gains: Bandwidths and limits; None for the defaults.
            share: Share of the bandwidths that gains, lag and moments allow.
        """
        self.vehicle, self.gains = vehicle, (gains := gains or Gains())
        low, high = vehicle.rotor_command(np.array([[-1.0], [1.0]])) ** 2
        self._allocation = Allocation(np.linalg.pinv(vehicle.mixer), low, high)
        self.thrust = self._allocation.thrust
        """Smallest and largest thrust without a moment [N]."""
        least, largest = (thrust / (vehicle.mass * GRAVITY) for thrust in self.thrust)
        self._descent = gains.authority * GRAVITY * (1 - least)  # [m/s^2], largest asked for
        self._climb = gains.authority * GRAVITY * (largest - 1)  # [m/s^2]
        tilt = min(gains.max_tilt, gains.authority * math.acos(1 / largest))  # [rad]
        sideways, vertical = GRAVITY * math.tan(tilt), min(self._climb, self._descent)
        self.max_acceleration = np.array([sideways, sideways, vertical])
        """Largest acceleration (3,) [m/s^2] that is asked for along x, y and z, up and down."""
        self._inertia = np.array(vehicle.inertia)
        # (3,) [rad/s^2], largest asked for
        self._angular_acceleration = gains.authority * self._allocation.moment / self._inertia
        angles = np.array([tilt, tilt, MAX_HEADING_ERROR])  # [rad], the largest errors
        self.max_body_rate = np.sqrt(self._angular_acceleration * angles)
        """Largest body rate (3,) [rad/s] that is asked for: it can be stopped within half of the
        largest errors."""
        lag, slowest = rotor_lag(vehicle)
        unit = 1 / slowest + timestep  # [s]
        integrators, most = INTEGRATORS[controlled], INTEGRATORS["position"]
        room = np.array([ROOM[integrators[k]] for k in (0, 0, 2)])
        fastest = np.sqrt(self._angular_acceleration / angles * room)  # (3,) [rad/s]
        bandwidths = (
            min(gains.level / unit, *fastest[:2]),
            gains.height / unit,
            min(gains.heading / unit, fastest[2]),
        )
        level, height, heading = (
            # Loops outside of the controlled quantity have a gain of zero.
            np.append(np.zeros(full - n), cascade(lag, share * bandwidth, n, timestep))
            for bandwidth, full, n in zip(bandwidths, most, integrators, strict=True)
        )
        self._position_gain = np.array([level[0], height[0]])  # [1/s]
        self._velocity_gain = np.array([level[1], level[1], height[1]])  # [1/s]
        self._attitude_gain = np.array([level[2], level[2], heading[0]])  # [1/s]
        self._body_rate_gain = np.array([level[3], level[3], heading[1]])  # [1/s]
        self._lead = np.array([height[2], level[4], level[4], heading[2]])  # thrust, moments

    def approach_velocity(self, offset: Array, max_speed: float) -> Array:
        """Velocity (N, 3) [m/s] to a place at an offset (N, 3) [m], both in the world frame.

        Near the place it is proportional to the distance d; farther away it is the speed that half
        of the largest acceleration, b, can stop: sqrt(2 b (d - d_0 / 2)). Both meet smoothly at
        d_0 = b / k^2.
        """
        rate, brake = self._position_gain, self.max_acceleration[1:] / 2  # (2,), level and up
        half = brake / rate**2 / 2
        distance = columns(norm(offset[:, :2])[:, None], np.abs(offset[:, 2:]))  # (N, 2)
        stoppable = np.sqrt(2 * brake * np.maximum(distance - half, half))
        speed = np.minimum(np.minimum(rate * distance, stoppable), max_speed)
        return offset * (speed / np.maximum(distance, 1e-9)).T.take((0, 0, 1), axis=0).T

    def rotor_command(
        self,
        motion: State | Reading,
        error: Array,
        heading: Array,
        turn: Array | float = 0.0,
        target_motion: Motion | None = None,
    ) -> Array:
        """Rotor commands (N, R) [rad/s] that remove an error of the velocity.

        Args:
            motion: The aircraft now.
            error: Velocity less the wanted one (N, 3) [m/s], world frame.
            heading: Wanted heading, unit vectors (N, 2), east and north.
            turn: Rate of that heading (N, 1) [rad/s].
            target_motion: Acceleration [m/s^2] and jerk [m/s^3] of the target, (N, 3) each, world
                frame, to feed forward.
        """
        wanted = -self._velocity_gain * error
        level = limited(wanted[:, :2], self.max_acceleration[0])
        climb = within(wanted[:, 2:], -self._descent, self._climb)
        force = columns(level, climb + GRAVITY)  # [m/s^2], specific
        if target_motion is not None:
            force = force + target_motion[0]
        drag = self.vehicle.drag_coefficient / self.vehicle.mass * motion.speed
        force = to_body(motion.rotation, force + drag[:, None] * motion.velocity)
        ahead = (motion.rotation[:, :2] * heading[:, :, None]).sum(axis=-2)  # to the body frame
        body_rate = -self._attitude_gain * attitude_error(force, ahead)
        body_rate = within(body_rate, -self.max_body_rate, self.max_body_rate)
        if target_motion is not None:
            # Body z turns with the force: omega x e3 = jerk / |f| across it.
            jerk = to_body(motion.rotation, target_motion[1]) / norm(force)[:, None]
            body_rate = body_rate + columns(-jerk[:, 1:2], jerk[:, :1], 0 * jerk[:, 2:])
        body_rate = body_rate + turn * motion.rotation[:, 2]  # about the vertical
        return self.body_rate_command(motion, self.vehicle.mass * force[:, 2:], body_rate)

    def body_rate_command(self, motion: State | Reading, thrust: Array, body_rate: Array) -> Array:
        """Rotor commands (N, R) [rad/s] for a thrust and body rate, with a lead against the lag.

        They stay between the commands of actions -1 and 1 in the control mode "rotor".

        Args:
            motion: The aircraft now.
            thrust: Wanted collective thrust (N, 1) [N].
            body_rate: Wanted body rate (N, 3) [rad/s].
        """
        omega, largest = motion.body_rate, self._angular_acceleration
        acceleration = within(self._body_rate_gain * (body_rate - omega), -largest, largest)
        drag = self.vehicle.moment_coefficient * motion.angular_speed
        moment = self._inertia * acceleration + cross(omega, self._inertia * omega)
        moment = moment + drag[:, None] * omega
        now = product(self.vehicle.mixer, motion.rotor_speed**2)
        wrench = now + self._lead * (columns(thrust, moment) - now)
        return np.sqrt(self._allocation.mix(wrench))


def rotor_lag(vehicle: Vehicle) -> tuple[float, float]:
    """Rates [1/s] at which rotors follow their commands: for the poles, and for the bandwidths.

    For a moment as many rotors speed up as slow down, by as much, so that its rate is the mean of
    lag_up and lag_down, for which the poles are placed. Thrust alone follows at either rate, so
    the bandwidths are those of the slower one.
    """
    rates = [rate for rotor in vehicle.rotors for rate in (rotor.lag_up, rotor.lag_down)]
    return sum(rates) / len(rates), min(rates)


def cascade(lag: float, bandwidth: float, integrators: int, timestep: float) -> Array:
    """Gains of nested loops around a chain of integrators that the rotors drive.

    All poles of the closed loop, sampled with lag and hold, are at exp(-bandwidth * timestep)
    (Ackermann's formula).

    Args:
        lag: Rate of the rotors [1/s].
        bandwidth: Bandwidth of the closed loop [rad/s].
        integrators: Number of integrators, n.
        timestep: Time between two commands [s].

    Returns:
        (n + 1,): the gains of the n loops from the outermost [1/s], and the lead: the commanded
        over the wanted change of thrust or moment.
    """
    size = integrators + 1
    a, b = np.eye(size, k=1), np.eye(size)[:, -1:] * lag
    a[-1, -1] = -lag
    a, b = sampled(a, b, timestep)
    power = np.linalg.matrix_power
    reach = np.hstack([power(a, k) @ b for k in range(size)])
    placed = power(a - math.exp(-bandwidth * timestep) * np.eye(size), size)
    gains = np.linalg.solve(reach.T, np.eye(size)[-1]) @ placed
    gains[-1] += 1
    return np.append(gains[:-1] / gains[1:], gains[-1])


def sampled(a: Array, b: Array, timestep: float) -> tuple[Array, Array]:
    """The linear system dx/dt = a x + b u with u held over a step [s]: x' = A x + B u, exactly."""
    from scipy.linalg import expm  # takes a sixth of a second, and not every program needs it

    size = len(a)
    system = np.vstack([np.hstack([a, b]), np.zeros((b.shape[1], size + b.shape[1]))])
    both = expm(timestep * system)[:size]
    return both[:, :size], both[:, size:]


def attitude_error(force: Array, heading: Array) -> Array:
    """e_R (N, 3) = (R_d^T R - R^T R_d)^vee / 2: the sine of the angle from R_d to R, on its axis.

    R_d = (b1, b2, b3) has b3 along the force and b1 over the heading. In the body frame its columns
    are those of R^T R_d.

    Args:
        force: (N, 3) of any length, body frame.
        heading: (N, 3) of any length, body frame.
    """
    b3 = force / norm(force)[:, None]
    b2 = cross(b3, heading)
    b2 = b2 / norm(b2)[:, None]
    b = columns(cross(b2, b3), b2, b3).T  # (9, N)
    return (b.take((7, 2, 3), axis=0) - b.take((5, 6, 1), axis=0)).T / 2


def turned(vector: Array, heading: Array) -> Array:
    """Vectors (N, k) turned about the vertical by a heading (N, 2): forward, left to east, north.

    The opposite heading, (east, -north), turns world vectors to forward and left.
    """
    east, north, x, y = heading[:, :1], heading[:, 1:], vector[:, :1], vector[:, 1:2]
    return columns(east * x - north * y, north * x + east * y, vector[:, 2:])


def limited(vector: Array, largest: float) -> Array:
    """The vectors (N, k), shortened to a length of at most `largest`."""
    return vector * (largest / np.maximum(norm(vector), largest))[:, None]


def cross(first: Array, second: Array) -> Array:
    """Cross product (N, 3); NumPy's own takes four times as long for N = 1."""
    a, b, ahead, back = first.T, second.T, (1, 2, 0), (2, 0, 1)
    return (a.take(ahead, 0) * b.take(back, 0) - a.take(back, 0) * b.take(ahead, 0)).T
