"""Measures crazyflow's reach-a-position environment and its simulator; see measure.py."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

from measure import CHUNK, FLIGHT, Facts, Row, Work, actions, arguments, cycle, serve

# isort: split
import crazyflow.envs  # noqa: F401 - registers the ids
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from crazyflow.control import Control
from crazyflow.drones import Drone
from crazyflow.dynamics import Dynamics
from crazyflow.envs.drone_env import action_space
from crazyflow.sim import Sim
from crazyflow.sim.integration import Integrator
from crazyflow.sim.sim import rotor_vel_limits
from jax import Array

SLOW = 50
"""Actions a second at which a control step is ten physics steps; 500, of one, is its default."""
FITTED = "attitude response fitted to flights, no rotors; commands attitude and thrust"
ROTORS = "rotor lag, drag; commands rotor speeds"
METHODS = {
    Integrator.euler: "Euler",
    Integrator.rk4: "RK4",
    Integrator.symplectic_euler: "symplectic Euler",
}


def facts(sim: Sim, substeps: int, model: str) -> Facts:
    """What a simulator computes."""
    method = f"{METHODS[sim.integrator]}, analytic"
    precision = str(sim.data.states.pos.dtype)
    return Facts(substeps / sim.freq, 1 / sim.freq, method, precision, model)


def environment(num_envs: int, frequency: int) -> tuple[Facts, Work]:
    """Its vector environment; it waits for the results only now and then, as a JAX policy would."""
    env = gym.make_vec("DroneReachPos-v0", num_envs=num_envs, freq=frequency)
    env.reset(seed=0)
    drawn = itertools.islice(actions(env.action_space), 64)
    chosen = itertools.cycle([jnp.asarray(action) for action in drawn])
    sim = env.unwrapped.sim

    def work() -> tuple[int, int]:
        flown = [env.step(next(chosen)) for _ in range(CHUNK)]
        jax.block_until_ready(flown)
        ended = sum(int(np.count_nonzero(step[2] | step[3])) for step in flown)
        return CHUNK * num_envs - ended, ended

    return facts(sim, env.unwrapped.n_substeps, FITTED), work


def fitted(num_worlds: int) -> tuple[Facts, Work]:
    """The simulator of the environment alone."""
    sim = Sim(num_worlds, drone=Drone.cf2x_L250, dynamics=Dynamics.so_rpy)
    space = action_space(Control.attitude, Dynamics.so_rpy, Drone.cf2x_L250)
    return fly(sim, sim.attitude_control, space.low, space.high, FITTED)


def modelled(num_worlds: int) -> tuple[Facts, Work]:
    """The simulator with the dynamics and the integrator that are nearest to quadrl's."""
    dynamics, drone = Dynamics.first_principles, Drone.cf2x_L250
    sim = Sim(
        num_worlds,
        drone=drone,
        dynamics=dynamics,
        control=Control.rotor_vel,
        integrator=Integrator.rk4,
    )
    return fly(sim, sim.rotor_vel_control, *rotor_vel_limits(dynamics, drone), ROTORS)


def fly(
    sim: Sim, command: Callable[[Array], None], low: Any, high: Any, model: str
) -> tuple[Facts, Work]:
    """Random commands in control steps as long as those of the slow environment."""
    drawn = itertools.islice(cycle(low, high, (sim.n_worlds, 1, 4)), 64)
    chosen = itertools.cycle([jnp.asarray(x, dtype=jnp.float32) for x in drawn])
    substeps, turns = sim.freq // SLOW, itertools.count()

    def work() -> tuple[int, int]:
        if next(turns) % FLIGHT == 0:
            sim.reset()
        command(next(chosen))
        sim.step(substeps)
        jax.block_until_ready(sim.data.states)
        return sim.n_worlds, 0

    return facts(sim, substeps, model), work


def main() -> None:
    """Serve the environment at two rates, and the simulator."""
    sizes = arguments()
    rows = []
    for frequency in (SLOW, 500):
        system = f"crazyflow, {frequency} Hz"
        for n in (1, *sizes):
            what = "one" if n == 1 else "batch"
            make = partial(environment, n, frequency)
            rows.append(Row(system, what, n, make))
    n = max(sizes)
    rows.append(Row(f"crazyflow, {SLOW} Hz", "physics", n, partial(fitted, n)))
    rows.append(Row("crazyflow, RK4", "physics", n, partial(modelled, n)))
    serve(rows, ("crazyflow", "jax", "mujoco", "numpy", "gymnasium"))


if __name__ == "__main__":
    main()
