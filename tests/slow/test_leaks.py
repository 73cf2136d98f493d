"""Environments that are opened and closed, or flown on and on, keep no memory.

Each kind is measured in a fresh interpreter, which runs this file.
"""

import ctypes
import gc
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

sys.path.append(str(Path(__file__).parents[1]))  # this file is run, too

import apis  # noqa: E402
from helpers import needs_dm_control  # noqa: E402

from quadrl.core.environment import Environment  # noqa: E402

PICTURE = {"render_mode": "rgb_array", "width": 64, "height": 48}
KEPT = []


def opened(api, picture=False, **settings):
    """An environment that is flown for a step, and closed."""
    flown = api("landing", **settings)
    flown.reset()
    flown.step(np.zeros((flown.rows, 4), np.float32))
    if picture:
        flown.environment.render()
    flown.environment.close()


def vectors():
    for engine in ("mujoco", "free_flight"):
        opened(apis.Vector, engine=engine)


def flights():
    """Half a second of random flights in both engines, down to the ground, with resets."""
    if not KEPT:
        for engine in ("mujoco", "free_flight"):
            KEPT.append(Environment("landing", num_envs=16, num_threads=1, engine=engine))
            KEPT[-1].reset()
    for environment in KEPT:
        for _ in range(10):
            now = environment.step(np.random.uniform(-1, 1, (16, 4)))
            over = now.terminated | now.truncated
            if over.any():
                environment.reset(over)


def leak():
    KEPT.append(np.ones(1024))  # 8 kB


# What is done; how often before the first reading, and how often then; what may be kept each time
# [kB]. An open environment has 500 or more, dm_control's 6,000, one that draws 170,000.
WORK = {
    "dm_control": (lambda: opened(apis.DmControl), 10, 40, 60.0),
    "gymnasium": (lambda: opened(apis.Gymnasium), 30, 80, 5.0),
    "gymnasium_vector": (vectors, 30, 60, 20.0),
    "torchrl": (lambda: opened(apis.TorchRL), 15, 30, 20.0),
    "picture": (lambda: opened(apis.Gymnasium, picture=True, **PICTURE), 3, 10, 2000.0),
    "flights": (flights, 30, 40, 5.0),
    "leak": (leak, 30, 40, 5.0),
}


def resident():
    """Memory of this process [kB], without what Python and the C library keep for later."""
    gc.collect()
    getattr(ctypes.CDLL(None), "malloc_trim", int)(0)  # glibc has it
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1024


def measure(name):
    """Slope of the memory over the times that something is done [kB].

    The median slope of all pairs of readings: what an allocator or a driver takes now and then does
    not count, a leak does.
    """
    work, before, count, _ = WORK[name]
    for _ in range(before):
        work()
    gc.collect()
    gc.freeze()  # the modules: a collection then takes a millisecond and not a hundred
    marks = []
    for _ in range(count):
        work()
        marks.append(resident())
    return stats.theilslopes(marks)[0]


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize("name", WORK)
def test_nothing_is_kept(name):
    if name == "dm_control":
        needs_dm_control()
    command = [sys.executable, "-W", "ignore", __file__, name]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    limit = WORK[name][-1]
    assert (float(done.stdout) > limit) == (name == "leak")


if __name__ == "__main__":
    print(measure(sys.argv[1]))
