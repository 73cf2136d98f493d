"""Files that are written whole or not at all, and safetensors files that are read with care."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from quadrl.errors import QuadrlError

UNREADABLE = (SafetensorError, OSError, ValueError, TypeError, KeyError, AttributeError,
              RecursionError)  # fmt: skip
"""What reading a damaged safetensors file and its header can raise."""
HEADER = "quadrl"
"""The one entry of the file's table, JSON: safetensors writes several in random order."""


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole or not at all: the old one stays until the new one is on the disk."""
    scratch = path.with_name(path.name + ".part")
    try:
        with open(scratch, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(scratch, path)
    except BaseException:
        with contextlib.suppress(OSError):
            scratch.unlink()
        raise


def read_safetensors(
    path: Path, wanted: Sequence[str], framework: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays of a safetensors file, and the header that quadrl wrote into its table.

    Args:
        path: The file.
        wanted: What the header's format may be.
        framework: "numpy" or "pt".

    Raises:
        QuadrlError: The file cannot be read, or is of another format.
    """
    try:
        with safe_open(path, framework=framework) as opened:
            header = json.loads((opened.metadata() or {}).get(HEADER, "{}"))
            written = header.get("format")
            names = opened.keys() if written in wanted else ()
            arrays = {name: opened.get_tensor(name) for name in names}
    except UNREADABLE as error:
        raise QuadrlError(f"{path} is damaged or not a safetensors file: {error}") from error
    if written not in wanted:
        allowed = " or ".join(wanted)
        raise QuadrlError(name=f"format of {path}", value=written, allowed=allowed)
    return arrays, header
