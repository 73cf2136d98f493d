"""What an action means: rotor speeds, thrust and body rates, a velocity, or a position.

An action is four numbers in [-1, 1]; every entry has a unit, a value at 0 and a scale that follow
from the vehicle. `rotor` is the paper's, and holds for a control step. The others are flown by
inner loops (`quadrl.loops`) that see the true state and command the rotors at every physics step,
as an autopilot does. They command them within what `rotor` can command, hover plus and minus
`Vehicle.action_scale`, so that interfaces differ in their meaning and not in their power.

Velocities and offsets are along the level heading: forward, left, up. So is what the Crazyflie's
hover setpoint takes, and MAVLink's SET_POSITION_TARGET_LOCAL_NED with MAV_FRAME_BODY_OFFSET_NED
(there forward, right, down).
"""

from __future__ import annotations

import abc
import dataclasses
from typing import ClassVar

import numpy as np

from quadrl.loops import MAX_TURN, Controlled, Loops, heading_of
from quadrl.rotation import Array
from quadrl.state import State
from quadrl.task import check_choices
from quadrl.vehicle import GRAVITY, ROTORS, Vehicle

HASTE = 1.0
"""[s] in which the largest acceleration that the loops ask for reaches the velocity at action 1;
the offset at action 1 is where half of it stops from there."""
PACE = 0.5
"""Share of the bandwidth at which positions are flown to. With all of it the rotors are at their
limits for every setpoint that an exploring policy draws, and hover was learned to 61 cm only."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """One number of an action."""

    name: str
    unit: str
    meaning: str
    """And the frame."""


class Interface(abc.ABC):
    """How actions (..., k) fly an aircraft of a vehicle; without a memory between control steps."""

    name: ClassVar[str]
    """The name in INTERFACES."""
    entries: ClassVar[tuple[Entry, ...]]
    """What the k numbers are."""
    has_loops: ClassVar[bool] = True
    """Whether the rotor commands follow the state, at every physics step."""

    vehicle: Vehicle
    centre: np.ndarray
    """(k,) in the entries' units, at an action of 0."""
    scale: np.ndarray
    """(k,) what an action of 1 adds to it, and -1 takes away."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Take the scales from the vehicle."""
        self.vehicle = vehicle

    @property
    def size(self) -> int:
        """Numbers in an action, k."""
        return len(self.entries)

    def values(self, action: np.ndarray) -> np.ndarray:
        """What actions (..., k), clipped to [-1, 1], ask for: (..., k) in the entries' units."""
        return self.centre + self.scale * np.minimum(np.maximum(action, -1.0), 1.0)

    def setpoint(self, state: State, action: np.ndarray) -> np.ndarray:
        """What is held for a control step, (..., n), of the state in which it begins."""
        return self.values(action)

    @abc.abstractmethod
    def rotor_command(self, state: State, setpoint: np.ndarray) -> np.ndarray:
        """Rotor speed commands (..., 4) [rad/s] for the next physics step."""


class Rotor(Interface):
    """The paper's: each number is a change of a rotor's speed command from hover."""

    name = "rotor"
    entries = tuple(
        Entry(f"rotor_{k + 1}", "rad/s", f"speed command of the rotor {where}")
        for k, where in enumerate(("ahead", "on the left", "behind", "on the right"))
    )
    has_loops = False

    def __init__(self, vehicle: Vehicle) -> None:
        """Hover, plus and minus the vehicle's action scale."""
        super().__init__(vehicle)
        self.centre = np.full(ROTORS, vehicle.hover_speed)
        self.scale = np.full(ROTORS, vehicle.action_scale)

    def setpoint(self, state: State, action: np.ndarray) -> np.ndarray:
        """Within what the rotors can do: `Vehicle.rotor_command`."""
        return self.vehicle.rotor_command(action)

    def rotor_command(self, state: State, setpoint: np.ndarray) -> np.ndarray:
        """The setpoint itself."""
        return setpoint


class _Looped(Interface):
    """What is flown by loops at the physics step."""

    controlled: ClassVar[Controlled]
    pace: ClassVar[float] = 1.0

    def __init__(self, vehicle: Vehicle) -> None:
        """Place the poles for the physics step."""
        super().__init__(vehicle)
        loops = Loops(vehicle, vehicle.physics_step, self.controlled, pace=self.pace)
        self._loops = loops
        climb = min(loops.max_climb, loops.max_sink)
        self._acceleration = np.array([loops.max_level, loops.max_level, climb])  # [m/s^2]

    def _fly(
        self,
        state: State,
        error: np.ndarray,
        heading: np.ndarray,
        turn: np.ndarray | float = 0.0,
    ) -> np.ndarray:
        """Rotor commands (..., 4) [rad/s] that take away an error of the velocity.

        Args:
            state: What is.
            error: (..., 3) [m/s], world frame.
            heading: Unit vectors (..., 2) to point to, east and north.
            turn: (..., 1) [rad/s], rate of the heading.
        """
        loops = self._loops
        force = loops.specific_force(state.velocity, error)
        body_rate = loops.attitude_rate(state.rotation, force, heading)
        body_rate = body_rate + turn * state.rotation[..., 2, :]  # about the vertical
        return loops.rotor_command(state, loops.thrust(state.rotation, force), body_rate)


class ThrustBodyRate(_Looped):
    """Collective thrust and body rates, as acrobatic pilots and rate controllers have it."""

    name = "thrust_body_rate"
    controlled = "body_rate"
    entries = (
        Entry("thrust", "weight", "collective thrust over the aircraft's weight, along body z"),
        Entry("roll_rate", "rad/s", "about body x (forward)"),
        Entry("pitch_rate", "rad/s", "about body y (left): nose down"),
        Entry("yaw_rate", "rad/s", "about body z (up)"),
    )

    def __init__(self, vehicle: Vehicle) -> None:
        """Thrust as far as four rotors together reach down; rates that a largest tilt stops."""
        super().__init__(vehicle)
        loops = self._loops
        thrust = min(loops.max_climb, loops.max_sink) / GRAVITY
        self.centre = np.array([1.0, 0.0, 0.0, 0.0])
        self.scale = np.array([thrust, *loops.max_body_rate])

    def rotor_command(self, state: State, setpoint: np.ndarray) -> np.ndarray:
        """The rate loop alone."""
        thrust = self.vehicle.mass * GRAVITY * setpoint[..., :1]
        return self._loops.rotor_command(state, thrust, setpoint[..., 1:])


class Velocity(_Looped):
    """A velocity along the heading, and the rate of the heading."""

    name = "velocity"
    controlled = "velocity"
    entries = (
        Entry("forward", "m/s", "level, along the heading of the moment"),
        Entry("left", "m/s", "level, across the heading of the moment"),
        Entry("up", "m/s", "vertical"),
        Entry("yaw_rate", "rad/s", "of the heading, counter-clockwise from above"),
    )

    def __init__(self, vehicle: Vehicle) -> None:
        """Velocities that are reached within HASTE."""
        super().__init__(vehicle)
        self.centre = np.zeros(4)
        self.scale = np.append(self._acceleration * HASTE, self._loops.max_body_rate[2])

    def rotor_command(self, state: State, setpoint: np.ndarray) -> np.ndarray:
        """The velocity loop and those within it."""
        heading = heading_of(state.rotation)
        error = state.velocity - _to_world(heading, setpoint[..., :3])
        return self._fly(state, error, heading, setpoint[..., 3:])


class Position(_Looped):
    """A place and a heading, from those that the aircraft has when the control step begins.

    An action of 0 brakes and stays; a place is held by giving its offset again at every step.
    """

    name = "position"
    controlled = "position"
    pace = PACE
    entries = (
        Entry("forward", "m", "offset, level, along the heading"),
        Entry("left", "m", "offset, level, across the heading"),
        Entry("up", "m", "offset, vertical"),
        Entry("yaw", "rad", "turn of the heading, counter-clockwise from above"),
    )

    def __init__(self, vehicle: Vehicle) -> None:
        """Offsets at which the approach is as fast as HASTE allows."""
        super().__init__(vehicle)
        self.centre = np.zeros(4)
        self.scale = np.append(self._acceleration * HASTE**2, MAX_TURN)
        self._fastest = float(self._acceleration[0] * HASTE)  # [m/s]

    def setpoint(self, state: State, action: np.ndarray) -> np.ndarray:
        """Where to be (3) [m], task frame, and the heading (2), east and north: (..., 5)."""
        values = self.values(action)
        heading = heading_of(state.rotation)
        sine, cosine = np.sin(values[..., 3:]), np.cos(values[..., 3:])
        east, north = heading[..., :1], heading[..., 1:]
        place = state.position + _to_world(heading, values[..., :3])
        turned = [cosine * east - sine * north, sine * east + cosine * north]
        return np.concatenate([place, *turned], axis=-1)

    def rotor_command(self, state: State, setpoint: np.ndarray) -> np.ndarray:
        """Every loop."""
        approach = self._loops.approach(setpoint[..., :3] - state.position, self._fastest)
        return self._fly(state, state.velocity - approach, setpoint[..., 3:])


INTERFACES: dict[str, type[Interface]] = {
    kind.name: kind for kind in (Rotor, ThrustBodyRate, Velocity, Position)
}
"""Every action interface by name."""


def make(name: str, vehicle: Vehicle) -> Interface:
    """The interface of a name for a vehicle.

    Raises:
        OptionError: Unknown name; the message lists the choices.
    """
    check_choices([name], INTERFACES, "action interface")
    return INTERFACES[name](vehicle)


def _to_world(heading: Array, vector: Array) -> Array:
    """Vectors (..., 3), forward, left and up of a heading (..., 2), in the world frame."""
    east, north = heading[..., :1], heading[..., 1:]
    forward, left = vector[..., :1], vector[..., 1:2]
    level = [east * forward - north * left, north * forward + east * left]
    return np.concatenate([*level, vector[..., 2:]], axis=-1)
