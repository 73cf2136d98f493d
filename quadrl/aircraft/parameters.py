"""Rows of parameters: the numbers of each aircraft that the engines use, one C struct per row.

The struct is generated from the numeric fields of `Rotor`, `Vehicle` and `Aerodynamics`: a new
parameter is a field there, and `engines/native/aero.h` and `engines/dynamics.py` find it by its
name. A row stands in the `user` data of the aircraft's body (`body_user`), where the callbacks
read it; free flight reads the same bytes.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from quadrl.aircraft.aerodynamics import (
    GROUND_EFFECT,
    MOST_OFFSET,
    MOST_TAKEN,
    ROTOR_EFFECTS,
    STILL_AIR,
    WINDMILL,
    Aerodynamics,
)
from quadrl.aircraft.rotors import GRAVITY, Rotor, hover_squares, mixer
from quadrl.aircraft.vehicle import MAX_ROTORS, Vehicle, resolved_speed, resolved_turn
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array

WIND = 3
AIR = WIND + MAX_ROTORS
"""Size of a row of air, in the simulation's `userdata`: the wind [m/s], world frame, and for each
rotor the noise of its thrust in the vortex ring state, of unit variance."""
HIT = 2
"""How many numbers follow the air in a world with solids: the number of the solid that was hit
fastest in this control step, from 1 on (0 for none), and the speed of that hit [m/s]."""
FEET, HELD, SINCE = 7, 5, 6
"""How many follow those: 1 once a foot has touched a solid; at the moment of that touch the speed
into the solid and along it [m/s], the cosine of the angle between the body's z axis and the solid's
normal, and the body rate [rad/s]; at index `HELD`, 1 once a solid grips a foot; and, at index
`SINCE`, when it last touched a solid, by MuJoCo's clock [s]."""
MARK = 1903518052.0
"""Marks the actuators and bodies of quadrl: "quad" in ASCII."""
SETTINGS = (
    *("name", "rotors", "action_scale", "physics_timestep", "control_timestep", "aerodynamics"),
    *("dead_time", "command_map"),
)
"""Fields of `Vehicle` that are not in a row."""
DERIVED = ("foot", "hull", "ground_clearance", "rotor_height", "resolved_speed", "resolved_turn")
"""Properties of `Vehicle` that are in a row."""
STEADY = ("steady_force", "steady_moment")
"""Force [N], world frame, and moment [N m], body frame, (3,) each, that act on an aircraft for an
episode; zero unless they are drawn."""


def _fields(kind: type, settings: tuple[str, ...] = ()) -> list[Any]:
    sizes = {"float": (), "bool": (), "Vector": (3,)}
    fields = [field for field in dataclasses.fields(kind) if field.name not in settings]
    return [(field.name, np.float64, sizes[str(field.type)]) for field in fields]


ROTOR = np.dtype([*_fields(Rotor), ("hover_speed", np.float64)])
AIRCRAFT = np.dtype(
    [
        ("mark", np.float64),
        ("size", np.float64),  # of a row, which tells a model of another version
        ("rotor_count", np.float64),
        *_fields(Vehicle, SETTINGS),
        *((name, np.float64, (3,) if name in ("foot", "hull") else ()) for name in DERIVED),
        *((name, np.float64, (3,)) for name in STEADY),
        *_fields(Aerodynamics),
        ("effects", np.float64),  # Aerodynamics.effects
        ("rotor", ROTOR, (MAX_ROTORS,)),
    ]
)
"""A row. Every number is a double."""
ROW_SIZE = AIRCRAFT.itemsize // 8
PLACES = np.arange(float(ROW_SIZE)).view(AIRCRAFT)
"""A row in which each number is its own index."""
LAYOUT = np.frombuffer(json.dumps(AIRCRAFT.descr).encode(), dtype=np.uint8)
"""The names and shapes of its numbers, as JSON, which is saved beside rows."""


def rows(vehicle: Vehicle, count: int = 1) -> np.ndarray:
    """`count` equal rows (count,) of an aircraft."""
    table = np.zeros(count, dtype=AIRCRAFT)
    table["mark"], table["size"] = MARK, ROW_SIZE
    for name in AIRCRAFT.names or ():
        if name not in ("mark", "size", "rotor", *STEADY):
            owner = vehicle if hasattr(vehicle, name) else vehicle.aerodynamics
            table[name] = getattr(owner, name)
    for name, *_ in _fields(Rotor):
        for k, rotor in enumerate(vehicle.rotors):
            value = rotor.disc if name == "disc_radius" else getattr(rotor, name)
            table["rotor"][name][:, k] = value
    table["rotor"]["hover_speed"][:, : vehicle.rotor_count] = vehicle.hover_speed
    return table


def numbers(table: np.ndarray) -> np.ndarray:
    """Rows (n,) as doubles (n, ROW_SIZE)."""
    return np.ascontiguousarray(table).view(np.float64).reshape(len(table), -1)


def named(numbers: np.ndarray) -> np.ndarray:
    """Rows (n,) from their doubles (n, ROW_SIZE); a view where these lie side by side."""
    return np.ascontiguousarray(numbers).view(AIRCRAFT)[:, 0]


def field(table: np.ndarray, name: str) -> np.ndarray:
    """A view of a field of rows (n,), such as "mass" or "rotor.max_speed".

    It is (n, 1), (n, 3), or of the rotors that there are (n, R), (n, R, 3).
    """
    if name.startswith("rotor."):
        count = int(table["rotor_count"][0]) if len(table) else 0
        return table["rotor"][name.removeprefix("rotor.")][:, :count]
    return table[name].reshape(len(table), -1)


def refitted(saved: np.ndarray, layout: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Rows (n, size) that were saved when a row had fewer numbers, as rows (n, ROW_SIZE).

    Args:
        saved: The rows, as doubles.
        layout: The `LAYOUT` that was saved beside them.
        own: Rows (n,) with the numbers that they lack.

    Raises:
        QuadrlError: They have a number that is not known here, or are no such rows.
    """
    table = own.copy()
    try:
        _fill(table, np.ascontiguousarray(saved).view(_dtype(json.loads(layout.tobytes())))[:, 0])
    except QuadrlError:
        raise
    except (IndexError, RecursionError, TypeError, ValueError) as error:
        raise QuadrlError(f"the rows of an aircraft cannot be read: {error}") from error
    table["size"] = ROW_SIZE
    return numbers(table)


def _fill(table: np.ndarray, saved: np.ndarray) -> None:
    for name in saved.dtype.names or ():
        if name not in (table.dtype.names or ()):
            raise QuadrlError(name="number of an aircraft", value=name, allowed="one known here")
        if table[name].dtype.names:
            _fill(table[name], saved[name])
        else:
            table[name] = saved[name]


def _dtype(fields: Any) -> np.dtype:
    return np.dtype(
        [(n, _dtype(k) if isinstance(k, list) else k, *map(tuple, s)) for n, k, *s in fields]
    )


def limits(table: np.ndarray) -> np.ndarray:
    """Largest speed [m/s] and body rate [rad/s] of rows (n,), (n, 2), for native/state.c."""
    return np.stack([table["resolved_speed"], table["resolved_turn"]], axis=1)


def hover_thrust(table: np.ndarray) -> np.ndarray:
    """Thrust (n,) [N] with which rows hover against their weight and the steady force."""
    x, y, z = table["steady_force"].T
    return np.sqrt(x**2 + y**2 + (table["mass"] * GRAVITY - z) ** 2)


def refresh(table: np.ndarray, timestep: float) -> None:
    """Update, in place, the parameters of rows that follow from the others."""
    count = int(table["rotor_count"][0])
    matrix = mixer(table["rotor"][:, :count])
    squares = hover_squares(matrix, hover_thrust(table), table["steady_moment"])
    table["rotor"]["hover_speed"][:, :count] = np.sqrt(np.maximum(squares, 0.0))
    table["resolved_speed"] = resolved_speed(table["mass"], table["drag_coefficient"], timestep)
    least = table["inertia"].min(axis=-1)
    table["resolved_turn"] = resolved_turn(least, table["moment_coefficient"], timestep)


class Parameters:
    """Rows by name, in any array namespace: `p.mass` (N,), `p.rotor.position` (N, R, 3)."""

    def __init__(self, arrays: dict[str, Any]) -> None:
        """Take the arrays; a nested dict becomes nested Parameters."""
        for name, value in arrays.items():
            nested = Parameters(cast(Any, value)) if isinstance(value, dict) else value
            setattr(self, name, nested)

    def __getattr__(self, name: str) -> Array:
        """Tell type checkers that every parameter is an array."""
        raise AttributeError(f"there is no parameter {name!r}")

    @classmethod
    def of(
        cls, table: np.ndarray, control_timestep: float = 0.0, rotors: int | None = None
    ) -> Parameters:
        """Views of rows (N,).

        Args:
            table: Rows; the views are live.
            control_timestep: Control timestep [s], which is kept beside them.
            rotors: Number of rotors; None for the rows' own.
        """
        count = int(table["rotor_count"][0]) if rotors is None else rotors
        rotor = table["rotor"][:, :count]
        arrays: dict[str, Any] = {n: table[n] for n in AIRCRAFT.names or () if n != "rotor"}
        arrays["rotor"] = {name: rotor[name] for name in ROTOR.names or ()}
        return cls(arrays | {"control_timestep": control_timestep})

    @classmethod
    def of_symbols(cls, numbers: Array, control_timestep: float, rotors: int) -> Parameters:
        """A row by name from its numbers (1, ROW_SIZE), which a tracer reads."""
        return cls.of(PLACES, control_timestep, rotors).map(
            lambda places: numbers[0, places.astype(int)]
        )

    def map(self, function: Callable[[Array], Array]) -> Parameters:
        """The same with a function applied to every array."""
        mapped = Parameters({})
        for name, value in vars(self).items():
            if isinstance(value, Parameters):
                value = value.map(function)
            elif not isinstance(value, float):
                value = function(value)
            setattr(mapped, name, value)
        return mapped


def c_structs() -> str:
    """The C declarations of a row, for LANES aircraft side by side (1: exactly a row)."""

    def fields(dtype: np.dtype) -> str:
        lines: list[str] = []
        for name in dtype.names or ():
            inner = dtype[name]
            if inner.base == ROTOR:
                lines.append(f"  Rotor {name}[{MAX_ROTORS}];")
                continue
            sizes = "".join(f"[{n}]" for n in inner.shape)
            lines.append(f"  double {name}{sizes}[LANES];")
        return "\n".join(lines)

    effects = f"{STILL_AIR=}, {ROTOR_EFFECTS=}, {GROUND_EFFECT=}"
    sizes = f"MAX_ROTORS = {MAX_ROTORS}, WIND = {WIND}, AIR = {AIR}, HIT = {HIT}, FEET = {FEET}"
    sizes += f", HELD = {HELD}, SINCE = {SINCE}, ROW_SIZE = {ROW_SIZE}"
    return (
        "// Written by quadrl/aircraft/parameters.py from Rotor, Vehicle and Aerodynamics.\n"
        f"#define QUADRL_MARK {MARK!r}\n#define MOST_OFFSET {MOST_OFFSET!r}\n"
        f"#define WINDMILL {WINDMILL!r}\n#define MOST_TAKEN {MOST_TAKEN!r}\n"
        f"enum {{ {sizes} }};\nenum {{ {effects} }};\n"
        f"typedef struct {{\n{fields(ROTOR)}\n}} Rotor;\n"
        f"typedef struct {{\n{fields(AIRCRAFT)}\n}} Aircraft;\n"
    )
