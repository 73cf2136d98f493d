"""`quadrl render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from quadrl.base.files import free_name
from quadrl.cli import choices
from quadrl.cli.console import console, say
from quadrl.cli.flown import Flown, flies
from quadrl.evaluation.policy_file import FILE
from quadrl.learning.show import render
from quadrl.rendering.sheet import SHEETS
from quadrl.rendering.video import VIDEOS, checked


@choices.command
class Render(Flown):
    """Draw a flight of a policy or a controller, or of several side by side."""

    policy: Annotated[Positional[tuple[str, ...]], arg(metavar="[POLICY ...]")] = ()  # pyright: ignore[reportIncompatibleVariableOverride]
    """A run folder, a .safetensors file, or the name of a shipped policy: a task's name or, for
    example, hover_robust (write ./NAME for a folder of that name). Several policies and controllers
    are shown side by side in the same episode of the first one's task, in the weather and with the
    randomization of the first one that was trained with any."""
    controller: tuple[choices.ControllerName, ...] = ()  # pyright: ignore[reportIncompatibleVariableOverride]
    """Controllers, in addition to the policies or alone: geometric or lqr."""
    out: Path | None = None
    """Output file. The extension sets the format: .mp4 or .gif for a video, .png or .jpg for
    several moments in one picture. By default flight.mp4 or, if that exists, flight-2.mp4 and so
    on; a file that is named here is overwritten."""
    camera: choices.Camera = "follow"
    """Camera: follow keeps the goal in view, chase is behind the aircraft."""
    width: int | None = None
    """Width of a picture [pixels]; by default 848, 640 for .gif, 480 for .png and .jpg. Each of
    several flights has a picture of this size."""
    height: int | None = None
    """Height of a picture [pixels]; by default 480, 360 for .gif, 270 for .png and .jpg."""
    fps: float | None = None
    """Frames per second; by default 20, and 12.5 for .gif."""
    speed_trail: bool = False
    """Show the whole path so far, coloured by speed, instead of the last seconds."""

    def run(self) -> None:
        """Fly an episode of each and draw them."""
        chosen = [(policy, "", self.algo) for policy in self.policy]
        chosen += [("", controller, "") for controller in self.controller]
        controllers: dict[str, Any] = {}
        for policy, controller, algo in chosen or [("", "", self.algo)]:
            name = label(controller or policy)
            again = f" ({len(controllers) + 1})" if name in controllers else ""
            controllers[name + again] = flies(policy, controller, algo)
        out, kind = checked(self.out or free_name(Path("flight.mp4")), (*VIDEOS, *SHEETS))
        media = render(
            controllers if len(controllers) > 1 else next(iter(controllers.values())),
            self.task or None,
            seed=self.seed,
            kind=kind,
            camera=self.camera,
            width=self.width,
            height=self.height,
            fps=self.fps,
            speed_trail=self.speed_trail,
            progress=not console.quiet,
            **self.conditions(),
        )
        say(f"wrote {media.save(out)}")


def label(flown: str) -> str:
    """The name of a flight in a comparison."""
    path = Path(flown)
    return path.parent.name if path.name == FILE and path.parent.name else path.name
