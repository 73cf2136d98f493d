"""The speed of every layer, measured in one process.

The yardstick is bare `mj_step`: the same lean model with the same callbacks under random commands,
which move it as random actions do (a step at rest takes an eighth less time). Every rate is in
control steps per second.
"""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import operator
import statistics
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
from mujoco.batch import Batch

from quadrl.aircraft.presets import in_real_air
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.machine import cores, machine
from quadrl.conditions.randomization import FACTORS, Randomization
from quadrl.conditions.randomizations import RANDOMIZATIONS
from quadrl.conditions.sampler import AircraftSampler
from quadrl.conditions.solids import Cylinder
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.core.task import Task
from quadrl.engines.mujoco import BatchEngine
from quadrl.tasks import make

Work = Iterator[int]
"""An iterator that flies some control steps at each `next` and gives their number."""

ALL_CORES, ONE_CORE = "all cores", "one core"
CHUNK = 200  # control steps of one aircraft between two looks at the clock
FLIGHT = 16  # control steps from hover under random commands, until bare aircraft are put back
HEIGHT = 3.0  # [m], where the aircraft of bare mj_step begin; in a FLIGHT they come near nothing
LOW = 0.5  # [m], where they feel the ground
FULL = RANDOMIZATIONS["full"]
DIFFERENT = Randomization(**{name: getattr(FULL, name) for name in (*FACTORS, "rotors")})
"""Aircraft that differ; nothing else is drawn."""
FREE_FLIGHT_ENVS = 4096
POSTS = 100
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
    batch = _batched_mj_step(vehicle, model, num_envs)
    flying = partial(_environment, num_envs=FREE_FLIGHT_ENVS, engine="free_flight")
    layers = [
        Layer("mj_step, a loop on each core", ALL_CORES,
              _mj_step(vehicle, model, cores()), None, ALL_CORES),
        Layer(f"mj_step, mujoco.batch of {size}", ALL_CORES, batch, None, ALL_CORES),
        Layer("the same with mujoco's own stage clock", ALL_CORES, _with_clock(batch)),
        Layer(f"Environment of {size}", ALL_CORES, _environment(task, num_envs=num_envs), 0.90),
        Layer(f"Environment of {free}, {FREE_FLIGHT}", ALL_CORES, flying(task), 20.0, FREE_FLIGHT),
        Layer("the same in real air and wind", FREE_FLIGHT,
              flying(task, vehicle=air, weather="light"), 1 / 3),
        Layer("the same, different aircraft", FREE_FLIGHT,
              flying(task, randomization=DIFFERENT), 0.90),
        Layer("the same, all that is drawn", FREE_FLIGHT, flying(task, randomization=FULL)),
        Layer("the same by velocities, flown by loops", FREE_FLIGHT,
              flying(task, control_mode="velocity"), 1 / 3),
        Layer(f"the same among {POSTS} posts", FREE_FLIGHT, flying(_among_posts(task)), 0.80),
        Layer("only how far those posts are", FREE_FLIGHT, _clearance(_among_posts(task)), 4.0),
        Layer(f"Gymnasium make_vec of {size}", ALL_CORES, _vectors(vectors)),
    ]  # fmt: skip
    if importlib.util.find_spec("torchrl"):
        what = f"TorchRL collector of {size} with a policy"
        layers.append(Layer(what, ALL_CORES, _collector(task, num_envs, stack), 0.75))
    layers += [
        Layer("mj_step, a loop on one core", ONE_CORE,
              _mj_step(vehicle, model, 1), None, ONE_CORE),
        Layer("Gymnasium make, one aircraft", ONE_CORE,
              _single(alone, model.nu, lambda step: step[2] or step[3]), 0.35),
    ]  # fmt: skip
    if importlib.util.find_spec("dm_control"):
        from quadrl.envs import dm_control

        loaded = dm_control.make(task, random=0)
        stack.callback(loaded.close)
        flown = _single(loaded, model.nu, lambda step: step.last())
        layers.append(Layer("dm_control load, one aircraft", ONE_CORE, flown))
    return [
        *layers,
        Layer(KERNEL, ONE_CORE, _free_flight(vehicle, HEIGHT), None, KERNEL),
        Layer(f"{KERNEL} in air", KERNEL, _free_flight(air, HEIGHT), 1 / 3),
        Layer(f"{KERNEL} near the ground", KERNEL, _free_flight(air, LOW), 1 / 3),
        Layer(f"{KERNEL}, different aircraft", KERNEL,
              _free_flight(vehicle, HEIGHT, DIFFERENT), 0.90),
    ]  # fmt: skip


def _actions(*shape: int) -> Iterator[np.ndarray]:
    """Cycle through 64 random actions (*shape) float32, so that drawing them is not measured."""
    drawn = np.random.default_rng(0).uniform(-1, 1, (64, *shape))
    return itertools.cycle(drawn.astype(np.float32))


def _commands(vehicle: Vehicle, *shape: int) -> Iterator[np.ndarray]:
    """Cycle through the rotor commands (*shape, R) [rad/s] of random actions."""
    shape = (64, *shape, vehicle.rotor_count)
    return itertools.cycle(vehicle.rotor_command(np.random.default_rng(0).uniform(-1, 1, shape)))


def _mj_step(vehicle: Vehicle, model: mujoco.MjModel, cores: int) -> Work:
    """Fly with `mj_step` at its best: one aircraft per core, one command per flight."""
    aircraft, commands = [mujoco.MjData(model) for _ in range(cores)], _commands(vehicle)

    def fly(data: mujoco.MjData) -> None:
        for _ in range(8):
            mujoco.mj_resetData(model, data)
            data.qpos[2], data.act[:] = HEIGHT, vehicle.hover_speed
            data.ctrl[:] = next(commands)
            mujoco.mj_step(model, data, FLIGHT * vehicle.substeps)

    with ThreadPoolExecutor(cores) as pool:
        while True:
            list(pool.map(fly, aircraft))
            yield 8 * FLIGHT * cores


def _batched_mj_step(vehicle: Vehicle, model: mujoco.MjModel, num_envs: int) -> Work:
    """Fly with MuJoCo's native batch on all cores."""
    batch, commands = Batch(model, num_envs), _commands(vehicle, num_envs)
    batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    batch.bind("qpos")[:, 2] = HEIGHT
    batch.bind("act")[:] = vehicle.hover_speed
    hovering, ctrl = batch.state.copy(), batch.bind("ctrl")
    while True:
        batch.state[:] = hovering
        for _ in range(FLIGHT):
            ctrl[:] = next(commands)
            batch.step(nstep=vehicle.substeps)
            yield num_envs


def _with_clock(work: Work) -> Work:
    """Do the same with mujoco's own clock, which it reads at every stage of a step."""
    while True:
        ours = mujoco.get_mjcb_time()
        mujoco.set_mjcb_time(None)
        try:
            steps = next(work)
        finally:
            mujoco.set_mjcb_time(ours)
        yield steps


def _free_flight(
    vehicle: Vehicle, height: float, randomization: Randomization | None = None
) -> Work:
    """Fly from hover at a height [m] with the free-flight engine alone."""
    count, sampler = FREE_FLIGHT_ENVS, AircraftSampler(randomization, vehicle)
    per_row = sampler.randomization.per_row
    settings: Any = {"engine": "free_flight", "num_threads": 1, "per_row": per_row}
    engine = BatchEngine(vehicle, count, altitude=height, **settings)
    if per_row:
        drawn = sampler.sample(np.random.default_rng(0).random((count, len(sampler.names))))
        engine.write_parameters(np.arange(count), sampler.table(drawn))
    commands = _commands(vehicle, count)
    while True:
        engine.qpos[:], engine.qvel[:] = (0, 0, height, 1, 0, 0, 0), 0.0
        engine.act[:] = vehicle.hover_speed
        for _ in range(FLIGHT):
            engine.ctrl[:] = next(commands)
            engine.advance(vehicle.substeps)
            yield count


def _environment(task: Task, **settings: Any) -> Work:
    environment = Environment(task, seed=0, **settings)
    environment.flatten(environment.reset())
    for action in _actions(num_envs := environment.num_envs, environment.action_size):
        now = environment.step(action)
        observation = environment.flatten(now.observation)
        over = np.asarray(now.terminated | now.truncated)
        if over.any():
            observation[over] = environment.flatten(environment.reset(over))
        yield num_envs


def _among_posts(task: Task) -> Task:
    """Put the task into a world with posts, all of them too far away to be hit."""
    places = np.random.default_rng(0).uniform(8, 30, (POSTS, 2)) * (-1, 1)
    posts = [
        Cylinder(f"post_{k}", height=8.0, position=(x, y, 4.0)) for k, (x, y) in enumerate(places)
    ]
    own = {"name": f"{task.name}_among_posts", "solids": lambda _: posts}
    return type("AmongPosts", (type(task),), own)()


def _clearance(task: Task) -> Work:
    """Compute the clearance of aircraft in flight, where they are after each of some steps."""
    environment = Environment(task, num_envs=FREE_FLIGHT_ENVS, seed=0, engine="free_flight")
    environment.reset()
    engine, flown = environment.engine, list[np.ndarray]()
    for action in itertools.islice(_actions(FREE_FLIGHT_ENVS, environment.action_size), FLIGHT):
        environment.step(action)
        flown.append(engine.qpos.copy())
    for places in itertools.cycle(flown):
        engine.qpos[:] = places
        engine.clearance()
        yield FREE_FLIGHT_ENVS


def _vectors(envs: Any) -> Work:
    envs.reset(seed=0)
    for action in _actions(*envs.action_space.shape):
        envs.step(action)
        yield envs.num_envs


def _single(env: Any, size: int, over: Callable[[Any], bool]) -> Work:
    """Fly one aircraft, which is reset when its episode is over."""
    actions = _actions(size)
    env.reset()
    while True:
        for _ in range(CHUNK):
            if over(env.step(next(actions))):
                env.reset()
        yield CHUNK


def _collector(task: Task, num_envs: int, stack: contextlib.ExitStack) -> Work:
    """Collect with the collector and the policy of a training."""
    from quadrl.envs.torchrl import QuadrotorEnv
    from quadrl.learning.algorithm import one_thread
    from quadrl.learning.config import TrainConfig
    from quadrl.learning.environments import make_collector
    from quadrl.learning.networks import make_actor_critic

    config = TrainConfig(task.name)
    env = QuadrotorEnv(task, num_envs, seed=0)
    actor, _, _ = make_actor_critic(env.environment.size, env.environment.action_size, config)
    collector = make_collector(env, actor, frames := num_envs * config.rollout)
    stack.callback(collector.shutdown)
    batches = iter(collector)
    while True:
        with one_thread():  # as in a training
            next(batches)
        yield frames
