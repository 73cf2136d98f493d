"""Software in the loop: policies exported to C fly as many episodes as their cards are made of."""

import numpy as np
import pytest
from flown_in_c import Flown, compiled, motions_of, tasks_of
from scipy.stats import ks_2samp

from quadrl.core.environment import Environment
from quadrl.core.scenario import UNDISTURBED
from quadrl.deploy.export import export
from quadrl.evaluation.policy import Policy

EPISODES, SEED = 500, 3_000_000
LATE = {"randomization": {"command_delay": (0.02, 0.02)}}
FLOWN = {
    "hover_ppo": {}, "static_waypoint_ppo": {}, "random_waypoint_ppo": {},
    "straight_and_level_ppo": {}, "target_following_ppo": {}, "landing_ppo": {},
    "trajectory_ppo": {}, "race_apg": {}, "recovery_ppo": {}, "lsy_race_ppo": {},
    "perching_ppo": {}, "deck_landing_ppo": {}, "navigation_ppo": {}, "all_ppo": {},
    "hover_robust": LATE, "hover_robust_crazyflie_brushless": LATE,
}  # fmt: skip
"""A policy of each task that an autopilot can fly, and two that were trained for delays."""


def outcomes(policy, conditions, library=None):
    """Success (N,) and error (N,) of episodes, and how far what the C saw is from what there was.

    Each number of an observation is rounded by its largest size, also where it passes zero.

    Args:
        policy: Flies, unless there is a library.
        conditions: Other than an undisturbed flight.
        library: Its functions in C, which see the motion alone.
    """
    environment = Environment(
        policy.scenario, num_envs=EPISODES, seed=SEED, **UNDISTURBED | conditions
    )
    observation, flight = environment.reset(), policy.flying(EPISODES)
    success, error, over = np.zeros(EPISODES, bool), np.zeros(EPISODES), np.zeros(EPISODES, bool)
    flown = library and Flown(library, policy, EPISODES)
    away, size = np.zeros(policy.size), np.ones(policy.size)
    if flown:
        assert flown.begin(motions_of(environment), tasks_of(environment)) == 0
    while not over.all():
        seen = environment.flatten(observation)
        if flown:
            flown.step(motions_of(environment))
            far = np.abs(flown.observation - seen)[~over].max(axis=0)
            away, size = np.maximum(away, far), np.maximum(size, np.abs(seen[~over]).max(axis=0))
        done = environment.step(flown.action.astype(float) if flown else flight(seen))
        observation = done.observation
        now = (done.terminated | done.truncated) & ~over
        success[now], error[now] = done.is_success[now], done.error[now]
        over |= now
    return success, error, (away / size).max()


@pytest.mark.parametrize("name", FLOWN)
def test_the_c_flies_the_episodes_of_the_policy(name, tmp_path):
    policy = Policy.pretrained(name)
    library = compiled(export(name, "c", tmp_path / "policy.h"), tmp_path, "-O2")
    success, error, away = outcomes(policy, FLOWN[name], library)
    expected, usual, _ = outcomes(policy, FLOWN[name])
    print(f"{name}: {success.mean():.1%} in C, {expected.mean():.1%} in Python; {away:.1e}")
    assert away < 1e-5
    share = expected.mean()
    # Rounding may decide a flight that a hair decides: as many as chance would, none of 100 %.
    assert abs(success.mean() - share) <= 2 * np.sqrt(share * (1 - share) / EPISODES)
    assert share > 0.5
    if (success == expected).all():
        assert np.median(error) == pytest.approx(np.median(usual), abs=1e-4)
    else:
        # A race at the limit is chaos: from the first contact that a rounding shifts, flights part.
        assert ks_2samp(error, usual, method="asymp").pvalue > 0.01
