"""The file of a policy: safetensors, arrays and a table of strings, nothing that could run."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load as of_bytes
from safetensors.numpy import save as to_bytes

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.files import read_safetensors, write_safetensors
from quadrl.evaluation.memory import GRU, NAMES, PREFIX

FORMAT, RECURRENT_FORMAT = "quadrl-policy-3", "quadrl-policy-gru-2"
FILE, RUN, RUN_FORMAT = "policy.safetensors", "config.json", "quadrl-run-2"
"""In the folder of a run: its policy, and its settings."""
SHIPPED = Path(__file__).parents[1] / "assets" / "policies"
"""The policies that come with the package: TASK_ALGO.safetensors, or TASK_VARIANT.safetensors for a
variant of the training, with a .json beside each."""
SHIPPED_AS = {"vpg": "gae"}
"""Algorithms that the file names call otherwise: the paper's word for the policy gradient."""
CLIP = 10.0
"""Normalised observations are clipped to +-CLIP."""
LARGEST = 1e30
"""Bound of every number: what a layer adds up from inputs within CLIP then stays finite."""
PARTS = ("weight", "bias")


def arrays_of(policy: Any) -> dict[str, np.ndarray]:
    """The arrays of a policy by their names in its file."""
    arrays = {"mean": policy.mean, "deviation": policy.deviation}
    for k, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        arrays |= {f"weight_{k}": weight, f"bias_{k}": bias}
    arrays |= policy.memory.arrays() if policy.memory else {}
    return {k: np.ascontiguousarray(v, dtype=np.float32) for k, v in arrays.items()}


def parts_of(arrays: Mapping[str, np.ndarray], layers: int) -> dict[str, Any]:
    """The fields of a policy that `arrays_of` took apart."""
    weights, biases = (tuple(arrays[f"{p}_{k}"] for k in range(layers)) for p in PARTS)
    own = {k.removeprefix(PREFIX): arrays[k] for k in NAMES if k in arrays}
    parts = {"weights": weights, "biases": biases, "memory": GRU(**own) if own else None}
    return parts | {name: arrays[name] for name in ("mean", "deviation")}


def write(path: Path, policy: Any) -> None:
    """Write the file of a policy, whole or not at all."""
    arrays = arrays_of(policy)
    header = {"format": RECURRENT_FORMAT if policy.memory else FORMAT}
    header |= {"task": policy.task, "metadata": policy.metadata}
    write_safetensors(path, arrays, header, to_bytes)


def read(path: Path) -> dict[str, Any]:
    """The fields of the policy in a file, or in the folder of a run.

    Raises:
        QuadrlError: The file is missing, damaged or not a policy of quadrl.
    """
    file = path / FILE if path.is_dir() else path
    if not file.is_file():
        if (path / RUN).is_file():
            raise QuadrlError(
                f"the run in {path} has no policy yet, since it was stopped before its first "
                f"checkpoint; continue it: quadrl train --resume {path}"
            )
        raise QuadrlError(
            f"there is no policy at '{file}'; give a run folder (quadrl train ... --out FOLDER "
            "makes one) or a .safetensors file"
        )
    arrays, header = read_safetensors(file, (FORMAT, RECURRENT_FORMAT), of_bytes)
    task, metadata = header.get("task"), header.get("metadata")
    options = metadata.get("task_options", {}) if isinstance(metadata, dict) else None
    if not (isinstance(task, str) and isinstance(metadata, dict) and isinstance(options, dict)):
        raise QuadrlError(f"{file} does not say what its policy was trained for")
    own = NAMES if header["format"] == RECURRENT_FORMAT else ()
    if not {*NAMES[4:]} & {*arrays}:  # a unit without a layer before it
        own = own[:4]
    layers = max(1, (len(arrays) - len(own)) // 2 - 1)
    names = ("mean", "deviation", *(f"{p}_{k}" for k in range(layers) for p in PARTS), *own)
    if set(arrays) != set(names):
        raise QuadrlError(f"{file} is damaged: its arrays are {', '.join(sorted(arrays))}")
    parts = parts_of(arrays, layers)
    if not _is_network(**parts):
        raise QuadrlError(f"{file} is damaged: its arrays do not make a policy network")
    return {**parts, "task": task, "metadata": metadata}


def warn_of_another_run(folder: Path, run: dict[str, Any], own: dict[str, Any]) -> None:
    """Warn the caller's caller where a policy is not of the run in whose folder it is."""
    for name in ("task", "algo", "seed", "run"):
        if name in own and name in run and own[name] != run[name]:
            text = f"the policy in {folder} is not of the run there: its {name} is "
            text += f"{own[name]}, that of the run {run[name]}"
            warnings.warn(text, QuadrlWarning, stacklevel=3)
            return


def _is_network(
    weights: tuple[np.ndarray, ...],
    biases: tuple[np.ndarray, ...],
    memory: GRU | None,
    mean: np.ndarray,
    deviation: np.ndarray,
) -> bool:
    """Whether the arrays fit together and no observation makes an output that is not finite."""
    arrays = (*weights, *biases, mean, deviation, *(memory.arrays().values() if memory else ()))
    # NaN is not smaller either.
    sound = all(a.dtype == np.float32 and (np.abs(a) < LARGEST).all() for a in arrays)
    width = mean.size
    if not sound or not mean.shape == deviation.shape == (width,) or not (deviation > 0).all():
        return False
    if memory:
        if not memory.fits(width):
            return False
        width = memory.width + width * (not memory.alone)
    for weight, bias in zip(weights, biases, strict=True):
        if bias.ndim != 1 or weight.shape != (bias.size, width):
            return False
        width = bias.size
    return width > 0 and width % 2 == 0


def shipped() -> list[Path]:
    """The files of the policies that come with the package, by name."""
    return sorted(SHIPPED.glob("*.safetensors"))
