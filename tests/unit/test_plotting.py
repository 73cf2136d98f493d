"""Plots: what is drawn of flights and of trainings, in which colours, and in which files."""

import numpy as np
import pytest
from helpers import refused
from scipy.spatial.transform import Rotation

import quadrl
from quadrl import tasks
from quadrl.base.media import Media
from quadrl.evaluation import flight_figures, plotting
from quadrl.evaluation.controllers import make_controller
from quadrl.evaluation.rollout import fly
from quadrl.learning.folder import read_metrics
from quadrl.learning.foreign import read_curve
from quadrl.rendering import read_scenarios

STEPS = np.arange(1.0, 6.0)
METRICS = {name: STEPS for name in ("steps", "seconds", "success", "error", "survival")}
FILES = [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")]
METRICS["return"] = np.where(STEPS % 2, STEPS, np.nan)


def drawn(name, vehicle="paper", episodes=3, weather=None, **options):
    """The axes of a picture of some flights by their labels, and the rollout."""
    task = tasks.make(name, time_limit=0.5, **options)
    flown = {"episodes": episodes, "vehicle": vehicle, "weather": weather}
    rollout = fly(make_controller("lqr", task), task, **flown)
    parts = flight_figures.trajectory(rollout, "title").subfigs
    axes = [axis for part in parts for axis in part.axes if axis.get_visible()]
    return {a.get_ylabel() or a.get_title("left"): a for a in axes}, rollout


def lines(axis, style):
    return [line for line in axis.lines if line.get_linestyle() == style]


def test_flights_are_shown_with_attitude_speed_and_commands():
    axes, rollout = drawn("hover")
    assert not {"wind [m/s]", "airspeed [m/s]"} & set(axes)
    for k, name in enumerate(flight_figures.PLACE):
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
    for name, first, values in (
        ("rotor", "speed [rad/s]", rollout.rotor_speed),
        ("action", "action", rollout.action),
    ):
        for k, axis in enumerate([axes[first], *(axes[f"{name} {n}"] for n in (2, 3, 4))]):
            assert axis.get_title("left") == f"{name} {k + 1}"
            np.testing.assert_array_equal(axis.lines[2].get_ydata(), values[:, 2, k])


def test_flights_in_wind_show_it_and_the_airspeed():
    axes, rollout = drawn("hover", weather="light")
    wind, air = rollout.wind[:, 1], rollout.velocity[1:, 1] - rollout.wind[:, 1]
    for name, value in (("wind [m/s]", wind), ("airspeed [m/s]", air)):
        shown = axes[name].lines[1].get_ydata()
        np.testing.assert_allclose(shown, np.linalg.norm(value, axis=1), rtol=1e-12)
    np.testing.assert_array_equal(axes["error [m]"].lines[1].get_ydata(), rollout.error[:, 1])
    assert axes["error [m]"].get_yscale() == "log"


def test_each_flight_has_its_colour_and_its_own_goal():
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


def test_the_mean_action_is_the_main_line_where_it_was_evaluated():
    evaluated = {name: values[::2] for name, values in METRICS.items()}
    figure = plotting.learning_curve(METRICS, "title", evaluated)
    for axis, name in zip(figure.axes[:3], plotting.PANELS, strict=True):
        main = max(axis.lines, key=lambda line: line.get_linewidth())
        assert main.get_label() == name
        np.testing.assert_array_equal(main.get_xdata(), evaluated["steps"] / 1000)
        np.testing.assert_array_equal(main.get_ydata(), evaluated[name])


def test_runs_are_compared_by_their_median_where_all_have_been():
    late = METRICS | {"return": np.where(STEPS > 2, 3 * STEPS, np.nan)}
    points, (low, median, high) = plotting.spread([METRICS, late, late], "return", "steps")
    assert points[0] == 3 and points[-1] == 5
    np.testing.assert_allclose([low, median, high], np.outer((1, 3, 3), points))
    figure = plotting.learning_curves({"ppo": [METRICS, late], "own": [late]}, "hover")
    words = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert words == ["PPO, 2 seeds", "own, 1 seed"]
    np.testing.assert_allclose(figure.axes[0].lines[0].get_xdata(), points / 1000)  # thousands
    nothing = METRICS | dict.fromkeys(("return", "success"), np.full(5, np.nan))
    with refused(match="no episode has ended"):
        plotting.learning_curves({"ppo": [nothing]}, "hover")


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "begins"), FILES)
def test_the_same_numbers_make_the_same_file_of_every_kind(tmp_path, kind, begins):
    paths = [tmp_path / f"{k}.{kind}" for k in (1, 2)]
    first, second = (
        plotting.save(plotting.learning_curve(METRICS, "title"), path).read_bytes()
        for path in paths
    )
    assert first == second and first.startswith(begins)
    assert kind in Media(first, kind)._repr_html_()


@pytest.mark.slow
def test_a_picture_of_flights_is_saved_as_every_kind_and_carries_its_scenario(tmp_path):
    flown = quadrl.evaluate("geometric", "hover", episodes=1, time_limit=0.5)
    shown = quadrl.plot(flown, kind="pdf")
    for kind, begins in FILES:
        assert shown.save(tmp_path / f"flight.{kind}").read_bytes().startswith(begins)
    assert read_scenarios(tmp_path / "flight.png") == [flown.scenario]


def test_other_kinds_are_refused(tmp_path):
    figure = plotting.learning_curve(METRICS, "title")
    path = tmp_path / "c.xyz"
    with refused(f"ending of {path}", "xyz"):
        plotting.save(figure, path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "text", [None, "", "iteration,steps\n", "iteration,steps\n1,32\n", "iteration,steps\n1,many\n"]
)
def test_metrics_that_cannot_be_drawn_are_refused(tmp_path, text):
    path = tmp_path / "metrics.csv"
    if text is not None:
        path.write_text(text)
    with refused(match=str(path)):
        read_metrics(path)


OTHERS = {  # the content of a csv, and what is read of it: steps, column, values
    "steps,value\n0,0\n10,0.5\n20,1\n": ([0, 10, 20], "success", [0, 0.5, 1]),
    "Wall time,Step,Value\n1.7e9,10,-3\n1.7e9,20,250\n": ([10, 20], "return", [-3, 250]),
    # W&B's export of a run, which went on at an earlier step.
    '"Step","my - eval/success_rate","my - eval/success_rate__MIN"\n20,0.9,0.1\n10,0.2,""\n':
        ([10, 20], "success", [0.2, 0.9]),
    # Stable-Baselines3's progress.csv: evaluations have rows of their own.
    "time/total_timesteps,rollout/ep_rew_mean,eval/mean_reward\n8,1.5,\n16,,7\n":
        ([8, 16], "return", [np.nan, 7]),
    "time/total_timesteps,rollout/ep_rew_mean,eval/mean_reward\n8,1.5,\n16,2.5,\n":
        ([8, 16], "return", [1.5, 2.5]),
    '#{"t_start": 1.5, "env_id": "quadrl/Hover-v0"}\nr,l,t\n4.0,10,0.5\n8.0,30,1.5\n':
        ([10, 40], "return", [4, 6]),  # mean of the episodes so far
}  # fmt: skip


@pytest.mark.parametrize("text", OTHERS)
def test_curves_of_other_programs_are_read(tmp_path, text):
    (tmp_path / "curve.csv").write_text(text)
    steps, name, values = OTHERS[text]
    read = read_curve(tmp_path / "curve.csv")
    np.testing.assert_array_equal(read["steps"], steps)
    np.testing.assert_array_equal(read[name], values)


def test_a_monitor_is_the_mean_of_its_last_hundred_episodes(tmp_path):
    rows = "".join(f"{k},1,{k}\n" for k in range(150))
    (tmp_path / "monitor.csv").write_text(f"#{{}}\nr,l,t\n{rows}")
    mean = read_curve(tmp_path / "monitor.csv")["return"]
    assert mean[99] == pytest.approx(49.5) and mean[149] == pytest.approx(np.arange(50, 150).mean())


@pytest.mark.parametrize("text", ["", "steps,value\n", "a,b\n1,2\n", "steps,loss\n1,2\n"])
def test_a_csv_without_a_curve_is_refused(tmp_path, text):
    (tmp_path / "curve.csv").write_text(text)
    with refused(match="curve.csv has no column of"):
        read_curve(tmp_path / "curve.csv")


def test_curves_of_other_programs_are_drawn_beside_those_of_runs():
    other = {"steps": STEPS, "success": STEPS / 5}
    figure = plotting.learning_curves({"ppo": [METRICS], "mine": [other]}, "hover")
    labels = [[line.get_label() for line in axis.lines] for axis in figure.axes]
    both = ["PPO, 1 seed", "mine, 1 seed"]
    assert labels == [both[:1], both, both[:1], both[:1]]  # by steps, then by seconds
    assert [text.get_text() for text in figure.axes[1].get_legend().get_texts()] == both
    alone = plotting.learning_curves({"mine": [other]}, "hover")
    assert [len(axis.lines) for axis in alone.axes] == [0, 1]
