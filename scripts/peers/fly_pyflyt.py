"""Measures PyFlyt's QuadX-Hover, by itself and as Gymnasium's processes; see measure.py."""

from __future__ import annotations

import os

from measure import Facts, Row, Work, arguments, fly_batch, fly_one, serve

# isort: split
import gymnasium as gym
import numpy as np
import PyFlyt.gym_envs  # noqa: F401 - registers the ids
from PyFlyt.core.aviary import Aviary

SYSTEM, TASK = "PyFlyt", "PyFlyt/QuadX-Hover-v4"
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
POSITION = 7
"""The flight mode that holds a position."""


def facts(aviary: Aviary, loops: int) -> Facts:
    """What an aviary computes in a control step of some turns of its control loop."""
    # Bullet keeps what single precision would lose, if it was built for double.
    drone = aviary.drones[0].Id
    before = aviary.getBasePositionAndOrientation(drone)
    aviary.resetBasePositionAndOrientation(drone, [1 + 1e-12, 0, 1], [0, 0, 0, 1])
    kept = aviary.getBasePositionAndOrientation(drone)[0][0] != 1
    aviary.resetBasePositionAndOrientation(drone, *before)
    return Facts(
        loops * aviary.step_period,
        aviary.physics_period,
        "semi-implicit Euler, Bullet's",
        "float64" if kept else "float32",
        "motor lag and noise, drag, contact; commands body rates, over its flight controller",
    )


def one() -> tuple[Facts, Work]:
    """Its Gymnasium environment."""
    env = gym.make(TASK)
    work = fly_one(env)
    return facts(env.unwrapped.env, env.unwrapped.env_step_ratio), work


def batch() -> tuple[Facts, Work]:
    """It has no batch: as many processes as there are cores."""
    known, _ = one()
    return known, fly_batch(gym.make_vec(TASK, num_envs=CORES, vectorization_mode="async"))


def physics() -> tuple[Facts, Work]:
    """An aviary of one aircraft, hovering under its own controller."""
    aviary = Aviary(np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3)), drone_type="quadx")
    aviary.set_mode(POSITION)  # off the ground, so that nothing has to be put back
    aviary.set_setpoint(0, np.array([0.0, 0.0, 0.0, 1.0]))

    def work() -> tuple[int, int]:
        for _ in range(10):
            aviary.step()
        return 10, 0

    return facts(aviary, 1), work


def main() -> None:
    """Serve; the sizes of the batches are of no use here."""
    arguments()
    rows = [
        Row(SYSTEM, "one", 1, one),
        Row(SYSTEM, "batch", CORES, batch),
        Row(SYSTEM, "physics", 1, physics),
    ]
    serve(rows, ("PyFlyt", "pybullet", "numba", "numpy", "gymnasium"))


if __name__ == "__main__":
    main()
