"""The file for PX4's mc_raptor: its layout, what each number means, and what it refuses."""

import io
import tarfile

import numpy as np
import pytest
from helpers import refused
from policies import make_raptor
from scipy.spatial.transform import Rotation

import quadrl
from quadrl.base.errors import QuadrlError
from quadrl.core.environment import Environment
from quadrl.core.scenario import UNDISTURBED
from quadrl.deploy.export import export
from quadrl.evaluation.memory import GRU
from quadrl.evaluation.policy import Policy

SHAPES = {
    "layers/0/weights": (16, 22),
    "layers/0/biases": (16,),
    "layers/1/weights_input": (48, 16),
    "layers/1/biases_input": (48,),
    "layers/1/weights_hidden": (48, 16),
    "layers/1/biases_hidden": (48,),
    "layers/1/initial_hidden_state": (16,),
    "layers/2/weights": (4, 16),
    "layers/2/biases": (4,),
}
# From east, north, up to the frames of PX4: the policy's x, along its heading, is PX4's first axis.
TURNED = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
FRONT_RIGHT, BACK_RIGHT, BACK_LEFT, FRONT_LEFT = (1, -1), (-1, -1), (-1, 1), (1, 1)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    path = export(make_raptor(), "raptor", tmp_path_factory.mktemp("raptor") / "policy.tar")
    return files_in(path.read_bytes())


def files_in(content):
    with tarfile.open(fileobj=io.BytesIO(content)) as tar:
        return {x.name: tar.extractfile(x).read() for x in tar.getmembers()}


def said(files, name):
    return dict(x.split(": ", 1) for x in files[f"{name}/meta"].decode().splitlines())


def array(files, name):
    about = said(files, name)
    shape = [int(about[f"dim_{k}"]) for k in range(int(about["num_dims"]))]
    return np.frombuffer(files[f"{name}/data"], "<f4").reshape(shape)


def network(files, seen, state):
    """Actions (n, 4), unclipped, and the next state, by the equations of RLtools' layers."""
    own = {k: array(files, f"actor/{k}/parameters").astype(float) for k in SHAPES}
    weights = {k.partition("/")[2]: v for k, v in own.items()}
    x = np.maximum(seen @ weights["0/weights"].T + weights["0/biases"], 0)
    new = np.split(x @ weights["1/weights_input"].T + weights["1/biases_input"], 3, axis=1)
    old = np.split(state @ weights["1/weights_hidden"].T + weights["1/biases_hidden"], 3, axis=1)
    reset, update = (1 / (1 + np.exp(-a - b)) for a, b in zip(new[:2], old[:2], strict=True))
    state = update * state + (1 - update) * np.tanh(new[2] + reset * old[2])
    return state @ weights["2/weights"].T + weights["2/biases"], state


def observed(state, last):
    """What mc_raptor makes of PX4's topics (n, 22), with the goal at the origin and no yaw of it.

    Args:
        state: True state of aircraft.
        last: Their last actions as the module has them, (n, 4).
    """
    own = Rotation.from_quat(np.asarray(state.quaternion), scalar_first=True)
    down, ahead = TURNED.apply(state.position), TURNED * own * TURNED.inv()
    falls, turns = TURNED.apply(state.velocity), TURNED.apply(state.body_rate)
    w, x, y, z = ahead.as_quat(scalar_first=True).T
    level = Rotation.from_quat(np.stack([w, x, -y, -z], -1), scalar_first=True)
    place, speed, rate = (np.stack([a, -b, -c], -1) for a, b, c in (down.T, falls.T, turns.T))
    clipped = place.clip(-0.5, 0.5), speed.clip(-1, 1)
    matrix = level.as_matrix().reshape(-1, 9)
    return np.concatenate([clipped[0], matrix, clipped[1], rate, last], axis=1)


def motors(vehicle):
    """The rotors that are motors 1 to 4 of a Crazyflie, by where they are."""
    at = [tuple(np.sign(rotor.position[:2])) for rotor in vehicle.rotors]
    return [at.index(corner) for corner in (FRONT_RIGHT, BACK_RIGHT, BACK_LEFT, FRONT_LEFT)]


# ------------------------------------------------------------------------------------- layout


def test_the_tar_has_every_array_where_the_module_looks(files):
    for name, shape in SHAPES.items():
        about = said(files, f"actor/{name}/parameters")
        assert (about["type"], about["dtype"]) == ("tensor", "float32")
        assert array(files, f"actor/{name}/parameters").shape == shape
    numbers = sum(int(np.prod(shape)) for shape in SHAPES.values())
    assert numbers == 2084
    assert said(files, "actor")["checkpoint_name"].endswith("hover_raptor, racer")
    types = [said(files, f"actor/layers/{k}") for k in range(3)]
    assert types[0] == {"activation_function": "RELU", "type": "dense"}
    assert types[1] == {"type": "gru"}
    assert types[2] == {"activation_function": "IDENTITY", "type": "dense"}
    # The reader has room for so much of each, and steps through the example by these sizes.
    assert len(files["actor/meta"]) <= 256 and max(map(len, files)) < 100
    assert all(len(x) < 100 for name, x in files.items() if name.endswith("parameters/meta"))
    assert array(files, "example/input").shape[1:] == (2, 22)
    assert array(files, "example/output").shape[1:] == (2, 4)
    assert len(array(files, "example/input")) >= 5


def test_the_example_is_what_the_network_answers(files):
    """The module takes 1e-5 for its test, over all numbers."""
    seen, asked = array(files, "example/input"), array(files, "example/output")
    state = np.zeros((2, 16))
    for now, expected in zip(seen, asked, strict=True):
        found, state = network(files, now, state)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)
    assert np.ptp(asked, axis=0).min() > 1e-3


# ------------------------------------------------------------------------------- what it means

DIRECTIONS = [
    *(("position", k, far) for k in range(3) for far in (0.3, -0.3, 0.7, -0.7)),
    *(("velocity", k, far) for k in range(3) for far in (0.8, -0.8, 1.5, -1.5)),
    *(("body_rate", k, far) for k in range(3) for far in (2.0, -25.0)),
    *(("turned", k, far) for k in range(3) for far in (0.4, -1.1)),
]


def test_each_input_and_each_motor_is_that_of_px4(files):
    """Moved along each axis, also past the clips, turned, and after an action of each rotor."""
    made = make_raptor()
    count = len(DIRECTIONS)
    start = {k: np.zeros((count, 3)) for k in ("position", "velocity", "body_rate")}
    turned = np.zeros((count, 3))
    for row, (name, axis, far) in enumerate(DIRECTIONS):
        (turned if name == "turned" else start[name])[row, axis] = far
    way = Rotation.from_rotvec([0.2, -0.1, 0.6]) * Rotation.from_rotvec(turned)
    start["quaternion"] = way.as_quat(scalar_first=True)
    environment = Environment(made.scenario, num_envs=count, seed=0, **UNDISTURBED)
    order, last = motors(environment.vehicle), np.zeros((count, 4))
    seen = environment.flatten(environment.reset(start=start))
    own, state = made.initial_state(count), np.zeros((count, 16))
    rng = np.random.default_rng(1)
    for _ in range(2):
        action, own = made.step(seen, own)
        found, state = network(files, observed(environment.snapshot.state, last), state)
        np.testing.assert_allclose(found.clip(-1, 1), action[:, order], rtol=0, atol=1e-5)
        command = rng.uniform(-1, 1, (count, 4))
        seen = environment.flatten(environment.step(command).observation)
        last = command[:, order]
        # The share of the largest speed is that of the control of PX4's motor.
        share = environment.snapshot.rotor_command / environment.vehicle.max_speed
        np.testing.assert_allclose(share, (command + 1) / 2, rtol=0, atol=1e-12)


def test_flights_by_the_tar_are_those_of_the_policy(files):
    made = make_raptor()
    environment = Environment(made.scenario, num_envs=3, seed=5, **UNDISTURBED)
    order, last = motors(environment.vehicle), np.zeros((3, 4))
    seen, own = environment.flatten(environment.reset()), made.initial_state(3)
    state = np.zeros((3, 16))
    for _ in range(60):
        action, own = made.step(seen, own)
        found, state = network(files, observed(environment.snapshot.state, last), state)
        np.testing.assert_allclose(found.clip(-1, 1), action[:, order], rtol=0, atol=1e-5)
        seen, last = environment.flatten(environment.step(action).observation), action[:, order]


@pytest.mark.slow
def test_training_makes_the_shape_that_is_exported(tmp_path):
    settings = {"steps": 1024, "num_envs": 16, "rollout": 8, "evaluations": 0, "episodes": 1}
    run = quadrl.train("hover", variant="raptor", out=tmp_path / "run", **settings)
    found = files_in(export(run, "raptor", tmp_path / "x.tar").read_bytes())
    assert all(array(found, f"actor/{k}/parameters").shape == x for k, x in SHAPES.items())
    scenario = run.policy.scenario
    assert scenario.control_mode == "share" and scenario.vehicle.control_timestep == 0.01


# ------------------------------------------------------------------------------------ refusals


def narrower():
    zeros, few = np.zeros((48, 22), np.float32), np.zeros((9, 22), np.float32)
    unit = GRU(zeros[:, :9], zeros[:, :16], zeros[:, 0], zeros[:, 0], few, few[:, 0])
    return make_raptor(memory=unit)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Policy.pretrained("hover"), ("control_mode = 'rotor'", "must be share")),
        (
            lambda: make_raptor(vehicle_options={"control_timestep": 0.02}),
            ("control_timestep = 0.02", "must be 0.01"),
        ),
        (
            lambda: make_raptor(observe={"sensors": {"offset": {"near": 1.0}}}),
            ("clips of offset = (1.0, 1.0)", "0.5 m and 1.0 m/s"),
        ),
        (narrower, ("layers = [22, 9, 16, 4]", "22 inputs, 16 neurons, a memory of 16, 4 actions")),
    ],
)
def test_another_shape_is_refused_in_a_line_that_says_how_to_train_one(make, words, tmp_path):
    with pytest.raises(QuadrlError) as caught:
        export(make(), "raptor", tmp_path / "policy.tar")
    assert all(word in str(caught.value) for word in words), caught.value
    assert "quadrl train hover --variant raptor" in str(caught.value)
    assert "\n" not in str(caught.value) and not [*tmp_path.iterdir()]


def test_an_aircraft_with_other_motors_is_refused(tmp_path):
    plus = make_raptor(vehicle="paper", randomization="none")
    with refused("vehicle", "paper", lists="four rotors at the corners"):
        export(plus, "raptor", tmp_path / "policy.tar")
    assert not [*tmp_path.iterdir()]
