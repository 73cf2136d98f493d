"""Checkpoints from which training continues bit for bit.

A checkpoint is one safetensors file, so that reading it runs nothing: tensors by name, and a
header of JSON. It is written completely or not at all.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from safetensors.torch import load as of_bytes
from safetensors.torch import save as to_bytes
from tensordict import TensorDict
from torch import nn

from quadrl.base.errors import QuadrlError
from quadrl.base.files import read_safetensors, write_safetensors
from quadrl.learning.defaults import flat
from quadrl.learning.folder import CHANGEABLE
from quadrl.learning.folder import CHECKPOINT as CHECKPOINT

AT_GOAL = ("at_goal", "looks")
CHANGED = ("scenario.changed.task", "scenario.changed.vehicle")
"""Not what is flown, but how it differed from what its names meant when it was saved."""
FORMAT = "quadrl-checkpoint-7"


def save(path: Path, tensors: dict[str, Any], numbers: dict[str, Any]) -> None:
    """Write a checkpoint.

    Args:
        path: The file; it replaces an old one once it is on the disk.
        tensors: Tensors and arrays, in nested dicts.
        numbers: Whatever JSON can hold.
    """
    flat = TensorDict(tensors).flatten_keys("/").contiguous().clone()  # as safetensors demands
    header = {"format": FORMAT, "numbers": numbers}
    write_safetensors(path, flat.to_dict(), header, to_bytes)


def load(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a checkpoint: its tensors, nested as they were saved, and its numbers.

    Raises:
        QuadrlError: The file is missing, damaged or of another version.
    """
    if not path.is_file():
        raise QuadrlError(f"there is no checkpoint at {path}")
    flat, header = read_safetensors(path, (FORMAT,), of_bytes)
    try:
        tensors = TensorDict(flat).unflatten_keys("/").to_dict()
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise QuadrlError(f"{path} is damaged: {error}") from error
    if not isinstance(numbers := header.get("numbers"), dict):
        raise QuadrlError(f"{path} is damaged: its header lacks the numbers")
    return tensors, numbers


def begin_with(path: Path, actor: nn.Module, critic: nn.Module) -> None:
    """Load the weights and the normalisers of a checkpoint into the networks.

    A policy that holds the goal keeps its own observation at the goal, which may be another one.

    Raises:
        QuadrlError: The file cannot be read, or the networks are of other sizes.
    """
    tensors, _ = load(path)
    for name, network in (("actor", actor), ("critic", critic)):
        given = {k: v for k, v in tensors[name].items() if k.rpartition(".")[2] not in AT_GOAL}
        own = {k: v for k, v in network.state_dict().items() if k.rpartition(".")[2] in AT_GOAL}
        try:
            network.load_state_dict(given | own)
        except RuntimeError as error:
            reason = f"its {name} sees other numbers than this training's, or has other layers"
            allowed, folder = f"a run whose {name} is alike", str(path.parent)
            raise QuadrlError(reason, name="from", value=folder, allowed=allowed) from error


def check_same(path: Path, saved: dict[str, Any], present: dict[str, Any]) -> None:
    """Refuse a checkpoint whose settings lead to another policy than the present ones.

    Args:
        path: The checkpoint.
        saved: Its resolved configuration.
        present: The configuration to continue it with.

    Raises:
        QuadrlError: A setting differs.
    """
    was, now = dict(flat(saved)), dict(flat(present))
    for name in was | now:
        free = name.partition(".")[0] in CHANGEABLE or name in CHANGED
        if was.get(name) != now.get(name) and not free:
            reason = f"{path} was trained with it; restore that setting or start a new run"
            value = now.get(name, present.get(name))
            raise QuadrlError(reason, name=name, value=value, allowed=repr(was.get(name)))
