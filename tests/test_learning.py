"""Training, its checkpoints and its judgement."""

import csv
import dataclasses
import json
import math
import multiprocessing
import os
import random
import resource
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save as to_safetensors
from tensordict import TensorDict

import quadrl
from quadrl.environment import Environment
from quadrl.learning import checkpoint
from quadrl.learning.config import (
    ALGORITHMS,
    ConfigError,
    GAEConfig,
    PPOConfig,
    RunError,
    TrainConfig,
    TRPOConfig,
    make_task,
    parse_options,
    read_config,
)
from quadrl.learning.evaluate import EVALUATION_SEED, Record, fly, judge
from quadrl.learning.figures import FigureError, learning_curve, read_metrics, trajectory
from quadrl.learning.policy import Normaliser, export, make_actor_critic
from quadrl.learning.train import SEED_STRIDE, Training
from quadrl.task import OptionError

# 6 batches of 32 transitions; episodes of 10 steps, so that many end in between.
TINY = TrainConfig(
    num_envs=8,
    rollout=4,
    steps=8 * 4 * 6,
    hidden=(16,),
    critic_hidden=(16,),
    task_options=("horizon=0.5",),
    checkpoint_seconds=0.0,
    ppo=PPOConfig(epochs=2, minibatch=16),
)
LONG = dataclasses.replace(TINY, steps=8 * 4 * 30)
OUTPUTS = ("policy.safetensors", "metrics.csv")


def metrics(folder: Path) -> list[dict[str, str]]:
    """The rows of metrics.csv but for the wall clock."""
    with open(folder / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def train(config: TrainConfig, folder: Path, *, resume: bool = False) -> Path:
    Training(config, folder, resume=resume).run()
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def evaluated(folder: Path) -> dict[str, float]:
    config = TrainConfig.of_folder(folder)
    task = make_task(config.task, config.options)
    return judge(fly(quadrl.Policy.load(folder), task, episodes=4))


def assert_same_run(a: Path, b: Path) -> None:
    """Weights, normaliser and header; metrics; evaluation."""
    assert (a / "policy.safetensors").read_bytes() == (b / "policy.safetensors").read_bytes()
    assert metrics(a) == metrics(b)
    assert evaluated(a) == evaluated(b)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run that nobody disturbed; not to be written to."""
    return train(TINY, tmp_path_factory.mktemp("runs") / "finished")


@pytest.fixture
def copy(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "copy"))


# The normaliser and the networks.


@pytest.mark.parametrize("sizes", [(500,), (1, 1, 1, 1, 1, 200), (3, 497), (100,) * 5])
def test_normaliser_is_the_mean_and_deviation_of_everything(sizes):
    generator = np.random.default_rng(0)
    rows = generator.normal([5.0, -3.0, 0.0], [2.0, 0.01, 100.0], (sum(sizes), 3))
    normaliser, first = Normaliser(3), 0
    for size in sizes:
        normaliser.update(torch.from_numpy(rows[first : first + size]))
        first += size
        seen = rows[:first]
        np.testing.assert_allclose(normaliser.mean, seen.mean(0), rtol=1e-12)
        deviation = np.maximum(seen.std(0), 1e-4)  # of one row, it is nothing
        np.testing.assert_allclose(normaliser.deviation, deviation, rtol=1e-5)
    assert normaliser.count == sum(sizes)
    expected = np.clip((rows - rows.mean(0)) / rows.std(0), -10, 10)
    got = normaliser(torch.from_numpy(rows).float())
    np.testing.assert_allclose(got, expected, atol=1e-3)


def test_normaliser_takes_batches_of_any_shape():
    rows = torch.randn(4, 6, 3, generator=torch.Generator().manual_seed(0))
    one, other = Normaliser(3), Normaliser(3)
    one.update(rows)
    other.update(rows.reshape(-1, 3))
    torch.testing.assert_close(one.state_dict(), other.state_dict())


def test_normaliser_far_from_zero_loses_no_digits():
    # The sum of squares minus the square of the sum would have lost all of them.
    rows = 1e6 + np.random.default_rng(0).normal(0, 1e-2, (1000, 1))
    normaliser = Normaliser(1)
    for part in np.split(rows, 10):
        normaliser.update(torch.from_numpy(part))
    np.testing.assert_allclose(normaliser.deviation, rows.std(0), rtol=1e-6)


@pytest.mark.parametrize("hidden", [(), (7,), (16, 5)])
def test_exported_policy_is_the_actors_mean(hidden, tmp_path):
    torch.manual_seed(0)
    actor, _, normaliser = make_actor_critic(
        6, 4, hidden=hidden, critic_hidden=(3,), initial_deviation=0.5
    )
    for parameter in actor.parameters():
        parameter.data += 0.3 * torch.randn_like(parameter)
    observations = 4 * torch.randn(1000, 6) + 2
    normaliser.update(observations[:50])
    policy = export(actor, "hover", {})
    with torch.no_grad():
        mean = actor.get_dist(TensorDict({"observation": observations}, [1000])).mean
    assert (mean.abs() > 1).any() and (mean.abs() < 1).any()
    np.testing.assert_allclose(policy(observations.numpy()), mean.clamp(-1, 1), atol=1e-6)
    policy.save(tmp_path / "policy.safetensors")
    again = quadrl.Policy.load(tmp_path)(observations.numpy())
    np.testing.assert_array_equal(again, policy(observations.numpy()))


def test_actions_start_with_the_deviation_that_was_asked_for():
    torch.manual_seed(0)
    actor, _, normaliser = make_actor_critic(
        6, 4, hidden=(16,), critic_hidden=(3,), initial_deviation=0.5
    )
    observations = torch.randn(100, 6)
    normaliser.update(observations)
    with torch.no_grad():
        batch = actor(TensorDict({"observation": observations}, [100]))
    np.testing.assert_allclose(batch["scale"], 0.5, atol=0.02)
    np.testing.assert_allclose(batch["loc"], 0.0, atol=0.05)


# The same seed.


def test_same_seed_same_run(finished, tmp_path):
    assert_same_run(finished, train(TINY, tmp_path / "again"))


@pytest.mark.parametrize(("engine", "num_envs"), [("mujoco", 8), ("flight", 1000)])
def test_threads_change_nothing(tmp_path, engine, num_envs):
    # A thread of free flight is worth 256 aircraft; landing's come down into MuJoCo's hands.
    config = dataclasses.replace(
        TINY,
        task="landing",
        task_options=("horizon=0.5", "start_height=0.3"),
        engine=engine,
        num_envs=num_envs,
        steps=num_envs * 4 * 6,
        ppo=PPOConfig(epochs=1, minibatch=num_envs),
    )
    one, *others = (
        train(dataclasses.replace(config, num_threads=n), tmp_path / str(n)) for n in (1, 2, 3)
    )
    for other in others:
        assert_same_run(one, other)


def test_other_threads_of_torch_change_nothing(finished, tmp_path):
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        assert_same_run(finished, train(TINY, tmp_path / "run"))
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_another_seed_is_another_run(finished, tmp_path):
    other = train(dataclasses.replace(TINY, seed=1), tmp_path / "other")
    ours, theirs = quadrl.Policy.load(finished), quadrl.Policy.load(other)
    for name in ("weights", "biases"):
        for a, b in zip(getattr(ours, name), getattr(theirs, name), strict=True):
            assert (a != b).mean() > 0.9
    assert (ours.mean != theirs.mean).all()  # the episodes are others, too


# Checkpoints.


def train_alone(config: TrainConfig, folder: str) -> None:
    """In a process of its own: go on with the run in the folder, or begin it."""
    train(config, Path(folder), resume=(Path(folder) / "config.json").exists())


@pytest.fixture(scope="module")
def processes():
    """Processes that have imported everything already."""
    patch = pytest.MonkeyPatch()
    here = Path(__file__).parent
    patch.setenv("PYTHONPATH", os.pathsep.join(map(str, (Path(quadrl.__file__).parents[1], here))))
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([Path(__file__).stem])
    yield context
    patch.undo()


@pytest.mark.parametrize(
    ("engine", "task", "option", "checkpoint_seconds"),
    [
        ("mujoco", "hover", "radius=0.5", 0.05),
        ("flight", "landing", "start_height=0.3", 0.0),  # down to the ground
    ],
)
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_killed_at_any_moment_it_ends_the_same(
    processes, tmp_path, algo, engine, task, option, checkpoint_seconds
):
    folder = tmp_path / "killed"
    config = dataclasses.replace(
        LONG,
        algo=algo,
        engine=engine,
        task=task,
        task_options=("horizon=0.5", option),
        checkpoint_seconds=checkpoint_seconds,
    )
    undisturbed = train(config, tmp_path / "undisturbed")
    moments, killed_in_training = [], 0
    for _ in range(2):
        process = processes.Process(target=train_alone, args=(config, str(folder)))
        process.start()
        begun = len(metrics(folder)) if (folder / "metrics.csv").exists() else 0
        # From the first row of this process on, at any moment of about the next half second.
        deadline = time.monotonic() + 60
        while process.is_alive() and time.monotonic() < deadline:
            if (folder / "metrics.csv").exists() and len(metrics(folder)) != begun:
                break
            time.sleep(0.002)
        moments.append(random.uniform(0.0, 0.15))
        time.sleep(moments[-1])
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        killed_in_training += process.exitcode == -signal.SIGKILL
    assert killed_in_training >= 1, f"killed {moments} s after the first row"
    process = processes.Process(target=train_alone, args=(config, str(folder)))
    process.start()
    process.join()
    assert process.exitcode == 0
    assert_same_run(undisturbed, folder)
    assert not [p for p in folder.iterdir() if p.suffix == ".part"]


class Stop(Exception):
    pass


def stopped(config: TrainConfig, folder: Path, after: int, *, resume: bool = False) -> Path:
    """A run that stops after the row of an iteration is written, before its checkpoint."""

    def stop(progress):
        if progress.iteration == after:
            raise Stop

    with pytest.raises(Stop):
        Training(config, folder, resume=resume).run(stop)
    return folder


@pytest.mark.parametrize("after", [1, 2, 6])
def test_stopped_after_each_part_of_an_iteration(finished, tmp_path, after):
    folder = stopped(TINY, tmp_path / "run", after)
    assert len(metrics(folder)) == after
    assert not (folder / "policy.safetensors").exists()
    assert_same_run(finished, train(TINY, folder, resume=True))


def test_two_trainings_do_not_share_a_folder(finished, tmp_path, processes):
    folder = stopped(TINY, tmp_path / "run", 4)
    first = Training(TINY, folder, resume=True)
    before = contents(folder)
    with pytest.raises(RunError, match=r"another training works in .*run"):
        Training(TINY, folder, resume=True)
    process = processes.Process(target=train, args=(TINY, folder), kwargs={"resume": True})
    process.start()
    process.join()
    assert process.exitcode == 1
    assert contents(folder) == before
    first.run()
    assert_same_run(finished, folder)
    train(TINY, folder, resume=True)  # its end has set it free


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_algorithm_goes_on_where_it_was_stopped(tmp_path, algo):
    config = dataclasses.replace(TINY, algo=algo)
    alone = train(config, tmp_path / "alone")
    stopped(config, tmp_path / "run", 3)
    stopped(config, tmp_path / "run", 5, resume=True)
    assert_same_run(alone, train(config, tmp_path / "run", resume=True))
    assert quadrl.Policy.load(alone).metadata["algo"] == algo


def test_stopped_again_and_again_between_rare_checkpoints(finished, tmp_path, monkeypatch):
    rare = dataclasses.replace(TINY, checkpoint_seconds=1e9)
    folder = stopped(rare, tmp_path / "run", 4)
    assert not (folder / checkpoint.CHECKPOINT).exists()  # before the first: from the start
    stopped(TINY, folder, 4, resume=True)
    numbers = checkpoint.load(folder / checkpoint.CHECKPOINT)[1]
    assert numbers["iteration"] == 3
    stopped(rare, folder, 6, resume=True)
    # Rows 4 to 6 lie beyond the checkpoint and are written anew.
    assert len(metrics(folder)) == 6
    training = Training(TINY, folder, resume=True)
    assert training.iteration == 3
    training.run()
    assert_same_run(finished, folder)


def test_rows_beyond_the_checkpoint_are_written_anew(finished, tmp_path):
    folder = stopped(TINY, tmp_path / "run", 4)
    with open(folder / "metrics.csv", "a") as file:
        file.write("99,99,nonsense\n5,160,0.1")
    assert_same_run(finished, train(TINY, folder, resume=True))


def test_resuming_a_finished_run_changes_nothing(finished, copy):
    before = contents(copy)
    training = Training(TINY, copy, resume=True)
    policy = training.run()
    assert contents(copy) == before
    for a, b in zip(policy.weights, quadrl.Policy.load(finished).weights, strict=True):
        np.testing.assert_array_equal(a, b)
    assert training.seconds > 0


def test_killed_between_the_last_checkpoint_and_the_policy(finished, copy):
    (copy / "policy.safetensors").unlink()
    assert_same_run(finished, train(TINY, copy, resume=True))


def test_a_new_run_does_not_touch_an_old_one(copy):
    before = contents(copy)
    with pytest.raises(RunError, match="already holds a run.*quadrl train --resume"):
        Training(TINY, copy)
    assert contents(copy) == before


def half(path):
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def flipped(path):
    content = bytearray(path.read_bytes())
    for k in range(8, 16):
        content[k] ^= 0xFF
    path.write_bytes(content)


def foreign(path):
    path.write_bytes(to_safetensors({"weight": torch.zeros(3)}))


def other_version(path):
    header = json.dumps({"format": "quadrl-checkpoint-9", "numbers": {}})
    path.write_bytes(to_safetensors({"weight": torch.zeros(3)}, metadata={"quadrl": header}))


def of_other_networks(path):
    tensors, numbers = checkpoint.load(path)
    tensors["actor"] = {name: torch.zeros(17) for name in tensors["actor"]}
    checkpoint.save(path, tensors, numbers)


def without_its_settings(path):
    tensors, numbers = checkpoint.load(path)
    checkpoint.save(path, tensors, {k: v for k, v in numbers.items() if k != "config"})


def lacking_a_part(path):
    tensors, numbers = checkpoint.load(path)
    tensors.pop("environment")
    checkpoint.save(path, tensors, numbers)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (half, "is damaged or no checkpoint"),
        (flipped, "is damaged or no checkpoint"),
        (lambda path: path.write_bytes(b""), "is damaged or no checkpoint"),
        (foreign, "has the format None; this version of quadrl reads 'quadrl-checkpoint-2'"),
        (other_version, "has the format 'quadrl-checkpoint-9'"),
        (of_other_networks, "does not fit its run"),
        (lacking_a_part, "does not fit its run"),
        (without_its_settings, "does not fit its run: 'config'"),
        (Path.unlink, "there is no checkpoint at"),
    ],
)
def test_a_damaged_checkpoint_is_refused_and_nothing_is_touched(copy, damage, says):
    damage(copy / checkpoint.CHECKPOINT)
    before = contents(copy)
    with pytest.raises(RunError, match=says) as caught:
        Training(TINY, copy, resume=True)
    assert str(copy / checkpoint.CHECKPOINT) in str(caught.value)
    assert contents(copy) == before


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"task": "random_waypoint"}, "task = 'random_waypoint', and here it is 'hover'"),
        ({"task_options": ()}, "task_options = .., and here it is .'horizon=0.5'."),
        ({"vehicle": "racer"}, "vehicle = 'racer', and here it is 'paper'"),
        ({"engine": "mujoco"}, "engine = 'mujoco', and here it is 'flight'"),
        ({"seed": 1}, "seed = 1, and here it is 0"),
        ({"gamma": 0.5}, f"gamma = 0.5, and here it is {TrainConfig.gamma}"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused(copy, tmp_path, change, says):
    # The networks are of one size, so nothing else would notice.
    other = stopped(dataclasses.replace(TINY, **change), tmp_path / "other", 2)
    shutil.copy(other / checkpoint.CHECKPOINT, copy)
    with pytest.raises(RunError, match=f"trained with {says}: .*start a new run") as caught:
        Training(TINY, copy, resume=True)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["quadrl", "mujoco", "torch", "torchrl", "numpy"])
def test_a_checkpoint_of_other_versions_is_refused(copy, name):
    path = copy / checkpoint.CHECKPOINT
    tensors, numbers = checkpoint.load(path)
    numbers["config"]["versions"][name] = "0.0.7"
    checkpoint.save(path, tensors, numbers)
    with pytest.raises(RunError, match=rf"versions\.{name} = '0\.0\.7', and here it is "):
        Training(TINY, copy, resume=True)


class HalfWritten:
    """A file that takes half of what it is given; then `end` happens."""

    def __init__(self, file, end):
        self.file, self.end = file, end

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.file.close()

    def write(self, content):
        self.file.write(content[: len(content) // 2])
        self.file.flush()
        self.end()


def breaking_at(name, end, monkeypatch):
    """Files that are written whole break in the middle of the one that is called so."""

    def opened(path, mode):
        file = open(path, mode)
        return HalfWritten(file, end) if path.name == f"{name}.part" else file

    monkeypatch.setattr("quadrl.policy.open", opened, raising=False)


def full():
    raise OSError(28, "No space left on device")


def killed():
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("name", [checkpoint.CHECKPOINT, "policy.safetensors", "metrics.csv"])
def test_a_full_disk_does_not_destroy_what_is_there(finished, tmp_path, monkeypatch, name):
    folder = stopped(TINY, tmp_path / "run", 4)
    before = contents(folder)
    with monkeypatch.context() as patch:
        breaking_at(name, full, patch)
        with pytest.raises(OSError, match="No space left"):
            Training(TINY, folder, resume=True).run()
    if name in before:
        assert (folder / name).read_bytes() == before[name]
    assert not list(folder.glob("*.part"))
    assert_same_run(finished, train(TINY, folder, resume=True))


def train_with_small_files(folder: str, limit: int) -> None:
    """Go on; the system itself refuses every byte of a file beyond the limit."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    with pytest.raises(OSError, match="File too large"):
        train(TINY, Path(folder), resume=True)


def test_a_file_that_the_system_cuts_short_is_not_the_checkpoint(finished, processes, tmp_path):
    folder = stopped(TINY, tmp_path / "run", 4)
    before = (folder / checkpoint.CHECKPOINT).read_bytes()
    process = processes.Process(
        target=train_with_small_files, args=(str(folder), len(before) - 1000)
    )
    process.start()
    process.join()
    assert process.exitcode == 0
    assert (folder / checkpoint.CHECKPOINT).read_bytes() == before
    assert_same_run(finished, train(TINY, folder, resume=True))


def train_killed_while_writing(folder: str, name: str) -> None:
    breaking_at(name, killed, pytest.MonkeyPatch())
    train(TINY, Path(folder), resume=True)


@pytest.mark.parametrize("name", [checkpoint.CHECKPOINT, "policy.safetensors", "metrics.csv"])
def test_killed_in_the_middle_of_writing_nothing_is_lost(finished, processes, tmp_path, name):
    folder = stopped(TINY, tmp_path / "run", 4)
    before = contents(folder)
    process = processes.Process(target=train_killed_while_writing, args=(str(folder), name))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert (folder / f"{name}.part").exists()
    if name in before:
        assert (folder / name).read_bytes() == before[name]
    assert_same_run(finished, train(TINY, folder, resume=True))
    assert not list(folder.glob("*.part"))


def test_checkpoints_keep_every_kind_of_number(tmp_path):
    tensors = {
        "a": {"b": torch.arange(3), "c": {"d": torch.tensor(2.5, dtype=torch.float64)}},
        "state": np.array([[2**64 - 1]], dtype=np.uint64),
        "flags": np.array([True, False]),
    }
    checkpoint.save(tmp_path / "c", tensors, {"iteration": 3})
    got, numbers = checkpoint.load(tmp_path / "c")
    assert numbers == {"iteration": 3}
    torch.testing.assert_close(got["a"]["b"], torch.arange(3))
    assert got["a"]["c"]["d"] == 2.5 and got["a"]["c"]["d"].dtype == torch.float64
    assert got["state"].numpy()[0, 0] == 2**64 - 1
    assert got["flags"].tolist() == [True, False]


def test_a_diverged_training_says_so_and_keeps_its_checkpoint(tmp_path):
    wild = dataclasses.replace(TINY, ppo=PPOConfig(learning_rate=1e30, epochs=2, minibatch=16))
    with pytest.raises(RunError, match="diverged after 32 steps.*lower the learning rate"):
        train(wild, tmp_path / "run")
    assert not (tmp_path / "run" / "policy.safetensors").exists()
    assert not (tmp_path / "run" / checkpoint.CHECKPOINT).exists()


# The algorithm.


def advantages(training: Training, rewards, terminated, truncated) -> TensorDict:
    """Value targets of one aircraft's steps, through the estimator that training uses."""
    steps = len(rewards)
    column = lambda values, kind: torch.tensor(values, dtype=kind).reshape(1, steps, 1)  # noqa: E731
    observation = torch.zeros(1, steps, training.env.environment.size)
    terminated, truncated = column(terminated, torch.bool), column(truncated, torch.bool)
    batch = TensorDict({"observation": observation}, [1, steps], names=[None, "time"])
    batch["next"] = TensorDict(
        {
            "observation": observation.clone(),
            "reward": column(rewards, torch.float32),
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        },
        [1, steps],
    )
    with torch.no_grad():
        training.advantages(batch)
    return batch


def test_values_go_on_at_truncation_and_not_at_termination(tmp_path):
    config = dataclasses.replace(TINY, gamma=0.5, gae_lambda=0.5)
    training = Training(config, tmp_path / "run")
    for parameter in training.critic.parameters():
        parameter.data.zero_()
    list(training.critic.parameters())[-1].data.fill_(10.0)  # every value is 10

    def targets(rewards, terminated, truncated):
        return advantages(training, rewards, terminated, truncated)["value_target"].flatten()

    # Two steps of one episode: delta_1 = 2 + 5 - 10 = -3, so A_1 = -3 and the target is 7;
    # delta_0 = 1 + 5 - 10 = -4, A_0 = -4 + 0.25 * -3 = -4.75: 5.25.
    assert targets([1.0, 2.0], [False, False], [False, False]).tolist() == [5.25, 7.0]
    # The second is cut off by the clock: the value of where it was counts as before.
    assert targets([1.0, 2.0], [False, False], [False, True]).tolist() == [5.25, 7.0]
    # The second ends it: delta_1 = 2 - 10 = -8: 2, and A_0 = -4 + 0.25 * -8 = -6: 4.
    assert targets([1.0, 2.0], [False, True], [False, False]).tolist() == [4.0, 2.0]
    # The first step ends its episode or is cut off: the second belongs to another and does not
    # count; A_0 = delta_0 = 1 - 10 = -9, or 1 + 5 - 10 = -4.
    assert targets([1.0, 2.0], [True, False], [False, False]).tolist() == [1.0, 7.0]
    assert targets([1.0, 2.0], [False, False], [True, False]).tolist() == [6.0, 7.0]


def test_the_critic_sees_the_last_observation_of_an_episode_not_the_next_first(tmp_path):
    training = Training(TINY, tmp_path / "run")
    seen = []
    learn = training._learn
    training._learn = lambda batch: (seen.append(batch.clone()), learn(batch))[1]
    training.run()
    environment = Environment(
        make_task("hover", {"horizon": 0.5}),
        num_envs=8,
        seed=TINY.seed * SEED_STRIDE,
        engine=TINY.engine,
    )
    observation = environment.flatten(environment.reset())
    ends = 0
    for batch in seen:
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


def test_ppo_learns_to_stop_a_tumble(tmp_path):
    """Hover in which only the spin counts: the return is the spin lost in a second [rad/s].

    An episode starts with 1.5 rad/s on average. Measured with seeds 0 to 5: the logged return goes
    from -1.0 .. -1.3 to 0.80 .. 1.01, and the mean action reaches 0.88 .. 1.06; no action at all
    0.23 (the aerodynamic moment brakes a little), random ones -1.3.
    """
    others = ("survival", "progress", "attitude", "speed", "control")
    options = ("horizon=1", "spin=3", "tilt=0", "speed=0", *(f"{n}_weight=0" for n in others))
    config = TrainConfig(
        num_envs=64,
        rollout=16,
        steps=20_480,
        gamma=0.9,
        reward_scale=0.3,
        task_options=options,
        ppo=PPOConfig(learning_rate=3e-3, minibatch=128, epochs=4),
    )
    folder = train(config, tmp_path / "run")
    returns = [float(row["return"]) for row in metrics(folder) if row["return"]]
    assert np.mean(returns[:3]) < -0.5
    assert np.mean(returns[-3:]) > 0.4
    task = make_task("hover", config.options)
    learned = judge(fly(quadrl.Policy.load(folder), task, episodes=64))["return_mean"]
    nothing = judge(fly(lambda o: np.zeros((len(o), 4)), task, episodes=64))["return_mean"]
    assert learned > nothing + 0.3


# Evaluation.


def make_record(**changes) -> Record:
    """Three aircraft over 5 s of 100 steps: one to the end, one crashed, one done early."""
    steps, episodes = 100, 3
    length = np.array([100, 20, 60])
    number = np.arange(steps)[:, None]
    flown = number < length
    error = np.where(number < length - 40, 9.0, [0.1, 0.2, 0.6]) * np.where(flown, 1, np.nan)
    reward = np.where(flown, [1.0, -2.0, 0.5], np.nan)
    nothing = {
        name: np.zeros((steps, episodes, k))
        for name, k in (("position", 3), ("quaternion", 4), ("velocity", 3), ("body_rate", 3),
                        ("rotor_speed", 4), ("goal", 3), ("action", 4))
    }  # fmt: skip
    values = dict(
        error=error,
        reward=reward,
        length=length,
        terminated=np.array([False, True, True]),
        is_success=np.array([False, False, True]),
        diverged=np.array([False, True, False]),
        markers=(),
        control_step=0.05,
        task=make_task("hover", {}),
    )
    return Record(**{**nothing, **values, **changes})


def test_judgement_by_hand():
    figures = judge(make_record())
    # The last 2 s are 40 steps. The first aircraft: 0.1; the second flew for 20 steps, all of
    # them 0.2; the third: 0.6. Mean: 0.3.
    assert figures["position_error_m"] == pytest.approx(0.3)
    # Returns: 100 * 1, 20 * -2, 60 * 0.5 = 100, -40, 30: mean 30, deviation sqrt(9800 / 3).
    assert figures["return_mean"] == pytest.approx(30.0)
    assert figures["return_std"] == pytest.approx(math.sqrt(9800 / 3))
    assert figures["success_rate"] == pytest.approx(1 / 3)
    # The second crashed; the third was over early, but by success.
    assert figures["survival_rate"] == pytest.approx(2 / 3)
    assert figures["length_mean_s"] == pytest.approx(3.0)  # (5 + 1 + 3) / 3
    assert figures["episodes"] == 3
    assert figures["diverged"] == 1
    json.dumps(figures, allow_nan=False)


def test_heading_error_by_hand():
    """Yaw 10, -30 and 90 degrees; the first only since the last 2 s, turned about before."""
    record = make_record()
    half = np.radians([10.0, -30.0, 90.0]) / 2
    quaternion = np.zeros_like(record.quaternion)
    quaternion[..., 0], quaternion[..., 3] = np.cos(half), np.sin(half)
    quaternion[:60, 0] = [0.0, 0.0, 0.0, 1.0]
    quaternion[60:, 2] = np.nan  # over since
    figures = judge(make_record(quaternion=quaternion))
    assert figures["heading_error_deg"] == pytest.approx((10 + 30 + 90) / 3)
    free = make_record(quaternion=quaternion, task=make_task("random_waypoint", {}))
    assert "heading_error_deg" not in judge(free)


def test_an_error_before_the_last_two_seconds_does_not_count():
    record = make_record()
    early, late = record.error.copy(), record.error.copy()
    early[59, 0], late[60, 0] = 1000.0, 4.1  # 40 steps before the end is 60
    assert judge(make_record(error=early))["position_error_m"] == pytest.approx(0.3)
    # One of 40 is 4 m larger: 0.1 on the first aircraft, a third of it in the mean.
    assert judge(make_record(error=late))["position_error_m"] == pytest.approx(0.3 + 0.1 / 3)


def brake(observation: np.ndarray) -> np.ndarray:
    """A controller without a matrix product, whose rounding depends on the number of rows."""
    return np.tanh(0.3 * observation[..., 0:4] - 0.2 * observation[..., 9:13])


def test_episode_i_is_the_single_environment_of_its_seed():
    record = fly(brake, "hover", episodes=4, seed=EVALUATION_SEED + 7)
    for i in range(4):
        alone = Environment("hover", seed=EVALUATION_SEED + 7 + i)
        observation = alone.flatten(alone.reset())
        for t in range(record.length[i]):
            now = alone.step(brake(observation))
            observation = alone.flatten(now.observation)
            assert now.reward == record.reward[t, i] and now.error == record.error[t, i]
            np.testing.assert_array_equal(alone.simulation.state.position, record.position[t, i])
        assert now.terminated == record.terminated[i]
        assert now.terminated or now.truncated
        assert np.isnan(record.reward[record.length[i] :, i]).all()


def test_evaluation_flies_the_mean_action_and_is_the_same_every_time(finished):
    policy = quadrl.Policy.load(finished)
    seen = []

    def watched(observation):
        seen.append(observation)
        return policy(observation)

    one, other = (fly(c, "hover", episodes=5) for c in (watched, policy))
    for field in dataclasses.fields(Record):
        if isinstance(getattr(one, field.name), np.ndarray):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))
    for t, observation in enumerate(seen):
        flying = t < one.length
        np.testing.assert_array_equal(one.action[t][flying], policy(observation)[flying])
    fresh = fly(policy, "hover", episodes=5, seed=EVALUATION_SEED + 5)
    assert (fresh.position[0] != one.position[0]).all()


def test_evaluation_episodes_are_none_of_the_trainings():
    assert EVALUATION_SEED > 999 * SEED_STRIDE + (1 << 20)


def test_flight_of_a_record_is_in_the_world_frame():
    vehicle = quadrl.Vehicle()
    record = fly(brake, "hover", episodes=2, vehicle=vehicle)
    flight = record.flight(vehicle, 1)
    steps = record.length[1]
    assert len(flight.time) == steps
    assert flight.time[0] == pytest.approx(0.05) and flight.time[-1] == pytest.approx(0.05 * steps)
    up = [0, 0, 3]  # the task's altitude
    np.testing.assert_allclose(flight.qpos[:, :3], record.position[:steps, 1] + up)
    np.testing.assert_allclose(flight.goal, np.tile(up, (steps, 1)))
    assert flight.max_rotor_speed == vehicle.max_speed
    assert flight.task == "hover"


# Configuration.


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"gamma": 2.0}, "gamma = 2.0: 0 to 1 is allowed"),
        ({"gae_lambda": math.nan}, "gae_lambda = nan"),
        ({"seed": -1}, "seed = -1: 0 to 999 is allowed"),
        ({"num_envs": 0}, "num_envs = 0: 1 to 1048576 is allowed"),
        ({"num_envs": 2**20, "rollout": 100}, "num_envs = 1048576 with rollout = 100: 2 to 16"),
        ({"num_envs": 1, "rollout": 1}, "num_envs = 1 with rollout = 1: 2 to 16777216"),
        ({"steps": -5}, "steps = -5: at least 1 is allowed"),
        ({"hidden": (16, 0)}, "width of a hidden layer = 0"),
        ({"initial_deviation": 0.0}, "initial_deviation = 0.0"),
        ({"reward_scale": 0.0}, "reward_scale = 0.0: a positive number is allowed"),
        ({"algo": "sac"}, "unknown algorithm 'sac'; choices: ppo"),
        ({"vehicle": "paprr"}, "unknown vehicle 'paprr' .did you mean paper"),
        ({"task": "hovver"}, "unknown task 'hovver' .did you mean hover.*choices: .*hover"),
        ({"task_options": ("horizn=5",)}, "unknown hover option 'horizn' .did you mean horizon"),
        ({"task_options": ("horizon",)}, "option 'horizon': NAME=VALUE is expected"),
        ({"task_options": ("horizon=long",)}, "horizon = 'long': a number is expected"),
        ({"task_options": ("horizon=true",)}, "horizon = True: a number is expected"),
        ({"task_options": ("horizon=[1,2]",)}, "horizon = .1, 2.: a number is expected"),
        ({"task_options": ("horizon=NaN",)}, "horizon = nan is not finite"),
        ({"task_options": ("horizon=-1",)}, "horizon = -1"),
    ],
)
def test_configurations_that_cannot_be_trained_are_refused(change, says):
    with pytest.raises(ConfigError, match=says) as caught:
        TrainConfig(**change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        (PPOConfig, {"epochs": 0}),
        (PPOConfig, {"minibatch": -1}),
        (PPOConfig, {"learning_rate": math.inf}),
        (PPOConfig, {"clip": 0.0}),
        (PPOConfig, {"entropy": -0.1}),
        (TRPOConfig, {"max_kl": 0.0}),
        (TRPOConfig, {"iterations": 0}),
        (GAEConfig, {"critic_rate": math.nan}),
    ],
)
def test_settings_of_an_algorithm_that_cannot_be_are_refused(kind, change):
    (name,) = change
    with pytest.raises(ConfigError, match=f"{name} = .* is allowed"):
        kind(**change)


def test_options_are_read_as_json_where_they_are():
    options = parse_options(("a=1", "b=2.5", "c=[1,[2,3]]", "d=true", "e=word", "f=x=y", "g="))
    assert options == {
        "a": 1, "b": 2.5, "c": (1, (2, 3)), "d": True, "e": "word", "f": "x=y", "g": "",
    }  # fmt: skip
    with pytest.raises(OptionError, match="'=5'|NAME=VALUE|unknown hover option ''"):
        make_task("hover", parse_options(("=5",)))


def test_the_configuration_of_a_run_is_found_again(finished):
    assert TrainConfig.of_folder(finished) == TINY
    saved = read_config(finished)
    assert saved["resolved_task"]["horizon"] == 0.5
    assert saved["resolved_task"]["radius"] == 0.5
    assert saved["resolved_vehicle"]["mass"] == 0.65
    assert set(saved["versions"]) == {"quadrl", "mujoco", "torch", "torchrl", "numpy"}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "cannot be read"),
        ("{", "cannot be read"),
        ("[]", "is no configuration of a run"),
        ("{}", "its configuration is damaged"),
    ],
)
def test_damaged_configurations_are_refused(copy, text, says):
    (copy / "config.json").write_text(text)
    with pytest.raises(RunError, match=says):
        TrainConfig.of_folder(copy)


@pytest.mark.parametrize("part", ["resolved_task", "resolved_vehicle"])
def test_a_run_of_a_task_or_an_aircraft_that_has_changed_is_not_continued(copy, part):
    config = read_config(copy)
    name = {"resolved_task": "radius", "resolved_vehicle": "mass"}[part]
    config[part][name] *= 2
    (copy / "config.json").write_text(json.dumps(config))
    with pytest.raises(RunError, match="parameters have changed since; start a new run"):
        TrainConfig.of_folder(copy)


# Figures.


def test_figures_are_pictures(finished, tmp_path):
    path = learning_curve(read_metrics(finished / "metrics.csv"), "title", tmp_path / "a" / "b.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    trajectory(fly(brake, "hover", episodes=2), "title", tmp_path / "c.pdf")
    assert (tmp_path / "c.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(FigureError, match=r"c\.xyz: a picture's name ends in one of .*\.png"):
        learning_curve(read_metrics(finished / "metrics.csv"), "title", tmp_path / "c.xyz")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "c.pdf"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "there is no"),
        ("", "has no rows"),
        ("iteration,steps\n", "has no rows"),
        ("iteration,steps\n1,32\n", "has no column error, return, seconds, success, survival"),
        ("iteration,steps\n1,many\n", "something that is no number"),
    ],
)
def test_metrics_that_cannot_be_drawn_are_refused(tmp_path, text, says):
    path = tmp_path / "metrics.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(FigureError, match=says):
        read_metrics(path)
