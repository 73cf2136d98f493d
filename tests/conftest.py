"""What every test stands on: the package of this repository, and a folder of its own."""

import os
import sys
from pathlib import Path

import pytest

# The matrices are small, and a second thread of OpenBLAS is busy waiting for the first one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# At the end: an installed package comes first.
sys.path.append(str(Path(__file__).parents[1]))

import quadrl  # noqa: E402 - before any test imports mujoco: it chooses the renderer
from quadrl.engines import mjcf  # noqa: E402

# Processes that tests start have the same package.
SEARCHED = [str(Path(quadrl.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, SEARCHED))


@pytest.fixture(autouse=True)
def scratch_folder(tmp_path, monkeypatch):
    """What a test writes where it runs goes with it."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def cheap_pictures():
    """Whatever is drawn has coarse shadows and rough edges, and takes a fifth of the time."""
    compile_model = mjcf.compile_model

    def cheaper(*given, **options):
        model = compile_model(*given, **options)
        model.vis.quality.shadowsize, model.vis.quality.offsamples = 512, 0
        return model

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mjcf, "compile_model", cheaper)
        yield
