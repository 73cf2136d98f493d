"""The packages: what a user gets from pip, away from this repository."""

import platform
import shutil
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import numpy as np
import processes
import pytest
from PIL import Image

from quadrl.aircraft.aerodynamics import STILL_AIR
from quadrl.deploy import wheels
from quadrl.engines.native.compiling import Target

REPOSITORY = Path(__file__).parents[2]
FOLDERS = ("quadrl", "quadrl/assets", "quadrl/tasks")  # links are not followed
SMOKE = """
import pathlib, sys
import gymnasium
import quadrl, quadrl.tasks
for module in (quadrl, quadrl.tasks):
    assert pathlib.Path(module.__file__).is_relative_to(sys.prefix), module.__file__
assert "torch" not in sys.modules and "tasks" not in sys.modules
environment = gymnasium.make("quadrl/Hover-v0")
seen, _ = environment.reset(seed=0)
policy = quadrl.Policy.pretrained("hover")
for _ in range(10):
    seen, _, _, _, info = environment.step(policy(seen))
assert info["error"] < 1, info
if sys.version_info < (3, 13):
    assert quadrl.load("hover").reset().first()
"""


FLIGHTS = """
import dataclasses, hashlib, sys, warnings
import numpy as np
import quadrl
from quadrl.core.environment import Environment
from quadrl.engines import native
from quadrl.tasks.hover import Hover

@dataclasses.dataclass(frozen=True)
class Mine(Hover):
    name = "mine"
    compiled = True
    def reward(self, before, now, end):
        return super().reward(before, now, end) | {"slow": -np.abs(now.state.velocity[..., 0])}

def digest(task, **settings):
    environment, seen = Environment(task, num_envs=20, seed=3, **settings), hashlib.sha256()
    environment.reset()
    shape = 100, environment.num_envs, environment.action_size
    for action in np.random.default_rng(0).uniform(-1, 1, shape):
        done = environment.step(action)
        moved = environment.engine.qpos, environment.engine.qvel
        for array in (done.reward, done.terminated, *done.observation.values(), *moved):
            seen.update(array.tobytes())
        if (over := done.terminated | done.truncated).any():
            environment.reset(over)
    if environment.engine.name == "free_flight":
        leg = environment.engine.leg(4)
        for array in leg.vector_jacobian_product(np.ones_like(leg.start)):
            seen.update(array.tobytes())
    print(seen.hexdigest())
    return environment.not_compiled

assert not digest("hover")
# The wheel of this test has the derivatives of calm air alone, to be made in time.
windy = {"weather": "severe", "aerodynamics": "none"}
assert not digest("hover", engine="free_flight", randomization="full", **windy)
assert not digest("hover", vehicle="hexa", control_mode="velocity", altitude=1.0, time_limit=1.0)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    assert digest(Mine()) == digest(Mine(), num_threads=2)
for line in (native.library()._name, *(str(warning.message) for warning in caught)):
    print(line, file=sys.stderr)
"""


def run(*command, cwd):
    """Run a command that no environment variable leads to this repository."""
    return finished(*command, cwd=cwd).stdout


def finished(*command, cwd, without=(), **variables):
    """The same with its errors, and with further variables, or without some."""
    without = ("PYTHONPATH", "PYTHONHOME", *without)
    return processes.run(*command, cwd=cwd, without=without, **variables)


def build(kind, source, folder, **variables):
    # Without isolation: hatchling is in the dev extra, in the version that constraints.txt names.
    options = ("--no-isolation", kind, "--outdir", folder, source)
    finished(sys.executable, "-m", "build", *options, cwd=folder, **variables)
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


def installation(package, root):
    """Make an environment that has the package and what it depends on, nothing else."""
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


def test_installed_package_flies_from_another_folder(wheel, tmp_path):
    programs = installation(wheel, tmp_path / "environment") / "bin"
    run(programs / "python", "-W", "error", "-c", SMOKE, cwd=tmp_path)
    quadrl = programs / "quadrl"
    assert "hover" in run(quadrl, "tasks", cwd=tmp_path)
    assert "train" in run(quadrl, "--help", cwd=tmp_path)


@pytest.fixture(scope="module")
def without_compiler(tmp_path_factory):
    """Runs a program of an environment that has the wheel for this machine, and no compiler."""
    root, machine = tmp_path_factory.mktemp("machine"), platform.machine()
    libraries = root / wheels.tag(machine)
    wheels.fill(Target(machine, folder=libraries), tasks=["hover"], airs=[STILL_AIR])
    (root / "dist").mkdir()
    wheel = build("--wheel", REPOSITORY, root / "dist", QUADRL_LIBRARIES=str(libraries))
    assert wheel.name.endswith(f"-py3-none-{libraries.name}.whl")
    programs, cache = installation(wheel, root / "environment") / "bin", root / "cache"
    assert not any(shutil.which(name, path=programs) for name in ("cc", "gcc", "clang"))

    def program(name, *arguments, cwd):
        variables = {"PATH": str(programs), "QUADRL_CACHE": str(cache)}
        done = finished(programs / name, *arguments, cwd=cwd, without=("CC",), **variables)
        assert not cache.exists() or not [*cache.iterdir()]
        return done

    return program


def test_without_a_compiler_hover_is_trained_and_drawn(without_compiler, tmp_path):
    short = ("--steps", "8192", "--episodes", "4", "--no-video", "--out", "run")
    done = without_compiler("quadrl", "train", "hover", *short, cwd=tmp_path)
    assert "compile" not in done.stderr
    drawn = ("--out", "flight.png", "--width", "160", "--height", "120")
    without_compiler("quadrl", "render", "run", *drawn, cwd=tmp_path)
    assert np.std(Image.open(tmp_path / "flight.png")) > 10


def test_a_wheel_flies_as_what_is_compiled_here_and_an_own_task_in_numpy(
    without_compiler, tmp_path
):
    there = without_compiler("python", "-W", "error", "-c", FLIGHTS, cwd=tmp_path)
    here = finished(sys.executable, "-W", "error", "-c", FLIGHTS, cwd=REPOSITORY)
    assert there.stdout == here.stdout and len(set(here.stdout.split())) == 4
    library, warning = there.stderr.splitlines()
    assert Path(library).parts[-3:-1] == ("native", "prebuilt")
    assert warning.startswith("the step of the task mine is not compiled: no C compiler found")
    (library,) = here.stderr.splitlines()
    assert "prebuilt" not in library
