"""Flights through every API, and by bare mj_step."""

import dataclasses
import importlib.util
import itertools
import types

import mujoco
import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.presets import VEHICLES
from quadrl.base.philox import SOLIDS
from quadrl.conditions import sensors
from quadrl.conditions.scene import Scene
from quadrl.control import modes
from quadrl.core.environment import Environment
from quadrl.core.rewards import total
from quadrl.core.snapshot import EpisodeEnd, Snapshot
from quadrl.core.task import either, ends_of
from quadrl.engines import mjcf
from quadrl.engines.rng import Rng
from quadrl.engines.solids import Solids
from quadrl.engines.state import State
from quadrl.engines.threads import Threads


def fly(api, task, seed, actions, mode="rotor"):
    """Fly n aircraft through an API, episode after episode; row i is seeded with seed + i.

    Args:
        api: A name of APIS.
        task: The task.
        seed: Of row 0.
        actions: (T, n, k) float32.
        mode: What they mean, a name of CONTROL_MODES.

    Returns:
        Arrays (T, n, ...) by name of COLUMNS: the observation that each action met, and the
        observation, reward and flags that it led to.
    """
    aircraft = APIS[api](task, seed, actions.shape[1], mode)
    met, steps = next(aircraft), []
    for action in actions:
        *led_to, begun = aircraft.send(action)
        steps.append((met, *led_to))
        met = begun
    return {name: np.stack([s[k] for s in steps]) for k, name in enumerate(COLUMNS)}


COLUMNS = ("met", "observation", "reward", "terminated", "truncated", "is_success")


def flat(observation):
    """The terms of an observation side by side, in double precision."""
    return np.concatenate(list(observation.values()), axis=-1)


# Each API is a generator: it gives the first observations, then for each action that is sent to it
# the COLUMNS after `met`, and what the next action meets: a new episode's start, where one ended.


def together(one):
    """n aircraft of a generator for a single one."""

    def fly_all(task, seed, count, mode):
        aircraft = [one(task, seed + i, mode) for i in range(count)]
        actions = yield np.stack([next(each) for each in aircraft])
        while True:
            led_to = [each.send(a) for each, a in zip(aircraft, actions, strict=True)]
            actions = yield tuple(map(np.stack, zip(*led_to, strict=True)))

    return fly_all


def by_mj_step(task, seed, mode):
    """Bare mj_step and the task's own functions: what every API has to give, bit for bit."""
    vehicle = VEHICLES["paper"]
    model = mjcf.compile_model(vehicle, contact=task.contact, drawn=False, scene=task.build)
    rays = {name: sensors.make(name, given).rays for name, given in task.sensors.items()}
    data, scene = mujoco.MjData(model), Scene(task.solids(), rays)
    finer = round(vehicle.physics_timestep / model.opt.timestep)
    row = parameters.rows(vehicle)
    origin = np.array([0.0, 0.0, max(task.altitude, vehicle.ground_clearance)])
    solids = Solids(model, 1, origin, lambda name: getattr(model, name)[None], Threads(1, 1))
    hits, feet = np.split(data.userdata[None, parameters.AIR :], [parameters.HIT], axis=1)
    world = types.SimpleNamespace(
        solids=solids, hits=hits, feet=feet, qpos=data.qpos[None], num_envs=1, forked=False
    )
    world.clearance = lambda rows: solids.clearance(data.qpos[None])
    control = modes.kind(mode)(vehicle)
    own = parameters.Parameters.of(row, vehicle.control_timestep)
    settle = round(min(task.settle_time, task.time_limit) / vehicle.control_timestep)
    errors, episode = [], itertools.count()

    def state():
        return State.of_coordinates(
            position=data.qpos[None, :3] - origin,
            quaternion=data.qpos[None, 3:].copy(),
            velocity=data.qvel[None, :3].copy(),
            body_rate=data.qvel[None, 3:].copy(),
            rotor_speed=data.act[None].copy(),
            origin_height=origin[2],
        )

    def snapshot(remembered, action, command):
        time = np.array([len(errors) * vehicle.control_timestep])
        seen = scene.world(world)
        now = Snapshot(state(), remembered, own, action, command, time, world=seen)
        return dataclasses.replace(now, potentials=task.measure(now))

    def observed(now):
        read = {name: own.read(now.world.ranges(name), 0.0, None) for name, own in rays.items()}
        return flat(task.observe(now) | read)

    def move(substep):
        time = np.array([len(errors) * vehicle.control_timestep])
        time += (substep + 1) * vehicle.physics_timestep
        placed = task.move(before.task, time)
        if placed:
            poses = scene.poses(placed, 1, origin, solids.poses)
            solids.move(poses, vehicle.physics_timestep)

    def begin():
        errors.clear()
        keys = np.array([seed]), np.array([next(episode)])
        start, drawn = task.begin(Rng(*keys), own)
        remembered = task.remember(start, drawn)
        mujoco.mj_resetData(model, data)
        if scene.solids:
            poses = scene.poses(task.place(Rng(*keys, SOLIDS), start, remembered), 1, origin)
            solids.place(np.array([0]), poses)
        data.qpos[:] = np.concatenate([start.position + origin, start.quaternion], axis=-1)[0]
        data.qvel[:] = np.concatenate([start.velocity, start.body_rate], axis=-1)[0]
        data.act[:] = start.rotor_speed[0]
        return snapshot(remembered, np.zeros((1, control.size)), start.rotor_speed)

    before = begin()
    led_to = observed(before)[0]
    while True:
        action = (yield led_to)[None].astype(np.float64)
        setpoint = control.setpoint(before.state, action)
        command = np.zeros((1, vehicle.rotor_count))
        hits[:] = 0.0
        for substep in range(vehicle.substeps):
            move(substep)
            seen = state() if control.has_loops else before.state
            data.ctrl[:] = control.rotor_command(seen, setpoint)[0]
            command += data.ctrl / vehicle.substeps
            for k in range(finer):
                if solids.moves:
                    solids.stand(np.array([0]), (k + 0.5) / finer)
                mujoco.mj_step(model, data)
        solids.arrive()
        errors.append(0.0)  # counts the step: `snapshot` tells the time
        now = snapshot(before.task, action, command if control.has_loops else setpoint)
        terminated = either(ends_of(task, now))
        late = len(errors) * vehicle.control_timestep > task.time_limit - 1e-9
        truncated = late & ~terminated
        errors[-1] = float(task.error(now)[0])
        counts = (np.array([n]) for n in (len(errors), sum(errors), sum(errors[-settle:])))
        end = EpisodeEnd(terminated, truncated, *counts, settle)
        end.succeeded = success = (terminated | truncated) & task.succeeded(now, end)
        reward = total(task.reward(before, now, end))
        before = snapshot(task.update(before, now), now.action, now.rotor_command)
        seen = begun = observed(before)
        if terminated or truncated:
            before = begin()
            begun = observed(before)
        led_to = seen[0], reward[0], terminated[0], truncated[0], success[0], begun[0]


def by_environment(task, seed, count, mode):
    """The core."""
    environment = Environment(task, num_envs=count, seed=seed, control_mode=mode)
    action = yield flat(environment.reset())
    while True:
        now = environment.step(action)
        seen, over = flat(now.observation), now.terminated | now.truncated
        begun = seen.copy()
        if over.any():
            begun[over] = flat(environment.reset(over))
        action = yield seen, now.reward, now.terminated, now.truncated, now.is_success, begun


def by_dm_control(task, seed, mode):
    """The dm_control environment, which begins the next episode by itself."""
    from quadrl.envs import dm_control

    environment = dm_control.make(task, random=seed, control_mode=mode)
    action = yield flat(environment.reset().observation)
    while True:
        now = environment.step(action)
        success = environment.task.transition.is_success[0]
        ended = now.last() and now.discount == 0.0, now.last() and now.discount == 1.0
        later = environment.step(action) if now.last() else now
        columns = now.reward, *ended, success
        action = yield flat(now.observation), *columns, flat(later.observation)


def by_gymnasium(task, seed, mode):
    """The single Gymnasium environment."""
    from quadrl.envs.gymnasium import QuadrotorEnv

    environment = QuadrotorEnv(task, control_mode=mode)
    action = yield environment.reset(seed=seed)[0]
    while True:
        seen, reward, terminated, truncated, info = environment.step(action)
        begun = environment.reset()[0] if terminated or truncated else seen
        action = yield seen, reward, terminated, truncated, info["is_success"], begun


def by_gymnasium_vector(task, seed, count, mode):
    """The vector without autoreset; the other modes are held against it in test_gymnasium.py."""
    from quadrl.envs.gymnasium import QuadrotorVectorEnv

    environment = QuadrotorVectorEnv(task, count, autoreset_mode="DISABLED", control_mode=mode)
    action = yield environment.reset(seed=seed)[0]
    while True:
        seen, reward, terminated, truncated, info = environment.step(action)
        over = terminated | truncated
        begun = environment.reset(options={"reset_mask": over})[0] if over.any() else seen
        action = yield seen, reward, terminated, truncated, info["is_success"], begun


def by_torchrl(task, seed, count, mode):
    """TorchRL's batched environment."""
    import torch

    from quadrl.envs.torchrl import QuadrotorEnv

    environment = QuadrotorEnv(task, count, seed=seed, control_mode=mode)
    met = environment.reset()
    action = yield met["observation"].numpy()
    while True:
        step = met.set("action", torch.from_numpy(action))
        now, met = environment.step_and_maybe_reset(step)
        columns = [now["next", name][:, 0].numpy() for name in COLUMNS[2:]]
        action = yield now["next", "observation"].numpy(), *columns, met["observation"].numpy()


APIS = {
    "mj_step": together(by_mj_step),
    "environment": by_environment,
    **({"dm_control": together(by_dm_control)} if importlib.util.find_spec("dm_control") else {}),
    "gymnasium": together(by_gymnasium),
    "gymnasium_vector": by_gymnasium_vector,
    "torchrl": by_torchrl,
}
"""Ways to fly: a plain loop, the core, and every API."""
