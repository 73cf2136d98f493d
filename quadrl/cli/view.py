"""`quadrl view`."""

from __future__ import annotations

from quadrl.cli import choices
from quadrl.cli.console import say
from quadrl.cli.flown import Flown, flies
from quadrl.rendering.live.view import view
from quadrl.tasks import TASKS


@choices.command
class View(Flown):
    """Watch a policy or a controller fly live in the browser; push it, add wind, or steer."""

    num_envs: int = 1
    """Aircraft that fly at the same time."""
    host: str = "localhost"
    """Address that the page is served at; 0.0.0.0 lets other machines see and steer it."""
    port: int = 8080
    """Port that the page is served at; 0 for any that is free."""
    native: bool = False
    """Open MuJoCo's own viewer instead, on this machine's screen."""

    def run(self) -> None:
        """Serve the page, or show the window, until Ctrl-C."""
        name = self.controller or self.policy
        try:
            view(
                flies(self.policy, self.controller, self.algo),
                self.task or None,
                label=f"{name}_{self.algo or TASKS[name].trained_by}" if name in TASKS else name,
                num_envs=self.num_envs,
                seed=self.seed,
                host=self.host,
                port=self.port,
                native=self.native,
                on_open=say,
                **self.conditions(),
            )
        except KeyboardInterrupt:
            say("stopped")
