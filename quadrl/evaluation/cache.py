"""Results of flights that are kept in a file until they stand in a card.

A result is found again by a digest over all that it depends on, so that none is ever taken for
another one's.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import json
import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FunctionType
from typing import Any

import mujoco
import numpy as np

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.files import read_sealed_json, write_sealed_json
from quadrl.base.version import __version__
from quadrl.core.task import Task

FILE = "flown.json"
FORMAT = "quadrl-flown-3"


class ResultCache:
    """Calls functions that fly, and keeps their results in a file, from which it repeats them."""

    def __init__(self, folder: Path | None) -> None:
        """Read what is kept in a folder; None keeps nothing."""
        self._file = None if folder is None else folder / FILE
        self._found: dict[str, Any] = {}
        self._used: set[str] = set()
        if self._file is None or not self._file.exists():
            return
        try:
            self._found = read_sealed_json(self._file, FORMAT)["flown"]
        except QuadrlError:
            aside = self._file.with_suffix(".unused")
            os.replace(self._file, aside)
            warnings.warn(
                f"{self._file} is damaged or something else, so nothing is taken from it; "
                f"it is now {aside}",
                QuadrlWarning,
                stacklevel=3,
            )

    def __call__(self, fly: Callable[..., Any], *given: Any, **conditions: Any) -> Any:
        """What `fly` gives for these arguments, as JSON has it."""
        key = self._key(fly, given, conditions)
        if key not in self._found:
            flown = json.dumps(fly(*given, **conditions), default=np.ndarray.tolist)
            if key is None:
                return json.loads(flown)
            self._found[key] = json.loads(flown)
            self._write(self._found)
        self._used.add(key)
        return self._found[key]

    def forget(self) -> None:
        """Keep nothing of what was asked for any longer."""
        if self._used:
            self._write({k: v for k, v in self._found.items() if k not in self._used})

    def _key(self, *what: Any) -> str | None:
        """A digest over what is flown; None where nothing is kept, or it may do anything."""
        if self._file is None:
            return None
        try:
            return digest([*what, __version__, mujoco.__version__, np.__version__])
        except (OSError, TypeError):
            return None

    def _write(self, found: dict[str, Any]) -> None:
        assert self._file
        if not found:
            self._file.unlink(missing_ok=True)
            return
        self._file.parent.mkdir(parents=True, exist_ok=True)
        write_sealed_json(self._file, {"flown": found}, FORMAT)


def digest(thing: Any) -> str:
    """A digest over the whole content of a thing.

    Raises:
        TypeError: It is a function or an object whose content does not tell what it does.
        OSError: The source of a task cannot be read.
    """
    text = json.dumps(thing, sort_keys=True, default=_content)
    return hashlib.sha256(text.encode()).hexdigest()


def _content(thing: Any) -> Any:
    """The content of a thing that JSON does not know."""
    if isinstance(thing, np.generic):
        return thing.item()
    if isinstance(thing, np.ndarray):
        data = hashlib.sha256(thing.tobytes()).hexdigest()
        return [thing.dtype.str, list(thing.shape), data]
    if isinstance(thing, Mapping):
        return dict(thing)
    kind = thing if isinstance(thing, FunctionType) else type(thing)
    content: list[Any] = [kind.__module__, kind.__qualname__]
    own = kind.__module__.startswith("quadrl.") and "<" not in kind.__qualname__  # no closures
    if not own:
        if not isinstance(thing, Task):
            raise TypeError(f"{kind.__qualname__} may do anything")
        content.append(hashlib.sha256(Path(inspect.getfile(kind)).read_bytes()).hexdigest())
    if not isinstance(thing, FunctionType):
        # What an object of a dataclass has beside its fields it has computed from them.
        data_only = dataclasses.is_dataclass(thing)
        names = [f.name for f in dataclasses.fields(thing)] if data_only else vars(thing)
        content.append({name: getattr(thing, name) for name in names})
    return content
