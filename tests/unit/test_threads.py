"""Many threads of Python at once: nobody's numbers depend on who else flies."""

import threading
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from processes import python

from quadrl.aircraft.presets import VEHICLES
from quadrl.core.environment import Environment
from quadrl.engines import mjcf

THREADS = 8
STEPS = 30  # 1.5 s of hover, or 0.6 s of a racer: some episodes end, in the air and on the ground
ACTIONS = np.random.default_rng(5).uniform(-1, 1, (THREADS, STEPS, 4, 6))
NAMES = ("paper", "racer", "crazyflie", "hexa")


def environment(thread: int) -> np.ndarray:
    """A batch or a single aircraft with resets in between; every thread has another case."""
    engine = ("mujoco", "free_flight")[thread % 2]
    task = ("hover", "landing", "target_following", "straight_and_level")[thread // 2 % 4]
    vehicle, count = VEHICLES[NAMES[thread % 4]], 1 if thread % 4 == 3 else 4
    settings = {"randomization": {"command_delay": (0.0, 0.02), "mass": (1.0, 1.05)}}
    flown = Environment(
        task,
        num_envs=count,
        seed=thread,
        engine=engine,
        vehicle=vehicle,
        num_threads=2,
        **settings if thread % 3 else {},
    )
    flown.reset()
    log = []
    for action in ACTIONS[thread]:
        now = flown.step(action[:count, : vehicle.rotor_count])
        log.append([*np.ravel(flown.engine.qpos), *np.ravel(now.reward)])
        if (over := now.terminated | now.truncated).any():
            flown.reset(over)
    return np.array(log)


def opened_and_closed(thread: int) -> np.ndarray:
    """Environments that live for two steps, large enough to fly on several threads."""
    ends = []
    for k in range(4):
        count = 16 if k % 2 else 600
        flown = Environment("hover", num_envs=count, seed=10 * thread + k, engine="free_flight")
        flown.reset()
        for action in ACTIONS[thread, :2, :1, :4]:
            flown.step(np.broadcast_to(action, (count, 4)))
        ends.append(flown.engine.qpos.sum(axis=0))
    return np.array(ends)


def plain_model(thread: int) -> np.ndarray:
    """Bare mj_step of a model of ours, and of one that is not."""
    ours = mjcf.compile_model(VEHICLES[NAMES[thread % 4]], contact=thread % 2 == 0)
    brick = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body pos='0 0 1'><freejoint/><geom size='.1'/></body>"
        "<geom type='plane' size='1 1 1'/></worldbody></mujoco>"
    )
    log = []
    for model in (ours, brick):
        data = mujoco.MjData(model)
        data.qpos[2] = 1.0 + 0.1 * thread
        for k in range(2 * STEPS):
            data.ctrl[:] = 100.0 + k if model is ours else 0.0
            mujoco.mj_step(model, data)
        log += [*data.qpos, *data.qvel, *data.act]
    return np.array(log)


def at_once(work: Callable[[int], np.ndarray]) -> list[np.ndarray]:
    """What `work` gives each thread, all of them started together."""
    results: dict[int, np.ndarray | BaseException] = {}
    barrier = threading.Barrier(THREADS)

    def run(thread: int) -> None:
        barrier.wait()
        try:
            results[thread] = work(thread)
        except BaseException as error:
            results[thread] = error

    threads = [threading.Thread(target=run, args=(k,)) for k in range(THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=120)
    assert not any(thread.is_alive() for thread in threads), "a thread hangs"
    for result in results.values():
        if isinstance(result, BaseException):
            raise result
    return [results[k] for k in range(THREADS)]


@pytest.mark.slow
@pytest.mark.parametrize("work", [environment, opened_and_closed, plain_model])
def test_eight_threads_get_bit_for_bit_what_one_gets(work):
    alone = [work(thread) for thread in range(THREADS)]
    assert len({result.tobytes() for result in alone}) == THREADS  # every thread has other numbers
    for together, expected in zip(at_once(work), alone, strict=True):
        np.testing.assert_array_equal(together, expected)


def test_the_first_environments_of_a_process_may_be_made_in_threads():
    code = (
        "import time\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from quadrl.engines import native\n"
        "from quadrl.core.environment import Environment\n"
        "load = native.load\n"
        "native.load = lambda path: (time.sleep(0.5), load(path))[1]\n"  # so that they meet
        "def make(seed): return Environment('hover', seed=seed).reset()\n"
        "list(ThreadPoolExecutor(4).map(make, range(4)))\n"
        "make(4)"
    )
    python("-W", "error", "-c", code)
