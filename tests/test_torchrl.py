"""Door three: TorchRL's batched environment, and TorchRL's wrappers of the other two doors."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import DMControlEnv, DMControlWrapper, EnvBase, GymWrapper
from torchrl.envs.utils import check_env_specs

import quadrl
from quadrl import testing
from quadrl.environment import ActionError
from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.task import OptionError
from quadrl.tasks import TASKS

every_task = pytest.mark.parametrize("name", TASKS)
COUNT = 4
ACTIONS = torch.from_numpy(testing.varied_actions(60, COUNT))


def policy(actions, sees="observation"):
    """Gives one action after the other, whatever it sees."""
    turn = iter(actions)
    return TensorDictModule(lambda _: next(turn), in_keys=[sees], out_keys=["action"])


def rollout(environment):
    """A rollout of ACTIONS, [N, T]; resets are in between."""
    return environment.rollout(len(ACTIONS), policy(ACTIONS), break_when_any_done=False)


@pytest.mark.parametrize("reward_terms", [False, True])
@every_task
def test_torchrls_check_passes(name, reward_terms):
    check_env_specs(QuadrotorEnv(name, COUNT, seed=0, reward_terms=reward_terms))


@every_task
def test_a_seed_gives_the_episodes(name):
    one = rollout(QuadrotorEnv(name, COUNT, seed=3, horizon=0.5))
    same, other = QuadrotorEnv(name, COUNT, horizon=0.5), QuadrotorEnv(name, COUNT, horizon=0.5)
    same.set_seed(3)
    other.set_seed(3 + COUNT)
    assert torch.equal(one["next", "observation"], rollout(same)["next", "observation"])
    assert not torch.equal(one["observation"][:, 0], rollout(other)["observation"][:, 0])


def test_shapes_types_and_flags_are_those_of_torchrl():
    environment = QuadrotorEnv("hover", COUNT, seed=0, horizon=0.5, tolerance=9.0)
    flown = rollout(environment)
    assert environment.num_envs == COUNT
    assert environment.batch_size == torch.Size([COUNT])
    assert flown["action"].shape == (COUNT, 60, 4)
    after = flown["next"]
    assert after["observation"].dtype == after["reward"].dtype == torch.float32
    assert after["reward"].shape == after["done"].shape == (COUNT, 60, 1)
    over = after["terminated"] | after["truncated"]
    assert torch.equal(after["done"], over)
    assert not (after["terminated"] & after["truncated"]).any()
    # Episodes of ten steps, all of them successful with such a tolerance.
    every_tenth = (torch.arange(60) % 10 == 9).expand(COUNT, 60)[..., None]
    assert torch.equal(after["truncated"], every_tenth)
    assert torch.equal(after["is_success"], every_tenth)
    # The final observation stays, and the next step meets that of the new episode.
    end, start = after["observation"][:, :-1], flown["observation"][:, 1:]
    assert torch.equal((end != start).any(-1), every_tenth[:, :-1, 0])


def test_the_terms_of_the_reward_add_up():
    after = rollout(QuadrotorEnv("hover", COUNT, seed=0, reward_terms=True))["next"]
    terms = after["reward_terms"]
    assert {"progress", "control", "survival"} <= set(terms.keys())
    torch.testing.assert_close(sum(terms.values()), after["reward"], rtol=1e-5, atol=1e-4)


def test_a_partial_reset_leaves_the_other_rows_alone():
    environment = QuadrotorEnv("hover", COUNT, seed=0)
    met = environment.reset()
    for action in ACTIONS[:5]:
        met = environment.step(met.set("action", action))["next"]
    before, states = met.clone(), environment.environment.simulation.qpos.copy()
    mask = torch.tensor([[False], [True], [False], [True]])
    after = environment.reset(met.set("_reset", mask))
    keep = ~mask[:, 0]
    for name in ("observation", "error"):
        assert torch.equal(after[name][keep], before[name][keep])
        assert not torch.equal(after[name][~keep], before[name][~keep])
    np.testing.assert_array_equal(environment.environment.simulation.qpos[keep], states[keep])
    second = QuadrotorEnv("hover", COUNT, seed=0)
    second.reset()
    assert torch.equal(after["observation"][~keep], second.reset()["observation"][~keep])


@pytest.mark.parametrize("task", ["hover", "target_following"])
def test_episodes_begin_anew_as_torchrl_itself_would_have_it(task):
    one, other = (QuadrotorEnv(task, COUNT, seed=0, horizon=0.6) for _ in range(2))
    met = again = one.reset()
    other.reset()
    begun = 0
    for t, action in enumerate(ACTIONS[:40]):
        now = one.step(met.set("action", action))
        same = other.step(again.set("action", action))
        assert (now == same).all()
        begun += int(now["next", "done"].sum())
        met, again = one.step_mdp(now), other.step_mdp(same)
        if t == 20:  # some of them over at other times than the rest
            for flags in (met, again):
                flags.set("done", torch.tensor([[True], [False], [False], [True]]))
        met, again = one.maybe_reset(met), EnvBase.maybe_reset(other, again)
        assert set(met.keys()) == set(again.keys())
        for name in met.keys():  # noqa: SIM118
            assert torch.equal(met[name], again[name]), (t, name)
    assert begun > COUNT


@pytest.mark.parametrize("reward_terms", [False, True])
def test_what_is_handed_out_is_never_changed_later(reward_terms):
    environment = QuadrotorEnv("hover", COUNT, seed=0, horizon=0.2, reward_terms=reward_terms)
    met = environment.reset()
    handed_out, copies = [met], [met.clone()]
    for action in ACTIONS[:12]:
        now, met = environment.step_and_maybe_reset(met.clone().set("action", action))
        handed_out += [now, met]
        copies += [now.clone(), met.clone()]
    for given, copy in zip(handed_out, copies, strict=True):
        assert (given == copy).all()


def test_a_restored_environment_goes_on_where_it_was_saved():
    environment = QuadrotorEnv("hover", COUNT, seed=0, horizon=0.5)
    met = environment.reset()
    for action in ACTIONS[:14]:
        _, met = environment.step_and_maybe_reset(met.set("action", action))
    other = QuadrotorEnv("hover", COUNT, seed=99, horizon=0.5)
    other.restore(environment.environment.save())
    again = other.reset()
    assert torch.equal(met["observation"], again["observation"])
    for action in ACTIONS[14:40]:
        one, met = environment.step_and_maybe_reset(met.set("action", action))
        same, again = other.step_and_maybe_reset(again.set("action", action))
        for name in ("observation", "reward", "done"):
            assert torch.equal(one["next", name], same["next", name])
        assert torch.equal(met["observation"], again["observation"])


def test_vehicle_and_task_options_arrive():
    heavy = dataclasses.replace(quadrl.Vehicle(), mass=1.3)
    environment = QuadrotorEnv("hover", 2, vehicle=heavy, tolerance=0.5).environment
    assert environment.simulation.model.body_mass.sum() == pytest.approx(1.3)
    assert environment.task.tolerance == 0.5


@pytest.mark.parametrize(
    ("arguments", "options", "choices"),
    [
        (("hoover", 2), {}, r"did you mean hover\?.*choices: .*hover"),
        (("hover", 2), {"tollerance": 1}, "did you mean tolerance.*choices: horizon"),
        (("hover", 0), {}, "num_envs = 0: a whole number from 1"),
    ],
)
def test_an_unknown_name_lists_the_choices(arguments, options, choices):
    with pytest.raises(OptionError, match=choices):
        QuadrotorEnv(*arguments, **options)


def test_an_action_that_is_not_finite_is_refused():
    environment = QuadrotorEnv("hover", 2)
    action = torch.zeros(2, 4)
    action[1, 2] = torch.nan
    with pytest.raises(ActionError, match=r"action\[1, 2\] is nan"):
        environment.step(environment.reset().set("action", action))


@pytest.mark.parametrize(
    "settings",
    [{"autoreset_mode": "DISABLED"}, {"autoreset_mode": "SAME_STEP", "reward_terms": False}],
)
@every_task
def test_torchrls_gymnasium_wrapper_sees_the_same_episodes(name, settings):
    # Of SAME_STEP the wrapper resets once more when every row ends at once, Gymnasium's own
    # vectors too; here the climb and the dive end before the others.
    horizon = testing.EPISODE
    ours = rollout(QuadrotorEnv(name, COUNT, seed=5, horizon=horizon))
    assert 3 <= ours["next", "done"].sum()
    assert not ours["next", "done"].all(0).any()
    id = f"quadrl/{name.title().replace('_', '')}-v0"
    vector = gym.make_vec(id, num_envs=COUNT, horizon=horizon, **settings)
    environment = GymWrapper(vector)
    check_env_specs(environment)
    vector.environment.seed(5)  # environment.set_seed would use up the first episodes
    theirs = rollout(environment)
    for key in ("observation", "reward", "done", "terminated", "truncated"):
        assert torch.equal(theirs["next", key], ours["next", key]), key
    assert torch.equal(theirs["observation"], ours["observation"])


@every_task
def test_torchrls_dm_control_environment_after_register(name):
    quadrl.suite.register()
    environment = DMControlEnv("quadrotor", name)
    check_env_specs(environment)
    assert environment.rollout(5)["next", "goal"].shape == (5, 3)


@every_task
def test_torchrls_dm_control_wrapper_tells_a_crash_from_the_clock(name):
    def ends(**task_kwargs):
        environment = DMControlWrapper(quadrl.load(name, {"random": 0} | task_kwargs))
        dive = torch.full((1000, 4), -1.0, dtype=torch.float64)
        last = environment.rollout(1000, policy(dive, sees="goal"))[-1]["next"]
        return last["done"].item(), last["terminated"].item(), last["truncated"].item()

    assert ends() == (True, True, False)
    assert ends(time_limit=0.2) == (True, False, True)
