"""What every test stands on: the package of this repository, and a folder of its own."""

import sys
from pathlib import Path

import pytest

# At the end: an installed package comes first.
sys.path.append(str(Path(__file__).parents[1]))

import quadrl  # noqa: E402, F401 - before any test imports mujoco: it chooses the renderer


@pytest.fixture(autouse=True)
def scratch_folder(tmp_path, monkeypatch):
    """MuJoCo writes MUJOCO_LOG.TXT where it runs."""
    monkeypatch.chdir(tmp_path)
