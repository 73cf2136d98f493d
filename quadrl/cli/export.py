"""`quadrl export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from quadrl.cli import choices
from quadrl.cli.console import say
from quadrl.deploy.export import TARGETS, export


@choices.command
class Export:
    """Write an aircraft for MuJoCo alone, or a policy for ONNX or torch."""

    what: Annotated[Positional[str], arg(metavar="RUN|POLICY|VEHICLE")]
    """A run folder, a .safetensors file, or the name of a shipped policy: that of its task, or
    one such as hover_robust; or an aircraft (write ./NAME for a folder of such a name)."""
    to: Annotated[str, choices.words(TARGETS)]
    """What it is for: mjcf, the aircraft as a model of MuJoCo; onnx or torch, the policy."""
    out: Path | None = None
    """Output file, of that ending: .xml, .onnx or .pt2. By default the name of the aircraft or of
    the task or, where that exists, NAME-2 and so on; a file that is named here is overwritten."""

    def run(self) -> None:
        """Write the file."""
        say(f"wrote {export(self.what, self.to, self.out)}")
