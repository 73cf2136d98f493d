"""What concerns the whole process: builds, spawned workers, MuJoCo's clock, limits and forks."""

import importlib.util
import multiprocessing
import os
import pickle
import re
import shutil
import textwrap
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import excited
import mujoco
import numpy as np
import pytest
from apis import APIS
from processes import python

from quadrl import VEHICLES, cli
from quadrl.aircraft.command_map import CommandMap
from quadrl.aircraft.presets import in_real_air
from quadrl.engines import native
from quadrl.engines.native import compiling
from quadrl.testing import varied_actions


def test_processes_that_build_at_once_do_not_disturb_each_other(tmp_path):
    settings = {"QUADRL_CACHE": str(tmp_path / "cache"), "QUADRL_CFLAGS": "-O0"}
    code = "from quadrl.engines.native import build, load; print(build()); load(build())"
    with ThreadPoolExecutor(4) as pool:
        running = [pool.submit(python, "-c", code, **settings) for _ in range(4)]
    (path,) = {one.result().stdout.strip() for one in running}
    assert os.listdir(tmp_path / "cache") == [Path(path).name]  # and no scratch left


def test_a_library_for_another_mujoco_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("QUADRL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("QUADRL_CFLAGS", "-O0")
    shutil.copytree(Path(mujoco.__file__).parent / "include", tmp_path / "include")
    header = tmp_path / "include" / "mujoco" / "mujoco.h"
    running = mujoco.mj_version()
    line = f"#define mjVERSION_HEADER {running}"
    assert line in header.read_text()
    header.write_text(header.read_text().replace(line, line + "0"))
    path = compiling.build(include=tmp_path / "include")
    with pytest.raises(native.NativeError, match=rf"{running}0.*{running}\b"):
        native.load(path)
    # The one for this mujoco stands beside it under another name.
    right = compiling.build()
    assert right != path
    assert native.load(right).quadrl_mujoco_version() == running


def fly_on(given, actions):
    """What pickled environments give."""
    many = pickle.loads(given)
    return [[one.copied(one.step(action[: one.rows])) for action in actions] for one in many]


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_environments_of_every_api_fly_on_in_another_process(engine):
    """With MuJoCo the callbacks, which that process has to load, must be the same."""
    settings = {"randomization": {"mass": (0.9, 1.1)}, "engine": engine}
    flown = APIS if importlib.util.find_spec("dm_control") else APIS[1:]
    many = [api(seed=1, **settings) for api in flown]
    actions = varied_actions(12, 4)[:, 2:]
    for one in many:
        one.reset()
        for action in actions[:5]:
            one.step(action[: one.rows])
    given = pickle.dumps(many)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        elsewhere = pool.apply(fly_on, (given, actions[5:]))
    here = fly_on(given, actions[5:])
    for one, other in zip(sum(here, []), sum(elsewhere, []), strict=True):
        for name, value in one.items():
            np.testing.assert_array_equal(value, other[name], err_msg=name)


FLY = """
import quadrl, mujoco
from quadrl.engines import mjcf
from quadrl.aircraft.vehicle import Vehicle
{before}
model = mjcf.compile_model(Vehicle(), drawn=False)
data = mujoco.MjData(model)
{after}
mujoco.mj_step(model, data)
timer = data.timer[mujoco.mjtTimer.mjTIMER_STEP]
print(timer.number, timer.duration > 0)
"""
TICKS = "import itertools; clock = itertools.count(1.0); mujoco.set_mjcb_time(lambda: next(clock))"
BACK = "mujoco.set_mjcb_time(None); mjcf.compile_model(Vehicle(), drawn=False)"
KEEP = "import os; os.environ['QUADRL_KEEP_CLOCK'] = '1'"


@pytest.mark.parametrize(
    ("before", "after", "moves"),
    [("", "", False), ("", BACK, True), (TICKS, "", True), (KEEP, "", True)],
    ids=["ours", "brought back", "somebody's", "kept"],
)
def test_the_clock_stands_still_unless_somebody_wants_it(before, after, moves):
    # In a process of its own: the clock is stopped once in a process.
    assert python("-c", FLY.format(before=before, after=after)).stdout == f"1 {moves}\n"


@pytest.mark.parametrize("missing", ["pytest torch torchrl tensordict", "dm_control dm_env"])
def test_the_contract_needs_neither_pytest_nor_torch_nor_dm_control(missing):
    code = (
        "import sys; sys.modules.update(dict.fromkeys(sys.argv[1].split()));"
        "import quadrl; quadrl.testing.check_task('hover')"
    )
    python("-c", code, missing)


LIMITED = """
import resource, sys
from quadrl import cli
from quadrl.learning import run
size = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
limit = size + int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
cli.main(sys.argv[2:])
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="ulimit -v is Linux's")
@pytest.mark.parametrize(
    "words",
    [
        ["evaluate", "hover", "--episodes", "100000"],
        ["train", "hover", "--num-envs", "65536", "--no-video", "--out", "run"],
        ["train", "hover", "--hidden", "8000", "8000", "--no-video", "--out", "run"],
    ],
)
def test_under_a_limit_of_the_shell_the_command_ends_in_one_line(words, tmp_path):
    ended = python("-c", LIMITED, 300 << 20, *words, code=2, cwd=tmp_path)
    (line,) = ended.stderr.splitlines()
    assert "memory" in line


FORKED = """
    import os, signal, sys
    import numpy as np
    from quadrl.engines.mujoco import BatchEngine
    from quadrl.core.environment import Environment
    from quadrl.base.errors import QuadrlError
    from quadrl.aircraft.vehicle import Vehicle

    def fly(environment, steps):
        actions = 0.3 * np.random.default_rng(1).uniform(-1, 1, (steps, environment.num_envs, 4))
        done = [environment.step(action) for action in actions]
        seen = environment.flatten(done[-1].observation)
        environment.reset(done[-1].terminated)
        return environment.engine.qpos.tobytes(), seen.tobytes()

    def in_a_child(work):
        sys.stdout.flush()
        if child := os.fork():
            _, status = os.waitpid(child, 0)
            assert os.waitstatus_to_exitcode(status) == 0, status
        else:
            signal.alarm(60)  # a child that hangs is killed
            work()
            sys.exit(0)  # by the long way, which frees everything

    def child():
        assert fly(environment, 5) == expected

    for engine, count in (("mujoco", 128), ("free_flight", 2048)):
        for settings in ({}, {"weather": "light", "randomization": "full"}):
            given = {"num_envs": count, "seed": 3, "engine": engine, "num_threads": 2, **settings}
            environment, other = (Environment("hover", **given) for _ in range(2))
            in_a_child(environment.reset)  # before its first flight
            for each in (environment, other):
                each.reset()
                fly(each, 3)
            expected = fly(other, 5)
            in_a_child(child)
            in_a_child(lambda: in_a_child(child))
            assert fly(environment, 5) == expected

    boat = Environment("deck_landing", num_envs=1024, seed=3, num_threads=2)
    boat.reset()
    boat.step(np.zeros((1024, 4)))
    saved = boat.save()
    in_a_child(lambda: boat.restore(saved))  # which measures how far the deck is

    bare = BatchEngine(Vehicle(), 128, altitude=3.0, num_threads=2)
    bare.advance(1)

    def refused():
        try:
            bare.advance(1)
        except QuadrlError as error:
            assert "forked" in str(error)
        else:
            sys.exit(1)

    in_a_child(refused)
"""


def test_batches_that_have_flown_fly_on_in_a_forked_process_bit_for_bit():
    python("-c", textwrap.dedent(FORKED))


PIPED = """tasks
train hover --steps 8192 --num-envs 64 --episodes 2 --out run --log wandb
train --help
new-task my_task
check my_task --import my_task.py
new-aircraft mine
study study.toml
runs .
evaluate run --episodes 2
evaluate run hover --episodes 2
evaluate nothing
robustness run --episodes 2 --no-recovery
render run --width 160 --height 120 --fps 2
plot run
export paper --to mjcf
crosscheck nothing
identify --stand STAND --out mine.json
replay log.npz --vehicle crazyflie_brushless
benchmark --num-envs 8 --seconds 0.01 --repeats 1
completion bash"""
COMMANDS = """
import sys
from quadrl.cli import main
for line in sys.argv[1].splitlines():
    try:
        main(line.split())
    except SystemExit as end:
        print(line.split()[0], end.code or 0)
"""


def test_no_command_writes_colours_or_moves_the_cursor_in_a_pipe(tmp_path):
    """Whatever the terminal is called that the pipe is typed into."""
    pytest.importorskip("wandb")
    assert {line.split()[0] for line in PIPED.splitlines()} == {*cli.COMMANDS} - {"view"}
    (tmp_path / "study.toml").write_text(
        'tasks = ["hover"]\nseeds = [0]\nepisodes = 2\nsettings = { steps = 8192, num_envs = 64 }\n'
    )
    forced = "FORCE_COLOR", "CLICOLOR_FORCE", "TTY_COMPATIBLE"
    terminal = {"TERM": "xterm-256color", "COLORTERM": "truecolor", "WANDB_MODE": "offline"}
    stand = Path(__file__).parents[2] / "docs/data/thrust_stand_cf2.1-stock-prop.csv"
    flown = in_real_air(VEHICLES["crazyflie_brushless"]), CommandMap(194.0, 223.0, 834.0)
    (log,) = excited.fly(*flown, count=1, seconds=12.0)
    np.savez(tmp_path / "log.npz", **excited.columns(log))
    lines = PIPED.replace("STAND", str(stand))
    done = python("-c", COMMANDS, lines, cwd=tmp_path, without=forced, **terminal)
    ended = re.findall(r"^(\S+) (\d)$", done.stdout, re.MULTILINE)
    # Help, what there is not, and a script.
    assert ended == [("train", "0"), ("evaluate", "2"), ("crosscheck", "2"), ("completion", "0")], (
        done.stderr
    )
    for text in (done.stdout, done.stderr):
        assert not re.findall(r"[\x1b\r\x07\x08].{,20}", text)
