"""Randomizations: changes to the specified flight, drawn at the start of each episode.

Aircraft are drawn around the specified one, by factors, so that a preset fits every vehicle;
`quadrl.conditions.randomizations` has the presets.
`quadrl.conditions.sampler` makes the aircraft, `quadrl.conditions.randomizer` applies the rest.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from quadrl.aircraft.rotors import MAX
from quadrl.base.errors import QuadrlError
from quadrl.base.validation import number, numbers, resolved

Range = tuple[float, float]
LEAST, MOST = 0.01, 100.0  # smallest and largest factor
LONGEST_DELAY = 10.0  # [s]
OFF = (1.0, 1.0)  # a factor that changes nothing
AFFECTS: dict[str, tuple[str, ...]] = {
    "mass": ("mass",),
    "inertia": ("inertia",),
    "thrust": ("rotor.thrust_coefficient",),
    "torque": ("rotor.torque_coefficient",),
    "lag": ("rotor.lag_up", "rotor.lag_down"),
    "drag": ("drag_coefficient", "moment_coefficient", "rotor_drag", "flapping_moment"),
    "inflow": ("blade_lift", "translational_lift"),
    "max_speed": ("rotor.max_speed",),
    "rotors": (
        *("rotor.thrust_coefficient", "rotor.torque_coefficient", "rotor.lag_up", "rotor.lag_down"),
    ),
    "one_rotor": ("rotor.thrust_coefficient", "rotor.torque_coefficient"),
    "centre_of_mass": ("rotor.position",),
    "rotor_inertia": ("rotor_inertia",),
    "inertia_axes": ("inertia",),
    "force": ("steady_force",),
    "moment": ("steady_moment",),
    "flapping": ("flapping_moment",),
    "sizes": (
        *("mass", "inertia", "rotor.thrust_coefficient", "rotor.torque_coefficient"),
        *("rotor.disc_radius", "rotor.lag_up", "rotor.lag_down", "drag_coefficient"),
        *("moment_coefficient", "rotor_drag", "flapping_moment", "rotor_inertia"),
    ),
}
"""Numbers that a field of `Randomization` changes in a row of parameters
(`aircraft/parameters.py`)."""
FACTORS = ("mass", "inertia", "thrust", "torque", "lag", "drag", "inflow", "max_speed")
"""Fields that are one factor for the whole aircraft."""
DELAYS = ("command_delay", "observation_delay", "rate_delay")
AGES = DELAYS[1:]


@dataclasses.dataclass(frozen=True)
class Errors:
    """Sizes of errors of the state estimate, the same along or about each of three axes."""

    position: float = 0.0
    """[m], world frame."""
    attitude: float = 0.0
    """[rad], about the axes of the body."""
    velocity: float = 0.0
    """[m/s], world frame."""
    body_rate: float = 0.0
    """[rad/s], body frame."""

    def __post_init__(self) -> None:
        """Validate the sizes."""
        for name, value in vars(self).items():
            object.__setattr__(self, name, number(name, value, 0, MAX))

    @property
    def sizes(self) -> np.ndarray:
        """Sizes (12,) of all errors, in the order of the fields."""
        return np.repeat([*vars(self).values()], 3)


@dataclasses.dataclass(frozen=True)
class Pushes:
    """Impulses that hit an aircraft now and then, between two control steps."""

    rate: float = 0.0
    """Pushes in a second, on average."""
    velocity: float = 0.0
    """Change of the velocity by each push [m/s], in any direction."""
    body_rate: float = 0.0
    """Change of the body rate by each push [rad/s], about any axis."""

    def __post_init__(self) -> None:
        """Validate the numbers."""
        for name, value in vars(self).items():
            object.__setattr__(self, name, number(f"pushes {name}", value, 0, MAX))


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of whole quadrotors, drawn evenly in their logarithm in place of the specified ones.

    0 stands for the specified size. The layout, the largest rotor speed and the shape of the
    inertia stay; what the air does goes with the thrust, the area or the inertia that it acts on.
    """

    mass: Range = (0.0, 0.0)
    """[kg]."""
    thrust_to_weight: Range = (0.0, 0.0)
    """Largest thrust over the weight."""
    angular_acceleration: Range = (0.0, 0.0)
    """Angular acceleration with the two rotors on one side of the X at their largest speeds and the
    others at rest [rad/s^2], the geometric mean of roll and pitch; yaw keeps its share of it."""
    lag: Range = (0.0, 0.0)
    """Time constant of the rotors [s], the geometric mean of rising and falling."""

    def __post_init__(self) -> None:
        """Validate the ranges."""
        for name, value in vars(self).items():
            pair = _pair(f"sizes {name}", value, 0, MAX)
            if pair[0] == 0 < pair[1]:
                allowed = "(0, 0) or two positive numbers"
                raise QuadrlError(name=f"sizes {name}", value=value, allowed=allowed)
            object.__setattr__(self, name, pair)


def _pair(name: str, given: Any, low: float, high: float) -> Range:
    """A range, from two numbers or from one number for both ends."""
    whole = isinstance(given, (list, tuple, np.ndarray))
    first, last = numbers(name, given if whole else (given, given), 2, low, high)
    if first > last:
        raise QuadrlError(name=name, value=given, allowed="(low, high) with low at most high")
    return first, last


RECORDS: dict[str, type] = {"noise": Errors, "bias": Errors, "pushes": Pushes, "sizes": Sizes}
"""Fields of `Randomization` that are records of their own."""


@dataclasses.dataclass(frozen=True)
class Randomization:
    """What is drawn anew for each aircraft at each reset, evenly between two ends (low, high).

    One number in place of a pair stands for both ends. Factors are of what is specified.
    """

    mass: Range = (1.0, 1.0)
    """Factor of the mass."""
    inertia: Range = (1.0, 1.0)
    """Factor of the moments of inertia, the same about every axis."""
    thrust: Range = (1.0, 1.0)
    """Factor of the thrust of all rotors at a given rotor speed."""
    torque: Range = (1.0, 1.0)
    """Factor of the torque of all rotors; where the air acts on the discs, at least what the thrust
    needs."""
    lag: Range = (1.0, 1.0)
    """Factor of the time constants of all rotors, rising and falling."""
    drag: Range = (1.0, 1.0)
    """Factor of the aircraft's drag and aerodynamic moment, and of the drag of its rotors."""
    inflow: Range = (1.0, 1.0)
    """Factor of the lift of the blades: how much the thrust changes with climb, descent and
    flight."""
    max_speed: Range = (1.0, 1.0)
    """Factor of the largest rotor speed, at most 1, as with a low battery."""
    rotors: Range = (1.0, 1.0)
    """Further factor of the thrust, the torque and the time constant, drawn for each rotor."""
    one_rotor: Range = (1.0, 1.0)
    """Further factor of the thrust and the torque of one random rotor: a damaged one."""
    wind: Range = (1.0, 1.0)
    """Factor of the weather's mean wind; the turbulence grows with it."""
    centre_of_mass: float = 0.0
    """Largest distance of the centre of mass from its specified place, along each axis [m]."""
    command_delay: Range = (0.0, 0.0)
    """Delay of the rotor commands [s], in whole physics steps, in addition to the aircraft's own
    `dead_time`."""
    observation_delay: Range = (0.0, 0.0)
    """Age of position, attitude and velocity in the state estimate, and so in all observations of
    them [s], in whole physics steps."""
    rate_delay: Range = (0.0, 0.0)
    """Age of the body rate in the state estimate [s], in whole physics steps."""
    noise: Errors = Errors()
    """Standard deviations of the errors of the state estimate, drawn anew at each control step."""
    bias: Errors = Errors()
    """Largest constant errors of the state estimate, drawn for each episode."""
    pushes: Pushes = Pushes()
    """Impulses."""
    rotor_inertia: Range = (1.0, 1.0)
    """Factor of the moment of inertia of the rotors about their axes."""
    inertia_axes: Range = (1.0, 1.0)
    """Further factor of the moment of inertia about each axis, drawn for each; none gets larger
    than the sum of the other two."""
    force: float = 0.0
    """Largest constant force on the aircraft in an episode, along each axis of the world, as a
    share of its specified weight."""
    moment: float = 0.0
    """Largest constant moment on the aircraft in an episode, about each axis of its body, as a
    share of that weight times the distance of its farthest rotor."""
    corners: float = 0.0
    """Share of the episodes in which lag and command_delay are both drawn from the upper quarter
    of their ranges, since slow rotors are hardest to fly where commands are late."""
    flapping: Range = (1.0, 1.0)
    """Further factor of the rotors' flapping moment; 0 is without, as other simulators are."""
    sizes: Sizes = Sizes()
    """Sizes that take the place of the specified ones, before any factor."""
    command_jitter: Range = (0.0, 0.0)
    """Probability that the commands of a control step arrive one control step later, so that those
    of the step before stay in force."""
    command_loss: Range = (0.0, 0.0)
    """Outages of the link in a second, on average. In an outage no command arrives, and the last
    one stays in force."""
    loss_time: Range = (0.2, 0.2)
    """Length of each outage [s], in whole control steps; by default 0.2 s."""

    def __post_init__(self) -> None:
        """Validate as far as that needs no aircraft."""
        for field in dataclasses.fields(self):
            name, given = field.name, getattr(self, field.name)
            if name in ("centre_of_mass", "corners", "force", "moment"):
                value: Any = number(name, given, 0, 1)  # [m], shares
            elif name in RECORDS:
                value = resolved(name, given, RECORDS[name])
            elif name in (*DELAYS, "loss_time"):
                value = _pair(name, given, 0, LONGEST_DELAY)
            elif name in ("command_jitter", "command_loss"):
                value = _pair(name, given, 0, 1.0 if name == "command_jitter" else MAX)
            else:
                least = 0.0 if name in ("drag", "wind", "flapping") else LEAST
                value = _pair(name, given, least, 1.0 if name == "max_speed" else MOST)
            object.__setattr__(self, name, value)
        often, lasts = self.command_loss[1], self.loss_time[1]
        if often * lasts > 1:
            reason = f"with outages of {lasts:g} s the link would never be there"
            allowed = f"at most {1 / lasts:.3g} a second"
            raise QuadrlError(reason, name="command_loss", value=often, allowed=allowed)

    def __repr__(self) -> str:
        return f"Randomization({', '.join(f'{k}={v!r}' for k, v in self.given().items())})"

    def given(self) -> dict[str, Any]:
        """The fields that differ from the defaults, as JSON has them."""
        off, own = dataclasses.asdict(NONE), dataclasses.asdict(self)
        return {name: value for name, value in own.items() if value != off[name]}

    @property
    def per_row(self) -> bool:
        """Whether parameters of the aircraft are drawn."""
        return any(getattr(self, name) != getattr(NONE, name) for name in AFFECTS)

    @property
    def uncertain(self) -> bool:
        """Whether the state estimate has errors or is late."""
        late = self.observation_delay[1] > 0 or self.rate_delay[1] > 0
        return late or (self.noise, self.bias) != (Errors(), Errors())


NONE = Randomization()
