"""A trained policy as numbers: NumPy in, NumPy out, no torch.

The file is safetensors: arrays and a table of strings, nothing that could run. The network is the
paper's: hidden layers of tanh, then the mean and the log-variance of a normal distribution over the
actions. Observations are normalised with the mean and the deviation of the training.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from quadrl.errors import QuadrlError
from quadrl.validation import choice
from quadrl.vehicle import VEHICLES

if TYPE_CHECKING:
    from quadrl.environment import Environment

FORMAT = "quadrl-policy-2"
FILE = "policy.safetensors"
CLIP = 10.0
"""Normalised observations are clipped to +-CLIP."""
LOG_VARIANCE = (-12.0, 2.0)
"""Bounds of the log-variance of the actions."""
SHIPPED = Path(__file__).parent / "assets" / "policies"
"""The policies that come with the package: TASK_ALGO.safetensors, with a .json beside each."""
SHIPPED_AS = {"vpg": "gae"}
"""Algorithms that the file names call otherwise: the paper's word for the policy gradient."""

UNREADABLE = (SafetensorError, OSError, ValueError, TypeError, KeyError, AttributeError,
              RecursionError)  # fmt: skip
"""What reading a damaged safetensors file and its header can raise."""
HEADER = "quadrl"
"""The one entry of the file's table, JSON: safetensors writes several in random order."""


@dataclasses.dataclass(frozen=True)
class Policy:
    """The mean action of a trained network."""

    weights: tuple[np.ndarray, ...]
    """Of each layer, (outputs, inputs); the last gives k means and k log-variances, (2 k, ...)."""
    biases: tuple[np.ndarray, ...]
    """Of each layer, (outputs,)."""
    mean: np.ndarray
    """Of the observations in training, (size,)."""
    deviation: np.ndarray
    """Of the observations in training, (size,)."""
    task: str
    """The task that it was trained for."""
    metadata: dict[str, Any] = dataclasses.field(default_factory=dict)
    """How it was made: algo, seed, steps, vehicle, rotors, control_mode, task_options."""

    @property
    def control_mode(self) -> str:
        """What its actions mean."""
        return str(self.metadata.get("control_mode", "rotor"))

    @property
    def size(self) -> int:
        """Numbers in an observation."""
        return len(self.mean)

    @property
    def action_size(self) -> int:
        """Numbers in an action, k."""
        return len(self.biases[-1]) // 2

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The mean action.

        Args:
            observation: Flat vectors (..., size), in the order of the task's terms.

        Returns:
            Actions (..., k), within [-1, 1].

        Raises:
            QuadrlError: The observation has another size.
        """
        return np.clip(self._outputs(observation)[0], -1.0, 1.0)

    def sampled(self, seed: int) -> Callable[[np.ndarray], np.ndarray]:
        """The stochastic policy, as in training: a normal distribution, clipped to [-1, 1].

        Args:
            seed: Of the draws.

        Returns:
            A function of observations, as the policy itself.
        """
        generator = np.random.default_rng(seed)

        def act(observation: np.ndarray) -> np.ndarray:
            mean, log_variance = self._outputs(observation)
            deviation = np.exp(0.5 * np.clip(log_variance, *LOG_VARIANCE))
            return np.clip(mean + deviation * generator.standard_normal(mean.shape), -1.0, 1.0)

        return act

    def check_fits(self, environment: Environment) -> None:
        """Refuse a task and a vehicle with another layout than the policy was trained for.

        Raises:
            QuadrlError: The policy observes or commands another number of values, or it commands
                rotors, and those of the vehicle stand or turn otherwise.
        """
        vehicle = environment.vehicle
        own_sizes, there = (
            (self.size, self.action_size),
            (environment.size, environment.action_size),
        )
        for what, own, needed in zip(("observation", "action"), own_sizes, there, strict=True):
            if own != needed:
                name = f"{what} size of the policy for {self.task}"
                where = f"{environment.task.name} with the vehicle {vehicle.name}"
                raise QuadrlError(name=name, value=own, allowed=f"{needed} for {where}")
        trained = VEHICLES.get(str(self.metadata.get("vehicle")), vehicle)
        if self.control_mode == "rotor" and not np.array_equal(trained.layout, vehicle.layout):
            allowed = f"one with the rotor layout of {trained.name}, which the policy has learned"
            raise QuadrlError(name="vehicle", value=vehicle.name, allowed=allowed)

    def _outputs(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and log-variance (..., k) of the actions."""
        observation = np.asarray(observation, dtype=np.float32)
        if observation.shape[-1:] != self.mean.shape:
            allowed = f"(..., {self.size}) for the policy for {self.task}"
            raise QuadrlError(name="observation shape", value=observation.shape, allowed=allowed)
        hidden = np.clip((observation - self.mean) / self.deviation, -CLIP, CLIP)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = np.tanh(hidden @ weight.T + bias)
        output = hidden @ self.weights[-1].T + self.biases[-1]
        return output[..., : self.action_size], output[..., self.action_size :]

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
            QuadrlError: The file is missing, damaged or not a policy of quadrl.
        """
        path = Path(path)
        file = path / FILE if path.is_dir() else path
        if not file.is_file():
            raise QuadrlError(
                f"there is no policy at {file}; give a run folder (quadrl train ... --out FOLDER "
                "makes one) or a .safetensors file"
            )
        arrays, header = read_safetensors(file, FORMAT, "numpy")
        task, metadata = header.get("task"), header.get("metadata")
        options = metadata.get("task_options", {}) if isinstance(metadata, dict) else None
        if not (isinstance(task, str) and isinstance(metadata, dict) and isinstance(options, dict)):
            raise QuadrlError(f"{file} does not say what its policy was trained for")
        layers = max(1, len(arrays) // 2 - 1)
        names = ("mean", "deviation", *(f"{p}_{k}" for k in range(layers) for p in PARTS))
        if set(arrays) != set(names):
            raise QuadrlError(f"{file} is damaged: its arrays are {', '.join(sorted(arrays))}")
        weights, biases = (tuple(arrays[f"{p}_{k}"] for k in range(layers)) for p in PARTS)
        policy = cls(weights, biases, arrays["mean"], arrays["deviation"], task, metadata)
        if not _is_network(policy):
            raise QuadrlError(f"{file} is damaged: its arrays do not make a policy network")
        return policy

    @classmethod
    def pretrained(cls, task: str, algo: str = "ppo") -> Policy:
        """A policy that comes with the package; the .json beside it says how it was made.

        Args:
            task: The task that it was trained for.
            algo: The algorithm that it was trained with: ppo, trpo or vpg (or gae, its alias).

        Raises:
            QuadrlError: There is no such policy; the message lists those that there are.
        """
        known = [file.stem for file in shipped()]
        name = choice("pretrained policy", f"{task}_{SHIPPED_AS.get(algo, algo)}", known)
        return cls.load(SHIPPED / f"{name}.safetensors")


PARTS = ("weight", "bias")


def _is_network(policy: Policy) -> bool:
    """Whether the arrays fit together and no observation makes an output that is not finite."""
    arrays = (*policy.weights, *policy.biases, policy.mean, policy.deviation)
    width = policy.mean.size
    sound = policy.mean.shape == policy.deviation.shape == (width,)
    sound = sound and all(a.dtype == np.float32 and np.isfinite(a).all() for a in arrays)
    largest = CLIP
    for weight, bias in zip(policy.weights, policy.biases, strict=True):
        if not sound or weight.shape != (bias.size, width) or bias.shape != (bias.size,):
            return False
        sums = largest * np.abs(weight, dtype=np.float64).sum(axis=1) + np.abs(bias)
        sound = bool((sums < np.finfo(np.float32).max / 2).all())
        width, largest = bias.size, 1.0  # the largest output of tanh
    return sound and width > 0 and width % 2 == 0 and bool((policy.deviation > 0).all())


def shipped() -> list[Path]:
    """The files of the policies that come with the package, by name."""
    return sorted(SHIPPED.glob("*.safetensors"))


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
    path: Path, wanted: str, framework: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays of a safetensors file, and the header that quadrl wrote into its table.

    Args:
        path: The file.
        wanted: The header's format.
        framework: "numpy" or "pt".

    Raises:
        QuadrlError: The file cannot be read, or is of another format.
    """
    try:
        with safe_open(path, framework=framework) as opened:
            header = json.loads((opened.metadata() or {}).get(HEADER, "{}"))
            written = header.get("format")
            names = opened.keys() if written == wanted else ()
            arrays = {name: opened.get_tensor(name) for name in names}
    except UNREADABLE as error:
        raise QuadrlError(f"{path} is damaged or not a safetensors file: {error}") from error
    if written != wanted:
        raise QuadrlError(name=f"format of {path}", value=written, allowed=wanted)
    return arrays, header
