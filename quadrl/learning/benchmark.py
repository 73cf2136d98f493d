"""The speed of every layer, measured in one process.

The yardstick is bare `mj_step`: the same lean model with the same callbacks under random commands,
which move it as random actions do (a step at rest takes an eighth less time). Every rate is in
control steps per second.
"""

from __future__ import annotations

import contextlib
import importlib.util
import operator
import statistics
import time
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym

from quadrl.aircraft.presets import in_real_air
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.machine import cores, machine
from quadrl.conditions.randomization import FACTORS, Randomization
from quadrl.conditions.randomizations import RANDOMIZATIONS
from quadrl.core.scenario import Scenario
from quadrl.core.task import Task
from quadrl.learning import workloads
from quadrl.learning.workloads import FREE_FLIGHT_ENVS, HEIGHT, POSTS, Work
from quadrl.tasks import make

ALL_CORES, ONE_CORE = "all cores", "one core"
LOW = 0.5  # [m], where they feel the ground
FULL = RANDOMIZATIONS["full"]
DIFFERENT = Randomization(**{name: getattr(FULL, name) for name in (*FACTORS, "rotors")})
"""Aircraft that differ; nothing else is drawn."""
FREE_FLIGHT = "free flight"  # Environment of FREE_FLIGHT_ENVS
KERNEL = "kernel"  # free flight of FREE_FLIGHT_ENVS on one core and nothing else


class Layer(NamedTuple):
    """One row of the measurement."""

    what: str
    of: str
    """The yardstick: bare mj_step on ALL_CORES or ONE_CORE, or another layer."""
    work: Work
    target: float | None = None
    """Share of the yardstick that it should reach."""
    is_yardstick: str = ""
    """The yardstick that it is a candidate for; the fastest candidate is the yardstick."""


def benchmark(
    task: str, *, num_envs: int = 1024, seconds: float = 0.2, repeats: int = 30
) -> dict[str, Any]:
    """Measure all layers in turns, several times each, so that drift affects all alike.

    Args:
        task: Name of a task.
        num_envs: Aircraft in the batches.
        seconds: Length of each measurement; short, since the speed of a machine drifts.
        repeats: Measurements of each layer. The fastest is the rate: other work on the machine only
            slows a layer down.

    Returns:
        `rates`: for each layer `what`, `rate` [control steps/s], all `repeats` of it, `share` of
        `of` (the median of the ratios within one turn), and its `target` (None: none is set). `of`
        is bare mj_step on all cores or on one, or another layer. `machine`, and the settings. The
        TorchRL layer is left out where TorchRL is not installed.
    """
    with contextlib.ExitStack() as stack:
        layers = _layers(make(task), num_envs, stack)
        rates = _measure([layer.work for layer in layers], seconds, repeats)
    yardsticks: dict[str, list[float]] = {}
    for layer, measured in zip(layers, rates, strict=True):
        best = yardsticks.get(layer.is_yardstick, measured)
        yardsticks[layer.is_yardstick] = max(best, measured, key=statistics.median)
    found = []
    for layer, measured in zip(layers, rates, strict=True):
        share = statistics.median(map(operator.truediv, measured, yardsticks[layer.of]))
        row = {"what": layer.what, "rate": max(measured), "repeats": measured, "share": share}
        found.append(row | {"of": layer.of, "target": layer.target})
    given = {"task": task, "num_envs": num_envs, "seconds": seconds}
    return {**given, "rates": found, "machine": machine()}


def rows(measured: dict[str, Any]) -> list[tuple[str, ...]]:
    """Format what `benchmark` returned as rows of text, the head first."""
    written: list[tuple[str, ...]] = [("what", "steps/s", "median", "share", "of", "target")]
    for row in measured["rates"]:
        what, rate = row["what"], row["rate"]
        if what.startswith(KERNEL):
            what += f": {1e9 / (rate * Vehicle().substeps):,.0f} ns a physics step"
        speeds = (f"{rate:,.0f}" for rate in (rate, statistics.median(row["repeats"])))
        target = "" if row["target"] is None else f"{row['target']:.2f}"
        of = "mj_step" if row["of"] in (ALL_CORES, ONE_CORE) else row["of"]
        written.append((what, *speeds, f"{row['share']:.2f}", of, target))
    return written


def _measure(works: list[Work], seconds: float, repeats: int) -> list[list[float]]:
    """Measure the control steps per second of each work, `repeats` times over."""
    for work in works:
        next(work)  # the first call is slower
    rates: list[list[float]] = [[] for _ in works]
    for _ in range(repeats):
        for work, measured in zip(works, rates, strict=True):
            steps, began, elapsed = 0, time.perf_counter(), 0.0
            while elapsed < seconds:
                steps += next(work)
                elapsed = time.perf_counter() - began
            measured.append(steps / elapsed)
    return rates


def _layers(task: Task, num_envs: int, stack: contextlib.ExitStack) -> list[Layer]:
    """Make all layers; what has to be closed goes to the stack."""
    gymnasium_id = task.gymnasium_id()
    vehicle, size, free = Vehicle(), f"{num_envs:,}", f"{FREE_FLIGHT_ENVS:,}"
    air = in_real_air(vehicle)
    model = Scenario.of(task, vehicle=vehicle).compile_model(drawn=False)
    alone = gym.make(gymnasium_id)
    vectors: Any = gym.make_vec(gymnasium_id, num_envs=num_envs)
    for env in (alone, vectors):
        stack.callback(env.close)
    batch = workloads.batched_mj_step(vehicle, model, num_envs)
    flying = partial(workloads.environment, num_envs=FREE_FLIGHT_ENVS, engine="free_flight")
    posts = workloads.among_posts(task)
    layers = [
        Layer("mj_step, a loop on each core", ALL_CORES,
              workloads.mj_step(vehicle, model, cores()), None, ALL_CORES),
        Layer(f"mj_step, mujoco.batch of {size}", ALL_CORES, batch, None, ALL_CORES),
        Layer("the same with mujoco's own stage clock", ALL_CORES, workloads.with_clock(batch)),
        Layer(f"Environment of {size}", ALL_CORES,
              workloads.environment(task, num_envs=num_envs), 0.90),
        Layer(f"Environment of {free}, {FREE_FLIGHT}", ALL_CORES, flying(task), 20.0, FREE_FLIGHT),
        Layer("the same in real air and wind", FREE_FLIGHT,
              flying(task, vehicle=air, weather="light"), 1 / 3),
        Layer("the same, different aircraft", FREE_FLIGHT,
              flying(task, randomization=DIFFERENT), 0.90),
        Layer("the same, all that is drawn", FREE_FLIGHT, flying(task, randomization=FULL)),
        Layer("the same by velocities, flown by loops", FREE_FLIGHT,
              flying(task, control_mode="velocity"), 1 / 3),
        Layer(f"the same among {POSTS} posts", FREE_FLIGHT, flying(posts), 0.80),
        Layer("only how far those posts are", FREE_FLIGHT, workloads.clearance(posts), 4.0),
        Layer(f"Gymnasium make_vec of {size}", ALL_CORES, workloads.vectors(vectors)),
    ]  # fmt: skip
    if importlib.util.find_spec("torchrl"):
        what = f"TorchRL collector of {size} with a policy"
        layers.append(Layer(what, ALL_CORES, workloads.collector(task, num_envs, stack), 0.75))
    layers += [
        Layer("mj_step, a loop on one core", ONE_CORE,
              workloads.mj_step(vehicle, model, 1), None, ONE_CORE),
        Layer("Gymnasium make, one aircraft", ONE_CORE,
              workloads.single(alone, model.nu, lambda step: step[2] or step[3]), 0.35),
    ]  # fmt: skip
    if importlib.util.find_spec("dm_control"):
        from quadrl.envs import dm_control

        loaded = dm_control.make(task, random=0)
        stack.callback(loaded.close)
        flown = workloads.single(loaded, model.nu, lambda step: step.last())
        layers.append(Layer("dm_control load, one aircraft", ONE_CORE, flown))
    return [
        *layers,
        Layer(KERNEL, ONE_CORE, workloads.free_flight(vehicle, HEIGHT), None, KERNEL),
        Layer(f"{KERNEL} in air", KERNEL, workloads.free_flight(air, HEIGHT), 1 / 3),
        Layer(f"{KERNEL} near the ground", KERNEL, workloads.free_flight(air, LOW), 1 / 3),
        Layer(f"{KERNEL}, different aircraft", KERNEL,
              workloads.free_flight(vehicle, HEIGHT, DIFFERENT), 0.90),
    ]  # fmt: skip
