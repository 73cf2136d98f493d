"""A policy as a controller of the Crazyflie's firmware, whose headers are a test's own here."""

import ctypes
import dataclasses
import itertools
import shutil
import subprocess
from pathlib import Path

import helpers
import numpy as np
import pytest
from flown_in_c import FLAGS, motions_of

import quadrl
from quadrl.aircraft.command_map import CommandMap
from quadrl.core.environment import Environment
from quadrl.core.scenario import UNDISTURBED
from quadrl.deploy.c import Header
from quadrl.deploy.crazyflie import HELD, held, motors
from quadrl.deploy.export import export
from quadrl.engines.native.compiling import compiler
from quadrl.evaluation.policy import Policy

FIRMWARE = Path(__file__).parents[1] / "board" / "crazyflie.h"
HEADERS = (
    "FreeRTOS", "app", "controller", "controller_pid", "debug", "log", "param",
    "platform_defaults", "pm", "task",
)  # fmt: skip
NAME = "hover_robust_crazyflie_brushless"
LEVEL = np.array([0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0], np.float32)
NOT_ASKED, FLYING, NO_GROUND_STATION, NO_SETPOINT, TILTED, FAR, NOT_FINITE = range(7)


@pytest.fixture(scope="module")
def app(tmp_path_factory):
    """The folder."""
    return export(NAME, "crazyflie", tmp_path_factory.mktemp("app") / "app")


def compiled(app, firmware, folder):
    """The controller of a folder, with the warnings of the firmware's build."""
    shutil.copytree(app, folder)
    for header in HEADERS:
        (folder / f"{header}.h").write_text(firmware)
    source, made = folder / "src" / "controller.c", folder / "controller.so"
    strict = "-Wextra", "-Wdouble-promotion", "-Wunused-function", "-O2", "-std=gnu11"
    flags = [flag for flag in FLAGS if flag not in ("-std=c99", "-Wno-unused-function")]
    command = [compiler(), *flags, *strict, f"-I{folder}", "-shared", "-fPIC", source, "-o", made]
    subprocess.run([*command, "-lm"], check=True, capture_output=True, text=True)
    return ctypes.CDLL(str(made))


@pytest.fixture(scope="module")
def library(app, tmp_path_factory):
    """The controller."""
    return compiled(app, FIRMWARE.read_text(), tmp_path_factory.mktemp("built") / "app")


class Board:
    """An aircraft in the hand of a test, whose ground station is alive."""

    def __init__(self, library):
        self.library, self.forces = library, np.zeros(4, np.float32)
        self._millisecond = library.millisecond
        self._millisecond.restype = ctypes.c_bool
        pointer = ctypes.POINTER(ctypes.c_uint8)
        self.on, self.alive = (pointer.in_dll(library, f"param_{k}") for k in ("on", "alive"))
        self._why = pointer.in_dll(library, "log_why")
        library.controllerOutOfTreeInit()
        self.on[0] = 0
        self.run(LEVEL)
        self.on[0] = 1

    @property
    def why(self):
        return self._why[0]

    def run(self, motion, goal=(0.0, 0.0, 0.0), *, times=1, age=0, mode=(1, 1, 1), alive=True):
        """Whether the policy flew the last of some milliseconds."""
        given = [np.ascontiguousarray(x, np.float32) for x in (motion, goal)]
        for _ in range(times):
            self.alive[0] = (self.alive[0] + alive) % 256
            arrays = (x.ctypes.data_as(ctypes.c_void_p) for x in (*given, self.forces))
            motion, at, forces = arrays
            flew = self._millisecond(motion, at, age, (ctypes.c_int * 3)(*mode), forces)
        return flew


@pytest.mark.slow
def test_it_flies_as_the_policy_does(library):
    """At the firmware's pace, around a setpoint elsewhere."""
    policy, board = Policy.pretrained(NAME), Board(library)
    pair = [Environment(policy.scenario, seed=4, **UNDISTURBED) for _ in range(2)]
    observation, _ = (each.reset() for each in pair)
    flight, vehicle = policy.flying(1), pair[0].vehicle
    order = motors(vehicle)
    thrust = np.array([vehicle.rotors[k].thrust_coefficient for k in order])
    mode, over = pair[0].control_mode, False
    while not over:
        motion = motions_of(pair[1])[0, :13]
        assert board.run(motion, (7.0, -4.0, 1.5), times=20)
        action = flight(pair[0].flatten(observation))
        speed = np.sqrt(board.forces * 0.2 / thrust)
        asked = mode.values(action)[0, order]
        np.testing.assert_allclose(speed, asked, rtol=2e-3)
        command = np.empty(4)
        command[order] = speed
        own = (command - mode.centre) / np.where(command > mode.centre, mode.scale, mode.scale_down)
        done, _ = pair[0].step(action), pair[1].step(np.clip(own[None], -1, 1))
        observation, over = done.observation, done.truncated[0] | done.terminated[0]
    assert done.is_success[0] and pair[1].snapshot.potentials.distance[0] < 0.05


def test_a_step_is_made_at_the_pace_of_the_training(library):
    board, forces = Board(library), []
    for k in range(60):
        assert board.run(LEVEL + np.float32(1e-3 * k) * (np.arange(13) == 2))
        forces.append(board.forces.copy())
    changes = np.flatnonzero(np.abs(np.diff(forces, axis=0)).max(axis=1)) + 1
    np.testing.assert_array_equal(changes, [20, 40])


GUARDS = {
    "not asked": ({}, {}, NOT_ASKED),
    "ground station": ({"alive": False, "times": 502}, {}, NO_GROUND_STATION),
    "old setpoint": ({"age": 501}, {}, NO_SETPOINT),
    "velocity asked along x": ({"mode": (2, 1, 1)}, {}, NO_SETPOINT),
    "nothing asked along y": ({"mode": (1, 0, 1)}, {}, NO_SETPOINT),
    "velocity asked along z": ({"mode": (1, 1, 2)}, {}, NO_SETPOINT),
    "on its side": ({}, {3: 0.7, 4: 0.714}, TILTED),
    "far": ({}, {0: 1.6}, FAR),
    "no position": ({}, {1: np.nan}, NOT_FINITE),
    "no rate": ({"times": 20}, {11: np.inf}, NOT_FINITE),
}


@pytest.mark.parametrize("case", GUARDS)
def test_the_pid_controller_flies_where_the_policy_may_not(case, library):
    how, changed, why = GUARDS[case]
    board, motion = Board(library), LEVEL.copy()
    assert board.run(LEVEL, times=30) and board.why == FLYING
    motion[[*changed]] = [*changed.values()]
    board.on[0] = case != "not asked"
    pids, begun = (ctypes.c_int.in_dll(library, k) for k in ("pids", "begun"))
    before = pids.value, begun.value
    assert not board.run(motion, **how) and board.why == why
    assert pids.value > before[0] and begun.value == before[1] + 1  # as it is when it is chosen
    board.run(LEVEL)
    board.on[0] = 1
    assert board.run(LEVEL) == (why < TILTED)  # after the worst it stays off
    board.on[0] = 0
    board.run(LEVEL)
    board.on[0] = 1
    assert board.run(LEVEL)


def test_a_far_setpoint_is_approached_as_one_where_episodes_began(library):
    board, found = Board(library), []
    for away in (0.5, 1.0, 0.3):
        for side in (1, -1):
            motion = LEVEL + np.float32(side * away) * (np.arange(13) < 2)
            board.run(motion, times=40)
            found.append(board.forces.copy())
            board.on[0] = 0
            board.run(LEVEL)
            board.on[0] = 1
    np.testing.assert_array_equal(found[:2], found[2:4])
    for nearer, far in zip(found[4:], found[:2], strict=True):
        assert not np.array_equal(nearer, far)


@pytest.mark.parametrize("pose", HELD)
def test_motors_answer_in_the_hand_as_its_page_says(pose, app, library):
    page = app.joinpath("README.md").read_text()
    (row,) = (line for line in page.splitlines() if line.startswith(f"| {pose} |"))
    board, (height, quaternion) = Board(library), HELD[pose]
    motion = np.concatenate([[0, 0, height], quaternion, np.zeros(6)])
    board.run(motion, times=981)
    rotor = quadrl.VEHICLES["crazyflie_brushless"].rotors[0]
    speeds = np.sqrt(board.forces * 0.2 / rotor.thrust_coefficient)
    np.testing.assert_allclose(speeds, [float(x) for x in row.split("|")[2:-1]], atol=2)


def test_poses_in_the_hand_tell_motors_and_axes_apart():
    """A page whose numbers were all alike would find nothing."""
    found = held(Header(Policy.pretrained(NAME)))
    level, below, *_, left = found.values()
    assert (below > level).all() and np.ptp(level) < 0.05 * level.mean()
    np.testing.assert_array_equal(np.sign(left - level), [1, -1, 1, -1])  # yaw: m1 and m3
    for one, other in itertools.combinations(found.values(), 2):
        assert np.abs(one - other).max() > 0.03 * level.mean()  # three times what one can read


def test_a_number_that_another_compiler_gives_keeps_the_policy_off(app, tmp_path):
    folder = shutil.copytree(app, tmp_path / "app")
    policy = folder / "src" / "policy.h"
    policy.write_text(policy.read_text().replace("a * over", "1.001f * a * over"))
    library = compiled(folder, FIRMWARE.read_text(), tmp_path / "built")
    assert not Board(library).run(LEVEL) and not library.controllerOutOfTreeTest()


@pytest.mark.parametrize(
    ("what", "name", "allowed"),
    [
        ("race", "task", "holds a place"),
        ("hover", "rotor_speed", "variant robust"),
        ("hover_robust", "vehicle", "a Crazyflie"),
    ],
)
def test_what_a_crazyflie_has_not_is_refused(what, name, allowed, tmp_path):
    with helpers.refused(name, lists=allowed):
        export(what, "crazyflie", tmp_path / "app")
    assert not (tmp_path / "app").exists()


def test_motors_are_found_by_their_places_and_spins():
    vehicle = quadrl.VEHICLES["crazyflie"]
    assert motors(vehicle) == [0, 1, 2, 3]
    turned = vehicle.rotors[1:] + vehicle.rotors[:1]
    assert motors(dataclasses.replace(vehicle, rotors=turned)) == [3, 0, 1, 2]


@pytest.mark.slow
def test_an_aircraft_whose_rotors_have_another_order_gets_its_own(app, tmp_path, monkeypatch):
    vehicle = quadrl.VEHICLES["crazyflie_brushless"]
    turned = dataclasses.replace(vehicle, rotors=vehicle.rotors[1:] + vehicle.rotors[:1])
    monkeypatch.setitem(quadrl.VEHICLES, "crazyflie_brushless", turned)
    policy = Policy.pretrained(NAME)
    own = policy.metadata | {"vehicle": "crazyflie_brushless"}
    folder = export(dataclasses.replace(policy, metadata=own), "crazyflie", tmp_path / "app")
    boards = [
        Board(compiled(built, FIRMWARE.read_text(), tmp_path / built.parent.name))
        for built in (app, folder)
    ]
    for board in boards:  # a level aircraft is seen alike, and so the network asks for the same
        board.run(LEVEL)
    assert np.ptp(boards[0].forces) > 1e-3
    np.testing.assert_allclose(boards[1].forces, boards[0].forces[[3, 0, 1, 2]], rtol=1e-5)


@pytest.mark.slow
def test_commands_of_an_identified_aircraft_are_made_for_the_voltage(app, tmp_path, monkeypatch):
    """Its table of commands, and the battery at 4 V, in place of the firmware's own."""
    mapped = CommandMap(offset=300.0, gain=-200.0, gain_by_volt=700.0)
    vehicle = dataclasses.replace(quadrl.VEHICLES["crazyflie_brushless"], command_map=mapped)
    monkeypatch.setitem(quadrl.VEHICLES, "crazyflie_brushless", vehicle)
    policy = Policy.pretrained(NAME)
    own = policy.metadata | {"vehicle": "crazyflie_brushless"}
    folder = export(dataclasses.replace(policy, metadata=own), "crazyflie", tmp_path / "app")
    assert (
        "# CONFIG_ENABLE_THRUST_BAT_COMPENSATED is not set" in (folder / "app-config").read_text()
    )
    text = FIRMWARE.read_text().replace("#define CONFIG_ENABLE_THRUST_BAT_COMPENSATED\n", "")
    boards = []
    for built, header in ((app, FIRMWARE.read_text()), (folder, text)):
        boards.append(Board(compiled(built, header, tmp_path / built.parent.name)))
        assert boards[-1].run(LEVEL, times=30)
    thrust = vehicle.rotors[0].thrust_coefficient
    speed = np.sqrt(boards[0].forces * 0.2 / thrust)
    np.testing.assert_allclose(boards[1].forces, mapped.command(speed, 4.0), rtol=1e-5)
