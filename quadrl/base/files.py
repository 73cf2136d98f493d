"""Files that are written whole or not at all, with a digest, and read with care; locks."""

from __future__ import annotations

import contextlib
import csv
import errno
import fcntl
import hashlib
import io
import itertools
import json
import os
import re
import tomllib
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from safetensors import SafetensorError

from quadrl.base.errors import QuadrlError, QuadrlWarning

UNREADABLE = (SafetensorError, OSError, ValueError, TypeError, KeyError, AttributeError,
              RecursionError)  # fmt: skip
"""What reading a damaged safetensors file and its header can raise."""
PART = ".part"
"""Behind the name of a file that is not whole yet."""
NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)
"""What a file system without locks says."""
HEADER = "quadrl"
"""The one entry of the file's table, JSON: safetensors writes several in random order."""
BLANK = b"0" * 64
"""What stands in place of a digest while it is worked out: it comes first in a file."""
DIGEST = re.compile(rb"digest\W{1,8}([0-9a-f]{64})")
"""In JSON, or in JSON within JSON."""


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole or not at all: the old one stays until the new one is on the disk."""
    scratch = path.with_name(path.name + PART)
    try:
        scratch.write_bytes(content)
        put(scratch, path)
    except BaseException:
        with contextlib.suppress(OSError):
            scratch.unlink()
        raise


def write_json(path: Path, content: Any) -> None:
    """Write what JSON can hold, whole or not at all."""
    write_whole(path, json.dumps(content, indent=2).encode())


def write_csv(path: Path, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write rows under the names of their columns, whole or not at all."""
    write_whole(path, csv_content([head, *rows]))


def csv_content(rows: Iterable[Sequence[Any]]) -> bytes:
    """The content of a .csv file, its head first."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(rows)
    return text.getvalue().encode()


def put(written: Path, path: Path) -> None:
    """Move a file within its file system once it is on the disk, and sync the folder."""
    _sync(written)
    os.replace(written, path)
    with contextlib.suppress(OSError):  # not every file system can do that with a folder
        _sync(path.parent)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def free_name(path: Path, holding: str = "") -> Path:
    """The path, or the first of NAME-2, NAME-3 and so on that is not there yet.

    A folder counts as there with a file of the name `holding` in it.
    """
    names = (path.with_name(f"{path.stem}-{k}{path.suffix}") for k in itertools.count(2))
    return next(x for x in itertools.chain([path], names) if not (x / holding).exists())


def lock(folder: Path) -> int:
    """Lock a folder against other processes while the returned descriptor is open.

    Raises:
        BlockingIOError: Another one holds the lock.
        OSError: The folder cannot be opened, or its file system has no such locks (NO_LOCKS).
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def write_sealed(path: Path, content: bytes) -> None:
    """Write a file with the digest of all its other bytes in place of BLANK, its first digest."""
    digest = hashlib.sha256(content).hexdigest().encode()
    write_whole(path, content.replace(BLANK, digest, 1))


def is_sealed(content: bytes) -> bool | None:
    """Whether the digest of a file is that of its other bytes; None where it has no digest."""
    if (found := DIGEST.search(content)) is None:
        return None
    blank = content[: found.start(1)] + BLANK + content[found.end(1) :]
    return hashlib.sha256(blank).hexdigest().encode() == found[1]


def check_seal(path: Path, content: bytes, *, unsealed: bool) -> None:
    """Refuse a file that is not as it was written.

    Args:
        path: Its path.
        content: Its bytes.
        unsealed: Whether it is of an earlier format, which has no digest.

    Raises:
        QuadrlError: A digest is missing, or another one.
    """
    sound = is_sealed(content)
    if sound is None and unsealed:
        text = f"{path} is of an earlier quadrl and has no digest: damage to it would not be seen"
        warnings.warn(text, QuadrlWarning, stacklevel=3)
    elif not sound:
        raise QuadrlError(f"{path} is damaged, or was changed after it was written: restore it")


def write_sealed_json(path: Path, content: Mapping[str, Any], form: str) -> None:
    """Write a table as JSON, with a format and a digest."""
    sealed = {"digest": BLANK.decode(), "format": form, **content}
    write_sealed(path, json.dumps(sealed, indent=2).encode())


def read_sealed_json(path: Path, form: str, *, unsealed: bool = True) -> dict[str, Any]:
    """Read what `write_sealed_json` wrote.

    Args:
        path: The file.
        form: Its format.
        unsealed: Whether it may be a table of an earlier quadrl, without a digest.

    Raises:
        QuadrlError: The file cannot be read, is no table, of another format, or damaged.
    """
    try:
        content = path.read_bytes()
        found = json.loads(content)
    except (OSError, ValueError, RecursionError) as error:
        raise QuadrlError(f"{path} cannot be read: {error}") from error
    if not isinstance(found, dict):
        raise QuadrlError(f"{path} must hold a table")
    table = cast(dict[str, Any], found)
    check_seal(path, content, unsealed=unsealed and "format" not in table)
    if (written := table.get("format", form)) != form:
        raise QuadrlError(name=f"format of {path}", value=written, allowed=form)
    return {name: value for name, value in table.items() if name not in ("digest", "format")}


def write_safetensors(
    path: Path, arrays: dict[str, Any], header: dict[str, Any], to_bytes: Callable[..., bytes]
) -> None:
    """Write arrays and a header, with a digest of both.

    Args:
        path: The file.
        arrays: Arrays of one framework, by name.
        header: What JSON can hold; its `format` says what the file is.
        to_bytes: `save` of the framework's module of safetensors.
    """
    text = json.dumps({"digest": BLANK.decode(), **header})
    write_sealed(path, to_bytes(arrays, metadata={HEADER: text}))


def read_safetensors(
    path: Path,
    wanted: Sequence[str],
    unsealed: Sequence[str],
    of_bytes: Callable[[bytes], dict[str, Any]],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays of a safetensors file, and the header that quadrl wrote into its table.

    Args:
        path: The file.
        wanted: What the header's format may be.
        unsealed: Earlier formats, of files without a digest.
        of_bytes: `load` of a framework's module of safetensors.

    Raises:
        QuadrlError: The file cannot be read, is damaged, or of another format.
    """
    try:
        content = path.read_bytes()
        size = int.from_bytes(content[:8], "little")
        table: dict[str, Any] = json.loads(content[8 : 8 + size])
        metadata: dict[str, str] = table.get("__metadata__") or {}
        header: Any = json.loads(metadata.get(HEADER, "{}"))
        written = header.get("format")
        if written not in (*wanted, *unsealed):
            allowed = " or ".join(wanted)
            raise QuadrlError(name=f"format of {path}", value=written, allowed=allowed)
        check_seal(path, content, unsealed=written in unsealed)
        return of_bytes(content), header
    except QuadrlError:
        raise
    except UNREADABLE as error:
        raise QuadrlError(f"{path} is damaged or not a safetensors file: {error}") from error


def read_table(path: Path, what: str) -> dict[str, Any]:
    """The content of a .toml or .json file that holds a table.

    Args:
        path: The file.
        what: It is, for the refusal of another kind of file.

    Raises:
        QuadrlError: It cannot be read, or is no such file.
    """
    if path.suffix not in (".toml", ".json"):
        raise QuadrlError(name=what, value=str(path), allowed="a .toml or a .json file")
    try:
        text = path.read_text(encoding="utf-8")
        content: Any = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except OSError as error:
        raise QuadrlError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise QuadrlError(f"{path} is not {path.suffix[1:].upper()}: {reason}") from error
    if not isinstance(content, dict):
        raise QuadrlError(f"{path} must hold a table of names and values")
    return cast(dict[str, Any], content)
