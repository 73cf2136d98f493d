"""Environments of every API are pickled and copied, and the copies go on bit for bit."""

import copy
import pickle

import cloudpickle
import numpy as np
import pytest
from apis import APIS
from helpers import needs_dm_control

import quadrl
from quadrl.testing import varied_actions

WAYS = {
    "pickle": lambda thing: pickle.loads(pickle.dumps(thing)),
    "cloudpickle": lambda thing: pickle.loads(cloudpickle.dumps(thing)),
    "deepcopy": copy.deepcopy,
}
SEEN = {"observation_history": 2, "rotor_speed": "estimated", "airspeed": True, "disturbance": True}
LATE = {
    "airspeed": {"noise": 0.3, "bias": 0.2, "delay": 0.1, "rate": 10},
    "state": {"rate": 10, "delay": 0.05},
}
SETTINGS = {
    "alone": {},
    "randomized": {"randomization": "full", "observe": SEEN},
    "free flight": {"engine": "free_flight", "randomization": {"command_delay": (0.0, 0.1)}},
    "lost": {"randomization": {"command_loss": 4.0, "command_jitter": 0.5}},
    "dead time": {"engine": "free_flight", "vehicle": "crazyflie", "time_limit": 0.12},
    "loops": {"control_mode": "velocity", "vehicle": "crazyflie", "task": "target_following"},
    "contact": {"task": "landing", "start_height": 0.05},
    "solids": {"task": "race", "vehicle": "racer", "time_limit": 0.3},
    "in the air": {"aerodynamics": "full", "weather": "light"},
    "sensors": {"observe": {"sensors": LATE, "action_history": 1}},
}


def assert_same(one, other):
    assert one.keys() == other.keys()
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name], err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
@pytest.mark.parametrize("api", APIS, ids=lambda api: api.__name__)
def test_a_copy_goes_on_bit_for_bit(api, settings):
    settings = {"time_limit": 0.3} | settings  # six steps
    copied, untouched = (api(seed=4, **settings) for _ in range(2))
    size = untouched.core.action_size
    actions = varied_actions(14, 4, size)[:, 2 : 2 + api.rows]
    # Before the first reset, after a reset, in the middle of an episode, and in a later one.
    ways = {"before": "pickle", 0: "deepcopy", 3: "pickle", 10: "cloudpickle"}
    others = [WAYS[ways["before"]](copied)]
    for t, action in enumerate(actions):
        if t % 7 == 0:
            met = untouched.copied(untouched.reset())
            for flown in (*others, copied):
                assert_same(flown.copied(flown.reset()), met)
        if t in ways:
            others.append(WAYS[ways[t]](copied))
        given = untouched.copied(untouched.step(action))
        for flown in (*others, copied):
            assert_same(flown.copied(flown.step(action)), given)
    assert len(others) == 4


def test_a_copied_physics_of_dm_control_is_drawn_and_measured_as_the_other():
    needs_dm_control()
    environment = quadrl.load("hover", {"random": 0})
    environment.reset()
    environment.step(np.full(4, 0.3))
    other = copy.deepcopy(environment)
    for name in ("xpos", "geom_xpos", "qpos", "sensordata"):
        one, same = (getattr(env.physics.data, name) for env in (environment, other))
        np.testing.assert_array_equal(one, same)
    assert other.task.environment.engine.data is other.physics.data.ptr
