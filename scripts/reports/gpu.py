"""Check a GPU against the processor, then measure it: the command `scripts/gpu`."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from quadrl.base.files import write_json
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.device.batch import Batch
from quadrl.device.training import DeviceTraining, Learner
from quadrl.evaluation.evaluate import evaluate
from quadrl.learning.config import TrainConfig

LATE = {"command_delay": (0.0, 0.04), "observation_delay": (0.0, 0.03), "mass": (0.9, 1.1)}
LATE |= {"command_loss": (0.0, 2.0), "command_jitter": (0.0, 0.5), "noise": {"position": 0.01}}
LATE |= {"pushes": {"rate": 0.5, "velocity": 0.5, "body_rate": 1.0}}
SEES = {"rotor_speed": "estimated", "disturbance": True, "action_history": 2, "privileged": True}
FLIGHTS: dict[str, dict[str, Any]] = {
    "hover": {"task": "hover"},
    "body rates": {"task": "hover", "control_mode": "thrust_body_rate"},
    "velocity": {"task": "hover", "control_mode": "velocity"},
    "full air": {"task": "hover", "aerodynamics": "full"},
    "wind": {"task": "hover", "weather": "light"},
    "uncertain": {"task": "hover", "randomization": LATE, "observe": SEES, "weather": "light"},
    "static_waypoint": {"task": "static_waypoint"},
    "random_waypoint": {"task": "random_waypoint"},
    "straight_and_level": {"task": "straight_and_level"},
    "target_following": {"task": "target_following"},
    "race": {"task": "race"},
    "recovery": {"task": "recovery"},
    "trajectory": {"task": "trajectory"},
    "navigation": {"task": "navigation", "control_mode": "velocity"},
}
TIMED = ("hover", "body rates", "race", "full air", "uncertain", "navigation")
AIRCRAFT = (4_096, 65_536, 262_144, 1_048_576)
COMPARED, STEPS = 256, 100
"""Aircraft and control steps of a comparison."""
EXACT, NEAR, LOOSE = 1e-6, 1e-5, 1e-3
"""Largest differences, relative to 1 + the number: of flights in double precision, whose sines are
others than the processor's; and of the motion after a step in single precision, of all but one
aircraft in a hundred, without and with loops, which take roots of thrusts that are nearly zero."""
NEAR_SOLIDS = 0.5
"""Clearance [m] from which on MuJoCo has not flown an aircraft."""
TRAININGS: dict[str, dict[str, Any]] = {
    "hover": {
        "num_envs": 2048,
        "steps": 983_040,
        "ppo": {"learning_rate": 1e-2, "beta2": 0.99, "minibatch": 4096},
    },
}


def scenario(name: str) -> Scenario:
    """A flight by its name."""
    own = dict(FLIGHTS[name])
    return Scenario.of(own.pop("task"), **own, engine="free_flight")


def differs(found: torch.Tensor, expected: Any) -> torch.Tensor:
    """The largest difference of each row, relative to 1 + the number."""
    own, other = found.double().cpu(), torch.as_tensor(expected).double().cpu()
    return ((own - other).abs() / (1 + other.abs())).reshape(len(own), -1).amax(1)


def check(name: str, device: str) -> dict[str, float]:
    """Fly the same episodes on a device and on the processor; what differs.

    Where starts are drawn on the processor, the first episode of each row is compared; and where
    there are solids, until one is near, since MuJoCo flies on the processor from there on.
    """
    given = scenario(name), COMPARED, 7, device
    exact, fast = Batch(*given, precision="float64"), Batch(*given, precision="float32")
    environment = Environment(given[0], num_envs=COMPARED, seed=7)
    environment.reset(), exact.reset(), fast.reset()
    rng, found = np.random.default_rng(0), {"flags": 0.0, "double": 0.0, "single": 0.0, "ends": 0.0}
    single: list[torch.Tensor] = []
    same, solids = np.ones(COMPARED, dtype=bool), bool(environment.scene.solids)
    for _ in range(STEPS):
        action = rng.normal(0, 0.4, (COMPARED, environment.action_size)).astype(np.float32)
        fast.table.copy_(exact.table)
        fast.episodes.copy_(exact.episodes)
        for batch in (exact, fast):
            batch.action[0].copy_(torch.from_numpy(action))
        now, done = exact.step(), environment.step(action)
        near = fast.step()
        if solids:
            same &= environment.engine.clearance() > NEAR_SOLIDS
        flags = np.stack([done.terminated, done.truncated, done.is_success, done.diverged])
        own = torch.stack([now.terminated, now.truncated, now.success, now.diverged])
        found["flags"] += float((own.cpu().numpy() != flags)[:, same].sum())
        seen = np.concatenate(list(done.observation.values()), -1)
        for own, expected in ((now.final, seen), (now.reward, done.reward)):
            worst = differs(own, expected)[torch.from_numpy(same)].amax() if same.any() else 0.0
            found["double"] = max(found["double"], float(worst))
        flying, motion = ~(now.over | near.over), slice(exact.layout.motion)
        single.append(differs(fast.table[motion].T, exact.table[motion].T)[flying.cpu()])
        over = flags[:2].any(0)
        found["ends"] += float((over & same).sum())
        if exact.layout.pooled:
            same &= ~over
        if over.any():
            environment.reset(over)
    found["single"] = float(torch.cat(single).quantile(0.99))
    return found


def passes(name: str, found: dict[str, float]) -> bool:
    """Whether a comparison shows no fault."""
    near = LOOSE if scenario(name).control_mode != "rotor" else NEAR
    return found["flags"] == 0 and found["double"] < EXACT and found["single"] < near


def seconds(call: Callable[[], None], times: int) -> float:
    """Time of a call, recorded as a graph, the median of seven rounds of some launches [s]."""
    call()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        call()
    graph.replay()
    rounds: list[float] = []
    for _ in range(7):
        begun, ended = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begun.record()
        for _ in range(times):
            graph.replay()
        ended.record()
        ended.synchronize()
        rounds.append(1e-3 * begun.elapsed_time(ended) / times)
    return sorted(rounds)[3]


def timed(name: str, count: int, steps: int = 20) -> dict[str, Any]:
    """Control steps a second of a flight with random actions, episodes' starts included."""
    batch = Batch(scenario(name), count, 0)
    batch.reset()
    batch.action.normal_(0, 0.3)
    for _ in range(200):  # until some episodes of all lengths are over
        batch.fly(0)

    def fly() -> None:
        for _ in range(steps):
            batch.fly(0)

    each = seconds(fly, 5) / steps
    batch.check()
    return {"flight": name, "aircraft": count, "us": 1e6 * each, "steps_per_second": count / each}


def with_policy(count: int) -> dict[str, Any]:
    """The same with a policy's network in the loop, as in a training."""
    with tempfile.TemporaryDirectory() as folder:
        config = TrainConfig("hover", num_envs=count, device="cuda", evaluations=0)
        learner: Learner = DeviceTraining(config, Path(folder) / "run")._learner
        each = seconds(torch.no_grad()(learner._fly), 5) / config.rollout
    name = "hover, policy of 128 neurons"
    return {"flight": name, "aircraft": count, "us": 1e6 * each, "steps_per_second": count / each}


def trained(task: str, seed: int) -> dict[str, Any]:
    """A training from nothing: its time, and how its policy flies in MuJoCo."""
    config = TrainConfig(task, seed=seed, device="cuda", **TRAININGS[task])
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        training = DeviceTraining(config, Path(folder) / "run")
        ready = time.perf_counter()
        policy = training.run()
        over = time.perf_counter()
    flown = evaluate(policy, config.scenario, episodes=300).metrics
    return {
        "task": task,
        "seed": seed,
        "steps": training.steps,
        "seconds": training.seconds,
        "ready": ready - begun,
        "whole": over - begun,
        "success": flown["success_rate"],
    }


def rows(trainings: bool, aircraft: tuple[int, ...]) -> Iterator[dict[str, Any]]:
    """All that is measured."""
    for name in TIMED:
        for count in aircraft:
            yield timed(name, count)
    for count in aircraft:
        yield with_policy(count)
    for task in TRAININGS if trainings else ():
        for seed in (11, 12, 13):
            yield trained(task, seed)


def gpu(
    out: Path | None = None, trainings: bool = True, aircraft: tuple[int, ...] = AIRCRAFT
) -> None:
    """Check a GPU against the processor, then measure it.

    Args:
        out: A file for the figures, in JSON.
        trainings: Whether trainings are measured, too.
        aircraft: How many fly at once.
    """
    if not torch.cuda.is_available():
        sys.exit("there is no GPU that this torch can use: nothing was measured")
    checked = {name: check(name, "cuda") for name in FLIGHTS}
    for name, found in checked.items():
        print(
            f"{'ok' if passes(name, found) else 'FAILED':7}{name:22}{json.dumps(found)}", flush=True
        )
    if not all(passes(*one) for one in checked.items()):
        sys.exit("the GPU does not fly what the processor does: nothing was measured")
    found: list[dict[str, Any]] = []
    for row in rows(trainings, aircraft):
        found.append(row)
        print(json.dumps(row), flush=True)
    if out:
        card = torch.cuda.get_device_name()
        write_json(
            out, {"card": card, "torch": torch.__version__, "checked": checked, "rows": found}
        )


if __name__ == "__main__":
    tyro.cli(gpu)
