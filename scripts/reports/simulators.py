"""Measures one simulator, in the environment of that simulator; peers.py runs it.

Arguments are the name of a simulator, the seconds of a measurement and the sizes of the batches. It
prints one JSON object.
"""

from __future__ import annotations

import copy
import itertools
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import Any

# Some simulators write to standard output, from C too and when they are imported: the answer keeps
# standard output, all else goes to standard error.
ANSWER = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)

import numpy as np  # noqa: E402

CHUNK = 10  # control steps of a single environment between two looks at the clock
FLIGHT = 16  # control steps under random commands until bare aircraft are put back

Work = Iterator[int]
"""Flies some control steps each time: how many, of all aircraft."""
Row = tuple[str, str, int, Callable[[], Work]]
"""System, what (one, batch or physics), number of aircraft, and what makes it."""


def cycle(low: Any, high: Any, shape: tuple[int, ...], kind: Any = float) -> Iterator[np.ndarray]:
    """Random numbers of a shape, over and over; drawing them is not measured."""
    drawn = np.random.default_rng(0).uniform(low, high, (64, *shape))
    return itertools.cycle(drawn.astype(kind))


def actions(space: Any) -> Iterator[np.ndarray]:
    """Random actions in a Box."""
    return cycle(space.low, space.high, space.shape, space.dtype)


def fly_one(env: Any) -> Work:
    """A Gymnasium environment, reset when its episode ends."""
    chosen = actions(env.action_space)
    env.reset(seed=0)
    while True:
        for _ in range(CHUNK):
            _, _, terminated, truncated, _ = env.step(next(chosen))
            if terminated or truncated:
                env.reset()
        yield CHUNK


def fly_batch(env: Any) -> Work:
    """A Gymnasium vector that resets a row on the step after its end; that step does not count."""
    env.reset(seed=0)
    for action in actions(env.action_space):
        _, _, terminated, truncated, _ = env.step(action)
        yield env.num_envs - int(np.count_nonzero(terminated | truncated))


def quadrl(sizes: list[int]) -> list[Row]:
    """Its hover in both engines."""
    import gymnasium as gym

    from quadrl.environment import Environment

    def physics(engine: Any, count: int) -> Work:
        environment = Environment("hover", num_envs=count, seed=0, engine=engine)
        environment.reset()
        flown, vehicle, start = environment.engine, environment.vehicle, environment.engine.save()
        drawn = itertools.islice(cycle(-1, 1, (count, vehicle.rotor_count)), 64)
        commands = itertools.cycle([vehicle.rotor_command(action) for action in drawn])
        while True:
            flown.restore(start)
            for _ in range(FLIGHT):
                flown.ctrl[:] = next(commands)
                flown.advance(vehicle.substeps)
                yield count

    rows: list[Row] = []
    for engine, system in (("mujoco", "quadrl, MuJoCo"), ("free_flight", "quadrl, free flight")):
        task = {"id": "quadrl/Hover-v0", "engine": engine}
        rows.append((system, "one", 1, lambda task=task: fly_one(gym.make(**task))))
        for n in sizes:
            batch = {**task, "num_envs": n}
            rows.append((system, "batch", n, lambda batch=batch: fly_batch(gym.make_vec(**batch))))
        rows.append((system, "physics", n, lambda engine=engine, n=n: physics(engine, n)))
    return rows


def pyflyt(_: list[int]) -> list[Row]:
    """QuadX-Hover by itself and as Gymnasium's processes, and an aviary of one aircraft."""
    import gymnasium as gym
    import PyFlyt.gym_envs  # noqa: F401 - registers the ids
    from PyFlyt.core.aviary import Aviary

    task, cores = "PyFlyt/QuadX-Hover-v4", len(os.sched_getaffinity(0))

    def physics() -> Work:
        aviary = Aviary(np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3)), drone_type="quadx")
        aviary.set_mode(7)  # holds a position, off the ground, so that nothing has to be put back
        aviary.set_setpoint(0, np.array([0.0, 0.0, 0.0, 1.0]))
        while True:
            for _ in range(10):
                aviary.step()
            yield 10

    processes = {"id": task, "num_envs": cores, "vectorization_mode": "async"}
    return [
        ("PyFlyt", "one", 1, lambda: fly_one(gym.make(task))),
        ("PyFlyt", "batch", cores, lambda: fly_batch(gym.make_vec(**processes))),
        ("PyFlyt", "physics", 1, physics),
    ]


def rotorpy(sizes: list[int]) -> list[Row]:
    """Its hover with commands to the rotors, and the batched dynamics."""
    import torch
    from rotorpy.learning.quadrotor_environments import make_default_vec_env
    from rotorpy.vehicles.crazyflie_params import quad_params

    def made(count: int) -> Any:
        return make_default_vec_env(count, quad_params, "cmd_motor_speeds", torch.device("cpu"))

    def environment(count: int) -> Work:
        env = made(count)
        env.reset(seed=0)
        for action in cycle(-1, 1, (count, 4), np.float32):
            env.step(action)  # it resets a row on its last step
            yield count

    def physics(count: int) -> Work:
        env = made(count)
        low, high = env.rotor_speed_min[0], env.rotor_speed_max[0]
        drawn = itertools.islice(cycle(low, high, (count, 4)), 64)
        commands = itertools.cycle([{"cmd_motor_speeds": torch.from_numpy(x)} for x in drawn])
        while True:
            state = copy.deepcopy(env.initial_states)
            for _ in range(FLIGHT):
                state = env.quadrotors.step(state, next(commands), env.t_step)
                yield count

    def best_threaded(work: Work) -> Work:
        """With one of torch's threads or all: they spin, and beside other work all are slower."""
        speeds = {}
        for threads in {1, torch.get_num_threads()}:
            torch.set_num_threads(threads)
            next(work)
            speeds[threads] = measure(work, 0.5)
        best = max(speeds, key=speeds.__getitem__)
        while True:
            torch.set_num_threads(best)
            yield next(work)

    rows = [("one" if n == 1 else "batch", n, environment) for n in (1, *sizes)]
    rows.append(("physics", sizes[-1], physics))
    return [
        ("rotorpy", what, n, lambda make=make, n=n: best_threaded(make(n)))
        for what, n, make in rows
    ]


def crazyflow(sizes: list[int]) -> list[Row]:
    """Its reach-a-position environment at two rates, and its simulator."""
    import crazyflow.envs  # noqa: F401 - registers the ids
    import gymnasium as gym
    import jax
    import jax.numpy as jnp
    from crazyflow.control import Control
    from crazyflow.drones import Drone
    from crazyflow.dynamics import Dynamics
    from crazyflow.envs.drone_env import action_space
    from crazyflow.sim import Sim
    from crazyflow.sim.integration import Integrator
    from crazyflow.sim.sim import rotor_vel_limits

    def jaxed(drawn: Iterator[np.ndarray]) -> Iterator[Any]:
        return itertools.cycle([jnp.asarray(x) for x in itertools.islice(drawn, 64)])

    def environment(count: int, frequency: int) -> Work:
        env = gym.make_vec("DroneReachPos-v0", num_envs=count, freq=frequency)
        env.reset(seed=0)
        chosen = jaxed(actions(env.action_space))
        while True:  # it waits for the results only now and then, as a JAX policy would
            flown = [env.step(next(chosen)) for _ in range(CHUNK)]
            jax.block_until_ready(flown)
            yield CHUNK * count - sum(int(np.count_nonzero(now[2] | now[3])) for now in flown)

    def physics(modelled: bool) -> Work:
        """The simulator of the environment, or that with rotors and RK4, nearest to quadrl's."""
        drone, fitted = Drone.cf2x_L250, Dynamics.so_rpy
        kind = {"dynamics": Dynamics.first_principles if modelled else fitted}
        kind |= {"control": Control.rotor_vel, "integrator": Integrator.rk4} if modelled else {}
        sim, space = Sim(n, drone=drone, **kind), action_space(Control.attitude, fitted, drone)
        ends = rotor_vel_limits(kind["dynamics"], drone) if modelled else (space.low, space.high)
        command = sim.rotor_vel_control if modelled else sim.attitude_control
        chosen = jaxed(cycle(*ends, (n, 1, 4), np.float32))
        while True:  # control steps as long as those at 50 Hz
            sim.reset()
            for _ in range(FLIGHT):
                command(next(chosen))
                sim.step(sim.freq // 50)
                jax.block_until_ready(sim.data.states)
                yield n

    n = sizes[-1]
    rows: list[Row] = [
        (f"crazyflow, {rate} Hz", "one" if k == 1 else "batch", k,
         lambda k=k, rate=rate: environment(k, rate))
        for rate in (50, 500) for k in (1, *sizes)
    ]  # fmt: skip
    rows.append(("crazyflow, 50 Hz", "physics", n, lambda: physics(modelled=False)))
    return [*rows, ("crazyflow, RK4", "physics", n, lambda: physics(modelled=True))]


def measure(work: Work, seconds: float) -> float:
    """Fly until the time is over: control steps per second."""
    steps, began = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - began) < seconds or not steps:
        steps += next(work)
    return steps / elapsed


SIMULATORS = {"quadrl": quadrl, "PyFlyt": pyflyt, "rotorpy": rotorpy, "crazyflow": crazyflow}

if __name__ == "__main__":
    name, seconds, *sizes = sys.argv[1:]
    said = []
    for system, what, aircraft, make in SIMULATORS[name](sorted(map(int, sizes))):
        work = make()
        next(work)  # compiles
        rate = measure(work, float(seconds))
        said.append({"system": system, "what": what, "aircraft": aircraft, "rate": rate})
    print(json.dumps({"version": version(name), "rows": said}), file=ANSWER)
