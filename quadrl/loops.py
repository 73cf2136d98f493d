"""The loops that fly an aircraft: position, velocity, attitude, body rate, rotors.

Shared by the geometric controller, which flies them at the control step, and by the action
interfaces, which fly them at the physics step. Lee, Leok and McClamroch, "Geometric Tracking
Control of a Quadrotor UAV on SE(3)", CDC 2010; their force and moment act at once, while here they
come through rotors that lag, once a step, from a narrow range of commands. So the gains place the
poles of the whole chain from moment to what is controlled, sampled as it is flown, and each loop
asks of the next one only what the rotors can give.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, Protocol

import numpy as np

from quadrl.rotation import norm, to_world
from quadrl.task import OptionError
from quadrl.vehicle import GRAVITY, ROTOR_DIRECTIONS, ROTORS, YAW_REACTION, Vehicle

MAX_TURN = 0.5  # [rad], of the desired heading from the present one
Controlled = Literal["position", "velocity", "body_rate"]
INTEGRATORS: dict[Controlled, tuple[int, int, int]] = {
    "position": (4, 2, 2),
    "velocity": (3, 1, 1),
    "body_rate": (1, 0, 1),
}
"""How many stand between the rotors and what is controlled: east and north, up, heading.

Beside a velocity goes the rate of the heading, beside body rates the thrust.
"""
ROOM = {1: 4, 2: 3, 3: 1, 4: 1}
"""By integrators: the square of the bandwidth, over the largest angular acceleration by the largest
angle, at which the inner loops ask for no more than that: they multiply the largest rate by p / 2
(of one integrator), the largest angle by p^2 / 3 (of two) or p^2 (of three)."""


class Motion(Protocol):
    """What the loops need to know of aircraft: a State, or what a controller has read."""

    @property
    def rotation(self) -> np.ndarray:
        """(..., 3, 3), body to world."""
        ...

    @property
    def velocity(self) -> np.ndarray:
        """(..., 3) [m/s], world frame."""
        ...

    @property
    def body_rate(self) -> np.ndarray:
        """(..., 3) [rad/s], body frame."""
        ...

    @property
    def rotor_speed(self) -> np.ndarray:
        """(..., 4) [rad/s]."""
        ...


@dataclasses.dataclass(frozen=True)
class Gains:
    """Bandwidths and limits as shares of what the aircraft can do, so that one set flies many.

    A bandwidth is the share of 1 / (time constant of the rotors + control step).
    """

    level: float = 1.3
    """Bandwidth of east and north: position, velocity, tilt, body rate and moment."""
    height: float = 1.3
    """Bandwidth of the altitude: position, velocity and thrust."""
    heading: float = 1.0
    """Bandwidth of the heading: angle, rate and moment."""
    authority: float = 0.8
    """Share of the largest accelerations, linear and angular, that is asked for; under 1."""
    max_speed: float = 2.0
    """Largest speed towards the setpoint [m/s]."""
    max_tilt: float = 0.4
    """Largest tilt that is asked for [rad]; less where the thrust would not carry the weight."""

    def __post_init__(self) -> None:
        """Refuse what cannot fly."""
        for name, value in vars(self).items():
            most = {"authority": 1.0, "max_tilt": math.pi / 2}.get(name, math.inf)
            if not 0 < value < most:
                raise OptionError(f"{name} = {value!r}: between 0 and {most} is allowed")


class Loops:
    """Nested loops for aircraft of any leading shape, without a memory.

    From the outermost: `approach`, `specific_force`, `attitude_rate` and `thrust`, `rotor_command`.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        step: float,
        controlled: Controlled,
        gains: Gains | None = None,
        pace: float = 1.0,
    ) -> None:
        """Place the poles.

        Args:
            vehicle: The aircraft.
            step: Time between two commands to the rotors [s].
            controlled: What the outermost loop controls.
            gains: Bandwidths and limits; None for the defaults.
            pace: Share of the bandwidths that gains, lag and moments allow.
        """
        self.vehicle, self.gains = vehicle, (gains := gains or Gains())
        self._mixer, self._inertia = mixer(vehicle), np.array(vehicle.inertia)
        self._unmix = np.linalg.inv(self._mixer)
        # Squares of the rotor commands [rad^2/s^2].
        self._low, self._high = vehicle.rotor_command(np.array([-1.0, 1.0])) ** 2
        hover = vehicle.hover_speed**2
        self.max_sink: float = gains.authority * GRAVITY * (1 - self._low / hover)
        """Largest acceleration downwards that is asked for [m/s^2]."""
        self.max_climb: float = gains.authority * GRAVITY * (self._high / hover - 1)
        """Upwards [m/s^2]."""
        tilt = min(gains.max_tilt, gains.authority * math.acos(hover / self._high))  # [rad]
        self.max_level = GRAVITY * math.tan(tilt)
        """Sideways [m/s^2]."""
        moment = np.abs(self._mixer[1:]).sum(1) / 2 * (self._high - self._low)
        self._max_turn = gains.authority * moment / self._inertia  # (3,) [rad/s^2]
        angles = np.array([tilt, tilt, MAX_TURN])  # [rad], the largest errors
        # Stopped within half of those.
        self.max_body_rate = np.sqrt(self._max_turn * angles)
        """(3,) [rad/s], largest that is asked for."""
        # As fast as the lag allows, if the moments suffice for the largest errors.
        sideways, upwards, turning = INTEGRATORS[controlled]
        room = np.array([ROOM[sideways], ROOM[sideways], ROOM[turning]])
        fastest = np.sqrt(self._max_turn / angles * room)  # (3,) [rad/s]
        unit = 1 / vehicle.lag_rate + step  # [s]
        bandwidths = (
            min(gains.level / unit, *fastest[:2]),
            gains.height / unit,
            min(gains.heading / unit, fastest[2]),
        )
        level, height, heading = (
            # Loops further out than what is controlled have a rate of zero.
            np.append(np.zeros(most - n), cascade(vehicle, pace * bandwidth, n, step))
            for bandwidth, most, n in zip(
                bandwidths, INTEGRATORS["position"], (sideways, upwards, turning), strict=True
            )
        )
        self._level_rate, self._height_rate = level[0], height[0]  # [1/s]
        self._velocity_rate = np.array([level[1], level[1], height[1]])  # [1/s]
        self._attitude_rate = np.array([level[2], level[2], heading[0]])  # [1/s]
        self._spin_rate = np.array([level[3], level[3], heading[1]])  # [1/s]
        self._lead = np.array([height[2], level[4], level[4], heading[2]])  # thrust, moments

    def approach(self, offset: np.ndarray, fastest: float) -> np.ndarray:
        """Velocity (..., 3) [m/s] to a place at an offset (..., 3) [m], both in the world frame."""
        level, height = offset[..., :2], offset[..., 2:]
        brake = min(self.max_climb, self.max_sink) / 2
        parts = [
            approach_velocity(level, self._level_rate, self.max_level / 2, fastest),
            approach_velocity(height, self._height_rate, brake, fastest),
        ]
        return np.concatenate(parts, axis=-1)

    def specific_force(self, velocity: np.ndarray, error: np.ndarray) -> np.ndarray:
        """-k e + g e3 (..., 3) [m/s^2], world frame, within what can be given; and against drag.

        Args:
            velocity: (..., 3) [m/s], world frame.
            error: (..., 3) [m/s], by how much it is too large.
        """
        wanted = -self._velocity_rate * error
        level = limited(wanted[..., :2], self.max_level)
        climb = np.clip(wanted[..., 2:], -self.max_sink, self.max_climb) + GRAVITY
        drag = self.vehicle.drag_coefficient / self.vehicle.mass * norm(velocity)
        return np.concatenate([level, climb], axis=-1) + drag[..., None] * velocity

    def attitude_rate(
        self, rotation: np.ndarray, force: np.ndarray, heading: np.ndarray
    ) -> np.ndarray:
        """Body rate (..., 3) [rad/s] towards the attitude of a force and a heading.

        Args:
            rotation: (..., 3, 3), body to world.
            force: (..., 3), of any length, world frame: the direction of the thrust.
            heading: Unit vectors (..., 2), east and north.
        """
        error = attitude_error(rotation, desired_rotation(force, heading))
        return np.clip(-self._attitude_rate * error, -self.max_body_rate, self.max_body_rate)

    def thrust(self, rotation: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Collective thrust (..., 1) [N] of a specific force (..., 3) [m/s^2]: m force . R e3."""
        along = np.sum(force * rotation[..., :, 2], axis=-1, keepdims=True)
        return self.vehicle.mass * along

    def rotor_command(
        self, motion: Motion, thrust: np.ndarray, body_rate: np.ndarray
    ) -> np.ndarray:
        """Commands (..., 4) [rad/s] that bring thrust and body rate through the lag.

        The moment is M = J turn + omega x J omega, and against drag. Commands stay within what
        actions of -1 and 1 command.

        Args:
            motion: What is.
            thrust: (..., 1) [N], collective.
            body_rate: (..., 3) [rad/s], the wanted one.
        """
        vehicle, omega = self.vehicle, motion.body_rate
        turn = -self._spin_rate * (omega - body_rate)
        turn = np.clip(turn, -self._max_turn, self._max_turn)
        moment = self._inertia * turn + cross(omega, self._inertia * omega)
        moment = moment + vehicle.moment_coefficient * norm(omega)[..., None] * omega
        now = to_world(self._mixer, motion.rotor_speed**2)
        command = now + self._lead * (np.concatenate([thrust, moment], axis=-1) - now)
        return np.sqrt(mix(command, self._unmix, self._low, self._high))


def cascade(vehicle: Vehicle, bandwidth: float, integrators: int, step: float) -> np.ndarray:
    """Gains of nested loops around a chain of integrators that the rotors drive.

    All poles of the closed loop, sampled with lag and hold, stand at exp(-bandwidth * step)
    (Ackermann's formula).

    Args:
        vehicle: The aircraft.
        bandwidth: [rad/s].
        integrators: n, between what the rotors give and what is controlled.
        step: Time between two commands [s].

    Returns:
        (n + 1,): the rates of the n loops from the outermost [1/s], and the lead: how many times
        the wanted change of thrust or moment is commanded.
    """
    size = integrators + 1
    a, b = np.eye(size, k=1), np.eye(size)[:, -1:] * vehicle.lag_rate
    a[-1, -1] = -vehicle.lag_rate
    a, b = sampled(a, b, step)
    power = np.linalg.matrix_power
    reach = np.hstack([power(a, k) @ b for k in range(size)])
    placed = power(a - math.exp(-bandwidth * step) * np.eye(size), size)
    gains = np.linalg.solve(reach.T, np.eye(size)[-1]) @ placed
    gains[-1] += 1
    return np.append(gains[:-1] / gains[1:], gains[-1])


def sampled(a: np.ndarray, b: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """The linear system dx/dt = a x + b u with u held over a step [s]: x' = A x + B u, exactly."""
    from scipy.linalg import expm  # a sixth of a second, and not everybody needs it

    size = len(a)
    system = np.vstack([np.hstack([a, b]), np.zeros((b.shape[1], size + b.shape[1]))])
    both = expm(step * system)[:size]
    return both[:, :size], both[:, size:]


def mixer(vehicle: Vehicle) -> np.ndarray:
    """(4, 4): squares of the rotor speeds to thrust [N] and moments [N m] (equation 7)."""
    x, y = vehicle.arm_length * np.array(ROTOR_DIRECTIONS).T
    thrust = np.full(ROTORS, vehicle.thrust_coefficient)
    yaw = vehicle.torque_coefficient * np.array(YAW_REACTION)
    return np.stack([thrust, y * thrust, -x * thrust, yaw])


def mix(wrench: np.ndarray, unmix: np.ndarray, low: float, high: float) -> np.ndarray:
    """Squares of the rotor speeds (..., 4), within low and high, for thrust and moments (..., 4).

    What does not fit is cut: first yaw, then thrust, then roll and pitch together. `unmix` (4, 4)
    is the inverse of the mixer.
    """
    tilt = to_world(unmix[:, 1:3], wrench[..., 1:3])
    spread = np.max(tilt, axis=-1, keepdims=True) - np.min(tilt, axis=-1, keepdims=True)
    tilt = tilt * ((high - low) / np.maximum(spread, high - low))
    lift = wrench[..., :1] * unmix[:, 0]
    least, most = np.min(tilt, axis=-1, keepdims=True), np.max(tilt, axis=-1, keepdims=True)
    squares = tilt + np.minimum(np.maximum(lift, low - least), high - most)
    yaw = wrench[..., 3:] * unmix[:, 3]
    room = np.where(yaw > 0, high - squares, squares - low) / np.maximum(np.abs(yaw), 1e-9)
    share = np.clip(np.min(room, axis=-1, keepdims=True), 0.0, 1.0)
    return np.clip(squares + share * yaw, low, high)


def attitude_error(rotation: np.ndarray, desired: np.ndarray) -> np.ndarray:
    """e_R (..., 3) = (R_d^T R - R^T R_d)^vee / 2, of rotations (..., 3, 3) body to world."""
    product = np.sum(desired[..., :, :, None] * rotation[..., :, None, :], axis=-3)
    skew = (product - np.swapaxes(product, -1, -2)) / 2
    return np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)


def heading_of(rotation: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 2), east and north, of where body x points; east if up or down."""
    ahead = rotation[..., :2, 0]
    length = norm(ahead)[..., None]
    return np.where(length > 1e-6, ahead / np.maximum(length, 1e-6), np.array([1.0, 0.0]))


def desired_rotation(force: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """R_d (..., 3, 3): b3 along a force (..., 3), b1 over a heading (..., 2)."""
    b1 = np.concatenate([heading, np.zeros_like(heading[..., :1])], axis=-1)
    b3 = force / norm(force)[..., None]
    b2 = cross(b3, b1)
    b2 = b2 / norm(b2)[..., None]
    return np.stack([cross(b2, b3), b2, b3], axis=-1)


def approach_velocity(offset: np.ndarray, rate: float, brake: float, fastest: float) -> np.ndarray:
    """Velocity (..., k) [m/s] towards a point at an offset (..., k) [m].

    In proportion to the distance near the point; farther off what `brake` [m/s^2] can stop.
    """
    distance = norm(offset)[..., None]
    near = brake / rate**2
    stoppable = np.sqrt(2 * brake * np.maximum(distance - near / 2, near / 2))
    speed = np.minimum(np.minimum(rate * distance, stoppable), fastest)
    return offset * (speed / np.maximum(distance, 1e-9))


def limited(vector: np.ndarray, largest: float) -> np.ndarray:
    """The vectors (..., k), shortened to a length of at most `largest`."""
    return vector * (largest / np.maximum(norm(vector), largest))[..., None]


def cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Cross product (..., 3): NumPy's own takes four times as long for one aircraft."""
    ahead, back = [1, 2, 0], [2, 0, 1]
    return first[..., ahead] * second[..., back] - first[..., back] * second[..., ahead]
