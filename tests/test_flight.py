"""The free-flight engine: against the exact solution, against MuJoCo, and where it hands over."""

import dataclasses
import json
import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import reference
import torch
from scipy.spatial.transform import Rotation

import quadrl
from quadrl import tasks
from quadrl.environment import Environment
from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.flight import EngineError, parameters
from quadrl.learning.config import TrainConfig
from quadrl.learning.train import Training
from quadrl.policy import Policy
from quadrl.simulation import BatchSimulation, SingleSimulation
from quadrl.task import OptionError
from quadrl.vehicle import VEHICLES, Vehicle

PAPER = Vehicle()
STEPS = 20


def random_flights(count, seed, vehicle=PAPER):
    """Starts x (n, 17) as `reference` has them, commands (n, 4) and winds (n, 3)."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    moving = rng.uniform(-2, 2, (count, 6))
    low, high = 0.66 * vehicle.hover_speed, 1.33 * vehicle.hover_speed  # the paper's 150 and 300
    speed, command = rng.uniform(low, high, (2, count, 4))
    start = np.concatenate([rng.uniform(-1, 1, (count, 3)), q, moving, speed], axis=-1)
    return start, command, rng.uniform(-3, 3, (count, 3))


def fly(vehicle, start, command, wind, seconds, engine="flight"):
    """The starts through an engine: qpos, qvel, act (n, 17)."""
    simulation = BatchSimulation(vehicle, len(start), altitude=3.0, engine=engine)
    attitude = Rotation.from_quat(start[:, 3:7], scalar_first=True).inv()
    simulation.qpos[:, :3], simulation.qpos[:, 3:] = (
        start[:, :3],
        attitude.as_quat(scalar_first=True),
    )
    simulation.qvel[:, :3], simulation.qvel[:, 3:] = attitude.apply(start[:, 7:10]), start[:, 10:13]
    simulation.act[:], simulation.ctrl[:], simulation.wind[:] = start[:, 13:], command, wind
    simulation.advance(round(seconds / vehicle.physics_step))
    return np.concatenate([simulation.qpos, simulation.qvel, simulation.act], axis=-1)


def error(flown, exact):
    """Worst deviation over position, attitude, velocity (body frame), spin and rotor speed."""
    true_attitude = Rotation.from_quat(exact[:, 3:7], scalar_first=True).inv()
    attitude = Rotation.from_quat(flown[:, 3:7], scalar_first=True)
    deviations = (
        flown[:, :3] - exact[:, :3],
        (attitude.inv() * true_attitude).magnitude(),
        attitude.inv().apply(flown[:, 7:10]) - exact[:, 7:10],
        flown[:, 10:] - exact[:, 10:],
    )
    return max(np.abs(deviation).max() for deviation in deviations)


@pytest.mark.parametrize("name", VEHICLES)
def test_fourth_order_towards_the_exact_solution(name):
    vehicle = VEHICLES[name]
    start, command, wind = random_flights(100, seed=1, vehicle=vehicle)
    seconds = 20 * vehicle.control_step  # 1 s of the paper's aircraft
    exact = reference.fly(vehicle, start, command, seconds, wind)
    # The reference has the paper's inertia and mixer; the quarter of a step leaves 4^-4 = 1/256.
    errors = []
    for share in (1, 1 / 4):
        finer = dataclasses.replace(vehicle, physics_step=vehicle.physics_step * share)
        errors.append(error(fly(finer, start, command, wind, seconds), exact))
    assert errors[0] / errors[1] == pytest.approx(256, rel=0.25), errors
    # The limits that MuJoCo is held to, here with the velocity in the body frame as well.
    assert errors[0] < 2e-3
    assert errors[1] < 1e-4


@pytest.mark.parametrize("task", tasks.TASKS)
def test_both_engines_come_together_on_every_task(task):
    """The same episode in both, at the aircraft's own step and at a quarter of it."""
    apart = []
    for step in (0.01, 0.0025):
        vehicle = dataclasses.replace(PAPER, physics_step=step)
        states = []
        for engine in ("mujoco", "flight"):
            environment = Environment(task, num_envs=16, seed=5, vehicle=vehicle, engine=engine)
            environment.reset()
            actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, 16, 4))
            for action in actions:
                environment.step(action)
            simulation = environment.simulation
            states.append(np.concatenate([simulation.qpos, simulation.qvel, simulation.act], -1))
        apart.append(np.abs(states[0] - states[1]).max())
    assert apart[0] < 2e-3, apart
    assert apart[1] < 1e-4, apart
    assert apart[0] / apart[1] == pytest.approx(16, rel=0.2), apart  # MuJoCo's second order


@pytest.mark.parametrize("threads", [1, 3])
def test_an_aircraft_flies_the_same_whatever_flies_beside_it(threads):
    count = 1030  # several threads' worth, and no whole number of lanes
    batch = BatchSimulation(PAPER, count, altitude=3.0, engine="flight", num_threads=threads)
    rng = np.random.default_rng(2)
    batch.qpos[:] = rng.normal(size=(count, 7)) + [0, 0, 3, 0, 0, 0, 0]
    batch.qpos[:, 3:] /= np.linalg.norm(batch.qpos[:, 3:], axis=-1, keepdims=True)
    batch.qvel[:], batch.act[:] = rng.normal(size=(count, 6)), rng.uniform(150, 300, (count, 4))
    batch.ctrl[:] = rng.uniform(150, 300, (count, 4))
    model = PAPER.compile_lean()
    one = SingleSimulation(PAPER, model, mujoco.MjData(model), altitude=3.0, engine="flight")
    chosen = [0, 1, 7, 8, 511, 1023, 1024, 1029]
    flown = []
    for row in chosen:
        for name in ("qpos", "qvel", "act", "ctrl"):
            getattr(one, name)[:] = getattr(batch, name)[row]
        one.advance()
        flown.append(np.concatenate([one.qpos, one.qvel, one.act]))
    batch.advance()
    rows = np.concatenate([batch.qpos, batch.qvel, batch.act], axis=-1)[chosen]
    np.testing.assert_array_equal(rows, flown)
    assert one.data.time == pytest.approx(len(chosen) * 0.05)


def test_wind_carries_the_aircraft_as_it_does_in_mujoco():
    start, command, _ = random_flights(8, seed=3)
    gale = np.tile([5.0, -2.0, 1.0], (8, 1))
    flight, exact = (fly(PAPER, start, command, gale, 0.5, e) for e in ("flight", "mujoco"))
    still = fly(PAPER, start, command, 0 * gale, 0.5)
    assert np.abs(flight - exact).max() < 2e-3
    assert np.abs(flight - still)[:, 7].min() > 0.01  # east


# ------------------------------------------------------------------------------ near the ground


def landing(engine, count=32):
    return Environment("landing", num_envs=count, seed=0, engine=engine)


def test_what_could_touch_the_ground_is_mujocos_bit_by_bit():
    # From one state both engines make the same step of every aircraft that is near the ground,
    # and not of those that are not: each is flown by the engine that it should be.
    flight, whole = landing("flight"), landing("mujoco")
    flight.reset(), whole.reset()
    rng = np.random.default_rng(0)
    flight.simulation.qpos[:, 2] = np.linspace(0.07, 3.0, 32)
    touched = 0
    for _ in range(10):
        for name in ("qpos", "qvel", "act"):
            getattr(whole.simulation, name)[:] = getattr(flight.simulation, name)
        whole.simulation.batch.bind("qacc_warmstart")[:] = flight.simulation.batch.bind(
            "qacc_warmstart"
        )
        action = rng.uniform(-1, 1, (32, 4))
        flight.step(action), whole.step(action)
        near = (flight.simulation.qpos == whole.simulation.qpos).all(axis=-1)
        height = flight.simulation.qpos[:, 2]
        assert near[height < 0.4].all()
        assert not near[height > 1.5].any()
        touched += near.sum()
    assert touched > 20


def test_nothing_that_free_flight_takes_comes_near_the_ground_in_a_step():
    # The wildest flights: fast, tilted, in wind, at any height.
    rng = np.random.default_rng(4)
    count = 2000
    simulation = BatchSimulation(PAPER, count, altitude=3.0, contact=True, engine="flight")
    floor = parameters(simulation.model)[-1]
    quaternion = rng.normal(size=(count, 4))
    simulation.qpos[:, 2] = rng.uniform(0.1, 4.0, count)
    simulation.qpos[:, 3:] = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    simulation.qvel[:] = rng.normal(size=(count, 6)) * 8
    simulation.act[:], simulation.ctrl[:] = rng.uniform(0, 319, (2, count, 4))
    simulation.wind[:] = rng.normal(size=(count, 3)) * 8
    near = np.zeros(count, dtype=bool)
    near[simulation._flight.advance(5)] = True  # pyright: ignore
    lowest = simulation.qpos[:, 2]
    assert 0.1 < near.mean() < 0.9
    assert (lowest[~near] > floor).all()
    # The paper's aircraft reaches 0.3 m from its centre at most, rotors included.
    assert 0.29 < floor < 0.4


def test_landing_ends_as_it_does_in_mujoco():
    ends = []
    for engine in ("mujoco", "flight"):
        environment = landing(engine)
        environment.reset()
        environment.simulation.qpos[:, 2] = 0.5
        over = np.zeros(32, dtype=bool)
        heights = []
        for _ in range(40):  # rotors slowed by a tenth: down it goes
            now = environment.step(np.full((32, 4), -0.6))
            over |= np.asarray(now.terminated)
            heights.append(environment.simulation.qpos[:, 2].copy())
        ends.append((over, np.array(heights)))
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    assert ends[0][0].all()
    np.testing.assert_allclose(ends[0][1], ends[1][1], atol=5e-3)


def test_saved_and_restored_it_flies_on_bit_by_bit():
    environment, other = landing("flight"), landing("flight")
    environment.reset()
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 0.2, (20, 32, 4))
    for action in actions[:10]:
        environment.step(action)
    other.restore(environment.save())
    for action in actions[10:]:
        np.testing.assert_array_equal(environment.step(action).reward, other.step(action).reward)
    np.testing.assert_array_equal(environment.simulation.qpos, other.simulation.qpos)


def test_an_aircraft_that_breaks_down_is_counted_and_leaves_the_others_alone():
    environment = Environment("hover", num_envs=9, seed=0, engine="flight")
    undisturbed = Environment("hover", num_envs=9, seed=0, engine="flight")
    environment.reset(), undisturbed.reset()
    environment.simulation.qvel[4, 3:] = 1e200
    now, sound = environment.step(np.zeros((9, 4))), undisturbed.step(np.zeros((9, 4)))
    assert now.diverged.tolist() == [False] * 4 + [True] + [False] * 4
    assert now.terminated[4] and np.isfinite(now.reward).all()
    others = np.arange(9) != 4
    np.testing.assert_array_equal(now.reward[others], sound.reward[others])


# ---------------------------------------------------------------------------------------- the doors


def through_dm_control(task, actions):
    door = quadrl.load(task, {"random": 7, "engine": "flight"})
    door.reset()
    for action in actions[:, 0]:
        door.step(action)
    data = door.physics.data
    np.testing.assert_array_equal(data.body("aircraft").xpos, data.qpos[:3])  # drawn where it is
    return data.qpos


def through_gymnasium(task, actions):
    door = gym.make(gymnasium_id(task), engine="flight")
    door.reset(seed=7)
    for action in actions[:, 0]:
        door.step(action)
    return door.unwrapped.environment.simulation.qpos


def through_gymnasium_vector(task, actions):
    door = gym.make_vec(gymnasium_id(task), num_envs=3, engine="flight")
    door.reset(seed=7)
    for action in actions:
        door.step(action)
    return door.unwrapped.environment.simulation.qpos[0]


def through_torchrl(task, actions):
    door = QuadrotorEnv(task, 3, seed=7, engine="flight")
    state = door.reset()
    for action in actions:
        state = door.step(state.set("action", torch.from_numpy(action)))["next"]
    return door.environment.simulation.qpos[0]


def gymnasium_id(task):
    return f"quadrl/{''.join(word.capitalize() for word in task.split('_'))}-v0"


@pytest.mark.parametrize("task", ["hover", "landing"])
@pytest.mark.parametrize(
    "door", [through_dm_control, through_gymnasium, through_gymnasium_vector, through_torchrl]
)
def test_every_door_flies_it_bit_by_bit(task, door):
    # Landing's aircraft comes down from 3 m: from free flight into MuJoCo's hands.
    actions = np.random.default_rng(1).uniform(-1, -0.2, (12, 3, 4)).astype(np.float32)
    environment = Environment(task, num_envs=2, seed=7, engine="flight")
    environment.reset()
    for action in actions:
        environment.step(action[:2])
    np.testing.assert_array_equal(door(task, actions), environment.simulation.qpos[0])


def test_training_in_it_is_judged_in_mujoco(tmp_path):
    # What the run records of itself; its evaluation has no option for another engine.
    config = TrainConfig(engine="flight", num_envs=8, rollout=4, steps=64)
    folder = tmp_path / "run"
    folder.mkdir()
    Training(config, folder).run()
    assert json.loads((folder / "config.json").read_text())["engine"] == "flight"
    assert Policy.load(folder)(np.zeros(22, np.float32)).shape == (4,)


# ---------------------------------------------------------------------------------- what it refuses


def change(edit):
    spec = PAPER.spec(contact=True)
    edit(spec)
    return spec.compile()


def wall(spec):
    spec.worldbody.add_geom(name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=[1, 0.1, 1])


def load(spec):
    body = spec.body("aircraft").add_body(name="load", pos=[0, 0, -0.3])
    body.add_geom(size=[0.05, 0, 0], mass=0.1)


def off_centre(spec):
    spec.body("aircraft").ipos = (0.01, 0, 0)


@pytest.mark.parametrize(
    ("edit", "named"),
    [(wall, "wall"), (load, "no other body"), (off_centre, "centre of mass")],
)
def test_refuses_what_the_equations_do_not_describe(edit, named):
    with pytest.raises(EngineError, match=rf"{named}.*engine='mujoco'"):
        parameters(change(edit))


def test_the_parameters_are_the_models():
    model = Vehicle(mass=0.9, arm_length=0.3).compile_lean()
    packed = parameters(model).tolist()
    assert packed[1] == 0.9 and packed.count(0.3) == 2 and packed.count(-0.3) == 2
    assert packed[-1] == -math.inf  # nothing to touch
    model.body_mass[1] = 1.3
    assert parameters(model)[1] == 1.3


def test_an_unknown_engine_lists_the_choices():
    with pytest.raises(OptionError, match="mujoco, flight"):
        Environment("hover", engine="warp")  # pyright: ignore
