"""Parameters and wind of each row: drawn, flown, shown, saved, and refused."""

import dataclasses

import helpers
import mujoco
import numpy as np
import pytest
from helpers import EVERYTHING, drawn, flying

from quadrl import tasks
from quadrl.aircraft import parameters
from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import PARAMETERS
from quadrl.conditions import sampler
from quadrl.conditions.randomization import FACTORS
from quadrl.conditions.sampler import EACH_ROTOR, AircraftSampler, vehicle_of
from quadrl.control.feasibility import Reach
from quadrl.core.environment import Environment
from quadrl.engines import mjcf
from quadrl.engines import mujoco as engines
from quadrl.engines.mujoco import BatchEngine, DataEngine
from quadrl.engines.rng import Rng
from quadrl.tasks.hover import Hover

ENGINES = ("mujoco", "free_flight")
PAPER = Vehicle()


LOW = tasks.make("landing", start_height=0.03)  # [m] over where it stands


def by_itself(vehicle, task, engine, altitude):
    """One aircraft in the complete model, and in a batch of its own."""
    model = mjcf.compile_model(vehicle, contact=task.contact)
    settings = dict(altitude=altitude, engine=engine)
    yield DataEngine(vehicle, model, mujoco.MjData(model), **settings)
    lean = mjcf.compile_model(vehicle, contact=task.contact, drawn=False)
    yield BatchEngine(vehicle, 1, model=lean, **settings)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", ["paper", "hexa"])
@pytest.mark.parametrize("task", [tasks.make("hover"), LOW], ids=lambda task: task.name)
def test_a_row_flies_as_the_aircraft_that_is_built_with_its_numbers(task, name, engine):
    vehicle = VEHICLES[name]
    # What can touch stays where it is when the centre of mass moves.
    shift = 0.0 if task is LOW else EVERYTHING.centre_of_mass
    randomization = dataclasses.replace(EVERYTHING, centre_of_mass=shift)
    environment = flying(task, vehicle=vehicle, engine=engine, randomization=randomization)
    copies = []
    for i, row in enumerate(environment.engine.parameters):
        own = vehicle_of(vehicle, row)
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


@pytest.mark.parametrize(("column", "resolved"), [(5, "resolved_turn"), (0, "resolved_speed")])
def test_a_row_diverges_past_its_own_limit(column, resolved):
    # J / (2 k_M dt) from 417 rad/s down, but 50 at most; m / (2 k_D dt) from 3611 m/s down.
    engine = flying(count=8, randomization={"drag": (9.0, 50.0)}).engine
    limit = engine.parameters[resolved]
    assert np.ptp(limit) > 0.3 * limit.max()
    for row in range(8):  # alone, so that the limit of no other row finds it out
        engine.qvel[:], engine.qvel[row, column] = 0.0, 0.99 * limit[row]
        assert engine.read() is None
        engine.qvel[row, column] = 1.01 * limit[row]
        np.testing.assert_array_equal(engine.read(), np.arange(8) == row)


def test_the_fields_of_a_row_are_those_that_mujoco_compiles():
    names = ("body_mass", "body_subtreemass", "body_inertia", "body_invweight0", "body_user")
    names += ("dof_M0", "dof_invweight0", "actuator_gear", "actuator_ctrlrange", "site_pos")
    # What is drawn and what can touch keep their size when the centre of mass moves.
    for shift, compared in ((0.0, names), (0.002, ("site_pos", "body_mass"))):
        drawn = dataclasses.replace(EVERYTHING, centre_of_mass=shift)
        engine = flying(randomization=drawn).engine
        for name in compared:
            for row, field in zip(engine.parameters, engine.batch.expand(name), strict=True):
                model = mjcf.compile_model(vehicle_of(PAPER, row), drawn=False)
                np.testing.assert_allclose(field, getattr(model, name), rtol=1e-14, err_msg=name)


def test_what_is_drawn_lies_in_its_range_and_differs_by_rotor_row_and_episode():
    environment = flying(count=200)
    shown, table = environment.randomizer.shown(), environment.engine.parameters.copy()
    ends = {name: getattr(EVERYTHING, name) for name in FACTORS}
    ends |= {f"{name}_{k}": EVERYTHING.rotors for name in EACH_ROTOR for k in range(1, 5)}
    ends |= {f"centre_of_mass_{axis}": (-0.002, 0.002) for axis in "xyz"}
    assert shown.keys() == ends.keys()
    for name, (low, high) in ends.items():
        assert (shown[name] >= low).all() and (shown[name] <= high).all()
        assert np.ptp(shown[name]) > 0.9 * (high - low), name
    # No number follows another: |r| stays under 5 standard deviations of 1 / sqrt(200).
    related = np.corrcoef([*shown.values()])
    assert np.abs(related - np.eye(len(related))).max() < 5 / np.sqrt(200)
    rotor = table["rotor"][:, :4]
    own = {name: np.stack([shown[f"{name}_{k}"] for k in range(1, 5)], 1) for name in EACH_ROTOR}
    whole = {name: shown[name][:, None] for name in FACTORS}
    place = np.stack([shown[f"centre_of_mass_{axis}"] for axis in "xyz"], 1)
    first = PAPER.rotors[0]
    for found, expected in (
        (table["mass"], 0.65 * shown["mass"]),
        (table["inertia"], PAPER.inertia * whole["inertia"]),
        (table["drag_coefficient"], 9e-3 * shown["drag"]),
        (table["moment_coefficient"], 9e-4 * shown["drag"]),
        (table["blade_lift"], PAPER.aerodynamics.blade_lift * shown["inflow"]),
        (rotor["thrust_coefficient"], 3.13e-5 * whole["thrust"] * own["thrust"]),
        (rotor["torque_coefficient"], 7.5e-7 * whole["torque"] * own["torque"]),
        (1 / rotor["lag_up"], 0.18 * whole["lag"] * own["lag"]),
        (1 / rotor["lag_down"], 0.18 * whole["lag"] * own["lag"]),
        (rotor["max_speed"], first.max_speed * np.tile(whole["max_speed"], 4)),
        (rotor["position"][:, 0], np.array(first.position) - place),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)
    first = drawn(environment)
    environment.reset()
    assert (drawn(environment) != first).any(axis=1).all()


def test_what_is_drawn_changes_neither_the_starts_nor_each_other():
    plain = Environment("hover", num_envs=4, seed=3)
    observation = plain.reset()
    environment = flying()
    for name, term in environment.task.observe(environment.snapshot).items():
        np.testing.assert_array_equal(term, observation[name], err_msg=name)
    light = flying(randomization={"mass": EVERYTHING.mass, "command_delay": (0.0, 0.1)})
    np.testing.assert_array_equal(
        light.engine.parameters["mass"], environment.engine.parameters["mass"]
    )
    # What is not of the aircraft leaves the one row of parameters that all share.
    assert len(flying(randomization={"command_delay": 0.02}).engine.parameters) == 1


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


def test_starts_and_parameters_are_drawn_from_streams_of_their_own():
    rng, other = (Rng(np.array([5]), np.array([0]), *stream) for stream in ((), (PARAMETERS,)))
    assert not np.intersect1d(rng.uniform(0.0, 1.0, 8), other.uniform(0.0, 1.0, 8)).size
    environment = flying(randomization={"mass": (0.9, 1.1)}, count=1)
    share = (environment.engine.parameters["mass"] / 0.65 - 0.9) / (1.1 - 0.9)
    place = environment.seeds.keys, environment.seeds.episodes - 1
    np.testing.assert_allclose(share, Rng(*place, PARAMETERS).uniform(0.0, 1.0, 1)[0])


@pytest.mark.parametrize("count", [1, 3])
def test_a_reset_calms_the_air(count):
    environment = flying(randomization=None, count=count)
    environment.engine.wind[:] = 2.0
    environment.reset(np.array([0]))
    assert (environment.engine.wind[0] == 0).all() and (environment.engine.wind[1:] == 2).all()


def test_a_batch_of_equal_aircraft_draws_no_parameters():
    alike = engines.make("mujoco", PAPER, mjcf.compile_model(PAPER, drawn=False), 4, altitude=3.0)
    with helpers.refused("engine"):
        Environment("hover", engine=alike, randomization={"mass": (0.9, 1.1)})
    Environment("hover", engine=alike, randomization={"command_delay": 0.02}).reset()


def test_each_axis_has_a_factor_of_its_own_of_which_there_is_a_body():
    given = {"inertia": (0.8, 1.0), "inertia_axes": (0.9, 1.1), "rotor_inertia": (0.5, 1.5)}
    given |= {"inflow": (0.5, 1.5)}
    environment = flying(randomization=given, count=500, aerodynamics="full")
    table, shown = environment.engine.parameters, environment.randomizer.shown()
    np.testing.assert_allclose(table["translational_lift"], 0.0566 * shown["inflow"], rtol=1e-14)
    axes = np.stack([shown[f"inertia_axes_{axis}"] for axis in "xyz"], axis=1)
    wanted = np.array(PAPER.inertia) * shown["inertia"][:, None] * axes
    rest = wanted.sum(axis=1, keepdims=True) - wanted
    np.testing.assert_allclose(table["inertia"], np.minimum(wanted, rest), rtol=1e-14)
    assert (wanted > rest).any()  # z of the paper's is 1.3 of a possible 1.5
    np.testing.assert_allclose(table["rotor_inertia"], 6e-5 * shown["rotor_inertia"])
    assert np.ptp(axes, axis=0).min() > 0.97 * 0.2 and np.ptp(shown["rotor_inertia"]) > 0.97
    for vehicle in VEHICLES.values():
        heavy = AircraftSampler({"inertia_axes": (0.5, 2.0)}, vehicle)
        inertia = heavy.table(heavy.sample(np.random.default_rng(0).random((99, len(heavy.names)))))
        assert (2 * inertia["inertia"] <= inertia["inertia"].sum(1)[:, None] * (1 + 1e-12)).all()


WEIGHT = 0.65 * 9.81  # [N], and the arm of 0.23 m


@pytest.mark.parametrize("engine", ["mujoco", "free_flight"])
def test_a_steady_force_and_moment_accelerate_by_what_they_are(engine):
    given = {"force": 0.05, "moment": 0.002}
    environment = flying(randomization=given, count=200, engine=engine)
    shown, table = environment.randomizer.shown(), environment.engine.parameters
    force, moment = (np.stack([shown[f"{k}_{n}"] for n in "xyz"], axis=1) for k in given)
    np.testing.assert_allclose(table["steady_force"], WEIGHT * force, rtol=1e-14)
    np.testing.assert_allclose(table["steady_moment"], WEIGHT * 0.23 * moment, rtol=1e-14)
    for shares, size in ((force, 0.05), (moment, 0.002)):
        assert np.abs(shares).max() <= size and (np.ptp(shares, axis=0) > 1.9 * size).all()
    # Level and at rest with rotors at hover speed, a physics step of 0.01 s.
    flown = environment.engine
    flown.qpos[:, 3:], flown.qvel[:] = (1.0, 0.0, 0.0, 0.0), 0.0
    flown.act[:] = flown.ctrl[:] = PAPER.hover_speed
    flown.advance(1)
    np.testing.assert_allclose(flown.qvel[:, :3], 9.81 * force * 0.01, rtol=1e-3, atol=1e-6)
    expected = WEIGHT * 0.23 * moment / PAPER.inertia * 0.01
    np.testing.assert_allclose(flown.qvel[:, 3:], expected, rtol=1e-3, atol=1e-5)


def test_hover_holds_the_steady_force_and_moment():
    randomization = {"force": 0.05, "moment": 0.002, "mass": (0.9, 1.1)}
    environment = flying(randomization=randomization, count=20)
    table = environment.engine.parameters
    wrench = (PAPER.mixer @ table["rotor"]["hover_speed"][:, :4, None] ** 2)[..., 0]
    up = np.array([0, 0, 9.81]) * table["mass"][:, None] - table["steady_force"]
    np.testing.assert_allclose(wrench[:, 0], np.linalg.norm(up, axis=1), rtol=1e-12)
    np.testing.assert_allclose(wrench[:, 1:], -table["steady_moment"], atol=1e-12)
    # What rotors can give counts it: the load that is held is over weight and force together.
    plain = np.repeat(parameters.rows(PAPER), 1)
    pulled = plain.copy()
    pulled["steady_force"][:, 2] = -0.2 * WEIGHT
    least, most = Reach(PAPER, plain).loads(35.0)
    low, high = Reach(PAPER, pulled).loads(35.0)
    np.testing.assert_allclose([low, high], [least / 1.2, most / 1.2], rtol=1e-12)
    pulled["steady_moment"][:, 2] = 0.9 * 4 * 7.5e-7 * 225.678 * 35.0  # most of what turns it
    assert Reach(PAPER, pulled).loads(35.0)[1] < high


def test_corners_are_drawn_as_often_as_is_asked_for():
    given = {"lag": (0.5, 2.5), "command_delay": (0.0, 0.07)}
    plain = AircraftSampler(given, PAPER)
    shares = np.random.default_rng(0).random((4000, len(plain.names)))

    def drawn(corners):
        sampler = AircraftSampler({**given, "corners": corners}, PAPER)
        numbers = sampler.sample(shares)
        lag, late = (sampler.columns(numbers, k)[:, 0] for k in given)
        return numbers, (lag >= 2.0) & (late >= 0.06 - 1e-9), sampler.columns(numbers, "corner")

    for corners in (0.0, 0.3, 1.0):
        numbers, slow, corner = drawn(corners)
        # An even draw gives a sixteenth, 8 delays of which 2 are in the upper quarter.
        expected = corners + (1 - corners) / 16
        assert abs(slow.mean() - expected) < 5 * np.sqrt(0.25 / 4000), corners
        assert slow[corner[:, 0] == 1].all() and abs(corner.mean() - corners) < 0.04
    numbers, _, corner = drawn(0.3)
    usual = plain.sample(shares)
    others = [k for k, n in enumerate(plain.names) if n not in (*given, "corner")]
    np.testing.assert_array_equal(numbers[:, others], usual[:, others])
    same = corner[:, 0] == 0
    np.testing.assert_array_equal(numbers[same], usual[same])


REFUSED = [  # randomization, name, value, a part of what is allowed
    ("heavy", "randomization", "heavy", "light, full"),
    (5, "randomization", 5, "mapping"),
    ([("mass", (1, 2))], "randomization", ..., "mapping"),
    ({"mas": (1, 2)}, "field of randomization", "mas", "did you mean mass?"),
    ({"noise": {"speed": 1.0}}, "field of noise", "speed", "velocity"),
    ({"noise": 0.1}, "noise", 0.1, "Errors"),
    ({"mass": (0.5, 0.6, 0.7)}, "mass", (0.5, 0.6, 0.7), "2 numbers"),
    ({"mass": (0.7, 0.6)}, "mass", (0.7, 0.6), "low at most high"),
    ({"mass": (np.nan, 1.0)}, "mass[0]", ..., "number"),
    ({"mass": (0.0, 1.0)}, "mass[0]", 0.0, "between"),
    ({"mass": {0.9, 1.1}}, "mass[0]", {0.9, 1.1}, "between"),
    ({"max_speed": (0.9, 1.1)}, "max_speed[1]", 1.1, "between"),
    ({"force": -0.1}, "force", -0.1, "between"),
    ({"moment": (0.0, 0.1)}, "moment", (0.0, 0.1), "between"),
    # About z the rotors of the paper's give far less than about x and y.
    ({"moment": 0.5}, "moment", 0.5, "of weight times arm"),
    # With 0.97 of the weight on top, 1.97 times it, sideways too: more than twice.
    ({"force": 0.97}, "rotors", ..., "narrower"),
    ({"corners": (0.1, 0.2)}, "corners", (0.1, 0.2), "between 0 and 1"),
    ({"centre_of_mass": -0.01}, "centre_of_mass", -0.01, "between"),
    ({"noise": {"position": -0.1}}, "position", -0.1, "between"),
    ({"bias": {"attitude": np.inf}}, "attitude", np.inf, "between"),
    ({"pushes": {"rate": -1.0}}, "pushes rate", -1.0, "between"),
    ({"observation_delay": 0.075}, "observation_delay", (0.075, 0.075), "0.01 s"),
    ({"rate_delay": (0.0, 0.005)}, "rate_delay", (0.0, 0.005), "a whole number of physics steps"),
    ({"command_delay": (-0.01, 0.0)}, "command_delay[0]", -0.01, "between"),
    # Hover with twice the mass takes the largest speed; 2.01 times is more.
    ({"mass": (0.8, 2.01)}, "max_speed of rotor 1", ..., "hover speed"),
    ({"mass": (0.8, 1.6), "thrust": (0.7, 1.2)}, "max_speed of rotor 1", ..., "hover"),
    # 1 / 0.18 s is 5.6 times a second: 18.5 times as fast is more than 100.
    ({"lag": (0.054, 1.0)}, "physics_timestep", 0.01, "0.0097"),
    ({"drag": (0.1, 99.0)}, "physics_timestep", 0.01, "at most"),
    ({"pushes": {"rate": 1.0, "body_rate": 60.0}}, "pushes body_rate", 60.0, "between"),
    # All alike can hover; one rotor that turns the aircraft far more than the others cannot.
    ({"rotors": (0.6, 1.4)}, "rotors", ..., "narrow"),
    # The rotors stand 23 cm from the centre.
    ({"centre_of_mass": 0.2}, "rotors", ..., "narrow"),
]


@pytest.mark.parametrize(("randomization", "name", "value", "allowed"), REFUSED)
def test_a_randomization_that_holds_what_cannot_be_is_refused(randomization, name, value, allowed):
    with helpers.refused(name, value, lists=allowed):
        Environment("hover", randomization=randomization)


def hovers(vehicle, low, high):
    """Whether aircraft hover with every combination of weak and strong rotors."""
    sampled, count = AircraftSampler("none", vehicle), vehicle.rotor_count
    ends = np.indices((2,) * (2 * count)).reshape(2 * count, -1).T
    drawn = np.tile(sampled.low, (len(ends), 1))
    sampled.columns(drawn, "thrust_1", 2 * count)[:] = np.where(ends, high, low)
    rotor = sampled.table(drawn)["rotor"][:, :count]
    return bool(((rotor["hover_speed"] > 0) & (rotor["hover_speed"] < rotor["max_speed"])).all())


@pytest.mark.parametrize("name", [k for k, v in helpers.LAYOUTS.items() if v.rotor_count < 7])
def test_unlike_rotors_are_refused_if_any_combination_of_them_cannot_hover(name):
    vehicle, refused = helpers.LAYOUTS[name], []
    for width in (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.8):
        ends = (1 - width, 1 + width)
        try:
            AircraftSampler({"rotors": ends}, vehicle)
        except QuadrlError:
            refused.append(width)
        assert hovers(vehicle, *ends) == (width not in refused)
    assert refused


def test_eight_rotors_are_drawn_without_building_every_combination(monkeypatch):
    built, refresh = [], parameters.refresh
    counted = lambda table, step: (built.append(len(table)), refresh(table, step))  # noqa: E731
    monkeypatch.setattr(parameters, "refresh", counted)
    flying(count=3, vehicle=helpers.LAYOUTS["eight"], randomization="light")
    assert sum(built) < 2000  # 4^8 combinations are 65,536


def test_a_drawn_aircraft_that_cannot_hover_is_refused_and_changes_nothing(monkeypatch):
    monkeypatch.setattr(sampler, "EXCHANGES", 0)  # so that it is not found before
    environment = Environment("hover", num_envs=200, seed=0, randomization={"rotors": (0.55, 1.45)})
    with helpers.refused(match="rotors = .* narrower range"):
        environment.reset()
    assert (
        environment.engine.parameters["mass"] == 0.65
    ).all() and not environment.seeds.episodes.any()
