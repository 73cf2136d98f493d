"""Fly one policy on any quadrotor, others beside it: `any_aircraft` and `any_memories`."""

from __future__ import annotations

import dataclasses
import importlib.util
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadrl.base.rotation import to_world
from quadrl.base.units import length, percent
from quadrl.conditions.randomization import Randomization
from quadrl.control.reading import Reading
from quadrl.core.scenario import Scenario
from quadrl.evaluation.card import wilson
from quadrl.evaluation.in_flight import Controller
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly, summarize
from scripts.reports import report
from scripts.reports.crosscheck import LATE, PRESETS, Raptor, commanding
from scripts.reports.report import Result, Runs, say, table

SEED = 970_000  # of flights that no choice was made on
AIRS = {"none": "still", "full": "real"}
LAYOUTS = {"an X": "racer", "a plus": "paper"}
"""Of drawn aircraft, and the presets that have them."""
WHO = {"any": "any", "raptor": "RAPTOR"}
DRAWN = "drawn: "


class Facing(Raptor):
    """RAPTOR's policy, told that each flight begins heading east: it holds the heading of then."""

    begun: np.ndarray | None = None  # (N,) [rad], heading of the first observation

    def read(self, observation: np.ndarray) -> Reading:
        """What it is told of observations (N, size)."""
        reading = super().read(observation)
        east, north = reading.heading.T
        self.begun = np.arctan2(north, east) if self.begun is None else self.begun
        turn = Rotation.from_euler("z", -self.begun[:, None]).as_matrix()
        vectors = reading.to_goal, reading.velocity, reading.target_velocity
        to_goal, velocity, target = (to_world(turn, vector) for vector in vectors)
        turned = {"to_goal": to_goal, "velocity": velocity, "target_velocity": target}
        return dataclasses.replace(reading, rotation=turn @ reading.rotation, **turned)


def any_aircraft(run: Runs = (), episodes: int = 1000, beside: int = 100) -> None:
    """Fly the policy `hover_any` on the presets and on drawn quadrotors, RAPTOR's beside it.

    RAPTOR's flies if the package foundation-policy is there, which quadrl does not need.

    Args:
        run: Run folder of the policy; by default the one that comes with quadrl.
        episodes: Flights on each preset in each condition; as many on drawn quadrotors.
        beside: Flights of RAPTOR's policy: the first of those.
    """
    policy = Policy.load(run[0]) if run else Policy.pretrained("hover", variant="any")
    there = importlib.util.find_spec("foundation_policy") is not None
    rows, flyers = list[Result](), {"any": episodes} | ({"raptor": beside} if there else {})
    for aircraft in (*PRESETS, *(DRAWN + layout for layout in LAYOUTS)):
        for air, delay in ((air, delay) for air in AIRS for delay in (0.0, LATE)):
            for who, flights in flyers.items():
                count = flights // len(LAYOUTS) if aircraft.startswith(DRAWN) else flights
                row = flown(policy, who, aircraft, air, delay, count)
                rows.append({"flies": who, "aircraft": aircraft, "air": air, "delay": delay} | row)
                say(rows[-1])
    report.save("any_aircraft", {"rows": rows})


def any_memories(runs: Runs, episodes: int = 1000) -> None:
    """Fly policies of other memories on drawn quadrotors in real air, 20 ms late.

    Args:
        runs: Their run folders.
        episodes: Flights of each.
    """
    rows = list[Result]()
    for policy in map(Policy.load, runs):
        seen, memory = policy.scenario.observe, policy.memory
        past = f"history of {seen.action_history}" if seen.observation_history else "none"
        kind = f"GRU of {policy.state_size}" if memory else past
        told = "yes" if "airframe" in seen.sensors else "no"
        for layout in LAYOUTS:
            row = flown(policy, "any", DRAWN + layout, "full", LATE, episodes // len(LAYOUTS))
            rows.append({"memory": kind, "told": told, "steps": policy.metadata["steps"]} | row)
            say(rows[-1])
    report.save("any_memories", {"rows": rows})


def flown(policy: Policy, who: str, aircraft: str, air: str, delay: float, count: int) -> Result:
    """Figures of flights in one condition, by the policy or by RAPTOR's, each in its own terms."""
    drawn = aircraft.removeprefix(DRAWN) if aircraft.startswith(DRAWN) else ""
    draws, name = policy.scenario.randomization, LAYOUTS[drawn] if drawn else aircraft
    kept = ("sizes", "torque", "inertia_axes", "rotors") if drawn else ()
    changes: dict[str, Any] = {field: getattr(draws, field) for field in kept}
    given: Any = {
        **{"vehicle": name, "aerodynamics": air, "weather": "calm", "engine": "free_flight"},
        "randomization": Randomization(**changes, command_delay=(delay, delay)),
        "control_timestep": policy.scenario.vehicle.control_timestep,
    }
    scenario, flyer = Scenario.of(policy.scenario, **given), policy
    if who == "raptor":
        scenario = commanding(scenario)
        flyer: Controller = Facing(scenario)
    found = summarize(fly(flyer, scenario, episodes=count, seed=SEED))
    kept = ("success_rate", "survival_rate", "position_error_m", "yaw_rate_rad_s")
    return {"episodes": count} | {key: found[key] for key in kept}


def any_aircraft_table() -> str:
    """Success and survival on each aircraft: the worst of still and real air, late and not."""
    result, rows = report.load("any_aircraft"), []
    cases = [(air, delay) for air in AIRS for delay in (0.0, LATE)]
    for aircraft in dict.fromkeys(row["aircraft"] for row in result["rows"]):
        own = [row for row in result["rows"] if row["aircraft"] == aircraft]
        for who in dict.fromkeys(row["flies"] for row in own):
            each = {(x["air"], x["delay"]): x for x in own if x["flies"] == who}
            worst = max(x["position_error_m"] for x in each.values())
            fell = min(x["survival_rate"] for x in each.values())
            turning = max(x["yaw_rate_rad_s"] for x in each.values())
            shares = (percent(each[case]["success_rate"]) for case in cases)
            last = percent(fell), length(worst), f"{turning:.2g}"
            rows.append([aircraft, WHO[who], *shares, *last])
    heads = (f"{AIRS[air]}{', 20 ms' if delay else ''}" for air, delay in cases)
    head = ("aircraft", "policy", *heads, "survives", "error", "yaw rate [rad/s]")
    counts = sorted({row["episodes"] for row in result["rows"]})
    note = f"{' or '.join(map(str, counts))} flights each. The last three columns are the worst "
    return f"{table(head, rows)}\n\n{note}of the four conditions. {report.source(result)}"


def memories_table() -> str:
    """Success on drawn aircraft in real air, 20 ms late, by what a policy remembers with."""
    result, rows = report.load("any_memories"), []
    for kind in dict.fromkeys((row["memory"], row["told"]) for row in result["rows"]):
        own = [row for row in result["rows"] if (row["memory"], row["told"]) == kind]
        count = sum(row["episodes"] for row in own)
        good = sum(row["episodes"] * row["success_rate"] for row in own)
        low, high = wilson(good, count)
        error = max(row["position_error_m"] for row in own)
        stays = float(np.mean([row["survival_rate"] for row in own]))
        share = f"{percent(good / count)} ({percent(low)} to {percent(high)})"
        rows.append([*kind, share, percent(stays), length(error)])
    head = ("memory", "told its matrix", "successful (95 % interval)", "survives", "error")
    note = f"{count:,} flights each; one training each. {report.source(result)}"
    return f"{table(head, rows)}\n\n{note}"


PARTS: report.Parts = {"any-aircraft": any_aircraft_table, "any-memories": memories_table}
