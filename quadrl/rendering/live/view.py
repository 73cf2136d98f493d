"""Show a flight live: on a page in the browser, or in MuJoCo's own window."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Unpack

from quadrl.base.extras import needed
from quadrl.control import CONTROLLERS
from quadrl.core.scenario import Conditions, Scenario
from quadrl.core.task import Task
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.evaluate import setting
from quadrl.evaluation.in_flight import Controller
from quadrl.evaluation.policy import Policy, shipped
from quadrl.rendering.live.flight import Flight


def view(
    controller: Any,
    task: str | Task | Scenario | None = None,
    *,
    label: str = "",
    num_envs: int = 1,
    seed: int = 0,
    host: str = "localhost",
    port: int = 8080,
    native: bool = False,
    on_open: Callable[[str], None] = print,
    **conditions: Unpack[Conditions],
) -> None:
    """Fly and draw until interrupted, or until the window is closed.

    The air is calm unless a weather is given; in calm air the spectator sets the wind.

    Args:
        controller: A policy or a controller, as `quadrl.evaluate` takes it.
        task: As `quadrl.evaluate` takes it.
        label: Its name on the page; by default that of `quadrl.evaluate`.
        num_envs: Aircraft that fly at the same time.
        seed: Seed of the episodes.
        host: Address that the page is served at.
        port: Port that the page is served at; 0 for any that is free.
        native: Whether to open MuJoCo's own viewer, on this machine's screen, in place of the page.
        on_open: Called with a line that says where the page is.
        **conditions: As `quadrl.evaluate` takes them.

    Raises:
        QuadrlError: Something is unknown, out of range, or does not fit together.
        RenderingUnavailable: There is no screen.
        MissingLibrary: A library of the page is not installed.
    """
    conditions["weather"] = conditions.get("weather") or "calm"
    if native:
        from quadrl.rendering.live import native as window

        window.check_screen()
        _, flown, scenario = setting(controller, task, **conditions)
        window.run(Flight(flown, scenario, num_envs=num_envs, seed=seed))
        return
    with needed("quadrl view"):
        from quadrl.rendering.live.browser import Page
    name, flown, scenario = setting(controller, task, **conditions)
    flight, name = Flight(flown, scenario, num_envs=num_envs, seed=seed), label or name
    page = Page(flight, {name: lambda: flown} | others(scenario), host=host, port=port)
    try:
        on_open(f"{name} flies {scenario.task.name}: open {page.address} (Ctrl-C ends it)")
        page.run()
    finally:
        page.close()


def others(scenario: Scenario) -> dict[str, Callable[[], Controller]]:
    """Policies that come with quadrl for the task of a scenario, and controllers, by name."""
    task, vehicle, policies = scenario.task, scenario.aircraft, {}
    for file in shipped():
        policy = Policy.load(file)
        # The aircraft stays the same, so a policy's actions must mean what they did in training.
        own = policy.scenario.aircraft
        alike = own.action_scale == vehicle.action_scale
        alike &= own.control_timestep == vehicle.control_timestep
        if policy.task == task.name and alike:
            policies[file.stem] = lambda policy=policy: policy
    return policies | {name: partial(make_controller, name, task, vehicle) for name in CONTROLLERS}
