"""A policy as the file that PX4's mc_raptor reads from the SD card: a tar of named arrays.

The module (PX4 1.18, src/modules/mc_raptor) has the shape of the network compiled in and makes what
it reads, in this order: position and velocity less those of the setpoint, in a frame with x along
the setpoint's heading, y left, z up, clipped; between them the rotation from the body to it, row by
row; the body rate, ahead, left, up; the last action. Motors are in the order of a Crazyflie, which
the module puts into PX4's. Layout: RLtools, include/rl_tools/persist/backends/tar.
"""

from __future__ import annotations

import io
import json
import tarfile
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlError, QuadrlWarning
from quadrl.core.environment import Environment
from quadrl.core.scenario import UNDISTURBED
from quadrl.deploy import c
from quadrl.deploy.crazyflie import motors
from quadrl.evaluation.policy import Policy

NEAR, SLOW, TIMESTEP = 0.5, 1.0, 0.01  # [m], [m/s], [s]
SEES = {"offset": 6, "rotation": 9, "body_rate": 3, "action_history": 4}
NETWORK = "22 inputs, 16 neurons, a memory of 16, 4 actions"
STEPS, FLIGHTS = 100, 2
"""Of the example inside, with which the module tests what it has read: 5 steps of 2 flights."""
OBSERVATION = (
    "Position.OrientationRotationMatrix.LinearVelocity.AngularVelocityDelayed(0).ActionHistory(1)"
)


def content(policy: Policy, metadata: Mapping[str, str]) -> bytes:
    """The file of a policy.

    Args:
        policy: The policy.
        metadata: As `quadrl.deploy.export.described` gives it.

    Raises:
        QuadrlError: The policy has another shape, or its aircraft other motors.
    """
    environment = Environment(policy.scenario, seed=0, **UNDISTURBED)
    _check(policy, environment)
    header, vehicle = c.Header(policy), environment.vehicle
    header.check_holds_a_place()
    if mapped := vehicle.command_map:
        said = f"mc_raptor gives each motor the share of its largest speed, but {vehicle.name} has"
        warnings.warn(f"{said} {mapped}", QuadrlWarning, stacklevel=3)
    entries = arrays(policy, environment)
    seen, asked = example(policy, environment)
    said = {"name": "l2f", "observation": OBSERVATION}
    name = f"quadrl {json.loads(metadata['quadrl'])}, {header.name}, {vehicle.name}"
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        actor = {"checkpoint_name": name[:80], "type": "sequential"}
        _add(tar, "actor/meta", _lines(**actor, meta=json.dumps({"environment": said})))
        for layer, activation in (("0", "RELU"), ("1", ""), ("2", "IDENTITY")):
            own = {"activation_function": activation, "type": "dense"} if activation else {}
            _add(tar, f"actor/layers/{layer}/meta", _lines(**(own or {"type": "gru"})))
        named = {f"actor/layers/{key}/parameters": array for key, array in entries.items()}
        for key, array in (named | {"example/input": seen, "example/output": asked}).items():
            sizes = {f"dim_{k}": size for k, size in enumerate(array.shape)}
            kind = {"type": "tensor", "dtype": "float32", "num_dims": array.ndim}
            _add(tar, f"{key}/meta", _lines(**kind, **sizes))
            _add(tar, f"{key}/data", array.astype("<f4").tobytes())
    return file.getvalue()


def arrays(policy: Policy, environment: Environment) -> dict[str, np.ndarray]:
    """The numbers of the network by layer and name, inputs and motors as the module has them."""
    unit, ((weight, bias),) = policy.memory, policy.mean_layers
    assert unit is not None and unit.first_weight is not None and unit.first_bias is not None
    columns, order = _columns(environment), motors(environment.vehicle)
    first = unit.first_weight / policy.deviation
    return {
        "0/weights": first[:, columns],
        "0/biases": unit.first_bias - first @ policy.mean,
        "1/weights_input": unit.input_weight,
        "1/biases_input": unit.input_bias,
        "1/weights_hidden": unit.state_weight,
        "1/biases_hidden": unit.state_bias,
        "1/initial_hidden_state": policy.initial_state(),
        "2/weights": weight[order],
        "2/biases": bias[order],
    }


def example(policy: Policy, environment: Environment) -> tuple[np.ndarray, np.ndarray]:
    """What the policy sees and answers, unclipped, (STEPS, FLIGHTS, 22 and 4), in flights of it."""
    flown = Environment(environment.scenario, num_envs=FLIGHTS, seed=0)
    seen, state = flown.flatten(flown.reset()), policy.initial_state(FLIGHTS)
    ((weight, bias),) = policy.mean_layers
    inputs, outputs = list[np.ndarray](), list[np.ndarray]()
    for _ in range(STEPS):
        action, state = policy.step(seen, state)
        inputs.append(seen[:, _columns(flown)])
        outputs.append((state @ weight.T + bias)[:, motors(flown.vehicle)])
        seen = flown.flatten(flown.step(action).observation)
    return np.array(inputs), np.array(outputs)


def _columns(environment: Environment) -> list[int]:
    """Which number of the observation each input of the module is."""
    offset, *others = ([*range(x.start, x.stop)] for x in map(environment.layout.get, SEES) if x)
    rotation, rate, actions = others
    own = [actions[k] for k in motors(environment.vehicle)]
    return [*offset[:3], *rotation, *offset[3:], *rate, *own]


def _check(policy: Policy, environment: Environment) -> None:
    """Refuse another shape.

    Raises:
        QuadrlError: It says what differs.
    """
    unit, seen = policy.memory, {k: x.stop - x.start for k, x in environment.layout.items()}
    network: list[Any] = [policy.size, *(len(bias) for _, bias in policy.mean_layers)]
    if unit and unit.first_bias is not None:
        network[1:1] = unit.first_bias.size, unit.width
    clips: Any = None
    if "offset" in seen and environment.observer:
        sensor: Any = environment.observer.senses.channels["offset"].sensor
        clips = sensor.near, sensor.slow
    for name, value, needed, allowed in (
        ("control_mode", policy.control_mode, "share", "share"),
        ("control_timestep", environment.vehicle.control_timestep, TIMESTEP, f"{TIMESTEP}"),
        ("observation", seen, SEES, ", ".join(SEES)),
        ("clips of offset", clips, (NEAR, SLOW), f"{NEAR} m and {SLOW} m/s"),
        ("layers", network, [22, 16, 16, 4], NETWORK),
    ):
        if value != needed:
            reason = "mc_raptor flies one shape of policy; quadrl train hover --variant raptor "
            raise QuadrlError(f"{reason}trains it", name=name, value=value, allowed=allowed)


def _lines(**said: Any) -> bytes:
    return "".join(f"{name}: {value}\n" for name, value in said.items()).encode()


def _add(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    entry = tarfile.TarInfo(name)
    entry.size = len(content)
    tar.addfile(entry, io.BytesIO(content))
