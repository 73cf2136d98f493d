"""The sanitizers' job can fail: a fault of C that is made on purpose is caught with its flags.

scripts/sanitize runs the rest: the tests of the C part, with the library built in that way.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from quadrl import native

SCRIPT = Path(__file__).parents[1] / "scripts" / "sanitize"
FAULTS = {
    "heap-buffer-overflow": "double* volatile x = malloc(4 * sizeof(double)); return x[n];",
    "index 4 out of bounds": "double x[4] = {1}; return x[n];",
    "heap-use-after-free": "double* volatile x = malloc(8); free(x); return x[0];",
    "stack-buffer-overflow": "double y[4] = {1}, *volatile x = y; return x[n];",
    "signed integer overflow": "int most = 2147483644; return most + n;",
    "division by zero": "return 1 / (n - 4);",
    "misaligned address": "double x[2] = {1, 2}; return *(double*)((char*)x + n);",
}
"""What is reported: the body of a function of n that is at fault for n = 4; volatile hides from one
sanitizer what the other is to find."""


def sanitizer(name: str) -> str:
    """Path of a library of gcc's."""
    if sys.platform != "linux" or not (gcc := shutil.which("gcc")):
        pytest.skip("the sanitizers are run on Linux with gcc")
    path = subprocess.check_output([gcc, f"-print-file-name={name}.so"], text=True).strip()
    if not os.path.isabs(path):
        pytest.skip(f"gcc has no {name} here; scripts/sanitize says what to install")
    return path


def flags() -> list[str]:
    """Those that the script sets."""
    found = re.search(r'^export QUADRL_CFLAGS="(.*)"$', SCRIPT.read_text(), re.MULTILINE)
    assert found
    return shlex.split(found[1])


@pytest.mark.parametrize("fault", FAULTS)
def test_a_deliberate_fault_is_caught(fault, tmp_path):
    libraries = f"{sanitizer('libasan')} {sanitizer('libubsan')}"
    source, built = tmp_path / "fault.c", tmp_path / "fault.so"
    body = f"double fault(int n) {{ if (n < 4) return 0; {FAULTS[fault]} }}"
    source.write_text(f"#include <stdlib.h>\n{body}\n")
    subprocess.run(
        ["gcc", *native.FLAGS, *flags(), "-fvisibility=default", "-w", "-o", built, source],
        check=True,
    )
    call = "import ctypes, sys; ctypes.CDLL(sys.argv[1]).fault(int(sys.argv[2])); print('done')"
    settings = {"LD_PRELOAD": libraries, "ASAN_OPTIONS": "detect_leaks=0"}
    environment = os.environ | settings | {"PYTHONMALLOC": "malloc"}

    def run(n: int) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-I", "-S", "-c", call, str(built), str(n)]
        return subprocess.run(command, env=environment, capture_output=True, text=True)

    sound, faulty = run(3), run(4)
    assert (sound.returncode, sound.stdout) == (0, "done\n"), sound.stderr
    assert faulty.returncode != 0 and "done" not in faulty.stdout
    assert fault in faulty.stderr


def test_extra_flags_make_another_library(monkeypatch, tmp_path):
    monkeypatch.setenv("QUADRL_CACHE", str(tmp_path))
    monkeypatch.delenv("QUADRL_CFLAGS", raising=False)
    usual = native.build()
    monkeypatch.setenv("QUADRL_CFLAGS", "-O1 -DQUADRL_SAID='a word'")
    other = native.build()
    assert native.flags()[-2:] == ("-O1", "-DQUADRL_SAID=a word")
    assert usual != other and usual.exists() and other.exists()


@pytest.mark.skipif("QUADRL_CFLAGS" not in os.environ, reason="scripts/sanitize sets it")
def test_the_library_in_use_is_the_sanitized_one():
    assert "-fsanitize=address,undefined" in native.flags()
    assert b"__asan_" in native.build().read_bytes()
