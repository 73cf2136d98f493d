"""The packages: what a user gets from pip, away from this repository."""

import json
import os
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
FOLDERS = ("quadrl", "quadrl/assets", "quadrl/tasks")  # links are not followed
SMOKE = """
import pathlib, sys
import numpy as np
import quadrl, quadrl.tasks
for module in (quadrl, quadrl.tasks):
    assert pathlib.Path(module.__file__).is_relative_to(sys.prefix), module.__file__
assert "torch" not in sys.modules and "tasks" not in sys.modules
environment = quadrl.load("hover")
step = environment.reset()
policy = quadrl.Policy.pretrained("hover")
for _ in range(10):
    step = environment.step(policy(np.concatenate(list(step.observation.values()))))
assert environment.task.transition.error < 1, environment.task.transition
"""


def run(*command, cwd):
    """Run a command that no environment variable leads to this repository."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def build(kind, source, folder):
    # Without isolation: hatchling is in the dev extra, in the version that constraints.txt names.
    options = ("--no-isolation", kind, "--outdir", folder, source)
    run(sys.executable, "-m", "build", *options, cwd=folder)
    (package,) = folder.iterdir()
    return package


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build("--wheel", REPOSITORY, tmp_path_factory.mktemp("wheel"))


def test_wheel_has_every_file_of_the_package_and_no_other(wheel):
    assert wheel.name.endswith("-py3-none-any.whl")
    files = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    left_out = (".so", ".dylib", ".pyc")
    paths = [path for folder in FOLDERS for path in (REPOSITORY / folder).rglob("*")]
    paths = [p for p in paths if p.is_file() and p.suffix not in left_out and p.name != ".DS_Store"]
    assert files == {str(path.relative_to(REPOSITORY)) for path in paths}
    for name in (
        "py.typed",
        "tasks/hover.py",
        "engines/native/aero.h",
        "assets/policies/hover_ppo.json",
    ):
        assert f"quadrl/{name}" in files


def test_wheel_built_from_the_sdist_is_the_same(wheel, tmp_path):
    folders = [tmp_path / name for name in ("sdist", "source", "wheel")]
    for folder in folders:
        folder.mkdir()
    with tarfile.open(build("--sdist", REPOSITORY, folders[0])) as archive:
        archive.extractall(folders[1], filter="data")
    (source,) = folders[1].iterdir()
    direct, again = (zipfile.ZipFile(p) for p in (wheel, build("--wheel", source, folders[2])))
    assert sorted(direct.namelist()) == sorted(again.namelist())
    assert all(direct.read(name) == again.read(name) for name in direct.namelist())


@pytest.fixture(scope="module", params=["wheel", "sdist"])
def installed(request, wheel, tmp_path_factory):
    """The folder of an environment that has the package and what it depends on, nothing else."""
    package, root = wheel, tmp_path_factory.mktemp("empty") / "environment"
    if request.param == "sdist":
        package = build("--sdist", REPOSITORY, tmp_path_factory.mktemp("sdist"))
    venv.create(root, symlinks=True)
    python = root / "bin" / "python"
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    # A folder that a .pth file names is searched, but the .pth files in it, such as that of the
    # editable quadrl, are not read.
    ours = sorted({sysconfig.get_path("purelib"), sysconfig.get_path("platlib")})
    packages = Path(run(python, "-c", where, cwd=root).strip())
    (packages / "dependencies.pth").write_text("\n".join(ours) + "\n")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python)
    options = ("--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--force-reinstall")
    run(*pip, "install", *options, package, cwd=root)
    return root


def test_installed_package_flies_from_another_folder(installed, tmp_path):
    run(installed / "bin" / "python", "-W", "error", "-c", SMOKE, cwd=tmp_path)
    quadrl = installed / "bin" / "quadrl"
    assert "hover" in run(quadrl, "tasks", cwd=tmp_path)
    assert "train" in run(quadrl, "--help", cwd=tmp_path)


def test_installed_package_trains(installed, tmp_path):
    quadrl, short = installed / "bin" / "quadrl", ("--steps", "8192", "--episodes", "4")
    run(quadrl, "train", "hover", *short, "--no-video", "--out", "run", cwd=tmp_path)
    evaluated = run(quadrl, "evaluate", "run", "--episodes", "4", "--json", cwd=tmp_path)
    assert json.loads(evaluated)["episodes"] == 4


def test_python_is_limited_as_the_dependencies_are(wheel):
    # labmaze, which dm-control needs, has wheels for no later version: pip must say so itself.
    archive = zipfile.ZipFile(wheel)
    (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    assert "Requires-Python: <3.13,>=3.11\n" in archive.read(metadata).decode()
