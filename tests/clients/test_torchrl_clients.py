"""TorchRL's own environments, wrappers and recorders on ours, as they come."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv, GymWrapper, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.record import CSVLogger, PixelRenderTransform, VideoRecorder

import quadrl  # noqa: F401 - registers the ids
from quadrl.envs.torchrl import QuadrotorEnv

HOVER = "quadrl/Hover-v0"
SMALL = {"width": 64, "height": 48}
INFO = {"is_success", "error", "diverged", "reward_terms"}


@pytest.mark.parametrize("id", [HOVER, f"quadrl:{HOVER}"])
def test_gym_env_makes_it_by_name(id):
    environment = GymEnv(id, vehicle="crazyflie", time_limit=0.5)
    check_env_specs(environment)
    environment.set_seed(4)
    flown = environment.rollout(30, lambda observation: torch.zeros(4))
    assert len(flown) == 25 and flown["next", "truncated"][-1]  # of 0.02 s
    single = gym.make(HOVER, vehicle="crazyflie", time_limit=0.5)
    single.reset(seed=4)  # GymEnv begins with another reset
    np.testing.assert_array_equal(flown["observation"][0], single.reset()[0])


@pytest.mark.usefixtures("cheap_pictures")
@pytest.mark.parametrize("pixels_only", [True, False])
def test_gym_env_gives_pixels(pixels_only):
    environment = GymEnv(HOVER, from_pixels=True, pixels_only=pixels_only, **SMALL)
    pixels = environment.rollout(2)["next", "pixels"]
    assert (pixels.shape, pixels.dtype) == ((2, 48, 64, 3), torch.uint8)
    environment.close()


def test_the_info_is_read_into_tensors():
    environment = GymWrapper(gym.make(HOVER)).auto_register_info_dict()
    check_env_specs(environment)
    after = environment.rollout(5)["next"]
    assert INFO <= set(after.keys())
    terms = after["reward_terms"].sum(-1)
    torch.testing.assert_close(terms, after["reward"][:, 0], check_dtype=False)


def test_a_vector_with_gymnasiums_default_says_which_mode_torchrl_takes():
    with pytest.raises(RuntimeError, match="SAME_STEP or DISABLED"):
        GymWrapper(gym.make_vec(HOVER, num_envs=3))


pictures = pytest.mark.usefixtures("cheap_pictures")


@pictures
def test_pixels_are_those_of_every_aircraft():
    environment = QuadrotorEnv("hover", 3, seed=0, from_pixels=True, time_limit=0.25, **SMALL)
    check_env_specs(environment)
    flown = environment.rollout(7, break_when_any_done=False)
    pixels = flown["next", "pixels"]
    assert (pixels.shape, pixels.dtype) == ((3, 7, 48, 64, 3), torch.uint8)
    single = gym.make(HOVER, render_mode="rgb_array", **SMALL)
    environment.set_seed(10)
    single.reset(seed=12)
    shown = environment.reset()["pixels"][2].numpy()
    assert np.abs(shown.astype(int) - single.render()).max() <= 8
    environment.close()


@pictures
def test_its_transforms_draw_and_record(tmp_path):
    logger = CSVLogger("flight", log_dir=str(tmp_path), video_format="pt")
    environment = TransformedEnv(QuadrotorEnv("hover", 2, seed=0, **SMALL))
    environment.append_transform(PixelRenderTransform())
    environment.append_transform(VideoRecorder(logger, tag="hover"))
    flown = environment.rollout(4)
    assert flown["next", "pixels"].shape == (2, 4, 48, 64, 3)
    environment.transform.dump()
    (path,) = tmp_path.rglob("*.pt")
    video = torch.load(path)
    assert video.shape[-3:] == (3, 48, 128)  # side by side
    assert video.float().std() > 5
    environment.close()
