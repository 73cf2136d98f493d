"""Sensors: a registry of them, each with its own noise, bias, delay and rate; and one's own."""

import dataclasses

import helpers
import numpy as np
import pytest
from test_observing import ACTIONS, seen

from quadrl.aircraft.rotors import GRAVITY
from quadrl.base.rotation import to_body, to_world
from quadrl.conditions import sensors
from quadrl.conditions.sensors import Sensor, felt, register_sensor
from quadrl.core.environment import Environment
from quadrl.deploy.export import described_sensor
from quadrl.learning.description import describe_observation
from quadrl.tasks.hover import Hover

NORTH = np.array([0.0, 1.0, 0.0])


@register_sensor
class Compass(Sensor):
    """Direction of a pole, body frame."""

    compiled = True
    name, size, unit = "compass", 3, "1"
    formula = "strength R^T (0, 1, 0)"

    strength: float = 1.0

    def sense(self, now):
        """Of a unit field, or of another strength."""
        return self.strength * to_body(
            now.true.rotation, np.broadcast_to(NORTH, (len(now.wind), 3))
        )


@register_sensor
class Pole(Compass):
    """Another compass."""

    name = "pole"


@register_sensor
class Odometer(Sensor):
    """Way that was flown."""

    name, unit = "odometer", "m"

    def begin(self, now):
        """From here on."""
        return {"way": np.zeros((len(now.wind), 1)), "last": np.array(now.true.position)}

    def update(self, now):
        """Add the last stretch."""
        position = np.array(now.true.position)
        stretch = np.linalg.norm(position - now.memory["last"], axis=1, keepdims=True)
        return {"way": now.memory["way"] + stretch, "last": position}

    def sense(self, now):
        """What has added up."""
        return now.memory["way"]


@dataclasses.dataclass(frozen=True)
class Northwards(Hover):
    """Rewards a heading that the compass shows."""

    sensors = {"compass": {"rate": 10.0}}

    def reward(self, before, now, end):
        """As hover, and the change of what the compass shows ahead."""
        turned = now.sensed["compass"][..., 0] - before.sensed["compass"][..., 0]
        return super().reward(before, now, end) | {"north": turned}


WILD = {
    "sensors": {
        "compass": {"noise": 0.1, "bias": 0.2, "delay": 0.1, "rate": 10},
        "odometer": {"delay": 0.1},
        "airspeed": {"noise": 0.3},
        "state": {"rate": 10, "delay": 0.1},
    }
}
WILD |= {"disturbance": True, "action_history": 2, "observation_history": 1}


@pytest.mark.parametrize(
    ("name", "entry"),
    [
        ("state", "velocity"),
        ("estimate", "velocity"),
        ("rotor_speed", "rotor_speed"),
        ("airspeed", "airspeed"),
        ("privileged", "privileged"),
    ],
)
def test_samples_are_held_and_as_late_as_the_sensor_says(name, entry):
    # A step is 0.05 s: every fourth gives a sample, which is seen two steps later.
    late = {"sensors": {name: {"delay": 0.1, "rate": 5}}}
    environments = [
        Environment("hover", num_envs=3, seed=1, observe=observe)
        for observe in (late, {"airspeed": True, "privileged": True})
    ]
    found, true = shown = [], []

    def look(step, rows=slice(None)):
        for environment, log in zip(environments, shown, strict=True):
            seen = step(environment)
            if entry == "privileged":
                seen = {entry: environment.privileged[rows]}
            log.append(np.array(seen[entry]))

    look(Environment.reset)
    for t, action in enumerate(ACTIONS):
        look(lambda one, action=action: one.step(action).observation)
        if t == 4:  # an episode of its own, whose samples count from its start
            look(lambda one: one.reset(np.array([1])), [1])
            for log in shown:
                fresh = log.pop()
                log[-1][1] = fresh[0]
    for row, start in ((0, 0), (1, 5), (2, 0)):
        for t in range(len(ACTIONS) + 1 - start):
            sample = start + max(0, (t - 2) // 4 * 4)
            np.testing.assert_array_equal(found[start + t][row], true[sample][row])


@dataclasses.dataclass(frozen=True)
class Aware(Hover):
    """Asks for sensors that show nothing of their own to a task, and for one that does."""

    sensors = {"state": {"rate": 10.0}, "rotor_speed": {}, "airspeed": {}}

    def reward(self, before, now, end):
        """As hover, and the airspeed."""
        return super().reward(before, now, end) | {"air": now.sensed["airspeed"][..., 0]}


def test_a_task_may_ask_for_any_sensor_but_looks_at_none_that_shows_nothing_to_it(monkeypatch):
    environment = helpers.begun(Aware(), num_envs=2, seed=1)
    assert {"rotor_speed", "airspeed"} <= helpers.idle(environment).observation.keys()
    peep = lambda self, before, now, end: {"hidden": now.sensed["rotor_speed"][..., 0]}  # noqa: E731
    monkeypatch.setattr(Aware, "reward", peep)
    with pytest.raises(KeyError, match="rotor_speed"):
        Environment(Aware(), num_envs=2, seed=1)


def test_the_aim_moves_on_by_short_offsets_and_no_further_than_it_may():
    options = {"gain": 2.0, "near": 0.5, "most": 0.15}
    environment = helpers.begun("hover", 2, observe={"sensors": {"aim": options}})
    assert not {"goal", "position"} & environment.observer.senses.terms.keys()
    east = np.array([1, 0, 0, 1]) / np.sqrt(2)  # x of the body is north
    environment.reset(
        start={"position": np.array([[-0.1, 0, 0], [-0.6, 0, 0]]), "quaternion": east}
    )
    summed = np.zeros((2, 3))
    for _ in range(30):
        seen = helpers.idle(environment).observation["aim"]
        state = environment.engine.state
        offset = to_world(state.rotation, environment.task.observe(environment.snapshot)["goal"])
        summed += np.where(np.linalg.norm(offset, axis=1, keepdims=True) < 0.5, 0.1 * offset, 0)
        summed = np.clip(summed, -0.15, 0.15)
        np.testing.assert_allclose(seen, to_body(state.rotation, offset + summed), atol=1e-12)
    assert summed[0, 0] == 0.15 and not summed[1].any()  # near, and a long way off
    start = environment.reset(np.array([0]))["aim"]  # a new episode sums up anew
    np.testing.assert_array_equal(start, environment.task.observe(environment.snapshot)["goal"][:1])
    both = helpers.begun("hover", 2, observe={"sensors": {"aim": {"beside_goal": True}}})
    assert {"goal", "aim"} <= both.reset().keys() and "position" not in both.observer.senses.terms


def test_noise_is_new_in_each_sample_and_a_bias_lasts():
    options = {"compass": {"noise": 0.1, "bias": 0.5}}
    environment = helpers.begun("hover", 400, observe={"sensors": options})
    errors = []
    for _ in range(6):
        state = environment.engine.state
        exact = to_body(state.rotation, np.broadcast_to(NORTH, (400, 3)))
        errors.append(environment.sensed["compass"] - exact)
        helpers.idle(environment)
    # The mean of six samples is the bias within 5 * 0.1 / sqrt(6).
    bias = np.mean(errors, axis=0)
    assert np.abs(bias).max() < 0.5 + 0.21 and np.ptp(bias, axis=0).min() > 0.9
    noise = (np.array(errors) - bias) / (0.1 * np.sqrt(5 / 6))
    assert abs(noise.std() - 1) < 0.05  # of 7200 numbers
    # Of numbers that are less their mean of six, two go together by -1/5; 1200 pairs.
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1] + 0.2) < 5 / np.sqrt(1200)


def test_no_two_streams_of_errors_are_the_same():
    """Noise and bias of two sensors, in the first samples of 2,000 episodes, go apart."""
    count, errors = 2000, []
    for given in ({"noise": 0.1}, {"bias": 0.1}):
        both = {"sensors": {"compass": given, "pole": given}}
        environment = helpers.begun("hover", count, observe=both)
        state = environment.engine.state
        exact = to_body(state.rotation, np.broadcast_to(NORTH, (count, 3)))
        errors += [(environment.sensed[name] - exact)[:, 0] for name in ("compass", "pole")]
    together = np.corrcoef(errors)
    assert abs(together - np.eye(4)).max() < 5 / np.sqrt(count)


def test_the_disturbance_compares_a_step_with_the_mean_of_its_thrusts():
    """Thrust rises from nothing to 2 g within the step: it gained g, so nothing else acted."""
    last = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    now = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 2 * GRAVITY]])
    np.testing.assert_allclose(felt(np.zeros((1, 3)), last, now, 0.05, 1.0), 0.0, atol=1e-12)


def test_a_sensor_of_ones_own_says_how_its_samples_follow():
    environment = Environment("hover", observe={"sensors": {"compass": {"strength": 2.0}}})
    said = {term["name"]: term["formula"] for term in describe_observation(environment)}
    assert said["compass"] == "strength R^T (0, 1, 0)" and said["velocity"] == "R^T v"
    (told,) = (
        described_sensor(s) for s in environment.observer.senses.sensors if s.name == "compass"
    )
    assert told["strength"] == 2.0 and told["meaning"]["rate"].startswith("Samples in a second")


def test_another_sensor_beside_it_changes_nothing():
    observes = WILD, {"sensors": {"compass": WILD["sensors"]["compass"]}}
    among, alone = (seen(observe, randomization="full")[0][-1]["compass"] for observe in observes)
    np.testing.assert_array_equal(among, alone)


@pytest.mark.parametrize("rotor_speed", ["true", "none"])
@pytest.mark.parametrize("compiled", [True, False])
def test_a_task_sees_the_sensors_that_it_asks_for(rotor_speed, compiled, monkeypatch):
    monkeypatch.setattr(Northwards, "compiled", compiled)
    environment = helpers.begun(Northwards(), 3, observe={"rotor_speed": rotor_speed})
    assert bool(environment.not_compiled) != compiled
    shown = [environment.snapshot.sensed["compass"][:, 0].copy()]
    for action in ACTIONS:
        done = environment.step(action)
        shown.append(done.observation["compass"][:, 0].copy())
        np.testing.assert_array_equal(done.reward_terms["north"], shown[-1] - shown[-2])
    assert (np.array(shown)[1::2] == np.array(shown)[:-1:2]).all()  # each is held for two steps
    # Of an episode that begins in between, the change is from what is seen at its start.
    fresh = environment.reset(np.array([1]))["compass"][0, 0]
    shown[-1][1] = fresh
    done = environment.step(ACTIONS[0])
    expected = done.observation["compass"][:, 0] - shown[-1]
    np.testing.assert_array_equal(done.reward_terms["north"], expected)


class Nameless(Sensor):
    """Has no name."""

    sense = Compass.sense


class Namesake(Nameless):
    """Has the name of another one."""

    name = "compass"


class Narrow(Compass):
    """Gives another number of values than it says."""

    name, size = "narrow", 2


class Velocity(Compass):
    """Has the name of an entry of the task."""

    name = "velocity"


@pytest.mark.parametrize(
    ("given", "name", "allowed"),
    [
        (["compass"], "sensors", "mapping"),
        ({"compas": {}}, "sensor", "did you mean compass?"),
        ({"compass": 0.1}, "sensor compass", "mapping"),
        ({"compass": {"lag": 1}}, "option of compass", "noise, bias, delay, rate, strength"),
        ({"compass": {"noise": -1}}, "compass noise", "between 0"),
        ({"compass": {"delay": 11}}, "compass delay", "between 0 and 10"),
        ({"compass": {"delay": 0.07}}, "compass delay", "control steps of 0.05 s"),
        ({"compass": {"rate": 50}}, "compass rate", "at most 20, one in each of the control steps"),
        ({"action_history": {"length": 0}}, "action_history length", "between 1"),
        ({"estimate": {"noise": 0.1}}, "estimate noise", "`noise` of the randomization"),
        ({"rotor_speed": {"source": "none"}}, "rotor_speed source", "true, estimated"),
        ({"velocity": {}}, "sensor", "no entry of the task hover has"),
        ({"narrow": {}}, "sense of narrow", "(1, 2)"),
    ],
)
def test_an_impossible_sensor_is_refused(given, name, allowed, monkeypatch):
    for kind in (Narrow, Velocity):
        monkeypatch.setitem(sensors.SENSORS, kind.name, kind)
    with helpers.refused(lists=allowed, match=f"^{name}"):
        Environment("hover", observe={"sensors": given}).reset()


@pytest.mark.parametrize("kind", [Nameless, Namesake, object, "compass"])
def test_only_sensors_with_a_name_of_their_own_are_registered(kind):
    with helpers.refused(match="sensor"):
        register_sensor(kind)
