"""`quadrl render`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from quadrl import mjcf
from quadrl.cli.console import console, say
from quadrl.cli.flown import Flown
from quadrl.rollout import evaluate


@dataclasses.dataclass(frozen=True)
class Render(Flown):
    """Draw a flight of a policy or a controller as a video."""

    out: Path = Path("flight.mp4")
    """Output file (.mp4)."""
    camera: str = "follow"
    """Camera: follow, track, chase, onboard or fixed."""
    width: int = 848
    """Width of the video [pixels]."""
    height: int = 480
    """Height of the video [pixels]."""
    fps: float = 30.0
    """Frames per second."""

    def run(self) -> None:
        """Fly one episode and write the video."""
        from quadrl.rendering import write_video

        controller, task, vehicle = self.setting()
        self.out.parent.mkdir(parents=True, exist_ok=True)  # refused before the flight, not after
        _, rollout = evaluate(controller, task, episodes=1, seed=self.seed, vehicle=vehicle)
        with console.status(f"drawing {self.out}"):
            write_video(
                rollout.trajectory(vehicle),
                mjcf.compile_model(vehicle, contact=task.contact, scene=task.scene),
                self.out,
                camera=self.camera,
                width=self.width,
                height=self.height,
                fps=self.fps,
            )
        say(f"wrote {self.out}")
