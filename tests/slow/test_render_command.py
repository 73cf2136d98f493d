"""`quadrl render`: what it draws, and where it writes."""

from pathlib import Path

import imageio_ffmpeg
import pytest
from PIL import Image

from quadrl import cli
from quadrl.conditions.weather import WEATHERS
from quadrl.evaluation.evaluate import beside
from quadrl.evaluation.policy import Policy

pytestmark = [
    pytest.mark.usefixtures("cheap_pictures"),
    # mediapy and imageio_ffmpeg leave pipes of processes that are over to the garbage collector.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
QUICK = ["--task-options", "time_limit=0.2", "--width", "160", "--height", "120", "--fps", "10"]


def render(*words):
    cli.main(["render", *map(str, words), *QUICK])


def test_a_video_without_a_name_overwrites_nothing(capsys):
    Path("flight.mp4").write_text("mine")
    for expected in ("flight-2.mp4", "flight-3.mp4"):
        render("hover")
        assert capsys.readouterr().out == f"wrote {expected}\n"
    assert Path("flight.mp4").read_text() == "mine"
    render("hover", "--out", "flight.mp4")  # it was named
    assert imageio_ffmpeg.count_frames_and_secs("flight.mp4")[0] == 2 + 10
    assert len(list(Path().iterdir())) == 3


def test_policies_and_controllers_side_by_side(capsys):
    render("hover", "--controller", "geometric", "lqr", "--out", "a.png")
    with Image.open("a.png") as sheet:  # a row for each
        assert sheet.size == (4 * 162, 3 * 122)
    render("hover", "--controller", "lqr", "--out", "a.gif")
    with Image.open("a.gif") as gif:
        assert gif.size == (320, 120)
    capsys.readouterr()


def test_side_by_side_they_fly_the_task_of_the_first_in_one_world():
    flown = [scenario for _, scenario in beside(["landing_robust", "landing", "lqr"])]
    assert {scenario.task.name for scenario in flown} == {"landing"}
    trained = Policy.pretrained("landing", variant="robust").scenario
    assert all(scenario.randomization == trained.randomization for scenario in flown)
    flown = beside(["landing", "lqr"], vehicle="crazyflie", weather="light", start_height=2)
    for _, scenario in flown:
        assert scenario.task.start_height == 2 and scenario.vehicle.name == "crazyflie"
        assert scenario.weather == WEATHERS["light"]
    ((_, alone),) = beside(["lqr"])
    assert alone.task.name == "hover"


@pytest.mark.parametrize(
    ("policy", "label"),
    [("hover", "hover"), ("runs/a", "a"), ("runs/a/policy.safetensors", "a")]
    + [("x/best.safetensors", "best.safetensors"), ("policy.safetensors", "policy.safetensors")],
)
def test_flights_are_named_after_their_runs(policy, label):
    assert cli.render.label(policy) == label
