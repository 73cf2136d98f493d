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
from quadrl.validation import keys, number, numbers
from quadrl.vehicle import Vehicle, check_inertia

AIRCRAFT = ("mass", "inertia", "drag_coefficient", "moment_coefficient")
ROTOR = ("thrust_coefficient", "torque_coefficient", "lag_up", "lag_down", "max_speed")
RANGES = (*AIRCRAFT, *ROTOR, "wind")
"""What can be drawn: parameters of the aircraft, of each rotor on its own, and the wind [m/s]."""
COEFFICIENTS = ROTOR[:2]
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
        if not isinstance(given, (list, tuple, np.ndarray)) or len(given) != 2:
            raise QuadrlError(name=f"range of {name}", value=given, allowed="a pair (low, high)")
        limit = MAX_WIND if name == "wind" else MAX
        ends = []
        for end in given:
            whole = [end] * size if np.ndim(end) == 0 else end
            ends.append(np.array(numbers(f"range of {name}", whole, size, -limit, limit)))
        if not (ends[0] <= ends[1]).all():
            allowed = "(low, high) with low at most high"
            raise QuadrlError(name=f"range of {name}", value=given, allowed=allowed)
        return ends[0], ends[1]

    def _check_extremes(self) -> None:
        """Make the lightest and strongest, and the heaviest and weakest aircraft of the ranges."""
        fastest = np.linalg.norm(np.abs(self._ranges.get("wind", (0.0, 0.0))).max(axis=0))
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
                    made = dataclasses.replace(self._vehicle, rotors=rotors, **changes)
                    number("fastest wind [m/s]", float(fastest), 0.0, made.resolved_speed)
                except QuadrlError as error:
                    where = f"in the {'heaviest' if heavy else 'lightest'} aircraft of these ranges"
                    reason = f"{error.reason}; {where}".removeprefix("; ")
                    raise QuadrlError(**vars(error) | {"reason": reason}) from error
        if "inertia" in self._ranges:
            low, high = (tuple(end.tolist()) for end in self._ranges["inertia"])
            check_inertia("range of inertia", low, high)
        if any(name in self._ranges for name in COEFFICIENTS):
            self._check_unlike_rotors()

    def _check_unlike_rotors(self) -> None:
        """Each rotor is drawn alone: every combination of weak and strong ones must hover."""
        count = self._vehicle.rotor_count
        corners = np.indices((4,) * count).reshape(count, -1).T  # (4^R, R)
        table = parameters.rows(self._vehicle, len(corners))
        table["mass"] = self._ranges.get("mass", table["mass"][:1])[-1]
        rotor = table["rotor"][:, :count]
        ends = (corners % 2, corners // 2, 0 * corners)
        for name, end in zip((*COEFFICIENTS, "max_speed"), ends, strict=True):
            if name in self._ranges:
                rotor[name] = np.concatenate(self._ranges[name])[end]
        parameters.refresh(table, self._vehicle.physics_timestep)
        hover = rotor["hover_speed"]
        unable = ((hover <= 0) | (hover >= rotor["max_speed"])).any(axis=-1)
        if unable.any():
            worst = {name: rotor[name][unable][0].tolist() for name in COEFFICIENTS}
            reason = "each rotor is drawn alone, and with these the aircraft cannot hover"
            raise QuadrlError(reason, name="ranges", value=worst, allowed="narrower")

    def _end(self, name: str, which: int) -> Any:
        end = self._ranges[name][which]
        return tuple(end.tolist()) if len(end) > 1 else float(end[0])

    def holds(self, saved: np.ndarray) -> bool:
        """Whether rows of parameters can have been drawn from these ranges."""
        table = saved.copy().view(parameters.AIRCRAFT)[:, 0]
        own = parameters.rows(self._vehicle, len(table))
        for name in self._ranges.keys() - {"wind"}:
            of = np.s_[:] if name in AIRCRAFT else "rotor"
            own[of][name][:] = table[of][name]
        parameters.refresh(own, self._vehicle.physics_timestep)
        return np.array_equal(own.view(np.float64).reshape(saved.shape), saved)

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


def check_saved(ranges: Ranges | None, saved: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    """Refuse a saved state that is not finite, or of an aircraft that this environment never has.

    Raises:
        QuadrlError: The message names the array.
    """
    rows, table = "engine.rows", "engine.parameters"
    if not np.isfinite(saved[rows]).all():
        raise QuadrlError(name=rows, value=saved[rows], allowed="finite")
    drawn = ranges is not None and ranges.per_row and ranges.holds(saved[table])
    if not (drawn or np.array_equal(saved[table], own[table])):
        reason = "the state was saved with another aircraft"
        raise QuadrlError(reason, name=table, value=saved[table], allowed="this aircraft's")
