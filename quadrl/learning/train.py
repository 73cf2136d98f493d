"""The training loop: collect, estimate advantages, let the algorithm learn, write it down.

A run is a folder. Everything that the next iteration depends on (networks, optimisers, normaliser,
generators, the simulated aircraft) stands in its checkpoint, so a run that was killed at any
moment continues and ends with the same policy, bit for bit.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import time
import warnings
import weakref
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.base.files import PART
from quadrl.base.machine import check_memory, processor_kind
from quadrl.base.progress import Progress
from quadrl.engines import native
from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.evaluation.policy import FILE as POLICY_FILE
from quadrl.evaluation.policy import Policy
from quadrl.learning import checkpoint
from quadrl.learning.algorithm import Algorithm
from quadrl.learning.apg import APG
from quadrl.learning.config import TrainConfig, renamed
from quadrl.learning.environments import RecordingEnv, make_collector, make_env
from quadrl.learning.folder import (
    EVALUATION,
    WARNINGS,
    Log,
    lock_folder,
    new_folder,
    read_config,
    run_of,
    write_config,
)
from quadrl.learning.networks import BEGINS, PRIVILEGED, STATE, export, make_actor_critic
from quadrl.learning.ppo import PPO
from quadrl.learning.trpo import TRPO
from quadrl.learning.vpg import VPG

with warnings.catch_warnings():
    # TorchRL 0.14 warns about its own classes at this import.
    warnings.filterwarnings("ignore", message=".*WeightUpdater.*", category=DeprecationWarning)
    from torchrl.modules import set_recurrent_mode
    from torchrl.objectives.value import GAE

LEARNED_FROM = ("action", "action_log_prob", "loc", "scale", "advantage", "value_target")
"""Of a batch, beside what actor and critic read."""
ALGORITHMS = {"ppo": PPO, "trpo": TRPO, "vpg": VPG}


def make_algorithm(config: TrainConfig, env: QuadrotorEnv, actor: Any, critic: Any) -> Algorithm:
    """The algorithm of a training."""
    own = getattr(config, config.algo)
    if isinstance(env, RecordingEnv):
        return APG(actor, critic, own, env, config.gamma, config.reward_scale)
    return ALGORITHMS[config.algo](actor, critic, own)


def make_device(name: str) -> torch.device:
    """The device of a name.

    Raises:
        QuadrlError: This torch, or this machine, does not have it.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).cpu()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).strip().partition("\n")[0]
        allowed = "a device that this torch can use, such as cpu"
        raise QuadrlError(reason, name="device", value=name, allowed=allowed) from error
    return device


@contextlib.contextmanager
def one_thread() -> Generator[None]:
    """Let torch calculate with one thread, so that no bit depends on how many cores there are.

    Networks this small gain nothing from a second thread, and lose a lot when a core is busy.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Training:
    """A run in its folder."""

    @one_thread()  # the first weights are numbers, too
    def __init__(self, config: TrainConfig, folder: Path, *, resume: bool = False) -> None:
        """Make everything that learns; then make the folder, or load its checkpoint.

        A run may be continued with more steps than it was begun with.

        Raises:
            QuadrlError: The folder or the device cannot be used.
        """
        self.config, self.folder = config, folder
        device = make_device(config.device)
        torch.manual_seed(config.seed)
        self.env = make_env(config, device)
        size, actions = self.env.environment.size, self.env.environment.action_size
        self._check_memory(size)
        given = self.env.observation_spec.get(PRIVILEGED, None)
        self.actor, self.critic, self.normalisers = make_actor_critic(
            size, actions, config, 0 if given is None else given.shape[-1]
        )
        for network in (self.actor, self.critic):
            network.to(device)
        self.algorithm = make_algorithm(config, self.env, self.actor, self.critic)
        self.advantages = GAE(
            gamma=config.gamma, lmbda=config.gae_lambda, value_network=None, average_gae=True
        )
        self.iteration = 0
        self.seconds = 0.0  # of training, in all processes that worked on it
        self._running = {name: np.zeros(config.num_envs) for name in ("return", "length")}
        self._generators: dict[str, torch.Tensor] = {}
        self._remembered: dict[str, np.ndarray] = {}  # the states of a recurrent policy
        self._asked = self._stopping = False
        if not resume:
            new_folder(folder)
        self._unlock = weakref.finalize(self, lock_folder(folder))
        for left in folder.glob(f"*{PART}") if resume else ():  # by a kill
            left.unlink(missing_ok=True)
        resolved = config.resolved()
        self._known_as = run_of(resolved)
        if not resume:
            write_config(folder, resolved)
        elif any((folder / name).exists() for name in (checkpoint.CHECKPOINT, POLICY_FILE)):
            # Without either, it was stopped before the first checkpoint.
            try:
                self._restore()
            except QuadrlError:
                self._unlock()
                raise
            before = read_config(folder).get("processors", ())
            if others := set(before) - {processor_kind()}:
                text = f"{folder} was trained on another processor ({', '.join(sorted(others))}): "
                text += "on this one its policy can end otherwise in the last digits"
                warnings.warn(text, QuadrlWarning, stacklevel=2)
            write_config(folder, resolved, before)
        if self.iteration < config.iterations:
            (folder / EVALUATION).unlink(missing_ok=True)

    def _check_memory(self, size: int) -> None:
        """Refuse networks and batches that do not fit, of observations of a size.

        Of a weight there are four numbers, with gradient and Adam's two; of a transition some ten
        times its observation and 1 kB more, as was measured.
        """
        config = self.config
        for name, hidden in (("hidden", config.hidden), ("critic_hidden", config.critic_hidden)):
            widths = (size, *hidden, 1)
            weights = sum(a * b for a, b in itertools.pairwise(widths))
            check_memory(f"{name} = {hidden}", 16.0 * weights)
        batch = config.num_envs * config.rollout
        check_memory(f"num_envs * rollout = {batch}", batch * (40.0 * size + 1000))

    @property
    def steps(self) -> int:
        """Control steps of all aircraft so far."""
        return self.iteration * self.config.num_envs * self.config.rollout

    @one_thread()
    def run(self, on_progress: Callable[[Progress], None] = lambda progress: None) -> Policy:
        """Train to the end, or until `ask` stops it, and save the policy.

        Returns:
            The saved policy.

        Raises:
            QuadrlError: A weight is no longer finite.
        """
        config = self.config
        with contextlib.ExitStack() as stack:
            stack.callback(self._unlock)
            if self.iteration >= config.iterations:
                policy = self.policy()  # a kill may have come between the checkpoint and its policy
                policy.save(self.folder / POLICY_FILE)
                return policy
            collector = make_collector(self.env, self.actor, config.num_envs * config.rollout)
            stack.callback(collector.shutdown, close_env=False)
            self._set_generators()
            log = Log(self.folder, self.iteration)
            stack.callback(log.close)
            stack.enter_context(native.warnings_in(self.folder / WARNINGS))
            # All that the imports made is no garbage, and to look through it takes 5 % of the time.
            gc.freeze()
            stack.callback(gc.unfreeze)
            started = saved = time.perf_counter()
            before, batches = self.seconds, iter(collector)
            while True:
                metrics = self._learn(next(batches))
                self.iteration += 1
                now = time.perf_counter()
                self.seconds = before + now - started
                if not all(weight.isfinite().all() for weight in self.algorithm.parameters):
                    raise QuadrlError(
                        f"the training diverged after {self.steps} steps: a weight is no longer "
                        "finite; lower the learning rate and start a new run"
                    )
                log.write(self.iteration, self.steps, self.seconds, metrics)
                progress = (self.iteration, config.iterations, self.steps, self.seconds, metrics)
                on_progress(Progress(*progress))
                over = self.iteration == config.iterations or self._stopping
                if over or self._asked or now - saved > config.checkpoint_seconds:
                    self._asked = False  # what is asked from here on, the next iteration does
                    self.save()
                    saved = time.perf_counter()
                if over:
                    break
            self.seconds = before + time.perf_counter() - started
        return self.policy()

    def ask(self, *, stop: bool = False) -> None:
        """Ask for a checkpoint at the end of this iteration, and maybe to stop after it.

        It may be called at any moment, by the handler of a signal or another thread.
        """
        self._stopping |= stop
        self._asked = True

    def policy(self) -> Policy:
        """The policy at this moment."""
        config = self.config
        metadata = {
            "algo": config.algo,
            "seed": config.seed,
            "run": self._known_as,
            "variant": config.variant,
            "steps": self.steps,
            "rotors": config.scenario.vehicle.rotor_count,
            **config.scenario.to_json(),
        }
        return export(self.actor, config.task, metadata)

    def _learn(self, batch: Any) -> dict[str, float]:
        """One iteration on a batch (aircraft, time)."""
        metrics = self._episodes(batch)
        with torch.no_grad():
            if self.config.memory != "none":
                done, state = (batch["next", name] for name in ("done", STATE))
                batch[BEGINS] = torch.roll(done, 1, dims=1)
                batch[BEGINS][:, 0] = False  # the state before it says so
                self._remembered = {STATE: state[:, -1].masked_fill(done[:, -1], 0.0).cpu().numpy()}
            first = self.iteration == 0 and not self.algorithm.whole
            if first:  # the first batch was collected without a normaliser
                self._normalise(batch)
                with set_recurrent_mode():
                    present = self.actor.get_dist(batch)
                batch["action_log_prob"] = present.log_prob(batch["action"])
            batch["next", "reward"] *= self.config.reward_scale
            self._evaluate(batch)
            self.advantages(batch)
        flat = batch.select(*self.actor.in_keys, *self.critic.in_keys, *LEARNED_FROM)
        if self.config.memory == "none" and not self.algorithm.whole:
            flat = flat.reshape(-1)
        metrics |= self.algorithm.update(flat, 1 - self.iteration / self.config.iterations)
        if not first:
            self._normalise(batch)
        return metrics | {"deviation": float(batch["scale"].mean())}

    def _evaluate(self, batch: Any) -> None:
        """Add the critic's values of all states and of those after them.

        Within an episode the state after one is the next one, whose value is there already.
        """
        value = self.critic(batch)["state_value"]
        ends = batch["next", "done"][..., 0].clone()
        ends[:, -1] = True
        after = torch.roll(value, -1, dims=1)
        after[ends] = self.critic(batch["next"].select(*self.critic.in_keys)[ends])["state_value"]
        batch["next", "state_value"] = after

    def _normalise(self, batch: Any) -> None:
        """Include a batch in the normalisers."""
        for name, normaliser in self.normalisers.items():
            normaliser.update(batch[name])

    def _episodes(self, batch: Any) -> dict[str, float]:
        """Return, length, success and survival of the episodes that ended in the batch."""
        names = ("reward", "done", "terminated", "is_success", "error")
        columns = (batch["next", name][..., 0].cpu().numpy().T for name in names)
        reward, done, terminated, success, error = columns  # (time, aircraft)
        ended: dict[str, list[np.ndarray]] = {name: [] for name in self._running}
        for gained, over in zip(reward, done, strict=True):
            self._running["return"] += gained
            self._running["length"] += 1
            for name, running in self._running.items():
                ended[name].append(running[over])
                running[over] = 0.0
        returns, lengths = (np.concatenate(ended[name]) for name in ("return", "length"))
        metrics = {"episodes": float(len(returns)), "reward": float(reward.mean())}
        metrics["error"] = float(error.mean())
        if len(returns):
            metrics |= {
                "return": float(returns.mean()),
                "length": float(lengths.mean()),
                "success": float(success[done].mean()),
                "survival": float(1 - (terminated & ~success)[done].mean()),
            }
        return metrics

    def save(self) -> None:
        """Write the checkpoint, and the policy of this moment."""
        tensors = {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "optimisers": self.algorithm.save(),
            "environment": self.env.environment.save() | self._remembered,
            "running": self._running,
            "generators": self._get_generators(),
        }
        numbers = {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "config": self.config.resolved(),
        }
        checkpoint.save(self.folder / checkpoint.CHECKPOINT, tensors, numbers)
        self.policy().save(self.folder / POLICY_FILE)

    def _get_generators(self) -> dict[str, torch.Tensor]:
        """The state of every random number generator that the training draws from."""
        states = {"cpu": torch.get_rng_state()}
        if self.env.device.type == "cuda":
            states["cuda"] = torch.cuda.get_rng_state(self.env.device)
        return states

    def _set_generators(self) -> None:
        if "cpu" in self._generators:
            torch.set_rng_state(self._generators["cpu"])
        if "cuda" in self._generators and self.env.device.type == "cuda":
            torch.cuda.set_rng_state(self._generators["cuda"], self.env.device)

    def _restore(self) -> None:
        path = self.folder / checkpoint.CHECKPOINT
        tensors, numbers = checkpoint.load(path)
        try:
            checkpoint.check_same(path, renamed(numbers["config"]), self.config.resolved())
            self.actor.load_state_dict(tensors["actor"])
            self.critic.load_state_dict(tensors["critic"])
            self.algorithm.restore(tensors.get("optimisers", {}))
            self.env.restore({k: v.numpy() for k, v in tensors["environment"].items()})
            self._running = {k: v.numpy().copy() for k, v in tensors["running"].items()}
            self._generators = tensors["generators"]
            self.iteration, self.seconds = int(numbers["iteration"]), float(numbers["seconds"])
        except QuadrlError:
            raise
        except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError,
                ValueError) as error:  # fmt: skip
            reason = str(error).partition("\n")[0]
            raise QuadrlError(f"{path} does not fit its run: {reason}") from error
