"""Quantities as text."""

import math

import pytest

from quadrl.base import units
from quadrl.base.progress import TimeLeft

LENGTHS = [
    (0.0, "0 µm"),
    (1e-9, "under 0.1 µm"),
    (7.6e-7, "0.76 µm"),
    (5.3e-5, "53 µm"),
    (9.9996e-4, "1.00 mm"),
    (0.0052, "5.2 mm"),
    (0.0112, "1.1 cm"),
    (-0.123, "-12 cm"),
    (1234.0, "1,234 m"),
    (math.nan, "nan µm"),
]
SHARES = [(1.0, "100 %"), (0.9999, "99.99 %"), (0.995, "99.5 %"), (0.12, "12 %"), (0.0, "0 %")]
SHARES += [(0.0004, "0.04 %")]  # only all is a hundred percent, and only none is zero
TIMES = [(0.4, "0 s"), (59.7, "1:00 min"), (725, "12:05 min"), (12000, "3:20 h")]


@pytest.mark.parametrize(
    ("shown", "cases"),
    [(units.length, LENGTHS), (units.percent, SHARES), (units.duration, TIMES)],
    ids=["length", "share", "time"],
)
def test_a_number_is_shown_in_the_unit_that_fits(shown, cases):
    assert [shown(number) for number, _ in cases] == [text for _, text in cases]


def test_a_metric_has_the_unit_of_its_name():
    metrics = {
        "position_error_m": (0.02, "2.0 cm"),
        "success_rate": (0.5, "50 %"),
        "heading_error_deg": (3.27, "3.3 °"),
        "yaw_rate_rad_s": (7.4e-6, "under 0.001 rad/s"),
        "touchdown_speed_median_m_s": (0.2, "0.20 m/s"),
        "length_mean_s": (10.0, "10 s"),
        "return_mean": (187.4, "187"),
        "episodes": (100, "100"),
        "task": ("hover", "hover"),
        "speed_error_share": (0.12, "12 %"),
        "command_change_rate": (None, "none"),
        "circling_m_s": (0.00712, "0.007 m/s"),
    }
    assert units.quantity("race_time_best_s", float("nan")) == "none"
    shown = {name: units.quantity(name, value) for name, (value, _) in metrics.items()}
    assert shown == {name: text for name, (_, text) in metrics.items()}


def test_the_time_left_is_told_from_the_speed_since_the_first_look(monkeypatch):
    now = iter([100.0, 110.0, 130.0, 140.0])
    monkeypatch.setattr("quadrl.base.progress.time.monotonic", lambda: next(now))
    clock = TimeLeft()
    # Three of ten are done by others; two more in 10 s, so that five take 25 s.
    assert [clock.left(done, 10) for done in (3, 5, 9, 10)] == ["", "  25 s left", "  5 s left", ""]
