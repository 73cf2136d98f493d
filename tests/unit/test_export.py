"""What leaves quadrl flies without it: MuJoCo's own actuators, ONNX and torch."""

import dataclasses
import functools
import json
import re
import sys
from pathlib import Path

import helpers
import mujoco
import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from policies import linear, make_remembering
from processes import python

import quadrl
from quadrl import cli
from quadrl.aircraft.presets import VEHICLES
from quadrl.control.modes import modes_of
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.deploy.export import described, export
from quadrl.engines.mjcf import compile_model
from quadrl.evaluation.policy import Policy, shipped
from quadrl.evaluation.rollout import fly

LAYOUTS = pytest.mark.parametrize("vehicle", helpers.LAYOUTS.values(), ids=helpers.LAYOUTS)
# A run of its own, where neither quadrl nor its callbacks are.
ALONE = """
import sys, mujoco
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("hover").id)
for _ in range(round(1 / model.opt.timestep)):
    mujoco.mj_step(model, data)
print(abs(data.qpos - model.key("hover").qpos).max(), *(m for m in sys.modules if m == "quadrl"))
"""


@functools.cache
def models(vehicle) -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """What an aircraft is written as, read from its file, and the lean model of quadrl's engine."""
    written = mujoco.MjModel.from_xml_path(str(export(vehicle, "mjcf")))
    return written, compile_model(vehicle, drawn=False)


def hovering(vehicle) -> tuple[mujoco.MjData, mujoco.MjData]:
    """The same hover in both."""
    written, own = models(vehicle)
    data, true = mujoco.MjData(written), mujoco.MjData(own)
    mujoco.mj_resetDataKeyframe(written, data, written.key("hover").id)
    true.qpos[:], true.act[:] = (0, 0, 1, 1, 0, 0, 0), vehicle.hover_speed
    return data, true


# ------------------------------------------------------------------------------------ MuJoCo alone


def test_it_hovers_where_quadrl_is_not(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "there").mkdir()
    path = export("crazyflie", "mjcf", tmp_path / "there" / "small.xml")
    assert path.stat().st_size < 20_000 and [*path.parent.iterdir()] == [path]
    assert float(python("-c", ALONE, path, cwd=tmp_path / "elsewhere").stdout) < 1e-3


@LAYOUTS
def test_the_forces_are_those_of_quadrl(vehicle):
    """Weight, thrust, torque, drag and moment in any motion and wind; the file has six digits."""
    (model, reference), (data, true) = models(vehicle), hovering(vehicle)
    motion = helpers.random_motion(vehicle, 20, speed=8.0, turn=5.0, wind=5.0, rotor=0.3)
    for k in range(20):
        data.qpos[3:] = true.qpos[3:] = motion.quaternion[k]
        data.qvel[:] = true.qvel[:] = (*motion.velocity[k], *motion.body_rate[k])
        true.act[:] = motion.rotor_speed[k]
        data.act[:] = (motion.rotor_speed[k] / vehicle.max_speed) ** 2
        model.opt.wind[:] = true.userdata[:3] = motion.wind[k]
        mujoco.mj_forward(model, data)
        mujoco.mj_forward(reference, true)
        largest = np.abs(true.qacc[:3]).max(), np.abs(true.qacc[3:]).max()
        scale = np.repeat(largest, 3)
        np.testing.assert_allclose(data.qacc / scale, true.qacc / scale, atol=2e-4)
    model.opt.wind[:] = 0


@LAYOUTS
@pytest.mark.parametrize("change", [0.01, -0.01])
def test_rotors_follow_a_command_near_hover_as_fast(vehicle, change):
    """The square of the speed changes by 2 Omega times the change of the speed."""
    (model, reference), (data, true) = models(vehicle), hovering(vehicle)
    command = vehicle.hover_speed * (1 + change)
    data.ctrl[:], true.ctrl[:] = (command / vehicle.max_speed) ** 2, command
    mujoco.mj_forward(model, data)
    mujoco.mj_forward(reference, true)
    expected = 2 * vehicle.hover_speed * true.act_dot / vehicle.max_speed**2
    np.testing.assert_allclose(data.act_dot, expected, rtol=0.006)  # half of the change


@LAYOUTS
def test_it_stands_on_the_ground(vehicle):
    model, height = models(vehicle)[0], vehicle.ground_clearance
    data = mujoco.MjData(model)
    for _ in range(round(1 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qpos[:3], (0, 0, height), atol=0.02 * height)
    assert data.ncon >= 4


@pytest.mark.parametrize("what", ["hexa", "hover_robust"])
def test_the_numbers_of_its_actions_are_in_it(what):
    model = mujoco.MjModel.from_xml_path(str(export(what, "mjcf")))
    robust = Policy.pretrained("hover", variant="robust").scenario.aircraft
    vehicle = VEHICLES.get(what, robust)
    for name in ("hover_speed", "max_speed", "action_scale", "control_timestep"):
        np.testing.assert_allclose(model.numeric(name).data, getattr(vehicle, name), rtol=1e-5)


def test_mjx_takes_it():
    jax, mjx = pytest.importorskip("jax"), pytest.importorskip("mujoco.mjx")
    vehicle = VEHICLES["crazyflie"]
    model, (data, _) = models(vehicle)[0], hovering(vehicle)
    step, put = jax.jit(mjx.step), (mjx.put_model(model), mjx.put_data(model, data))
    for _ in range(10):
        put = put[0], step(*put)
    np.testing.assert_allclose(put[1].qpos, data.qpos, atol=1e-4)


# ---------------------------------------------------------------------------------- ONNX and torch

POLICIES = [
    Policy.pretrained("hover"),
    Policy.pretrained("hover", variant="robust"),  # sees its last actions and a disturbance
    linear(24, 6, vehicle="hexa"),
    make_remembering(vehicle="crazyflie"),
    make_remembering(alone=True),
]
policies = pytest.mark.parametrize("k", range(len(POLICIES)), ids=lambda k: repr(POLICIES[k]))


@functools.cache
def seen(k: int) -> np.ndarray:
    """Observations (n, size) of a policy: drawn ones and, of a trained one, clipped and flown ones.

    The weights of the others are drawn, and so large that clipped observations make sums whose last
    digit is more than 1e-6.
    """
    policy, kept = POLICIES[k], []

    def act(observation):
        kept.append(observation.astype(np.float32))
        return policy(observation)

    drawn = np.random.default_rng(0).normal(policy.mean, policy.deviation, (1000, policy.size))
    if "algo" in policy.metadata:
        drawn[:50] *= 100
        fly(act, policy.scenario, episodes=5, seed=0)
    return np.concatenate([*kept, drawn]).astype(np.float32)


def states(policy: Policy, count: int) -> np.ndarray:
    """What a policy with a memory may remember, (count, state_size)."""
    shape = (count, policy.state_size)
    return np.random.default_rng(1).uniform(-1, 1, shape).astype(np.float32)


@pytest.mark.slow
@policies
def test_onnx_acts_as_the_policy(k):
    policy, path = POLICIES[k], export(POLICIES[k], "onnx")
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    observation, shapes = seen(k), {"observation": ["batch", policy.size]}
    given, memory = {"observation": observation}, states(policy, len(observation))
    if policy.memory:
        shapes["state"], given["state"] = ["batch", policy.state_size], memory
    assert {entry.name: entry.shape for entry in session.get_inputs()} == shapes
    found = dict(
        zip([e.name for e in session.get_outputs()], session.run(None, given), strict=True)
    )
    action, state = policy.step(observation, memory)
    np.testing.assert_allclose(found.pop("action"), action, rtol=0, atol=1e-6)
    assert [*found] == ["next_state"] * bool(policy.memory)
    for array in found.values():
        np.testing.assert_allclose(array, state, rtol=0, atol=1e-6)
    one = {name: array[:1] for name, array in given.items()}
    np.testing.assert_allclose(session.run(["action"], one)[0], action[:1], rtol=0, atol=1e-6)


@policies
def test_torch_acts_as_the_policy(k):
    policy, observation = POLICIES[k], seen(k)
    before = torch.get_rng_state()
    module = policy.to_torch()
    assert torch.equal(torch.get_rng_state(), before)
    memory = states(policy, len(observation))
    with torch.no_grad():
        found = module(*map(torch.from_numpy, (observation, memory)[: 1 + bool(policy.memory)]))
    expected = policy.step(observation, memory)
    # Torch adds up the products of a layer in another order, each sum rounded to 1.2e-7 of it.
    rounding = 32 * np.finfo(np.float32).eps
    for array, tensor in zip(expected, found if policy.memory else [found], strict=False):
        np.testing.assert_allclose(tensor, array, rtol=0, atol=rounding)


def test_a_module_has_its_own_numbers_which_can_be_trained():
    policy = Policy.pretrained("hover")
    module, observation = policy.to_torch(), torch.zeros(1, policy.size)
    before = policy(observation.numpy())
    module(observation).sum().backward()
    with torch.no_grad():
        for parameter in module.parameters():
            assert parameter.grad is not None
            parameter.add_(1.0)
    np.testing.assert_array_equal(policy(observation.numpy()), before)


def test_the_file_says_what_its_numbers_are():
    policy = Policy.pretrained("hover", variant="robust")
    model = onnx.load(export(policy, "onnx"))
    said = {entry.key: json.loads(entry.value) for entry in model.metadata_props}
    assert Scenario.of(said["scenario"]) == policy.scenario
    assert said["control_timestep"] == 0.05 and said["quadrl"] == quadrl.__version__
    terms = {term["name"]: term for term in said["observation"]}
    assert [*terms][-2:] == ["aim", "action_history"]
    assert terms["velocity"] == {
        "name": "velocity", "first": 6, "last": 8, "unit": "m/s", "meaning": "body frame",
        "formula": "R^T v",
    }  # fmt: skip
    assert terms["action_history"]["last"] == policy.size - 1
    hover = policy.scenario.aircraft.hover_speed
    for number, speed in zip(said["action"], hover, strict=True):
        assert (number["unit"], number["at_0"]) == ("rad/s", speed)
        assert (number["change"], number["change_down"]) == (90.0, -90.0)


def said_by(path: Path) -> dict:
    """The metadata of an ONNX file, read by nothing of quadrl."""
    return {entry.key: json.loads(entry.value) for entry in onnx.load(path).metadata_props}


def commanded(said: dict, action: np.ndarray) -> np.ndarray:
    """Commands (n, k) of actions, as the metadata say."""
    names = "at_0", "change", "change_down", "least", "most"
    zero, up, down, least, most = (np.array([one[k] for one in said["action"]]) for k in names)
    return np.clip(zero + np.where(action > 0, up, -down) * action, least, most)


@pytest.mark.parametrize(
    ("mode", "vehicle"),
    [(mode, name) for name in ("racer", "hexa") for mode in modes_of(VEHICLES[name])],
)
def test_an_action_is_the_command_that_the_file_says(mode, vehicle):
    environment = Environment("hover", vehicle=vehicle, control_mode=mode, seed=0)
    size = environment.size, environment.action_size
    policy = linear(*size, vehicle=vehicle, control_mode=mode)
    said = said_by(export(policy, "onnx"))
    action = np.random.default_rng(0).uniform(-1, 1, (50, environment.action_size))
    action = np.concatenate([action, np.sign(action)])
    expected = environment.control_mode.values(action)
    if mode == "share_of_x":  # each number names the rotor that it commands
        expected = expected[
            :, [int(one["name"].removeprefix("rotor_")) - 1 for one in said["action"]]
        ]
    np.testing.assert_allclose(commanded(said, action), expected, rtol=1e-12, atol=1e-12)


def test_a_flight_by_the_metadata_alone_is_quadrls():
    policy = Policy.pretrained("race")
    paths = {to: export(policy, to) for to in ("onnx", "torch", "mjcf")}
    said, extra = said_by(paths["onnx"]), {"action": "", "aircraft": ""}
    torch.export.load(paths["torch"], extra_files=extra)
    assert all(json.loads(text) == said[name] for name, text in extra.items())
    model = mujoco.MjModel.from_xml_path(str(paths["mjcf"]))
    names = "hover_speed", "action_scale", "least_command", "most_command"
    hover, scale, least, most = (model.numeric(name).data for name in names)
    session = onnxruntime.InferenceSession(paths["onnx"])
    environment = Environment(policy.scenario, seed=0)
    observation, over, at_ends = environment.reset(), False, 0
    while not over:
        given = {"observation": environment.flatten(observation)}
        action = session.run(["action"], given)[0]
        done = environment.step(action)
        observation, flown = done.observation, environment.snapshot.rotor_command
        np.testing.assert_allclose(commanded(said, action), flown, rtol=1e-6)
        by_model = np.clip(hover + scale * action, least, most)
        np.testing.assert_allclose(by_model, flown, rtol=1e-4)  # the file has six digits
        at_ends += (flown <= 1e-9).any() + (flown >= 0.999999 * most).any()
        over = (done.terminated | done.truncated).item()
    assert done.is_success.all() and at_ends > 10  # it is flown to the limits of the rotors


@LAYOUTS
def test_rotors_stand_and_turn_as_the_files_say(vehicle):
    """By the numbers of a file the aircraft hovers: it is carried, and nothing turns it."""
    model, data = models(vehicle)[0], {}
    policy = linear(14 + 4 + vehicle.rotor_count, vehicle.rotor_count, vehicle=vehicle)
    aircraft = json.loads(described(policy)["aircraft"])
    assert "x forward, y left, z up" in aircraft["frame"]
    assert "counter-clockwise" in aircraft["meaning"]["spin"]
    for name in aircraft["rotors"][0]:
        data[name] = np.array([rotor[name] for rotor in aircraft["rotors"]])
    for name in ("position", "axis", "spin"):
        shape = data[name].shape
        written = model.numeric(f"rotor_{name}").data.reshape(shape)
        np.testing.assert_allclose(written, data[name], rtol=1e-5, atol=1e-9)
    squares = data["hover_speed"][:, None] ** 2
    pull = data["thrust_coefficient"][:, None] * squares * data["axis"]
    reaction = (data["spin"] * data["torque_coefficient"])[:, None] * squares * data["axis"]
    moment = np.cross(data["position"], pull) - reaction
    weight = aircraft["mass"] * 9.81
    assert pull[:, 2].sum() == pytest.approx(weight, rel=1e-9)
    np.testing.assert_allclose(moment.sum(axis=0), 0, atol=1e-9 * weight)
    # MuJoCo's actuators agree on which way each one turns.
    turns = np.sign(model.actuator_gear[:, 5] * model.actuator_gear[:, 2])
    np.testing.assert_array_equal(turns, -data["spin"])


@pytest.mark.slow
@pytest.mark.parametrize("name", [file.stem for file in shipped()])
def test_every_term_of_a_shipped_policy_has_its_formula(name):
    said = {k: json.loads(text) for k, text in described(Policy.pretrained(name)).items()}
    assert all(term["formula"] for term in (*said["observation"], *said["sensors"]))
    assert len(said["normalisation"]["mean"]) == 1 + said["observation"][-1]["last"]
    sensors = {sensor["name"]: sensor for sensor in said["sensors"]}
    assert "privileged" not in sensors
    senses = "robust", "raptor", "hover_any", "navigation", "all_ppo"
    assert bool(sensors) == any(word in name for word in senses)
    if name == "navigation_robust":
        assert sensors["range_finder"]["rate"] == 15 and sensors["range_finder"]["share"] == 0.02
    elif "robust" in name:  # constants stand beside the formulas that have them, defaults too
        for sensor, constants in (
            ("aim", ("gain", "near", "most")),
            ("disturbance", ("smoothing",)),
            ("rotor_speed", ("source", "delay", "rate")),
            ("action_history", ("length",)),
        ):
            assert {*constants} <= sensors[sensor].keys()
        assert sensors["aim"]["gain"] == 0.5 and sensors["disturbance"]["smoothing"] == 0.02


@functools.cache
def on_the_page(name: str):
    """A class of the page for those who fly without quadrl."""
    text = (Path(__file__).parents[2] / "docs" / "fly_alone.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (code,) = [block for block in blocks if f"class {name}" in block]
    exec(code, found := {})
    return found[name]


PLACES = [file.stem for file in shipped() if "robust" in file.stem]
PLACES.remove("navigation_robust")  # of rays and velocities, which the class does not know


@pytest.mark.slow
@pytest.mark.parametrize("name", PLACES)
def test_a_robust_policy_flies_by_its_file_alone(name):
    """With late commands and estimates, noise, wind, and other numbers than those specified."""
    policy = Policy.pretrained(name)
    late = {"command_delay": (0.02, 0.02), "observation_delay": (0.02, 0.02)}
    drawn = dataclasses.replace(policy.scenario.randomization, **late, rate_delay=(0.01, 0.01))
    environment = Environment(policy.scenario, seed=0, randomization=drawn)
    alone = on_the_page("Robust")(export(name, "onnx"))
    observation, steps, over = environment.reset(), 0, False
    while not over:
        state, vector = environment.observer.estimate, np.hstack([*observation.values()])
        target = environment.task.target_velocity(environment.snapshot)
        rotation, offset = state.rotation[0], state.rotation[0] @ observation["goal"][0]
        motion = np.array(state.velocity[0]), np.array(state.body_rate[0])
        command = alone(rotation, *motion, offset, 0.0 if target is None else target[0])
        np.testing.assert_allclose(alone.seen, vector[0], rtol=0, atol=1e-6)
        acts = policy(environment.flatten(observation))
        asked = environment.control_mode.values(acts)[0]
        done = environment.step(alone.acted[None])
        for own in (asked, environment.snapshot.rotor_command[0]):
            np.testing.assert_allclose(command, own, rtol=1e-6)
        observation, over = done.observation, (done.terminated | done.truncated).item()
        steps += 1
    assert steps > 20


def test_the_same_policy_is_the_same_file():
    contents = {export("hover", "onnx", f"{k}.onnx").read_bytes() for k in range(3)}
    assert len(contents) == 1


# -------------------------------------------------------------------------- names, files, refusals


def test_files_have_names_of_their_own_unless_they_are_given():
    assert export("hexa", "mjcf").name == "hexa.xml"
    assert export("hexa", "mjcf").name == "hexa-2.xml"
    assert export(Policy.pretrained("hover"), "onnx").name == "hover.onnx"
    for name in ("hover_robust", "hover_gae", "hover"):  # of the task is one already
        kept = "hover-2.onnx" if name == "hover" else f"{name}.onnx"
        assert export(name, "onnx").name == kept
    kept = export("hexa", "mjcf", "hexa.xml")
    assert kept.name == "hexa.xml" and "paper" not in kept.read_text()
    assert "The aircraft paper" in export("paper", "mjcf", "hexa.xml").read_text()


def test_the_command_says_what_it_wrote(capsys, tmp_path):
    cli.main(["export", "hover", "--to", "onnx", "--out", "flown.onnx"])
    assert capsys.readouterr().out == "wrote flown.onnx\n"
    assert [path.name for path in tmp_path.iterdir()] == ["flown.onnx"]


def test_a_run_is_exported_by_its_folder(tmp_path):
    (tmp_path / "run").mkdir()
    make_remembering().save(tmp_path / "run" / "policy.safetensors")
    assert export(tmp_path / "run", "onnx").name == "run.onnx"
    assert export(tmp_path / "run" / "policy.safetensors", "onnx").name == "run-2.onnx"
    (tmp_path / "run" / "policy.safetensors").rename("best one.safetensors")
    assert export("best one.safetensors", "onnx").name == "best one.onnx"


@pytest.mark.parametrize(
    ("what", "to", "out", "said"),
    [
        ("hover", "onx", None, "did you mean onnx?"),
        ("crazyfly", "mjcf", None, "did you mean crazyflie?"),
        ("hover_robst", "onnx", None, "did you mean hover_robust?"),
        ("crazyflie", "onnx", None, "an aircraft has no network: give a policy for onnx"),
        (VEHICLES["hexa"], "torch", None, "must be mjcf for hexa"),
        ("geometric", "onnx", None, "must be one of a run folder"),
        (len, "onnx", None, "a policy or an aircraft"),
        (".", "onnx", None, "there is no policy at 'policy.safetensors'"),
        ("hover", "onnx", "hover.xml", "the name of a file ending in .onnx"),
        ("hexa", "mjcf", ".", "the name of a file ending in .xml"),
    ],
)
def test_what_cannot_be_exported_is_said_in_a_line(what, to, out, said, tmp_path):
    with helpers.refused() as caught:
        export(what, to, out)
    assert said in str(caught.value)
    assert not [*tmp_path.iterdir()]


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "quadrl.deploy.onnx", raising=False)
    monkeypatch.setitem(sys.modules, "onnx", None)
    with helpers.refused() as caught:
        export("hover", "onnx")
    said = "quadrl.export needs onnx: python -m pip install 'quadrl[export]'"
    assert str(caught.value) == said and isinstance(caught.value, ImportError)


def test_an_aircraft_needs_neither_torch_nor_onnx():
    code = "import sys, quadrl; quadrl.export('paper', 'mjcf'); "
    code += "print({'torch', 'onnx'} & {*sys.modules})"
    assert python("-c", code).stdout == "set()\n"
