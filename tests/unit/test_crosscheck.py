"""A policy flown by other physics: the same flights where they are quadrl's, refusals where not."""

import contextlib
import dataclasses
import json
import sys
import types
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers import refused
from policies import linear
from scipy.spatial.transform import Rotation

from quadrl import cli
from quadrl.aircraft.presets import VEHICLES, in_real_air
from quadrl.base.errors import QuadrlError
from quadrl.core.scenario import UNDISTURBED
from quadrl.deploy import crosscheck as crosschecking
from quadrl.deploy import simulators
from quadrl.deploy.crosscheck import brakes, crosscheck, fly_in, scaled
from quadrl.deploy.driver import Course, in_order
from quadrl.deploy.manoeuvres import checks, engine_of
from quadrl.deploy.simulators import Simulator, environment_of
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import EVALUATION_SEED, flights, fly

BRUSHLESS = VEHICLES["crazyflie_brushless"]
OWN = engine_of(BRUSHLESS)
NAME = "hover_robust_crazyflie_brushless"


# ------------------------------------------------------------------------------------- the flights
@pytest.mark.parametrize("late", [0.0, 0.05])
def test_quadrls_own_physics_from_elsewhere_give_quadrls_flights(late):
    policy = Policy.pretrained("target_following")
    drawn = {"command_delay": (late, late)} if late else "none"
    scenario = dataclasses.replace(policy.scenario, **UNDISTURBED | {"randomization": drawn})
    calls, own = [], engine_of(scenario.aircraft)

    def advance(motion, command, seconds):
        calls.append(seconds)
        return own(motion, command, seconds)

    found = fly_in(policy, scenario, 6, 3, advance)
    true = flights(
        fly(policy, scenario, episodes=6, seed=EVALUATION_SEED + 3, engine="free_flight")
    )
    # To the bit, over every step of each episode.
    assert np.array_equal(found["failed"], ~true["survived"])
    for name in ("success", "position_error_m", "length_s"):
        assert np.array_equal(found[name], true[name])
    assert len(calls) >= 50


def test_an_aircraft_whose_episode_is_over_is_not_flown():
    policy = linear(22, 4)  # hovers the paper's aircraft, whatever it sees
    rows = []

    def advance(motion, command, seconds):
        rows.append(np.isfinite(command).all(axis=1).sum())
        sinking = motion.copy()
        sinking[0, 2] -= 0.2  # out of the arena within 15 steps
        return sinking

    found = fly_in(policy, policy.scenario, 2, 0, advance)
    assert rows[0] == 2 and rows[-1] == 1 and found["failed"].tolist() == [True, False]


def test_an_aircraft_that_has_touched_something_there_has_failed():
    policy = linear(22, 4)
    motions = []

    def advance(motion, command, seconds):
        motions.append(motion)
        touched = motion.copy()
        touched[1] = np.nan
        return touched

    found = fly_in(policy, policy.scenario, 2, 0, advance)
    assert found["failed"].tolist() == [False, True]
    assert found["length_s"][1] == policy.scenario.vehicle.control_timestep
    assert np.isfinite(motions[-1]).all()


SCENE = """<mujoco><worldbody><body name="drone" mocap="true">
  <geom type="sphere" size="0.09"/>
  <geom name="col_box:0" type="box" size="0.07 0.07 0.02" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>"""


def test_the_box_of_the_aircraft_alone_touches_a_course():
    spec, level = mujoco.MjSpec.from_string(SCENE), [1, 0, 0, 0]
    solids = [("box", [0.01, 0.5, 0.5]), ("cylinder", [0.015, 1.0, 0.0])]
    one, other = [0, 0, 1, *level], [5, 0, 1, *level]
    course = Course(spec, solids, [[one, other], [one, other], [other, one], [one, other]])
    place = np.array([[0.079, 0, 1], [0.081, 0, 1], [0.079, 0, 1], [0.081, 0, 1]])
    turned = [np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)]  # its edge is ahead
    pose = np.array([level, level, level, turned], float)
    assert course.free(np.ones(4, bool), place, pose).tolist() == [False, True, False, False]
    assert course.free(np.array([True, False, True, True]), place + 1, pose)[[0, 1]].tolist() == [
        True,
        False,
    ]


# -------------------------------------------------------------------------------------- the checks
@pytest.mark.parametrize("name", ["paper", "crazyflie", "crazyflie_brushless", "racer"])
def test_nothing_is_wrong_with_quadrl(name):
    vehicle = in_real_air(VEHICLES[name])
    found = checks(vehicle, engine_of(vehicle))
    assert not [one for one in found if one.wrong or one.here != one.there]


def test_numbers_of_the_manoeuvres_are_those_of_physics():
    bare = dataclasses.replace(BRUSHLESS, aerodynamics=VEHICLES["paper"].aerodynamics)
    found = {one.name: one.here for one in checks(bare, engine_of(bare))}
    assert found["hovering [m/s^2]"] == pytest.approx([0.0], abs=1e-9)
    # A rotor 5 % faster lifts by (1.05^2 - 1) k_T Omega^2 more, of which its lag loses a little.
    lift = (1.05**2 - 1) * 9.81 * bare.mass / 4
    roll, pitch, yaw = found["rotor 1 [rad/s^2]"]  # ahead on the right, counter-clockwise
    arm = 0.05 / np.sqrt(2)
    assert roll == pytest.approx(-lift * arm / bare.inertia[0], rel=1e-3)
    assert pitch == pytest.approx(-lift * arm / bare.inertia[1], rel=1e-3)
    assert yaw == pytest.approx(-lift * 5.939e-3 / bare.inertia[2], rel=1e-3)
    assert found["lag up [s]"] == pytest.approx([0.042], rel=1e-4)
    assert found["lag down [s]"] == pytest.approx([0.037], rel=1e-4)
    assert brakes(bare)[0] == pytest.approx(bare.drag_coefficient, rel=0.02)  # at 1 m/s


def changed(**rotor):
    """The aircraft with other numbers of its rotors."""
    rotors = tuple(
        dataclasses.replace(one, **{k: make(one) for k, make in rotor.items()})
        for one in BRUSHLESS.rotors
    )
    return dataclasses.replace(BRUSHLESS, rotors=rotors)


def reordered(motion, command, seconds):
    """A simulator whose first two rotors have changed places."""
    order = np.array([1, 0, 2, 3])
    begun = np.concatenate([motion[:, :13], motion[:, 13 + order]], axis=1)
    end = OWN(begun, command[:, order], seconds)
    return np.concatenate([end[:, :13], end[:, 13 + order]], axis=1)


def flapped_otherwise(motion, command, seconds):
    """A simulator whose flapping moment has the other sign."""
    none = dataclasses.replace(BRUSHLESS.aerodynamics, flapping_moment=0.0)
    still = dataclasses.replace(BRUSHLESS, aerodynamics=none)
    end, without = (engine_of(v)(motion, command, seconds) for v in (BRUSHLESS, still))
    end[:, 10:13] = 2 * without[:, 10:13] - end[:, 10:13]
    return end


def driven(motion, command, seconds):
    """A simulator whose drag drives."""
    end = OWN(motion, command, seconds)
    end[:, 7:9] = 2 * motion[:, 7:9] - end[:, 7:9]
    return end


def through(into, back):
    """A simulator that takes and gives changed motions."""

    def advance(motion, command, seconds):
        return back(OWN(into(motion), command, seconds))

    return advance


def rolled(by):
    return lambda motion: np.concatenate(
        [motion[:, :3], np.roll(motion[:, 3:7], by, axis=1), motion[:, 7:]], axis=1
    )


def conjugate(motion):
    turned = motion.copy()
    turned[:, 4:7] *= -1
    return turned


def rates_in(frame):
    """Body rates turned into the world frame, or back."""

    def turn(motion):
        way = Rotation.from_quat(motion[:, 3:7], scalar_first=True)
        turned = motion.copy()
        turned[:, 10:13] = way.apply(motion[:, 10:13], inverse=frame == "body")
        return turned

    return turn


def downwards(motion):
    other = motion.copy()
    other[:, 9] *= -1
    return other


PLANTED = {
    "another order": (reordered, "rotor 1 [rad/s^2]", "it is another rotor"),
    "spins": (engine_of(changed(spin=lambda r: -r.spin)), "rotor 3 [rad/s^2]", "its spin"),
    "sign of flapping": (flapped_otherwise, "flapping along x [rad/s^2]", "the other sign"),
    "lag as time": (
        engine_of(changed(lag_up=lambda r: 1 / r.lag_up)), "lag up [s]", "a rate was taken",
    ),
    "real part last": (through(rolled(1), rolled(-1)), "turning [1/s]", "order of the quaternion"),
    "world to body": (through(conjugate, conjugate), "tilted [m/s^2]", "turned round"),
    "world rates": (through(rates_in("body"), rates_in("world")), "turning [1/s]", "body rate"),
    "z downwards": (through(downwards, downwards), "way [m/s]", "axes"),
    "no numbers": (lambda *given: np.full((11, 17), np.nan), "hovering [m/s^2]", "weight"),
    "force that drives": (driven, "drag along x [m/s^2]", "the other sign"),
    "thrust": (
        engine_of(changed(thrust_coefficient=lambda r: 1.05 * r.thrust_coefficient)),
        "hovering [m/s^2]", "weight",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", PLANTED)
def test_a_planted_fault_is_found(fault):
    advance, name, words = PLANTED[fault]
    (found,) = (one for one in checks(BRUSHLESS, advance) if one.name == name)
    assert words in found.wrong


def test_an_aircraft_of_a_kind_with_slower_rotors_is_no_fault():
    slower = changed(lag_up=lambda r: r.lag_up / 3, lag_down=lambda r: 2 * r.lag_down)
    assert not any(one.wrong for one in checks(BRUSHLESS, engine_of(slower)))


def test_air_that_a_simulator_lacks_is_no_fault():
    still = dataclasses.replace(BRUSHLESS, aerodynamics=VEHICLES["paper"].aerodynamics)
    found = {one.name: one for one in checks(BRUSHLESS, engine_of(still))}
    assert not any(one.wrong for one in found.values())
    assert abs(found["flapping along y [rad/s^2]"].here[0]) > 20
    assert found["flapping along y [rad/s^2]"].there == [0.0]


def test_rotors_are_matched_by_their_places():
    own = np.array([r.position for r in BRUSHLESS.rotors])
    there = 0.7 * own[[3, 0, 1, 2]]  # begins ahead on the left, as rotorpy's
    assert in_order(own, there).tolist() == [1, 2, 3, 0]


def test_an_aircraft_of_theirs_flies_by_shares_of_the_hover_speed():
    hover = float(np.mean(BRUSHLESS.hover_speed))
    there = types.SimpleNamespace(hover_speed=2 * hover, given=[])

    def advance(motion, command, seconds):
        there.given.append((motion[0, 13:], command[0]))
        return motion

    there.advance = advance
    motion = np.ones((1, 17)) * hover
    end = scaled(there, BRUSHLESS)(motion, np.full((1, 4), hover), 0.01)
    assert np.array_equal(there.given[0], np.full((2, 4), 2 * hover))
    assert np.array_equal(end, motion)


# ------------------------------------------------------------------------------------- the command
class Stub:
    """A simulator with quadrl's own physics, which counts those that are not closed."""

    version, open = "9.9", 0

    def __init__(self, name, python, given):
        self.vehicle = VEHICLES[given["vehicle"]["name"]]
        self.hover_speed = float(np.mean(self.vehicle.hover_speed))
        self.flies = engine_of(self.vehicle)
        Stub.open += 1

    def advance(self, motion, command, seconds):
        end = motion.copy()
        rows = np.isfinite(command).all(axis=1)
        end[rows] = self.flies(motion[rows], command[rows], seconds)
        return end

    def close(self):
        Stub.open -= 1


@pytest.fixture
def stubbed(monkeypatch):
    monkeypatch.setattr(crosschecking, "Simulator", Stub)
    monkeypatch.setattr(crosschecking, "environment_of", lambda name, said: Path(name))


@pytest.mark.slow
def test_a_row_for_each_aircraft_on_time_and_late(stubbed, capsys):
    words = ["crosscheck", NAME, "--simulators", "crazyflow", "--episodes", "2", "--seed", "5"]
    cli.main([*words, "--json"])
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert "flying in crazyflow 9.9: cf21B_500, 20 ms late" in err
    rows = [(row["flown_in"], row["aircraft"], row["delay"]) for row in found["rows"]]
    assert rows == [
        (where, aircraft, delay)
        for where, aircraft in (
            ("quadrl", "crazyflie_brushless"),
            ("crazyflow 9.9", "matched"),
            ("crazyflow 9.9", "cf21B_500"),
            ("quadrl", "air of crazyflow"),
        )
        for delay in (0.0, 0.02)
    ]
    # The stub is quadrl but for the noise of the vortex ring.
    first, *_ = found["rows"]
    for row in found["rows"][2:4]:
        assert row["success_rate"] == first["success_rate"] == 1.0
        assert row["position_error_m"] == pytest.approx(first["position_error_m"], rel=0.5)
    assert [*found["checks"]] == ["crazyflow", "crazyflow cf21B_500"] and Stub.open == 0
    assert ["flapping moment", "yes", "yes: passed negated", "none"] in found["effects"]
    cli.main(words)
    out = capsys.readouterr().out
    assert "rotor 4 [rad/s^2]" in out and "air of crazyflow" in out and "passed negated" in out


def test_a_simulator_that_means_something_else_is_refused(stubbed, monkeypatch):
    monkeypatch.setattr(Stub, "advance", lambda self, *given: reordered(*given))
    with pytest.raises(QuadrlError, match=r"rotor 1 .* in rotorpy, .* in quadrl; it is another"):
        crosscheck(Policy.pretrained("hover", variant="robust_crazyflie_brushless"))
    assert Stub.open == 0


@pytest.mark.parametrize(
    ("words", "said"),
    {
        ("landing",): "task = 'landing': must be one without ground and solids",
        ("lsy_race",): "task = 'lsy_race': must be one without",
        ("nowhere",): "there is no policy at 'nowhere'",
        ("hover", "--simulators", "gazebo"): "must be one of rotorpy, crazyflow",
        ("hover", "--episodes", "0"): "episodes = 0",
        ("hover", "--seed", "-1"): "seed = -1",
    }.items(),
)
def test_what_cannot_be_flown_is_refused_in_a_line(words, said, monkeypatch, capsys):
    monkeypatch.setenv("QUADRL_INSTALL", "no")
    with pytest.raises(SystemExit):
        cli.main(["crosscheck", *words])
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1


def test_six_rotors_are_refused():
    hexa = linear(26, 6, vehicle="hexa")
    with refused(name="vehicle", value="hexa", lists="one with four level rotors"):
        crosscheck(hexa)


# --------------------------------------------------------------------------------- the environment
def test_nothing_is_installed_unasked(monkeypatch, tmp_path):
    monkeypatch.setenv("QUADRL_CACHE", str(tmp_path))
    monkeypatch.setenv("QUADRL_INSTALL", "no")
    with pytest.raises(QuadrlError, match="rotorpy>=3,<4 is not in .*QUADRL_INSTALL=no"):
        environment_of("rotorpy")
    assert not [*tmp_path.iterdir()]


def test_an_installation_that_fails_says_why_and_is_tried_again(monkeypatch, tmp_path):
    monkeypatch.setenv("QUADRL_CACHE", str(tmp_path))
    monkeypatch.delenv("QUADRL_INSTALL", raising=False)
    said, broken = [], tmp_path / "python"
    broken.write_text("#!/bin/sh\necho first >&2\necho 'no room' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(broken))
    for _ in range(2):
        with pytest.raises(QuadrlError, match="crazyflow cannot be installed: no room"):
            environment_of("crazyflow", said.append)
    assert len(said) == 2 and said[0].startswith("installing crazyflow>=0.4 in ")
    # What is made in its place is known without pip.
    (folder,) = (tmp_path / "simulators").iterdir()
    (folder / simulators.INSTALLED).touch()
    assert environment_of("crazyflow") == folder / "bin" / "python"


def test_a_simulator_that_dies_says_why():
    with pytest.raises(QuadrlError, match="rotorpy has stopped: ModuleNotFoundError.*rotorpy"):
        given = {"own": "", "vehicle": dataclasses.asdict(BRUSHLESS), "brakes": [0.0] * 3}
        with contextlib.closing(Simulator("rotorpy", Path(sys.executable), given)):
            pass
