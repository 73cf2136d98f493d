"""Errors of both engines against the exact solution as a flight becomes fast for the physics step.

The exact solution is `quadrl.dynamics` integrated to twelve digits by a method of eighth order.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import tyro
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from quadrl import dynamics
from quadrl.aircraft import parameters
from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.dynamics import Motion
from quadrl.engines.mujoco import ENGINES, BatchEngine
from scripts.reports import report
from scripts.reports.report import say, table

FLIGHTS, CONTROL_STEPS = 16, 20  # of each row: 1 s
PRODUCTS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # rates times the physics step
SLOW, FAST = 2.0, 10.0  # [m/s] and [rad/s]
TITLES = {
    "lag": "Rotor lag, k_c dt; every rotor is thrown from end to end of its commands",
    "turn": "Turning, |omega| dt, of an aircraft with three different moments of inertia",
    "moment": "Aerodynamic moment, 2 k_M |omega| dt / J",
    "drag": "Drag, 2 k_D |v| dt / m",
}
UNITS = {"position_m": "m", "attitude_rad": "rad", "body_rate_rad_s": "rad/s"}
attitude_of = partial(Rotation.from_quat, scalar_first=True)
Errors = dict[str, dict[str, float]]


def main(products: tuple[float, ...] = PRODUCTS) -> None:
    """Measure and write down.

    Args:
        products: Rates times the physics step.
    """
    tables: dict[str, list] = {name: [] for name in TITLES}
    for product in products:
        for name, errors in zip(TITLES, cases(product), strict=True):
            tables[name].append({"product": product, "errors": errors})
        say(f"rate times dt = {product}")
    report.save("step_size", {"tables": tables})


def cases(product: float) -> list[Errors]:
    """The errors at one product of a rate and the physics step, in the order of TITLES."""
    paper = Vehicle()
    rate = product / paper.physics_timestep
    lagging = tuple(replace(rotor, lag_up=rate, lag_down=rate) for rotor in paper.rotors)
    lopsided = replace(paper, inertia=(7.5e-3, 6e-3, 1.1e-2), moment_coefficient=0.0)
    damped = replace(paper, moment_coefficient=rate * min(paper.inertia) / (2 * FAST))
    dragged = replace(paper, drag_coefficient=rate * paper.mass / (2 * FAST))
    return [
        flown(replace(paper, rotors=lagging), SLOW, SLOW, bang=True),
        flown(lopsided, rate, SLOW),
        flown(damped, FAST, SLOW),
        flown(dragged, SLOW, FAST),
    ]


def flown(vehicle: Vehicle, turn: float, speed: float, *, bang: bool = False) -> Errors:
    """Largest errors of a second of flight by engine.

    Args:
        vehicle: The aircraft.
        turn: Body rate at the start [rad/s], about any axis.
        speed: Speed at the start [m/s], in any direction.
        bang: Whether every rotor is commanded to one of its ends in every control step, or hovers.
    """
    rng = np.random.default_rng(0)

    def directions(size: int) -> np.ndarray:
        drawn = rng.normal(size=(FLIGHTS, size))
        return drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)

    still, rotors = np.zeros((FLIGHTS, 3)), np.tile(vehicle.hover_speed, (FLIGHTS, 1))
    start = (still, directions(4), speed * directions(3), turn * directions(3), rotors)
    exact = np.concatenate(start, axis=-1)
    engines = {name: BatchEngine(vehicle, FLIGHTS, altitude=3.0, engine=name) for name in ENGINES}
    for engine in engines.values():  # written directly: it may be too fast for `place`
        engine.qpos[:] = exact[:, :7] + (*engine.origin, 0, 0, 0, 0)
        engine.qvel[:], engine.act[:] = exact[:, 7:13], rotors
    worst: Errors = {name: dict.fromkeys(UNITS, 0.0) for name in ENGINES}
    for _ in range(CONTROL_STEPS):
        ends = rng.choice([-1.0, 1.0], (FLIGHTS, vehicle.rotor_count))
        command = vehicle.rotor_command(ends if bang else 0 * ends)
        exact = solved(vehicle, exact, command)
        attitude = attitude_of(exact[:, 3:7])
        for name, engine in engines.items():
            engine.ctrl[:] = command
            engine.advance(vehicle.substeps)
            errors = (
                np.linalg.norm(engine.qpos[:, :3] - engine.origin - exact[:, :3], axis=-1),
                (attitude_of(engine.qpos[:, 3:]).inv() * attitude).magnitude(),
                np.linalg.norm(engine.qvel[:, 3:] - exact[:, 10:13], axis=-1),
            )
            for unit, error in zip(UNITS, errors, strict=True):
                worst[name][unit] = max(worst[name][unit], float(error.max()))
    return worst


def solved(vehicle: Vehicle, motion: np.ndarray, command: np.ndarray) -> np.ndarray:
    """The exact motions (N, 13 + R) a control step later; columns as in `Motion`."""
    p, calm = parameters.Parameters.of(parameters.rows(vehicle, FLIGHTS)), np.zeros((FLIGHTS, 3))

    def rate(_: float, flat: np.ndarray) -> np.ndarray:
        now = Motion(*np.split(flat.reshape(motion.shape), (3, 7, 10, 13), axis=-1))
        change = dynamics.derivative(p, now, command, calm, -GRAVITY)
        return np.concatenate(list(vars(change).values()), axis=-1).ravel()

    span = (0.0, vehicle.control_timestep)
    solution = solve_ivp(rate, span, motion.ravel(), method="DOP853", rtol=1e-12, atol=1e-12)
    after = solution.y[:, -1].reshape(motion.shape)
    after[:, 3:7] /= np.linalg.norm(after[:, 3:7], axis=-1, keepdims=True)
    return after


def shown() -> str:
    """Tables of errors."""
    result, parts = report.load("step_size"), []
    columns = [(engine, unit) for engine in ENGINES for unit in UNITS]
    head = ("rate times dt", *(f"{e}: {k.partition('_')[0]} [{UNITS[k]}]" for e, k in columns))
    for name, title in TITLES.items():
        rows = (
            (row["product"], *(f"{row['errors'][e][k]:.1e}" for e, k in columns))
            for row in result["tables"][name]
        )
        parts += [f"{title}:", table(head, rows)]
    return "\n\n".join([*parts, report.source(result)])


PARTS: report.Parts = {"step-size": shown}

if __name__ == "__main__":
    tyro.cli(main)
