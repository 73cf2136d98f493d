"""The stored exact solutions (tests/data/README.md), and how far an engine is from them."""

import functools
from pathlib import Path

import numpy as np
import reference

from quadrl.engines.mujoco import BatchEngine

DATA = Path(__file__).parent / "data"


@functools.cache
def exact(name):
    """Arrays of tests/data/exact.npz under a name, or the array of that name."""
    with np.load(DATA / "exact.npz") as file:
        if name in file:
            return file[name]
        prefix = f"{name}/"
        return {k.removeprefix(prefix): file[k] for k in file.files if k.startswith(prefix)}


def deviations(vehicle, engine, name, seconds):
    """How far an engine is at the end of the flights of a name, as `reference.deviation` has it."""
    flights = exact(name)
    batch = BatchEngine(vehicle, len(flights["start"]), altitude=3.0, engine=engine)
    batch.qpos[:], batch.qvel[:], batch.act[:] = reference.to_mujoco(flights["start"])
    batch.ctrl[:], batch.wind[:] = flights["command"], flights["wind"]
    batch.advance(round(seconds / vehicle.physics_timestep))
    return reference.deviation(batch.qpos, batch.qvel, batch.act, flights["end"])
