"""Extreme aircraft, actions and contacts: what is flown is right, or terminated and counted.

How far a flight can be trusted is told by four numbers of the aircraft and its flight, each a rate
times the physics step: see `extreme.LIMITS`, and the tables of docs/lab/accuracy.md. Who is faster
than the step resolves (`Vehicle.resolved_speed`, `resolved_turn`) has diverged.
"""

import extreme
import helpers
import numpy as np
import pytest
import reference
import solutions

ENGINES = ("mujoco", "free_flight")
AIRCRAFT = 12


@pytest.mark.parametrize("engine", ENGINES)
def test_extreme_flights_are_right_or_ended(engine):
    results = [
        extreme.flown(vehicle, engine, solutions.exact(f"extreme/{k}"))
        for k, vehicle in enumerate(extreme.vehicles(AIRCRAFT))
    ]
    worst, trusted, within, ended = map(np.array, zip(*results, strict=True))
    assert trusted.max() < extreme.RIGHT, trusted.max()
    assert worst.max() < extreme.RESOLVED, worst.max()
    # All three kinds are there.
    count = within.size
    assert 0.05 * count < within.sum() < 0.9 * (count - ended.sum())
    assert ended.sum() > 0.05 * count


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("task", ["hover", "landing"])
def test_every_row_is_finite_and_moves_or_is_counted_and_neighbours_fly_on(task, engine):
    """Rows 0 to 7 are wild, the others are not; nobody is reset."""
    ended = 0
    for vehicle in extreme.vehicles(6):
        settings = {"num_envs": 16, "seed": 3, "vehicle": vehicle, "engine": engine}
        environment, undisturbed = (helpers.begun(task, **settings) for _ in range(2))
        start = extreme.starts(vehicle)
        start[:, 10:13] *= np.geomspace(1.0, 1e9, 8)[:, None]  # what no flight comes back from
        flying = environment.engine
        _, flying.qvel[:8], flying.act[:8] = reference.to_mujoco(start)
        for wild in extreme.actions(vehicle, 20):
            # Not quite hovering: an aircraft that hovers from rest does not move, and is no worse.
            action = np.concatenate([wild, np.full_like(wild, 0.05)])
            before = helpers.coordinates(flying)[:, :13]
            now, calm = environment.step(action), undisturbed.step(action)
            after = helpers.coordinates(flying)
            seen = np.concatenate(list(now.observation.values()), axis=-1)
            assert np.isfinite(seen).all() and np.isfinite(now.reward).all()
            assert np.isfinite(after).all()
            assert ((after[:, :13] != before).any(axis=-1) | now.diverged).all()
            assert (now.terminated >= now.diverged).all()
            assert not (now.is_success & now.diverged).any()
            np.testing.assert_array_equal(now.reward[8:], calm.reward[8:])
            np.testing.assert_array_equal(after[8:], helpers.coordinates(undisturbed.engine)[8:])
            ended += now.diverged.sum()
        environment.reset(np.arange(8))  # and the wild ones begin anew
        assert not helpers.idle(environment).diverged[:8].any()
    assert ended > 0


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_whoever_hits_the_ground_at_speed_has_crashed_and_is_not_under_it(engine):
    for vehicle in extreme.vehicles(6):
        environment = helpers.begun("landing", num_envs=16, vehicle=vehicle, engine=engine)
        flying, sinking = environment.engine, np.geomspace(2.5, 200.0, 16)  # [m/s]
        flying.qpos[:, :2], flying.qvel[:] = 0.0, 0.0
        flying.qpos[:, 2] = 0.1 + 2 * sinking * vehicle.control_timestep
        flying.qvel[:, 2] = -sinking
        over = np.zeros(16, dtype=bool)
        for _ in range(25):  # they hit it in the second step
            now = environment.step(np.full((16, vehicle.rotor_count), -1.0))
            assert not (now.is_success & ~over).any()  # what comes after the end does not count
            over |= now.terminated
            assert np.isfinite(helpers.coordinates(flying)).all() and np.isfinite(now.reward).all()
        assert over.all()
        # Nothing fell through the ground: the origin is where it stands on its feet.
        lowest = flying.state.position[:, 2] + vehicle.ground_clearance
        assert (lowest > -vehicle.ground_clearance).all(), lowest.min()
