"""A trained policy as numbers: NumPy in, NumPy out, no torch.

The file is safetensors: arrays and a table of strings, nothing that could run. Its network is the
paper's: hidden layers of tanh, and the mean and the log-variance of a normal distribution over
the actions; observations are normalised with the mean and the deviation of the training.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from quadrl.errors import QuadrlError
from quadrl.vehicle import ROTORS

FORMAT = "quadrl-policy-1"
FILE = "policy.safetensors"
CLIP = 10.0
"""Normalised observations are held within +-CLIP."""
LOG_VARIANCE = (-12.0, 2.0)
"""Within which the log-variance of the actions is held."""
SHIPPED = Path(__file__).parent / "assets" / "policies"
"""The policies that come with the package: TASK_ALGO.safetensors, with a .json beside each."""

UNREADABLE = (SafetensorError, OSError, ValueError, TypeError, KeyError, AttributeError,
              RecursionError)  # fmt: skip
"""What reading a damaged safetensors file and its header can raise."""
HEADER = "quadrl"
"""The one entry of the file's table, JSON: of several, safetensors writes the order at random."""


class PolicyError(QuadrlError, ValueError):
    """A file that is no policy of quadrl, or a policy for something else."""


@dataclasses.dataclass(frozen=True)
class Policy:
    """The mean action of a trained network."""

    weights: tuple[np.ndarray, ...]
    """Of each layer, (outputs, inputs); the last gives mean and log-variance, (2 * 4, hidden)."""
    biases: tuple[np.ndarray, ...]
    """Of each layer, (outputs,)."""
    mean: np.ndarray
    """Of the observations in training, (size,)."""
    deviation: np.ndarray
    """Of the observations in training, (size,)."""
    task: str
    """The task that it was trained for."""
    metadata: dict[str, Any] = dataclasses.field(default_factory=dict)
    """How it was made: algorithm, seed, steps, vehicle, action interface."""

    @property
    def action(self) -> str:
        """The action interface that it was trained with."""
        return str(self.metadata.get("action", "rotor"))

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The mean action.

        Args:
            observation: Flat vector (..., size) in the order of the task's parts.

        Returns:
            Actions (..., 4), within [-1, 1].

        Raises:
            ValueError: The observation has another size.
        """
        return np.clip(self._outputs(observation)[0], -1.0, 1.0)

    def sampled(self, seed: int) -> Callable[[np.ndarray], np.ndarray]:
        """The stochastic policy: observations as for the mean action to actions drawn anew.

        They are drawn as in training: from a normal distribution, and clipped to [-1, 1].

        Args:
            seed: Of the draws.
        """
        generator = np.random.default_rng(seed)

        def act(observation: np.ndarray) -> np.ndarray:
            mean, log_variance = self._outputs(observation)
            deviation = np.exp(0.5 * np.clip(log_variance, *LOG_VARIANCE))
            return np.clip(mean + deviation * generator.standard_normal(mean.shape), -1.0, 1.0)

        return act

    def _outputs(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and log-variance (..., 4) of the actions."""
        observation = np.asarray(observation, dtype=np.float32)
        if observation.shape[-1:] != self.mean.shape:
            raise ValueError(
                f"an observation of shape {observation.shape} was given; the policy for "
                f"{self.task} expects (..., {len(self.mean)})"
            )
        hidden = np.clip((observation - self.mean) / self.deviation, -CLIP, CLIP)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = np.tanh(hidden @ weight.T + bias)
        output = hidden @ self.weights[-1].T + self.biases[-1]
        half = output.shape[-1] // 2
        return output[..., :half], output[..., half:]

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        arrays = {"mean": self.mean, "deviation": self.deviation}
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays |= {f"weight_{k}": weight, f"bias_{k}": bias}
        arrays = {k: np.ascontiguousarray(v, dtype=np.float32) for k, v in arrays.items()}
        header = {"format": FORMAT, "task": self.task, "metadata": self.metadata}
        write_whole(Path(path), save(arrays, metadata={HEADER: json.dumps(header)}))

    @classmethod
    def load(cls, path: str | Path) -> Policy:
        """Read a policy; nothing in the file is run.

        Args:
            path: A .safetensors file, or a run folder that holds policy.safetensors.

        Raises:
            PolicyError: There is no such file, or it is damaged, or no policy of quadrl.
        """
        path = Path(path)
        file = path / FILE if path.is_dir() else path
        if not file.is_file():
            raise PolicyError(
                f"no policy at {file}; give a run folder (quadrl train ... --out FOLDER makes one) "
                "or a .safetensors file"
            )
        try:
            with safe_open(file, framework="numpy") as opened:
                header = read_header(opened.metadata())
                names = opened.keys() if header.get("format") == FORMAT else ()
                arrays = {name: opened.get_tensor(name) for name in names}
        except UNREADABLE as error:
            raise PolicyError(f"{file} is damaged or no safetensors file: {error}") from error
        if header.get("format") != FORMAT:
            raise PolicyError(
                f"{file} is no policy of this version of quadrl: its format is "
                f"{header.get('format')!r}, {FORMAT!r} is expected"
            )
        return cls._of_arrays(file, arrays, header)

    @classmethod
    def pretrained(cls, task: str, algo: str = "ppo") -> Policy:
        """A policy that comes with the package; how it was made stands in the .json beside it.

        Args:
            task: The task that it was trained for.
            algo: The algorithm that it was trained with.

        Raises:
            PolicyError: There is none; the message lists those that there are.
        """
        file = SHIPPED / f"{task}_{algo}.safetensors"
        if file not in (there := shipped()):
            names = ", ".join("{} with {}".format(*known.stem.rsplit("_", 1)) for known in there)
            raise PolicyError(
                f"no policy comes with quadrl for {task} with {algo}; choices: {names or 'none'}; "
                f"or train one with quadrl train {task} --algo {algo}"
            )
        return cls.load(file)

    @classmethod
    def _of_arrays(
        cls, file: Path, arrays: dict[str, np.ndarray], header: dict[str, Any]
    ) -> Policy:
        """Check that the arrays make a network, and build it."""
        try:
            layers = max(1, len(arrays) // 2 - 1)
            weights = tuple(arrays[f"weight_{k}"] for k in range(layers))
            biases = tuple(arrays[f"bias_{k}"] for k in range(layers))
            mean, deviation = arrays["mean"], arrays["deviation"]
            task, metadata = header["task"], header["metadata"]
        except KeyError as error:
            raise PolicyError(f"{file} lacks a part of a policy: {error}") from error
        width = mean.size
        sound = mean.shape == deviation.shape == (width,) and len(arrays) == 2 * layers + 2
        for weight, bias in zip(weights, biases, strict=True):
            sound = sound and weight.shape == (bias.size, width) and bias.shape == (bias.size,)
            width = bias.size
        numbers = all(a.dtype == np.float32 and np.isfinite(a).all() for a in arrays.values())
        if not sound or not numbers or width != 2 * ROTORS or not (deviation > 0).all():
            raise PolicyError(f"{file}: the arrays in it do not make a policy network")
        if not _stays_finite(weights, biases):
            raise PolicyError(f"{file}: its weights are so large that its actions are no numbers")
        known = isinstance(task, str) and isinstance(metadata, dict)
        if not known or not isinstance(metadata.get("task_options", {}), dict):
            raise PolicyError(f"{file} does not say what the policy was trained for")
        return cls(weights, biases, mean, deviation, task, metadata)


def _stays_finite(weights: tuple[np.ndarray, ...], biases: tuple[np.ndarray, ...]) -> bool:
    """Whether no observation makes a sum in the network larger than single precision holds."""
    largest = CLIP
    for weight, bias in zip(weights, biases, strict=True):
        sums = largest * np.abs(weight, dtype=np.float64).sum(axis=1) + np.abs(bias)
        if not (sums < np.finfo(np.float32).max / 2).all():
            return False
        largest = 1.0  # of tanh
    return True


def shipped() -> list[Path]:
    """The files of the policies that come with the package, by name."""
    return sorted(SHIPPED.glob("*.safetensors"))


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole or not at all: what stood there stays until the new one is on the disk."""
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


def read_header(table: dict[str, str] | None) -> dict[str, Any]:
    """What `HEADER` says in the table of a safetensors file; nothing when it is not there.

    Raises:
        ValueError: It is no JSON.
    """
    header = json.loads((table or {}).get(HEADER, "{}"))
    return header if isinstance(header, dict) else {}
