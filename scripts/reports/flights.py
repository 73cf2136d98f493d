"""Fly real flights again, open loop, beside what was measured: `flights`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from matplotlib.figure import Figure

from quadrl.aircraft.presets import CRAZYFLIE, in_real_air
from quadrl.aircraft.vehicle import Vehicle
from quadrl.evaluation import plotting
from quadrl.evaluation.flight_log import read
from quadrl.evaluation.identification import TRIMS, VAGUE, at_bounds, changed, fit
from quadrl.evaluation.open_loop import UNITS, Window, halves, judged, stretch
from quadrl.evaluation.open_loop import windows as windows_of
from quadrl.evaluation.predictions import picture
from scripts.reports import report
from scripts.reports.report import DOCS, Result, block

CAPTURED, BY_HAND = "under motion capture", "by hand"
JUDGED = ("figure8", "lissajous", "trefoil")  # of the former; the others are fitted
PIECE = 2.5  # [s] of the latter, judged and fitted in turn
AIR = in_real_air(CRAZYFLIE)
# The largest speed was measured at 2.97 V; these flights have more.
FASTER = tuple(dataclasses.replace(rotor, max_speed=1.3 * rotor.max_speed) for rotor in AIR.rotors)
BEGUN = dataclasses.replace(AIR, rotors=FASTER)  # what is fitted
FITS = {  # what is fitted in turn, and by which quantity
    "fitted: thrust, drag": (("thrust", "rotor_drag"), "velocity"),
    "fitted: trim, lag too": ((*TRIMS, "lag_rate"), "body_rate"),
    "fitted: inertia too": (("inertia_x", "inertia_y", "torque"), "body_rate"),
}
Drawn = tuple[str, float, float, str, str, int]
"""Start of a log's name, from when till when [s], label, quantity, axis."""
PICTURES: dict[str, tuple[str, Drawn]] = {
    "by_hand_roll": (BY_HAND, ("log15_0", 55.0, 57.0, "roll rate [rad/s]", "body_rate", 0)),
    "captured_roll": (CAPTURED, ("B3_", 6.0, 11.0, "roll rate [rad/s]", "body_rate", 0)),
    "captured_climb": (CAPTURED, ("B3_", 6.0, 11.0, "velocity up [m/s]", "velocity", 2)),
}


def sets() -> dict[str, tuple[list[Window], list[Window]]]:
    """Windows of real flights that judge, and others for fits."""
    stand = DOCS / "data" / "thrust_stand_cf2.1-stock-prop.csv"
    found: dict[str, tuple[list[Window], list[Window]]] = {CAPTURED: ([], []), BY_HAND: ([], [])}
    for log in read(DOCS / "data" / "nanobench_extract.npz", stand).values():
        found[CAPTURED][not any(name in log.name for name in JUDGED)].append(windows_of(log))
    for log in read(DOCS / "data" / "crazyflie_excitation.npz", stand).values():
        for part, own in zip(found[BY_HAND], halves(windows_of(log), PIECE), strict=True):
            part.append(own)
    return found


def judge(where: Sequence[Window], fits: Sequence[Result]) -> list[Result]:
    """The errors of holding the state, of the preset, and of it with fitted factors."""
    flown = {"as shipped": CRAZYFLIE, "in real air": AIR}
    flown |= {row["model"]: changed(BEGUN, row["factors"]) for row in fits}
    return judged(where, flown)


def flights() -> None:
    """Fit the brushed Crazyflie to real flights, fly others, and draw some."""
    result: dict[str, list[Result]] = {"rows": [], "fits": []}
    for name, (others, learnt) in sets().items():
        factors: dict[str, float] = {}
        vague: dict[str, float] = {}
        fits: list[Result] = []
        for model, (free, quantity) in FITS.items():
            if quantity in others[0][0].motion:
                found, spread = fit(changed(BEGUN, factors), learnt, free, quantity)
                factors, vague = factors | found, vague | spread
                fits.append({"model": model, "factors": factors, "standard_errors": vague})
        for part, rows in {"rows": judge(others, fits), "fits": fits}.items():
            result[part] += ({"flights": name} | row for row in rows)
        for file, (of, drawn) in PICTURES.items():
            if of == name:
                physical = [row["factors"] for row in fits if not at_bounds(row["factors"])][-1]
                figure = drawn_over(others, changed(BEGUN, physical), drawn)
                plotting.save(figure, report.IMAGES / f"{file}.png")
    report.save("flights", result)


def drawn_over(where: Sequence[Window], fitted: Vehicle, drawn: Drawn) -> Figure:
    """A stretch of a log, with the preset and a fit."""
    name, first, last, label, quantity, axis = drawn
    (log,) = (log for log, _ in where if log.name.startswith(name))
    models = {"as shipped": CRAZYFLIE, "fitted": fitted}
    return picture(stretch(log, first, last), models, [(quantity, axis, label)])


def flights_table() -> str:
    """Errors of each model in each set, what was fitted, and whether it is physical."""
    result, rows = report.load("flights"), []
    fits = {(row["flights"], row["model"]): row for row in result["fits"]}
    for row in result["rows"]:
        own = fits.get((row["flights"], row["model"]), {"factors": {}})
        beyond, said = at_bounds(own["factors"]), []
        for name in FITS.get(row["model"], ((), ""))[0]:
            spread = own["standard_errors"][name]
            known = "" if spread <= VAGUE and name not in beyond else ", not identified"
            said.append(f"{name} {own['factors'][name]:.2f} ± {100 * spread:.1f} %{known}")
        cells = (" / ".join(f"{x:.2g}" for x in row[name]) for name in UNITS)
        physical = "" if row["model"] == "hold" else "no" if beyond else "yes"
        words = f"{row['flights']}, {row['windows']}" if row["model"] == "hold" else ""
        rows.append((words, row["model"], *cells, physical, "; ".join(said)))
    head = (f"{name.replace('_', ' ')} [{unit}]" for name, unit in UNITS.items())
    head = ("flights, predictions", "model", *head, "physical", "factors on the preset's numbers")
    return block(head, rows, "", result)


PARTS: report.Parts = {"flights": flights_table}
