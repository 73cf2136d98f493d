"""Keyed random numbers: the published answers, one definition in three languages, statistics."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

from quadrl.base import philox
from quadrl.engines import native, rng
from quadrl.engines.rng import Rng

# Salmon et al. 2011, the known answers of Random123 for philox4x32-10: counter, key, words.
KNOWN = [
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (  # digits of pi
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]


def signed(low, high):
    """Two 32-bit words as one int64."""
    return np.array([low | high << 32], dtype=np.uint64).view(np.int64)


def by_c(keys, episodes, stream, first, count):
    out = np.empty((len(keys), count))
    native.library().quadrl_uniform(
        len(keys), keys.ctypes.data, episodes.ctypes.data, stream, first, count, out.ctypes.data
    )
    return out


@pytest.mark.parametrize(("counter", "key", "words"), KNOWN)
def test_philox_gives_the_published_answers(counter, key, words):
    for as_array in (lambda x: np.array([x]), lambda x: torch.tensor([x])):
        got = philox.philox(tuple(map(as_array, counter)), tuple(map(as_array, key)))
        assert [int(word[0]) for word in got] == list(words)
    # In C: word j of the block at counter (number / 4, stream, episode).
    episode = signed(*counter[2:])
    got = by_c(signed(*key), episode, counter[1], 4 * counter[0], 4)
    assert (got[0] * 2.0**32).astype(np.uint64).tolist() == list(words)


@pytest.mark.parametrize(("first", "count"), [(0, 1), (0, 64), (3, 6), (5, 2), (1000, 9)])
def test_numpy_c_and_torch_give_the_same_numbers(first, count):
    keys = np.array([0, 1, 5, 2**31, 2**32 - 1, 2**32, 2**53 + 7, philox.MAX_SEED])
    episodes = np.array([0, 3, 2**31, 1, 2**33, 0, 9, 2**40])
    expected = by_c(keys, episodes, 2, first, count)
    tensors = torch.from_numpy(keys), torch.from_numpy(episodes)
    for got in (
        rng.uniform(keys, episodes, 2, first, count),
        philox.uniform_array_api(keys, episodes, 2, first, count),
        rng.uniform(*tensors, 2, first, count),
    ):
        assert got.shape == expected.shape and "float64" in str(got.dtype)
        np.testing.assert_array_equal(np.asarray(got), expected)
    assert (expected >= 0).all() and (expected < 1).all()


def test_a_row_has_its_own_numbers_whatever_its_neighbours_and_the_order():
    keys, episodes = 7 + np.arange(9), np.arange(9) // 2
    whole = rng.uniform(keys, episodes, philox.START, 0, 20)
    some = np.array([6, 0, 3])
    picked = rng.uniform(keys[some], episodes[some], philox.START, 0, 20)
    np.testing.assert_array_equal(picked, whole[some])
    # In pieces they are the same numbers as at once.
    pieces = Rng(keys, episodes)
    taken = [pieces.uniform(0, 1, 3), pieces.uniform(0, 1)[:, None], pieces.uniform(0, 1, 16)]
    np.testing.assert_array_equal(np.concatenate(taken, axis=1), whole)
    # 2 + 4 u.
    np.testing.assert_array_equal(Rng(keys, episodes).uniform(2, 6, 20), 2 + 4 * whole)


def test_streams_do_not_overlap():
    # 4 keys, 5 episodes, 4 streams and 50 blocks of four numbers, 128 bits each: all different,
    # and that stream 1 goes on where stream 0 ends would show.
    blocks = [
        rng.uniform(np.array([key]), np.array([episode]), stream, 0, 200).reshape(-1, 4)
        for key in (0, 1, 2**32, 2**32 + 1)
        for episode in (0, 1, 2, 2**32, 2**32 + 1)
        for stream in (philox.START, philox.PARAMETERS, 2, 3)
    ]
    every = np.concatenate(blocks)
    assert len(every) == 4000 and len(np.unique(every, axis=0)) == 4000


def test_every_purpose_has_a_stream_of_its_own():
    # Every whole number of the module but these is a stream, and so is one that is added.
    others = ("MAX_SEED", "MASK")
    streams = {k: v for k, v in vars(philox).items() if k not in others and type(v) is int}
    # Another number would change every episode of a seed.
    known = dict(START=0, PARAMETERS=1, WEATHER=8, TURBULENCE=9, NOISE=16, PUSHES=17)
    assert known.items() <= streams.items()
    assert len(set(streams.values())) == len(streams), streams


COUNT = 100_000
ONE = np.ones(COUNT, dtype=np.int64)
DRAWS = {  # names to COUNT numbers of one kind
    "along a stream": lambda: rng.uniform(ONE[:1], ONE[:1], 0, 0, COUNT)[0],
    "along another": lambda: rng.uniform(3 * ONE[:1], ONE[:1], 1, 0, COUNT)[0],
    "over seeds": lambda: rng.uniform(np.arange(COUNT), ONE, 0, 0, 1)[:, 0],
    "over large seeds": lambda: rng.uniform(2**53 + np.arange(COUNT), ONE, 0, 2, 1)[:, 0],
    "over episodes": lambda: rng.uniform(ONE, np.arange(COUNT), 0, 1, 1)[:, 0],
    "over every fourth": lambda: rng.uniform(ONE[:1], ONE[:1], 0, 0, 4 * COUNT)[0, ::4],
}
# Numbers are drawn once and are always the same. A bound of five standard deviations, or of a
# probability of 1e-6, would be missed by one generator in a million.
SIGMAS, RARE = 5.0, 1e-6


@pytest.mark.parametrize("name", DRAWS)
def test_numbers_are_uniform_and_independent(name):
    u = DRAWS[name]()
    # Mean 1/2 with variance 1/12; variance 1/12 with variance (1/80 - 1/144) of each square.
    assert abs(u.mean() - 1 / 2) < SIGMAS * math.sqrt(1 / 12 / COUNT)
    assert abs(u.var() - 1 / 12) < SIGMAS * math.sqrt((1 / 80 - 1 / 144) / COUNT)
    for lag in (1, 2, 3, 4, 1000):
        r = np.corrcoef(u[lag:], u[:-lag])[0, 1]
        assert abs(r) < SIGMAS / math.sqrt(COUNT), lag
    # 128 bins, and 16 x 16 of neighbours: too even is as suspicious as too uneven.
    pairs = np.histogram2d(u[::2], u[1::2], bins=16, range=[[0, 1], [0, 1]])[0]
    for counts in (np.histogram(u, bins=128, range=(0, 1))[0], pairs.ravel()):
        assert RARE < stats.chisquare(counts).pvalue < 1 - RARE
    # Low bits as well: a number is a multiple of 2^-32.
    words = (u * 2.0**32).astype(np.uint64)
    assert (words == u * 2.0**32).all()
    for bit in range(32):
        ones = int((words >> np.uint64(bit) & np.uint64(1)).sum())
        assert abs(ones - COUNT / 2) < SIGMAS * math.sqrt(COUNT / 4), bit


def test_directions_are_even_over_the_sphere_and_the_horizon():
    def draw():
        return Rng(np.arange(COUNT), 0 * ONE)

    # Each coordinate of an even direction is uniform in [-1, 1] (Archimedes).
    sphere = draw().direction()
    np.testing.assert_allclose(np.linalg.norm(sphere, axis=1), 1, rtol=1e-12)
    for k in range(3):
        assert stats.kstest(sphere[:, k], stats.uniform(-1, 2).cdf).pvalue > RARE
    level = draw().level_direction()
    np.testing.assert_array_equal(level[:, 2], 0)
    angle = np.arctan2(level[:, 1], level[:, 0])
    assert stats.kstest(angle, stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > RARE
    # The length is uniform, not the volume.
    length = np.linalg.norm(draw().vector(2.5, shortest=1.0), axis=1)
    assert stats.kstest(length, stats.uniform(1.0, 1.5).cdf).pvalue > RARE


def test_attitudes_have_a_heading_and_a_tilt():
    q = Rng(np.arange(COUNT), 0 * ONE).attitude(0.2)
    np.testing.assert_allclose((q * q).sum(1), 1, rtol=1e-12)
    # cos(tilt) = 1 - 2 (x^2 + y^2), the tilt uniform in [0, 0.2).
    tilt = np.arccos(1 - 2 * (q[:, 1] ** 2 + q[:, 2] ** 2))
    assert stats.kstest(tilt, stats.uniform(0, 0.2).cdf).pvalue > RARE
    level = Rng(np.arange(COUNT), 0 * ONE).attitude(0.0)
    np.testing.assert_array_equal(level[:, 1:3], 0)
    heading = 2 * np.arctan2(level[:, 3], level[:, 0])
    assert stats.kstest(heading, stats.uniform(0, 2 * np.pi).cdf).pvalue > RARE
