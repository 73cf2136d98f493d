"""A policy as a controller of the Crazyflie's firmware, in a folder that its build takes.

The firmware's own PID controller flies wherever the policy may not.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from string import Template

import numpy as np

from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.deploy import c
from quadrl.deploy.single import number, numbers
from quadrl.evaluation.policy import Policy

TEMPLATES = Path(__file__).with_name("templates") / "crazyflie"
MOTORS = (1, -1), (-1, -1), (-1, 1), (1, 1)
"""Where motors 1 to 4 are: signs of x, forward, and y, left; 1 and 3 turn counter-clockwise."""
DEAD_MAN, STALE = 500, 500  # [ms]
TILT, FAR = 60, 1.5  # [degrees], [m]
REACH = 0.5  # [m]: a setpoint farther off is approached as one there
HELD = {
    "level, at the setpoint": (0.0, (1.0, 0.0, 0.0, 0.0)),
    "20 cm below it": (-0.2, (1.0, 0.0, 0.0, 0.0)),
    "right side down by 10 degrees": (0.0, (0.99619, 0.08716, 0.0, 0.0)),
    "nose down by 10 degrees": (0.0, (0.99619, 0.0, 0.08716, 0.0)),
    "nose to the left by 20 degrees": (0.0, (0.98481, 0.0, 0.0, 0.17365)),
}
"""Height [m] and quaternion in which a hand holds the aircraft."""
FILES = {
    "Makefile": """CRAZYFLIE_BASE ?= ../crazyflie-firmware
OOT_CONFIG := $(PWD)/app-config
EXTRA_CFLAGS += -ffp-contract=off
include $(CRAZYFLIE_BASE)/tools/make/oot.mk
""",
    "Kbuild": "obj-y += src/\n",
    "src/Kbuild": "obj-y += controller.o\n",
}
CONFIG = """CONFIG_APP_ENABLE=y
CONFIG_APP_PRIORITY=1
CONFIG_APP_STACKSIZE=350
CONFIG_CONTROLLER_OOT=y
"""
COMPENSATION = "CONFIG_ENABLE_THRUST_BAT_COMPENSATED"
BY_THRUST = """#ifndef CONFIG_ENABLE_THRUST_BAT_COMPENSATED
#error "the firmware must compensate the battery: CONFIG_ENABLE_THRUST_BAT_COMPENSATED=y"
#endif
// The share of the largest thrust that a rotor speed [rad/s] gives; the firmware knows the battery.
static float asked(float speed) {{ return {thrust} * speed * speed / THRUST_MAX; }}
"""
BY_MAP = """#ifdef CONFIG_ENABLE_THRUST_BAT_COMPENSATED
#error "commands are made for each voltage here: CONFIG_ENABLE_THRUST_BAT_COMPENSATED must be off"
#endif
// The share of the largest PWM that brings a rotor speed [rad/s] at the battery's voltage.
static float asked(float speed) {{
  return (speed - {offset}) / ({gain} + {volts} * pmGetBatteryVoltage());
}}
"""


def files(policy: Policy, metadata: Mapping[str, str]) -> dict[str, bytes]:
    """The files of the folder by their paths.

    Args:
        policy: The policy.
        metadata: As `quadrl.deploy.export.described` gives it.

    Raises:
        QuadrlError: The policy needs what a Crazyflie has not, or flies another kind of aircraft.
    """
    header = c.Header(policy)
    environment, name = header.environment, header.name
    vehicle = environment.vehicle
    header.check_holds_a_place()
    header.check_speeds("a Crazyflie")
    ticks = vehicle.control_timestep * 1e3
    if abs(ticks - round(ticks)) > 1e-6:
        allowed = "in whole milliseconds, as the firmware's loop"
        raise QuadrlError(name="control_timestep", value=vehicle.control_timestep, allowed=allowed)
    order = motors(vehicle)
    speeds = ", ".join(f"command[{k}]" for k in order)
    places = dict(zip(("first", "second", "third", "fourth"), order, strict=True))
    if mapped := vehicle.command_map:
        line = mapped.offset, mapped.gain, mapped.gain_by_volt
        given = dict(zip(("offset", "gain", "volts"), map(number, line), strict=True))
        checks, switch = BY_MAP.format(**given), "# {} is not set"
        meaning = f"Rotor speed of a PWM u: {mapped}. It was identified from logs of an aircraft."
    else:
        thrust = float(np.mean([rotor.thrust_coefficient for rotor in vehicle.rotors]))
        checks, switch = BY_THRUST.format(thrust=number(thrust)), "{}=y"
        meaning = (
            f"A rotor speed is turned into thrust, {thrust:.3g} N s^2 times its square, which the "
            "firmware brings by its own table of the motors. `quadrl identify` finds the speeds of "
            "your own motors from a log; a policy trained on its file has them in here."
        )
    given = {
        "name": name,
        "upper": name.upper(),
        "version": json.loads(metadata["quadrl"]),
        "vehicle": vehicle.name,
        "checks": checks,
        "speeds": speeds,
        "ticks": round(ticks),
        "dead_man": DEAD_MAN,
        "stale": STALE,
        "tilt": TILT,
        "upright": number(math.cos(math.radians(TILT))),
        "far": FAR,
        "reach": f"{REACH}f",
        "hovering": numbers(vehicle.hover_speed),
        "held": "\n".join(
            f"| {name} | {' | '.join(f'{x:.0f}' for x in found[order])} |"
            for name, found in held(header).items()
        ),
        "cost": header.cost.said(),
        "meaning": meaning,
    } | places
    made = {
        path: Template((TEMPLATES / source).read_text()).substitute(given).encode()
        for path, source in (
            ("src/controller.c", "controller.c.in"),
            ("README.md", "README.md.in"),
        )
    }
    fixed = FILES | {"app-config": f"{CONFIG}{switch.format(COMPENSATION)}\n"}
    texts = {path: text.encode() for path, text in fixed.items()}
    return made | texts | {"src/policy.h": c.written(header, metadata)}


def held(header: c.Header) -> dict[str, np.ndarray]:
    """Rotor speeds (R,) [rad/s] that a policy asks for after a second in each pose of HELD."""
    vehicle, found = header.environment.vehicle, dict[str, np.ndarray]()
    for name, (height, quaternion) in HELD.items():
        motion = np.array([0, 0, height, *quaternion, *6 * (0.0,), *vehicle.hover_speed])
        motions = np.tile(motion.astype(np.float32), (round(1 / vehicle.control_timestep), 1))
        *_, (_, _, found[name]) = header.flown(motions)
    return found


def motors(vehicle: Vehicle) -> list[int]:
    """The rotors that are motors 1 to 4 of a Crazyflie, in this order.

    Raises:
        QuadrlError: The aircraft is no Crazyflie: another number, place or spin of its rotors.
    """
    x, y = (np.array([rotor.position[k] for rotor in vehicle.rotors]) for k in (0, 1))
    found = [np.flatnonzero((x * a > 1e-3) & (y * b > 1e-3)) for a, b in MOTORS]
    spins = [vehicle.rotors[k[0]].spin for k in found if len(k)]
    if len(x) != 4 or [*map(len, found)] != [1, 1, 1, 1] or spins != [1.0, -1.0, 1.0, -1.0]:
        allowed = (
            "a Crazyflie: four rotors at the corners, of which the front right and the back left "
            "one turn counter-clockwise"
        )
        raise QuadrlError(name="vehicle", value=vehicle.name, allowed=allowed)
    return [int(k[0]) for k in found]
