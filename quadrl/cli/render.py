"""`quadrl render`."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from quadrl.base.progress import ProgressBar
from quadrl.cli import choices
from quadrl.cli.console import console, say
from quadrl.cli.flown import Flown
from quadrl.core.scenario import Scenario
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.policy import FILE
from quadrl.evaluation.rollout import Controller

VIDEO, GIF, SHEET = (848, 480, 20.0), (640, 360, 12.5), (480, 270, 20.0)
"""What a kind of file is drawn with unless it is given: width and height [pixels], frames/s."""


@choices.command
class Render(Flown):
    """Draw a flight of a policy or a controller, or of several side by side."""

    policy: Annotated[Positional[tuple[str, ...]], arg(metavar="[POLICY ...]")] = ()  # pyright: ignore[reportIncompatibleVariableOverride]
    """A run folder, a .safetensors file, the name of a task, for the policy for it that comes with
    quadrl, or of such a policy, as hover_robust (write ./NAME for a folder of that name). Several,
    and controllers, are shown side by side; they fly the same episode, of the first one's task."""
    controller: tuple[choices.ControllerName, ...] = ()  # pyright: ignore[reportIncompatibleVariableOverride]
    """Controllers, beside the policies or alone: geometric or lqr."""
    out: Path | None = None
    """Output file. Its ending sets the kind: .mp4, .gif, or, for moments of the flight in one
    picture, .png or .jpg. By default flight.mp4 or, where that exists, flight-2.mp4 and so on; a
    file that is named here is overwritten."""
    camera: choices.Camera = "follow"
    """Camera: follow keeps the goal in view, chase is behind the aircraft."""
    width: int | None = None
    """Width of a picture [pixels]; by default 848, 640 for .gif, 480 for .png and .jpg. Each of
    several flights has a picture of this size."""
    height: int | None = None
    """Height of a picture [pixels]; by default 480, 360 for .gif, 270 for .png and .jpg."""
    fps: float | None = None
    """Frames per second; by default 20, and 12.5 for .gif."""

    def run(self) -> None:
        """Fly an episode of each and draw them."""
        from quadrl.rendering.sheet import SHEETS, write_contact_sheet
        from quadrl.rendering.video import write_video

        flown = self.flown()
        out = self.out or free_name(Path("flight.mp4"))
        out.parent.mkdir(parents=True, exist_ok=True)  # refused before the flight, not after
        kind = out.suffix.removeprefix(".").lower()
        write = write_contact_sheet if kind in SHEETS else write_video
        width, height, fps = SHEET if kind in SHEETS else GIF if kind == "gif" else VIDEO
        flights, models, labels = [], [], []
        for label, controller, scenario in flown:
            one = evaluate(controller, scenario, episodes=1, seed=self.seed)
            flights.append(one.rollout.trajectory(one.vehicle))
            models.append(one.scenario.compile_model())
            labels.append(label if len(flown) > 1 else "")
        with ProgressBar(console) as bar:
            write(
                flights,
                models,
                out,
                label=labels,
                camera=self.camera,
                width=width if self.width is None else self.width,
                height=height if self.height is None else self.height,
                fps=fps if self.fps is None else self.fps,
                on_frame=lambda done, total: bar.update(done, total, f"drawing {out}"),
            )
        say(f"wrote {out}")

    def flown(self) -> list[tuple[str, Controller, Scenario]]:
        """Label, controller and scenario of each flight, in the task and the world of the first.

        Raises:
            QuadrlError: One is unknown, or there is none.
        """
        names = [field.name for field in dataclasses.fields(Flown)]
        shared: dict[str, Any] = {name: getattr(self, name) for name in names}
        chosen: list[dict[str, Any]] = [{"policy": name, "controller": ""} for name in self.policy]
        chosen += [{"policy": "", "controller": name} for name in self.controller]
        flown: list[tuple[str, Controller, Scenario]] = []
        for one in chosen or [{"policy": "", "controller": ""}]:
            if one["controller"]:
                shared["algo"] = ""
            if flown and not self.task:
                shared["task"] = flown[0][2].task.name
            _, controller, scenario = Flown(**(shared | one)).setting()
            flown.append((label_of(**one), controller, scenario))
        disturbed = [scenario for *_, scenario in flown]
        world: Any = {"task": disturbed[0].task}
        for name in ("weather", "randomization"):
            own = (getattr(scenario, name) for scenario in disturbed)
            default = Scenario.__dataclass_fields__[name].default
            world[name] = next((x for x in own if x != default), default)
        for k, (label, controller, scenario) in enumerate(flown):
            flown[k] = label, controller, dataclasses.replace(scenario, **world)
        return flown


def label_of(policy: str, controller: str) -> str:
    """What a flight is called beside others."""
    if controller:
        return controller
    path = Path(policy)
    return path.parent.name if path.name == FILE and path.parent.name else path.name


def free_name(path: Path) -> Path:
    """The path, or the first of NAME-2, NAME-3 and so on that is not there yet."""
    names = (path.with_name(f"{path.stem}-{k}{path.suffix}") for k in itertools.count(2))
    return next(name for name in itertools.chain([path], names) if not name.exists())
