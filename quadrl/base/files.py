"""Atomic writes, digests and checked reading of files, and locks of folders."""

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
import secrets
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from safetensors import SafetensorError

from quadrl.base.errors import QuadrlError

UNREADABLE = (SafetensorError, OSError, ValueError, TypeError, KeyError, AttributeError,
              RecursionError)  # fmt: skip
"""Errors that reading a damaged safetensors file and its header can raise."""
PART = ".part"
"""Suffix of a file that is still being written."""
NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)
"""Error numbers of a file system without locks."""
HEADER = "quadrl"
"""Key of the header, JSON, in a safetensors file's metadata; several keys would be written in
random order."""
BLANK = b"0" * 64
"""Placeholder of a digest while it is computed; it comes first in a file."""
DIGEST = re.compile(rb"digest\W{1,8}([0-9a-f]{64})")
"""Finds a digest in JSON, or in JSON within JSON."""


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole or not at all: the old one stays until the new one is on the disk.

    Nobody can guess the name under which it is written at first and put a link there.
    """
    scratch = path.with_name(f"{path.name}.{secrets.token_hex(8)}{PART}")
    try:
        with open(scratch, "xb") as file:
            file.write(content)
        put(scratch, path)
    except BaseException:
        with contextlib.suppress(OSError):
            scratch.unlink()
        raise


def write_json(path: Path, content: Any) -> None:
    """Write a value as JSON, whole or not at all."""
    write_whole(path, json.dumps(content, indent=2).encode())


def write_csv(path: Path, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a .csv file of rows under the names of their columns, whole or not at all."""
    write_whole(in_a_folder(path), csv_content([head, *rows]))


def csv_content(rows: Iterable[Sequence[Any]]) -> bytes:
    """The content of a .csv file; the first row is its head."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows(rows)
    return text.getvalue().encode()


def put(written: Path, path: Path) -> None:
    """Sync a file to the disk, move it within its file system, and sync the folder."""
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
    """The path, or the first of NAME-2, NAME-3 and so on that does not exist yet.

    With `holding`, a folder exists if it has a file of that name.
    """
    names = (path.with_name(f"{path.stem}-{k}{path.suffix}") for k in itertools.count(2))
    return next(x for x in itertools.chain([path], names) if not (x / holding).exists())


def in_a_folder(path: str | os.PathLike[str]) -> Path:
    """The path of a file to be written, whose folder exists: asked before the work for its content.

    Raises:
        QuadrlError: There is no such folder; a mistyped one is not made.
    """
    path = Path(path)
    if not path.parent.is_dir():
        reason = f"there is no folder {path.parent}; make it first"
        raise QuadrlError(f"{path} cannot be written: {reason}")
    return path


def lock(folder: Path) -> int:
    """Lock a folder against other processes while the returned descriptor is open.

    Raises:
        BlockingIOError: Another one holds the lock.
        OSError: The folder cannot be opened, or its file system has no locks (NO_LOCKS).
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


def is_sealed(content: bytes) -> bool:
    """Whether a file has a digest, and it matches its other bytes."""
    if (found := DIGEST.search(content)) is None:
        return False
    blank = content[: found.start(1)] + BLANK + content[found.end(1) :]
    return hashlib.sha256(blank).hexdigest().encode() == found[1]


def check_seal(path: Path, content: bytes) -> None:
    """Refuse a file whose content does not match its digest.

    Raises:
        QuadrlError: The digest is missing or does not match.
    """
    if not is_sealed(content):
        raise QuadrlError(f"{path} is damaged, or was changed after it was written: restore it")


def check_texts(value: Any) -> None:
    """Refuse a value of a file with a text that a terminal would not show as it is.

    Raises:
        ValueError: A text in it, at any depth, holds control characters other than line breaks.
    """
    if isinstance(value, str):
        if not re.sub(r"[\n\t]", "", value).isprintable():
            raise ValueError(f"the text {value[:60]!r} holds control characters")
    elif isinstance(value, Mapping):
        table = cast(Mapping[str, Any], value)
        check_texts([*table.keys(), *table.values()])
    elif isinstance(value, list):
        for one in cast(list[Any], value):
            check_texts(one)


def write_sealed_json(path: Path, content: Mapping[str, Any], form: str) -> None:
    """Write a mapping as JSON, with its format and a digest."""
    sealed = {"digest": BLANK.decode(), "format": form, **content}
    write_sealed(path, json.dumps(sealed, indent=2).encode())


def another_format(path: Path, written: Any, *read: str) -> QuadrlError:
    """The error about a file of another format than those that can be read."""
    reason = "another version of quadrl wrote it" if written else "quadrl did not write it"
    return QuadrlError(reason, name=f"format of {path}", value=written, allowed=" or ".join(read))


def read_sealed_json(path: Path, form: str) -> dict[str, Any]:
    """Read what `write_sealed_json` wrote.

    Raises:
        QuadrlError: The file cannot be read, is damaged, holds no mapping, or has another format.
    """
    try:
        content = path.read_bytes()
        found = json.loads(content)
        check_texts(found)
    except (OSError, ValueError, RecursionError) as error:
        raise QuadrlError(f"{path} cannot be read: {error}") from error
    if not isinstance(found, dict):
        raise QuadrlError(f"{path} must hold a table")
    table = cast(dict[str, Any], found)
    if (written := table.get("format")) != form:
        raise another_format(path, written, form)
    check_seal(path, content)
    return {name: value for name, value in table.items() if name not in ("digest", "format")}


def write_safetensors(
    path: Path, arrays: dict[str, Any], header: dict[str, Any], to_bytes: Callable[..., bytes]
) -> None:
    """Write arrays and a header, with a digest of both.

    Args:
        path: The file.
        arrays: Arrays of one framework, by name.
        header: A mapping that JSON can hold; its `format` says what the file is.
        to_bytes: `save` of the safetensors module for that framework.
    """
    text = json.dumps({"digest": BLANK.decode(), **header})
    write_sealed(path, to_bytes(arrays, metadata={HEADER: text}))


def read_safetensors(
    path: Path, wanted: Sequence[str], of_bytes: Callable[[bytes], dict[str, Any]]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read the arrays of a safetensors file, and the header that quadrl wrote into its metadata.

    Args:
        path: The file.
        wanted: Formats that the header may name.
        of_bytes: `load` of the safetensors module for a framework.

    Raises:
        QuadrlError: The file cannot be read, is damaged, or has another format.
    """
    try:
        content = path.read_bytes()
        size = int.from_bytes(content[:8], "little")
        table: dict[str, Any] = json.loads(content[8 : 8 + size])
        metadata: dict[str, str] = table.get("__metadata__") or {}
        header: Any = json.loads(metadata.get(HEADER, "{}"))
        check_texts(header)
        written = header.get("format")
        if written not in wanted:
            raise another_format(path, written, *wanted)
        check_seal(path, content)
        return of_bytes(content), header
    except QuadrlError:
        raise
    except UNREADABLE as error:
        raise QuadrlError(f"{path} is damaged or not a safetensors file: {error}") from error


def read_table(path: Path, what: str) -> dict[str, Any]:
    """Read a .toml or .json file that holds a mapping.

    Args:
        path: The file.
        what: What the file is, for the error message about another kind of file.

    Raises:
        QuadrlError: It cannot be read, or is not such a file.
    """
    if path.suffix not in (".toml", ".json"):
        raise QuadrlError(name=what, value=str(path), allowed="a .toml or a .json file")
    try:
        text = path.read_text(encoding="utf-8")
        content: Any = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
        check_texts(content)
    except OSError as error:
        raise QuadrlError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise QuadrlError(f"{path} is not {path.suffix[1:].upper()}: {reason}") from error
    if not isinstance(content, dict):
        raise QuadrlError(f"{path} must hold a table of names and values")
    return cast(dict[str, Any], content)
