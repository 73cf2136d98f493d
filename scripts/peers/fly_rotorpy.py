"""Measures rotorpy's batched environment and dynamics; see measure.py."""

from __future__ import annotations

import copy
import itertools
from functools import partial

from measure import FLIGHT, Facts, Row, Work, arguments, cycle, measure, serve

# isort: split
import numpy as np
import torch
from rotorpy.learning.quadrotor_environments import QuadrotorEnv, make_default_vec_env
from rotorpy.vehicles.crazyflie_params import quad_params

SYSTEM = "rotorpy"
TRIAL = 0.5  # [s]


def made(num_envs: int) -> tuple[Facts, QuadrotorEnv]:
    """Its hover, with commands to the rotors as quadrl's has."""
    cpu = torch.device("cpu")
    env = make_default_vec_env(num_envs, quad_params, "cmd_motor_speeds", cpu)
    return Facts(
        env.t_step,
        env.t_step,
        f"{env.quadrotors.integrator.upper()}, torchdiffeq's",
        str(env.vehicle_states["x"].dtype).removeprefix("torch."),
        "rotor lag and noise, drag, flapping; commands rotor speeds",
    ), env


def best_threaded(work: Work) -> Work:
    """The same with one of torch's threads or all, whichever is faster here.

    They wait for each other by spinning, and where anything else runs all are slower than one.
    """
    speeds = {}
    for threads in {1, torch.get_num_threads()}:
        torch.set_num_threads(threads)
        work()
        tried = measure(work, TRIAL)
        speeds[threads] = tried["steps"] / tried["seconds"]
    best = max(speeds, key=speeds.__getitem__)

    def threaded() -> tuple[int, int]:
        torch.set_num_threads(best)
        return work()

    return threaded


def environment(num_envs: int) -> tuple[Facts, Work]:
    """Its vector environment, of one aircraft or many; it resets a row on its last step."""
    facts, env = made(num_envs)
    env.reset(seed=0)
    drawn = itertools.islice(cycle(-1, 1, (num_envs, 4)), 64)
    actions = itertools.cycle([action.astype(np.float32) for action in drawn])

    def work() -> tuple[int, int]:
        _, _, done, _ = env.step(next(actions))
        return num_envs, int(np.count_nonzero(done))

    return facts, best_threaded(work)


def physics(num_envs: int) -> tuple[Facts, Work]:
    """The batched dynamics alone."""
    facts, env = made(num_envs)
    low, high = env.rotor_speed_min[0], env.rotor_speed_max[0]
    drawn = itertools.islice(cycle(low, high, (num_envs, 4)), 64)
    commands = itertools.cycle([{"cmd_motor_speeds": torch.from_numpy(x)} for x in drawn])
    start, turns = env.initial_states, itertools.count()
    state = start

    def work() -> tuple[int, int]:
        nonlocal state
        if next(turns) % FLIGHT == 0:
            state = copy.deepcopy(start)
        state = env.quadrotors.step(state, next(commands), env.t_step)
        return num_envs, 0

    return facts, best_threaded(work)


def main() -> None:
    """Serve one aircraft and the batches."""
    sizes = arguments()
    rows = [Row(SYSTEM, "one", 1, partial(environment, 1))]
    rows += [Row(SYSTEM, "batch", n, partial(environment, n)) for n in sizes]
    rows.append(Row(SYSTEM, "physics", max(sizes), partial(physics, max(sizes))))
    serve(rows, ("rotorpy", "torch", "torchdiffeq", "numpy"))


if __name__ == "__main__":
    main()
