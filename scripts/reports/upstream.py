"""Writes docs/upstream/torchrl-trpo.patch, which adds TRPOLoss and its tests to TorchRL."""

from __future__ import annotations

import difflib
import importlib.metadata
import importlib.util
import subprocess
import sys
from pathlib import Path

import tyro

from scripts.reports.report import DOCS, REPOSITORY

VERSION = "0.14.1"
"""Of TorchRL."""
PATCH = DOCS / "upstream" / "torchrl-trpo.patch"
LOSS = REPOSITORY / "quadrl" / "learning" / "trpo_loss.py"
TESTS = REPOSITORY / "tests" / "unit" / "test_trpo_loss.py"
HERE, THERE = "from quadrl.learning.trpo_loss import", "from torchrl.objectives import"
HEADER = """# Copyright (c) Meta Platforms, Inc. and affiliates.
#
# This source code is licensed under the MIT license found in the
# LICENSE file in the root directory of this source tree.
"""
"""What every file of TorchRL begins with."""
LINE_LENGTH = "88"
"""Of TorchRL's code."""
PAGE = """--- a/docs/source/reference/objectives_policy.rst
+++ b/docs/source/reference/objectives_policy.rst
@@ -12,5 +12,6 @@
     PPOLoss
     ClipPPOLoss
     KLPENPPOLoss
+    TRPOLoss
     A2CLoss
     ReinforceLoss
"""
"""The entry in TorchRL's reference, whose pages an installed TorchRL does not have."""


def main(check: bool = False) -> None:
    """Write the patch.

    Args:
        check: Write nothing; exit with 1 and a message if the patch would change.
    """
    text = patch()
    if check and (not PATCH.exists() or PATCH.read_text() != text):
        sys.exit(f"{PATCH.name}: not as `scripts/report upstream` writes it")
    if not check:
        PATCH.parent.mkdir(exist_ok=True)
        PATCH.write_text(text)


def patch() -> str:
    """The patch, against the installed TorchRL."""
    installed = importlib.metadata.version("torchrl")
    if installed != VERSION:
        sys.exit(f"The patch is for TorchRL {VERSION}, and TorchRL {installed} is installed")
    exports = (package() / "objectives" / "__init__.py").read_text()
    return (
        PAGE
        + difference("test/objectives/test_trpo.py", "", adapted(TESTS))
        + difference("torchrl/objectives/__init__.py", exports, exported(exports))
        + difference("torchrl/objectives/trpo.py", "", adapted(LOSS))
    )


def package() -> Path:
    """The folder of the installed torchrl, which is not imported."""
    found = importlib.util.find_spec("torchrl")
    assert found is not None and found.origin is not None
    return Path(found.origin).parent


def adapted(path: Path) -> str:
    """A module of quadrl as one of TorchRL: header, imports and width of its lines."""
    _, _, code = path.read_text().split('"""', 2)
    code = code.lstrip().replace(HERE, THERE)
    for command in (("check", "--select", "I", "--fix", "--quiet"), ("format",)):
        options = ("--isolated", "--line-length", LINE_LENGTH, "-")
        line = (sys.executable, "-m", "ruff", *command, *options)
        code = subprocess.run(line, input=code, capture_output=True, text=True, check=True).stdout
    return f"{HEADER}\n{code}"


def exported(text: str) -> str:
    """TorchRL's list of losses with this one after TQCLoss."""
    for line in ("from torchrl.objectives.tqc import TQCLoss\n", '    "TQCLoss",\n'):
        assert text.count(line) == 1, line
        text = text.replace(line, line + line.replace("tqc", "trpo").replace("TQC", "TRPO"))
    return text


def difference(path: str, before: str, after: str) -> str:
    """Between two texts of a file, of which the first is empty for a new one."""
    old, new = before.splitlines(keepends=True), after.splitlines(keepends=True)
    start = f"a/{path}" if before else "/dev/null"
    return "".join(difflib.unified_diff(old, new, start, f"b/{path}"))


if __name__ == "__main__":
    tyro.cli(main)
