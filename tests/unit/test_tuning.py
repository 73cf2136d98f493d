"""A controller is tuned by random search."""

import numpy as np
import pytest

from quadrl.control import Gains, GeometricController
from quadrl.core.scenario import Scenario
from quadrl.evaluation.rollout import fly, summarize
from quadrl.evaluation.tuning import tuned

BETWEEN = {"gain": (0.1, 10.0), "limit": (0.0, 1.0)}


def test_settings_are_drawn_evenly_in_logarithms_and_the_best_is_kept():
    seen = []

    def judge(settings):
        seen.append(settings)
        return (-abs(np.log(settings["gain"] / 3.0)),)

    best = tuned(lambda settings: settings, BETWEEN, judge, tries=400)
    assert best.settings == max([*seen], key=lambda each: judge(each)[0])
    assert best.settings["gain"] == pytest.approx(3.0, 0.05)
    gains = np.array([each["gain"] for each in seen[:400]])
    # The median of an even draw of logarithms between 0.1 and 10 is 1.
    assert abs(np.log10(np.median(gains))) < 0.2 and 0.1 <= gains.min() and gains.max() <= 10.0
    limits = [each["limit"] for each in seen[:400]]
    assert 0.01 <= min(limits) and max(limits) <= 1.0  # 0 has no logarithm


def test_usual_settings_are_tried_first_and_only_a_better_score_replaces_them():
    usual, scores = {"gain": 2.0, "limit": 0.5}, iter([(0.5, 0.0), (0.5, np.nan), (0.5, 0.0)])
    best = tuned(lambda settings: settings, BETWEEN, lambda _: next(scores), tries=3, usual=usual)
    assert best == (usual, (0.5, 0.0))


def test_drawn_gains_fly():
    scenario = Scenario.of("hover", engine="free_flight")

    def make(settings):
        return GeometricController(scenario.aircraft, scenario.task, Gains(**settings))

    def judge(flyer):
        return (-summarize(fly(flyer, scenario, episodes=2, seed=3))["position_error_m"],)

    # The poles that are twice as fast settle sooner.
    best = tuned(make, {"level": (0.5, 2.0)}, judge, tries=3, usual={"level": 0.2})
    assert best.settings["level"] > 0.2
