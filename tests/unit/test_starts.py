"""Starts that a caller gives: what a task remembers is of the start that is flown."""

import dataclasses

import gymnasium
import helpers
import numpy as np
import pytest
import torch

import quadrl
from quadrl.base.rotation import Array
from quadrl.core.environment import Environment
from quadrl.core.task import TaskState
from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.tasks.hover import Hover
from quadrl.tasks.landing import Landing
from quadrl.tasks.race import Race

STILL = {"velocity": (0, 0, 0), "body_rate": (0, 0, 0), "quaternion": (1, 0, 0, 0)}
COUNT = 500


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("track", ["split_s", "alphapilot", "airsim"])
def test_an_aircraft_at_rest_passes_no_gate_and_is_not_out(track, compiled, monkeypatch):
    monkeypatch.setattr(Race, "compiled", compiled)
    task = Race(track=track)
    gates, rng = task.course.centre, np.random.default_rng(0)
    spread = rng.uniform([-12, -12, -1], [12, 12, 3], (COUNT, 3))
    place = gates[rng.integers(len(gates), size=COUNT)] + spread
    place[0] = gates[0] + task.course.axes[0, 0]  # a metre behind the first gate
    place[:, 2] = np.maximum(place[:, 2], 0.5)
    environment = helpers.begun(task, COUNT, engine="free_flight")
    environment.reset(start=STILL | {"position": place})
    away = np.linalg.norm(gates[0] - place, axis=1)
    np.testing.assert_allclose(environment.snapshot.task.leg, away)
    done = environment.step(np.zeros((COUNT, 4)))
    assert not environment.snapshot.task.passed.any() and not done.terminated.any()
    assert not done.reward_terms["pass"].any() and not done.reward_terms["miss"].any()


def test_among_poles_only_who_begins_against_something_is_out():
    place = np.random.default_rng(1).uniform([-2.4, -2.4, 0.4], [2.4, 2.4, 2.0], (COUNT, 3))
    environment = helpers.begun("lsy_race", COUNT)
    turning = environment.vehicle.hover_speed
    environment.reset(start=STILL | {"position": place, "rotor_speed": turning})
    clearance = environment.snapshot.potentials.clearance.copy()
    done = environment.step(np.zeros((COUNT, 4)))
    assert not environment.snapshot.task.passed.any()
    assert not done.terminated[clearance > 0.01].any() and done.terminated[clearance < 0].all()


def test_some_rows_remember_their_start_and_the_others_their_flight():
    environment = helpers.begun("race", 3)
    before = environment.snapshot.task.position.copy()
    environment.reset(np.array([1]), start=STILL | {"position": [(0, 0, 2), (1, 2, 3), (0, 0, 4)]})
    before[1] = (1, 2, 3)
    np.testing.assert_array_equal(environment.snapshot.task.position, before)


def test_every_api_gives_the_same_start():
    start, own = STILL | {"position": (1.0, 2.0, 3.0)}, {"vehicle": "racer"}
    environments = [Environment("race", **own), Environment("race", **own)]
    environments[0].reset(start=start)
    environments[1].reset(start=start | {"quaternion": (-2, 0, 0, 0)})  # the same attitude
    single = gymnasium.make("quadrl/Race-v0", **own)
    single.reset(options=start)
    batch = gymnasium.make_vec("quadrl/Race-v0", num_envs=2, **own)
    batch.reset(options=start)
    tensors = QuadrotorEnv("race", 2, **own)
    tensors.reset()
    mask = torch.tensor([[True], [False]])
    tensors.reset(tensors.reset().set("_reset", mask), start=start)
    environments += [each.unwrapped.environment for each in (single, batch)]
    for each in (*environments, tensors.environment):
        np.testing.assert_array_equal(each.snapshot.task.position[0], (1, 2, 3))
        np.testing.assert_allclose(each.snapshot.state.position[0], (1, 2, 3), atol=1e-12)
    assert np.abs(tensors.environment.snapshot.task.position[1] - (1, 2, 3)).max() > 0.5
    with pytest.raises(quadrl.base.errors.QuadrlError, match="'place'.*position"):
        tensors.reset(start={"place": (0, 0, 0)})


def test_dm_control_begins_where_it_is_told_until_it_is_told_otherwise():
    helpers.needs_dm_control()
    from quadrl.envs import dm_control

    control = dm_control.make("race")
    control.task.start_at = STILL | {"position": (1.0, 2.0, 3.0)}
    for _ in range(2):
        control.reset()
        begun = control.task.environment.snapshot.task.position
        np.testing.assert_array_equal(begun, [(1, 2, 3)])
    control.task.start_at = None
    control.reset()
    assert (control.task.environment.snapshot.task.position != (1, 2, 3)).all()


def test_a_touchdown_in_the_first_step_is_as_hard_as_its_start_is_fast():
    # 2 cm above the pad, sinking at 1 m/s: the feet touch within the step of 0.05 s. Half the
    # speed is allowed.
    for speed, hard in ((1.0, True), (0.4, False)):
        environment = Environment(Landing())
        environment.reset(start=STILL | {"position": (0, 0, 0.02), "velocity": (0, 0, -speed)})
        assert environment.step(np.zeros((1, 4))).terminated[0] == hard


@dataclasses.dataclass(frozen=True)
class Begun(TaskState):
    attitude: Array  # (N, 4)
    turning: Array  # (N, R) [rad/s]


@dataclasses.dataclass(frozen=True)
class Remembers(Hover):
    def begin(self, rng, parameters):
        start, state = super().begin(rng, parameters)
        return start, Begun(state.goal, 0 * start.quaternion, 0 * start.rotor_speed)

    def remember(self, start, drawn):
        return Begun(drawn.goal, start.quaternion, start.rotor_speed)


def test_a_start_is_remembered_as_wind_has_trimmed_it():
    task = Remembers(tilt=0.0, speed=0.0, spin=0.0)
    environment = helpers.begun(task, 2, weather={"wind_speed": 6.0})
    begun, state = environment.snapshot.task, environment.snapshot.state
    assert (state.cos_tilt < 0.9999).all()  # leaning into the wind
    np.testing.assert_allclose(begun.attitude, state.quaternion, atol=1e-12)
    np.testing.assert_array_equal(begun.turning, state.rotor_speed)
