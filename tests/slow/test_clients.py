"""Clients that take their time: they learn, they film, they fly in other processes."""

import functools
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import RecordVideo
from gymnasium.wrappers.vector import RecordVideo as VectorRecordVideo
from processes import python
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import (
    SubprocVecEnv,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    GymEnv,
    ObservationNorm,
    ParallelEnv,
    RewardSum,
    StepCounter,
    TransformedEnv,
)
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import quadrl  # noqa: F401 - registers the ids
from quadrl.envs.sb3 import QuadrotorVecEnv
from quadrl.envs.torchrl import QuadrotorEnv
from quadrl.testing import varied_actions

HOVER = "quadrl/Hover-v0"
PICTURE = {"render_mode": "rgb_array", "width": 64, "height": 48}
EXAMPLES = Path(quadrl.__file__).parents[1] / "docs" / "examples"


# ------------------------------------------------------------------------------------ learning


@pytest.mark.parametrize("workers", [None, "fork", "forkserver", "spawn"])
def test_sb3_learns_from_the_name(workers):
    settings = {}
    if workers:
        settings = {"vec_env_cls": SubprocVecEnv, "vec_env_kwargs": {"start_method": workers}}
    # Workers that do not begin as a copy of this process know no id that it has registered.
    envs = VecNormalize(make_vec_env(f"quadrl:{HOVER}", 2, seed=0, **settings))
    model = PPO("MlpPolicy", envs, n_steps=128, batch_size=64, n_epochs=2, device="cpu")
    model.learn(512)
    assert len(model.ep_info_buffer) > 0
    envs.close()


def test_sb3_ppo_learns_on_the_batch():
    envs = VecNormalize(VecMonitor(QuadrotorVecEnv("hover", 64)), gamma=0.9)
    settings = {"n_steps": 64, "batch_size": 1024, "n_epochs": 5, "learning_rate": 3e-3}
    model = PPO("MlpPolicy", envs, gamma=0.9, seed=0, device="cpu", **settings)
    lengths = []
    for _ in range(2):
        model.learn(40 * 4096, reset_num_timesteps=False)
        lengths.append(np.mean([episode["l"] for episode in model.ep_info_buffer]))
    assert lengths[-1] > 190  # of 200: it stays in the air


def test_sb3_sac_learns_from_the_name():
    model = SAC("MlpPolicy", HOVER, learning_starts=100, seed=0, device="cpu")
    model.learn(400)
    assert np.isfinite(model.predict(np.zeros(22, np.float32), deterministic=True)[0]).all()


def torchrl_environments():
    yield lambda: QuadrotorEnv("hover", 4, seed=0)
    yield lambda: GymEnv(HOVER)
    # Its processes have not imported quadrl: the name says where the id comes from.
    yield lambda: ParallelEnv(2, functools.partial(GymEnv, f"quadrl:{HOVER}"))


@pytest.mark.parametrize(
    "make", list(torchrl_environments()), ids=["QuadrotorEnv", "GymEnv", "ParallelEnv"]
)
def test_torchrl_learns_as_in_its_tutorial(make):
    torch.manual_seed(0)
    transforms = [ObservationNorm(in_keys=["observation"]), DoubleToFloat(), RewardSum()]
    environment = TransformedEnv(make(), Compose(*transforms, StepCounter()))
    batch = environment.batch_size
    environment.transform[0].init_stats(
        64, reduce_dim=tuple(range(len(batch) + 1)), cat_dim=len(batch)
    )
    size, actions = environment.observation_spec["observation"].shape[-1], 4
    net = nn.Sequential(nn.Linear(size, 32), nn.Tanh(), nn.Linear(32, actions))
    scaled = nn.Sequential(net, AddStateIndependentNormalScale(actions))
    actor = ProbabilisticActor(
        TensorDictModule(scaled, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=environment.full_action_spec_unbatched,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
        return_log_prob=True,
    )
    critic = nn.Sequential(nn.Linear(size, 32), nn.Tanh(), nn.Linear(32, 1))
    value = ValueOperator(critic, in_keys=["observation"])
    advantage = GAE(gamma=0.9, lmbda=0.95, value_network=value, average_gae=True)
    loss = ClipPPOLoss(actor, value, clip_epsilon=0.2)
    optimiser = torch.optim.Adam(loss.parameters(), 1e-3)
    frames = {"frames_per_batch": 256, "total_frames": 512}
    collector = Collector(environment, actor, auto_register_policy_transforms=False, **frames)
    before = [parameter.clone() for parameter in loss.parameters()]
    for data in collector:
        for _ in range(2):
            advantage(data)
            values = loss(data.reshape(-1))
            total = sum(values[name] for name in values.keys() if name.startswith("loss_"))  # noqa: SIM118
            assert torch.isfinite(total)
            optimiser.zero_grad()
            total.backward()
            optimiser.step()
        assert data["next", "episode_reward"].isfinite().all()
    assert any((a != b).any() for a, b in zip(before, loss.parameters(), strict=True))
    collector.shutdown()


@pytest.mark.parametrize("example", ["sb3_ppo", "cleanrl_ppo", "torchrl_ppo", "learning_curve"])
def test_an_example_trains(example):
    options = ["--algo", "sac"] if example == "learning_curve" else []
    done = python(EXAMPLES / f"{example}.py", "--total-steps", "4096", *options)
    assert '"successful"' in done.stdout or '"success' in done.stdout


@pytest.mark.filterwarnings("default")  # of Ray, about itself
def test_rllib_learns_on_one_machine(monkeypatch):
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")  # it would write to the home folder
    # Plain Ray, on which studies run, lacks what RLlib needs.
    pytest.importorskip("ray.rllib", exc_type=ImportError)
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig

    config = PPOConfig().environment(f"quadrl:{HOVER}").env_runners(num_env_runners=0)
    config = config.training(train_batch_size=512, minibatch_size=128, num_epochs=1)
    algorithm = config.build_algo()
    result = algorithm.train()
    assert result["env_runners"]["num_env_steps_sampled"] >= 512
    algorithm.stop()
    ray.shutdown()


def mean_return(runner, envs):
    """What the mean action reaches in an episode of each aircraft."""
    policy = runner.get_inference_policy()
    total, over = torch.zeros(envs.num_envs), torch.zeros(envs.num_envs, dtype=torch.bool)
    seen, _ = envs.reset()
    while not over.all():
        with torch.no_grad():
            seen, reward, done, _ = envs.step(policy(seen))
        total, over = total + reward * ~over, over | (done == 1)
    return total.mean().item()


def test_rsl_rl_learns_to_stay_in_the_air():
    pytest.importorskip("rsl_rl")
    from rsl_rl.runners import OnPolicyRunner

    from quadrl.envs.rsl_rl import QuadrotorVecEnv as RslRlEnv

    torch.manual_seed(0)
    network = {"class_name": "MLPModel", "hidden_dims": [64, 64], "obs_normalization": True}
    normal = {"class_name": "GaussianDistribution", "init_std": 0.5}
    algorithm = {"class_name": "PPO", "gamma": 0.92, "learning_rate": 5e-3, "schedule": "fixed"}
    algorithm |= {"num_learning_epochs": 4, "num_mini_batches": 4, "value_loss_coef": 1e-3}
    settings = {
        "num_steps_per_env": 16,
        "save_interval": 1000,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": network | {"distribution_cfg": normal},
        "critic": network,
        "algorithm": algorithm | {"use_clipped_value_loss": False, "entropy_coef": 0.0},
    }
    envs, fresh = (RslRlEnv("hover", 128, seed=seed) for seed in (0, 1000))
    runner = OnPolicyRunner(envs, settings)
    before = mean_return(runner, fresh)
    runner.learn(30, init_at_random_ep_len=True)
    # Who falls at once gets about 50, and who stays in the air to the end about 2000.
    assert before < 100 and mean_return(runner, fresh) > 800


# --------------------------------------------------------------------------------------- videos


def videos(test):
    """The writers and the reader leave the pipes to ffmpeg to the garbage collector."""
    test = pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")(test)
    return pytest.mark.usefixtures("cheap_pictures")(test)


def frames_of(path):
    """The pictures of a video."""
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(path))
    width, height = next(reader)["size"]
    return [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


@videos
def test_gymnasium_records_an_episode(tmp_path):
    environment = RecordVideo(gym.make(HOVER, time_limit=0.5, **PICTURE), str(tmp_path / "one"))
    environment.reset(seed=0)
    while not environment.step(np.zeros(4))[3]:
        pass
    environment.close()
    (video,) = (tmp_path / "one").glob("*.mp4")
    frames = frames_of(video)
    assert len(frames) >= 10 and frames[0].shape == (48, 64, 3)
    assert np.std(frames[-1]) > 5


@videos
def test_gymnasium_records_a_vector(tmp_path):
    envs = gym.make_vec(HOVER, num_envs=4, time_limit=0.5, **PICTURE)
    envs = VectorRecordVideo(
        envs, str(tmp_path / "all"), record_first_only=False, video_aspect_ratio=(1, 1)
    )
    envs.reset(seed=0)
    for _ in range(12):
        envs.step(np.zeros((4, 4)))
    envs.close()
    frames = frames_of(tmp_path / "all" / "rl-video-episode-0.mp4")
    assert frames[0].shape == (96, 128, 3) and len(frames) >= 10


@videos
def test_sb3_records_the_batch(tmp_path):
    envs = QuadrotorVecEnv("hover", 4, **PICTURE)
    envs = VecVideoRecorder(envs, str(tmp_path), lambda step: step == 0, video_length=10)
    envs.reset()
    for _ in range(12):
        envs.step(np.zeros((4, 4)))
    envs.close()
    frames = frames_of(next(tmp_path.glob("*.mp4")))
    assert frames[0].shape == (96, 128, 3) and len(frames) >= 10


@pytest.mark.parametrize(
    "imports",
    ["import mediapy, quadrl.rendering", "import IPython, quadrl.rendering, mediapy"],
    ids=["mediapy first", "quadrl first, in a notebook"],
)
def test_mediapy_shows_a_video_in_a_notebook(imports):
    # In a process of its own: there no ffmpeg is on the path, and nobody has named one.
    code = f"""
import os
os.environ["PATH"] = ""
{imports}
import IPython.display
import numpy as np
shown = []
IPython.display.display = shown.append
mediapy.show_video(np.zeros((3, 48, 64, 3), np.uint8), fps=10)
assert "video/mp4" in shown[0].data
"""
    python("-c", code)


# ------------------------------------------------------------------------------ other processes


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_gymnasiums_asynchronous_vector(context):
    kwargs = {"vectorization_mode": "async", "vector_kwargs": {"context": context}}
    envs, ours = gym.make_vec(HOVER, 2, **kwargs), gym.make_vec(HOVER, 2)
    np.testing.assert_array_equal(envs.reset(seed=3)[0], ours.reset(seed=3)[0])
    for action in varied_actions(5, 2):
        one, other = envs.step(action), ours.step(action)
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])
    envs.close()
