"""Sample aircraft parameters: the rows that a randomization makes from a specified aircraft."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.quadrotor import sizes_of
from quadrl.aircraft.rotors import GRAVITY, hover_squares
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array
from quadrl.base.validation import number, whole_steps
from quadrl.conditions.randomization import AFFECTS, DELAYS, FACTORS, NONE, OFF
from quadrl.conditions.randomizations import Randomized, resolve
from quadrl.conditions.ranges import CORNER, ROUNDING, Ranges

EACH_ROTOR = ("thrust", "torque", "lag")
"""Factors that each rotor has once more on its own, within `Randomization.rotors`."""
DAMAGED = "damaged_rotor"
"""Name of the number, from 0 on, of the rotor to which `Randomization.one_rotor` applies."""
STEADY = ("force", "moment")
EXCHANGES = 3
"""Enough rounds: in layouts of four to eight rotors, more find no worse aircraft."""


@dataclasses.dataclass(frozen=True)
class Drawn:
    """What episodes (n,) have drawn from a randomization."""

    numbers: Array | None = None  # (n, k), a column for each of `AircraftSampler.names`
    """None where nothing depends on them."""
    table: np.ndarray | None = None  # (n,) rows of parameters
    """None where all aircraft are the specified one."""
    wind: Array | None = None  # (n,)
    """Factor of the weather's mean wind; None where it is the weather's."""


class AircraftSampler(Ranges):
    """The numbers that episodes draw from a randomization, and the aircraft that they make."""

    def __init__(self, randomization: Randomized, vehicle: Vehicle) -> None:
        """Validate for a vehicle.

        Raises:
            QuadrlError: `resolve` refuses the randomization, a delay is not a multiple of the time
                step, or an aircraft at the ends of the ranges cannot exist or cannot hover.
        """
        self.randomization = randomization = resolve(randomization)
        self._vehicle, self._specified = vehicle, parameters.rows(vehicle)
        weight = vehicle.mass * GRAVITY
        self._units = weight, weight * vehicle.size  # of force [N] and moment [N m]
        step = vehicle.physics_timestep
        self.delays = {
            name: whole_steps(name, getattr(randomization, name), step, "physics")
            for name in DELAYS
        }
        """Fewest and most physics steps by the names of DELAYS."""
        given, control = randomization, vehicle.control_timestep
        lasts = given.loss_time if given.command_loss[1] > 0 else (0.0, 0.0)
        self.outage = whole_steps("loss_time", lasts, control, "control")
        """Fewest and most control steps of an outage; 0 where the link is never lost."""
        early = *FACTORS, "command_delay", "observation_delay", "wind"
        ends = {name: getattr(randomization, name) for name in early}
        shift = randomization.centre_of_mass
        ends |= {f"centre_of_mass_{axis}": (-shift, shift) for axis in "xyz"}
        for name, size in vars(randomization.bias).items():
            ends |= {f"{name}_bias_{axis}": (-size, size) for axis in "xyz"}
        rotors = range(1, vehicle.rotor_count + 1)
        ends |= {f"{name}_{k}": randomization.rotors for name in EACH_ROTOR for k in rotors}
        # New numbers are added at the end, so that the others keep their random numbers.
        last = vehicle.rotor_count - 1 if randomization.one_rotor != OFF else 0
        ends |= {"one_rotor": randomization.one_rotor, DAMAGED: (0, last)}
        ends |= {name: getattr(randomization, name) for name in ("rate_delay", "rotor_inertia")}
        ends |= {f"inertia_axes_{axis}": randomization.inertia_axes for axis in "xyz"}
        for name in STEADY:
            size = getattr(randomization, name)
            ends |= {f"{name}_{axis}": (-size, size) for axis in "xyz"}
        ends |= {CORNER: (0, randomization.corners > 0), "flapping": randomization.flapping}
        sized = randomization.sizes != NONE.sizes
        self._usual = sizes_of(vehicle) if sized else dict.fromkeys(vars(NONE.sizes), 1.0)
        for name, usual in self._usual.items():
            drawn = getattr(randomization.sizes, name)
            ends[f"log_{name}"] = tuple(math.log(size or usual) for size in drawn)
        ends |= {name: getattr(given, name) for name in ("command_jitter", "command_loss")}
        ends["loss_time"] = lasts
        ends["torque"] = (self._least_torque(), ends["torque"][1])
        whole = {name: (steps, step) for name, steps in self.delays.items()}
        whole |= {DAMAGED: ((0, last), 1.0), "loss_time": (self.outage, control)}
        super().__init__(ends, whole, randomization.corners)
        if randomization != NONE:
            self._check_ends()
        if randomization.moment:
            self._check_moment()
        self.extremes = self._specified
        """Rows of the aircraft in which a rotor has most, or least, to do in hover."""
        if randomization.per_row:
            self.extremes = self.table(self._corners())
            self.check_hover(self.extremes)

    def table(self, drawn: Array) -> np.ndarray:
        """Rows of parameters (n,) of the aircraft with drawn numbers (n, k)."""
        count = self._vehicle.rotor_count
        table = np.repeat(self._specified, len(drawn))
        if self.randomization.sizes != NONE.sizes:
            self._size(table, drawn)
        for name in (*FACTORS, "rotor_inertia", "inertia_axes", "one_rotor", "flapping"):
            first, width = ("inertia_axes_x", 3) if name == "inertia_axes" else (name, 1)
            factor = self.columns(drawn, first, width)
            if name in EACH_ROTOR:
                factor = factor * self.columns(drawn, f"{name}_1", count)
            elif name == "one_rotor":
                factor = np.where(np.arange(count) == self.columns(drawn, DAMAGED), factor, 1.0)
            # The lag is a time and the parameter a rate.
            apply = np.divide if name == "lag" else np.multiply
            for field in AFFECTS[name]:
                numbers = parameters.field(table, field)
                apply(numbers, factor, out=numbers)
        if self.randomization.inertia_axes != OFF:
            inertia = table["inertia"]
            np.minimum(inertia, inertia.sum(-1, keepdims=True) - inertia, out=inertia)
        # The origin of the body is the centre of mass, so the rotors move instead of it.
        shift = self.columns(drawn, "centre_of_mass_x", 3)
        parameters.field(table, *AFFECTS["centre_of_mass"])[:] -= shift[:, None]
        for name, unit in zip(STEADY, self._units, strict=True):
            parameters.field(table, *AFFECTS[name])[:] = unit * self.columns(drawn, f"{name}_x", 3)
        parameters.refresh(table, self._vehicle.physics_timestep)
        return table

    def _size(self, table: np.ndarray, drawn: Array) -> None:
        """Give rows of parameters (n,), in place, the sizes in drawn numbers (n, k)."""
        mass, thrust, turn, lag = (
            np.exp(self.columns(drawn, f"log_{name}") - math.log(usual))
            for name, usual in self._usual.items()
        )  # (n, 1) each over the specified one
        force = mass * thrust  # and the moments with it, since the arms stay
        inertia = force / turn
        ratios = {
            **{"mass": mass, "inertia": inertia, "moment_coefficient": inertia},
            **{"rotor.thrust_coefficient": force, "rotor.torque_coefficient": force},
            "rotor.disc_radius": np.sqrt(force),  # the same flow through the discs at full speed
            **{"rotor.lag_up": 1 / lag, "rotor.lag_down": 1 / lag},
            "drag_coefficient": np.cbrt(mass) ** 2,  # an area, at one density
            **{"rotor_drag": force, "flapping_moment": force, "rotor_inertia": inertia},
        }
        for name in AFFECTS["sizes"]:
            numbers = parameters.field(table, name)
            np.multiply(numbers, ratios[name], out=numbers)

    def explains(self, saved: np.ndarray) -> bool:
        """Whether rows of parameters differ from the specified ones only in what may be drawn."""
        table = parameters.named(saved.copy())
        own = np.repeat(self._specified, len(table))
        for name in self.randomization.given().keys() & AFFECTS.keys():
            for field in AFFECTS[name]:
                parameters.field(own, field)[:] = parameters.field(table, field)
        parameters.refresh(own, self._vehicle.physics_timestep)
        return np.array_equal(own.view(np.float64).reshape(saved.shape), saved)

    # ------------------------------------------------------------------- what cannot fly

    def _least_torque(self) -> float:
        """The lowest torque factor with which no disc makes power from nothing.

        Raises:
            QuadrlError: It is above the largest that is asked for.
        """
        given, air = self.randomization, self._vehicle.aerodynamics
        if not (air.uses_discs and given.per_row):
            return given.torque[0]
        merit = max(rotor.figure_of_merit(air.air_density) for rotor in self._vehicle.rotors)
        strong = max(1.0, given.one_rotor[1])
        # Merit goes with thrust^1.5 over torque; a damaged rotor has the same factor for both.
        least = (given.thrust[1] * given.rotors[1]) ** 1.5 * math.sqrt(strong) / given.rotors[0]
        least *= merit * (1 + ROUNDING)
        if least > given.torque[1]:
            reason = "with less the rotors would make more power than momentum theory allows"
            allowed = f"above {least:.3g} with these thrusts"
            raise QuadrlError(reason, name="torque", value=given.torque, allowed=allowed)
        return max(given.torque[0], least)

    def _check_ends(self) -> None:
        """Build the aircraft at the ends of the ranges, which must be sound vehicles."""
        given, count = self.randomization, self._vehicle.rotor_count
        for heavy, inertia, drag in itertools.product((0, 1), repeat=3):
            # The mass is at one end of its range, the strength of the rotors at the other.
            weak = 1 - heavy
            ends = {"mass": heavy, "inertia": inertia, "drag": drag, "inflow": 1, "lag": 0}
            ends |= {"rotor_inertia": 1, "thrust": weak, "torque": weak, "max_speed": weak}
            both = self.low, self._high
            columns: Any = {k: both[end][self.names.index(k)] for k, end in ends.items()}
            columns |= {f"{name}_1": [given.rotors[ends[name]]] * count for name in EACH_ROTOR}
            columns["inertia_axes_x"] = [given.inertia_axes[inertia]] * 3
            columns |= {"force_x": (0.0, 0.0, 0.0), "moment_x": (0.0, 0.0, 0.0)}
            columns |= {
                "one_rotor": 1.0,
                "flapping": given.flapping[1],
                "centre_of_mass_x": (0.0, 0.0, 0.0),
            }
            try:
                made = vehicle_of(self._vehicle, self.table(self.at(1, **columns))[0])
                number("pushes velocity", given.pushes.velocity, 0, made.resolved_speed)
                number("pushes body_rate", given.pushes.body_rate, 0, made.resolved_turn)
            except QuadrlError as error:
                where = f"in the {('lightest', 'heaviest')[heavy]} aircraft of this randomization"
                reason = f"{error.reason}; {where}".removeprefix("; ")
                raise QuadrlError(**vars(error) | {"reason": reason}) from error

    def _check_moment(self) -> None:
        """Refuse moments that the rotors of the specified aircraft cannot hold.

        Raises:
            QuadrlError: The message has the largest that they can.
        """
        given, vehicle = self.randomization.moment, self._vehicle
        signs = np.array([*itertools.product((-1, 1), repeat=3)])
        rows = np.repeat(vehicle.mixer[None], len(signs), axis=0)
        squares = hover_squares(rows, self._units[0], given * self._units[1] * signs)
        usual = vehicle.hover_speed**2
        room = np.where(squares > usual, vehicle.max_speed**2 - usual, usual)
        most = given * float((room / np.maximum(np.abs(squares - usual), ROUNDING * usual)).min())
        if given >= most:
            reason = "no rotor speeds hold such a moment in hover"
            allowed = f"under {most:.3g} of weight times arm"
            raise QuadrlError(reason, name="moment", value=given, allowed=allowed)

    def _corners(self) -> Array:
        """Numbers (n, k) of the aircraft in which a rotor turns fastest, or slowest, in hover.

        Thrust and torque of each rotor, the centre of mass and the moment are at one end of their
        ranges; ends are exchanged as long as that makes the rotor faster, or slower.
        """
        given, count = self.randomization, self._vehicle.rotor_count
        each = "thrust_1", "centre_of_mass_x", "moment_x"
        first, second, third = (self.names.index(name) for name in each)
        places = np.r_[first : first + 2 * count, second : second + 2, third : third + 3]
        both = (self.low + self._high)[places]
        damaged = range(count if given.one_rotor != OFF else 1)
        cases = np.array([*itertools.product(range(count), (-1, 1), damaged)])
        columns: Any = {"mass": given.mass[1], DAMAGED: cases[:, 2:], "centre_of_mass_z": 0.0}
        columns["force_x"] = (given.force, given.force, -given.force)  # down, and aside
        drawn = self.at(len(cases), **columns)
        for _ in range(EXCHANGES):
            # Each aircraft as it is, and with each end exchanged in turn.
            tried = np.repeat(drawn[:, None], 1 + len(places), axis=1)
            each = np.arange(len(places))
            tried[:, 1 + each, places] = both - tried[:, 1 + each, places]
            rotor = self.table(tried.reshape(-1, tried.shape[-1]))["rotor"][:, :count]
            load = (rotor["hover_speed"] / rotor["max_speed"]).reshape(*tried.shape[:2], -1)
            load = np.take_along_axis(load, cases[:, :1, None], axis=-1)[..., 0] * cases[:, 1:2]
            worse = load[:, 1:] > load[:, :1]
            drawn[:, places] = np.where(worse, both - drawn[:, places], drawn[:, places])
        return drawn

    def check_hover(self, table: np.ndarray) -> None:
        """Refuse rows of parameters (n,) of which one cannot hover.

        Raises:
            QuadrlError: The message has the coefficients of its rotors.
        """
        rotor = table["rotor"][:, : self._vehicle.rotor_count]
        hover = rotor["hover_speed"]
        unable = ((hover <= 0) | (hover >= rotor["max_speed"])).any(axis=-1)
        if unable.any():
            reason = "each rotor is drawn alone, and with such rotors it cannot hover"
            names = ("thrust_coefficient", "torque_coefficient")
            worst = {name: rotor[name][unable][0].tolist() for name in names}
            raise QuadrlError(reason, name="rotors", value=worst, allowed="a narrower range")


def vehicle_of(vehicle: Vehicle, row: np.void) -> Vehicle:
    """A vehicle like another one, with the numbers of a row that a randomization can change."""
    affected = {field.rpartition(".")[2] for fields in AFFECTS.values() for field in fields}

    def made(part: Any, numbers: np.void, **own: Any) -> Any:
        names = affected & {field.name for field in dataclasses.fields(part)}
        return dataclasses.replace(part, **{n: numbers[n].tolist() for n in names}, **own)

    rotors = tuple(made(*pair) for pair in zip(vehicle.rotors, row["rotor"], strict=False))
    return made(vehicle, row, rotors=rotors, aerodynamics=made(vehicle.aerodynamics, row))
