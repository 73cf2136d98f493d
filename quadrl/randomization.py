"""Ranges from which the parameters and the air of each row are drawn, once per episode."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from quadrl import parameters
from quadrl.errors import QuadrlError
from quadrl.rng import Rng
from quadrl.rotors import MAX, Rotor
from quadrl.validation import keys, numbers
from quadrl.vehicle import Vehicle, check_inertia

AIRCRAFT = ("mass", "inertia", "drag_coefficient", "moment_coefficient")
ROTOR = ("thrust_coefficient", "torque_coefficient", "lag_up", "lag_down", "max_speed")
RANGES = (*AIRCRAFT, *ROTOR, "wind")
"""What can be drawn: parameters of the aircraft, of each rotor on its own, and the wind [m/s]."""
MAX_WIND = 100.0  # [m/s], in each direction


class Ranges:
    """Uniform ranges of parameters, validated for a vehicle."""

    def __init__(self, vehicle: Vehicle, ranges: Mapping[str, Any]) -> None:
        """Validate.

        Args:
            vehicle: The aircraft as it is specified; what has no range stays as it is there.
            ranges: By name of RANGES a pair (low, high), each a number or one per component
                (inertia and wind have three), in the unit of the parameter. Parameters of `Rotor`
                are drawn for each rotor alone.

        Raises:
            QuadrlError: Unknown name, a range the wrong way round, or one that holds an aircraft
                that cannot exist or cannot hover.
        """
        if not isinstance(ranges, Mapping):
            allowed = "a mapping from names to pairs (low, high)"
            raise QuadrlError(name="ranges", value=ranges, allowed=allowed)
        keys("range", ranges, RANGES)
        self._vehicle = vehicle
        self._ranges: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for name in RANGES:  # drawn in this order, however they were given
            if name in ranges:
                self._ranges[name] = self._pair(name, ranges[name])
        self._check_extremes()

    def _pair(self, name: str, given: Any) -> tuple[np.ndarray, np.ndarray]:
        size = 3 if name in ("inertia", "wind") else 1
        try:
            low, high = given
        except (TypeError, ValueError) as error:
            raise QuadrlError(
                name=f"range of {name}", value=given, allowed="a pair (low, high)"
            ) from error
        limit = MAX_WIND if name == "wind" else MAX
        ends = []
        for end in (low, high):
            whole = [end] * size if np.ndim(end) == 0 else end
            ends.append(np.array(numbers(f"range of {name}", whole, size, -limit, limit)))
        if not (ends[0] <= ends[1]).all():
            allowed = "(low, high) with low at most high"
            raise QuadrlError(name=f"range of {name}", value=given, allowed=allowed)
        return ends[0], ends[1]

    def _check_extremes(self) -> None:
        """Make the lightest and strongest, and the heaviest and weakest aircraft of the ranges."""
        for heavy in (0, 1):
            # Its mass, drag and moments at one end, what its rotors give at the other.
            changes = {name: self._end(name, heavy) for name in AIRCRAFT if name in self._ranges}
            rotor = {name: self._end(name, 1 - heavy) for name in ROTOR if name in self._ranges}
            rotors = tuple(dataclasses.replace(r, **rotor) for r in self._vehicle.rotors)
            for drag in (0, 1):
                for name in ("drag_coefficient", "moment_coefficient"):
                    if name in self._ranges:
                        changes[name] = self._end(name, drag)
                try:
                    dataclasses.replace(self._vehicle, rotors=rotors, **changes)
                except QuadrlError as error:
                    what = "heaviest" if heavy else "lightest"
                    raise QuadrlError(
                        f"in the {what} aircraft of these ranges",
                        name=error.name,
                        value=error.value,
                        allowed=error.allowed,
                    ) from error
        if "inertia" in self._ranges:
            low, high = (tuple(end.tolist()) for end in self._ranges["inertia"])
            check_inertia("range of inertia", low, high)

    def _end(self, name: str, which: int) -> Any:
        end = self._ranges[name][which]
        return tuple(end.tolist()) if len(end) > 1 else float(end[0])

    @property
    def per_row(self) -> bool:
        """Whether parameters are drawn, beside the air."""
        return any(name != "wind" for name in self._ranges)

    def draw(self, rng: Rng, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows of parameters (count,) and of air (count, AIR) for episodes that begin.

        Args:
            rng: Of those rows, at the beginning of the stream of parameters.
            count: Number of rows.
        """
        table, air = parameters.rows(self._vehicle, count), np.zeros((count, parameters.AIR))
        rotors = self._vehicle.rotor_count
        for name, (low, high) in self._ranges.items():
            size = rotors if name in Rotor.__dataclass_fields__ else len(low)
            drawn = low + (high - low) * rng.uniform(0.0, 1.0, size)
            if name == "wind":
                air[:] = drawn
            elif name in AIRCRAFT:
                table[name] = drawn if size > 1 else drawn[:, 0]
            else:
                table["rotor"][name][:, :rotors] = drawn
        if self.per_row:
            parameters.refresh(table, self._vehicle.physics_timestep)
        return table, air
