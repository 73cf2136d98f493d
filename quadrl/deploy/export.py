"""Export an aircraft or a policy: to MuJoCo alone, to ONNX, to torch."""

from __future__ import annotations

import dataclasses
import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.rotors import Rotor
from quadrl.aircraft.specification import FILE, resolve
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.docstrings import docstrings
from quadrl.base.errors import QuadrlError
from quadrl.base.extras import needed
from quadrl.base.files import free_name, write_whole
from quadrl.base.validation import choice
from quadrl.base.version import __version__
from quadrl.conditions.sensor import SYMBOLS, Sensor
from quadrl.core.environment import Environment
from quadrl.evaluation.controllers import comes_with_quadrl, policy_of
from quadrl.evaluation.policy import Policy, shipped
from quadrl.evaluation.policy_file import CLIP
from quadrl.learning.description import describe_observation
from quadrl.rendering.video import checked
from quadrl.tasks import TASKS

TARGETS = {
    "c": ("h", "quadrl.deploy.c"),
    "crazyflie": ("", "quadrl.deploy.crazyflie"),
    "hub": ("", "quadrl.deploy.hub"),
    "mjcf": ("xml", "quadrl.deploy.mjcf"),
    "px4": ("", "quadrl.deploy.px4"),
    "raptor": ("tar", "quadrl.deploy.raptor"),
    "onnx": ("onnx", "quadrl.deploy.onnx"),
    "torch": ("pt2", "quadrl.evaluation.module"),
}
"""By name: the ending of its file, empty for a folder, and the module that makes it."""


def export(what: Any, to: str, out: str | Path | None = None) -> Path:
    """Write an aircraft or a policy for programs without quadrl; `quadrl export` in Python.

    Args:
        what: A `Policy`, what `quadrl.train` returned, a run folder, a .safetensors file, or the
            name of a policy that comes with quadrl; for "mjcf" also a Vehicle, or its name.
        to: "mjcf" for the aircraft as a model of MuJoCo; "onnx", "torch", "c", "crazyflie",
            "px4", "raptor" or "hub" for the policy.
        out: The file, or the folder of "crazyflie", "px4" or "hub"; one that exists is overwritten.
            By default, in this folder, NAME.xml of an aircraft, NAME.onnx, .pt2, .h or .tar of a
            policy, or NAME_crazyflie; where that exists, NAME-2.xml and so on.

    Returns:
        The path of the file.

    Raises:
        QuadrlError: A name is unknown, there is no policy, or a library is missing.
        OSError: The file cannot be written.
    """
    ending, name = TARGETS[choice("to", to, TARGETS)]
    found = _found(what)
    if to == "mjcf":
        vehicle = found if isinstance(found, Vehicle) else found.scenario.vehicle
        stem, given = vehicle.name, (vehicle, __version__)
    elif isinstance(found, Policy):
        path = Path(what if isinstance(what, (str, Path)) else found.task).resolve()
        path = path.parent if path.name == "policy.safetensors" else path
        stem, given = path.name.removesuffix(".safetensors"), (found, described(found))
    else:
        reason = f"an aircraft has no network: give a policy for {to}"
        raise QuadrlError(reason, name="to", value=to, allowed=f"mjcf for {found.name}")
    with needed("quadrl.export"):
        module = importlib.import_module(name)
    if not ending:
        return _folder(Path(out or free_name(Path(f"{stem}_{to}"))), module.files(*given))
    path, _ = checked(out or free_name(Path(f"{stem}.{ending}")), (ending,))
    write_whole(path, module.content(*given))
    return path


def _folder(path: Path, files: Mapping[str, bytes]) -> Path:
    """Write files into a folder, by their paths in it."""
    for name, content in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        write_whole(path / name, content)
    return path


def _found(what: Any) -> Vehicle | Policy:
    """Find the aircraft or load the policy to export.

    Raises:
        QuadrlError: It is neither.
    """
    if isinstance(what, Vehicle):
        return what
    if isinstance(what, str) and (what in VEHICLES or what.endswith(FILE)):
        return resolve(what)
    found = getattr(what, "policy", what)  # of what `quadrl.train` returned
    if isinstance(found, str) and not (comes_with_quadrl(found) or Path(found).exists()):
        known = *VEHICLES, *TASKS, *(file.stem for file in shipped())
        choice("what", found, ("a run folder", "a .safetensors file", *known))
    if isinstance(found, (str, Path)):
        return policy_of(found)
    if not isinstance(found, Policy):
        raise QuadrlError(name="what", value=what, allowed="a policy or an aircraft")
    return found


def described(policy: Policy) -> dict[str, str]:
    """Describe what the numbers of a policy mean, each entry in JSON: enough to fly without quadrl.

    Returns:
        scenario, as `Scenario.of` takes it; observation, as `describe_observation` gives it;
        sensors: as `described_sensor` gives them, in the order in which they sense; symbols: what
        the letters of formulas mean; normalisation, which is part of the network; action: name,
        unit, meaning, value at 0, changes at 1 and at -1, least and largest value of each number;
        aircraft, as `described_aircraft` gives it; control_timestep [s]; quadrl: its version.

    Raises:
        QuadrlError: Its task is not known here, or does not fit it.
    """
    environment = Environment(scenario := policy.scenario, seed=0)
    policy.check_fits(environment)
    mode = environment.control_mode
    ends = mode.values(np.outer([-1.0, 1.0], np.ones(mode.size)))
    reach = np.transpose([mode.centre, mode.scale, -mode.scale_down, *ends]).tolist()
    names = "at_0", "change", "change_down", "least", "most"
    action = [
        dataclasses.asdict(term) | dict(zip(names, numbers, strict=True))
        for term, numbers in zip(mode.terms, reach, strict=True)
    ]
    sensors = environment.observer.senses.sensors if environment.observer else []
    whole = {
        "scenario": scenario.to_json(),
        "observation": describe_observation(environment),
        # What only the critic sees is left out.
        "sensors": [described_sensor(one) for one in sensors if one.name != "privileged"],
        "symbols": SYMBOLS,
        "normalisation": {
            "formula": "clip((observation - mean) / deviation, -clip, clip)",
            **{"clip": CLIP, "mean": policy.mean.tolist(), "deviation": policy.deviation.tolist()},
        },
        "action": action,
        "aircraft": described_aircraft(environment.vehicle),
        "control_timestep": environment.vehicle.control_timestep,
        "quadrl": __version__,
    }
    return {name: json.dumps(value) for name, value in whole.items()}


def described_aircraft(vehicle: Vehicle) -> dict[str, Any]:
    """Describe an aircraft as it is specified: all its numbers, and what a rotor's mean."""
    whole = dataclasses.asdict(vehicle)
    for rotor, speed in zip(whole["rotors"], vehicle.hover_speed.tolist(), strict=True):
        rotor["hover_speed"] = speed
    own = {"hover_speed": "Speed that carries the weight [rad/s]"}
    frame = "x forward, y left, z up, the origin at the centre of mass"
    return whole | {"units": "SI", "frame": frame, "meaning": docstrings(Rotor) | own}


def described_sensor(sensor: Sensor) -> dict[str, Any]:
    """Describe a sensor: its name, formula and options, and what these mean."""
    options, texts = dataclasses.asdict(sensor), docstrings(type(sensor))
    meaning = {name: texts.get(name, "") for name in options}
    return {"name": sensor.name, "formula": sensor.formula, **options, "meaning": meaning}
