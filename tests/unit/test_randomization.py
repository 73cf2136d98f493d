"""What disturbs a flight: late commands, errors of the estimate, pushes; and whose they are."""

import dataclasses
import math

import helpers
import numpy as np
import pytest
from test_sensors import WILD as EVERY_SENSOR

from quadrl import tasks
from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.philox import LINK, NOISE, PARAMETERS, PUSHES, uniform_array_api
from quadrl.base.rotation import norm
from quadrl.conditions.observing import Observing
from quadrl.conditions.randomization import Errors, Pushes, Randomization
from quadrl.conditions.randomizations import RANDOMIZATIONS
from quadrl.conditions.sampler import AircraftSampler
from quadrl.control import CONTROL_MODES
from quadrl.core.environment import Environment
from quadrl.engines.mujoco import BatchEngine
from quadrl.engines.rng import uniform

ENGINES = ("mujoco", "free_flight")
PAPER = Vehicle()
SEEN = EVERY_SENSOR | {"rotor_speed": "estimated", "privileged": True}
WILD = dataclasses.replace(
    RANDOMIZATIONS["full"],
    observation_delay=(0.0, 0.1),
    rate_delay=(0.0, 0.02),
    pushes=Pushes(rate=5.0, velocity=0.3, body_rate=0.5),
)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("mode", CONTROL_MODES)
def test_row_i_is_disturbed_as_the_single_aircraft_of_seed_plus_i(engine, mode):
    # Landings begin at rest, so in trim with the mean wind of each.
    task = tasks.make("landing" if engine == "free_flight" else "hover", time_limit=0.4)
    vehicle = VEHICLES["hexa" if mode == "rotor" else "paper"]
    settings = {"engine": engine, "control_mode": mode, "weather": "light", "vehicle": vehicle}
    wild = dataclasses.replace(WILD, observation_delay=(0.0, 2 * vehicle.control_timestep))
    settings |= {"randomization": wild, "observe": SEEN}
    size = Environment(task, **settings).action_size
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 3, size))
    whole = helpers.flying(task, count=3, seed=40, **settings)
    whole.reset(np.array([1]))
    drawn, records = whole.randomizer.drawn, helpers.fly(whole, actions)
    told = whole.privileged
    for i in range(3):
        single = helpers.flying(task, count=1, seed=40 + i, **settings)
        if i == 1:
            single.reset()
        np.testing.assert_array_equal(single.randomizer.drawn[0], drawn[i])
        helpers.assert_records(helpers.fly(single, actions[:, i : i + 1]), records, [i])
        np.testing.assert_array_equal(single.privileged[0], told[i])


def test_none_is_the_usual_flight_and_remembers_nothing():
    for given in (None, "none", {}, {"mass": 1.0}, Randomization()):
        environment = helpers.begun("hover", 2, randomization=given, observe=Observing())
        assert environment.observer is None and environment.privileged is None
        assert not environment.randomizer.active
        assert not any(name.startswith("disturbances") for name in environment.save())


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("drawn", "dead"),  # physics steps of 0.01 s, 5 in a control step
    [(1, 0), (3, 0), (5, 0), (12, 0), (0, 1), (0, 3), (0, 5), (0, 7), (2, 5), (3, 1)],
)
def test_commands_arrive_so_many_physics_steps_late(engine, drawn, dead):
    late, vehicle = drawn + dead, dataclasses.replace(PAPER, dead_time=dead / 100)
    given = {"command_delay": drawn / 100} if drawn else None
    environment = helpers.begun("hover", 3, engine=engine, vehicle=vehicle, randomization=given)
    other = BatchEngine(PAPER, 3, altitude=3.0, engine=engine)
    for field in ("qpos", "qvel", "act"):
        getattr(other, field)[:] = getattr(environment.engine, field)
    # Until the first command arrives the rotors keep their speed.
    commands = [np.array(other.act)] * late
    for action in helpers.random_actions(6, 3):
        commands += [PAPER.rotor_command(action)] * 5
        environment.step(action)
        for _ in range(5):
            other.ctrl[:] = commands.pop(0)
            other.advance(1)
        np.testing.assert_array_equal(
            helpers.coordinates(environment.engine), helpers.coordinates(other)
        )


@pytest.mark.parametrize(("drawn", "dead"), [(7, 0), (0, 3), (4, 3)])
@pytest.mark.parametrize("kind", ["thrust_body_rate", "velocity", "position"])
def test_the_commands_of_loops_are_late_too(kind, drawn, dead):
    late, vehicle = drawn + dead, dataclasses.replace(PAPER, dead_time=dead / 100)
    given = {"control_mode": kind, "randomization": {"command_delay": drawn / 100}}
    environment = helpers.begun("hover", 2, vehicle=vehicle, **given)
    pilot, asked, given = environment.autopilot, [], []
    asked += [np.array(environment.engine.act)] * late
    command = pilot.command
    pilot.command = lambda: asked.append(command().copy()) or asked[-1]
    advance = environment.engine.advance
    environment.engine.advance = lambda n: (
        given.append(environment.engine.ctrl.copy()) or advance(n)
    )
    for action in helpers.random_actions(4, 2, environment.action_size):
        environment.step(action)
    assert len(given) == 20
    np.testing.assert_array_equal(given, asked[:20])


@pytest.mark.parametrize("engine", ENGINES)
def test_a_dead_time_is_saved_and_held_as_if_each_step_had_its_command(engine):
    vehicle = dataclasses.replace(PAPER, dead_time=0.07)
    one, two = (
        helpers.begun("hover", 2, engine=engine, vehicle=vehicle, randomization=given)
        for given in (None, {"command_delay": (0.0, 0.04)})
    )
    # A delay that is drawn gives each physics step its own command; here it draws nothing.
    two.randomizer._delay[:] = 7
    for k, action in enumerate(helpers.random_actions(12, 2)):
        if k == 6:
            saved = one.save()
            one = Environment("hover", num_envs=2, engine=engine, vehicle=vehicle)
            one.restore(saved)
        one.step(action), two.step(action)
        np.testing.assert_array_equal(*(helpers.coordinates(e.engine) for e in (one, two)))
    assert one.randomizer.held == [2, 1, 3, 2, 1] and two.randomizer.held == [1] * 5


def test_each_row_has_a_delay_of_its_own():
    environment = helpers.begun("hover", 50, randomization={"command_delay": (0.01, 0.04)})
    drawn = environment.randomizer.shown()["command_delay"]
    environment.step(np.full((50, 4), 0.5))
    moved = np.abs(environment.engine.act - PAPER.hover_speed[0]).max(axis=1)
    earlier = drawn[:, None] < drawn[None] - 1e-9
    assert (moved[:, None] > moved[None])[earlier].all()


LOST = {"command_loss": (0.5, 2.0), "loss_time": (0.1, 0.3), "command_jitter": (0.1, 0.9)}


@pytest.mark.slow
@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("mode", CONTROL_MODES)
def test_commands_that_are_always_a_step_late_are_a_delay_of_one_step(mode, engine, compiled):
    vehicle = VEHICLES["hexa" if mode == "rotor" else "paper"]
    task = helpers.variant(tasks.TASKS["hover"], compiled=compiled)
    step, spread, records = vehicle.control_timestep, 3 * vehicle.physics_timestep, []
    for jitter, later in ((1.0, 0.0), (0.0, step)):
        given = {"command_delay": (later, later + spread), "command_jitter": jitter}
        flown = {"control_mode": mode, "vehicle": vehicle, "engine": engine}
        flown |= {"observe": {"action_history": 2}}
        environment = helpers.begun(task, 4, randomization=given, **flown)
        assert bool(environment.not_compiled) != compiled
        actions = helpers.random_actions(30, 4, environment.action_size)
        records.append(helpers.fly(environment, actions))
    late, expected = records
    helpers.assert_records(late, expected)
    # What was sent is seen, not what flew.
    sent = late[1]["observation.action_history"]
    np.testing.assert_array_equal(
        sent, np.clip(actions[1::-1].swapaxes(0, 1).reshape(4, -1), -1, 1)
    )


def test_links_change_nothing_else_and_no_chance_is_none():
    given = {"randomization": WILD, "observe": SEEN, "weather": "light"}
    drawn = dataclasses.replace(WILD, loss_time=0.1, command_jitter=0.0, command_loss=0.0)
    actions = helpers.random_actions(20, 3)
    usual, same = (helpers.begun("hover", 3, **given | r) for r in ({}, {"randomization": drawn}))
    helpers.assert_records(helpers.fly(same, actions), helpers.fly(usual, actions))
    drawn = dataclasses.replace(WILD, **LOST)
    other = helpers.begun("hover", 3, **given | {"randomization": drawn})
    for name in usual.randomizer.sampler.names[: -len(LOST)]:
        np.testing.assert_array_equal(usual.randomizer.column(name), other.randomizer.column(name))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("mode", ["rotor", "velocity"])
def test_the_last_command_stays_in_force_in_an_outage(engine, mode):
    given = {"command_loss": 2.0, "loss_time": 0.15, "command_jitter": 0.5, "command_delay": 0.02}
    given = {"engine": engine, "control_mode": mode, "randomization": given}
    environment = helpers.begun("hover", 4, **given, seed=1)
    other = BatchEngine(PAPER, 4, altitude=3.0, engine=engine)
    for field in ("qpos", "qvel", "act"):
        getattr(other, field)[:] = getattr(environment.engine, field)
    asked = [np.array(other.act)] * 7  # the longest delay: two physics steps and a control step
    pilot, last, rows = environment.autopilot, np.array(other.act), np.arange(4)
    if pilot:
        command = pilot.command
        pilot.command = lambda: asked.append(command().copy()) or asked[-1]
        environment.step = lambda action: (
            [environment.begin(action)]
            + [environment.engine.advance(steps) for steps in environment.commands()]
        )  # as engines of one's own are flown
    lost = np.zeros((20, 4), bool)
    for k, action in enumerate(helpers.random_actions(20, 4)):
        keys, episodes = environment.randomizer.place
        # A block of four numbers for each control step: the first says whether it is late.
        share = uniform(keys, episodes, LINK, 4 * k, 1)[:, 0]
        if not pilot:
            asked += [PAPER.rotor_command(action)] * 5
        environment.step(action)
        lost[k] = environment.randomizer.left > 0
        delay = 2 + 5 * (share < 0.5)
        for step in range(5):
            arrives = np.array(asked)[7 + 5 * k + step - delay, rows]
            other.ctrl[:] = last = np.where(lost[k][:, None], last, arrives)
            other.advance(1)
        if pilot:
            environment.finish()
        found = helpers.coordinates(environment.engine), helpers.coordinates(other)
        np.testing.assert_array_equal(*found)
    begun = np.diff(np.vstack([np.zeros((1, 4)), lost]), axis=0) > 0
    for row in range(4):  # of three control steps each, or of more that follow at once
        for first in np.flatnonzero(begun[:, row]):
            assert lost[first : first + 3, row].all()
    assert 3 < begun.sum() and not lost.all()


def test_links_are_lost_as_often_and_as_long_as_is_asked_for():
    given = {"command_loss": 1.0, "loss_time": 0.2, "command_jitter": 0.3}
    environment = helpers.begun("hover", 400, randomization=given, engine="free_flight")
    found = []
    for _ in range(200):
        helpers.idle(environment)
        source = environment.randomizer
        found.append((source.left > 0, source.left == 4, source._delay == 5))
    lost, begun, late = np.mean(found, axis=(0, 2))
    # 80,000 steps of 50 ms: 4,000 outages of four steps, as regular as geometric gaps let them be.
    assert lost == pytest.approx(0.2, abs=0.01) and begun == pytest.approx(0.05, abs=0.0025)
    assert late == pytest.approx(0.3, abs=5 * math.sqrt(0.3 * 0.7 / 80_000))
    drawn = helpers.begun("hover", 200, randomization=LOST).randomizer.shown()
    assert set(np.round(drawn["loss_time"] / 0.05).astype(int)) == {2, 3, 4, 5, 6}
    for name in ("command_loss", "command_jitter"):
        low, high = LOST[name]
        assert low <= drawn[name].min() < low + 0.05 < high - 0.05 < drawn[name].max() < high


@pytest.mark.parametrize("engine", ENGINES)
def test_an_outage_is_saved_and_goes_on(engine):
    given = {"command_loss": 2.0, "loss_time": 0.4, "command_jitter": 0.5}
    given = {"engine": engine, "randomization": given, "num_envs": 3}
    one, other = (Environment("hover", seed=seed, **given) for seed in (2, 7))
    one.reset()
    actions, within = helpers.random_actions(40, 3), 0
    for k, action in enumerate(actions):
        saved, left = one.save(), one.randomizer.left
        if ((left > 1) & (left < 8)).any():
            within += 1
            other.restore(saved)
            ahead = actions[k : k + 9]
            helpers.assert_records(helpers.fly(other, ahead), helpers.fly(one, ahead))
            one.restore(saved)
        one.step(action)
    assert within > 3
    for left in (-1, 9):
        with helpers.refused("randomizer.left", lists="the same randomization"):
            other.restore(saved | {"randomizer.left": np.full(3, left)})


def test_impossible_links_are_refused():
    for name, wrong in (("command_jitter", 1.5), ("command_jitter", (-0.1, 0.5))):
        with helpers.refused(lists="between 0 and 1", match=name):
            Randomization(**{name: wrong})
    for name in ("command_loss", "loss_time"):
        with helpers.refused(match=rf"^{name}\[0\] = -0.1"):
            Randomization(**{name: (-0.1, 0.2)})
    with helpers.refused("command_loss", lists="at most 5 a second", match="never be there"):
        Randomization(command_loss=(0.0, 6.0))
    with helpers.refused("loss_time", lists="a whole number of control steps of 0.05 s"):
        Environment("hover", randomization={"command_loss": 1.0, "loss_time": 0.12})
    assert Environment("hover", randomization={"loss_time": 0.12}).randomizer.late is False


SIZES = Errors(position=0.01, attitude=0.02, velocity=0.03, body_rate=0.04)


def angles(environment):
    """Error of the estimated attitude about the axes of the body (N, 3) [rad]."""
    seen, true = environment.observer.estimate, environment.engine.state
    np.testing.assert_allclose(norm(seen.quaternion), 1.0, rtol=1e-12)
    turn = np.swapaxes(true.rotation, -1, -2) @ seen.rotation  # I + [angles]x
    return np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0],
                     turn[:, 1, 0] - turn[:, 0, 1]], axis=-1) / 2  # fmt: skip


def test_the_noise_is_the_definition_and_the_bias_lasts():
    bias = Errors(position=0.1, attitude=0.05, velocity=0.2, body_rate=0.3)
    given = Randomization(noise=SIZES, bias=bias)
    environment = helpers.begun("hover", 100, seed=2**40, randomization=given)
    for step in range(4):
        keys, episodes = environment.randomizer.place
        words = uniform_array_api(keys, episodes, NOISE, 24 * step, 24) * 2.0**32
        halves = np.floor(words / 65536) + words % 65536
        normal = (halves[:, ::2] + halves[:, 1::2] - 131070) * (math.sqrt(3) / 65536)
        shown = environment.randomizer.shown()
        lasting = np.stack([shown[f"{k}_bias_{axis}"] for k in vars(bias) for axis in "xyz"], 1)
        expected = lasting + SIZES.sizes * normal
        seen, engine = environment.observer.estimate, environment.engine
        position = engine.qpos[:, :3] + expected[:, :3] - engine.origin
        np.testing.assert_array_equal(seen.position, position)
        np.testing.assert_array_equal(seen.velocity, engine.qvel[:, :3] + expected[:, 6:9])
        np.testing.assert_array_equal(seen.body_rate, engine.qvel[:, 3:] + expected[:, 9:])
        # Angles of 0.1 rad are known to a few parts in a thousand.
        np.testing.assert_allclose(angles(environment), expected[:, 3:6], rtol=0.01, atol=1e-4)
        helpers.idle(environment)
    # Sums of four uniform numbers: 3.5 deviations at most.
    assert abs(normal.std() - 1) < 5 / math.sqrt(2400) and np.abs(normal).max() < 3.5
    assert (np.abs(lasting) <= bias.sizes).all()
    assert (np.ptp(lasting, axis=0) > 1.8 * bias.sizes).all()
    environment.reset()
    assert (environment.randomizer.shown()["position_bias_x"] != lasting[:, 0]).all()


@pytest.mark.parametrize("compiled", [True, False])
def test_reward_end_and_success_are_those_of_the_true_state(compiled):
    task = helpers.SHORT["static_waypoint"]
    kind = type("Written", (type(task),), {"compiled": compiled})
    task = kind(**{field.name: getattr(task, field.name) for field in dataclasses.fields(task)})
    plain = helpers.flying(task, randomization=None)
    noisy = helpers.flying(task, randomization={"noise": SIZES, "bias": SIZES})
    assert bool(noisy.not_compiled) != compiled
    for action in helpers.random_actions(15, 4):
        expected, found = plain.step(action), noisy.step(action)
        for name in ("reward", "error", "terminated", "truncated", "is_success", "diverged"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        for name, term in expected.observation.items():
            np.testing.assert_array_equal(found.truth[name], term)
            if name != "rotor_speed":
                assert (found.observation[name] != term).any(axis=1).all(), name
        over = expected.terminated | expected.truncated
        if over.any():
            plain.reset(over), noisy.reset(over)


def test_the_goal_is_seen_from_where_the_estimate_is():
    environment = helpers.begun("hover", 50, randomization={"noise": {"position": 0.1}})
    seen = helpers.idle(environment).observation
    state = environment.engine.state
    to_goal = np.einsum("nij,nj->ni", state.rotation, seen["goal"])
    np.testing.assert_allclose(seen["position"] + to_goal, 0.0, atol=1e-12)  # the goal of hover
    assert np.abs(seen["position"] - state.position).max() > 0.1
    # What has no error is seen as it is, to the last bit.
    estimate = environment.observer.estimate
    np.testing.assert_array_equal(estimate.quaternion, state.quaternion)


@pytest.mark.parametrize("engine", ENGINES)
def test_the_pushes_are_the_definition(engine):
    # Eight numbers a control step: whether it hits, two directions by height and heading.
    pushes = Pushes(rate=20.0, velocity=0.5, body_rate=1.0)
    environment = helpers.begun(
        "hover", 20, seed=2**40, engine=engine, randomization={"pushes": pushes}
    )
    disturbances, qvel, hits = environment.randomizer, environment.engine.qvel, 0
    for step in range(5):
        keys, episodes = disturbances.place
        u = uniform_array_api(keys, episodes, PUSHES, 8 * step, 8)
        expected = qvel.copy()
        for first, share, turn, size in ((0, 1, 2, 0.5), (3, 3, 4, 1.0)):
            height, heading = 2 * u[:, share] - 1, 2 * math.pi * u[:, turn]
            level = np.sqrt(1 - height**2)
            way = np.stack([level * np.cos(heading), level * np.sin(heading), height], axis=1)
            hit = u[:, 0] < 1 - math.exp(-20.0 * PAPER.control_timestep)
            expected[:, first : first + 3] += size * hit[:, None] * way
        disturbances.act()
        np.testing.assert_allclose(qvel, expected, rtol=0, atol=1e-14)
        hits += hit.sum()
    assert 20 < hits < 80  # of 100, with a chance of 0.63


def test_what_diverges_is_counted_and_seen_finite_however_late():
    # A racer resolves 25 rad/s or so; pushes of 20 rad/s in the same direction add up.
    given = {"pushes": Pushes(rate=1e9, velocity=5.0, body_rate=20.0)}
    given |= {"observation_delay": 0.03, "rate_delay": 0.01}
    environment = helpers.begun("hover", 50, vehicle="racer", randomization=given)
    diverged = 0
    for _ in range(20):
        now = helpers.idle(environment)
        assert all(np.isfinite(part).all() for part in (now.reward, *now.observation.values()))
        assert (now.terminated >= now.diverged).all()
        diverged += now.diverged.sum()
    assert diverged


def test_the_flapping_is_drawn_apart_from_all_else():
    vehicle = VEHICLES["crazyflie_brushless"]
    tables = []
    for flapping in ((1.0, 1.0), (0.0, 1.2)):
        sampler = AircraftSampler(Randomization(mass=(0.8, 1.2), flapping=flapping), vehicle)
        keys, numbers = np.arange(2000), len(sampler.names)
        shares = uniform(keys, 0 * keys, PARAMETERS, 0, numbers)
        tables.append(sampler.table(sampler.sample(shares)))
    usual, drawn = tables
    factor = drawn["flapping_moment"] / usual["flapping_moment"]
    assert 0.0 <= factor.min() < 0.01 and 1.19 < factor.max() <= 1.2
    others = [name for name in usual.dtype.names if name != "flapping_moment"]
    np.testing.assert_array_equal(drawn[others], usual[others])
