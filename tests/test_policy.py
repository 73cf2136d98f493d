"""The policy as numbers: what it computes, what it refuses to read, what it does not import."""

import json
import os
import pickle
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save
from scipy import stats

import quadrl
from quadrl.errors import QuadrlError
from quadrl.learning import study
from quadrl.learning.config import make_task
from quadrl.learning.evaluate import EVALUATION_SEED, fly, judge
from quadrl.policy import FORMAT, SHIPPED, Policy, PolicyError, shipped

SIZE, HIDDEN = 3, 2


def make_policy(**changes) -> Policy:
    """A network small enough to be worked out by hand: 3 inputs, 2 hidden units, 4 actions."""
    values = dict(
        weights=(
            np.array([[1, 0, 0], [0, 1, 0]], np.float32),
            np.array([[1, 0], [0, 1], [1, 1], [9, 9], [0, 0], [0, 0], [0, 0], [0, 0]], np.float32),
        ),
        biases=(np.zeros(2, np.float32), np.array([0, 0.5, 0, 0, -1, -1, -1, -1], np.float32)),
        mean=np.array([1, 2, 3], np.float32),
        deviation=np.array([2, 4, 1], np.float32),
        task="hover",
        metadata={"algo": "ppo", "seed": 3, "task_options": {"horizon": 5}},
    )
    return Policy(**{**values, **changes})


def write(path, arrays, header):
    """A safetensors file with any content."""
    path.write_bytes(save(arrays, metadata={"quadrl": json.dumps(header)}))
    return path


def parts(policy: Policy) -> dict[str, np.ndarray]:
    arrays = {"mean": policy.mean, "deviation": policy.deviation}
    for k in range(len(policy.weights)):
        arrays |= {f"weight_{k}": policy.weights[k], f"bias_{k}": policy.biases[k]}
    return arrays


HEADER = {"format": FORMAT, "task": "hover", "metadata": {}}


def test_mean_action_by_hand():
    # Normalised: ((2-1)/2, (0-2)/4, (3-3)/1) = (0.5, -0.5, 0); hidden: tanh(0.5) = 0.46212,
    # -0.46212; means: 0.46212, -0.46212 + 0.5 = 0.03788, 0, 0; the log-variances are left out.
    action = make_policy()(np.array([2.0, 0.0, 3.0]))
    np.testing.assert_allclose(action, [0.46211716, 0.03788284, 0.0, 0.0], atol=1e-7)


def test_action_is_within_its_bounds_and_the_observation_within_ten_deviations():
    # Normalised, both are far above 10 and held there; tanh(10) = 1, so the fourth mean is 18.
    far = make_policy()(np.array([1e6, 1e6, 0.0]))
    np.testing.assert_array_equal(far, [1.0, 1.0, 1.0, 1.0])
    identity = make_policy(weights=(np.full((8, 3), 0.05, np.float32),), biases=(np.zeros(8, "f"),))
    # One linear layer: 0.05 * (10 + 0 + 0) = 0.5 however far away the first entry is.
    np.testing.assert_allclose(identity(np.array([1e6, 2.0, 3.0])), np.full(4, 0.5), rtol=1e-6)


def test_batches_of_any_shape():
    policy = make_policy()
    observations = np.random.default_rng(0).normal(size=(5, 6, SIZE))
    actions = policy(observations)
    assert actions.shape == (5, 6, 4)
    for i in range(5):
        for j in range(6):
            np.testing.assert_allclose(actions[i, j], policy(observations[i, j]), atol=1e-6)


@pytest.mark.parametrize("shape", [(2,), (4,), (3, 2), ()])
def test_observation_of_another_size_is_refused(shape):
    with pytest.raises(ValueError, match=r"hover expects \(\.\.\., 3\)"):
        make_policy()(np.zeros(shape))


def test_saved_and_loaded_it_is_the_same(tmp_path):
    policy = make_policy()
    policy.save(tmp_path / "policy.safetensors")
    for path in (tmp_path, tmp_path / "policy.safetensors", str(tmp_path)):
        loaded = quadrl.Policy.load(path)
        assert (loaded.task, loaded.metadata) == (policy.task, policy.metadata)
        for name, array in parts(policy).items():
            np.testing.assert_array_equal(parts(loaded)[name], array)
    assert [p.name for p in tmp_path.iterdir()] == ["policy.safetensors"]


def test_the_same_policy_is_the_same_file(tmp_path):
    # Ten times: with several entries in its table, safetensors shuffles them.
    contents = set()
    for k in range(10):
        make_policy().save(tmp_path / f"{k}.safetensors")
        contents.add((tmp_path / f"{k}.safetensors").read_bytes())
    assert len(contents) == 1


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "policy.safetensors"
    make_policy().save(path)
    before = path.read_bytes()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        make_policy(task="landing").save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_missing_policy(tmp_path):
    for path in (tmp_path, tmp_path / "policy.safetensors", tmp_path / "nowhere" / "run"):
        with pytest.raises(PolicyError, match="no policy at .*give a run folder"):
            Policy.load(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK\x03\x04 a zip archive, such as torch.save writes",
        b"\x00" * 1000,
        struct.pack("<Q", 1 << 62) + b"{}",
        b"import os",
    ],
)
def test_foreign_files_are_refused(tmp_path, content):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(content)
    with pytest.raises(PolicyError, match=r"policy\.safetensors is damaged or no safetensors file"):
        Policy.load(path)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.9, 0.99])
def test_truncated_files_are_refused(tmp_path, share):
    path = tmp_path / "policy.safetensors"
    make_policy().save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(PolicyError, match="damaged"):
        Policy.load(path)


def test_every_flipped_byte_of_the_header_is_refused_or_harmless(tmp_path):
    path = tmp_path / "policy.safetensors"
    make_policy().save(path)
    content = path.read_bytes()
    refused = 0
    for k in range(8 + int.from_bytes(content[:8], "little")):
        path.write_bytes(content[:k] + bytes([content[k] ^ 0x15]) + content[k + 1 :])
        try:
            Policy.load(path)
        except PolicyError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > 300  # of about 600; the others are in names and numbers of the metadata


class Attack:
    """Unpickled, it writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def test_a_pickle_is_refused_and_not_run(tmp_path):
    trap = tmp_path / "trap"
    attack = pickle.dumps(Attack(trap))
    pickle.loads(attack).close()
    assert trap.exists()  # the attack works where pickles are read
    trap.unlink()
    header = json.dumps({"__metadata__": {"quadrl": attack.decode("latin1")}}).encode()
    contents = (attack, struct.pack("<Q", len(header)) + header)
    for content in contents:
        (tmp_path / "policy.safetensors").write_bytes(content)
        with pytest.raises(PolicyError):
            Policy.load(tmp_path)
    assert not trap.exists()


def test_a_safetensors_file_of_somebody_else_is_refused(tmp_path):
    path = tmp_path / "model.safetensors"
    path.write_bytes(save({"weight": np.zeros((2, 2), np.float32)}))
    with pytest.raises(PolicyError, match="its format is None, 'quadrl-policy-1' is expected"):
        Policy.load(path)
    write(path, parts(make_policy()), HEADER | {"format": "quadrl-policy-9"})
    with pytest.raises(PolicyError, match="its format is 'quadrl-policy-9'"):
        Policy.load(path)


def replaced(name, value):
    return lambda arrays: arrays | {name: np.asarray(value, np.float32)}


def without(name):
    return lambda arrays: {key: value for key, value in arrays.items() if key != name}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (without("mean"), "lacks a part of a policy"),
        (without("weight_0"), "lacks a part of a policy"),
        (without("bias_1"), "do not make a policy network"),
        (lambda arrays: {}, "lacks a part of a policy"),
        (replaced("weight_9", np.zeros((2, 2))), "do not make a policy network"),
        (replaced("weight_0", np.zeros((2, 4))), "do not make a policy network"),
        (replaced("weight_0", np.zeros(6)), "do not make a policy network"),
        (replaced("bias_0", np.zeros((2, 1))), "do not make a policy network"),
        (replaced("bias_0", 0.0), "do not make a policy network"),
        (replaced("mean", np.zeros(4)), "do not make a policy network"),
        (replaced("mean", 0.0), "do not make a policy network"),
        (replaced("mean", np.zeros((1, 3))), "do not make a policy network"),
        (replaced("deviation", [1, 0, 1]), "do not make a policy network"),
        (replaced("deviation", [1, -1, 1]), "do not make a policy network"),
        (replaced("deviation", [1, np.inf, 1]), "do not make a policy network"),
        (replaced("weight_1", np.full((8, 2), np.nan)), "do not make a policy network"),
        (replaced("bias_1", np.full(8, np.inf)), "do not make a policy network"),
        (
            lambda arrays: arrays | {"weight_1": np.zeros((6, 2), "f"), "bias_1": np.zeros(6, "f")},
            "do not make a policy network",
        ),
        (lambda arrays: arrays | {"mean": np.zeros(3)}, "do not make a policy network"),
    ],
)
def test_arrays_that_make_no_network_are_refused(tmp_path, change, says):
    path = write(tmp_path / "policy.safetensors", parts(make_policy()), HEADER)
    Policy.load(path)
    write(path, change(parts(make_policy())), HEADER)
    with pytest.raises(PolicyError, match=says):
        Policy.load(path)


@pytest.mark.parametrize(
    "header",
    [
        {"task": 3},
        {"metadata": []},
        {"metadata": {"task_options": "horizon=5"}},
    ],
)
def test_what_it_was_trained_for_must_be_readable(tmp_path, header):
    path = write(tmp_path / "policy.safetensors", parts(make_policy()), HEADER | header)
    with pytest.raises(PolicyError, match="does not say what the policy was trained for"):
        Policy.load(path)


# The policies that come with the package.


def test_pretrained_is_the_file_that_ships():
    policy = Policy.pretrained("hover")
    assert (policy.task, policy.metadata["algo"]) == ("hover", "ppo")
    loaded = Policy.load(SHIPPED / "hover_ppo.safetensors")
    for name, array in parts(loaded).items():
        np.testing.assert_array_equal(parts(policy)[name], array)


@pytest.mark.parametrize(("task", "algo"), [("hovr", "ppo"), ("hover", "sac"), ("../hover", "ppo")])
def test_a_policy_that_does_not_ship(task, algo):
    with pytest.raises(PolicyError) as caught:
        Policy.pretrained(task, algo)
    message = str(caught.value)
    assert f"no policy comes with quadrl for {task} with {algo}; choices: " in message
    assert "hover with ppo" in message and f"quadrl train {task} --algo {algo}" in message


FRESH_SEED, FRESH_EPISODES = EVALUATION_SEED + 1_000_000, 100


@pytest.mark.parametrize("file", shipped(), ids=lambda file: file.stem)
def test_a_shipped_policy_still_reaches_its_figures(file):
    """On episodes of its own, with what chance allows between two samples of the same policy.

    Success: the recorded share of n episodes leaves, at one in a hundred, a true share as low as
    the lower bound of Clopper and Pearson; with that one the 100 episodes here must not be worse
    than one in a thousand would be. Recorded 500 of 500: at least 0.01^(1/500) = 0.991, so 94.
    Error: the means of two samples differ by less than 4 standard errors of their difference but
    in one of 30,000 cases, if they are normal. The seeds are fixed, so a policy either passes here
    or does not; the margins are for other episodes, not for luck.
    """
    beside = json.loads(file.with_suffix(".json").read_text())
    policy, recorded = Policy.load(file), beside["evaluation"]
    config, metadata = beside["config"], policy.metadata
    assert file.stem == f"{policy.task}_{metadata['algo']}" == f"{config['task']}_{config['algo']}"
    for name in ("seed", "vehicle"):
        assert config[name] == metadata[name]
    assert beside["command"].split()[:2] == ["quadrl", "train"]
    task = make_task(policy.task, metadata["task_options"])
    record = fly(
        policy,
        task,
        episodes=FRESH_EPISODES,
        seed=FRESH_SEED,
        vehicle=quadrl.VEHICLES[metadata["vehicle"]],
    )
    judged = judge(record)
    n, share = recorded["episodes"], recorded["success_rate"]
    hits = round(n * share)
    lowest = stats.beta.ppf(0.01, hits, n - hits + 1)
    assert judged["success_rate"] * FRESH_EPISODES >= stats.binom.ppf(0.001, FRESH_EPISODES, lowest)
    deviation, error = recorded["position_error_std_m"], recorded["position_error_m"]
    standard_error = deviation * (1 / n + 1 / FRESH_EPISODES) ** 0.5
    assert judged["position_error_m"] <= error + 4 * standard_error


def test_a_policy_that_got_worse_would_not_reach_them(monkeypatch):
    worse = study.with_noisy_weights(Policy.pretrained("hover"), 0.5, seed=0)
    monkeypatch.setattr(Policy, "load", lambda path: worse)
    with pytest.raises(AssertionError):
        test_a_shipped_policy_still_reaches_its_figures(SHIPPED / "hover_ppo.safetensors")


def test_errors_are_the_users_to_mend():
    assert issubclass(PolicyError, QuadrlError) and issubclass(PolicyError, ValueError)


def imported(code: str) -> set[str]:
    """The modules of a fresh interpreter after some code."""
    code += "\nimport sys; print(' '.join(sys.modules))"
    environment = os.environ | {"PYTHONPATH": str(Path(quadrl.__file__).parents[1])}
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    return set(done.stdout.decode().split())


def test_importing_quadrl_and_loading_a_policy_stay_light(tmp_path):
    make_policy().save(tmp_path / "policy.safetensors")
    modules = imported(f"import quadrl\nquadrl.Policy.load({str(tmp_path)!r})([1, 2, 3])")
    assert "quadrl.policy" in modules
    heavy = {"torch", "tensordict", "torchrl", "matplotlib", "mediapy", "PIL", "quadrl.rendering"}
    assert not heavy & modules
    assert not [name for name in modules if name.startswith("dm_control")]
