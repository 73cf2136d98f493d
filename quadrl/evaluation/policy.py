"""A trained policy as numbers: NumPy in, NumPy out, no torch.

The network is the paper's: hidden layers of tanh, then the mean and the log-variance of a normal
distribution over the actions. Observations are normalised with the mean and the deviation of the
training. A policy with a memory has a gated recurrent unit beside that: its state joins the
observation. `policy_file` has its file.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.files import read_sealed_json
from quadrl.base.validation import choice, number
from quadrl.control.modes import named
from quadrl.core.record import import_again, warn_of_changes
from quadrl.core.scenario import RECORDED, Scenario
from quadrl.core.task import Task
from quadrl.evaluation import fitting, policy_file
from quadrl.evaluation.memory import GRU, PolicyInFlight
from quadrl.evaluation.policy_file import CLIP, RUN, RUN_FORMAT, SHIPPED, SHIPPED_AS, shipped
from quadrl.tasks import TASKS

if TYPE_CHECKING:
    from quadrl.core.environment import Environment
    from quadrl.evaluation.module import PolicyModule

LOG_VARIANCE = (-12.0, 2.0)
"""Bounds of the log-variance of the actions."""
OWN = ("algo", "seed", "vehicle")  # what a policy says of itself


@dataclasses.dataclass(frozen=True, repr=False)
class Policy:
    """The mean action of a trained network."""

    weights: tuple[np.ndarray, ...]
    """Weights of each layer, (outputs, inputs); outputs of the last: k means, k log-variances."""
    biases: tuple[np.ndarray, ...]
    """Biases of each layer, (outputs,)."""
    mean: np.ndarray
    """Mean of the observations in training, (size,)."""
    deviation: np.ndarray
    """Deviation of the observations in training, (size,)."""
    task: str
    """The task that it was trained for."""
    metadata: dict[str, Any] = dataclasses.field(default_factory=dict)
    """How it was made: algo, seed, variant, steps, rotors; and its scenario, as
    `Scenario.to_json` gives it."""
    memory: GRU | None = None
    """What it remembers with: its state after an observation joins the normalised observation."""

    def __repr__(self) -> str:
        layers = "-".join(str(x) for x in (self.size, *(len(bias) for bias in self.biases)))
        said = {k: self.metadata[k] for k in OWN if k in self.metadata}
        known = ", ".join(f"{k} {v['name'] if isinstance(v, dict) else v}" for k, v in said.items())
        memory = f"; memory of {self.state_size}" if self.memory else ""
        return f"Policy for {self.task} ({known or 'made by hand'}; layers {layers}{memory})"

    @property
    def control_mode(self) -> str:
        """What its actions mean."""
        return named(self.metadata.get("control_mode", "rotor"))

    @property
    def conditions(self) -> dict[str, Any]:
        """What it was trained for and in, as `Scenario.of` takes it; it may have unknown names."""
        known = {name: self.metadata[name] for name in RECORDED if name in self.metadata}
        return known | {"task": self.task}

    @property
    def scenario(self) -> Scenario:
        """What it was trained for and in, with the numbers of then; other ones today are warned of.

        Raises:
            QuadrlError: Its task is not known here.
        """
        warn_of_changes(self.conditions, flown := Scenario.of(self.conditions), "policy")
        return flown

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords with which each API makes an environment that it fits.

        They are the aircraft, the control mode, the observation and the options of the task of its
        training: `gymnasium.make("quadrl/Hover-v0", **policy.keywords)`. The weather and the
        randomization of its training are in `scenario`. Those of a policy for several tasks make
        each of these tasks, with its usual options.
        """
        own = self.scenario
        needed = {"vehicle": own.aircraft, "control_mode": own.control_mode, "observe": own.observe}
        if own.task.parts != (own.task,):
            return needed
        return needed | {x.name: getattr(own.task, x.name) for x in dataclasses.fields(own.task)}

    @property
    def size(self) -> int:
        """Numbers in an observation."""
        return len(self.mean)

    @property
    def action_size(self) -> int:
        """Numbers in an action, k."""
        return len(self.biases[-1]) // 2

    @property
    def state_size(self) -> int:
        """Numbers that it remembers of an aircraft; 0 without a memory."""
        return self.memory.width if self.memory else 0

    @property
    def mean_layers(self) -> list[tuple[np.ndarray, ...]]:
        """Weight and bias of each layer, the last of which gives the means alone."""
        *hidden, last = zip(self.weights, self.biases, strict=True)
        return [*hidden, tuple(array[: self.action_size] for array in last)]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The mean action of a policy without a memory; `flying` is for every policy.

        Args:
            observation: Flat vectors (..., size), in the order of the task's terms.

        Returns:
            Actions (..., k), within [-1, 1].

        Raises:
            QuadrlError: The observation has another size, or the policy has a memory, which it
                would lose with every call.
        """
        return self._act(observation, self._without_memory(), None)[0]

    def sampled(self, seed: int) -> Callable[[np.ndarray], np.ndarray]:
        """As the policy itself, with actions drawn as in training; `flying` takes a seed too."""
        state, generator = self._without_memory(), np.random.default_rng(seed)
        return lambda observation: self._act(observation, state, generator)[0]

    def initial_state(self, n: int | None = None) -> np.ndarray:
        """The memory at the start of an episode: (n, state_size); (state_size,) without n."""
        rows = () if n is None else (int(number("n", n, 1, whole=True)),)
        return np.zeros((*rows, self.state_size), dtype=np.float32)

    def step(
        self,
        observation: np.ndarray,
        state: np.ndarray,
        generator: np.random.Generator | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute actions, and the memory to pass with the next observation.

        Args:
            observation: (n, size), or (size,) of one aircraft.
            state: What the last step gave, (n, state_size) or (state_size,); `initial_state` in the
                rows whose episode begins.
            generator: Generator of the draws of the stochastic policy; None for the mean action.

        Returns:
            Actions (n, k) or (k,), within [-1, 1]; the next state, of the shape of the present one.

        Raises:
            QuadrlError: The observation or the state has another shape.
        """
        state = np.asarray(state, dtype=np.float32)
        if state.shape != (needed := (*np.shape(observation)[:-1], self.state_size)):
            raise QuadrlError(name="state shape", value=state.shape, allowed=f"{needed}")
        return self._act(observation, state, generator)

    def flying(self, n: int | None = None, seed: int | None = None) -> PolicyInFlight:
        """The policy as a function of observations that keeps its memory; `reset` clears it.

        Args:
            n: Aircraft that it flies: observations are (n, size). None for one, (size,).
            seed: Seed of the draws of the stochastic policy; None for the mean action.
        """
        return PolicyInFlight(self, n, seed)

    def to_torch(self) -> PolicyModule:
        """The mean action as a `torch.nn.Module`, with the observations' normalisation."""
        from quadrl.evaluation.module import PolicyModule

        return PolicyModule(self)

    def check_fits(self, environment: Environment) -> None:
        """Refuse an environment in which observations or actions mean something else.

        `keywords` make one that fits. Another time between two actions is warned of, and so are
        numbers of the aircraft or the task that are others today than in the training.

        Raises:
            QuadrlError: The policy observes or commands another number of values or with other
                options, or in another control mode; or it commands rotors, and those of the vehicle
                stand or turn otherwise, or an action of 1 is another change of their speed.
        """
        trained = fitting.check_fits(self, environment)
        if trained.control_timestep != (timestep := environment.vehicle.control_timestep):
            said = f"control_timestep = {timestep:g}: the policy for {self.task} was trained with"
            warnings.warn(f"{said} {trained.control_timestep:g}", QuadrlWarning, stacklevel=4)
        warn_of_changes(self.conditions, environment.scenario, "policy", kept=False)

    def _without_memory(self) -> np.ndarray:
        """The state of a policy that has none.

        Raises:
            QuadrlError: It has one.
        """
        if self.memory:
            raise QuadrlError(
                f"the policy for {self.task} has a memory, which a single call would lose: fly "
                "with policy.flying(n), or keep the state with policy.step(observation, state)"
            )
        return self.initial_state()

    def _act(
        self, observation: np.ndarray, state: np.ndarray, generator: np.random.Generator | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Actions (..., k) and the next state."""
        observation = np.asarray(observation, dtype=np.float32)
        if observation.shape[-1:] != self.mean.shape:
            shape, allowed = observation.shape, f"(..., {self.size}) for the policy for {self.task}"
            reason = "an environment that is made with **policy.keywords gives that"
            raise QuadrlError(reason, name="observation shape", value=shape, allowed=allowed)
        hidden = np.clip((observation - self.mean) / self.deviation, -CLIP, CLIP)
        if self.memory:
            state = self.memory.step(hidden, state)
            hidden = state if self.memory.alone else np.concatenate([hidden, state], axis=-1)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = np.tanh(hidden @ weight.T + bias)
        output = hidden @ self.weights[-1].T + self.biases[-1]
        action, log_variance = output[..., : self.action_size], output[..., self.action_size :]
        if generator is not None:
            deviation = np.exp(0.5 * np.clip(log_variance, *LOG_VARIANCE))
            action = action + deviation * generator.standard_normal(action.shape)
        return np.clip(action, -1.0, 1.0), state

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        policy_file.write(Path(path), self)

    @classmethod
    def load(cls, path: str | Path) -> Policy:
        """Read a policy; nothing in the file is run.

        A policy in the folder of a run that it is not of is read with a `QuadrlWarning`. What this
        user gave to `--import` in the training is imported again.

        Args:
            path: A .safetensors file, or a run folder that holds policy.safetensors.

        Raises:
            QuadrlError: The file is missing, damaged or not a policy of quadrl.
        """
        path = Path(path)
        policy = cls(**policy_file.read(path))
        if (path / RUN).is_file():
            run = read_sealed_json(path / RUN, RUN_FORMAT)
            policy_file.warn_of_another_run(path, run, policy.metadata | {"task": policy.task})
            import_again(run, path)
        return policy

    @classmethod
    def pretrained(cls, task: str, algo: str = "", variant: str = "ideal") -> Policy:
        """A policy that comes with the package; the .json beside it says how it was made.

        Args:
            task: The task that it was trained for, or the name of its file, such as hover_robust.
            algo: The algorithm that it was trained with: ppo, trpo, vpg (or gae, its alias) or apg;
                by default that of the task's trainings.
            variant: The variant of the training: ideal; robust, for an uncertain aircraft; raptor,
                for PX4's module; any, for any quadrotor.

        Raises:
            QuadrlError: There is no such policy; the message lists those that there are.
        """
        name, known = task, [file.stem for file in shipped()]
        if task not in known:
            algo = algo or TASKS.get(task, Task).trained_by
            name = f"{task}_{SHIPPED_AS.get(algo, algo) if variant == 'ideal' else variant}"
        return cls.load(SHIPPED / f"{choice('pretrained policy', name, known)}.safetensors")
