"""The libraries of a wheel that needs no compiler: rotor callbacks, free flight, steps of tasks.

`scripts/wheels` runs it once for each version of mujoco. The libraries are those that a cache would
hold (`quadrl.engines.native.compiling`), under the same names and with the same bits.
"""

from __future__ import annotations

import itertools
import re
import sys
import warnings
from collections.abc import Iterable
from pathlib import Path

from quadrl.aircraft.aerodynamics import GROUND_EFFECT, ROTOR_EFFECTS, STILL_AIR
from quadrl.aircraft.presets import VEHICLES
from quadrl.base.errors import NativeError, QuadrlWarning
from quadrl.control.autopilot import Reversed
from quadrl.control.modes import modes_of
from quadrl.core.environment import Environment
from quadrl.engines import adjoint
from quadrl.engines.native import compiling
from quadrl.engines.native.compiling import HERE, Target
from quadrl.tasks import TASKS

GLIBC = 28
"""Of the oldest glibc that mujoco's own wheels run with, 2.28: manylinux_2_28."""
MACOS = "11_0"
"""The oldest macOS that mujoco's own wheels run with."""
MAX_WAYPOINTS = 4
"""How many `static_waypoint` has at most, to fly without a compiler at full speed."""
AIRS = STILL_AIR, ROTOR_EFFECTS, GROUND_EFFECT
ROTORS = {vehicle.rotor_count: name for name, vehicle in VEHICLES.items()}
"""A vehicle for each number of rotors; the other numbers of one are constants of the C."""


def tag(machine: str) -> str:
    """The platform of a wheel for a kind of machine, as `platform.machine` names it."""
    if sys.platform == "darwin":
        return f"macosx_{MACOS}_{machine}"
    return f"manylinux_2_{GLIBC}_{machine}"


def steps(tasks: Iterable[str]) -> list[str]:
    """Write the C of the steps of tasks and of the loops of control modes.

    It covers all options of the tasks, for the vehicles and conditions that ship. The code, not
    only its constants, depends on the numbers of rotors and actions, on whether the observation is
    an estimate, on a weight being zero, and on the number of waypoints.
    """
    many = range(1, MAX_WAYPOINTS + 1)
    routes = [{"waypoints": [[1.0, 1.0, 0.5]] * count} for count in many]
    with compiling.noted() as found, warnings.catch_warnings():
        warnings.simplefilter("ignore", QuadrlWarning)
        flown = [(name, mode) for name in ROTORS.values() for mode in modes_of(VEHICLES[name])]
        for task, (vehicle, mode), randomization, weight in itertools.product(
            tasks, flown, ("none", "full"), (0.0, 0.1)
        ):
            for options in routes if task == "static_waypoint" else [{}]:
                environment = Environment(
                    task,
                    task_options={"smoothness_weight": weight} | options,
                    vehicle=vehicle,
                    control_mode=mode,
                    randomization=randomization,
                )
                environment.reset()
                found += environment.sources()
                if environment.autopilot:
                    back = Reversed(environment.control_mode, environment.engine)
                    found += (f.source for f in back.functions)
        return list(dict.fromkeys(found))


def fill(target: Target, tasks: Iterable[str] = TASKS, airs: Iterable[int] = AIRS) -> None:
    """Compile what a wheel brings, for the mujoco that is installed.

    Args:
        target: What it is for; what its folder holds already is not compiled again.
        tasks: Those whose steps it brings.
        airs: Kinds of air whose derivatives it brings, as `Aerodynamics.effects`.

    Raises:
        NativeError: A library would not run on all systems that the wheel is for.
    """
    sources = steps(tasks)  # first, since flights need libraries of this machine
    paths = [compiling.build(target=target)]
    paths += [compiling.build_generated(source, target) for source in sources]
    paths += [adjoint.build(*each, target) for each in itertools.product(airs, ROTORS)]
    for path in paths:
        versions = map(int, re.findall(rb"GLIBC_2\.(\d+)", path.read_bytes()))
        if (newest := max(versions, default=0)) > GLIBC:
            raise NativeError(f"{path} needs glibc 2.{newest}: must be at most 2.{GLIBC}")


if __name__ == "__main__":
    chosen, *other = sys.argv[1:]
    machine, compiler = other or (HERE.machine, HERE.compiler)
    folder = Path(chosen) / tag(machine)
    fill(Target(machine, compiler, folder))
    sys.stdout.write(f"{folder}\n")
