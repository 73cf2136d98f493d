"""Door two: Gymnasium, single and vector."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import quadrl
from quadrl import testing
from quadrl.environment import ActionError
from quadrl.envs import gymnasium as door
from quadrl.task import OptionError
from quadrl.tasks import TASKS

IDS = {name: f"quadrl/{name.title().replace('_', '')}-v0" for name in TASKS}
HOVER = "quadrl/Hover-v0"
every_task = pytest.mark.parametrize("id", IDS.values(), ids=IDS)
every_mode = pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.name)


def episode(environment, actions, **reset):
    """Observations, rewards and infos of an episode."""
    observations, rewards, infos = [environment.reset(**reset)[0]], [], []
    for action in actions:
        observation, reward, terminated, truncated, info = environment.step(action)
        observations.append(observation)
        rewards.append(reward)
        infos.append(info)
        if terminated or truncated:
            break
    return np.stack(observations), rewards, infos


def test_every_task_has_an_id():
    registered = {id for id in gym.registry if id.startswith("quadrl/")}
    assert registered == set(IDS.values())
    for name, id in IDS.items():
        assert gym.make(id).unwrapped.environment.task == TASKS[name]()
        assert gym.make_vec(id, num_envs=2).environment.task == TASKS[name]()


@every_task
def test_gymnasiums_check_passes_without_a_warning_of_ours(id):
    # What pyproject.toml lets pass: the two about the bounds. Every other warning is an error.
    gym.utils.env_checker.check_env(gym.make(id).unwrapped, skip_render_check=True)


def test_registering_again_is_silent():
    before = dict(gym.registry)
    door.register_ids()  # Gymnasium warns of an id that is registered twice
    assert gym.registry == before


@every_task
def test_a_seed_gives_the_episode_and_the_next_one_differs(id):
    actions = testing.varied_actions(20, 4)[:, 3]
    environment = gym.make(id)
    first, *_ = episode(environment, actions, seed=3)
    second, *_ = episode(environment, actions)
    again, *_ = episode(environment, actions, seed=3)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(second, episode(environment, actions)[0])
    assert not np.array_equal(first[0], second[0])
    assert not np.array_equal(first[0], gym.make(id).reset()[0])


@every_task
def test_a_step_returns_pythons_own_types_and_the_terms_of_the_reward(id):
    environment = gym.make(id)
    observation, info = environment.reset(seed=0)
    assert observation.dtype == np.float32
    assert info == {}
    for action in testing.varied_actions(10, 1)[:, 0]:
        observation, reward, terminated, truncated, info = environment.step(action)
        assert observation.dtype == np.float32
        assert type(reward) is float
        assert type(terminated) is type(truncated) is bool
        assert set(info) == {"reward_terms", "is_success", "error", "diverged"}
        assert type(info["is_success"]) is type(info["diverged"]) is bool
        assert type(info["error"]) is float
        assert type(info["reward_terms"]) is dict
        assert all(type(term) is float for term in info["reward_terms"].values())
        assert sum(info["reward_terms"].values()) == reward


def test_reward_terms_can_be_left_out():
    environment = gym.make(HOVER, reward_terms=False)
    environment.reset()
    assert "reward_terms" not in environment.step(np.zeros(4))[4]
    vector = gym.make_vec(HOVER, num_envs=2, reward_terms=False)
    vector.reset()
    assert not {"reward_terms", "_reward_terms"} & set(vector.step(np.zeros((2, 4)))[4])


@pytest.mark.parametrize(
    "make", [gym.make, *AutoresetMode], ids=lambda m: getattr(m, "name", "one")
)
def test_what_is_handed_out_is_never_changed_later(make):
    horizon = 0.2  # four steps, so that resets are among the calls
    if make is gym.make:
        environment, shape = gym.make(HOVER, horizon=horizon), (4,)
    else:
        environment = gym.make_vec(HOVER, num_envs=3, horizon=horizon, autoreset_mode=make)
        shape = (3, 4)
    handed_out = [environment.reset(seed=0)]
    copies = [_copied(handed_out[0])]
    for _ in range(12):
        given = environment.step(np.full(shape, 0.1, dtype=np.float32))
        handed_out.append(given)
        copies.append(_copied(given))
        if np.any(given[3]) and make in (gym.make, AutoresetMode.DISABLED):
            mask = {"reset_mask": np.array([True, False, False])} if len(shape) == 2 else None
            handed_out.append(environment.reset(options=mask))
            copies.append(_copied(handed_out[-1]))
    for given, copy in zip(handed_out, copies, strict=True):
        assert data_equivalence(given[0], copy[0])
        assert repr(given[1:]) == copy[1]


def _copied(given):
    return given[0].copy(), repr(given[1:])


@every_mode
@every_task
def test_the_vector_is_gymnasiums_own_vector_of_single_ones(id, mode):
    count, settings = 4, {"horizon": testing.EPISODE}
    ours = gym.make_vec(id, num_envs=count, autoreset_mode=mode, **settings)
    theirs = gym.make_vec(
        id,
        num_envs=count,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        **settings,
    )
    assert ours.autoreset_mode == ours.metadata["autoreset_mode"] == mode
    for space in ("observation", "action", "single_observation", "single_action"):
        assert getattr(ours, f"{space}_space") == getattr(theirs, f"{space}_space")
    assert data_equivalence(ours.reset(seed=3), theirs.reset(seed=3))
    ends = 0
    for action in testing.varied_actions(110, count):
        *got, info = ours.step(action)
        *expected, their_info = theirs.step(action)
        assert data_equivalence(got, expected)
        # Where no row has something, Gymnasium's lacks the name, and ours masks every row.
        for name in set(info) - set(their_info):
            assert not info[name if name.startswith("_") else f"_{name}"].any()
        assert set(their_info) <= set(info)
        for name, value in their_info.items():
            if name == "final_obs":
                assert data_equivalence(tuple(info[name]), tuple(value))
            else:
                assert data_equivalence(info[name], value), name
        over = got[2] | got[3]
        ends += over.sum()
        if mode == AutoresetMode.DISABLED and over.any():
            reset = [vector.reset(options={"reset_mask": over.copy()}) for vector in (ours, theirs)]
            assert data_equivalence(*reset)
    assert ends >= 8


def test_the_action_of_a_resting_row_is_ignored():
    one, other = (gym.make_vec(HOVER, num_envs=2, horizon=0.1) for _ in range(2))
    for vector in (one, other):
        vector.reset(seed=0)
        vector.step(np.zeros((2, 4)))
        assert vector.step(np.zeros((2, 4)))[3].all()  # two steps of 0.05 s
    np.testing.assert_array_equal(one.step(np.zeros((2, 4)))[0], other.step(np.ones((2, 4)))[0])
    assert data_equivalence(one.step(np.zeros((2, 4))), other.step(np.zeros((2, 4))))


def test_a_mask_resets_and_seeds_its_rows_alone():
    vector = gym.make_vec(HOVER, num_envs=3, autoreset_mode="DISABLED")
    vector.reset(seed=0)
    met = vector.step(np.zeros((3, 4)))[0]
    mask = np.array([False, True, False])
    after, _ = vector.reset(seed=40, options={"reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], met[~mask])
    np.testing.assert_array_equal(after[1], gym.make(HOVER).reset(seed=41)[0])
    second, _ = vector.reset()
    np.testing.assert_array_equal(second[0], _second_start(seed=0))
    np.testing.assert_array_equal(second[1], _second_start(seed=41))


def _second_start(seed):
    environment = gym.make(HOVER)
    environment.reset(seed=seed)
    return environment.reset()[0]


@pytest.mark.parametrize("mask", [np.zeros(3, dtype=bool), np.ones(2, dtype=bool), np.ones(3)])
def test_an_impossible_mask_is_refused(mask):
    vector = gym.make_vec(HOVER, num_envs=3, autoreset_mode="DISABLED")
    vector.reset()
    with pytest.raises(OptionError, match=r"reset_mask.*\(3,\)"):
        vector.reset(options={"reset_mask": mask})


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP"])
def test_gymnasiums_statistics_are_those_of_the_episodes(mode):
    actions = testing.varied_actions(60, 3)
    vector = RecordEpisodeStatistics(
        gym.make_vec(HOVER, num_envs=3, horizon=0.5, autoreset_mode=mode)
    )
    vector.reset(seed=0)
    returns, lengths = [], []
    for action in actions:
        *_, info = vector.step(action)
        if "episode" in info:
            over = info["_episode"]
            returns += info["episode"]["r"][over].tolist()
            lengths += info["episode"]["l"][over].tolist()
    # Ten steps of 0.05 s; in NEXT_STEP an eleventh resets.
    assert lengths == [10] * 3 * (60 // (11 if mode == "NEXT_STEP" else 10))
    environment = gym.make(HOVER, horizon=0.5)
    alone = [sum(episode(environment, actions[:10, 1], seed=1)[1])]
    assert returns[1] == pytest.approx(alone[0])


def test_vector_takes_vehicle_task_options_and_the_number_of_steps():
    heavy = dataclasses.replace(quadrl.Vehicle(), mass=1.3, control_step=0.02)
    vector = gym.make_vec(
        HOVER, num_envs=2, vehicle=heavy, max_episode_steps=3, num_threads=1, tolerance=0.5
    )
    assert vector.environment.simulation.model.body_mass.sum() == pytest.approx(1.3)
    assert vector.environment.task.tolerance == 0.5
    assert vector.metadata["render_fps"] == 50
    vector.reset(seed=0)
    truncated = [vector.step(np.zeros((2, 4)))[3].tolist() for _ in range(3)]
    assert truncated == [[False] * 2, [False] * 2, [True] * 2]


def test_single_takes_vehicle_and_task_options():
    heavy = dataclasses.replace(quadrl.Vehicle(), mass=1.3)
    environment = gym.make(HOVER, vehicle=heavy, horizon=0.15)
    assert environment.unwrapped.environment.simulation.model.body_mass.sum() == pytest.approx(1.3)
    assert len(episode(environment, np.zeros((9, 4)))[1]) == 3  # 0.15 s in steps of 0.05 s


def test_success_is_reported_at_the_end_of_an_episode_alone():
    _, _, infos = episode(gym.make(HOVER, horizon=0.2, tolerance=9.0), np.zeros((9, 4)))
    assert [info["is_success"] for info in infos] == [False, False, False, True]
    _, _, infos = episode(gym.make(HOVER, horizon=0.2, tolerance=1e-6), np.zeros((9, 4)))
    assert not any(info["is_success"] for info in infos)


@pytest.mark.parametrize("count", [None, 3])
def test_a_divergence_ends_the_episode(count):
    environment = gym.make(HOVER) if count is None else gym.make_vec(HOVER, num_envs=count)
    action = np.zeros((4,) if count is None else (count, 4))
    environment.reset(seed=0)
    before = environment.step(action)[0]
    row = ... if count is None else 1
    environment.unwrapped.environment.simulation.qvel[row][..., 0] = 1e12
    observation, _, terminated, truncated, info = environment.step(action)
    expected = True if count is None else [False, True, False]
    np.testing.assert_array_equal(terminated, expected)
    np.testing.assert_array_equal(info["diverged"], expected)
    assert not np.any(truncated)
    np.testing.assert_array_equal(observation[row], before[row])


@pytest.mark.parametrize(
    ("make", "settings", "choices"),
    [
        (gym.make, {"tollerance": 1}, "did you mean tolerance.*choices: horizon"),
        (gym.make, {"task": "hoover"}, r"did you mean hover\?.*choices: .*hover"),
        (door.QuadrotorEnv, {"render_mode": "human"}, "'human'.*rgb_array"),
        (gym.make_vec, {"tollerance": 1}, "did you mean tolerance.*choices: horizon"),
        (gym.make_vec, {"render_mode": "human"}, "'human'.*rgb_array"),
        (gym.make_vec, {"autoreset_mode": "same"}, "unknown autoreset mode 'same'.*SAME_STEP"),
        (gym.make_vec, {"num_envs": 0}, "num_envs = 0: a whole number from 1"),
    ],
)
def test_an_unknown_name_lists_the_choices(make, settings, choices):
    with pytest.raises(OptionError, match=choices):
        make(*([] if make is door.QuadrotorEnv else [HOVER]), **settings)


@pytest.mark.parametrize(
    ("count", "action", "message"),
    [
        (None, np.zeros(3), r"shape \(3,\) was given; \(4,\) is expected"),
        (None, np.array([0, 0, 0, np.inf]), r"action\[3\] is inf"),
        (2, np.zeros((3, 4)), r"shape \(3, 4\) was given; \(2, 4\) is expected"),
        (2, np.array([[0] * 4, [0, np.nan, 0, 0]]), r"action\[1, 1\] is nan"),
    ],
)
def test_an_impossible_action_is_refused(count, action, message):
    environment = gym.make(HOVER) if count is None else gym.make_vec(HOVER, num_envs=count)
    environment.reset()
    environment.step(np.zeros((4,) if count is None else (count, 4)))
    with pytest.raises(ActionError, match=message):
        environment.step(action)


PICTURE = {"render_mode": "rgb_array", "width": 160, "height": 96}


def alike(one, other):
    """Whether two pictures show the same; software rendering is off by a level here and there."""
    return np.abs(one.astype(int) - other).max() <= 8


@every_task
def test_render_draws_the_flight_and_two_environments_take_turns(id):
    one, other = (gym.make(id, **PICTURE) for _ in range(2))
    one.reset(seed=0)
    other.reset(seed=1)
    first, between = one.render(), other.render()
    assert first.shape == (96, 160, 3)
    assert first.dtype == np.uint8
    assert first.reshape(-1, 3).std(axis=0).min() > 5  # not blank
    assert alike(one.render(), first)
    assert not alike(first, between)
    for _ in range(10):
        one.step(np.ones(4, dtype=np.float32))
    assert not alike(one.render(), first)
    assert alike(other.render(), between)
    one.close()
    assert alike(other.render(), between)
    other.close()


def test_the_goal_is_drawn():
    # Seen from where it does not move with the aircraft, the goal of hover is all that is green.
    environment = gym.make(HOVER, camera="fixed", **PICTURE)
    environment.reset(seed=0)
    red, green, blue = environment.render().astype(int).reshape(-1, 3).T
    assert ((green > red + 20) & (green > blue + 20)).sum() > 5
    environment.close()


def test_render_of_a_vector_has_a_picture_a_row():
    single, vector = gym.make(HOVER, **PICTURE), gym.make_vec(HOVER, num_envs=2, **PICTURE)
    single.reset(seed=4)
    vector.reset(seed=3)
    frames = vector.render()
    assert len(frames) == 2
    assert alike(frames[1], single.render())
    assert not alike(*frames)
    single.close()
    vector.close()


def test_without_a_render_mode_nothing_is_drawn():
    for environment in (gym.make(HOVER).unwrapped, gym.make_vec(HOVER, num_envs=2)):
        environment.reset()
        assert environment.render() is None


@every_task
def test_stable_baselines3_trains_a_few_steps(id):
    from stable_baselines3 import PPO

    environment = gym.make(id, horizon=0.5)
    model = PPO("MlpPolicy", environment, n_steps=32, batch_size=32, n_epochs=1, device="cpu")
    before = [parameter.clone() for parameter in model.policy.parameters()]
    model.learn(64)
    assert model.num_timesteps == 64
    assert any(
        not old.equal(new) for old, new in zip(before, model.policy.parameters(), strict=True)
    )
    assert model.ep_info_buffer[0]["l"] <= 10  # 0.5 s in steps of 0.05 s
