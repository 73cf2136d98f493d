"""What the log of a training says of its episodes."""

import numpy as np
import pytest
import torch

from quadrl.learning.environments import EpisodeStatistics

LIMIT, BATCH = 4, 2
NAMES = ("progress", "effort"), ("crashed", "time_limit")


def batches(steps, lives):
    """Batches of aircraft that crash after so many steps each, over and over, or live (0)."""
    length = np.zeros(len(lives), dtype=int)
    columns = {name: [] for name in ("reward", "done", "terminated", "is_success", "error")}
    for _ in range(steps):
        length += 1
        crashed = length == np.array(lives)
        over = crashed | (length == LIMIT)
        row = {"done": over, "terminated": crashed, "is_success": over & ~crashed}
        row |= {"reward": np.ones(len(lives)), "error": np.zeros(len(lives))}
        length[over] = 0
        for name, column in columns.items():
            column.append(row[name])
    for first in range(0, steps, BATCH):
        here = {k: np.array(v[first : first + BATCH]) for k, v in columns.items()}
        ends = np.stack([here["terminated"], here["done"] & ~here["terminated"]], axis=1)
        part = {name: torch.from_numpy(column) for name, column in here.items()}
        terms = here["reward"][:, None] * [[3.0], [-2.0]]
        yield part, torch.from_numpy(terms), torch.from_numpy(ends)


def test_success_is_that_of_episodes_which_are_all_over_by_now():
    statistics = EpisodeStatistics(3, LIMIT, BATCH, *NAMES)
    found = [statistics.count(*batch) for batch in batches(12, (0, 0, 1))]
    # The third aircraft crashes in every step, the two others live until they are cut off.
    assert [one["episodes"] for one in found] == [2.0, 4.0, 2.0, 4.0, 2.0, 4.0]
    assert all("success" not in one for one in found[:1])
    # After 4 steps: three were begun 4 steps ago, of which two live.
    assert found[1]["success"] == found[1]["survival"] == pytest.approx(2 / 3)
    # After 6: also one crashed that was begun 5, and one that was begun 4 steps ago.
    assert found[2]["success"] == pytest.approx(2 / 5)
    # After 8: those begun 4 to 8 steps ago, five of one aircraft and twice two.
    assert found[3]["success"] == found[3]["end/time_limit"] == pytest.approx(4 / 9)
    assert found[3]["end/crashed"] == pytest.approx(5 / 9)
    # Of the four that end in that batch two last one step, and two last four: 3 a step, less 2.
    assert found[3]["reward/progress"] == pytest.approx(7.5)
    assert found[3]["reward/effort"] == pytest.approx(-5.0)
    assert found[3]["return"] == pytest.approx(2.5)


def test_a_crash_of_all_in_the_first_step_is_no_success_while_others_are_cut_off():
    statistics = EpisodeStatistics(50, LIMIT, BATCH, *NAMES)
    found = [statistics.count(*batch) for batch in batches(8, (*[1] * 48, 0, 0))]
    # Begun 4 to 8 steps ago: all 50 twice, of which 2 live each time, and three times 48 others.
    assert found[-1]["success"] == pytest.approx(4 / 244)


def test_batches_longer_than_an_episode_count_every_one():
    statistics = EpisodeStatistics(1, 1, BATCH)
    done = torch.ones(BATCH, 1, dtype=torch.bool)
    batch = {"done": done, "terminated": done, "is_success": ~done}
    batch |= {name: done.double() for name in ("reward", "error")}
    none = torch.ones(BATCH, 0, 1)
    for _ in range(3):
        found = statistics.count(batch, none, none.bool())
    assert found["success"] == found["survival"] == 0.0 and found["length"] == 1.0
