"""The packages: what a user gets from pip, away from this repository."""

import os
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]

SMOKE = """
import pathlib, sys
import quadrl
assert pathlib.Path(quadrl.__file__).is_relative_to(sys.prefix), quadrl.__file__
assert "torch" not in sys.modules, "import quadrl imports torch"

import numpy as np
environment = quadrl.load("hover")
environment.reset()
action = np.zeros(environment.action_spec().shape)
for _ in range(10):
    step = environment.step(action)
assert all(np.isfinite(part).all() for part in step.observation.values()), step.observation

policy = quadrl.Policy.pretrained("hover")
flat = np.concatenate(list(step.observation.values()))
assert np.isfinite(policy(flat)).all(), flat

import quadrl.tasks
assert pathlib.Path(quadrl.tasks.__file__).is_relative_to(sys.prefix), quadrl.tasks.__file__
assert "tasks" not in sys.modules, "tasks was imported under a second name"
"""


def run(*command: str | Path, cwd: Path) -> str:
    """Standard output of a command that no environment variable leads to this repository."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def build(kind: str, source: Path, folder: Path) -> Path:
    # Without isolation: hatchling is in the dev extra, in the version that constraints.txt names.
    run(
        sys.executable,
        "-m",
        "build",
        "--no-isolation",
        kind,
        "--outdir",
        folder,
        source,
        cwd=folder,
    )
    (package,) = folder.iterdir()
    return package


def shipped(folder: str) -> set[str]:
    """Files below a folder of the package, links not followed, named as in a wheel."""
    return {
        str(path.relative_to(REPOSITORY))
        for path in (REPOSITORY / folder).rglob("*")
        if path.is_file()
        and path.parent.name != "__pycache__"
        and path.suffix not in (".so", ".dylib")
        and path.name != ".DS_Store"
    }


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build("--wheel", REPOSITORY, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    return build("--sdist", REPOSITORY, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The bin folder of an environment with the wheel and our dependencies, not our quadrl."""
    root = tmp_path_factory.mktemp("environment")
    venv.create(root, symlinks=True)
    python = root / "bin" / "python"
    site_packages = run(
        python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=root
    )
    # A folder that a .pth file names is searched, but the .pth files in it, such as that of the
    # editable quadrl, are not read.
    ours = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    Path(site_packages.strip(), "dependencies.pth").write_text("\n".join(sorted(ours)) + "\n")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python)
    run(*pip, "install", "--quiet", "--no-deps", "--no-index", "--force-reinstall", wheel, cwd=root)
    return root / "bin"


def test_wheel_has_every_file_of_the_package_and_no_other(wheel):
    assert wheel.name.endswith("-py3-none-any.whl")
    files = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    expected = shipped("quadrl") | shipped("quadrl/assets") | shipped("quadrl/tasks")
    assert files == expected
    for needed in ("quadrl/py.typed", "quadrl/tasks/__init__.py", "quadrl/tasks/hover.py"):
        assert needed in files
    kinds = (("native", ".c"), ("native", ".h"), ("assets", ".xml"))
    for folder, suffix in (
        *kinds,
        ("assets/policies", ".safetensors"),
        ("assets/policies", ".json"),
    ):
        assert any(name.startswith(f"quadrl/{folder}/") and name.endswith(suffix) for name in files)


def test_wheel_built_from_the_sdist_is_the_same(wheel, sdist, tmp_path):
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    folder = tmp_path / "wheel"
    folder.mkdir()
    direct, through_sdist = (zipfile.ZipFile(p) for p in (wheel, build("--wheel", source, folder)))
    assert sorted(direct.namelist()) == sorted(through_sdist.namelist())
    for name in direct.namelist():
        assert direct.read(name) == through_sdist.read(name), name


def test_installed_wheel_flies_from_another_folder(installed, tmp_path):
    run(installed / "python", "-W", "error", "-c", SMOKE, cwd=tmp_path)


def test_installed_command_lists_tasks_and_helps(installed, tmp_path):
    assert "hover" in run(installed / "quadrl", "tasks", cwd=tmp_path)
    assert "train" in run(installed / "quadrl", "--help", cwd=tmp_path)
