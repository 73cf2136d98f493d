"""Commands in processes of their own, which find this repository's package (see conftest.py)."""

import os
import subprocess
import sys
from typing import Any


def run(*command: Any, code: int = 0, without: tuple[str, ...] = (), cwd: Any = None, **variables):
    """Run a command to its end, which must have this exit code.

    Args:
        command: Its words, of any type.
        code: The exit code.
        without: Environment variables that it does not get.
        cwd: The folder that it runs in.
        variables: Environment variables that it gets beside those of the tests.

    Returns:
        The completed process, with its output as text.
    """
    environment = {name: value for name, value in os.environ.items() if name not in without}
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=environment | variables,
        capture_output=True,
        text=True,
        timeout=550,
    )
    assert done.returncode == code, f"{command}\n{done.stdout}\n{done.stderr}"
    return done


def python(*arguments: Any, **given: Any):
    """Run Python with arguments, as `run` does."""
    return run(sys.executable, *arguments, **given)


def command(*words: Any, **given: Any):
    """Run the command `quadrl`, as `run` does, without other libraries' warnings."""
    return python("-W", "ignore", "-m", "quadrl", *words, **given)
