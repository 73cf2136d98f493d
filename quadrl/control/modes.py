"""Control modes, the meaning of an action: rotor speeds, thrust and body rates, velocity, position.

An action is k numbers in [-1, 1]; each has a unit, a value at 0 and a scale that follow from the
vehicle. `rotor` is the paper's; its commands and those of `share` hold for a control step. The
others are flown by inner loops (`quadrl.control.loops`) that see the true state and command the
rotors at every physics step, as an autopilot does. `share` and `thrust_body_rate` span all that the
rotors can do; the others command speeds within hover plus and minus `Vehicle.action_scale`.

Velocities and offsets are along the level heading: forward, left, up, as in the Crazyflie's hover
setpoint and MAVLink's SET_POSITION_TARGET_LOCAL_NED with MAV_FRAME_BODY_OFFSET_NED (forward,
right, down).
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import numpy as np

from quadrl.aircraft.quadrotor import PLACES, as_x
from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import Array, heading_of, stack
from quadrl.base.validation import choice
from quadrl.control.allocation import columns, within
from quadrl.control.loops import MAX_HEADING_ERROR, Controlled, Loops, turned
from quadrl.control.mode import ActionTerm, ControlMode
from quadrl.engines.state import State

RESPONSE_TIME = 1.0
"""Time [s] in which the largest acceleration reaches the velocity of action 1; half of it can stop
from that velocity within the offset of action 1."""
POSITION_SHARE = 0.5
"""Share of the bandwidth with which positions are approached. With all of it the rotors reach their
limits for every setpoint of an exploring policy, and hover was learned to 61 cm only."""


class Rotor(ControlMode):
    """The paper's: each number changes the speed command of a rotor from hover."""

    name = "rotor"
    has_loops = any_layout = False

    def __init__(self, vehicle: Vehicle) -> None:
        """Hover, plus and minus the vehicle's action scale."""
        super().__init__(vehicle)
        self.centre = vehicle.hover_speed
        self.scale = self.scale_down = np.full(vehicle.rotor_count, vehicle.action_scale)
        self.terms = tuple(
            ActionTerm(
                f"rotor_{k + 1}",
                "rad/s",
                f"speed command of the rotor at x = {rotor.position[0]:.3g} m (forward), "
                f"y = {rotor.position[1]:.3g} m (left)",
            )
            for k, rotor in enumerate(vehicle.rotors)
        )

    def values(self, action: Array) -> Array:
        """The commands of `Vehicle.rotor_command`, within the limits of the rotors."""
        return self.vehicle.rotor_command(action)

    def slope(self, action: Array) -> Array:
        """The derivative of each number of `setpoint` by its own of the action, (N, k)."""
        wanted = self.centre + self.scale * action
        within = (abs(action) < 1) & (wanted > 0) & (wanted < self.vehicle.max_speed)
        return np.where(within, self.scale, 0.0)

    def rotor_command(self, state: State, setpoint: Array) -> Array:
        """The setpoint itself."""
        return setpoint


class Share(Rotor):
    """Each number commands the speed of a rotor as a share of the largest: -1 stands, 1 is all."""

    name = "share"

    def __init__(self, vehicle: Vehicle) -> None:
        """Half the largest speed, plus and minus as much."""
        super().__init__(vehicle)
        self.centre = self.scale = self.scale_down = vehicle.max_speed / 2

    @classmethod
    def reach(cls, vehicle: Vehicle) -> Vehicle:
        """Span all speeds of the rotors."""
        return dataclasses.replace(vehicle, action_scale=float(np.max(vehicle.max_speed)))

    def values(self, action: Array) -> Array:
        """The commands."""
        return self.centre + self.scale * within(np.asanyarray(action, order="F"), -1.0, 1.0)


class ShareOfX(Share):
    """Shares of the largest speeds in the order of an X, in whatever order the rotors stand.

    The same action lifts, rolls, pitches and yaws every quadrotor the same way, about the axes that
    the sensor `level` sees: a policy for one of them commands them all.
    """

    name = "share_of_x"
    any_layout = quadrotors_alone = True

    def __init__(self, vehicle: Vehicle) -> None:
        """Find the X in the layout.

        Raises:
            QuadrlError: There is none.
        """
        super().__init__(vehicle)
        rotors = vehicle.rotors
        position = np.array([rotor.position for rotor in rotors])
        self.order, _ = as_x(position, np.array([rotor.spin for rotor in rotors]))
        """Indices of the rotors in the order of the action."""
        self._places = [self.order.index(k) for k in range(len(self.order))]
        said = "speed command of the rotor {}, as an X sees it"
        self.terms = tuple(
            ActionTerm(f"rotor_{k + 1}", "rad/s", said.format(place))
            for k, place in zip(self.order, PLACES, strict=True)
        )

    def values(self, action: Array) -> Array:
        """The commands, in the order of the aircraft's rotors."""
        return super().values(stack(*(action[..., k] for k in self._places)))


class _Looped(ControlMode):
    """A mode that is flown by loops at the physics step."""

    controlled: ClassVar[Controlled]
    share: ClassVar[float] = 1.0

    def __init__(self, vehicle: Vehicle) -> None:
        """Place the poles for the physics step."""
        super().__init__(vehicle)
        timestep = vehicle.physics_timestep
        self._loops = Loops(self.reach(vehicle), timestep, self.controlled, share=self.share)
        self.centre = np.zeros(4)


class ThrustBodyRate(_Looped):
    """Collective thrust and body rates, as acrobatic pilots and rate controllers command them."""

    name = "thrust_body_rate"
    controlled = "body_rate"
    terms = (
        ActionTerm("thrust", "weight", "collective thrust over the aircraft's weight, body z"),
        ActionTerm("roll_rate", "rad/s", "about body x (forward)"),
        ActionTerm("pitch_rate", "rad/s", "about body y (left): nose down"),
        ActionTerm("yaw_rate", "rad/s", "about body z (up)"),
    )

    def __init__(self, vehicle: Vehicle) -> None:
        """Scale to the least and the largest thrust, and to the largest body rates of the loops."""
        super().__init__(vehicle)
        self.centre = np.array([1.0, 0.0, 0.0, 0.0])
        (least, largest), rates = self._loops.thrust, self._loops.max_body_rate
        weight = vehicle.mass * GRAVITY  # [N]
        self.scale = np.array([largest / weight - 1.0, *rates])
        self.scale_down = np.array([1.0 - least / weight, *rates])

    @classmethod
    def reach(cls, vehicle: Vehicle) -> Vehicle:
        """Span all that the rotors can do, as rate controllers do."""
        return dataclasses.replace(vehicle, action_scale=float(np.max(vehicle.max_speed)))

    def rotor_command(self, state: State, setpoint: Array) -> Array:
        """The body rate loop alone."""
        thrust = self.vehicle.mass * GRAVITY * setpoint[:, :1]
        return self._loops.body_rate_command(state, thrust, setpoint[:, 1:])


class Velocity(_Looped):
    """A velocity along the heading, and the rate of the heading."""

    name = "velocity"
    controlled = "velocity"
    terms = (
        ActionTerm("forward", "m/s", "level, along the present heading"),
        ActionTerm("left", "m/s", "level, across the present heading"),
        ActionTerm("up", "m/s", "vertical"),
        ActionTerm("yaw_rate", "rad/s", "of the heading, counter-clockwise from above"),
    )

    def __init__(self, vehicle: Vehicle) -> None:
        """Scale to velocities that are reached within RESPONSE_TIME."""
        super().__init__(vehicle)
        yaw_rate = self._loops.max_body_rate[2]
        largest = np.append(self._loops.max_acceleration * RESPONSE_TIME, yaw_rate)
        self.scale = self.scale_down = largest

    def rotor_command(self, state: State, setpoint: Array) -> Array:
        """The velocity loop and those within it."""
        heading = heading_of(state.rotation)
        error = state.velocity - turned(setpoint[:, :3], heading)
        return self._loops.rotor_command(state, error, heading, setpoint[:, 3:])


class Position(_Looped):
    """A position and a heading, relative to those at the begin of the control step.

    An action of 0 brakes and stays; a position is held by giving its offset again at every step.
    """

    name = "position"
    controlled = "position"
    share = POSITION_SHARE
    terms = (
        ActionTerm("forward", "m", "offset, level, along the heading"),
        ActionTerm("left", "m", "offset, level, across the heading"),
        ActionTerm("up", "m", "offset, vertical"),
        ActionTerm("yaw", "rad", "turn of the heading, counter-clockwise from above"),
    )

    def __init__(self, vehicle: Vehicle) -> None:
        """Scale to offsets at which the approach is as fast as RESPONSE_TIME allows."""
        super().__init__(vehicle)
        offsets = self._loops.max_acceleration * RESPONSE_TIME**2
        self.scale = self.scale_down = np.append(offsets, MAX_HEADING_ERROR)
        self._max_speed = float(self._loops.max_acceleration[0] * RESPONSE_TIME)  # [m/s]

    def setpoint(self, state: State, action: Array) -> Array:
        """Position (3) [m], task frame, and heading (2), east and north, side by side: (N, 5)."""
        values, heading = self.values(action), heading_of(state.rotation)
        place = state.position + turned(values[:, :3], heading)
        yaw = values[:, 3:]
        turn = columns(np.cos(yaw), np.sin(yaw))
        return columns(place, turned(turn, heading))

    def rotor_command(self, state: State, setpoint: Array) -> Array:
        """Every loop."""
        offset = setpoint[:, :3] - state.position
        error = state.velocity - self._loops.approach_velocity(offset, self._max_speed)
        return self._loops.rotor_command(state, error, setpoint[:, 3:])


CONTROL_MODES: dict[str, type[ControlMode]] = {
    mode.name: mode for mode in (Rotor, Share, ShareOfX, ThrustBodyRate, Velocity, Position)
}
"""Every control mode by name."""


def modes_of(vehicle: Vehicle) -> list[str]:
    """The names of the control modes that fit an aircraft."""
    four = vehicle.rotor_count == len(PLACES)
    return [name for name, mode in CONTROL_MODES.items() if four or not mode.quadrotors_alone]


def named(given: Any) -> str:
    """The name of the control mode that a caller or a file names.

    Raises:
        QuadrlError: Unknown name; the message lists the choices.
    """
    return choice("control_mode", given, CONTROL_MODES)


def kind(name: str) -> type[ControlMode]:
    """The class of a control mode.

    Raises:
        QuadrlError: Unknown name; the message lists the choices.
    """
    return CONTROL_MODES[named(name)]
