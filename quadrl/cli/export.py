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
    """Write an aircraft as a plain MuJoCo model, or a policy for ONNX or torch."""

    what: Annotated[Positional[str], arg(metavar="RUN|POLICY|VEHICLE")]
    """A run folder, a .safetensors file, or the name of a shipped policy: a task's name or, for
    example, hover_robust; or the name of an aircraft (write ./NAME for a folder of such a name)."""
    to: Annotated[str, choices.words(TARGETS)]
    """Format: mjcf for the aircraft as a MuJoCo model; onnx or torch for the policy."""
    out: Path | None = None
    """Output file, with the extension of the format: .xml, .onnx or .pt2. By default the name of
    the aircraft or the policy or, if that exists, NAME-2 and so on; a file that is named here is
    overwritten."""

    def run(self) -> None:
        """Write the file."""
        say(f"wrote {export(self.what, self.to, self.out)}")
