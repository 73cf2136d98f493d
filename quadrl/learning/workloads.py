"""What the benchmark flies: each layer as an iterator over control steps, under random actions."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from quadrl.aircraft.vehicle import Vehicle
from quadrl.conditions.randomization import Randomization
from quadrl.conditions.sampler import AircraftSampler
from quadrl.conditions.solids import Cylinder
from quadrl.core.environment import Environment
from quadrl.core.task import Task
from quadrl.engines.mujoco import BatchEngine

Work = Iterator[int]
"""An iterator that flies some control steps at each `next` and gives their number."""

CHUNK = 200  # control steps of one aircraft between two looks at the clock
FLIGHT = 16  # control steps from hover under random commands, until bare aircraft are put back
HEIGHT = 3.0  # [m], where the aircraft of bare mj_step begin; in a FLIGHT they come near nothing
FREE_FLIGHT_ENVS = 4096
POSTS = 100


def mj_step(vehicle: Vehicle, model: mujoco.MjModel, cores: int) -> Work:
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


def batched_mj_step(vehicle: Vehicle, model: mujoco.MjModel, num_envs: int) -> Work:
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


def with_clock(work: Work) -> Work:
    """Do the same with mujoco's own clock, which it reads at every stage of a step."""
    while True:
        ours = mujoco.get_mjcb_time()
        mujoco.set_mjcb_time(None)
        try:
            steps = next(work)
        finally:
            mujoco.set_mjcb_time(ours)
        yield steps


def free_flight(
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


def environment(task: Task, **settings: Any) -> Work:
    """Fly a batch of environments, each of which is reset when its episode is over."""
    environment = Environment(task, seed=0, **settings)
    environment.flatten(environment.reset())
    for action in _actions(num_envs := environment.num_envs, environment.action_size):
        now = environment.step(action)
        observation = environment.flatten(now.observation)
        over = np.asarray(now.terminated | now.truncated)
        if over.any():
            observation[over] = environment.flatten(environment.reset(over))
        yield num_envs


def among_posts(task: Task) -> Task:
    """Put the task into a world with posts, all of them too far away to be hit."""
    places = np.random.default_rng(0).uniform(8, 30, (POSTS, 2)) * (-1, 1)
    posts = [
        Cylinder(f"post_{k}", height=8.0, position=(x, y, 4.0)) for k, (x, y) in enumerate(places)
    ]
    own = {"name": f"{task.name}_among_posts", "solids": lambda _: posts}
    return type("AmongPosts", (type(task),), own)()


def clearance(task: Task) -> Work:
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


def vectors(envs: Any) -> Work:
    """Fly the vector of environments that Gymnasium made."""
    envs.reset(seed=0)
    for action in _actions(*envs.action_space.shape):
        envs.step(action)
        yield envs.num_envs


def single(env: Any, size: int, over: Callable[[Any], bool]) -> Work:
    """Fly one aircraft, which is reset when its episode is over."""
    actions = _actions(size)
    env.reset()
    while True:
        for _ in range(CHUNK):
            if over(env.step(next(actions))):
                env.reset()
        yield CHUNK


def collector(task: Task, num_envs: int, stack: contextlib.ExitStack) -> Work:
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


def _actions(*shape: int) -> Iterator[np.ndarray]:
    """Cycle through 64 random actions (*shape) float32, so that drawing them is not measured."""
    drawn = np.random.default_rng(0).uniform(-1, 1, (64, *shape))
    return itertools.cycle(drawn.astype(np.float32))


def _commands(vehicle: Vehicle, *shape: int) -> Iterator[np.ndarray]:
    """Cycle through the rotor commands (*shape, R) [rad/s] of random actions."""
    shape = (64, *shape, vehicle.rotor_count)
    return itertools.cycle(vehicle.rotor_command(np.random.default_rng(0).uniform(-1, 1, shape)))
