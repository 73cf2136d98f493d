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
    """Write an aircraft as a plain MuJoCo model, or a policy for ONNX, torch or a board's C."""

    what: Annotated[Positional[str], arg(metavar="RUN|POLICY|VEHICLE")]
    """A run folder, a .safetensors file, or the name of a shipped policy: a task's name or, for
    example, hover_robust; or the name of an aircraft (write ./NAME for a folder of such a name)."""
    to: Annotated[str, choices.words(TARGETS)]
    """Format: mjcf for the aircraft as a MuJoCo model; onnx, torch or c for the policy; crazyflie
    for a controller of that firmware, in a folder that its build takes; px4 for what a module of
    PX4 needs beside the C; raptor for the file that PX4's mc_raptor reads from the SD card; hub for
    a folder with the policy and its model card, which is flown for it."""
    out: Path | None = None
    """Output file, with the extension of the format: .xml, .onnx, .pt2, .h or .tar; or the folder
    of crazyflie, px4 or hub. By default the name of the aircraft or the policy or, if that exists,
    NAME-2 and so on; a file that is named here is overwritten."""

    def run(self) -> None:
        """Write the file."""
        if self.to == "hub":
            say("flying it for its card, which takes minutes")
        say(f"wrote {export(self.what, self.to, self.out)}")
