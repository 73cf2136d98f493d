"""What a saved flight remembers: whether its names mean other numbers today, and its own files.

A run keeps the paths of the files of `--import`, so that no later command on it needs them. Whoever
made a run must not choose what is run here: only paths that this user has written count. A key in
the user's cache folder, which nobody else can read, seals them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import hmac
import importlib.util
import inspect
import os
import secrets
import stat
import sys
import tempfile
import traceback
import warnings
from collections.abc import Generator, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from quadrl.aircraft import presets, specification
from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.records import as_json
from quadrl.core.catalogue import TASKS
from quadrl.core.rules import check_rules
from quadrl.core.scenario import Scenario
from quadrl.engines.native.compiling import cache_folder

MOST_TOLD = 3
"""Numbers of an aircraft or a task that a warning names."""
KEY = "key"
"""The file of the key in the cache folder."""
KEY_SIZE = 32
IMPORTED: dict[Path, str] = {}
"""The sha256 of each file that `import_own` has run, by its path."""


def warn_of_changes(
    record: Mapping[str, Any], flown: Scenario, whose: str, *, kept: bool = True
) -> None:
    """Warn where the aircraft or the task of a record has other numbers today.

    Args:
        record: As `Scenario.to_json` gave it.
        flown: What is flown of it.
        whose: What holds the record, such as "policy".
        kept: Whether to tell of numbers that are flown as recorded, or of those that are not.
    """
    found = (("aircraft", flown.vehicle.name, _aircraft), ("task", flown.task.name, _task))
    if "changed" not in record:  # names and some numbers, made by hand
        return
    for what, name, three in found:
        was, now, flies = (dict(_flat(as_json(one))) for one in three(record, flown))
        own = was if kept else now
        told = [k for k in was if was[k] != now.get(k) and flies.get(k) == own.get(k)]
        if told:
            had = ", ".join(f"{k} = {was[k]}" for k in told[:MOST_TOLD])
            has = ", ".join(f"{now.get(k)}" for k in told[:MOST_TOLD])
            more = f" (and {len(told) - MOST_TOLD} more)" if len(told) > MOST_TOLD else ""
            end = "flown: as recorded" if kept else "here it is as it is now"
            text = f"the {what} {name} of this {whose} has {had}{more}; {name} is now {has}; {end}"
            warnings.warn(text, QuadrlWarning, stacklevel=4)


def import_own(path: Path) -> None:
    """Run a file, which registers the user's own tasks and aircraft.

    Raises:
        QuadrlError: There is no such file, or it fails, or a task in it breaks a rule; the message
            names the file and the line.
    """
    if not path.is_file():
        raise QuadrlError(name="--import", value=str(path), allowed="the path of a Python file")
    content, known = path.read_bytes(), set(TASKS)
    spec: Any = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    with _located(path):
        spec.loader.exec_module(module)
    for kind in [kind for name, kind in TASKS.items() if name not in known]:
        with _located(path, inspect.getsourcelines(kind)[1]):
            check_rules(kind)
    IMPORTED[path.resolve()] = hashlib.sha256(content).hexdigest()


@contextlib.contextmanager
def _located(path: Path, line: int | None = None) -> Generator[None]:
    """Report a failure with the last line of the user's file that led to it, or a given line."""
    try:
        yield
    except Exception as error:
        frames, cause = list[traceback.FrameSummary](), error
        while cause is not None:
            frames += traceback.extract_tb(cause.__traceback__)
            cause = cause.__cause__
        lines = [
            frame.lineno for frame in frames if Path(frame.filename).resolve() == path.resolve()
        ]
        line = error.lineno if isinstance(error, SyntaxError) else (lines or [line])[-1]
        where = f"{path}, line {line}" if line else str(path)
        # What a check of quadrl says is a sentence; what Python says needs its kind.
        said = error if isinstance(error, (AssertionError, QuadrlError)) else repr(error)
        raise QuadrlError(f"{where}: {said}") from error


def sealed_imports() -> list[dict[str, str]]:
    """The files of `--import` in this process: path, sha256, and the seal of both."""
    if not IMPORTED or not (key := _key()):
        return []
    return [
        {"path": str(path), "sha256": digest, "seal": _seal(key, str(path), digest)}
        for path, digest in IMPORTED.items()
    ]


def import_again(run: Mapping[str, Any], folder: Path) -> None:
    """Run the files of `--import` of a run, as they are now, unless they were given.

    A run of another user or machine runs nothing; where a task of it is missing, using it says so.

    Raises:
        QuadrlError: A file fails, as `import_own` says.
    """
    imports = _imports(run, folder)
    key = _key() if imports else None
    for path, was, seal in imports:
        # It may have moved, and be given by its new path.
        now = IMPORTED.get(path) or {own.name: x for own, x in IMPORTED.items()}.get(path.name)
        if now is None:
            own = key and hmac.compare_digest(_seal(key, str(path), was).encode(), seal.encode())
            if not own or not path.is_file():
                if run.get("task") in TASKS:
                    gone = "which is gone" if own else "which only who trained it runs unasked"
                    text = f"{folder} was trained with --import {path.name}, {gone}: give it"
                    warnings.warn(text, QuadrlWarning, stacklevel=3)
                continue
            import_own(path)
            now = IMPORTED[path.resolve()]
        if now != was:
            text = f"{path.name} is not what it was when {folder} was trained: flown as it is now"
            warnings.warn(text, QuadrlWarning, stacklevel=3)


def _imports(run: Mapping[str, Any], folder: Path) -> list[tuple[Path, str, str]]:
    """Path, digest and seal of each file that a run was trained with."""
    try:
        return [(Path(one["path"]), one["sha256"] + "", one["seal"] + "") for one in run["imports"]]
    except (KeyError, TypeError) as error:
        raise QuadrlError(f"{folder} does not say what it was trained with: imports") from error


def _aircraft(record: Mapping[str, Any], flown: Scenario) -> tuple[Any, ...]:
    """The aircraft of a record, that of its name today, and the one that is flown."""
    fields, known = record.get("vehicle"), presets.VEHICLES.get(flown.vehicle.name)
    if known is None or not isinstance(fields, Mapping):
        return {}, {}, {}
    was = specification.resolve(cast(Mapping[str, Any], fields), whole=True)
    if was.name != flown.vehicle.name:
        return {}, {}, {}
    with contextlib.suppress(QuadrlError):  # what was changed may not fit into that of today
        own = {name: getattr(was, name) for name in record["changed"].get("vehicle", ())}
        known = dataclasses.replace(known, **own)
        if "aircraft" in record and record.get("aerodynamics") == flown.aerodynamics:
            flew = specification.resolve(record["aircraft"], whole=True)
            return flew, presets.with_effects(known, flown.aerodynamics), flown.aircraft
    return was, known, flown.vehicle


def _task(record: Mapping[str, Any], flown: Scenario) -> tuple[Any, ...]:
    """The options of a record's task, those of its name today, and those that are flown."""
    if record.get("task") != flown.task.name or "task_options" not in record:
        return {}, {}, {}
    today, own = as_json(flown.task.usual()), record["changed"].get("task", ())
    was = today | dict(record["task_options"])
    return was, today | {name: was.get(name) for name in own}, flown.task.to_json()


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The numbers in JSON by their names, such as rotors[0].lag_up."""
    if isinstance(value, dict):
        for key, item in cast(dict[str, Any], value).items():
            yield from _flat(item, f"{name}.{key}" if name else key)
    elif isinstance(value, list) and any(isinstance(one, dict) for one in cast(list[Any], value)):
        for k, item in enumerate(cast(list[Any], value)):
            yield from _flat(item, f"{name}[{k}]")
    else:
        yield name, value


def _seal(key: bytes | None, *words: str) -> str:
    return hmac.new(key or b"", "\0".join(words).encode(), hashlib.sha256).hexdigest()


def _key() -> bytes | None:
    """The user's key, made on first use; None where no file can be kept from others."""
    file = cache_folder() / KEY
    try:
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            descriptor, scratch = tempfile.mkstemp(dir=file.parent)
            with os.fdopen(descriptor, "wb") as written:
                written.write(secrets.token_bytes(KEY_SIZE))
            with contextlib.suppress(FileExistsError):  # another process was first
                os.link(scratch, file)
            os.unlink(scratch)
        with open(os.open(file, os.O_RDONLY | os.O_NOFOLLOW), "rb") as opened:
            found, key = os.fstat(opened.fileno()), opened.read()
    except OSError:
        return None
    alone = found.st_uid == os.getuid() and not stat.S_IMODE(found.st_mode) & 0o077
    return key if alone and len(key) == KEY_SIZE else None
