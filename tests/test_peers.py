"""The comparison with other simulators: quadrl's own program, and a peer that cannot be had."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "benchmark_peers"
# With these the installers see no registry, whatever the machine's settings are.
WITHOUT_REGISTRY = {
    "PIP_CONFIG_FILE": os.devnull,
    "PIP_NO_INDEX": "1",
    "PIP_FIND_LINKS": "",
    "UV_NO_INDEX": "1",
    "UV_FIND_LINKS": "",
    "UV_NO_CONFIG": "1",
    "UV_NO_CACHE": "1",
}
SYSTEMS = {"quadrl, MuJoCo", "quadrl, free flight"}


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """quadrl beside a peer that no registry has: what was written and what was printed."""
    folder = tmp_path_factory.mktemp("peers")
    out = folder / "peers.json"
    done = subprocess.run(
        (
            *(sys.executable, SCRIPT, "--peers", "rotorpy", "quadrl", "--num-envs", "8"),
            *("--seconds", "0.01", "--repeats", "2", "--environments", folder, "--out", out),
        ),
        env=os.environ | WITHOUT_REGISTRY,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(out.read_text()), done.stdout


def test_peer_that_cannot_be_installed_is_reported_and_the_rest_goes_on(compared):
    result, printed = compared
    assert set(result["missing"]) == {"rotorpy"}
    assert result["missing"]["rotorpy"].startswith("cannot be installed: ")
    assert "\n" not in result["missing"]["rotorpy"]
    assert "not measured" in printed
    assert {row["peer"] for row in result["rows"]} == {"quadrl"}


def test_every_row_says_what_it_measures_and_adds_up(compared):
    rows = compared[0]["rows"]
    assert {(row["system"], row["what"], row["aircraft"]) for row in rows} == {
        (system, what, aircraft)
        for system in SYSTEMS
        for what, aircraft in (("one", 1), ("batch", 8), ("physics", 8))
    }
    for row in rows:
        assert (row["substeps"], row["physics_step"], row["control_step"]) == (5, 0.01, 0.05)
        assert (row["precision"], row["integrator"].split(",")[0]) == ("float64", "RK4")
        assert len(row["rates"]) == 2 and min(row["rates"]) > 0
        assert min(row["rates"]) <= row["median"] <= row["fastest"] == max(row["rates"])
        assert row["physics_rate"] == pytest.approx(5 * row["median"])
        assert row["speed_up"] == pytest.approx(0.05 * row["median"])
