"""The build of the compiled part: its cache, and what it leaves behind."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import pytest

from quadrl.base.errors import QuadrlWarning
from quadrl.engines import native
from quadrl.engines.native import compiling


@pytest.fixture
def copying_compiler(tmp_path, monkeypatch):
    """A compiler that is done at once: it gives out a copy of the library that there is."""
    program = tmp_path / "copying-cc"
    copy = f'while [ "$1" != -o ]; do shift; done; cp "{compiling.build()}" "$2"'
    program.write_text(f"#!/bin/sh\n{copy}\n")
    program.chmod(0o755)
    monkeypatch.setenv("CC", str(program))


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache of compiled libraries; the compiler does not take its time."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("QUADRL_CACHE", str(folder))
    monkeypatch.setenv("QUADRL_CFLAGS", "-O0")
    return folder


def test_without_a_compiler_the_error_says_what_to_install(cache, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(native.NativeError, match="apt-get install build-essential"):
        compiling.build()
    assert list(cache.iterdir()) == []  # nothing half-made


def test_cc_names_the_compiler_and_what_it_says_is_quoted(cache, monkeypatch, tmp_path):
    chosen = tmp_path / "broken-cc"
    chosen.write_text("#!/bin/sh\necho 'no such target: toaster' >&2\nexit 1\n")
    chosen.chmod(0o755)
    monkeypatch.setenv("CC", str(chosen))
    assert compiling.compiler() == str(chosen)
    with pytest.raises(native.NativeError, match="no such target: toaster"):
        compiling.build()
    assert list(cache.iterdir()) == []


def test_the_cache_is_used_and_other_flags_make_another_library(
    copying_compiler, cache, monkeypatch, tmp_path
):
    path = compiling.build()
    assert list(cache.iterdir()) == [path]
    built = path.stat().st_mtime_ns
    monkeypatch.setenv("QUADRL_CFLAGS", "-O0 -DQUADRL_SAID='a word'")
    assert compiling.flags()[-2:] == ("-O0", "-DQUADRL_SAID=a word")
    assert compiling.build() != path and len(list(cache.iterdir())) == 2
    monkeypatch.setenv("QUADRL_CFLAGS", "-O0")
    monkeypatch.setenv("PATH", str(tmp_path))  # no compiler any more
    monkeypatch.delenv("CC", raising=False)
    assert compiling.build() == path
    assert path.stat().st_mtime_ns == built


def generated(function="f"):
    """A library of generated C, loaded as for the first time."""
    seen = '__attribute__((visibility("default")))'
    return compiling.opened_generated.__wrapped__(f"{seen} int {function}(void) {{ return 1; }}")


DAMAGES = {
    "short": lambda whole, other: whole[: len(whole) // 3],
    "empty": lambda whole, other: b"",
    "one bit": lambda whole, other: whole[:5000] + bytes([whole[5000] ^ 1]) + whole[5001:],
    "another library": lambda whole, other: other,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_library_is_never_loaded_but_built_anew(cache, damage):
    path = Path(generated()._name)
    whole = path.read_bytes()
    path.unlink()  # it is in use, and must not be cut short under this process
    other = Path(generated("g")._name).read_bytes()
    path.write_bytes(DAMAGES[damage](whole, other))
    assert generated().f() == 1 and path.read_bytes() == whole


@pytest.mark.parametrize("name", ["mujoco", "adjoint"])
def test_the_other_kinds_of_library_are_checked_as_well(copying_compiler, cache, name):
    path = compiling.build(name=name)
    whole = path.read_bytes()
    path.write_bytes(whole[:4096])
    assert compiling.build(name=name) == path and path.read_bytes() == whole


@pytest.fixture
def prebuilt(copying_compiler, cache, monkeypatch, tmp_path):
    """The libraries that a wheel brings: that of the callbacks, and one of generated C."""
    folder = tmp_path / "prebuilt"
    monkeypatch.setenv("QUADRL_CACHE", str(folder))
    compiling.build(), compiling.build_generated("int f;")
    monkeypatch.setenv("QUADRL_CACHE", str(cache))
    monkeypatch.setattr(compiling, "PREBUILT", folder)
    return folder


@pytest.fixture
def no_compiler(prebuilt, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC")


def test_what_a_wheel_brings_needs_neither_compiler_nor_cache(prebuilt, no_compiler, cache):
    assert {compiling.build(), compiling.build_generated("int f;")} == {*prebuilt.iterdir()}
    assert not cache.exists()
    with pytest.raises(native.NativeError, match="no C compiler found"):
        compiling.build_generated("int g;")


def test_what_a_wheel_brings_is_checked_as_well(prebuilt, cache):
    path = compiling.build()
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    again = compiling.build()
    assert again.parent == cache and again.read_bytes() == whole


def test_for_another_mujoco_it_is_said_which_one_needs_no_compiler(no_compiler, monkeypatch):
    brought = re.escape(mujoco.__version__)
    monkeypatch.setattr(mujoco, "__version__", "3.99.0")
    with pytest.raises(native.NativeError, match=rf"with mujoco {brought} none would be needed"):
        compiling.build()


def test_what_the_system_does_not_load_is_said_in_a_line(cache, monkeypatch):
    monkeypatch.setenv("QUADRL_CFLAGS", "-O0 -Wl,-z,now")
    with pytest.raises(native.NativeError, match="cannot be loaded.*nowhere.*QUADRL_CACHE"):
        compiling.compile_generated("int nowhere(void); int f(void) { return nowhere(); }")


@pytest.fixture
def run(tmp_path, cache):
    """Starts Python with a TMPDIR of its own."""
    (tmp_path / "tmp").mkdir()
    processes = []

    def start(code, **variables):
        code = f"from quadrl.engines.native import compiling, library; {code}"
        environment = os.environ | {"TMPDIR": str(tmp_path / "tmp")} | variables
        command = [sys.executable, "-c", code]
        processes.append(subprocess.Popen(command, env=environment, start_new_session=True))
        return processes[-1]

    yield start
    for process in processes:
        process.kill()
        process.wait()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "place", "compiler"),
    [
        # Root may write everywhere, so both stand in: a folder under a file cannot be made, and a
        # name past the file system's limit cannot even be asked for.
        ("library(), compiling.compile_generated('int f;')", "file/quadrl", None),
        ("library()", "x" * 300, None),
        ("compiling.build(), compiling.build(name='again')", "file/quadrl", None),
        ("compiling.build()", "file/quadrl", "false"),
    ],
    ids=["loaded", "unreadable", "never loaded", "refused"],
)
def test_without_a_cache_it_is_built_and_nothing_is_left(
    tmp_path, copying_compiler, run, code, place, compiler
):
    (tmp_path / "file").write_text("")
    variables = {"CC": compiler} if compiler else {}
    process = run(code, QUADRL_CACHE=str(tmp_path / place), **variables)
    assert process.wait() == (1 if compiler else 0)
    assert list((tmp_path / "tmp").iterdir()) == []


@pytest.mark.parametrize("whose", ["writable by all", "somebody else's"])
def test_a_cache_that_others_may_write_is_neither_read_nor_filled(
    copying_compiler, cache, monkeypatch, whose
):
    planted = compiling.build()  # where nobody else could
    if whose == "writable by all":
        cache.chmod(0o777)
    elif os.getuid() == 0:
        os.chown(cache, 54321, -1)
    else:
        monkeypatch.setattr(os, "getuid", lambda: 54321)
    with pytest.warns(QuadrlWarning, match="others may write"):
        built = compiling.build()
    assert built.parent != cache and list(cache.iterdir()) == [planted]


def test_a_user_without_a_home_has_a_cache(monkeypatch, tmp_path):
    for name in ("QUADRL_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(compiling.Path, "home", _no_home)
    monkeypatch.setattr(compiling.tempfile, "tempdir", str(tmp_path))
    assert compiling.cache_folder() == tmp_path / f"quadrl-{os.getuid()}"


def _no_home():
    raise RuntimeError("Could not determine home directory.")


@pytest.mark.slow
@pytest.mark.parametrize("where", ["cache", "temporary folder"])
def test_what_a_killed_build_left_is_removed_by_the_next_one_but_not_a_living_ones(
    tmp_path, cache, run, where
):
    # A compiler that writes a temporary file, says so, and never ends.
    program = tmp_path / "sleeping-cc"
    program.write_text('#!/bin/sh\ntouch "$TMPDIR/ccXYZ.o"\ntouch "$SAID"\nexec sleep 600\n')
    program.chmod(0o755)
    folder, variables = cache, {}
    if where != "cache":
        (tmp_path / "file").write_text("")
        folder, variables = tmp_path / "tmp", {"QUADRL_CACHE": str(tmp_path / "file" / "quadrl")}
    builders = []
    for name in ("dead", "living"):
        said = tmp_path / name
        builders.append(run("compiling.build()", CC=str(program), SAID=str(said), **variables))
        while not said.exists():
            assert builders[-1].poll() is None
            time.sleep(0.01)
    dead, living = sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime)
    assert (dead / "ccXYZ.o").exists() and (living / "ccXYZ.o").exists()
    os.killpg(builders[0].pid, signal.SIGKILL)
    builders[0].wait()
    assert dead.exists()
    assert run("compiling.compile_generated('int f;')", **variables).wait() == 0
    assert not dead.exists() and (living / "ccXYZ.o").exists()
    assert not list((tmp_path / "tmp").glob("cc*"))
    os.killpg(builders[1].pid, signal.SIGKILL)
