"""TorchRL's batched environment, and TorchRL's wrappers of the other APIs."""

import gymnasium as gym
import pytest
import torch
from helpers import needs_dm_control
from tensordict.nn import TensorDictModule
from torchrl.envs import DMControlEnv, EnvBase, GymWrapper
from torchrl.envs.utils import check_env_specs

import quadrl
from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.tasks import TASKS
from quadrl.testing import varied_actions

COUNT = 4
ACTIONS = torch.from_numpy(varied_actions(60, COUNT))


def policy(actions, sees="observation"):
    """Gives one action after the other, whatever it sees."""
    turn = iter(actions)
    return TensorDictModule(lambda _: next(turn), in_keys=[sees], out_keys=["action"])


def rollout(environment):
    """A rollout of ACTIONS, [N, T]; resets are in between."""
    return environment.rollout(len(ACTIONS), policy(ACTIONS), break_when_any_done=False)


@pytest.mark.parametrize("task", ["hover", "target_following"])
def test_episodes_begin_anew_as_torchrl_itself_would_have_it(task):
    one, other = (QuadrotorEnv(task, COUNT, seed=0, time_limit=0.6) for _ in range(2))
    met = again = one.reset()
    other.reset()
    memory = torch.rand(COUNT, 3, 2)  # of a policy: it ends with its episode
    begun = 0
    for t, action in enumerate(ACTIONS[:40]):
        now = one.step(met.set("action", action).set("memory", memory))
        same = other.step(again.set("action", action).set("memory", memory))
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


@pytest.mark.parametrize("mode", ["DISABLED", "SAME_STEP"])
@pytest.mark.parametrize("name", ["hover", "target_following"])
def test_torchrls_gymnasium_wrapper_sees_the_same_episodes(name, mode):
    # With SAME_STEP the wrapper resets once more when every row ends at once, Gymnasium's own
    # vectors too; here the climb and the dive end before the others.
    limit = 2.4
    ours = rollout(QuadrotorEnv(name, COUNT, seed=5, time_limit=limit))
    assert 3 <= ours["next", "done"].sum()
    assert not ours["next", "done"].all(0).any()
    vector = gym.make_vec(
        TASKS[name].gymnasium_id(), num_envs=COUNT, time_limit=limit, autoreset_mode=mode
    )
    environment = GymWrapper(vector)
    check_env_specs(environment)
    vector.environment.seed(5)  # environment.set_seed would use up the first episodes
    theirs = rollout(environment)
    for key in ("observation", "reward", "done", "terminated", "truncated"):
        assert torch.equal(theirs["next", key], ours["next", key]), key
    assert torch.equal(theirs["observation"], ours["observation"])


@pytest.mark.slow
def test_torchrls_dm_control_environment_after_register():
    needs_dm_control()
    quadrl.suite.register()
    for name in TASKS:
        environment = DMControlEnv("quadrotor", name)
        check_env_specs(environment)
        assert environment.rollout(5)["next", "goal"].shape == (5, 3)
