"""Training: the same seed, checkpoints that lose nothing, what the critic sees, the metrics."""

import dataclasses
import os
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from helpers import refused
from runs import TINY, assert_same_run, changed, contents, metrics, stopped, train
from safetensors.torch import save as to_safetensors
from tensordict import TensorDict

import quadrl
from quadrl.core.environment import Environment
from quadrl.engines import native
from quadrl.learning import checkpoint
from quadrl.learning.advantages import add_values
from quadrl.learning.defaults import ALGORITHMS
from quadrl.learning.environments import SEED_STRIDE
from quadrl.learning.folder import WARNINGS
from quadrl.learning.train import Training


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run that nobody disturbed; not to be written to."""
    return train(TINY, tmp_path_factory.mktemp("runs") / "finished")


@pytest.fixture
def copy(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "copy"))


def test_same_seed_same_run_on_any_threads_of_torch(finished, tmp_path):
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        assert_same_run(finished, train(TINY, tmp_path / "run"))
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("seed", [1, 2**32 - 1])
def test_another_seed_is_another_run(finished, tmp_path, seed):
    other = train(changed(seed=seed), tmp_path / "other")
    ours, theirs = quadrl.Policy.load(finished), quadrl.Policy.load(other)
    for a, b in zip(ours.weights, theirs.weights, strict=True):
        assert (a != b).mean() > 0.9
    assert (ours.mean != theirs.mean).all()  # the episodes are others, too
    assert theirs.metadata["seed"] == seed


# --------------------------------------------------------------------------- checkpoints


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_algorithm_continues_where_it_was_stopped(tmp_path, algo):
    # A task with a state of its own; six rotors, and commands that are not theirs. One algorithm
    # differentiates the rotors' own, and the teacher of another flies quadrotors.
    vehicle, rotors, mode, numbers = {
        "apg": ("hexa", 6, "rotor", 6),
        "dagger": ("racer", 4, "share_of_x", 4),
    }.get(algo, ("hexa", 6, "velocity", 4))
    other = {"task": "target_following", "vehicle": vehicle, "control_mode": mode}
    if algo == "dagger":  # what the teacher is asked about
        other["observe"] = {"action_history": 2, "sensors": {"level": {}}}
    config = changed(algo=algo, **other)
    alone = train(config, tmp_path / "alone")
    stopped(config, tmp_path / "run", 1)
    stopped(config, tmp_path / "run", 3, resume=True)
    folder = stopped(config, tmp_path / "run", 6, resume=True)
    assert len(metrics(folder)) == 6
    assert quadrl.Policy.load(folder).metadata["steps"] == 5 * 32  # of the last checkpoint
    assert_same_run(alone, train(config, tmp_path / "run", resume=True))
    policy = quadrl.Policy.load(alone)
    assert policy.metadata["algo"] == algo and policy.action_size == numbers
    assert (policy.metadata["vehicle"]["name"], policy.metadata["rotors"]) == (vehicle, rotors)
    assert policy.control_mode == config.conditions["control_mode"] == mode


def test_a_training_of_several_tasks_continues_with_their_returns(tmp_path):
    tasks = {"task": "one_of", "task_options": {"members": ["hover", "landing"]}}
    config = changed(**tasks, gammas=(0.9, 0.97))
    alone = train(config, tmp_path / "alone")
    stopped(config, tmp_path / "run", 3)
    assert_same_run(alone, train(config, tmp_path / "run", resume=True))


def test_an_uncertain_training_continues_and_its_policy_knows_what_it_met(tmp_path):
    config = changed(
        randomization="full",
        weather="light",
        aerodynamics="rotor_drag",
        observe={"action_history": 1, "rotor_speed": "estimated", "privileged": True},
    )
    alone = train(config, tmp_path / "alone")
    stopped(config, tmp_path / "run", 3)
    assert_same_run(alone, train(config, tmp_path / "run", resume=True))
    policy = quadrl.Policy.load(alone)
    seen = quadrl.Observing(action_history=1, rotor_speed="estimated")
    assert policy.scenario.observe == seen
    assert policy.metadata["aerodynamics"] == "rotor_drag"
    drawn = quadrl.Randomization(**policy.conditions["randomization"])
    assert drawn == quadrl.RANDOMIZATIONS["full"]
    # An evaluation is that of the training unless it is told otherwise.
    usual, same, ideal = (
        quadrl.evaluate(policy, episodes=4, **given).metrics["return_mean"]
        for given in (
            {},
            {"randomization": "full", "weather": "light", "aerodynamics": "rotor_drag"},
            {"randomization": "none", "weather": "calm", "aerodynamics": "none"},
        )
    )
    assert usual == same != ideal


def test_stopped_again_and_again_between_rare_checkpoints(finished, tmp_path):
    rare = changed(checkpoint_seconds=1e9)
    folder = stopped(rare, tmp_path / "run", 4)
    assert not (folder / checkpoint.CHECKPOINT).exists()  # before the first: from the start
    stopped(TINY, folder, 4, resume=True)
    assert checkpoint.load(folder / checkpoint.CHECKPOINT)[1]["iteration"] == 3
    stopped(rare, folder, 6, resume=True)
    with open(folder / "metrics.csv", "a") as file:
        file.write("99,99,nonsense\n5,160,0.1")
    for name in (checkpoint.CHECKPOINT, "policy.safetensors", "learning_curve.png"):
        (folder / f"{name}.part").write_bytes(b"half")  # as a kill leaves it
    # What lies after the checkpoint is written again.
    training = Training(TINY, folder, resume=True)
    assert training.iteration == 3 and not list(folder.glob("*.part"))
    training.run()
    assert_same_run(finished, folder)


def test_resuming_a_finished_run_changes_nothing(finished, copy):
    before = contents(copy)
    training = Training(TINY, copy, resume=True)
    policy = training.run()
    assert contents(copy) == before and training.seconds > 0
    for a, b in zip(policy.weights, quadrl.Policy.load(finished).weights, strict=True):
        np.testing.assert_array_equal(a, b)
    # Stopped between its last checkpoint and the policy, it writes the policy.
    file = copy / "policy.safetensors"
    file.unlink()
    assert_same_run(finished, train(TINY, copy, resume=True))
    dataclasses.replace(quadrl.Policy.load(copy), task="of an earlier checkpoint").save(file)
    assert_same_run(finished, train(TINY, copy, resume=True))


def test_two_trainings_do_not_share_a_folder(finished, tmp_path):
    folder = stopped(TINY, tmp_path / "run", 4)
    first = Training(TINY, folder, resume=True)
    before = contents(folder)
    for resume in (True, False):  # a new run does not touch an old one either
        with refused():
            Training(TINY, folder, resume=resume)
    assert contents(folder) == before
    first.run()
    assert_same_run(finished, folder)
    train(TINY, folder, resume=True)  # its end has unlocked it


def half(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def rewritten(change):
    def damage(path):
        tensors, numbers = checkpoint.load(path)
        change(tensors, numbers)
        checkpoint.save(path, tensors, numbers)

    return damage


DAMAGES = {
    "truncated": half,
    "foreign": lambda path: path.write_bytes(to_safetensors({"weight": torch.zeros(3)})),
    "missing": Path.unlink,
    "networks": rewritten(lambda t, n: t.update(actor={k: torch.zeros(17) for k in t["actor"]})),
    "part": rewritten(lambda t, n: t.pop("environment")),
    "settings": rewritten(lambda t, n: n.pop("config")),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_refused_and_nothing_is_touched(copy, damage):
    DAMAGES[damage](copy / checkpoint.CHECKPOINT)
    before = contents(copy)
    with refused() as caught:
        Training(TINY, copy, resume=True)
    assert str(copy / checkpoint.CHECKPOINT) in str(caught.value)
    assert contents(copy) == before


@pytest.mark.parametrize(
    ("change", "name", "value"),
    [({"task": "random_waypoint"}, "task", "hover"), ({"gamma": 0.5}, "gamma", TINY.gamma)],
)
def test_a_checkpoint_of_another_run_is_refused(copy, tmp_path, change, name, value):
    # The networks are of one size, so nothing else would notice.
    other = stopped(changed(**change), tmp_path / "other", 2)
    shutil.copy(other / checkpoint.CHECKPOINT, copy)
    with refused(name, value):
        Training(TINY, copy, resume=True)


def test_a_checkpoint_of_another_version_is_refused_and_one_without_a_new_setting_is_not(copy):
    path = copy / checkpoint.CHECKPOINT
    rewritten(lambda t, n: n["config"]["ppo"].pop("fused"))(path)
    Training(TINY, copy, resume=True).run()
    rewritten(lambda t, n: n["config"]["versions"].update(torch="0.0.7"))(path)
    with refused("versions.torch", allowed="'0.0.7'"):
        Training(TINY, copy, resume=True)


@pytest.mark.parametrize("name", [checkpoint.CHECKPOINT, "policy.safetensors", "metrics.csv"])
def test_a_full_disk_does_not_destroy_what_is_there(finished, tmp_path, monkeypatch, name):
    folder = stopped(TINY, tmp_path / "run", 4)
    before = contents(folder)
    replace = os.replace

    def full(written, path):
        if path.name == name:
            raise OSError(28, "No space left on device")
        replace(written, path)

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", full)
        with pytest.raises(OSError):
            Training(TINY, folder, resume=True).run()
    if name in before:
        assert (folder / name).read_bytes() == before[name]
    assert not list(folder.glob("*.part"))
    assert_same_run(finished, train(TINY, folder, resume=True))


def test_mujocos_warnings_stand_in_the_run_folder(tmp_path, capfd):
    def diverge(progress):
        training.env.environment.engine.qvel[:] = np.nan

    training = Training(changed(engine="mujoco"), tmp_path / "run")
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(native.library().warning)  # another test's may be there
    try:
        training.run(diverge)
    finally:
        mujoco.set_mju_user_warning(before)
    assert "huge value in Q" in (tmp_path / "run" / WARNINGS).read_text()
    assert "MuJoCo" not in "".join(capfd.readouterr())


def test_a_diverged_training_says_so_and_keeps_no_policy(tmp_path):
    wild = changed(ppo={"learning_rate": 1e30, "epochs": 2, "minibatch": 16})
    with refused():
        train(wild, tmp_path / "run")
    assert not (tmp_path / "run" / "policy.safetensors").exists()
    assert not (tmp_path / "run" / checkpoint.CHECKPOINT).exists()


# --------------------------------------------------------------------------- the algorithm


def test_values_continue_at_truncation_and_not_at_termination(tmp_path):
    training = Training(changed(gamma=0.5, gae_lambda=0.5), tmp_path / "run")
    for parameter in training.critic.parameters():
        parameter.data.zero_()
    list(training.critic.parameters())[-1].data.fill_(10.0)  # every value is 10

    def targets(terminated, truncated):
        """Value targets of two steps of one aircraft with rewards 1 and 2."""

        def column(values, kind):
            return torch.tensor(values, dtype=kind).reshape(1, 2, 1)

        observation = torch.zeros(1, 2, training.env.environment.size)
        terminated, truncated = (column(x, torch.bool) for x in (terminated, truncated))
        after = {
            "observation": observation.clone(),
            "reward": column([1.0, 2.0], torch.float32),
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }
        batch = TensorDict({"observation": observation}, [1, 2], names=[None, "time"])
        batch["next"] = TensorDict(after, [1, 2])
        with torch.no_grad():
            add_values(batch, training.critic)
            training.advantages(batch, np.zeros((1, 2), int))
        return batch["value_target"].flatten().tolist()

    # Two steps of one episode: delta_1 = 2 + 5 - 10 = -3, so A_1 = -3 and the target is 7;
    # delta_0 = 1 + 5 - 10 = -4, A_0 = -4 + 0.25 * -3 = -4.75: 5.25.
    assert targets([False, False], [False, False]) == [5.25, 7.0]
    # The second is cut off by the clock: the value of where it was counts as before.
    assert targets([False, False], [False, True]) == [5.25, 7.0]
    # The second ends it: delta_1 = 2 - 10 = -8: 2, and A_0 = -4 + 0.25 * -8 = -6: 4.
    assert targets([False, True], [False, False]) == [4.0, 2.0]
    # The first step ends its episode or is cut off: the second belongs to another and does not
    # count; A_0 = delta_0 = 1 - 10 = -9, or 1 + 5 - 10 = -4.
    assert targets([True, False], [False, False]) == [1.0, 7.0]
    assert targets([False, False], [True, False]) == [6.0, 7.0]


def test_the_critic_sees_the_last_observation_of_an_episode_not_the_next_first(tmp_path):
    training = Training(TINY, tmp_path / "run")
    seen = []
    learn = training._learn
    training._learn = lambda batch: (seen.append(batch.clone()), learn(batch))[1]
    training.run()
    environment = Environment(TINY.training_scenario, num_envs=8, seed=TINY.seed * SEED_STRIDE)
    observation = environment.flatten(environment.reset())
    ends = 0
    for batch in seen:
        add_values(batch, training.critic)
        expected = training.critic(batch["next"].select("observation"))["state_value"]
        torch.testing.assert_close(batch["next", "state_value"], expected)
        for t in range(TINY.rollout):
            row = batch[:, t]
            np.testing.assert_array_equal(row["observation"], observation)
            now = environment.step(row["action"].numpy())
            final = environment.flatten(now.observation)
            np.testing.assert_array_equal(row["next", "observation"], final)
            np.testing.assert_array_equal(row["next", "terminated"][:, 0], now.terminated)
            np.testing.assert_array_equal(row["next", "truncated"][:, 0], now.truncated)
            over, observation = now.terminated | now.truncated, final.copy()
            if over.any():
                observation[over] = environment.flatten(environment.reset(over))
                assert (observation[over] != final[over]).any(-1).all()
                ends += over.sum()
    assert ends == 16  # 24 steps of 8 aircraft, whose episodes last 10


def test_the_metrics_are_those_of_the_episodes(finished):
    rows = metrics(finished)
    assert [int(row["iteration"]) for row in rows] == [1, 2, 3, 4, 5, 6]
    assert [int(row["steps"]) for row in rows] == [32, 64, 96, 128, 160, 192]
    # 8 aircraft with episodes of 10 steps in batches of 4: they end in the third and the fifth.
    assert [float(row["episodes"]) for row in rows] == [0, 0, 8, 0, 8, 0]
    assert [row["length"] for row in rows] == ["", "", "10", "", "10", ""]
    assert all(row["survival"] == "1" for row in rows[2::2])
    # 10 points a step for being in the air, and the progress of an episode on top of it.
    assert 0 < float(rows[2]["return"]) < 200
