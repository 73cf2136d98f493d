"""The picture of flights: what is drawn, and in which colours."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadrl import tasks
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.rollout import fly
from quadrl.learning import figures


@pytest.fixture
def drawn(monkeypatch):
    """A function that draws some flights and gives the axes by their labels, and the rollout."""
    kept = []
    monkeypatch.setattr(figures, "save", lambda figure, path: kept.append(figure) or path)

    def draw(name, vehicle="paper", episodes=3, weather=None, **options):
        task = tasks.make(name, time_limit=0.5, **options)
        flown = {"episodes": episodes, "vehicle": vehicle, "weather": weather}
        rollout = fly(make_controller("lqr", task), task, **flown)
        figures.trajectory(rollout, "title", Path("a.png"))
        axes = [axis for part in kept[-1].subfigs for axis in part.axes if axis.get_visible()]
        return {a.get_ylabel() or a.get_title("left"): a for a in axes}, rollout

    return draw


def lines(axis, style):
    return [line for line in axis.lines if line.get_linestyle() == style]


def test_flights_are_shown_with_attitude_speed_and_commands(drawn):
    axes, rollout = drawn("hover")
    for k, name in enumerate(("x east [m]", "y north [m]", "z up [m]")):
        data = [line.get_ydata() for line in lines(axes[name], "-")]
        np.testing.assert_array_equal(np.transpose(data), rollout.position[..., k])
    attitude = Rotation.from_quat(rollout.quaternion[:, 0], scalar_first=True)
    yaw, pitch, roll = attitude.as_euler("ZYX", degrees=True).T
    # With axes ahead, left and up the nose is up where the pitch is negative.
    for name, angle in (("roll [deg]", roll), ("pitch [deg]", -pitch), ("yaw [deg]", yaw)):
        turned = axes[name].lines[0].get_ydata() - angle
        np.testing.assert_allclose((turned + 180) % 360 - 180, 0, atol=1e-6)
    speed = np.linalg.norm(rollout.velocity, axis=-1)
    np.testing.assert_array_equal(axes["speed [m/s]"].lines[1].get_ydata(), speed[:, 1])
    rotors = [axes["speed [rad/s]"], *(axes[f"rotor {k}"] for k in (2, 3, 4))]
    for name, parts, values in (
        ("rotor", rotors, rollout.rotor_speed),
        ("action", [axes["action"], *(axes[f"action {k}"] for k in (2, 3, 4))], rollout.action),
    ):
        for k, axis in enumerate(parts):
            assert axis.get_title("left") == f"{name} {k + 1}"
            np.testing.assert_array_equal(axis.lines[2].get_ydata(), values[:, 2, k])


def test_flights_in_wind_show_it_and_the_airspeed(drawn):
    axes, _ = drawn("hover")
    assert not {"wind [m/s]", "airspeed [m/s]"} & set(axes)
    axes, rollout = drawn("hover", weather="light")
    wind, air = rollout.wind[:, 1], rollout.velocity[:, 1] - rollout.wind[:, 1]
    for name, value in (("wind [m/s]", wind), ("airspeed [m/s]", air)):
        drawn_line = axes[name].lines[1].get_ydata()
        np.testing.assert_allclose(drawn_line, np.linalg.norm(value, axis=1), rtol=1e-12)
    np.testing.assert_array_equal(axes["error [m]"].lines[1].get_ydata(), rollout.error[:, 1])
    assert axes["error [m]"].get_yscale() == "log"


def test_each_flight_has_its_colour_and_its_own_goal(drawn):
    axes, _ = drawn("hover", episodes=9)
    assert len({line.get_color() for line in lines(axes["x east [m]"], "-")}) == 8
    (goal,) = lines(axes["x east [m]"], "--")  # one for all
    assert goal.get_color() == "black"
    for name in ("random_waypoint", "target_following"):
        axes, rollout = drawn(name)
        flights, goals = (lines(axes["y north [m]"], style) for style in ("-", "--"))
        assert [g.get_color() for g in goals] == [f.get_color() for f in flights]
        data = np.transpose([g.get_ydata() for g in goals])
        np.testing.assert_array_equal(data, rollout.goal[..., 1])
        assert len(goals) == 3
