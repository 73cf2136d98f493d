"""Measures quadrl's hover; see measure.py."""

from __future__ import annotations

import itertools
from functools import partial

from measure import FLIGHT, Facts, Row, Work, arguments, cycle, fly_batch, fly_one, serve

# isort: split
import quadrl  # noqa: F401 - before anything that imports mujoco

# isort: split
import gymnasium as gym
import mujoco

from quadrl.environment import Environment
from quadrl.simulation import Engine, Simulation
from quadrl.vehicle import ROTORS

SYSTEMS: dict[Engine, str] = {"mujoco": "quadrl, MuJoCo", "flight": "quadrl, free flight"}


def facts(engine: Engine, simulation: Simulation) -> Facts:
    """What a simulation computes."""
    vehicle, option = simulation.vehicle, simulation.model.opt
    method = mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_")
    by = "MuJoCo's" if engine == "mujoco" else "analytic"
    return Facts(
        vehicle.control_step,
        option.timestep,
        f"{method}, {by}",
        str(simulation.qpos.dtype),
        "rotor lag, drag, aerodynamic moment; commands rotor speeds",
    )


def one(engine: Engine) -> tuple[Facts, Work]:
    """Gymnasium's environment of one aircraft."""
    env = gym.make("quadrl/Hover-v0", engine=engine)
    return facts(engine, env.unwrapped.environment.simulation), fly_one(env)


def batch(engine: Engine, num_envs: int) -> tuple[Facts, Work]:
    """Gymnasium's native vector."""
    env = gym.make_vec("quadrl/Hover-v0", num_envs=num_envs, engine=engine)
    return facts(engine, env.unwrapped.environment.simulation), fly_batch(env)


def physics(engine: Engine, num_envs: int) -> tuple[Facts, Work]:
    """The simulation alone, put back before it comes near anything."""
    environment = Environment("hover", num_envs=num_envs, seed=0, engine=engine)
    environment.reset()
    simulation = environment.simulation
    start = simulation.save()
    drawn = itertools.islice(cycle(-1, 1, (num_envs, ROTORS)), 64)
    commands = itertools.cycle([simulation.vehicle.rotor_command(action) for action in drawn])
    turns = itertools.count()

    def work() -> tuple[int, int]:
        if next(turns) % FLIGHT == 0:
            simulation.restore(start)
        simulation.ctrl[...] = next(commands)
        simulation.advance()
        return num_envs, 0

    return facts(engine, simulation), work


def main() -> None:
    """Serve both engines."""
    sizes = arguments()
    rows = []
    for engine, system in SYSTEMS.items():
        rows.append(Row(system, "one", 1, partial(one, engine)))
        for n in sizes:
            rows.append(Row(system, "batch", n, partial(batch, engine, n)))
        n = max(sizes)
        rows.append(Row(system, "physics", n, partial(physics, engine, n)))
    serve(rows, ("numpy", "gymnasium", "mujoco"))


if __name__ == "__main__":
    main()
