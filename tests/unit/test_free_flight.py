"""The free-flight engine: beside MuJoCo, whatever flies beside it, and where it hands over.

tests/unit/test_exact.py holds both engines against the exact solution.
"""

import dataclasses
import math

import helpers
import mujoco
import numpy as np
import pytest

from quadrl import tasks
from quadrl.aircraft.aerodynamics import Aerodynamics
from quadrl.aircraft.vehicle import Vehicle
from quadrl.core.environment import Environment
from quadrl.engines import mjcf
from quadrl.engines.free_flight import MARGIN
from quadrl.engines.mujoco import BatchEngine, DataEngine

PAPER = Vehicle()
EVERY = helpers.LAYOUTS | helpers.IN_AIR


@pytest.mark.parametrize("per_row", [False, True])
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("name", ["paper", "eight", "leaning in air"])
def test_an_aircraft_flies_the_same_whatever_flies_beside_it(name, threads, per_row):
    count, vehicle = 1030, EVERY[name]  # several threads' worth, no whole lanes
    settings = dict(altitude=3.0, engine="free_flight")
    batch = BatchEngine(vehicle, count, num_threads=threads, per_row=per_row, **settings)
    table = helpers.parameter_rows(vehicle, count)
    if per_row:
        batch.write_parameters(np.arange(count), table)
    motion = helpers.random_motion(vehicle, count, wind=3.0, rotor=0.3)
    if name in helpers.IN_AIR:  # so that neighbours fly with and without ground effect
        motion.position[:, 2] = np.random.default_rng(2).uniform(-99.3, -98.9, count)
    helpers.put(batch, motion)
    batch.ctrl[:] = command = helpers.random_commands(vehicle, count, 1, rotor=0.3)[0]
    batch.advance(5)
    model = mjcf.compile_model(vehicle)
    one = DataEngine(vehicle, model, mujoco.MjData(model), **settings)
    chosen = [*range(120), 511, 1023, 1024, 1029]
    for row in chosen:
        if per_row:
            one.write_parameters(np.array([0]), table[row : row + 1])
        helpers.put(one, helpers.Motion(*(x[row : row + 1] for x in vars(motion).values())))
        one.ctrl[:] = command[row]
        one.advance(5)
        np.testing.assert_array_equal(helpers.coordinates(one)[0], helpers.coordinates(batch)[row])
    assert one.data.time == pytest.approx(len(chosen) * 5 * vehicle.physics_timestep)


# ------------------------------------------------------------------------------ near the ground


def test_what_could_touch_the_ground_is_mujocos_bit_by_bit():
    # From one state both engines make the same step of every aircraft that is near the ground,
    # and not of those that are not: each is flown by the engine that it should be.
    free, whole = (BatchEngine(PAPER, 32, altitude=0.07, model=helpers.grounded(PAPER), engine=e)
                   for e in ("free_flight", "mujoco"))  # fmt: skip
    helpers.put(free, helpers.random_motion(PAPER, 32, speed=1.0, turn=1.0), origin=0)
    free.qpos[:, 2] = np.linspace(0.07, 3.0, 32)
    touched, warm = 0, free.batch.bind("qacc_warmstart")
    for command in helpers.random_commands(PAPER, 32, 10):
        warm[:] = 7.0
        whole.restore(free.save())  # the warm start of the contacts as well
        free.ctrl[:] = whole.ctrl[:] = command
        free.advance(5), whole.advance(5)
        near = (helpers.coordinates(free) == helpers.coordinates(whole)).all(axis=-1)
        height = free.qpos[:, 2]
        assert near[height < 0.34].all()  # 0.292 m to the edge of a rotor's disc, and MARGIN
        assert not near[height > 1.5].any()
        # What was in contact long ago is forgotten: the next contact does not depend on it.
        assert not warm[~near].any()
        touched += near.sum()
    assert touched > 20


def by_both(vehicle, motion, command):
    """Coordinates (n, 13 + R) after a control step over the ground: in free flight, by MuJoCo."""
    for engine in ("free_flight", "mujoco"):
        model = helpers.grounded(vehicle)
        batch = BatchEngine(vehicle, len(command), altitude=3.0, model=model, engine=engine)
        helpers.put(batch, motion, origin=0)
        batch.ctrl[:] = command
        batch.advance(vehicle.substeps)
        yield helpers.coordinates(batch)


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_nothing_that_free_flight_takes_comes_near_the_ground_in_a_step(name):
    # The wildest flights: fast, tilted, in wind, at any height. Whoever is handed over is flown
    # exactly as MuJoCo flies it; all others stay clear of the ground by more than their reach. For
    # the long control step, thrust and drag have their time to push it down.
    vehicle, count = dataclasses.replace(EVERY[name], control_timestep=0.2), 300
    wild = helpers.random_motion(vehicle, count, speed=12.0, turn=8.0, wind=12.0, rotor=0.4)
    reach = max(np.linalg.norm(r.position) + r.radius for r in vehicle.rotors)
    highest = reach + 30.0 * vehicle.control_timestep
    wild.position[:, 2] = np.random.default_rng(4).uniform(0.1, highest, count)
    command = helpers.random_commands(vehicle, count, 1, rotor=0.9)[0]
    # Every other one is on its back, at its fastest: nothing is pushed down more.
    wild.quaternion[::2], wild.body_rate[::2] = (0, 1, 0, 0), 0.0
    wild.rotor_speed[::2], command[::2] = vehicle.max_speed, vehicle.max_speed
    free, whole = by_both(vehicle, wild, command)
    near = (free == whole).all(axis=-1)
    assert 0.1 < near.mean() < 0.95
    assert (free[~near, 2] > reach + MARGIN).all()


@pytest.mark.parametrize("name", ["drag", "drag of the rotors"])
def test_an_aircraft_that_the_wind_pushes_to_the_ground_is_handed_over(name):
    # At rest in wind of 60 m/s from above, which pushes far more than weight and thrust can: level,
    # by drag with 0.009 * 60^2 / 0.3 = 108 m/s^2, or on its side, by the rotors' own drag.
    vehicle, attitude = dataclasses.replace(PAPER, mass=0.3), (1, 0, 0, 0)
    if name != "drag":
        rotors = Aerodynamics(rotor_drag=1e-3)
        vehicle = dataclasses.replace(vehicle, drag_coefficient=0.0, aerodynamics=rotors)
        attitude = (math.sqrt(0.5), math.sqrt(0.5), 0, 0)
    count, reach = 200, max(np.linalg.norm(r.position) + r.radius for r in vehicle.rotors)
    motion = helpers.random_motion(vehicle, count, speed=0.0, turn=0.0, rotor=0.0)
    motion.quaternion[:], motion.wind[:] = attitude, (0, 0, -60)
    motion.position[:, 2] = reach + MARGIN + np.linspace(0.001, 1.0, count)
    free, whole = by_both(vehicle, motion, motion.rotor_speed)
    near = (free == whole).all(axis=-1)
    low = whole[:, 2] < reach + MARGIN
    assert 0.05 < low.mean() and near[low].all() and not near.all()


# ---------------------------------------------------------------------------------- what it refuses


def wall(spec):
    spec.worldbody.add_geom(name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=[1, 0.1, 1])


def load(spec):
    body = spec.body("aircraft").add_body(name="load", pos=[0, 0, -0.3])
    body.add_geom(size=[0.05, 0, 0], mass=0.1)


def slope(spec):
    quaternion = [math.cos(0.1), math.sin(0.1), 0, 0]
    spec.worldbody.add_geom(name="slope", type=mujoco.mjtGeom.mjGEOM_PLANE,
                            size=[1, 1, 1], quat=quaternion)  # fmt: skip


def off_centre(spec):
    spec.body("aircraft").ipos = (0.01, 0, 0)


@pytest.mark.parametrize(
    ("edit", "named"),
    [(wall, "wall"), (slope, "slope"), (load, "single body"), (off_centre, "centre of mass")],
)
def test_refuses_what_the_equations_do_not_describe(edit, named):
    spec = mjcf.spec(PAPER, contact=True)
    edit(spec)
    model = spec.compile()
    with helpers.refused("engine", lists="mujoco", match=named):
        DataEngine(PAPER, model, mujoco.MjData(model), altitude=3.0, engine="free_flight")
    # MuJoCo itself takes it.
    DataEngine(PAPER, model, mujoco.MjData(model), altitude=3.0)


def test_ground_that_a_task_raises_is_not_flown_through():
    class Raised(type(tasks.make("hover"))):
        contact = True

        def scene(self, spec):
            plane = mujoco.mjtGeom.mjGEOM_PLANE
            spec.worldbody.add_geom(type=plane, size=[5, 5, 1], pos=[0, 0, 2.0])

    # The task's frame begins at 3 m. It falls, its rotors at their slowest, and stays on the plane.
    environment = helpers.placed(Raised(), engine="free_flight")
    for _ in range(30):
        environment.step(np.full((1, 4), -1.0))
    assert 2.0 < environment.engine.qpos[0, 2] < 2.3


def test_a_task_that_builds_a_wall_is_refused():
    class Walled(type(tasks.make("hover"))):
        def scene(self, spec):
            wall(spec)

    with helpers.refused("engine", match="wall"):
        Environment(Walled(), engine="free_flight")
    Environment(Walled())


def test_the_clock_of_a_world_with_contacts_is_that_of_the_flight():
    # Its model has shorter steps.
    one = Environment("landing", engine="free_flight", seed=0)
    one.reset()
    one.step(np.zeros((1, 4)))
    assert one.engine.data.time == pytest.approx(one.vehicle.control_timestep)


def test_what_an_aircraft_was_when_its_episode_began_is_kept():
    many = Environment("hover", num_envs=3, seed=0, engine="free_flight", randomization="full")
    many.reset()
    assert len(set(many.engine.parameters["mass"])) == 3
    np.testing.assert_array_equal(many.engine.begun, many.engine.parameters)
