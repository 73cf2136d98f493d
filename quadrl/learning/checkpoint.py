"""Checkpoints from which training goes on bit for bit.

A checkpoint is one safetensors file, so that reading it runs nothing: tensors by name, and a
header of JSON. It is written whole or not at all.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save as to_bytes

from quadrl.learning.config import RunError
from quadrl.policy import HEADER, UNREADABLE, read_header, write_whole

FORMAT = "quadrl-checkpoint-2"
CHECKPOINT = "checkpoint.safetensors"


def save(path: Path, tensors: dict[str, Any], numbers: dict[str, Any]) -> None:
    """Write a checkpoint.

    Args:
        path: The file; the one that stands there is replaced once the new one is on the disk.
        tensors: Tensors and arrays, nested dicts of them allowed.
        numbers: Whatever JSON can hold.
    """
    flat = {name: tensor.detach().clone() for name, tensor in _flatten(tensors)}
    header = {"format": FORMAT, "numbers": numbers}
    write_whole(path, to_bytes(flat, metadata={HEADER: json.dumps(header)}))


def load(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a checkpoint: its tensors (nested as they were saved) and numbers.

    Raises:
        RunError: There is none, it is damaged, or of another version.
    """
    if not path.is_file():
        raise RunError(f"there is no checkpoint at {path}")
    try:
        with safe_open(path, framework="pt") as opened:
            header = read_header(opened.metadata())
            names = opened.keys() if header.get("format") == FORMAT else ()
            flat = {name: opened.get_tensor(name) for name in names}
    except UNREADABLE as error:
        raise RunError(f"{path} is damaged or no checkpoint: {error}") from error
    if header.get("format") != FORMAT:
        raise RunError(
            f"{path} has the format {header.get('format')!r}; this version of quadrl reads "
            f"{FORMAT!r}"
        )
    tensors: dict[str, Any] = {}
    for name, tensor in flat.items():
        *folders, last = name.split("/")
        into = tensors
        for folder in folders:
            into = into.setdefault(folder, {}) if isinstance(into, dict) else None
        if not isinstance(into, dict) or last in into:
            raise RunError(f"{path} is damaged: it holds {name!r} twice, or within a tensor")
        into[last] = tensor
    if not isinstance(numbers := header.get("numbers"), dict):
        raise RunError(f"{path} is damaged: its header lacks the numbers")
    return tensors, numbers


def _flatten(tensors: dict[str, Any], prefix: str = "") -> list[tuple[str, torch.Tensor]]:
    flat: list[tuple[str, torch.Tensor]] = []
    for name, value in tensors.items():
        if isinstance(value, dict):
            flat += _flatten(value, f"{prefix}{name}/")
        elif isinstance(value, torch.Tensor):
            flat.append((prefix + str(name), value))
        else:
            flat.append((prefix + str(name), torch.from_numpy(np.array(value))))
    return flat
