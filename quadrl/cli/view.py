"""`quadrl view`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import RenderingUnavailable
from quadrl.cli import choices
from quadrl.cli.console import say
from quadrl.cli.flown import Flown
from quadrl.control import CONTROLLERS
from quadrl.core.scenario import Scenario
from quadrl.core.task import Task
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.policy import Policy, shipped
from quadrl.evaluation.rollout import Controller
from quadrl.rendering.live.flight import Flight
from quadrl.tasks import TASKS


@choices.command
class View(Flown):
    """Watch a policy or a controller fly, live in the browser: push it, let the wind blow, fly."""

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
        try:
            self._native() if self.native else self._browser()
        except KeyboardInterrupt:
            say("stopped")

    def _native(self) -> None:
        from quadrl.rendering.live import native

        native.check_screen()
        _, controller, scenario = self.setting()
        native.run(Flight(controller, scenario, num_envs=self.num_envs, seed=self.seed))

    def setting(self) -> tuple[str, Controller, Scenario]:
        """As for other commands, but in calm air by default: the spectator sets the wind."""
        return super(View, dataclasses.replace(self, weather=self.weather or "calm")).setting()

    def _browser(self) -> None:
        try:
            from quadrl.rendering.live.browser import Page
        except ImportError as error:
            raise RenderingUnavailable(
                f"quadrl view needs {error.name}: install the extra `view` of quadrl"
            ) from error

        _, controller, scenario = self.setting()
        task, vehicle = scenario.task, scenario.aircraft
        flight = Flight(controller, scenario, num_envs=self.num_envs, seed=self.seed)
        name = self.controller or self.policy
        if name in TASKS:
            name = f"{name}_{self.algo or 'ppo'}"
        choices = {name: lambda: controller} | others(task, vehicle)
        page = Page(flight, choices, host=self.host, port=self.port)
        try:
            say(f"{name} flies {task.name}: open {page.address} (Ctrl-C ends it)")
            page.run()
        finally:
            page.close()


def others(task: Task, vehicle: Vehicle) -> dict[str, Callable[[], Controller]]:
    """What else can fly a task: the policies for it that come with quadrl, and the controllers."""
    policies = {}
    for file in shipped():
        policy = Policy.load(file)
        # The aircraft stays the same, so that its commands have to mean what they did in training.
        scale = policy.scenario.aircraft.action_scale
        if policy.task == task.name and scale == vehicle.action_scale:
            policies[file.stem] = lambda policy=policy: policy
    return policies | {
        name: lambda name=name: make_controller(name, task, vehicle) for name in CONTROLLERS
    }
