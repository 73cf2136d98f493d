"""Geometric tracking control on SE(3), with the lag of the rotors in the design.

Lee, Leok and McClamroch, "Geometric Tracking Control of a Quadrotor UAV on SE(3)", CDC 2010. Their
force and moment act at once; here they come through rotors that lag, once a control step, from a
narrow range of commands. So the gains place the poles of the whole chain from moment to position,
sampled as it is flown, and each loop asks of the next one only what the rotors can give.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.signal import cont2discrete

from quadrl.rotation import norm, to_world
from quadrl.task import OBSERVATION, OptionError, Task
from quadrl.vehicle import GRAVITY, ROTOR_DIRECTIONS, ROTORS, YAW_REACTION, Vehicle

MAX_TURN = 0.5  # [rad], of the desired heading from the present one
DESCENT_RATE = 0.8  # [1/s], sink speed of a landing over its height
TOUCHDOWN_SPEED = 0.2  # [m/s]
MAX_DESCENT_SPEED = 1.2  # [m/s]


@dataclasses.dataclass(frozen=True)
class Reading:
    """What a flat observation says, in the frames that controllers use."""

    rotation: np.ndarray  # (..., 3, 3), body to world
    velocity: np.ndarray  # (..., 3) [m/s], world frame
    body_rate: np.ndarray  # (..., 3) [rad/s], body frame
    rotor_speed: np.ndarray  # (..., 4) [rad/s]
    to_goal: np.ndarray  # (..., 3) [m], from the aircraft to the goal, world frame
    target_velocity: np.ndarray  # (..., 3) [m/s], world frame; zero where nothing moves

    @classmethod
    def of(cls, observation: np.ndarray, task: Task | None, vehicle: Vehicle) -> Reading:
        """Read the observation (..., size) of a task; None for the parts that all tasks have.

        Raises:
            OptionError: The observation has another size.
        """
        parts = OBSERVATION if task is None else task.observation
        ends = np.cumsum([part.size for part in parts.values()])
        observation = np.asarray(observation, dtype=np.float64)
        if observation.shape[-1:] != (ends[-1],):
            raise OptionError(f"observation {observation.shape}: (..., {ends[-1]}) is expected")
        part = dict(zip(parts, np.split(observation, ends[:-1], axis=-1), strict=True))
        rotation = rotation_of_angles(part["sin_attitude"], part["cos_attitude"])
        velocity = to_world(rotation, part["velocity"])
        relative = to_world(rotation, part.get("target_velocity", -part["velocity"]))
        return cls(
            rotation=rotation,
            velocity=velocity,
            body_rate=part["body_rate"],
            rotor_speed=part["rotor_speed"] * vehicle.max_speed,
            to_goal=to_world(rotation, part["goal"]),
            target_velocity=velocity + relative,
        )

    @property
    def heading(self) -> np.ndarray:
        """Unit vectors (..., 2), east and north, of where body x points; east if up or down."""
        ahead = self.rotation[..., :2, 0]
        length = norm(ahead)[..., None]
        return np.where(length > 1e-6, ahead / np.maximum(length, 1e-6), np.array([1.0, 0.0]))


@dataclasses.dataclass(frozen=True)
class Setpoint:
    """Where to be and how fast, now."""

    offset: np.ndarray  # (..., 3) [m], from the aircraft to where it should be, world frame
    velocity: np.ndarray  # (..., 3) [m/s], of that place, world frame


def fly_to_goal(reading: Reading, task: Task | None) -> Setpoint:
    """To the goal, and along with it where it moves."""
    return Setpoint(reading.to_goal, reading.target_velocity)


def follow_line(reading: Reading, task: Task | None) -> Setpoint:
    """To the nearest point of the line through the goal, and along it at its velocity."""
    line = reading.target_velocity
    along = line / np.maximum(norm(line), 1e-9)[..., None]
    ahead = np.sum(reading.to_goal * along, axis=-1, keepdims=True)
    return Setpoint(reading.to_goal - ahead * along, line)


def keep_distance(reading: Reading, task: Task | None) -> Setpoint:
    """To the nearest point at the task's distance from the target, and along with the target."""
    share = getattr(task, "keep", 1.0) / np.maximum(norm(reading.to_goal), 1e-9)
    return Setpoint(reading.to_goal * (1 - share)[..., None], reading.target_velocity)


def descend(reading: Reading, task: Task | None) -> Setpoint:
    """Over the pad, and down on it, slower the lower; it presses on when the pad is reached."""
    height = np.maximum(-reading.to_goal[..., 2], 0.0)
    aside = norm(reading.to_goal[..., :2])
    sink = np.minimum(DESCENT_RATE * height + TOUCHDOWN_SPEED, MAX_DESCENT_SPEED)
    sink = sink * np.clip(1.5 - aside / (0.2 + 0.2 * height), 0.0, 1.0)  # within a cone
    zero = np.zeros_like(sink)
    offset = np.stack([reading.to_goal[..., 0], reading.to_goal[..., 1], zero], axis=-1)
    return Setpoint(offset, np.stack([zero, zero, -sink], axis=-1))


Guidance = Callable[[Reading, Task | None], Setpoint]
GUIDANCE: dict[str, Guidance] = {
    "straight_and_level": follow_line,
    "target_following": keep_distance,
    "landing": descend,
}
"""How the tasks are flown that ask for more than to fly to the goal."""


def guidance(task: Task | None) -> Guidance:
    """What a task is flown with; None flies to the goal."""
    return fly_to_goal if task is None else GUIDANCE.get(task.name, fly_to_goal)


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


class GeometricController:
    """Flat observations of a task to actions, for aircraft of any leading shape."""

    def __init__(
        self, vehicle: Vehicle, task: Task | None = None, gains: Gains | None = None
    ) -> None:
        """Place the poles.

        Args:
            vehicle: The aircraft.
            task: Says where to be and whether to head east; None flies to the goal, at any heading.
            gains: Bandwidths and limits; None for the defaults.
        """
        self.vehicle, self.task, self.gains = vehicle, task, (gains := gains or Gains())
        self._mixer, self._inertia = mixer(vehicle), np.array(vehicle.inertia)
        self._unmix = np.linalg.inv(self._mixer)
        # Squares of the rotor commands [rad^2/s^2].
        self._low, self._high = vehicle.rotor_command(np.array([-1.0, 1.0])) ** 2
        hover = vehicle.hover_speed**2
        self._max_sink = gains.authority * GRAVITY * (1 - self._low / hover)  # [m/s^2]
        self._max_climb = gains.authority * GRAVITY * (self._high / hover - 1)  # [m/s^2]
        tilt = min(gains.max_tilt, gains.authority * math.acos(hover / self._high))  # [rad]
        self._max_level = GRAVITY * math.tan(tilt)  # [m/s^2]
        moment = np.abs(self._mixer[1:]).sum(1) / 2 * (self._high - self._low)
        self._max_turn = gains.authority * moment / self._inertia  # (3,) [rad/s^2]
        angles = np.array([tilt, tilt, MAX_TURN])  # [rad], the largest errors
        # Stopped within half of those.
        self._max_body_rate = np.sqrt(self._max_turn * angles)  # (3,) [rad/s]
        # As fast as the lag allows, if the moments suffice for the largest errors.
        fastest = np.sqrt(self._max_turn / angles * np.array([1, 1, 3]))  # (3,) [rad/s]
        unit = 1 / vehicle.lag_rate + vehicle.control_step  # [s]
        level = cascade(vehicle, min(gains.level / unit, *fastest[:2]), 4)
        height = cascade(vehicle, gains.height / unit, 2)
        heading = cascade(vehicle, min(gains.heading / unit, fastest[2]), 2)
        self._level_rate, self._height_rate = level[0], height[0]  # [1/s]
        self._velocity_rate = np.array([level[1], level[1], height[1]])  # [1/s]
        self._attitude_rate = np.array([level[2], level[2], heading[0]])  # [1/s]
        self._spin_rate = np.array([level[3], level[3], heading[1]])  # [1/s]
        self._lead = np.array([height[2], level[4], level[4], heading[2]])  # thrust, moments

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The action (..., 4), within [-1, 1], for a flat observation (..., size)."""
        reading = Reading.of(observation, self.task, self.vehicle)
        force = self._specific_force(reading)
        error = attitude_error(reading.rotation, self._desired_rotation(reading, force))
        limit = self._max_body_rate
        body_rate = np.clip(-self._attitude_rate * error, -limit, limit)
        turn = -self._spin_rate * (reading.body_rate - body_rate)
        return self._action(reading, force, np.clip(turn, -self._max_turn, self._max_turn))

    def _specific_force(self, reading: Reading) -> np.ndarray:
        """-k_x e_x - k_v e_v + g e3 (..., 3) [m/s^2], world frame, each term limited; and drag."""
        setpoint = guidance(self.task)(reading, self.task)
        level, height = setpoint.offset[..., :2], setpoint.offset[..., 2:]
        fastest, brake = self.gains.max_speed, min(self._max_climb, self._max_sink) / 2
        approach = [
            approach_velocity(level, self._level_rate, self._max_level / 2, fastest),
            approach_velocity(height, self._height_rate, brake, fastest),
        ]
        error = reading.velocity - setpoint.velocity - np.concatenate(approach, axis=-1)
        wanted = -self._velocity_rate * error
        level = limited(wanted[..., :2], self._max_level)
        climb = np.clip(wanted[..., 2:], -self._max_sink, self._max_climb) + GRAVITY
        drag = self.vehicle.drag_coefficient / self.vehicle.mass * norm(reading.velocity)
        return np.concatenate([level, climb], axis=-1) + drag[..., None] * reading.velocity

    def _desired_rotation(self, reading: Reading, force: np.ndarray) -> np.ndarray:
        """R_d (..., 3, 3): b3 along the force, b1 over the heading, and Omega_d = 0."""
        heading = reading.heading
        if self.task is not None and self.task.heading_matters:
            heading = towards_east(heading)
        b1 = np.concatenate([heading, np.zeros_like(heading[..., :1])], axis=-1)
        b3 = force / norm(force)[..., None]
        b2 = np.cross(b3, b1)
        b2 = b2 / norm(b2)[..., None]
        return np.stack([np.cross(b2, b3), b2, b3], axis=-1)

    def _action(self, reading: Reading, force: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """The action that brings thrust and moments, through the lag, to f and M of the paper.

        Here f = m force . R e3 and M = J turn + omega x J omega (and against drag).

        Args:
            reading: What is.
            force: (..., 3) [m/s^2], specific force, world frame.
            turn: (..., 3) [rad/s^2], angular acceleration, body frame.
        """
        vehicle, omega = self.vehicle, reading.body_rate
        thrust = vehicle.mass * np.sum(force * reading.rotation[..., :, 2], axis=-1, keepdims=True)
        moment = self._inertia * turn + np.cross(omega, self._inertia * omega)
        moment = moment + vehicle.moment_coefficient * norm(omega)[..., None] * omega
        now = to_world(self._mixer, reading.rotor_speed**2)
        command = now + self._lead * (np.concatenate([thrust, moment], axis=-1) - now)
        squares = mix(command, self._unmix, self._low, self._high)
        return np.clip((np.sqrt(squares) - vehicle.hover_speed) / vehicle.action_scale, -1.0, 1.0)


def cascade(vehicle: Vehicle, bandwidth: float, integrators: int) -> np.ndarray:
    """Gains of nested loops around a chain of integrators that the rotors drive.

    All poles of the closed loop, sampled at the control step with lag and hold, stand at
    exp(-bandwidth * control step) (Ackermann's formula).

    Args:
        vehicle: The aircraft.
        bandwidth: [rad/s].
        integrators: n, between what the rotors give and what is controlled.

    Returns:
        (n + 1,): the rates of the n loops from the outermost [1/s], and the lead: how many times
        the wanted change of thrust or moment is commanded.
    """
    size = integrators + 1
    a, b = np.eye(size, k=1), np.eye(size)[:, -1:] * vehicle.lag_rate
    a[-1, -1] = -vehicle.lag_rate
    a, b = sampled(a, b, vehicle.control_step)
    power = np.linalg.matrix_power
    reach = np.hstack([power(a, k) @ b for k in range(size)])
    placed = power(a - math.exp(-bandwidth * vehicle.control_step) * np.eye(size), size)
    gains = np.linalg.solve(reach.T, np.eye(size)[-1]) @ placed
    gains[-1] += 1
    return np.append(gains[:-1] / gains[1:], gains[-1])


def sampled(a: np.ndarray, b: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """The linear system dx/dt = a x + b u with u held over a step [s]: x' = A x + B u, exactly."""
    system: Any = cont2discrete((a, b, np.eye(len(a)), np.zeros_like(b)), step, method="zoh")
    return system[0], system[1]


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


def towards_east(heading: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 2): east, or where it is farther the heading turned by MAX_TURN to it."""
    east, north = heading[..., 0], heading[..., 1]
    cosine, sine = math.cos(MAX_TURN), np.where(north > 0, -1.0, 1.0) * math.sin(MAX_TURN)
    turned = np.stack([cosine * east - sine * north, sine * east + cosine * north], axis=-1)
    return np.where((east > cosine)[..., None], np.array([1.0, 0.0]), turned)


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


def rotation_of_angles(sines: np.ndarray, cosines: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3), body to world, of sines and cosines (..., 3) of roll, pitch, yaw."""
    (sr, sp, sy), (cr, cp, cy) = np.moveaxis(sines, -1, 0), np.moveaxis(cosines, -1, 0)
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
