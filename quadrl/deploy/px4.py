"""What a module of PX4 needs of a policy: frames, motors, parameters. A skeleton."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from string import Template

from quadrl.deploy import c
from quadrl.deploy.single import number, numbers
from quadrl.evaluation.policy import Policy

TEMPLATES = Path(__file__).with_name("templates") / "px4"


def files(policy: Policy, metadata: Mapping[str, str]) -> dict[str, bytes]:
    """The files of the folder by their paths.

    Args:
        policy: The policy.
        metadata: As `quadrl.deploy.export.described` gives it.

    Raises:
        QuadrlError: The policy needs what PX4 does not know.
    """
    header = c.Header(policy)
    vehicle, name = header.environment.vehicle, header.name
    header.check_holds_a_place()
    header.check_speeds("PX4")
    mapped, most = vehicle.command_map, max(rotor.max_speed for rotor in vehicle.rotors)
    if mapped:
        line = map(number, (mapped.offset, mapped.gain, mapped.gain_by_volt))
        control = "(speed[k] - {}) / ({} + {} * volts)".format(*line)
        meaning = f"Rotor speed of a control u: {mapped}. It was identified from logs."
    else:
        control = f"speed[k] / {number(most)}"
        meaning = (
            "A rotor's speed is taken to be in proportion to its control, which is hardly true: "
            "`quadrl identify` finds what the controls of your motors mean, from a log."
        )
    action = json.loads(metadata["action"])
    rows, parameters = list[str](), ["CA_AIRFRAME 0", f"CA_ROTOR_COUNT {vehicle.rotor_count}"]
    for k, rotor in enumerate(vehicle.rotors):
        x, y, z = rotor.position
        way = "counter-clockwise" if rotor.spin > 0 else "clockwise"
        rows.append(f"| {k + 1} | {x:.4g} | {-y:.4g} | {way} |")
        ratio = rotor.spin * rotor.torque_coefficient / rotor.thrust_coefficient
        own = {"PX": x, "PY": -y, "PZ": -z, "KM": ratio}
        own["CT"] = rotor.thrust_coefficient * rotor.max_speed**2
        parameters += [f"CA_ROTOR{k}_{key} {value + 0.0:.6g}" for key, value in own.items()]
    given = {
        "name": name,
        "upper": name.upper(),
        "version": json.loads(metadata["quadrl"]),
        "vehicle": vehicle.name,
        "hovering": numbers(vehicle.hover_speed),
        "rotors": vehicle.rotor_count,
        "control": control,
        "battery": " at the battery's voltage" if mapped and mapped.gain_by_volt else "",
        "timestep": f"{vehicle.control_timestep:g}",
        "least": f"{min(one['least'] for one in action):.0f}",
        "most": f"{max(one['most'] for one in action):.0f}",
        "hover": f"{vehicle.hover_speed.mean():.0f}",
        "motors": "\n".join(rows),
        "meaning": meaning,
        "cost": header.cost.said(),
    }
    texts = {
        path: Template((TEMPLATES / f"{path}.in").read_text()).substitute(given)
        for path in ("px4.h", "README.md")
    } | {"parameters.txt": "".join(f"param set-default {one}\n" for one in parameters)}
    made = {path: text.encode() for path, text in texts.items()}
    return made | {"policy.h": c.written(header, metadata)}
