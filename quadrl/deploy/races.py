"""Fly the races of the LSY competition by its own simulator's physics, beside quadrl.

Rules and track file are those of the task `lsy_race`; the floor is crazyflow's. Nothing is drawn
for the aircraft, and nothing pushes it.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from quadrl.base.primitives import Primitive
from quadrl.core.environment import Environment
from quadrl.core.scenario import UNDISTURBED, Scenario
from quadrl.deploy.crosscheck import brakes, fly_in
from quadrl.deploy.simulators import Simulator, environment_of
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import EVALUATION_SEED
from quadrl.tasks.arena import DEPTH

SIMULATOR = "crazyflow"


@dataclasses.dataclass(frozen=True)
class Races:
    """Races of a policy."""

    flown_in: str
    """quadrl, or the simulator with its version."""
    aircraft: str
    """Whose numbers flew."""
    course: str
    """Who finds what the aircraft touches."""
    success_rate: float
    """Share that came through every gate."""
    episodes: int
    """How many."""
    race_time_s: float
    """Mean of those that came through."""


def races(
    policy: Policy, *, episodes: int = 300, said: Callable[[str], None] = lambda text: None
) -> list[Races]:
    """Fly a policy for `lsy_race` in quadrl and by crazyflow's physics, and collide it there.

    Args:
        policy: The policy.
        episodes: Races of each kind.
        said: Told what is going on.

    Returns:
        quadrl; crazyflow with quadrl's numbers of the aircraft; with its own; and with its own in a
        scene where the course is built, too: MuJoCo finds there what the aircraft's box touches,
        and quadrl's own box is a point then.

    Raises:
        QuadrlError: The simulator cannot be installed.
    """
    flies = policy.scenario.aircraft
    calm: Any = {**UNDISTURBED, "engine": "free_flight", "aerodynamics": flies.aerodynamics}
    scenario = dataclasses.replace(policy.scenario, vehicle=flies, **calm)
    point = dataclasses.replace(scenario.task, box=0.0, least_box=0.0)
    touching = dataclasses.replace(scenario, task=point)
    found: list[Races] = []
    for own, course in ((None, "quadrl"), ("", "quadrl"), (flies.name, "quadrl"),
                        (flies.name, SIMULATOR)):  # fmt: skip
        given = {"own": own, "vehicle": dataclasses.asdict(flies), "brakes": brakes(flies)}
        flown = touching if course == SIMULATOR else scenario
        given |= {"course": solids(flown, episodes)} if course == SIMULATOR else {}
        with contextlib.ExitStack() as stack:
            advance, where = None, "quadrl"
            if own is not None:
                there = Simulator(SIMULATOR, environment_of(SIMULATOR, said), given)
                stack.callback(there.close)
                advance, where = there.advance, f"{SIMULATOR} {there.version}"
            got = fly_in(policy, flown, episodes, 0, advance)
        aircraft = flies.name if advance is None else own or "matched"
        success, time = float(got["success"].mean()), got["length_s"][got["success"]]
        mean = float(time.mean()) if len(time) else float("nan")
        found.append(Races(where, aircraft, course, success, episodes, mean))
        said(f"{where}, {aircraft}, collisions by {course}: {success:.3f}")
    return found


def solids(scenario: Scenario, episodes: int) -> dict[str, Any]:
    """The solids of each race, as the driver of the simulator takes them."""
    environment = Environment(scenario, num_envs=episodes, seed=EVALUATION_SEED)
    task: Any = scenario.task
    environment.reset()
    drawn = (environment.markers(k) for k in range(episodes))
    built = [[x for x in markers if isinstance(x, Primitive)] for markers in drawn]
    for each in built:
        for k in range(4 * len(task.course.gates)):  # the sides of frames come first
            thin = DEPTH, *np.asarray(each[k].size)[1:]  # they are drawn thicker
            each[k] = dataclasses.replace(each[k], size=thin)
    places = [[[*x.position, *x.quaternion] for x in each] for each in built]
    shapes = [(x.shape, np.asarray(x.size, float).tolist()) for x in built[0]]
    return {"shapes": shapes, "places": np.array(places, float).tolist()}
