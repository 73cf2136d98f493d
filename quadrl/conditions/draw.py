"""The aircraft that a randomization makes of the one that is specified."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array
from quadrl.base.validation import number
from quadrl.conditions.randomization import DELAYS, FACTORS, NONE, Randomized, Range, resolve

AXES = "xyz"
DRAG = ("drag_coefficient", "moment_coefficient", "rotor_drag", "flapping_moment")
EACH_ROTOR = ("thrust", "torque", "lag")
"""What the rotors of one aircraft differ in."""
WHICH = "damaged_rotor"
"""Number of the rotor, from 0 on, that `one_rotor` is about."""
ROUNDING = 1e-9
WHOLE = 1e-6  # of a step, within which a delay is a whole number of them


class Draw:
    """The numbers that are drawn for aircraft of a vehicle, and the aircraft that they make."""

    def __init__(self, randomization: Randomized, vehicle: Vehicle) -> None:
        """Validate for a vehicle.

        Raises:
            QuadrlError: It is what `resolve` refuses, a delay is no whole number of steps, or an
                aircraft would be drawn that cannot exist or cannot hover.
        """
        randomization = resolve(randomization)
        self._vehicle, self.given = vehicle, randomization
        self._specified = parameters.rows(vehicle)
        self._timesteps = (vehicle.physics_timestep, vehicle.control_timestep)
        self.delays = [
            _steps(name, getattr(randomization, name), timestep)
            for name, timestep in zip(DELAYS, self._timesteps, strict=True)
        ]
        """Fewest and most physics steps that commands are late, and control steps that observations
        are."""
        ends = {name: getattr(randomization, name) for name in (*FACTORS, *DELAYS, "wind")}
        shift = randomization.centre_of_mass
        ends |= {f"centre_of_mass_{axis}": (-shift, shift) for axis in AXES}
        for name, size in vars(randomization.bias).items():
            ends |= {f"{name}_bias_{axis}": (-size, size) for axis in AXES}
        rotors = range(1, vehicle.rotor_count + 1)
        ends |= {f"{name}_{k}": randomization.rotors for name in EACH_ROTOR for k in rotors}
        # Further ones stand at the end: the numbers before them stay what they were.
        last = vehicle.rotor_count - 1 if randomization.one_rotor != (1.0, 1.0) else 0
        ends |= {"one_rotor": randomization.one_rotor, WHICH: (0, last)}
        self.names = tuple(ends)
        """Of the numbers; all are drawn, so that a range has no effect on the others."""
        self.low, self._high = np.array([*ends.values()]).T
        self._width = self._high - self.low
        self.spread = np.flatnonzero(self._width)
        """Which of them differ from aircraft to aircraft."""
        if randomization != NONE:
            self._check()

    def of(self, shares: Array) -> Array:
        """The numbers (n, k), a column for each of `names`, from shares in [0, 1) of the ranges."""
        drawn = self.low + self._width * shares
        for name, (fewest, most), timestep in zip(
            DELAYS, self.delays, self._timesteps, strict=True
        ):
            k = self.names.index(name)
            drawn[:, k] = (fewest + np.floor((most - fewest + 1) * shares[:, k])) * timestep
        k = self.names.index(WHICH)
        drawn[:, k] = np.floor((self._width[k] + 1) * shares[:, k])
        return drawn

    def may_give(self, drawn: Array) -> bool:
        """Whether numbers (n, k) lie in their ranges."""
        room = ROUNDING * np.maximum(np.abs(self.low), np.abs(self._high))
        return bool(((drawn >= self.low - room) & (drawn <= self._high + room)).all())

    def columns(self, drawn: Array, name: str, count: int = 1) -> Array:
        """Columns (n, count) of drawn numbers, from the one of a name on."""
        first = self.names.index(name)
        return drawn[:, first : first + count]

    def scaled(self, drawn: Array) -> Array:
        """Those that differ, (n, ...), from -1 at the lowest to 1 at the highest."""
        low, width = self.low[self.spread], self._width[self.spread]
        return 2 * (drawn[:, self.spread] - low) / width - 1

    def table(self, drawn: Array) -> np.ndarray:
        """Rows of parameters (n,) of aircraft with some numbers (n, k)."""
        count = self._vehicle.rotor_count
        table = np.repeat(self._specified, len(drawn))
        whole = {name: self.columns(drawn, name) for name in FACTORS}
        each = {name: self.columns(drawn, f"{name}_1", count) for name in EACH_ROTOR}
        table["mass"] *= whole["mass"][:, 0]
        table["inertia"] *= whole["inertia"]
        for name in DRAG:
            table[name] *= whole["drag"][:, 0]
        table["blade_lift"] *= whole["inflow"][:, 0]
        rotor = table["rotor"][:, :count]
        rotor["thrust_coefficient"] *= whole["thrust"] * each["thrust"]
        rotor["torque_coefficient"] *= whole["torque"] * each["torque"]
        if self.given.one_rotor != (1.0, 1.0):
            damaged = np.arange(count) == self.columns(drawn, WHICH)
            for name in ("thrust_coefficient", "torque_coefficient"):
                rotor[name] *= np.where(damaged, self.columns(drawn, "one_rotor"), 1.0)
        for name in ("lag_up", "lag_down"):
            rotor[name] /= whole["lag"] * each["lag"]
        rotor["max_speed"] *= whole["max_speed"]
        # The origin of the body is the centre of mass: what moves are the rotors.
        rotor["position"] -= self.columns(drawn, "centre_of_mass_x", 3)[:, None]
        parameters.refresh(table, self._vehicle.physics_timestep)
        return table

    def holds(self, saved: np.ndarray) -> bool:
        """Whether rows of parameters differ from the specified ones only in what may be drawn."""
        table = saved.copy().view(parameters.AIRCRAFT)[:, 0]
        own = np.repeat(self._specified, len(table))
        given, off = self.given, (1.0, 1.0)
        for names, fields in (
            (("mass",), ("mass",)),
            (("inertia",), ("inertia",)),
            (("drag",), DRAG),
            (("inflow",), ("blade_lift",)),
        ):
            if any(getattr(given, name) != off for name in names):
                for field in fields:
                    own[field] = table[field]
        for names, fields in (
            (("thrust", "rotors", "one_rotor"), ("thrust_coefficient",)),
            (("torque", "rotors", "one_rotor"), ("torque_coefficient",)),
            (("lag", "rotors"), ("lag_up", "lag_down")),
            (("max_speed",), ("max_speed",)),
        ):
            if any(getattr(given, name) != off for name in names):
                for field in fields:
                    own["rotor"][field] = table["rotor"][field]
        if given.centre_of_mass:
            own["rotor"]["position"] = table["rotor"]["position"]
        parameters.refresh(own, self._vehicle.physics_timestep)
        return np.array_equal(own.view(np.float64).reshape(saved.shape), saved)

    def _check(self) -> None:
        """Make the aircraft at the ends of the ranges."""
        given, vehicle = self.given, self._vehicle
        fastest = given.lag[0] * given.rotors[0]
        for heavy, inertia, drag in itertools.product((0, 1), given.inertia, given.drag):
            # Its mass at one end, what its rotors give at the other.
            weak = 1 - heavy
            rotors = tuple(
                dataclasses.replace(
                    rotor,
                    thrust_coefficient=rotor.thrust_coefficient
                    * (given.thrust[weak] * given.rotors[weak]),
                    torque_coefficient=rotor.torque_coefficient
                    * (given.torque[weak] * given.rotors[weak]),
                    lag_up=rotor.lag_up / fastest,
                    lag_down=rotor.lag_down / fastest,
                    max_speed=rotor.max_speed * given.max_speed[weak],
                )
                for rotor in vehicle.rotors
            )
            try:
                air = vehicle.aerodynamics
                air = dataclasses.replace(
                    air,
                    rotor_drag=air.rotor_drag * drag,
                    flapping_moment=air.flapping_moment * drag,
                    blade_lift=air.blade_lift * given.inflow[1],
                )
                made = dataclasses.replace(
                    vehicle,
                    aerodynamics=air,
                    mass=vehicle.mass * given.mass[heavy],
                    inertia=tuple(inertia * moment for moment in vehicle.inertia),
                    drag_coefficient=vehicle.drag_coefficient * drag,
                    moment_coefficient=vehicle.moment_coefficient * drag,
                    rotors=rotors,
                )
                number("pushes velocity", given.pushes.velocity, 0, made.resolved_speed)
                number("pushes body_rate", given.pushes.body_rate, 0, made.resolved_turn)
            except QuadrlError as error:
                where = f"in the {('lightest', 'heaviest')[heavy]} aircraft of this randomization"
                reason = f"{error.reason}; {where}".removeprefix("; ")
                raise QuadrlError(**vars(error) | {"reason": reason}) from error
        if given.per_row:
            self._check_unlike_rotors()

    def _check_unlike_rotors(self) -> None:
        """Each rotor is drawn alone: every combination of weak and strong ones must hover."""
        given, count = self.given, self._vehicle.rotor_count
        kinds = 4 if given.rotors[0] < given.rotors[1] else 1  # weak or strong, twice
        corners = np.indices((kinds,) * count).reshape(count, -1).T  # (kinds^R, R)
        shifts = [(0.0, 0.0)]
        if given.centre_of_mass:
            shifts = itertools.product((-given.centre_of_mass, given.centre_of_mass), repeat=2)
        damaged = range(count if given.one_rotor != (1.0, 1.0) else 1)
        for (x, y), which in itertools.product(shifts, damaged):
            drawn = np.tile(self.low, (len(corners), 1))
            self.columns(drawn, WHICH)[:] = which
            self.columns(drawn, "mass")[:] = given.mass[1]
            self.columns(drawn, "centre_of_mass_x", 3)[:] = x, y, 0.0
            for name, end in (("thrust", corners % 2), ("torque", corners // 2)):
                self.columns(drawn, f"{name}_1", count)[:] = np.array(given.rotors)[end]
            rotor = self.table(drawn)["rotor"][:, :count]
            hover = rotor["hover_speed"]
            unable = ((hover <= 0) | (hover >= rotor["max_speed"])).any(axis=-1)
            if unable.any():
                reason = "each rotor is drawn alone, and with such rotors it cannot hover"
                names = ("thrust_coefficient", "torque_coefficient")
                worst = {name: rotor[name][unable][0].tolist() for name in names}
                raise QuadrlError(reason, name="rotors", value=worst, allowed="a narrower range")


def _steps(name: str, delay: Range, timestep: float) -> tuple[int, int]:
    """A delay [s] in whole steps.

    Raises:
        QuadrlError: It is no whole number of them.
    """
    fewest, most = (round(end / timestep) for end in delay)
    if any(abs(end / timestep - round(end / timestep)) > WHOLE for end in delay):
        kind = "physics" if name == DELAYS[0] else "control"
        allowed = f"a whole number of {kind} steps of {timestep:g} s"
        raise QuadrlError(name=name, value=delay, allowed=allowed)
    return fewest, most
