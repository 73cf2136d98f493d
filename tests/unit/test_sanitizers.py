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

from quadrl.engines.native import compiling

SCRIPT = Path(__file__).parents[2] / "scripts" / "sanitize"
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


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """One library with all the faults."""
    folder = tmp_path_factory.mktemp("faults")
    bodies = [
        f"double fault_{k}(int n) {{ if (n < 4) return 0; {body} }}"
        for k, body in enumerate(FAULTS.values())
    ]
    (folder / "fault.c").write_text("\n".join(["#include <stdlib.h>", *bodies, ""]))
    command = ["gcc", *compiling.FLAGS, *flags(), "-fvisibility=default", "-w", "-o", "fault.so"]
    subprocess.run([*command, "fault.c"], check=True, cwd=folder)
    return folder / "fault.so"


@pytest.mark.parametrize("fault", FAULTS)
def test_a_deliberate_fault_is_caught(fault, built):
    libraries = f"{sanitizer('libasan')} {sanitizer('libubsan')}"
    call = (
        "import ctypes, sys; function = getattr(ctypes.CDLL(sys.argv[1]), sys.argv[2]);"
        "function(3); print('sound', flush=True); function(4); print('done')"
    )
    settings = {"LD_PRELOAD": libraries, "ASAN_OPTIONS": "detect_leaks=0"}
    environment = os.environ | settings | {"PYTHONMALLOC": "malloc"}
    name = f"fault_{list(FAULTS).index(fault)}"
    command = [sys.executable, "-I", "-S", "-c", call, str(built), name]
    run = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert run.returncode != 0 and run.stdout == "sound\n", run.stderr
    assert fault in run.stderr


@pytest.mark.skipif("ASAN_OPTIONS" not in os.environ, reason="not run by scripts/sanitize")
def test_the_library_in_use_is_the_sanitized_one():
    assert "-fsanitize=address,undefined" in compiling.flags()
    assert b"__asan_" in compiling.build().read_bytes()
