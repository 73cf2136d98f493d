"""Operations on records: mostly dataclasses of arrays with a leading axis N, perhaps nested."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, cast

import numpy as np

from quadrl.base.errors import QuadrlError


def named(record: Any, prefix: str = "") -> dict[str, Any]:
    """The values in a record by name, in the order of its fields, none of them a record or a tuple.

    A value of a record within it has the name "FIELD.NAME", of a tuple of records "FIELD.0.NAME".
    """
    if isinstance(record, tuple):
        parts = enumerate(cast(tuple[Any, ...], record))
    else:
        kind = cast(Any, type(record))
        parts = ((name, getattr(record, name)) for name in _fields(kind))
    found: dict[str, Any] = {}
    for name, value in parts:
        inner = not hasattr(value, "dtype")  # most are arrays, which costs the least to see
        if inner and (dataclasses.is_dataclass(value) or isinstance(value, tuple)):
            found |= named(value, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = value
    return found


@functools.cache
def _fields(kind: type[Any]) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))


def leaves(record: Any) -> list[Any]:
    """A record's arrays, in the order of its fields."""
    return [value for value in named(record).values() if hasattr(value, "dtype")]


def mapped(function: Callable[[Any], Any], record: Any) -> Any:
    """A record with a function applied to each of its arrays; other values stay."""
    if hasattr(record, "dtype"):
        return function(record)
    if isinstance(record, tuple):
        return tuple(mapped(function, part) for part in cast(tuple[Any, ...], record))
    if not dataclasses.is_dataclass(record):
        return record
    kind: Any = type(record)
    return kind(**{name: mapped(function, getattr(record, name)) for name in _fields(kind)})


def filled(like: Any, arrays: Iterator[Any]) -> Any:
    """A record like another one with the next arrays of an iterator, in the order of `leaves`."""
    return mapped(lambda _: next(arrays), like)


def copied(record: Any) -> Any:
    """A record with copies of the arrays."""
    return mapped(np.array, record)


def owned(record: Any) -> Any:
    """The same record if its arrays are neither views nor read-only, else a copy."""
    own = all(array.base is None and array.flags.writeable for array in leaves(record))
    return record if own else copied(record)


def put(record: Any, rows: np.ndarray, fresh: Any) -> None:
    """Write rows (n,) of a record from another (n, ...)."""
    for into, value in zip(leaves(record), leaves(fresh), strict=True):
        into[rows] = value


def arrays(prefix: str, record: Any) -> dict[str, np.ndarray]:
    """Copies of a record's arrays by name, "PREFIX.NAME"."""
    # In C's order, as every file format wants them.
    return {name: np.array(value, order="C") for name, value in named(record, f"{prefix}.").items()}


def of_arrays(prefix: str, like: Any, saved: Mapping[str, np.ndarray]) -> Any:
    """A record like another one, from the arrays that `arrays` returned."""
    return filled(like, (np.array(saved[name]) for name in named(like, f"{prefix}.")))


def check_alike(saved: Mapping[str, np.ndarray], own: Mapping[str, np.ndarray]) -> None:
    """Refuse saved arrays whose names, shapes or dtypes are not the expected ones.

    Raises:
        QuadrlError: The message names the array.
    """
    reason = "what was saved is of another environment"
    if others := sorted(saved.keys() - own.keys()):
        raise QuadrlError(reason, name=others[0], value="an array", allowed="none: it has no such")
    for name, array in own.items():
        kept = saved.get(name)
        if kept is None or (kept.shape, kept.dtype) != (array.shape, array.dtype):
            found = None if kept is None else f"{kept.dtype} {kept.shape}"
            allowed = f"{array.dtype} {array.shape}"
            raise QuadrlError(reason, name=name, value=found, allowed=allowed)


def as_json(value: Any) -> Any:
    """A value, with records of any kind in it, as JSON gives it back."""
    return json.loads(json.dumps(value, default=_taken_apart))


def _taken_apart(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    return value.tolist() if hasattr(value, "tolist") else str(value)


def tuples(value: Any) -> Any:
    """A value with each list turned into a tuple, at any depth."""
    if isinstance(value, dict):
        return {name: tuples(item) for name, item in cast(dict[str, Any], value).items()}
    if isinstance(value, (list, tuple)):
        return tuple(map(tuples, cast(Iterable[Any], value)))
    return value


class Columns:
    """The places of arrays (N, ...) in a table (rows, N), with a row for each number."""

    def __init__(self, first: int, arrays: list[Any]) -> None:
        """Lay the arrays out by their shapes, from row `first` on."""
        self._places: list[tuple[slice, tuple[int, ...]]] = []
        self.end = first
        for array in arrays:
            tail = array.shape[1:]
            start, self.end = self.end, self.end + math.prod(tail)
            self._places.append((slice(start, self.end), tail))

    def views(self, table: np.ndarray) -> list[np.ndarray]:
        """The arrays as views of a table."""
        parts = (table[place].reshape(*tail, *table.shape[1:]) for place, tail in self._places)
        return [np.moveaxis(part, -1, 0) for part in parts]
