"""The benchmark's bookkeeping; how fast anything is, no test says."""

import json
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from quadrl import benchmark, tasks
from quadrl.cli import main

TINY = {"num_envs": 3, "seconds": 0.01, "repeats": 2}


@pytest.fixture(scope="module")
def measured():
    return benchmark.benchmark("hover", **TINY)


def test_measures_every_layer(measured):
    named = " / ".join(row["what"] for row in measured["rates"])
    for layer in ("mujoco.batch", "Environment", "make_vec", "TorchRL", "Gymnasium make", "dm_con"):
        assert layer in named


def test_the_fastest_repeat_is_the_rate(measured):
    for row in measured["rates"]:
        assert len(row["repeats"]) == TINY["repeats"]
        assert row["rate"] == max(row["repeats"]) > 0


def test_shares_are_of_the_fastest_bare_mj_step_within_one_turn(measured):
    for of in (benchmark.ALL_CORES, benchmark.ONE_CORE):
        group = [row for row in measured["rates"] if row["of"] == of]
        bare = [row for row in group if row["what"].startswith("mj_step")]
        yardstick = max(bare, key=lambda row: np.median(row["repeats"]))
        assert yardstick["share"] == 1.0
        for row in group:
            ratios = np.array(row["repeats"]) / yardstick["repeats"]
            assert row["share"] == pytest.approx(np.median(ratios))


def test_targets_stand_beside_the_figures(measured):
    targets = [row["target_share"] or row["target_rate"] for row in measured["rates"]]
    assert sorted(filter(None, targets)) == [0.60, 0.90, 15_000, 1_000_000]
    assert measured["memory_target_mb"] == 500.0


def test_machine_and_settings_are_named(measured):
    assert measured["machine"]["cores"] >= 1
    assert measured["machine"]["mujoco"] == mujoco.__version__
    assert measured["machine"]["cpu"]
    assert (measured["task"], measured["num_envs"]) == ("hover", 3)


def test_memory_grows_with_the_aircraft():
    # A row holds at least two tables of 36 numbers and a generator: hundreds of bytes an aircraft.
    few, many = (benchmark.memory_mb("hover", count) for count in (1, 8192))
    assert 1.0 < many - few < 1000.0
    assert few < 200.0


def test_every_layer_flies_the_steps_that_it_counts():
    # A control step is 0.05 s.
    flown = []
    step = mujoco.mj_step

    def counting(model, data, nstep=1):
        flown.append(nstep)
        step(model, data, nstep)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mujoco, "mj_step", counting)
        steps = benchmark._mj_step(tasks.make("hover"))()
    assert steps * 5 == sum(flown)


def test_bare_aircraft_stay_in_the_air(monkeypatch):
    # In a FLIGHT of 0.8 s the worst that there can be is free fall: 0.5 g 0.8^2 = 3.14 m, from a
    # command of nought; the smallest command carries (1 - 35/225.7)^2 = 0.71 of the weight.
    made = []
    monkeypatch.setattr(benchmark, "Batch", lambda *a: made.append(Batch(*a)) or made[0])
    work = benchmark._batched_mj_step(tasks.make("hover"), 8)
    height, began = made[0].bind("qpos")[:, 2], 0
    for _ in range(3 * benchmark.FLIGHT):
        assert work() == 8
        assert (height > 2.0).all()
        began += (np.abs(height - 3.0) < 0.02).all()  # one step after it is put back
    assert began >= 3


def test_mujocos_own_clock_is_read_only_in_its_layer():
    def read():
        clocks.append(mujoco.get_mjcb_time())
        return 1

    clocks = []
    ours = mujoco.get_mjcb_time()
    assert benchmark._with_clock(read)() == 1
    assert clocks == [None]  # mujoco's own
    assert mujoco.get_mjcb_time() is ours


def test_command_prints_one_object(capsys):
    arguments = ["--num-envs", "2", "--seconds", "0.001", "--repeats", "1"]
    main(["benchmark", "--json", *arguments])
    printed = json.loads(capsys.readouterr().out)
    assert printed["num_envs"] == 2
    assert len(benchmark.rows(printed)) == len(printed["rates"])


def test_command_prints_a_table():
    source = Path(benchmark.__file__).parents[1]
    arguments = ("benchmark", "--num-envs", "2", "--seconds", "0.001", "--repeats", "1")
    done = subprocess.run(
        [sys.executable, "-m", "quadrl", *arguments],
        cwd=source,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "15,000/s" in done.stdout
    assert "memory of 4,096 aircraft" in done.stdout


def test_the_parts_of_a_training_add_up_to_all_of_it(tmp_path):
    script = Path(__file__).parents[1] / "scripts" / "profile_training"
    out = tmp_path / "profile.json"
    subprocess.run([sys.executable, script, "--steps", "8192", "--out", out], check=True)
    engines = json.loads(out.read_text())["seconds"]
    assert list(engines) == ["mujoco", "flight"]
    for parts in engines.values():
        whole = parts.pop("all")
        assert all(seconds > 0 for seconds in parts.values())
        assert sum(parts.values()) == pytest.approx(whole)
