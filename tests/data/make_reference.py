"""Writes exact.npz beside this file: flights integrated exactly by tests/reference.py.

    python tests/data/make_reference.py [NAME...]

tests/data/README.md says what is in it. Needed anew only for other flights; the slow tests compare
a part of it with a fresh integration.
"""

import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
if __name__ == "__main__":
    sys.path[:0] = [str(HERE.parent), str(HERE.parents[1])]

import extreme  # noqa: E402
import helpers  # noqa: E402
import reference  # noqa: E402

FLIGHTS = {name: (vehicle, 50, 3.0) for name, vehicle in helpers.LAYOUTS.items()}
"""Vehicle, number of flights, and largest wind in each direction [m/s]."""
NEW = {"crazyflie_brushless": 8, "cf21B_500": 9}
SEEDS = {name: seed for seed, name in enumerate(sorted(FLIGHTS.keys() - NEW))} | NEW
"""Those of new names are given, so that the others keep theirs."""
AIRCRAFT = 12


def random_flights(vehicle, count, wind, seed):
    """Starts x (n, 13 + R) in the paper's terms, commands (n, R) and winds (n, 3)."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    moving = rng.uniform(-2, 2, (count, 6))
    speed, command = rng.uniform(0.66, 1.33, (2, count, vehicle.rotor_count)) * vehicle.hover_speed
    command = np.minimum(command, vehicle.max_speed)
    start = np.concatenate([rng.uniform(-1, 1, (count, 3)), q, moving, speed], axis=-1)
    return {"start": start, "command": command, "wind": rng.uniform(-wind, wind, (count, 3))}


def seconds(vehicle):
    """Length of a flight: 1 s of the paper's aircraft."""
    return 20 * vehicle.control_timestep


def flights(name):
    """Arrays of the flights of a name, with their ends."""
    vehicle, count, wind = FLIGHTS[name]
    part = random_flights(vehicle, count, wind, seed=SEEDS[name])
    end = reference.fly(vehicle, part["start"], part["command"], seconds(vehicle), part["wind"])
    return part | {"end": end}


def extreme_flights(vehicle):
    """States after each control step (steps, 8, 13 + R) of the extreme flights of an aircraft."""
    state, calm, states = extreme.starts(vehicle), np.zeros((extreme.ROWS, 3)), []
    for command in vehicle.rotor_command(extreme.actions(vehicle, extreme.CONTROL_STEPS)):
        state = reference.fly(vehicle, state, command, vehicle.control_timestep, calm)
        states.append(state)
    return np.array(states)


def main(*names):
    if names:  # these layouts alone
        arrays = dict(np.load(HERE / "exact.npz"))
        arrays |= {f"{name}/{k}": array for name in names for k, array in flights(name).items()}
        np.savez_compressed(HERE / "exact.npz", **arrays)
        return
    arrays = {f"{name}/{k}": array for name in FLIGHTS for k, array in flights(name).items()}
    for k, vehicle in enumerate(extreme.vehicles(AIRCRAFT)):
        arrays[f"extreme/{k}"] = extreme_flights(vehicle)
    np.savez_compressed(HERE / "exact.npz", **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])
