"""The speed of every layer and the memory of a large batch, measured in one process.

The yardstick is bare `mj_step`: the same lean model with the same callbacks under random commands,
which move it as random actions do (a step at rest is an eighth shorter). Everything is counted in
control steps a second.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import importlib.util
import itertools
import operator
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from mujoco.batch import Batch

from quadrl import tasks
from quadrl.environment import Environment
from quadrl.simulation import Engine
from quadrl.task import Task
from quadrl.vehicle import ROTORS, Vehicle

Work = Callable[[], int]
"""Flies some control steps, and says how many."""

ALL_CORES, ONE_CORE = "all cores", "one core"
CHUNK = 200
"""Control steps of one aircraft between two looks at the clock."""
FLIGHT = 16
"""Control steps from hover under random commands, until bare aircraft are put back."""
HEIGHT = 3.0
"""At which the aircraft of bare mj_step begin; in a FLIGHT they come near nothing [m]."""
FLIGHT_ENVS = 4096
MEMORY_ENVS = 4096
MEMORY_STEPS = 3
MEMORY_TARGET = 500.0  # [MB]

MEMORY_SCRIPT = """
import os, subprocess, sys
import numpy as np
from quadrl.environment import Environment

def resident():
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except FileNotFoundError:
        return 1024 * int(subprocess.check_output(["ps", "-o", "rss=", "-p", str(os.getpid())]))

task, count, steps = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
before = resident()
environment = Environment(task, num_envs=count, seed=0)
environment.reset()
for _ in range(steps):
    environment.flatten(environment.step(np.zeros((count, 4))).observation)
sys.stdout.write(str((resident() - before) / 1e6))
"""


@dataclasses.dataclass(frozen=True)
class Layer:
    """One thing that is measured."""

    what: str
    """In words."""
    of: str
    """The yardstick: bare mj_step on ALL_CORES or on ONE_CORE."""
    work: Work
    """What is timed."""
    bare: bool = False
    """Whether it is a candidate for the yardstick itself; the fastest one is."""
    target_share: float | None = None
    """Share of the yardstick that it should reach."""
    target_rate: float | None = None
    """Control steps a second that it should reach."""


def benchmark(task: str, *, num_envs: int, seconds: float, repeats: int) -> dict[str, Any]:
    """Measure every layer, in turn and several times over, so that a disturbance hits all alike.

    Args:
        task: A name of the catalogue.
        num_envs: Aircraft in the batches.
        seconds: Of each measurement; short, since the speed of a machine drifts within seconds.
        repeats: Of each. The fastest is the rate, since other work on the machine only takes away.

    Returns:
        `rates`: for each layer `what`, `rate` [control steps/s], all `repeats` of it, `share` of
        bare mj_step on `of` (median over the repeats of the ratio of the two that were measured
        within one turn), `target_share` and `target_rate` (None: none is set). `memory_mb` and
        `memory_target_mb` of `memory_envs` aircraft, beyond the imports. `machine`, and the
        settings. The TorchRL layer is left out where TorchRL is not installed.
    """
    made = tasks.make(task)
    with contextlib.ExitStack() as stack:
        layers = _layers(made, num_envs, stack)
        rates = _measure([layer.work for layer in layers], seconds, repeats)
    bare = [(layer.of, r) for layer, r in zip(layers, rates, strict=True) if layer.bare]
    yardsticks = {
        of: max((r for on, r in bare if on == of), key=statistics.median)
        for of in (ALL_CORES, ONE_CORE)
    }
    return {
        "task": task,
        "num_envs": num_envs,
        "seconds": seconds,
        "rates": [
            {
                "what": layer.what,
                "rate": max(measured),
                "repeats": measured,
                "share": statistics.median(map(operator.truediv, measured, yardsticks[layer.of])),
                "of": layer.of,
                "target_share": layer.target_share,
                "target_rate": layer.target_rate,
            }
            for layer, measured in zip(layers, rates, strict=True)
        ],
        "memory_mb": memory_mb(task),
        "memory_envs": MEMORY_ENVS,
        "memory_target_mb": MEMORY_TARGET,
        "machine": machine(),
    }


def rows(measured: dict[str, Any]) -> list[tuple[str, ...]]:
    """What `benchmark` returned, to be read: what, fastest and median rate, share, target."""
    written = []
    for row in measured["rates"]:
        target = "" if row["target_share"] is None else f"{row['target_share']:.2f}"
        if row["target_rate"] is not None:
            target = f"{row['target_rate']:,}/s"
        share = f"{row['share']:.2f} ({row['of']})"
        median = statistics.median(row["repeats"])
        written.append((row["what"], f"{row['rate']:,.0f}", f"{median:,.0f}", share, target))
    return written


def summary(measured: dict[str, Any]) -> str:
    """The memory and the machine in two lines."""
    computer = dict(measured["machine"])
    cpu, cores, system = (computer.pop(name) for name in ("cpu", "cores", "system"))
    versions = ", ".join(f"{name} {version}" for name, version in computer.items())
    return (
        f"memory of {measured['memory_envs']:,} aircraft: {measured['memory_mb']:.0f} MB beyond "
        f"the imports (target: {measured['memory_target_mb']:.0f} MB)\n"
        f"{cpu}, {cores} core{'s' * (cores > 1)}, {system}, {versions}"
    )


def memory_mb(task: str, num_envs: int = MEMORY_ENVS) -> float:
    """Memory that a batch takes beyond the imports, in a process of its own [MB]."""
    package = str(Path(__file__).parents[1])
    paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
    printed = subprocess.run(
        [sys.executable, "-c", MEMORY_SCRIPT, task, str(num_envs), str(MEMORY_STEPS)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    ).stdout
    return float(printed)


def machine() -> dict[str, str | int]:
    """What the figures were measured on."""
    versions = {}
    for name in ("mujoco", "gymnasium", "dm-control", "torch", "torchrl"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return {
        "cpu": _cpu(),
        "cores": _cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **versions,
    }


def _layers(task: Task, num_envs: int, stack: contextlib.ExitStack) -> list[Layer]:
    """Everything that is measured; what has to be closed goes to the stack."""
    layers = [
        Layer(
            f"mj_step, a loop on each of {_cores()} cores",
            ALL_CORES,
            _threaded_mj_step(task, stack),
            bare=True,
        ),
        Layer(
            f"mj_step, mujoco.batch of {num_envs:,}",
            ALL_CORES,
            _batched_mj_step(task, num_envs),
            bare=True,
        ),
        Layer(
            "the same with mujoco's own stage clock, its default",
            ALL_CORES,
            _with_clock(_batched_mj_step(task, num_envs)),
        ),
        Layer(
            f"Environment of {num_envs:,}: observation, reward, resets",
            ALL_CORES,
            _environment(task, num_envs),
            target_share=0.90,
        ),
        Layer(
            f"Environment of {FLIGHT_ENVS:,} in free flight, the same included",
            ALL_CORES,
            _environment(task, FLIGHT_ENVS, "flight"),
            target_rate=1_000_000,
        ),
        Layer(
            f"Gymnasium make_vec of {num_envs:,}, NEXT_STEP",
            ALL_CORES,
            _gymnasium_vector(task, num_envs, stack),
        ),
    ]
    if importlib.util.find_spec("torchrl"):
        layers.append(
            Layer(
                f"TorchRL collector of {num_envs:,}, policy in the loop",
                ALL_CORES,
                _collector(task, num_envs, stack),
                target_share=0.60,
            )
        )
    return [
        *layers,
        Layer("mj_step, a loop on one core", ONE_CORE, _mj_step(task), bare=True),
        Layer("Gymnasium make, one", ONE_CORE, _gymnasium(task, stack), target_rate=15_000),
        Layer("dm_control load, one", ONE_CORE, _dm_control(task, stack)),
    ]


def _measure(works: list[Work], seconds: float, repeats: int) -> list[list[float]]:
    """Control steps a second of each, `repeats` times over."""
    for work in works:
        work()  # the first time is slower
    rates: list[list[float]] = [[] for _ in works]
    for _ in range(repeats):
        for work, measured in zip(works, rates, strict=True):
            steps, began, elapsed = 0, time.perf_counter(), 0.0
            while elapsed < seconds:
                steps += work()
                elapsed = time.perf_counter() - began
            measured.append(steps / elapsed)
    return rates


# --------------------------------------------------------------------------------------- the layers


def _actions(*shape: int) -> Iterator[np.ndarray]:
    """Random actions (*shape, 4) float32, over and over; drawing them is not measured."""
    return itertools.cycle(
        np.random.default_rng(0).uniform(-1, 1, (64, *shape, ROTORS)).astype(np.float32)
    )


def _commands(vehicle: Vehicle, *shape: int) -> Iterator[np.ndarray]:
    """The rotor commands (*shape, 4) [rad/s] of random actions, over and over."""
    return itertools.cycle(
        vehicle.rotor_command(np.random.default_rng(0).uniform(-1, 1, (64, *shape, ROTORS)))
    )


def _hover(model: mujoco.MjModel, data: mujoco.MjData, vehicle: Vehicle) -> None:
    mujoco.mj_resetData(model, data)
    data.qpos[2] = HEIGHT
    data.act[:] = data.ctrl[:] = vehicle.hover_speed


def _mj_step(task: Task) -> Work:
    vehicle = Vehicle()
    model = vehicle.compile_lean(contact=task.contact)
    data = mujoco.MjData(model)
    commands = _commands(vehicle)

    def work() -> int:
        _hover(model, data, vehicle)
        for _ in range(FLIGHT):
            data.ctrl[:] = next(commands)
            mujoco.mj_step(model, data, vehicle.substeps)
        return FLIGHT

    return work


def _threaded_mj_step(task: Task, stack: contextlib.ExitStack) -> Work:
    """As `mj_step` can be at its best: each core an aircraft, a command a flight."""
    vehicle, cores = Vehicle(), _cores()
    model = vehicle.compile_lean(contact=task.contact)
    aircraft = [mujoco.MjData(model) for _ in range(cores)]
    commands = _commands(vehicle)
    pool = stack.enter_context(ThreadPoolExecutor(cores))

    def fly(data: mujoco.MjData) -> None:
        for _ in range(8):
            _hover(model, data, vehicle)
            data.ctrl[:] = next(commands)
            mujoco.mj_step(model, data, FLIGHT * vehicle.substeps)

    def work() -> int:
        list(pool.map(fly, aircraft))
        return 8 * FLIGHT * cores

    return work


def _batched_mj_step(task: Task, num_envs: int) -> Work:
    vehicle = Vehicle()
    batch = Batch(vehicle.compile_lean(contact=task.contact), num_envs)
    batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    batch.bind("qpos")[:, 2] = HEIGHT
    batch.bind("act")[:] = vehicle.hover_speed
    hovering, ctrl = batch.state.copy(), batch.bind("ctrl")
    commands = _commands(vehicle, num_envs)
    steps = itertools.count()

    def work() -> int:
        if next(steps) % FLIGHT == 0:
            batch.state[:] = hovering
        ctrl[:] = next(commands)
        batch.step(nstep=vehicle.substeps)
        return num_envs

    return work


def _with_clock(work: Work) -> Work:
    """The same as mujoco comes: it reads the clock at every stage of a step."""

    def timed() -> int:
        ours = mujoco.get_mjcb_time()
        mujoco.set_mjcb_time(None)
        try:
            return work()
        finally:
            mujoco.set_mjcb_time(ours)

    return timed


def _environment(task: Task, num_envs: int, engine: Engine = "mujoco") -> Work:
    environment = Environment(task, num_envs=num_envs, seed=0, engine=engine)
    environment.flatten(environment.reset())
    actions = _actions(num_envs)

    def work() -> int:
        now = environment.step(next(actions))
        observation = environment.flatten(now.observation)
        over = np.asarray(now.terminated | now.truncated)
        if over.any():
            observation[over] = environment.flatten(environment.reset(over))
        return num_envs

    return work


def _gymnasium_vector(task: Task, num_envs: int, stack: contextlib.ExitStack) -> Work:
    door = stack.enter_context(
        contextlib.closing(gym.make_vec(_gymnasium_id(task), num_envs=num_envs))
    )
    door.reset(seed=0)
    actions = _actions(num_envs)

    def work() -> int:
        door.step(next(actions))
        return num_envs

    return work


def _gymnasium(task: Task, stack: contextlib.ExitStack) -> Work:
    door = stack.enter_context(contextlib.closing(gym.make(_gymnasium_id(task))))
    door.reset(seed=0)
    actions = _actions()

    def work() -> int:
        for _ in range(CHUNK):
            _, _, terminated, truncated, _ = door.step(next(actions))
            if terminated or truncated:
                door.reset()
        return CHUNK

    return work


def _dm_control(task: Task, stack: contextlib.ExitStack) -> Work:
    from quadrl import suite

    door = stack.enter_context(contextlib.closing(suite.make(task, random=0)))
    door.reset()
    actions = _actions()

    def work() -> int:
        for _ in range(CHUNK):
            door.step(next(actions))  # after an episode's last step it begins the next one
        return CHUNK

    return work


def _collector(task: Task, num_envs: int, stack: contextlib.ExitStack) -> Work:
    """The collector and the policy as a training has them."""
    import torch

    from quadrl.envs.torchrl import QuadrotorEnv
    from quadrl.learning.config import recipe
    from quadrl.learning.policy import make_actor_critic
    from quadrl.learning.train import make_collector

    config = recipe(task.name)
    env = QuadrotorEnv(task, num_envs, seed=0)
    actor, _, _ = make_actor_critic(
        env.environment.size,
        ROTORS,
        hidden=config.hidden,
        critic_hidden=config.critic_hidden,
        initial_deviation=config.initial_deviation,
    )
    frames = num_envs * config.rollout
    collector = make_collector(env, actor, frames)
    stack.callback(collector.shutdown)
    stack.callback(torch.set_num_threads, torch.get_num_threads())
    batches = iter(collector)

    def work() -> int:
        torch.set_num_threads(1)  # as in a training
        next(batches)
        return frames

    return work


# -------------------------------------------------------------------------------------- the machine


def _gymnasium_id(task: Task) -> str:
    camel = "".join(word.capitalize() for word in task.name.split("_"))
    return f"quadrl/{camel}-v0"


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _cpu() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    if sys.platform == "darwin":
        command = ["sysctl", "-n", "machdep.cpu.brand_string"]
        return subprocess.run(command, capture_output=True, text=True).stdout.strip()
    return platform.processor() or platform.machine()
