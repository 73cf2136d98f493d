"""Fly policies of Crazyflies in other simulators, and another project's here: `crosschecks`."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadrl.base.errors import QuadrlError
from quadrl.base.primitives import Primitive
from quadrl.base.rotation import roll_pitch_yaw
from quadrl.base.units import length, percent
from quadrl.control.reading import Reading
from quadrl.core.environment import Environment
from quadrl.core.scenario import UNDISTURBED, Scenario
from quadrl.deploy.crosscheck import LATE, OWN, brakes, crosscheck, fly_in
from quadrl.deploy.simulators import Simulator, environment_of
from quadrl.evaluation.policy import Policy, shipped
from quadrl.evaluation.rollout import EVALUATION_SEED, flights, fly
from quadrl.tasks.arena import DEPTH
from scripts.reports import report
from scripts.reports.report import Result, say, table

PRESETS = ("paper", "crazyflie", "crazyflie_brushless", "racer")
MOTORS = np.radians([-45, -135, 135, 45])  # bearings of the motors that RAPTOR commands, in turn
NEAREST, SLOWEST = 0.5, 1.0  # [m], [m/s]: what PX4's module clips its input to
RACES = 300
HEAD = ("flown in", "aircraft", "successful", "20 ms late", "error", "20 ms late", "fell, late")


class Raptor:
    """RAPTOR's published policy (the package foundation-policy) on an aircraft, every 10 ms."""

    control_mode = "rotor"

    def __init__(self, scenario: Scenario) -> None:
        """Load it, and turn its frame so that the rotors are at the corners."""
        self.policy: Any = importlib.import_module("foundation_policy").Raptor()
        self.policy.reset()
        self.vehicle = vehicle = scenario.vehicle
        self.terms = scenario.task.observation
        bearing = np.array([np.arctan2(*one.position[1::-1]) for one in vehicle.rotors])
        ahead = np.abs(bearing).min() < 0.1
        self.frame = Rotation.from_euler("z", np.pi / 4 if ahead else 0.0)
        apart = np.exp(1j * (bearing - ahead * np.pi / 4 - MOTORS[:, None]))
        self.order = np.abs(apart - 1).argmin(axis=1)
        self.last: np.ndarray | None = None

    def read(self, observation: np.ndarray) -> Reading:
        """What it is told of observations (N, size)."""
        return Reading.of(observation.astype(float), self.terms, self.vehicle)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Actions (N, 4) of quadrl for observations (N, size): to the goal, or along with it."""
        reading = self.read(observation)
        back = self.frame.inv()
        offset = np.clip(-back.apply(reading.to_goal), -NEAREST, NEAREST)
        faster = back.apply(reading.velocity - reading.target_velocity)
        velocity, rate = np.clip(faster, -SLOWEST, SLOWEST), back.apply(reading.body_rate)
        turned = back * Rotation.from_matrix(reading.rotation) * self.frame
        last = np.zeros((len(observation), 4)) if self.last is None else self.last
        parts = offset, turned.as_matrix().reshape(-1, 9), velocity, rate, last
        self.last = np.clip(self.policy.evaluate_step(np.concatenate(parts, axis=1)), -1, 1)
        speed = np.empty_like(self.last)
        speed[:, self.order] = (self.last + 1) / 2
        change = speed * self.vehicle.max_speed - self.vehicle.hover_speed
        return change / self.vehicle.action_scale


def commanding(scenario: Scenario) -> Scenario:
    """The scenario of that policy: all that it sees, every 10 ms, and all speeds of the rotors."""
    vehicle = scenario.vehicle
    hover, most = vehicle.hover_speed, vehicle.max_speed
    scale = float(np.maximum(hover, most - hover).max())
    reaching = dataclasses.replace(vehicle, action_scale=scale, control_timestep=0.01)
    own: Any = {"control_mode": "rotor", "observe": {}, "aerodynamics": scenario.aerodynamics}
    return Scenario.of(scenario, vehicle=reaching, **own)


def crosschecks(only: tuple[str, ...] = ()) -> None:
    """Crosscheck every policy for a Crazyflie, and fly RAPTOR's policy on the presets.

    This takes the package foundation-policy, which quadrl does not need.

    Args:
        only: Names of policies, and `race` for its table, beside what was measured of all else; by
            default everything.
    """
    if only:
        kept = report.load("crosscheck")
        kept |= {"race": race()} if "race" in only else {}
        paths = (path for path in shipped() if path.stem in only)
        rows = [{"commit": report.commit()} | row for path in paths for row in crosschecked(path)]
        others = (row for row in kept["rows"] if row["policy"] not in only)
        rows += [{"commit": kept["commit"]} | row for row in others]
        report.save("crosscheck", kept | {"rows": sorted(rows, key=lambda row: row["policy"])})
        return
    if importlib.util.find_spec("foundation_policy") is None:
        sys.exit("needs foundation-policy: python -m pip install foundation-policy")
    result: dict[str, list[Result]] = {"raptor": [], "race": race(), "rows": []}
    for name in PRESETS:
        for air in ("none", "full"):
            for delay in (0.0, LATE):
                given: Any = {"vehicle": name, "aerodynamics": air, "engine": "free_flight"}
                given |= {"randomization": {"command_delay": (delay, delay)}} if delay else {}
                scenario = commanding(Scenario.of("hover", **given))
                rollout = fly(Raptor(scenario), scenario, episodes=100)
                found, yaw = flights(rollout), roll_pitch_yaw(rollout.quaternion[0])[:, 2]
                row: Result = {"vehicle": name, "air": air, "delay": delay, "episodes": 100}
                facing = found["success"][np.abs(yaw) < np.pi / 2]
                row |= {"success_rate": float(found["success"].mean())}
                row |= {"facing_success_rate": float(facing.mean())}
                row |= {"position_error_m": float(np.median(found["position_error_m"]))}
                row |= {"fall_rate": float(1 - found["survived"].mean())}
                say(row)
                result["raptor"].append(row)
    result["rows"] = [row for path in shipped() for row in crosschecked(path)]
    report.save("crosscheck", result)


def crosschecked(path: Path) -> list[Result]:
    """How a policy for a Crazyflie flies in other simulators; no rows of what cannot."""
    policy = Policy.load(path)
    if policy.scenario.vehicle.name not in OWN:
        return []
    try:
        found = crosscheck(policy, said=say)
    except QuadrlError as error:  # it races through gates
        say(f"{path.stem}: {error}")
        return []
    return [{"policy": path.stem} | dataclasses.asdict(row) for row in found.rows]


def race() -> list[Result]:
    """Fly the policy for `lsy_race` by crazyflow's physics: the competition's, on its aircraft.

    Rules and track file are those of quadrl's task, the floor is crazyflow's. Nothing is drawn for
    the aircraft, and nothing pushes it. In the last row the course is built in crazyflow's scene,
    too, and MuJoCo finds there what its aircraft's box touches; quadrl's own box is a point then.
    """
    policy = Policy.pretrained("lsy_race")
    flies = policy.scenario.aircraft
    calm: Any = {**UNDISTURBED, "engine": "free_flight", "aerodynamics": flies.aerodynamics}
    scenario = dataclasses.replace(policy.scenario, vehicle=flies, **calm)
    found: list[Result] = []
    for own, built in ((None, False), ("", False), (flies.name, False), (flies.name, True)):
        given = {"own": own, "vehicle": dataclasses.asdict(flies), "brakes": brakes(flies)}
        flown = scenario
        if built:
            point = dataclasses.replace(scenario.task, box=0.0, least_box=0.0)
            flown = dataclasses.replace(scenario, task=point)
            given["course"] = course(flown)
        with contextlib.ExitStack() as stack:
            advance, where = None, "quadrl"
            if own is not None:
                there = Simulator("crazyflow", environment_of("crazyflow", say), given)
                stack.callback(there.close)
                advance, where = there.advance, f"crazyflow {there.version}"
            got = fly_in(policy, flown, RACES, 0, advance)
        row: Result = {"flown_in": where, "aircraft": own or ("matched" if advance else flies.name)}
        row |= {"course": "crazyflow" if built else "quadrl"}
        row |= {"success_rate": float(got["success"].mean()), "episodes": RACES}
        row |= {"race_time_s": float(got["length_s"][got["success"]].mean())}
        say(row)
        found.append(row)
    return found


def course(scenario: Scenario) -> dict[str, Any]:
    """The solids of each race, as the driver of crazyflow takes them."""
    environment = Environment(scenario, num_envs=RACES, seed=EVALUATION_SEED)
    environment.reset()
    races = [[x for x in environment.markers(k) if isinstance(x, Primitive)] for k in range(RACES)]
    for solids in races:
        for k in range(4 * len(scenario.task.course.gates)):  # the sides of frames come first
            thin = DEPTH, *np.asarray(solids[k].size)[1:]  # they are drawn thicker
            solids[k] = dataclasses.replace(solids[k], size=thin)
    places = [[[*x.position, *x.quaternion] for x in solids] for solids in races]
    shapes = [(x.shape, np.asarray(x.size, float).tolist()) for x in races[0]]
    return {"shapes": shapes, "places": np.array(places, float).tolist()}


def _cells(rows: list[Result]) -> list[str]:
    """Of a row on time and the same late."""
    success, error, fell = (
        [say(row[name]) for row in rows]
        for name, say in (
            ("success_rate", percent),
            ("position_error_m", length),
            ("fall_rate", percent),
        )
    )
    return [*success, *error, fell[1]]


def crosscheck_table() -> str:
    """What policies for Crazyflies reach in other simulators."""
    result, found = report.load("crosscheck"), []
    rows = result["rows"]
    for on_time, late in zip(rows[::2], rows[1::2], strict=True):
        where = on_time["flown_in"], on_time["aircraft"]
        first = not found or found[-1][0] != on_time["policy"]
        found.append((on_time["policy"], *where, *_cells([on_time, late]), first))
    shown = [(f"`{row[0]}`" if row[-1] else "", *row[1:-1]) for row in found]
    return f"{table(('policy', *HEAD), shown)}\n\n{report.source(result, rows)}"


def raptor_table() -> str:
    """What RAPTOR's policy reaches in quadrl."""
    rows = report.load("crosscheck")["raptor"]
    air = {"none": "still", "full": "real air"}
    found = [
        (
            *(on_time["vehicle"], air[on_time["air"]]),
            *(percent(row["facing_success_rate"]) for row in (on_time, late)),
            *_cells([on_time, late]),
        )
        for on_time, late in zip(rows[::2], rows[1::2], strict=True)
    ]
    return table(
        ("aircraft", "air", "starts facing ahead", "20 ms late", "all starts", *HEAD[3:]), found
    )


def race_table() -> str:
    """What the policy for `lsy_race` reaches in the competition's simulator."""
    head = "flown in", "aircraft", "collisions by", "flights", "through every gate", "mean time"
    rows = (
        (
            *(row[name] for name in ("flown_in", "aircraft", "course", "episodes")),
            *(percent(row["success_rate"]), f"{row['race_time_s']:.2f} s"),
        )
        for row in report.load("crosscheck")["race"]
    )
    return table(head, rows)


PARTS: report.Parts = {
    "crosscheck": crosscheck_table,
    "raptor": raptor_table,
    "crosscheck-race": race_table,
}
