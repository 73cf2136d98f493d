"""The patch for TorchRL applies to it, and TorchRL then has a loss that passes its tests."""

import os
import shutil
import subprocess
import sys

import pytest

from scripts.reports import upstream


@pytest.fixture(scope="module")
def patched(tmp_path_factory):
    """A copy of the installed TorchRL with the patch, but for the pages that it does not have."""
    folder = tmp_path_factory.mktemp("patched")
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(upstream.package(), folder / "torchrl", ignore=ignored)
    apply = ("git", "apply", "--include=torchrl/*", "--include=test/*", str(upstream.PATCH))
    subprocess.run(apply, cwd=folder, check=True)
    return folder


def run(folder, *arguments):
    done = subprocess.run(
        (sys.executable, *arguments),
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_patch_is_what_the_script_writes():
    assert upstream.PATCH.read_text() == upstream.patch()


def test_the_page_of_the_reference_takes_its_part(tmp_path):
    """The page as TorchRL has it: eleven lines, then the names of the losses."""
    page = tmp_path / "docs/source/reference/objectives_policy.rst"
    page.parent.mkdir(parents=True)
    names = ["PPOLoss", "ClipPPOLoss", "KLPENPPOLoss", "A2CLoss", "ReinforceLoss"]
    page.write_text("line\n" * 11 + "".join(f"    {name}\n" for name in names))
    apply = ("git", "apply", "--include=docs/*", str(upstream.PATCH))
    subprocess.run(apply, cwd=tmp_path, check=True)
    assert page.read_text().split()[11:] == [*names[:3], "TRPOLoss", *names[3:]]


def test_torchrl_has_the_loss(patched):
    code = (
        "import sys, torchrl\n"
        "from torchrl.objectives import TRPOLoss\n"
        "assert 'TRPOLoss' in torchrl.objectives.__all__ and 'quadrl' not in sys.modules\n"
        "print(torchrl.__file__, TRPOLoss.__module__)"
    )
    expected = [str(patched / "torchrl" / "__init__.py"), "torchrl.objectives.trpo"]
    assert run(patched, "-W", "ignore", "-c", code).split() == expected


def test_its_tests_pass_there(patched):
    options = ("-q", "-p", "no:cacheprovider", "-c", os.devnull, "--rootdir", str(patched))
    output = run(patched, "-m", "pytest", *options, "test/objectives/test_trpo.py")
    assert "passed" in output and "skipped" not in output


def test_its_example_runs_there(patched):
    code = (
        "import doctest\n"
        "from torchrl.objectives import trpo\n"
        "done = doctest.testmod(trpo)\n"
        "assert done.attempted > 5 and not done.failed"
    )
    run(patched, "-W", "ignore", "-c", code)
