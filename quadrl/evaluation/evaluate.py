"""Evaluate a policy or a controller in episodes that no training has seen."""

from __future__ import annotations

import dataclasses
import html
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Unpack, cast

import numpy as np

from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.files import write_csv
from quadrl.base.units import length, percent, quantity
from quadrl.base.validation import number
from quadrl.control import CONTROLLERS
from quadrl.control.feasibility import warn_of_unreached
from quadrl.control.modes import kind
from quadrl.core.catalogue import make
from quadrl.core.scenario import UNDISTURBED, Conditions, Scenario
from quadrl.core.snapshot import Rollout
from quadrl.core.task import Task
from quadrl.core.trajectory import Trajectory
from quadrl.evaluation.controllers import make_controller, policy_of
from quadrl.evaluation.in_flight import Controller, scenario_of
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import (
    EVALUATION_SEED,
    MAX_EPISODES,
    MAX_SEED,
    flights,
    fly,
    summarize,
)

SAMPLING_SEED = 0  # of the actions drawn from a policy


@dataclasses.dataclass(frozen=True, repr=False)
class Evaluation:
    """What a policy or a controller reached over some episodes; a table in a notebook."""

    name: str
    """What flew."""
    scenario: Scenario
    """What it flew."""
    seed: int
    """Seed of the episodes."""
    metrics: dict[str, Any]
    """Names of task and vehicle, the seed, and what `quadrl.evaluation.rollout.summarize` gives."""
    rollout: Rollout
    """The flights, step by step."""

    @property
    def task(self) -> Task:
        """The task that was flown."""
        return self.scenario.task

    @property
    def vehicle(self) -> Vehicle:
        """The aircraft in its air."""
        return self.scenario.aircraft

    def __repr__(self) -> str:
        found = self.metrics
        return (
            f"{self.name} on {self.task.name}, {found['episodes']} episodes: "
            f"{percent(found['survival_rate'])} to the end, "
            f"{percent(found['success_rate'])} successful, error over the last 2 s "
            f"{length(found['position_error_m'])}, turning at "
            f"{quantity('yaw_rate_rad_s', found['yaw_rate_rad_s'])}"
        )

    def _repr_html_(self) -> str:
        rows = [("", self.name), *((name, quantity(name, x)) for name, x in self.metrics.items())]
        return html_table(rows)

    def trajectory(self) -> Trajectory:
        """The first flight, to be drawn; what it is drawn in carries the scenario.

        Another one is the first of an evaluation with the seed of that flight.
        """
        flight = self.rollout.trajectory(self.vehicle)
        return dataclasses.replace(flight, scenario=self.scenario.to_json())

    def yardstick(self) -> Evaluation:
        """The geometric controller in the same episodes; it commands rotors, as far as the mode."""
        flown = self.scenario
        vehicle = kind(flown.control_mode).reach(flown.vehicle)
        rotors: Any = {"control_mode": "rotor", "observe": flown.observe.for_controller()}
        other = dataclasses.replace(flown, vehicle=vehicle, **rotors)
        return evaluate("geometric", other, episodes=self.metrics["episodes"], seed=self.seed)

    def save_csv(self, path: str | Path) -> Path:
        """Write one row per flight: its seed and what `quadrl.evaluation.rollout.flights` gives."""
        columns = flights(self.rollout)
        rows = []
        for i, row in enumerate(
            zip(*(column.tolist() for column in columns.values()), strict=True)
        ):
            cells = (f"{x:.6g}" if isinstance(x, float) else int(x) for x in row)
            rows.append((i, self.seed + i, *cells))
        write_csv(Path(path), ("episode", "seed", *columns), rows)
        return Path(path)

    def save_states(self, path: str | Path) -> Path:
        """Write one row per control step of each flight, from its start at time 0 on.

        Time [s]; position x, y, z [m] and goal in the task's frame; quaternion; velocity [m/s],
        world frame; body rate wx, wy, wz [rad/s], body frame; speeds of the rotors [rad/s]; and the
        action that is taken there, none where a flight is over.
        """
        flown = self.rollout
        none = np.full((1, *flown.action.shape[1:]), np.nan)
        parts = {
            "x y z": flown.position,
            "qw qx qy qz": flown.quaternion,
            "vx vy vz": flown.velocity,
            "wx wy wz": flown.body_rate,
            _numbered("rotor", flown.rotor_speed): flown.rotor_speed,
            "goal_x goal_y goal_z": flown.goal,
            _numbered("action", flown.action): np.concatenate([flown.action, none]),
        }
        whole, rows = np.concatenate([*parts.values()], axis=-1), list[Any]()  # (S, N, columns)
        for i, last in enumerate(flown.length):
            for t, row in enumerate(whole[: last + 1, i]):
                cells = (f"{x:.9g}" if x == x else "" for x in (t * flown.control_timestep, *row))
                rows.append((i, self.seed + i, *cells))
        write_csv(Path(path), ["episode", "seed", "time", *" ".join(parts).split()], rows)
        return Path(path)


def _numbered(name: str, values: np.ndarray) -> str:
    return " ".join(f"{name}_{k + 1}" for k in range(values.shape[-1]))


def evaluate(
    controller: Any,
    task: str | Task | Scenario | None = None,
    *,
    episodes: int = 100,
    seed: int = 0,
    sampled: bool = False,
    **conditions: Unpack[Conditions],
) -> Evaluation:
    """Fly a policy or a controller through episodes that no training has seen.

    They are flown in MuJoCo unless `engine` says otherwise.

    Args:
        controller: A policy or a controller, as `setting` takes it.
        task: A task or its name, or a whole scenario; by default the task that the policy was
            trained for.
        episodes: Number of episodes.
        seed: Seed of the episodes; the same for every controller.
        sampled: Whether to draw the actions of a policy, as in training, instead of their mean.
        **conditions: `vehicle`, `weather`, `randomization` and the others, as
            `quadrl.core.scenario.Conditions` has them, and options of the task; what is left out
            is as in the training. A controller flies the aircraft that the task is trained on.

    Raises:
        QuadrlError: Something is unknown, out of range, or does not fit together.
    """
    seed = number("seed", seed, 0, MAX_SEED, whole=True)
    number("episodes", episodes, 1, MAX_EPISODES, whole=True)
    name, flown, scenario = setting(controller, task, **conditions)
    if sampled:
        if not isinstance(flown, Policy):
            raise QuadrlError(name="sampled", value=True, allowed="False for a controller")
        flown = flown.flying(episodes, SAMPLING_SEED)
    asked = scenario.randomization, scenario.control_mode, scenario.mean_wind, scenario.lands
    warn_of_unreached(scenario.aircraft, *asked)
    rollout = fly(flown, scenario, episodes=episodes, seed=EVALUATION_SEED + seed)
    names = {"task": scenario.task.name, "vehicle": scenario.vehicle.name, "seed": seed}
    return Evaluation(name, scenario, seed, names | summarize(rollout), rollout)


def setting(
    controller: Any,
    task: str | Task | Scenario | None = None,
    **conditions: Unpack[Conditions],
) -> tuple[str, Controller, Scenario]:
    """Resolve a controller, its name, and the scenario that it flies.

    Args:
        controller: A `Policy`; what `quadrl.train` returned; a run folder or a .safetensors file;
            the name of a task, for the policy for it that comes with quadrl, or of such a policy
            (hover_robust); "geometric" or "lqr";
            or any function of flat observations (N, size) that gives actions (N, k): of arrays,
            or a torch module.
        task: A task or its name, or a whole scenario; None for what the policy was trained for,
            hover for a controller.
        **conditions: As `evaluate` takes them.

    Returns:
        A name for what flies, a function of observations, and the scenario.

    Raises:
        QuadrlError: Something is unknown or missing.
    """
    flown: Any = getattr(controller, "policy", controller)
    if isinstance(flown, str) and flown in CONTROLLERS:
        scenario = Scenario.of(_on_its_aircraft(task or "hover"), **conditions)
        made = make_controller(flown, scenario.task, scenario.aircraft)
        return f"{flown} controller", made, scenario
    name = "policy" if isinstance(flown, Policy) else getattr(flown, "__name__", "controller")
    if isinstance(flown, (str, Path)):
        name, flown = str(flown), policy_of(flown)
    if not callable(flown):
        allowed = "a policy, a run, a path, the name of a task or a controller, or a function"
        raise QuadrlError(name="controller", value=flown, allowed=allowed)
    return name, cast(Any, flown), scenario_of(flown, task, **conditions)


def _on_its_aircraft(task: str | Task | Scenario) -> Scenario | dict[str, Any]:
    """What a controller flies: a scenario as it is, a task with the aircraft of its training."""
    if isinstance(task, Scenario):
        return task
    made = make(task)
    options = made.training.get("vehicle_options", {})
    return {"task": made, "vehicle": made.trained_on, "vehicle_options": options}


def beside(
    controllers: Iterable[Any],
    task: str | Task | Scenario | None = None,
    **conditions: Unpack[Conditions],
) -> list[tuple[Controller, Scenario]]:
    """Resolve several controllers for a view side by side: one episode of one task in one world.

    Each has the aircraft and the observation of its training. The task is that of the first; the
    weather, the randomization and the events are the first that disturb. Wind acts on all as on the
    first that brings it.

    Args:
        controllers: Policies or controllers, each as `setting` takes it.
        task: As `setting` takes it.
        **conditions: As `setting` takes them.

    Raises:
        QuadrlError: Something is unknown or missing.
    """
    flown: list[tuple[Controller, Scenario]] = []
    for one in controllers:
        _, flies, scenario = setting(one, task, **conditions)
        task = task or scenario.task.name
        flown.append((flies, scenario))
    scenarios = [scenario for _, scenario in flown]
    same: Any = {"task": scenarios[0].task}
    calm = Scenario.of(scenarios[0].task, **UNDISTURBED)
    for name in UNDISTURBED:
        usual = getattr(calm, name)
        own = (getattr(scenario, name) for scenario in scenarios)
        same[name] = next((world for world in own if world != usual), usual)
    air = next((one.aerodynamics for one in scenarios if not one.calm), None)
    return [
        (flies, dataclasses.replace(one, **same, aerodynamics=one.aerodynamics or air))
        for flies, one in flown
    ]


def html_table(rows: list[tuple[str, ...]]) -> str:
    """Rows of text as a table of a notebook; the first row is its head."""

    def line(cells: tuple[str, ...], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    body = "".join(line(row, "td") for row in rows[1:])
    return f"<table><thead>{line(rows[0], 'th')}</thead><tbody>{body}</tbody></table>"
