"""What is saved is what is loaded: one bit that has changed anywhere is refused."""

import re
import shutil
import warnings

import numpy as np
import pytest
from helpers import refused
from policies import make_policy, make_remembering
from runs import TINY, changed, train

from quadrl.base.errors import QuadrlWarning
from quadrl.base.machine import processor_kind
from quadrl.evaluation.evaluate import setting
from quadrl.evaluation.policy import Policy
from quadrl.learning import checkpoint
from quadrl.learning.folder import read_config, write_config
from quadrl.learning.train import Training

FLIPS = 1000
PARTS = ("config.json", "checkpoint.safetensors", "policy.safetensors")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run; not to be written to."""
    return train(TINY, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def copy(run, tmp_path):
    return shutil.copytree(run, tmp_path / "copy")


def flipped(content, bit):
    changed = bytearray(content)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def bits(content):
    """Every bit of the first 250 of them, where the header is, and as many as are left of all."""
    size = 8 * len(content)
    anywhere = np.random.default_rng(0).choice(size, FLIPS - 250, replace=False)
    return [*range(250), *anywhere.tolist()]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("config.json", read_config),
        ("checkpoint.safetensors", lambda folder: checkpoint.load(folder / PARTS[1])),
        ("policy.safetensors", lambda folder: Policy.load(folder / PARTS[2])),
        ("memory", lambda folder: Policy.load(folder / "memory")),
    ],
)
def test_one_bit_that_has_changed_is_refused(copy, name, read):
    make_remembering().save(copy / "memory")
    path = copy / name
    sound = path.read_bytes()
    read(copy)
    for bit in bits(sound):
        path.write_bytes(flipped(sound, bit))
        with refused() as caught:
            read(copy)
        assert str(path) in str(caught.value), bit


@pytest.mark.parametrize(
    ("name", "read"), [("config.json", read_config), ("policy.safetensors", Policy.load)]
)
def test_a_file_without_a_digest_is_refused(copy, name, read):
    content = (copy / name).read_bytes()
    # As long as it was, since a safetensors file begins with the length of its header.
    (copy / name).write_bytes(re.sub(rb"digest(\W+)[0-9a-f]", rb"digest\1x", content, count=1))
    with refused(match=f"{name} is damaged"):
        read(copy)


def test_a_policy_of_another_run_is_told(copy, run, tmp_path):
    other = train(changed(seed=5), tmp_path / "other")
    longer = train(changed(steps=2 * TINY.steps), tmp_path / "longer")
    wider = train(changed(gamma=0.9), tmp_path / "wider")
    for folder, name in ((other, "its seed is 5, that of the run 0"), (wider, "its run is")):
        shutil.copy(folder / PARTS[2], copy / PARTS[2])
        with pytest.warns(QuadrlWarning, match=f"policy in {copy} is not of the run.*{name}"):
            setting(copy)
    shutil.copy(longer / PARTS[2], copy / PARTS[2])  # the same run, further on
    setting(copy)
    make_policy().save(tmp_path / PARTS[2])  # in no run's folder
    setting(tmp_path, "hover")


def test_another_processor_is_told_at_a_resume(copy):
    assert read_config(copy)["processors"] == [processor_kind()]
    write_config(copy, TINY.resolved(), ["an abacus"])
    with pytest.warns(QuadrlWarning, match="trained on another processor .an abacus.*last digits"):
        Training(changed(steps=2 * TINY.steps), copy, resume=True).run()
    assert read_config(copy)["processors"] == ["an abacus", processor_kind()]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Policy.load(copy).metadata["run"] == read_config(copy)["run"]
