"""Parameters and wind of each row: drawn, flown, shown, saved, and refused."""

import dataclasses

import helpers
import mujoco
import numpy as np
import pytest
from helpers import WIND, drawn, flying, ranges_of

from quadrl import mjcf, tasks
from quadrl.engines import mujoco as engines
from quadrl.engines.mujoco import BatchEngine, DataEngine
from quadrl.environment import Environment
from quadrl.errors import QuadrlError
from quadrl.rng import PARAMETERS, Rng
from quadrl.tasks.hover import Hover
from quadrl.vehicle import VEHICLES, Vehicle

ENGINES = ("mujoco", "free_flight")
PAPER = Vehicle()


# --------------------------------------------------------------------------------------- flown

LOW = tasks.make("landing", start_height=0.03)  # [m] over where it stands


def by_itself(vehicle, task, engine, altitude):
    """One aircraft in the complete model, and in a batch of its own."""
    model = mjcf.compile_model(vehicle, contact=task.contact)
    settings = dict(altitude=altitude, engine=engine)
    yield DataEngine(vehicle, model, mujoco.MjData(model), **settings)
    yield BatchEngine(vehicle, 1, contact=task.contact, **settings)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", ["paper", "hexa"])
@pytest.mark.parametrize("task", [tasks.make("hover"), LOW], ids=lambda task: task.name)
def test_a_row_flies_as_the_aircraft_that_is_built_with_its_numbers(task, name, engine):
    vehicle = VEHICLES[name]
    environment = flying(task, vehicle=vehicle, engine=engine)
    copies = []
    for i, row in enumerate(environment.engine.parameters):
        own = helpers.vehicle_of_row(vehicle, row)
        np.testing.assert_allclose(row["rotor"]["hover_speed"][: own.rotor_count], own.hover_speed)
        np.testing.assert_allclose(row["resolved_turn"], own.resolved_turn)
        np.testing.assert_allclose(row["resolved_speed"], own.resolved_speed)
        for copy in by_itself(own, task, engine, environment.origin[2]):
            for field in ("qpos", "qvel", "act", "air"):
                getattr(copy, field)[:] = getattr(environment.engine, field)[i]
            copies.append((i, copy))
    touched = False
    for action in np.random.default_rng(0).uniform(-1, 0.2, (15, 4, vehicle.rotor_count)):
        environment.step(action)
        whole = helpers.coordinates(environment.engine)
        for i, copy in copies:
            copy.ctrl[:] = environment.engine.ctrl[i]
            copy.advance(vehicle.substeps)
            # The weights of a contact, 1 / m, are not rounded as MuJoCo's compiler rounds them.
            atol = 1e-11 if task is LOW else 0.0
            np.testing.assert_allclose(helpers.coordinates(copy)[0], whole[i], rtol=0, atol=atol)
            touched |= isinstance(copy, DataEngine) and copy.data.ncon > 0
    assert touched == (task is LOW)


@pytest.mark.parametrize("engine", ENGINES)
def test_each_parameter_is_felt(engine):
    # From the same start, with the same commands, in still air: each range changes the flight.
    commands = helpers.random_commands(PAPER, 1, 3, rotor=0.3)[:, 0]

    def end(ranges):
        environment = flying(count=1, ranges=ranges, engine=engine)
        helpers.put(environment.engine, helpers.random_motion(PAPER, 1, speed=5.0, turn=5.0))
        if "wind" in ranges:
            environment.engine.air[:] = 1.0
        for command in commands:
            environment.engine.ctrl[:] = command
            environment.engine.advance(5)
        return helpers.coordinates(environment.engine)

    whole = ranges_of(PAPER)
    # A range of one number is what is specified.
    paper = end({"mass": (PAPER.mass, PAPER.mass)})
    assert all((end({n: whole[n]}) != paper).any() for n in whole if n != "max_speed")


@pytest.mark.parametrize("engine", ENGINES)
def test_a_rotor_is_never_faster_than_its_own_largest_speed(engine):
    # Full action commands 225.7 + 35 = 260.7 rad/s, the row's rotors reach less.
    environment = flying(ranges={"max_speed": (230.0, 240.0)}, engine=engine)
    for _ in range(40):
        environment.step(np.ones((4, 4)))
    largest = environment.engine.parameters["rotor"]["max_speed"][:, :4]
    np.testing.assert_allclose(environment.engine.act, largest, rtol=1e-3)


@pytest.mark.parametrize(
    ("name", "column", "resolved"),
    [("moment_coefficient", 5, "resolved_turn"), ("drag_coefficient", 0, "resolved_speed")],
)
def test_a_row_diverges_past_its_own_limit(name, column, resolved):
    # J / (2 k_M dt): 46.9 to 7.5 rad/s; m / (2 k_D dt): 3611 to 65 m/s.
    highest = {"moment_coefficient": (8e-3, 0.05), "drag_coefficient": (9e-3, 0.5)}[name]
    engine = flying(count=8, ranges={name: highest}).engine
    limit = engine.parameters[resolved]
    assert np.ptp(limit) > 0.3 * limit.max()
    for row in range(8):  # alone, so that the limit of no other row finds it out
        engine.qvel[:], engine.qvel[row, column] = 0.0, 0.99 * limit[row]
        assert engine.read() is None
        engine.qvel[row, column] = 1.01 * limit[row]
        np.testing.assert_array_equal(engine.read(), np.arange(8) == row)


def test_the_fields_of_a_row_are_those_that_mujoco_compiles():
    engine = flying().engine
    names = ("body_mass", "body_subtreemass", "body_inertia", "body_invweight0", "body_user")
    for name in (*names, "dof_M0", "dof_invweight0", "actuator_gear", "actuator_ctrlrange"):
        for row, field in zip(engine.parameters, engine.batch.expand(name), strict=True):
            model = mjcf.compile_model(helpers.vehicle_of_row(PAPER, row), drawn=False)
            np.testing.assert_allclose(field, getattr(model, name), rtol=1e-14, err_msg=name)


# --------------------------------------------------------------------------------------- drawn


def test_what_is_drawn_lies_in_its_range_and_differs_by_rotor_row_and_episode():
    environment = flying(count=200)
    table, given = environment.engine.parameters.copy(), ranges_of(PAPER)
    for name, (low, high) in given.items():
        rotor = name in helpers.ROTOR_PARAMETERS
        values = environment.engine.air if name == "wind" else table["rotor" if rotor else name]
        values = values[name][:, :4] if rotor else values.reshape(200, -1)
        assert (values >= low).all() and (values <= high).all()
        wide = np.array(high) - low
        assert (np.ptp(values, axis=0) > 0.9 * wide).all(), name
        # No column follows another: |r| stays under 5 standard deviations of 1 / sqrt(200).
        related = np.atleast_2d(np.corrcoef(values.T))
        assert np.abs(related - np.eye(len(related))).max() < 5 / np.sqrt(200), name
    first = drawn(environment)
    environment.reset()
    assert (drawn(environment) != first).any(axis=1).all()


@pytest.mark.parametrize("engine", ENGINES)
def test_row_i_draws_and_flies_what_the_single_aircraft_of_seed_plus_i_does(engine):
    task = tasks.make("hover", time_limit=0.4)
    actions = helpers.random_actions(20, 3)
    whole = flying(task, count=3, seed=40, engine=engine)
    first, records = drawn(whole), helpers.fly(whole, actions)
    for i in range(3):
        single = flying(task, count=1, seed=40 + i, engine=engine)
        np.testing.assert_array_equal(drawn(single)[0], first[i])
        helpers.assert_records(helpers.fly(single, actions[:, i : i + 1]), records, [i])


def test_ranges_change_neither_the_starts_nor_each_other():
    plain = Environment("hover", num_envs=4, seed=3)
    observation = plain.reset()
    environment = flying()
    for name, term in environment.task.observe(environment.snapshot).items():
        np.testing.assert_array_equal(term, observation[name], err_msg=name)
    backwards = flying(ranges=dict(reversed(ranges_of(PAPER).items())))
    np.testing.assert_array_equal(drawn(backwards), drawn(environment))
    # Wind alone leaves the one row of parameters that all share.
    windy = flying(ranges={"wind": WIND})
    assert len(windy.engine.parameters) == 1 and np.ptp(windy.engine.air, axis=0).all()


@dataclasses.dataclass(frozen=True)
class Knowing(Hover):
    """Shows what was drawn."""

    true_parameters = True


@pytest.mark.parametrize("restored", [False, True])
def test_a_task_sees_the_specified_aircraft_unless_it_asks_for_the_true_one(restored):
    for task, shown in ((Hover(), False), (Knowing(), True)):
        environment = flying(task)
        if restored:
            saved = environment.save()
            environment = flying(task, seed=77)
            environment.restore(saved)
        for _ in range(2):
            seen, true = environment.snapshot.parameters, environment.engine.parameters
            assert len(np.unique(true["mass"])) == 4
            expected = true["mass"] if shown else np.array([PAPER.mass])
            np.testing.assert_array_equal(seen.mass, expected)
            expected = true["rotor"]["max_speed"][:, :4] if shown else [PAPER.max_speed]
            np.testing.assert_array_equal(seen.rotor.max_speed, expected)
            assert seen.control_timestep == 0.05
            environment.step(np.zeros((4, 4)))
            environment.reset(np.array([1]))


# --------------------------------------------------------------------------------------- refused


def test_starts_and_parameters_are_drawn_from_streams_of_their_own():
    rng, other = (Rng(np.array([5]), np.array([0]), *stream) for stream in ((), (PARAMETERS,)))
    assert not np.intersect1d(rng.uniform(0.0, 1.0, 8), other.uniform(0.0, 1.0, 8)).size
    environment = flying(ranges={"mass": (0.6, 0.7)}, count=1)
    share = (environment.engine.parameters["mass"] - 0.6) / (0.7 - 0.6)
    place = environment._keys, environment._episodes - 1
    np.testing.assert_allclose(share, Rng(*place, PARAMETERS).uniform(0.0, 1.0, 1)[0])


@pytest.mark.parametrize("count", [1, 3])
def test_a_reset_calms_the_air(count):
    environment = flying(ranges=None, count=count)
    environment.engine.air[:] = 2.0
    environment.reset(np.array([0]))
    assert (environment.engine.air[0] == 0).all() and (environment.engine.air[1:] == 2).all()


def test_a_batch_of_equal_aircraft_takes_no_ranges():
    alike = engines.make("mujoco", PAPER, 4, altitude=3.0)
    with pytest.raises(QuadrlError) as caught:
        Environment("hover", engine=alike, ranges={"mass": (0.6, 0.7)})
    assert caught.value.name == "engine"
    Environment("hover", engine=alike, ranges={"wind": (-1.0, 1.0)}).reset()


REFUSED = [  # ranges, name, value, a part of what is allowed
    ({"mas": (1, 2)}, "range", "mas", "did you mean mass?"),
    ({"hover_speed": (1, 2)}, "range", "hover_speed", "mass"),
    ({"mass": 1.0}, "range of mass", 1.0, "a pair"),
    ({"mass": (0.5, 0.6, 0.7)}, "range of mass", (0.5, 0.6, 0.7), "a pair"),
    ({"mass": (0.7, 0.6)}, "range of mass", (0.7, 0.6), "low at most high"),
    ({"wind": ((0, 0, 1), (1, 1, 0))}, "range of wind", ..., "low at most high"),
    ({"wind": ((0, 0), (1, 1))}, "range of wind", (0, 0), "3 numbers"),
    ({"wind": (0, 101)}, "range of wind[0]", 101, "100"),
    ({"mass": (np.nan, 1.0)}, "range of mass[0]", ..., "number"),
    ({"mass": ("a", "b")}, "range of mass[0]", "a", "number"),
    ({"lag_up": (True, 5)}, "range of lag_up[0]", True, "number"),
    ({"mass": (0.0, 0.6)}, "mass", 0.0, "between"),
    ({"thrust_coefficient": (-1e-5, 3e-5)}, "rotor thrust_coefficient", -1e-5, "between"),
    # Hover with twice the mass takes the largest speed; 1.31 kg are more.
    ({"mass": (0.5, 1.31)}, "max_speed of rotor 1", ..., "hover speed"),
    ({"max_speed": (220.0, 300.0)}, "max_speed of rotor 1", 220.0, "225.7"),
    (
        {"mass": (0.5, 1.0), "thrust_coefficient": (2e-5, 4e-5)},
        "max_speed of rotor 1",
        ...,
        "hover",
    ),
    ({"lag_down": (5.0, 101.0)}, "physics_timestep", 0.01, "0.0099"),
    ({"moment_coefficient": (1e-4, 0.1)}, "physics_timestep", 0.01, "0.006"),
    ({"mass": {0.5, 0.6}}, "range of mass", {0.5, 0.6}, "pair"),
    ({"wind": (-50, 50), "drag_coefficient": (0.1, 0.5)}, "fastest wind [m/s]", ..., "0 and 65"),
    # Each end alone can hover; one rotor that turns the aircraft far more than the others cannot.
    (
        {"thrust_coefficient": (2e-5, 4.2e-5), "torque_coefficient": (2e-7, 2e-6)},
        "ranges",
        ...,
        "narrow",
    ),
    # J_z of 0.015 is possible with 7.5e-3 twice, but not with 7e-3.
    ({"inertia": ((7e-3, 7e-3, 1e-2), (8e-3, 8e-3, 1.5e-2))}, "range of inertia", ..., "sum"),
]


@pytest.mark.parametrize(("ranges", "name", "value", "allowed"), REFUSED)
def test_a_range_that_holds_what_cannot_be_is_refused(ranges, name, value, allowed):
    with pytest.raises(QuadrlError) as caught:
        Environment("hover", ranges=ranges)
    error = caught.value
    assert error.name == name and allowed in error.allowed
    assert value is ... or error.value == value
