"""Comparisons of the seeds of two algorithms: against scipy, by hand, and by experiments."""

import json
import math

import numpy as np
import pytest
from helpers import refused
from scipy import stats

from quadrl import cli
from quadrl.learning import study
from quadrl.learning.comparison import VERDICTS, compare, power, sums
from quadrl.learning.study import StudyResult, along

NONE = math.inf


def runs(**figures):
    """Runs by task_algo, with a figure for each seed."""
    return [
        {"task": task, "algo": algo, "variant": "", "metrics": {"error": value}}
        for (task, algo), values in ((name.split("_"), x) for name, x in figures.items())
        for value in values
    ]


def test_one_task_is_mann_and_whitneys():
    a, b = np.array([3.0, 1, 2, 2, NONE, 0]), np.array([2.0, 4, 4, NONE, 5, 2, 7])
    found = sums([(a, b)])
    for p, side in zip(found.p_values()[:2], ("less", "greater"), strict=True):
        there = stats.mannwhitneyu(
            a, b, alternative=side, use_continuity=False, method="asymptotic"
        )
        assert p == pytest.approx(there.pvalue, rel=1e-12)
    assert found.chance == 1 - stats.mannwhitneyu(a, b).statistic / (6 * 7)


def test_two_tasks_by_hand():
    # First task: of 4 pairs 3 are smaller, 3/4; ranks 1, 3 against 2, 4. Second: of 2 x 3 pairs one
    # is smaller and one a tie, 1.5/6. Weights mn / (m + n + 1): 4/5 and 6/6, as shares 4/9 and 5/9.
    pairs = [([1.0, 3.0], [2.0, 4.0]), ([5.0, 8.0], [5.0, 6.0, 4.0])]
    found = sums([(np.array(a), np.array(b)) for a, b in pairs])
    assert found.chance == pytest.approx(4 / 9 * 3 / 4 + 5 / 9 * 1.5 / 6)
    # Variances of the chance without a difference: 5 / (12 * 4), and with a tie of two
    # (6 - (8 - 2) / (5 * 4)) / (12 * 6).
    usual = (4 / 9) ** 2 * 5 / 48 + (5 / 9) ** 2 * 5.7 / 72
    assert found.score == pytest.approx((found.chance - 0.5) / math.sqrt(usual))


def test_verdicts():
    low, high = np.arange(20.0), np.arange(20.0) + 15
    found = compare(runs(hover_ppo=low, hover_vpg=high, landing_ppo=low, landing_vpg=high),
                    "error", "ppo", "vpg")  # fmt: skip
    assert found.verdict == "smaller" and found.by_task["hover"] == found.chance > 0.95
    assert found.seeds == {"hover": (20, 20), "landing": (20, 20)}
    turned = compare(runs(hover_ppo=low, hover_vpg=high), "error", "vpg", "ppo")
    assert turned.verdict == "larger" and turned.low < 1 - found.chance < turned.high
    # All equal, or none of them solved: with seeds enough that is no difference.
    for same, seeds, verdict in ((1.0, 20, "no difference"), (None, 20, "no difference"),
                                 (1.0, 4, "undecided")):  # fmt: skip
        found = compare(runs(hover_ppo=[same] * seeds, hover_vpg=[same] * seeds),
                        "error", "ppo", "vpg")  # fmt: skip
        assert found.verdict == verdict and found.chance == 0.5


@pytest.mark.parametrize("chance", [0.5, 0.75])
def test_power_is_what_experiments_find(chance):
    # Normal figures whose means are z apart: a seed is smaller with the chance Phi(z / sqrt(2)).
    rng, apart = np.random.default_rng(1), math.sqrt(2) * stats.norm.ppf(chance)
    drawn = [(rng.normal(size=(2000, 12)), rng.normal(apart, size=(2000, 12))) for _ in range(2)]
    right = VERDICTS.index("smaller" if chance > 0.5 else "no difference")
    found = np.mean(sums(drawn).verdict(0.05) == right)
    said = power([(a[0], b[0]) for a, b in drawn], chance)
    assert 0.3 < said < 0.95 and said == pytest.approx(found, abs=0.06)


def test_false_verdicts_are_as_rare_as_the_level_says():
    rng = np.random.default_rng(2)
    ties = [np.minimum(rng.normal(size=(2, 4000, 15)), 0.0) for _ in range(2)]  # half of them
    found = sums([(a, b) for a, b in ties]).verdict(0.1)
    assert 0.05 < np.mean(found < 2) < 0.12
    # At the margin "no difference" would be false.
    apart = math.sqrt(2) * stats.norm.ppf(0.75)
    drawn = [(rng.normal(size=(4000, 15)), rng.normal(apart, size=(4000, 15)))]
    assert np.mean(sums(drawn).verdict(0.1) == VERDICTS.index("no difference")) < 0.1


def test_what_cannot_be_compared_is_refused():
    given = runs(hover_ppo=[1.0, 2.0], hover_vpg=[1.0, 2.0], hover_trpo=[3.0])
    for wrong, said in (
        (("errors", "ppo", "vpg"), "figure = 'errors': must be one of error"),
        (("error", "ppo", "vgp"), "compared = 'vgp': must be one of ppo, vpg, trpo"),
        (("error", "ppo", "trpo"), "seeds of trpo, hover = 1: must be 2 or more"),
    ):
        with refused(match=said):
            compare(given, *wrong)


def test_a_study_compares_every_two_with_a_part_of_the_level(tmp_path):
    # One-sided p of 0.013: enough for one comparison at 0.05, not for one of three.
    near, far = [1.0, 2, 3, 4, 5], [4.0, 5.5, 6, 7, 8]
    given = runs(hover_ppo=near, hover_vpg=far, hover_trpo=near)
    found = StudyResult(tmp_path, tuple(given), (), {}).compare("error")
    assert [(one.one, one.other) for one in found] == [
        ("ppo", "vpg"),
        ("ppo", "trpo"),
        ("vpg", "trpo"),
    ]
    assert found[0].verdict == "undecided"
    assert compare(given, "error", "ppo", "vpg").verdict == "smaller"


def test_the_command_says_who_is_ahead(tmp_path, monkeypatch, capsys):
    given = tuple(runs(hover_ppo=[1.0, 2, 3, 4, 5], hover_vpg=[6.0, 7, 8, 9, 10]))
    found = StudyResult(tmp_path, given, (), {})
    monkeypatch.setattr(study, "study", lambda *what, **how: found)
    cli.main(["study", "a.toml", "--compare", "error"])
    line = next(x for x in capsys.readouterr().out.splitlines() if x.startswith("ppo"))
    assert line.split()[:3] == ["ppo", "vpg", "1.00"] and " smaller " in line
    cli.main(["study", "a.toml", "--compare", "error", "--json"])
    assert json.loads(capsys.readouterr().out)["compared"][0]["verdict"] == "smaller"


def test_figures_along_a_training(tmp_path):
    head = "steps,seconds,success,survival,error,return\n"
    for shares, solved, area, lost in (
        ((0, 0.96, 0.5, 0.95, 1), 40.0, 3.41 / 5, 0.0),
        ((0, 0.5, 1, 0.96, 0.9), None, 3.36 / 5, 0.1),
        ((1, 1), 10.0, 1.0, 0.0),
    ):
        rows = (f"{10 * (k + 1)},1,{share},1,1,1\n" for k, share in enumerate(shares))
        (tmp_path / "evaluations.csv").write_text(head + "".join(rows))
        found = along(tmp_path)
        assert found["solved_after_steps"] == solved
        assert found["success_area"] == pytest.approx(area)
        assert found["success_lost"] == pytest.approx(lost)
    assert along(tmp_path / "elsewhere") == {}
