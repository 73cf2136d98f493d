"""What tests share. Each heading has the helpers of one kind of test."""

import contextlib
import dataclasses
import math
import sys

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadrl import tasks
from quadrl.aircraft import parameters
from quadrl.aircraft.aerodynamics import Aerodynamics
from quadrl.aircraft.presets import VEHICLES, in_real_air, with_effects
from quadrl.aircraft.rotors import ring
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.conditions.randomization import Randomization
from quadrl.conditions.weather import Weather
from quadrl.core.environment import Environment
from quadrl.engines.mjcf import compile_model
from quadrl.engines.mujoco import BatchEngine
from quadrl.engines.state import Start
from quadrl.tasks.hover import Hover

# ------------------------------------------------------------------------------ where a test runs


def needs_dm_control():
    """Skip a test, or the rest of its file, where dm-control cannot be: from Python 3.13 on."""
    if sys.version_info >= (3, 13):
        reason = "dm-control needs labmaze, which cannot be installed with this Python"
        pytest.importorskip("dm_control", reason=reason)


FOURTH_ORDER = mujoco.mj_version() >= 4_000_000
"""Whether MuJoCo's RK4 turns a free body with fourth order; before MuJoCo 4 it was second."""


# ------------------------------------------------------------------- motions, flown by an engine

ALIKE = ("mark", "size", "rotor_count", "effects", *parameters.DERIVED)
"""Numbers of a row that are the same in all: what kind of row it is, and what no force reads."""
UP = np.array([0.0, 0.0, 100.0])  # [m]; where nothing is near
_ROTOR = dict(thrust_coefficient=1.1e-5, torque_coefficient=2e-7, lag_up=20.0, lag_down=12.0)
LAYOUTS = {name: with_effects(vehicle, "none") for name, vehicle in VEHICLES.items()} | {
    "eight": Vehicle(
        name="eight",
        mass=1.2,
        inertia=(0.02, 0.02, 0.035),
        rotors=ring(range(0, 360, 45), [1, -1] * 4, 0.3, max_speed=700.0, **_ROTOR),
    ),
    # Five rotors in a ring that leans outwards and is turned about its arms, above the centre.
    "leaning": Vehicle(
        name="leaning",
        mass=0.8,
        inertia=(0.011, 0.009, 0.016),
        rotors=tuple(
            dataclasses.replace(
                rotor, position=(x, y, 0.04), axis=(0.2 * x - 0.1 * y, 0.2 * y + 0.1 * x, z)
            )
            for rotor in ring(range(0, 360, 72), (1, -1, 1, -1, 1), 0.2, max_speed=900.0, **_ROTOR)
            for x, y in [rotor.position[:2]]
            for z in [math.sqrt(1 - 0.05 * 0.2**2)]
        ),
    ),
}
"""Every preset, and layouts that no preset has."""
_AIR = dataclasses.replace(
    Aerodynamics.full(), flapping_moment=2e-6, flapping_pitch=0.6, rotor_inertia=2e-5
)
IN_AIR = {
    f"{name} in air": in_real_air(
        vehicle
        if name in VEHICLES
        else dataclasses.replace(
            vehicle,
            aerodynamics=_AIR,
            rotors=tuple(
                dataclasses.replace(rotor, disc_radius=0.08 + 0.005 * k * (name == "leaning"))
                for k, rotor in enumerate(vehicle.rotors)
            ),
        )
    )
    for name, vehicle in LAYOUTS.items()
    if name != "cf21B_500"  # whose own set has two of them alone
}
"""The same with every effect of the air."""


def grounded(vehicle: Vehicle) -> mujoco.MjModel:
    """The lean model of an aircraft that can touch the ground."""
    return compile_model(vehicle, contact=True, drawn=False)


@dataclasses.dataclass
class Motion:
    """Of n aircraft, and the wind that they fly in; world frame, body rates in the body's."""

    position: np.ndarray  # (n, 3) [m]
    quaternion: np.ndarray  # (n, 4) wxyz, body to world
    velocity: np.ndarray  # (n, 3) [m/s]
    body_rate: np.ndarray  # (n, 3) [rad/s]
    rotor_speed: np.ndarray  # (n, R) [rad/s]
    wind: np.ndarray  # (n, 3) [m/s]


def matrices(quaternion):
    """Rotation matrices (n, 3, 3) of quaternions wxyz (n, 4), by SciPy."""
    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix()


def random_quaternions(rng, count):
    """(n, 4) wxyz, any attitude."""
    quaternion = rng.normal(size=(count, 4))
    return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)


def random_motion(vehicle, count, seed=0, *, speed=2.0, turn=2.0, wind=0.0, rotor=0.1):
    """Any attitude; each coordinate up to `speed` [m/s], `turn` [rad/s] and `wind` [m/s].

    The rotor speeds differ from hover by a share of up to `rotor`.
    """
    rng = np.random.default_rng(seed)
    return Motion(
        position=rng.uniform(-1, 1, (count, 3)),
        quaternion=random_quaternions(rng, count),
        velocity=rng.uniform(-speed, speed, (count, 3)),
        body_rate=rng.uniform(-turn, turn, (count, 3)),
        rotor_speed=vehicle.hover_speed
        * rng.uniform(1 - rotor, 1 + rotor, (count, vehicle.rotor_count)),
        wind=rng.uniform(-wind, wind, (count, 3)),
    )


def random_commands(vehicle, count, steps, seed=1, *, rotor=0.1):
    """Rotor speed commands (steps, n, R) [rad/s], within a share `rotor` of hover."""
    rng = np.random.default_rng(seed)
    share = rng.uniform(1 - rotor, 1 + rotor, (steps, count, vehicle.rotor_count))
    return vehicle.hover_speed * share


def put(engine, motion, origin=UP):
    """Write a motion into an engine."""
    engine.qpos[:] = np.concatenate([motion.position + origin, motion.quaternion], axis=-1)
    engine.qvel[:] = np.concatenate([motion.velocity, motion.body_rate], axis=-1)
    engine.act[:], engine.wind[:] = motion.rotor_speed, motion.wind


def taken(engine, origin=UP):
    """The motion that an engine is in."""
    return Motion(
        position=engine.qpos[:, :3] - origin,
        quaternion=engine.qpos[:, 3:].copy(),
        velocity=engine.qvel[:, :3].copy(),
        body_rate=engine.qvel[:, 3:].copy(),
        rotor_speed=engine.act.copy(),
        wind=engine.wind.copy(),
    )


def flown(vehicle, engine, motion, commands, steps):
    """Fly a motion with each of the commands (k, n, R) for some physics steps."""
    batch = BatchEngine(vehicle, len(motion.position), altitude=3.0, engine=engine)
    put(batch, motion)
    for command in commands:
        batch.ctrl[:] = command
        batch.advance(steps)
    return taken(batch)


def coordinates(engine):
    """qpos, qvel and act side by side (n, 13 + R), a copy."""
    return np.concatenate([engine.qpos, engine.qvel, engine.act], axis=-1)


def parameter_rows(vehicle, count):
    """Rows of parameters (n,) that differ: each number that may act, by up to a fifth.

    What is 0 gets a size, unless it is of an `Aerodynamics` without effect: no force is left out.
    """
    own, table = parameters.rows(vehicle), parameters.rows(vehicle, count)
    numbers, air = parameters.numbers(table), vehicle.aerodynamics
    numbers[numbers == 0] = 1e-2 * vehicle.inertia[0]
    numbers *= np.random.default_rng(2).uniform(0.8, 1.2, numbers.shape)
    table["rotor"]["axis"] = own["rotor"]["axis"]  # MuJoCo's models have one for all rows
    for name in (*ALIKE, *(() if air.effects else vars(air))):
        table[name] = own[name]
    parameters.refresh(table, vehicle.physics_timestep)
    return table


# ------------------------------------------------------------------- episodes, flown by the core

# 12 steps to the time limit: several episodes. One route has a waypoint to pass, and one landing is
# low enough to touch the ground.
ROUTE = ((0.0, 0.0, -0.05), (0.0, 0.0, -1.0))
SHORT = {name: tasks.make(name, time_limit=0.6) for name in tasks.TASKS}
SHORT["a short route"] = tasks.make("static_waypoint", time_limit=0.6, waypoints=ROUTE, reach=0.04)
SHORT["a low landing"] = tasks.make("landing", time_limit=0.6, start_height=0.05)


def begun(task="hover", num_envs=1, seed=0, **settings):
    """An environment that is reset."""
    environment = Environment(task, num_envs=num_envs, seed=seed, **settings)
    environment.reset()
    return environment


def in_flight(time, pose, rotor_speed=0.0, wind=None):
    """An environment with the paper's aircraft at a moment, its goal there, as pictures see it."""
    environment = begun(weather=None if wind is None else Weather(wind_speed=1.0))
    now, engine = environment.snapshot, environment.engine
    now.time[:], now.state.rotor_speed[:], engine.qpos[:] = time, rotor_speed, pose
    engine.wind[:] = 0.0 if wind is None else wind
    environment.goals = lambda: pose[None, :3]
    return environment


def idle(environment):
    """A step with the action 0."""
    return environment.step(np.zeros((environment.num_envs, environment.action_size)))


FLAGS = ("terminated", "truncated", "is_success", "diverged")


EVERYTHING = Randomization(
    mass=(0.9, 1.1),
    inertia=(0.9, 1.1),
    thrust=(0.95, 1.05),
    torque=(0.9, 1.1),
    lag=(0.8, 1.25),
    drag=(0.5, 1.5),
    inflow=(0.9, 1.1),
    max_speed=(0.95, 1.0),
    rotors=(0.96, 1.04),
    centre_of_mass=0.002,
)
"""Every number of an aircraft is drawn."""


def drawn(environment):
    """Parameters and air of every row, (N, k), a copy."""
    table, air = environment.engine.parameters, environment.engine.wind
    rows = parameters.numbers(table)
    return np.concatenate([np.broadcast_to(rows, (len(air), rows.shape[1])), air], axis=1)


def flying(task="hover", *, count=4, seed=3, reset=True, **settings):
    """An environment whose rows draw every parameter, unless `randomization` says others."""
    settings = {"randomization": EVERYTHING} | settings
    environment = Environment(task, num_envs=count, seed=seed, **settings)
    if reset:
        environment.reset()
    return environment


def level(count=1, vehicle=None, *, position=(0, 0, 0), velocity=(0, 0, 0)):
    """A Start of `count` level aircraft that head east, their rotors at hover speed."""
    vehicle = vehicle or Vehicle()
    start = {"position": position, "quaternion": (1, 0, 0, 0), "velocity": velocity}
    start |= {"body_rate": (0, 0, 0), "rotor_speed": vehicle.hover_speed}
    return Start(**{k: np.array(np.broadcast_to(np.atleast_2d(v), (count, np.shape(v)[-1])), float)
                    for k, v in start.items()})  # fmt: skip


def starting(task, start, task_state=None):
    """A task whose episodes begin with a Start (n, k), and with a dict `task_state` of arrays.

    Row i begins with row i of these, over and over where there are fewer.
    """

    def begin(self, rng, parameters):
        own, state = super(kind, self).begin(rng, parameters)
        rows = np.arange(len(own.position)) % len(start.position)
        fields = {name: getattr(start, name)[rows] for name in Start.__dataclass_fields__}
        if task_state:
            state = type(state)(**{name: value[rows] for name, value in task_state.items()})
        return Start(**fields), state

    kind = type(type(task).__name__, (type(task),), {"begin": begin})
    return kind(**{field.name: getattr(task, field.name) for field in dataclasses.fields(task)})


def variant(base=Hover, options=None, **members):
    """A task with some methods or members replaced; compiled where that is possible."""
    body = {"name": base.name, "__annotations__": {}, "compiled": True, **members}
    return dataclasses.dataclass(frozen=True)(type("Variant", (base,), body))(**(options or {}))


def placed(
    task="hover", count=1, *, position=(0, 0, 0), velocity=(0, 0, 0), options=(), **settings
):
    """An environment, reset, whose aircraft are level somewhere, at hover speed."""
    made = tasks.make(task, **dict(options))
    start = level(count, settings.get("vehicle"), position=position, velocity=velocity)
    environment = Environment(starting(made, start), num_envs=count, seed=0, **settings)
    environment.reset()
    return environment


def random_actions(steps, count, size=4, seed=0):
    """(T, N, k) for an environment; one aircraft dives, so that episodes end early too."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (steps, count, size))
    actions[:, 1 % count] -= 0.7
    return actions


def recorded(environment, transition):
    """Copies of everything in a transition and of the coordinates, by name."""
    parts = {f"observation.{k}": v for k, v in transition.observation.items()}
    parts |= {f"term.{k}": v for k, v in transition.reward_terms.items()}
    parts |= {name: getattr(transition, name) for name in ("reward", "error", *FLAGS)}
    parts |= {"coordinates": coordinates(environment.engine)}
    return {name: np.array(value) for name, value in parts.items()}


def fly(environment, actions):
    """Records of a flight that resets whoever is over; with what each reset gives."""
    records = []
    for action in actions:
        now = environment.step(action)
        records.append(recorded(environment, now))
        if (over := now.terminated | now.truncated).any():
            fresh = environment.reset(over)
            records[-1] |= {f"fresh.{k}": np.array(v) for k, v in fresh.items()}
    return records


def assert_records(got, expected, rows=slice(None)):
    """Rows of the records of a flight are those of another one, bit for bit."""
    assert len(got) == len(expected)
    for step, (now, then) in enumerate(zip(got, expected, strict=True)):
        over = np.flatnonzero(then["terminated"] | then["truncated"])
        chosen = np.arange(len(then["reward"]))[rows]
        fresh = np.flatnonzero(np.isin(over, chosen))
        for name, value in then.items():
            mine = value[fresh] if name.startswith("fresh.") else value[chosen]
            if not name.startswith("fresh.") or len(fresh):
                np.testing.assert_array_equal(now[name], mine, err_msg=f"{name}, step {step}")


# ------------------------------------------------------------------- what is refused


@contextlib.contextmanager
def refused(name=None, value=..., allowed=None, *, lists="", match=None):
    """Expect a QuadrlError of one line, with these attributes where they are given.

    `lists` is a part of what is allowed; `match` is searched in the message, as pytest does it.
    """
    with pytest.raises(QuadrlError, match=match) as caught:
        yield caught
    error = caught.value
    assert str(error) and "\n" not in str(error)
    assert name in (None, error.name)
    assert value is ... or [type(value), value] == [type(error.value), error.value]
    assert allowed in (None, error.allowed) and lists in error.allowed
    assert error.name is None or error.allowed


def mostly_slow(names, *fast):
    """Parameters of a test that takes seconds with each: all but some are slow."""
    return [name if name in fast else pytest.param(name, marks=pytest.mark.slow) for name in names]
