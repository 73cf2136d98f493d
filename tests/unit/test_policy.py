"""The policy as numbers: what it computes, what it refuses to read, what it needs to fly."""

import dataclasses
import json

import gymnasium as gym
import numpy as np
import pytest
from helpers import needs_dm_control, refused
from policies import WIDTH, linear, make_policy, make_remembering, parts
from safetensors.numpy import save

import quadrl
from quadrl.aircraft.presets import VEHICLES
from quadrl.base.errors import QuadrlWarning
from quadrl.base.files import write_safetensors
from quadrl.core.environment import Environment
from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.evaluation.evaluate import setting
from quadrl.evaluation.policy import SHIPPED, Policy, shipped
from quadrl.evaluation.policy_file import FORMAT, RECURRENT_FORMAT
from quadrl.evaluation.rollout import fly

HEADER = {"format": FORMAT, "task": "hover", "metadata": {}}
RECURRENT_HEADER = HEADER | {"format": RECURRENT_FORMAT}


def write(path, arrays, header):
    """A safetensors file with any content."""
    write_safetensors(path, arrays, header, save)
    return path


def test_mean_action_by_hand():
    # Normalised: ((2-1)/2, (0-2)/4, (3-3)/1) = (0.5, -0.5, 0); hidden: tanh(0.5) = 0.46212,
    # -0.46212; means: 0.46212, -0.46212 + 0.5 = 0.03788, 0, 0; the log-variances are left out.
    expected = [0.46211716, 0.03788284, 0.0, 0.0]
    np.testing.assert_allclose(make_policy()(np.array([2.0, 0.0, 3.0])), expected, atol=1e-7)
    batch = make_policy()(np.tile([2.0, 0.0, 3.0], (5, 6, 1)))
    np.testing.assert_allclose(batch, np.tile(expected, (5, 6, 1)), atol=1e-7)


def test_actions_and_observations_are_clipped():
    # Normalised, both are far above 10 and clipped; tanh(10) = 1, so the fourth mean is 18.
    far = make_policy()(np.array([1e6, 1e6, 0.0]))
    np.testing.assert_array_equal(far, [1.0, 1.0, 1.0, 1.0])
    # One linear layer: 0.05 * (10 + 0 + 0) = 0.5 however far away the first entry is.
    one = make_policy(weights=(np.full((8, 3), 0.05, np.float32),), biases=(np.zeros(8, "f"),))
    np.testing.assert_allclose(one(np.array([1e6, 2.0, 3.0])), np.full(4, 0.5), rtol=1e-6)


def test_sampled_actions_are_normal_around_the_mean():
    # Log-variance -1: deviation exp(-0.5) = 0.6065; the second mean is 0.0379, the third 0.
    actions = make_policy().sampled(0)(np.tile([2.0, 0.0, 3.0], (20_000, 1)))
    assert np.abs(actions).max() == 1.0
    assert np.abs(np.median(actions[:, 1:3], axis=0) - [0.0379, 0.0]).max() < 0.02
    # 68.3 % of a normal distribution lie within one deviation, here inside the bounds.
    assert (np.abs(actions[:, 2]) < 0.6065).mean() == pytest.approx(0.683, abs=0.01)


@pytest.mark.parametrize("shape", [(2,), (4,), (3, 2), ()])
def test_an_observation_of_another_size_is_refused(shape):
    with refused(name="observation shape", value=shape):
        make_policy()(np.zeros(shape))


@pytest.mark.parametrize(
    ("policy", "settings", "name", "value", "needed"),
    [
        (linear(25, 4), {}, "observation size", 25, "22"),
        (linear(22, 6), {}, "action size", 6, "4"),
        # 22 numbers, 4 of them rotor speeds; the hexacopter has two more of those.
        (linear(22, 4), {"vehicle": "hexa"}, "observation size", 22, "24"),
        (linear(24, 4), {"vehicle": "hexa"}, "action size", 4, "6"),
        (linear(24, 6, control_mode="velocity"), {"vehicle": "hexa"}, "action size", 6, "4"),
        # As many rotors, but turned by 45 degrees.
        (linear(22, 4, vehicle="paper"), {"vehicle": "racer"}, "vehicle", "racer", "one with"),
    ],
)
def test_a_policy_for_another_layout_is_refused(policy, settings, name, value, needed):
    with refused(value=value) as caught:
        fly(policy, "hover", episodes=1, **settings)
    assert caught.value.name.startswith(name) and caught.value.allowed.startswith(f"{needed} ")


@pytest.mark.parametrize("policy", [make_policy(), make_remembering(seed=3, algo="ppo")], ids=repr)
def test_saved_and_loaded_it_is_the_same(policy, tmp_path):
    policy.save(tmp_path / "policy.safetensors")
    for path in (tmp_path, tmp_path / "policy.safetensors", str(tmp_path)):
        loaded = quadrl.Policy.load(path)
        assert (loaded.task, loaded.metadata) == (policy.task, policy.metadata)
        for name, array in parts(policy).items():
            np.testing.assert_array_equal(parts(loaded)[name], array)
    assert [p.name for p in tmp_path.iterdir()] == ["policy.safetensors"]


def test_the_same_policy_is_the_same_file(tmp_path):
    # Ten times: with several entries in its table, safetensors shuffles them.
    contents = set()
    for k in range(10):
        make_policy().save(tmp_path / f"{k}.safetensors")
        contents.add((tmp_path / f"{k}.safetensors").read_bytes())
    assert len(contents) == 1


ARRAYS, RECURRENT = parts(make_policy()), parts(make_remembering())


@pytest.mark.parametrize(
    "content",
    [
        None,
        save({"weight": np.zeros((2, 2), np.float32)}),
        save(ARRAYS, metadata={"quadrl": json.dumps(HEADER | {"format": "9"})}),
    ],
)
def test_what_is_no_policy_is_refused(tmp_path, content):
    path = tmp_path / "policy.safetensors"
    if content is not None:
        path.write_bytes(content)
    with refused(match=str(path)):
        Policy.load(tmp_path)


@pytest.mark.parametrize(
    ("arrays", "header"),
    [
        (ARRAYS, {"task": 3}),
        (ARRAYS, {"metadata": []}),
        (ARRAYS, {"metadata": {"task_options": "time_limit=5"}}),
        (RECURRENT, {"format": "quadrl-policy-2"}),  # without a memory
        (RECURRENT, {"format": "quadrl-policy-gru-9"}),
    ],
)
def test_a_header_that_does_not_say_what_it_is_is_refused(tmp_path, arrays, header):
    with refused():
        Policy.load(write(tmp_path / "p.safetensors", arrays, HEADER | header))


def replaced(**changes):
    return lambda arrays: arrays | {k: np.asarray(v, np.float32) for k, v in changes.items()}


def without(name):
    return lambda arrays: {key: value for key, value in arrays.items() if key != name}


ALONE = [
    *(without("mean"), without("weight_0"), without("bias_1"), lambda arrays: {}),
    replaced(weight_9=np.zeros((2, 2))),
    replaced(weight_0=np.zeros((2, 4))),
    replaced(bias_0=np.zeros((2, 1))),
    replaced(mean=np.zeros(4)),
    replaced(deviation=[1, 0, 1]),
    replaced(deviation=[1, np.inf, 1]),
    replaced(weight_1=np.full((8, 2), np.nan)),
    replaced(weight_1=np.full((8, 2), 3e38)),  # sums that single precision does not hold
    lambda arrays: arrays | {"weight_1": np.zeros((7, 2), "f"), "bias_1": np.zeros(7, "f")},
    lambda arrays: arrays | {"mean": np.zeros(3)},  # double precision
]
WITH_MEMORY = [
    lambda own: {k: v for k, v in own.items() if not k.startswith("memory")},
    replaced(memory_input_weight=np.zeros((3 * WIDTH, 21))),
    replaced(memory_state_weight=np.zeros((3 * WIDTH, WIDTH + 1))),
    replaced(memory_state_bias=np.zeros((3 * WIDTH, 1))),
    replaced(memory_input_weight=np.full((3 * WIDTH, 22), 3e37)),  # times the clip
    replaced(weight_0=np.zeros((8, 22))),  # without what is remembered
    lambda own: own | {"memory_input_bias": np.zeros(3 * WIDTH)},  # double precision
    replaced(
        **{f"memory_{kind}": np.zeros((0, 22)) for kind in ("input_weight", "state_weight")},
        **{f"memory_{kind}": np.zeros(0) for kind in ("input_bias", "state_bias")},
        weight_0=np.zeros((8, 22)),
    ),
]


@pytest.mark.parametrize(
    ("own", "header", "change"),
    [(ARRAYS, HEADER, change) for change in ALONE]
    + [(RECURRENT, RECURRENT_HEADER, change) for change in WITH_MEMORY],
)
def test_arrays_that_make_no_network_are_refused(tmp_path, own, header, change):
    path = write(tmp_path / "policy.safetensors", own, header)
    Policy.load(path)
    with refused():
        Policy.load(write(path, change(own), header))


def test_what_ships_is_found_by_its_task_and_by_its_own_name():
    for algo, file in (("ppo", "ppo"), ("gae", "gae"), ("vpg", "gae")):
        policy = Policy.pretrained("static_waypoint", algo)
        loaded = Policy.load(SHIPPED / f"static_waypoint_{file}.safetensors")
        for part, array in parts(loaded).items():
            np.testing.assert_array_equal(parts(policy)[part], array)
    for name, task in (("hover", "hover"), ("hover_robust", "hover"), ("landing_gae", "landing")):
        assert setting(name)[2].task.name == task


@pytest.mark.parametrize(("task", "algo"), [("hovr", "ppo"), ("hover", "sac"), ("../hover", "ppo")])
def test_a_policy_that_does_not_ship(task, algo):
    with refused(name="pretrained policy", value=f"{task}_{algo}") as caught:
        Policy.pretrained(task, algo)
    assert all(file.stem in caught.value.allowed for file in shipped())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hover_robust", "straight_and_level_robust"])
def test_a_robust_policy_flies_its_own_aircraft_or_says_which(name):
    policy = Policy.pretrained(name)
    plain = Environment(policy.task, observe=policy.conditions["observe"])
    with refused("action_scale", 35.0, lists="90", match="keywords"):
        policy.check_fits(plain)
    for flown in (policy, policy.flying(4)):
        with refused("action_scale", 35.0):
            fly(flown, policy.task, episodes=4, vehicle=VEHICLES["paper"])
        with refused("action_scale", 35.0):
            quadrl.evaluate(policy, episodes=4, vehicle=VEHICLES["paper"])
    for given in ({}, {"vehicle": "paper"}):  # the name stands for the aircraft of the training
        found = quadrl.evaluate(policy, episodes=20, randomization="none", weather="calm", **given)
        assert found.metrics["success_rate"] == 1.0 and found.vehicle.action_scale == 90.0
    calm = {"randomization": "none", "weather": "calm", "episodes": 20}
    assert fly(policy, policy.task, **calm).is_success.all()


def test_its_keywords_make_what_it_fits_in_every_api():
    policy = Policy.pretrained("hover", variant="robust")
    single = gym.make("quadrl/Hover-v0", **policy.keywords)
    many = QuadrotorEnv("hover", num_envs=3, seed=0, **policy.keywords)
    for environment in (single.unwrapped.environment, many.environment):
        policy.check_fits(environment)
    observation, info = single.reset(seed=0)
    for _ in range(200):
        observation, _, terminated, truncated, info = single.step(policy(observation))
    assert truncated and not terminated and info["is_success"]


def test_its_keywords_make_what_it_fits_in_dm_control():
    needs_dm_control()
    policy = Policy.pretrained("hover", variant="robust")
    classic = quadrl.load("hover", task_kwargs={"random": 0, **policy.keywords})
    policy.check_fits(classic.task.environment)


def test_an_environment_with_other_numbers_than_in_the_training_is_told(monkeypatch):
    policy, paper = Policy.pretrained("hover"), VEHICLES["paper"]
    monkeypatch.setitem(VEHICLES, "paper", dataclasses.replace(paper, mass=0.7))
    with pytest.warns(QuadrlWarning, match="paper of this policy has mass = 0.65; .* 0.7; here"):
        policy.check_fits(Environment("hover"))
    with pytest.warns(QuadrlWarning, match="mass = 0.65; paper is now 0.7; flown: as recorded"):
        found = quadrl.evaluate("hover", episodes=1)
    assert found.vehicle == paper
    with pytest.warns(QuadrlWarning, match="flown: as recorded"):
        assert policy.keywords["vehicle"] == paper
    assert quadrl.evaluate("hover", episodes=1, vehicle_options={"mass": 0.6}).vehicle.mass == 0.6


def test_another_time_between_two_actions_than_in_training_is_warned_of():
    with pytest.warns(QuadrlWarning, match="= 0.02: the policy for hover was trained with 0.05"):
        quadrl.evaluate("hover", episodes=1, control_timestep=0.02)
