"""Fly policies of Crazyflies in other simulators, and another project's here: `crosschecks`."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import roll_pitch_yaw
from quadrl.base.units import length, percent
from quadrl.core.scenario import Scenario
from quadrl.deploy.crosscheck import LATE, OWN, crosscheck
from quadrl.deploy.foundation_policy import Raptor, commanding, installed
from quadrl.deploy.races import races
from quadrl.evaluation.policy import Policy, shipped
from quadrl.evaluation.rollout import flights, fly
from scripts.reports import report
from scripts.reports.any_aircraft import PRESETS
from scripts.reports.report import Result, block, grouped, say, table

HEAD = ("flown in", "aircraft", "successful", "20 ms late", "error", "20 ms late", "fell, late")


def crosschecks(only: tuple[str, ...] = ()) -> None:
    """Crosscheck every policy for a Crazyflie, and fly RAPTOR's policy on the presets.

    This takes the package foundation-policy, which quadrl does not need.

    Args:
        only: Names of policies, and `race` for its table, beside what was measured of all else; by
            default everything.
    """
    if not only and not installed():
        sys.exit("needs foundation-policy: python -m pip install foundation-policy")
    others = {} if only else {"raptor": raptor()}
    if not only or "race" in only:
        found = races(Policy.pretrained("lsy_race"), said=say)
        others["race"] = [dataclasses.asdict(row) for row in found]
    cases = {path.stem: partial(crosschecked, path.stem) for path in shipped()}
    report.gather("crosscheck", "policy", cases, only, **others)


def crosschecked(name: str) -> dict[str, list[Result]]:
    """How a policy for a Crazyflie flies in other simulators; no rows of what cannot."""
    policy, found = Policy.pretrained(name), []
    if policy.scenario.vehicle.name in OWN:
        try:
            found = crosscheck(policy, said=say).rows
        except QuadrlError as error:  # it races through gates
            say(f"{name}: {error}")
    return {"rows": [dataclasses.asdict(row) for row in found]}


def raptor() -> list[Result]:
    """How RAPTOR's policy flies the presets in quadrl."""
    found: list[Result] = []
    cases = [(air, delay) for air in ("none", "full") for delay in (0.0, LATE)]
    for name, (air, delay) in ((name, case) for name in PRESETS for case in cases):
        given: Any = {"vehicle": name, "aerodynamics": air, "engine": "free_flight"}
        given |= {"randomization": {"command_delay": (delay, delay)}} if delay else {}
        scenario = commanding(Scenario.of("hover", **given))
        rollout = fly(Raptor(scenario), scenario, episodes=100)
        each, yaw = flights(rollout), roll_pitch_yaw(rollout.quaternion[0])[:, 2]
        row: Result = {"vehicle": name, "air": air, "delay": delay, "episodes": 100}
        row |= {"success_rate": float(each["success"].mean())}
        row |= {"facing_success_rate": float(each["success"][np.abs(yaw) < np.pi / 2].mean())}
        row |= {"position_error_m": float(np.median(each["position_error_m"]))}
        found.append(row | {"fall_rate": float(1 - each["survived"].mean())})
        say(found[-1])
    return found


def _cells(rows: Sequence[Result]) -> list[str]:
    """Of a row on time and the same late."""
    success = [percent(row["success_rate"]) for row in rows]
    error = [length(row["position_error_m"]) for row in rows]
    return [*success, *error, percent(rows[1]["fall_rate"])]


def crosscheck_table() -> str:
    """What policies for Crazyflies reach in other simulators."""
    result, found = report.load("crosscheck"), []
    for policy, rows in grouped(result["rows"], "policy").items():
        for k in range(0, len(rows), 2):
            where = rows[k]["flown_in"], rows[k]["aircraft"]
            found.append(("" if k else f"`{policy}`", *where, *_cells(rows[k : k + 2])))
    return block(("policy", *HEAD), found, "", result, result["rows"])


def raptor_table() -> str:
    """What RAPTOR's policy reaches in quadrl."""
    found = []
    said = {"none": "still", "full": "real air"}
    for (name, air), rows in grouped(report.load("crosscheck")["raptor"], "vehicle", "air").items():
        facing = (percent(row["facing_success_rate"]) for row in rows)
        found.append((name, said[air], *facing, *_cells(rows)))
    head = ("aircraft", "air", "starts facing ahead", "20 ms late", "all starts", *HEAD[3:])
    return table(head, found)


def race_table() -> str:
    """What the policy for `lsy_race` reaches in the competition's simulator."""
    head = "flown in", "aircraft", "collisions by", "flights", "through every gate", "mean time"
    rows = []
    for row in report.load("crosscheck")["race"]:
        known = (row[name] for name in ("flown_in", "aircraft", "course", "episodes"))
        time = row["race_time_s"]  # none if no race ended
        mean = "" if time is None else f"{time:.2f} s"
        rows.append((*known, percent(row["success_rate"]), mean))
    return table(head, rows)


PARTS: report.Parts = {
    "crosscheck": crosscheck_table,
    "raptor": raptor_table,
    "crosscheck-race": race_table,
}
