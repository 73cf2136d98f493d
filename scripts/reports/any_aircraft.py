"""Fly one policy on any quadrotor, others beside it: `any_aircraft` and `any_memories`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from quadrl.base.units import length, percent
from quadrl.conditions.randomization import Randomization
from quadrl.core.scenario import Scenario
from quadrl.deploy.crosscheck import LATE
from quadrl.deploy.foundation_policy import Facing, commanding, installed
from quadrl.evaluation.card import wilson
from quadrl.evaluation.in_flight import Controller
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly, summarize
from scripts.reports import report
from scripts.reports.report import Result, Runs, block, grouped

SEED = 970_000  # of flights that no choice was made on
PRESETS = ("paper", "crazyflie", "crazyflie_brushless", "racer")
AIRS = {"none": "still", "full": "real"}
CASES = [(air, delay) for air in AIRS for delay in (0.0, LATE)]
LAYOUTS = {"an X": "racer", "a plus": "paper"}
"""Of drawn aircraft, and the presets that have them."""
WHO = {"any": "any", "raptor": "RAPTOR"}
DRAWN = "drawn: "
FIGURES = ("success_rate", "survival_rate", "position_error_m", "yaw_rate_rad_s")


def any_aircraft(run: Runs = (), episodes: int = 1000, beside: int = 100) -> None:
    """Fly the policy `hover_any` on the presets and on drawn quadrotors, RAPTOR's beside it.

    RAPTOR's flies if the package foundation-policy is there, which quadrl does not need.

    Args:
        run: Run folder of the policy; by default the one that comes with quadrl.
        episodes: Flights on each preset in each condition; as many on drawn quadrotors.
        beside: Flights of RAPTOR's policy: the first of those.
    """
    policy = Policy.load(run[0]) if run else Policy.pretrained("hover", variant="any")
    flyers = {"any": episodes} | ({"raptor": beside} if installed() else {})

    def rows(aircraft: str) -> Iterator[Result]:
        for air, delay in CASES:
            for who, flights in flyers.items():
                count = flights // len(LAYOUTS) if aircraft.startswith(DRAWN) else flights
                known = {"flies": who, "aircraft": aircraft, "air": air, "delay": delay}
                yield known | flown(policy, who, aircraft, air, delay, count)

    every = *PRESETS, *(DRAWN + layout for layout in LAYOUTS)
    report.save("any_aircraft", {"rows": [row for one in every for row in rows(one)]})


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
    report.say(f"{who}, {aircraft}, {AIRS[air]} air, {delay:g} s late: {found['success_rate']}")
    return {"episodes": count} | {key: found[key] for key in FIGURES}


def worst(rows: Sequence[Result]) -> dict[str, float]:
    """The least of the shares and the largest of the other figures."""
    by = {True: min, False: max}
    return {name: by[name.endswith("_rate")](row[name] for row in rows) for name in FIGURES}


def any_aircraft_table() -> str:
    """Success and survival on each aircraft: the worst of still and real air, late and not."""
    result, rows = report.load("any_aircraft"), []
    for (aircraft, who), own in grouped(result["rows"], "aircraft", "flies").items():
        each, least = grouped(own, "air", "delay"), worst(own)
        shares = (percent(each[case][0]["success_rate"]) for case in CASES)
        last = percent(least["survival_rate"]), length(least["position_error_m"])
        rows.append([aircraft, WHO[who], *shares, *last, f"{least['yaw_rate_rad_s']:.2g}"])
    heads = (f"{AIRS[air]}{', 20 ms' if delay else ''}" for air, delay in CASES)
    head = ("aircraft", "policy", *heads, "survives", "error", "yaw rate [rad/s]")
    counts = sorted({row["episodes"] for row in result["rows"]})
    note = f"{' or '.join(map(str, counts))} flights each. The last three columns are the worst "
    return block(head, rows, f"{note}of the four conditions.", result)


def memories_table() -> str:
    """Success on drawn aircraft in real air, 20 ms late, by what a policy remembers with."""
    result, rows, count = report.load("any_memories"), [], 0
    for kind, own in grouped(result["rows"], "memory", "told").items():
        count = sum(row["episodes"] for row in own)
        good = sum(row["episodes"] * row["success_rate"] for row in own)
        low, high = wilson(good, count)
        stays = float(np.mean([row["survival_rate"] for row in own]))
        share = f"{percent(good / count)} ({percent(low)} to {percent(high)})"
        rows.append([*kind, share, percent(stays), length(worst(own)["position_error_m"])])
    head = ("memory", "told its matrix", "successful (95 % interval)", "survives", "error")
    return block(head, rows, f"{count:,} flights each; one training each.", result)


PARTS: report.Parts = {"any-aircraft": any_aircraft_table, "any-memories": memories_table}
