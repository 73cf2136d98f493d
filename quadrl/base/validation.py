"""Validation of options and parameters, which are checked once, where they come in."""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import numbers as abstract
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast

import numpy as np

from quadrl.base.errors import QuadrlError, UnknownKeyword

WHOLE = 1e-6  # of a step: tolerance with which a time is a whole number of steps
IN_A_FILE = ", or one of a file that --import names"
"""What else a name can be that is registered."""
MAX_OPTION = 1e9
"""Largest number in an option of a task; with larger ones sums would lose their digits."""


def number(
    name: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    whole: bool = False,
    positive: bool = False,
) -> Any:
    """A finite number between `low` and `high`, as a float, or as an int with `whole`.

    Raises:
        QuadrlError: It is not a number, not finite, or out of range.
    """
    kind = abstract.Integral if whole else abstract.Real
    if isinstance(value, kind) and not isinstance(value, (bool, np.bool_)):
        converted: Any = int(value) if whole else _float(value)  # type: ignore[arg-type]
        within = low <= converted <= high and (converted > 0 or not positive)
        if within and (whole or math.isfinite(converted)):
            return converted
    raise QuadrlError(name=name, value=value, allowed=_range(low, high, whole, positive))


def whole_steps(name: str, times: Sequence[float], timestep: float, kind: str) -> tuple[int, ...]:
    """Times [s] in numbers of steps.

    Raises:
        QuadrlError: A time is not a multiple of the time step.
    """
    steps = tuple(round(time / timestep) for time in times)
    if any(abs(time / timestep - k) > WHOLE for time, k in zip(times, steps, strict=True)):
        allowed = f"a whole number of {kind} steps of {timestep:g} s"
        value = times if len(times) > 1 else times[0]
        raise QuadrlError(name=name, value=value, allowed=allowed)
    return steps


def numbers(
    name: str, value: Any, size: int | None = None, low: float = -math.inf, high: float = math.inf
) -> tuple[float, ...]:
    """`size` numbers, each between `low` and `high`; any number of them if `size` is None.

    Raises:
        QuadrlError: It is not such a sequence.
    """
    try:
        items = None if isinstance(value, str) else tuple(value)
    except TypeError:
        items = None
    if items is None or (size is not None and len(items) != size):
        many = "a sequence of numbers" if size is None else f"a sequence of {size} numbers"
        raise QuadrlError(name=name, value=value, allowed=many)
    return tuple(number(f"{name}[{k}]", item, low, high) for k, item in enumerate(items))


def names(key: str, value: Any) -> list[str]:
    """A list of different names.

    Raises:
        QuadrlError: It is no such list.
    """
    found: list[Any] = list(cast(Any, value)) if isinstance(value, (list, tuple)) else []
    known = all(isinstance(name, str) and name for name in found)
    if not found or not known or len(set(found)) < len(found):
        allowed = 'a list of different names, such as ["hover"]'
        raise QuadrlError(name=key, value=value, allowed=allowed)
    return found


def choice(
    name: str,
    value: Any,
    choices: Iterable[str],
    others: str = "",
    known_as: Mapping[str, str] | None = None,
) -> Any:
    """A value that is one of the choices; `others` says what else there can be.

    `known_as` has the choice, or a sentence, for what other programs call it.

    Raises:
        QuadrlError: It is none of them; the message lists them and names the nearest.
    """
    allowed = list(choices)
    if isinstance(value, str) and value in allowed:
        return value
    like = {_letters(one): one for one in allowed}
    near = difflib.get_close_matches(_letters(str(value)), like, n=1)
    meant = (known_as or {}).get(str(value).lower(), like[near[0]] if near else "")
    hint = f" (did you mean {meant}?)" if meant in allowed else ""
    reason, allowed = "" if hint else meant, f"one of {', '.join(allowed)}{hint}{others}"
    raise QuadrlError(reason, name=name, value=value, allowed=allowed)


def keys(what: str, given: Iterable[str], choices: Iterable[str], *, tried: bool = False) -> None:
    """Refuse the first name that is not among the choices.

    Args:
        what: What they are names of.
        given: The names.
        choices: Those that there are.
        tried: Whether libraries try keywords, and read in Python's words which one is unknown.

    Raises:
        UnknownKeyword: The message lists the choices.
    """
    allowed = list(choices)
    for name in given:
        try:
            choice(what, name, allowed)
        except QuadrlError as error:
            reason = f"got an unexpected keyword argument {name!r}" if tried else ""
            raise UnknownKeyword(reason, name=what, value=name, allowed=error.allowed) from None


def record(name: str, value: Any, kind: type, word: str = "field") -> Any:
    """A value as it is, or the dataclass `kind` made from a mapping of some of its fields.

    Raises:
        UnknownKeyword: The dataclass has no such field; the message lists the choices.
        QuadrlError: A field without a default is missing.
    """
    if not isinstance(value, Mapping):
        return value
    given = cast(Mapping[str, Any], value)
    fields = [field for field in dataclasses.fields(kind) if field.init]
    keys(f"{word} of {name}", given, [field.name for field in fields])
    for field in fields:
        if field.default is field.default_factory and field.name not in given:  # both missing
            raise QuadrlError(name=f"{word} {field.name} of {name}", value=None, allowed="given")
    return kind(**given)


def resolved(
    name: str, value: Any, kind: type, known: Mapping[str, Any] | None = None, word: str = "field"
) -> Any:
    """An instance of the dataclass `kind`: as given, by a known name, or from some of its fields.

    Raises:
        QuadrlError: The value is something else, or there is no such name or field.
    """
    if known and isinstance(value, str):
        return known[choice(name, value, known)]
    made = record(name, value, kind, word)
    if not isinstance(made, kind):
        names = f", or a name of {', '.join(known)}" if known else ""
        allowed = f"of the kind {kind.__name__}, or a mapping of its {word}s{names}"
        raise QuadrlError(name=name, value=value, allowed=allowed)
    return made


def registered(what: str, kind: Any, base: type, registry: Mapping[str, Any]) -> str:
    """The name under which a class is registered.

    Raises:
        QuadrlError: It is not a subclass of the base with a name, or another class has the name.
    """
    name = getattr(kind, "name", None)
    is_kind = isinstance(kind, type) and issubclass(kind, base)
    if not (is_kind and isinstance(name, str)):
        allowed = f"a {base.__name__} subclass with a string `name` such as 'my_{what}'"
        raise QuadrlError(name=what, value=kind, allowed=allowed)
    if not name.isidentifier():
        allowed = f"letters, digits and underscores, such as 'my_{what}'"
        raise QuadrlError(name=f"{what} name", value=name, allowed=allowed)
    if registry.get(name, kind) is not kind:
        allowed = f"a name that no other {what} has"
        raise QuadrlError(name=f"{what} name", value=name, allowed=allowed)
    return name


def like(name: str, value: Any, default: Any) -> Any:
    """A value of the same kind as a default: text, flag, finite number or sequence of numbers.

    Raises:
        QuadrlError: The value is of another kind, not finite, or larger than `MAX_OPTION`.
    """
    if _kind(value) != (kind := _kind(default)):
        example = json.dumps(default or [0, 0, 1]) if kind == "sequence" else repr(default)
        allowed = f"a {kind}, such as {example}"
        raise QuadrlError(name=name, value=value, allowed=allowed)
    if isinstance(value, (str, bool)) or value is None:
        return value
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    # Whole numbers past 64 bits are objects to NumPy.
    if array.dtype.kind not in "fiu" or not (np.abs(array) <= MAX_OPTION).all():
        allowed = f"finite, between -{MAX_OPTION:g} and {MAX_OPTION:g}"
        raise QuadrlError(name=name, value=value, allowed=allowed)
    return value


def rows(given: Any, count: int) -> np.ndarray:
    """Numbers of rows in ascending order, from distinct numbers (n,) or a mask (count,).

    Raises:
        QuadrlError: What is given is neither.
    """
    array = np.asarray(given)
    if array.dtype == bool and array.shape == (count,):
        return np.flatnonzero(array)
    whole = array.ndim == 1 and (array.dtype.kind in "iu" or len(array) == 0)
    chosen = np.unique(array) if whole else np.zeros(0, dtype=np.int64)
    within = len(chosen) == 0 or (chosen[0] >= 0 and chosen[-1] < count)
    if not whole or len(chosen) != len(array) or not within:
        allowed = f"distinct numbers from 0 to {count - 1}, or a boolean mask of shape ({count},)"
        raise QuadrlError(name="rows", value=array.tolist(), allowed=allowed)
    return chosen.astype(np.int64)


def action(given: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A copy of an action in double precision.

    Raises:
        QuadrlError: Wrong shape, a type that does not convert without loss, or a number that is
            not finite.
    """
    if given is None:
        reason = "does the function that flies return its action?"
        raise QuadrlError(reason, name="action", value=None, allowed=f"an array {shape}")
    try:
        array = np.asarray(given)
    except (TypeError, ValueError, RuntimeError) as error:
        raise QuadrlError(str(error), name="action", value=given, allowed="real numbers") from error
    if array.dtype.char not in "fd" and not np.can_cast(array.dtype, np.float64):
        allowed = "a real type, such as float32 or float64"
        raise QuadrlError(name="action dtype", value=str(array.dtype), allowed=allowed)
    if array.shape != shape:
        raise QuadrlError(name="action shape", value=array.shape, allowed=str(shape))
    array = array.astype(np.float64)
    if np.count_nonzero(np.isfinite(array)) < array.size:  # a third of the time of `all`
        where = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
        raise QuadrlError(name=f"action{list(where)}", value=float(array[where]), allowed="finite")
    return array


def _letters(name: str) -> str:
    """What is left of a name, or of an environment's id, without the way it is written."""
    bare = name.rpartition("/")[2].partition("-v")[0]
    return "".join(filter(str.isalnum, bare)).lower()


def _kind(value: Any) -> str:
    if isinstance(value, (bool, str, dict)) or value is None:
        kind = type(cast(Any, value)).__name__
        return {"str": "string", "bool": "flag"}.get(kind, kind)
    return "number" if isinstance(value, abstract.Real) else "sequence"


def _float(value: Any) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _range(low: float, high: float, whole: bool, positive: bool) -> str:
    kind = "a whole number" if whole else "a number"
    if math.isfinite(low) and math.isfinite(high):
        return f"{kind} between {low:g} and {high if whole else format(high, '.10g')}"
    if math.isfinite(low):
        return f"{kind} of at least {low:g}"
    if math.isfinite(high):
        return f"{kind} of at most {high:.10g}"
    return f"{'a positive' if positive else 'a finite'}{' whole' * whole} number"
