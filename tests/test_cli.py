"""The command: what it writes and prints, and what it says when something is wrong."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from safetensors.numpy import save

import quadrl
from quadrl import cli, tasks

REPOSITORY = Path(quadrl.__file__).parents[1]
SIZE = ["--num-envs", "8", "--rollout", "4", "--steps", "192", "--hidden", "16"]
TINY = [*SIZE, "--task-options", "horizon=0.5", "--episodes", "2", "--checkpoint-seconds", "0"]
FILES = {
    "config.json",
    "metrics.csv",
    "events",
    "checkpoint.safetensors",
    "policy.safetensors",
    "evaluation.json",
    "learning_curve.png",
    "trajectory.png",
}
FIGURES = {"success_rate", "survival_rate", "position_error_m", "return_mean", "return_std"}


def quadrl_command(*arguments: object) -> int:
    """Exit code of the command in this process."""
    try:
        cli.main([str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code
    return 0


def in_a_process(*arguments: object, **environment: str) -> subprocess.CompletedProcess:
    variables = os.environ | {"PYTHONPATH": str(REPOSITORY)} | environment
    command = [sys.executable, "-W", "ignore", "-m", "quadrl", *map(str, arguments)]
    return subprocess.run(command, env=variables, capture_output=True, text=True)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with everything in it; not to be written to."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert quadrl_command("train", "hover", *TINY, "--out", folder) == 0
    return folder


@pytest.fixture
def copy(run, tmp_path):
    return Path(shutil.copytree(run, tmp_path / "copy"))


def refusal(capsys, *arguments: object) -> str:
    """The one line that a command with bad input prints on stderr."""
    capsys.readouterr()
    assert quadrl_command(*arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("quadrl: ") and said.err.count("\n") == 1, said.err
    assert "Traceback" not in said.err
    return said.err


# What it does.


def test_tasks(capsys):
    assert quadrl_command("tasks") == 0
    listed = capsys.readouterr().out
    for name in tasks.TASKS:
        assert name in listed
    assert quadrl_command("tasks", "hover") == 0
    shown = " ".join(capsys.readouterr().out.split())  # wherever the lines break
    for words in ("horizon 10 s", "rotor_speed 15..18 1", "35 rad/s at 1", "tilt 0.2 Largest tilt"):
        assert words in shown
    assert "target_velocity" in listed and "target_velocity" not in shown


def test_tasks_for_a_program_to_read(capsys):
    assert quadrl_command("tasks", "--json") == 0
    read = json.loads(capsys.readouterr().out)
    assert list(read) == list(tasks.TASKS)
    assert quadrl_command("tasks", "landing", "--json") == 0
    landing = json.loads(capsys.readouterr().out)
    assert landing == read["landing"]
    weights = {term["name"]: term["weight"] for term in landing["reward"]}
    assert (weights["progress"], weights["survival"], weights["failure"]) == (100, 0, 300)


def test_every_task_has_defaults_to_train_with(capsys):
    for name in tasks.TASKS:
        assert quadrl_command("train", name, "--help") == 0
        assert "--num-envs" in capsys.readouterr().out


def test_train_writes_every_file(run):
    assert {p.name for p in run.iterdir()} == FILES | {"flight.mp4"}
    config = json.loads((run / "config.json").read_text())
    assert (config["task"], config["num_envs"], config["hidden"]) == ("hover", 8, [16])
    assert config["resolved_task"]["horizon"] == 0.5
    with open(run / "metrics.csv", newline="") as file:
        assert [int(row["steps"]) for row in csv.DictReader(file)] == [32, 64, 96, 128, 160, 192]
    assert any(p.name.startswith("events.out.tfevents") for p in (run / "events").iterdir())
    evaluation = json.loads((run / "evaluation.json").read_text())
    assert FIGURES < set(evaluation)
    assert evaluation["episodes"] == 2 and evaluation["training_s"] > 0
    policy = quadrl.Policy.load(run)
    assert policy.metadata["steps"] == 192 and policy.weights[0].shape == (16, 22)
    for name in ("learning_curve.png", "trajectory.png"):
        assert (run / name).read_bytes().startswith(b"\x89PNG")
    # An episode of 0.5 s has states at 0.05 to 0.5 s: 0.45 s at 25 frames a second are 12.
    assert imageio_ffmpeg.count_frames_and_secs(str(run / "flight.mp4"))[0] == 12


def test_train_without_video_and_where_to_go_on(tmp_path, capsys):
    folder = tmp_path / "a folder" / "run"
    assert quadrl_command("train", "hover", *TINY, "--no-video", "--out", folder) == 0
    assert {p.name for p in folder.iterdir()} == FILES
    said = capsys.readouterr().out
    assert "100 %        192 steps" in said
    for command in (f"quadrl render '{folder}'", f"quadrl evaluate '{folder}'"):
        assert command in said  # on one line, however long


def test_train_into_the_default_folder(tmp_path):
    assert quadrl_command("train", "hover", *TINY, "--no-video", "--seed", "3") == 0
    assert (tmp_path / "runs" / "hover-ppo-3" / "policy.safetensors").exists()


def test_evaluate_prints_one_json_object_and_nothing_else(run, capsys):
    printed = []
    for _ in range(2):
        assert quadrl_command("evaluate", run, "--episodes", "3", "--json") == 0
        said = capsys.readouterr()
        assert said.err == ""
        printed.append(said.out)
    assert printed[0] == printed[1]  # the mean action, the same episodes
    figures = json.loads(printed[0])
    assert FIGURES < set(figures)
    assert figures["episodes"] == 3 and figures["task"] == "hover"
    assert all(np.isfinite(figures[name]) for name in FIGURES)
    # The options of the training hold: horizon=0.5, at 10 points a step or so.
    assert figures["length_mean_s"] <= 0.5
    assert quadrl_command("evaluate", run, "--episodes", "3", "--seed", "9", "--json") == 0
    assert json.loads(capsys.readouterr().out)["return_mean"] != figures["return_mean"]


def test_evaluation_of_the_training_is_that_of_evaluate(run, capsys):
    assert quadrl_command("evaluate", run, "--episodes", "2", "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures.items() <= json.loads((run / "evaluation.json").read_text()).items()


def test_evaluate_with_other_options_and_from_a_file(run, capsys):
    file = run / "policy.safetensors"
    options = ["--task-options", "horizon=0.25", "radius=0.1", "--episodes", "2"]
    assert quadrl_command("evaluate", file, *options, "--json") == 0
    assert json.loads(capsys.readouterr().out)["length_mean_s"] == 0.25
    assert quadrl_command("evaluate", file, *options) == 0
    assert "position_error_m" in capsys.readouterr().out


def test_render_writes_a_video_that_plays(run, tmp_path, capsys):
    path = tmp_path / "new" / "a.mp4"
    size = ["--width", "160", "--height", "120", "--fps", "20", "--camera", "chase"]
    assert quadrl_command("render", run, "--out", path, *size) == 0
    assert capsys.readouterr().out == f"wrote {path}\n"
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert (frames, seconds) == (10, 0.5)
    played = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "null", "-"],
        capture_output=True,
        text=True,
    )
    assert played.returncode == 0 and "160x120" in played.stderr


def test_plot(copy, capsys):
    before = (copy / "learning_curve.png").read_bytes()
    (copy / "learning_curve.png").unlink()
    assert quadrl_command("plot", copy) == 0
    assert capsys.readouterr().out == f"wrote {copy / 'learning_curve.png'}\n"
    assert (copy / "learning_curve.png").read_bytes() == before
    assert quadrl_command("plot", copy, "--out", copy / "new" / "curve.svg") == 0
    assert b"<svg" in (copy / "new" / "curve.svg").read_bytes()


def test_plot_of_several_runs(run, tmp_path, capsys):
    folders = [tmp_path / name for name in ("a", "b", "c")]
    for folder, task, algo in zip(folders, ("hover", "hover", "landing"), ("ppo", "gae", "ppo"),
                                  strict=True):  # fmt: skip
        shutil.copytree(run, folder)
        config = json.loads((folder / "config.json").read_text()) | {"task": task, "algo": algo}
        (folder / "config.json").write_text(json.dumps(config))
    (tmp_path / "no run").mkdir()
    assert quadrl_command("plot", *folders, tmp_path / "no run", "--format", "svg") == 0
    said = capsys.readouterr().out
    assert f"left out: {tmp_path / 'no run'} holds no run" in said
    names = ("learning_curves_hover.svg", "learning_curves_landing.svg")
    for name, shown in zip(names, (("PPO, 1 seed", "GAE, 1 seed"), ("PPO, 1 seed",)), strict=True):
        assert f"wrote {name}" in said
        assert all(label in (tmp_path / name).read_text() for label in shown)
    assert quadrl_command("plot", *folders[:2], "--out", "new/x.pdf") == 0
    assert (tmp_path / "new" / "x.pdf").read_bytes().startswith(b"%PDF")
    assert quadrl_command("plot", *folders, "--out", "new/x.png") == 0
    assert {p.name for p in (tmp_path / "new").iterdir()} == {
        "x.pdf", "x_hover.png", "x_landing.png",
    }  # fmt: skip
    assert quadrl_command("plot", folders[0], "--format", "pdf") == 0
    assert (folders[0] / "learning_curve.pdf").read_bytes().startswith(b"%PDF")
    assert "which run?" in refusal(capsys, "plot")
    assert "is no .svg" in refusal(capsys, "plot", *folders, "--out", "a.png", "--format", "svg")
    nothing = [tmp_path / "no run", tmp_path / "nowhere"]
    assert quadrl_command("plot", *nothing) == 2
    assert "none of the 2 folders holds a run to plot" in capsys.readouterr().err


def test_the_name_of_a_task_flies_the_policy_that_ships(capsys):
    assert quadrl_command("evaluate", "hover", "--episodes", "5", "--json") == 0
    shipped = capsys.readouterr().out
    file = quadrl.policy.SHIPPED / "hover_ppo.safetensors"
    assert quadrl_command("evaluate", file, "--episodes", "5", "--json") == 0
    assert capsys.readouterr().out == shipped
    # A folder of that name is written otherwise, and the name itself still means the task.
    shutil.copytree(quadrl.policy.SHIPPED, "hover")
    assert quadrl_command("evaluate", "hover", "--episodes", "5", "--json") == 0
    assert capsys.readouterr().out == shipped
    assert "no policy at hover/policy.safetensors" in refusal(capsys, "evaluate", "./hover")
    said = refusal(capsys, "evaluate", "hover", "--algo", "sac")
    assert "no policy comes with quadrl for hover with sac; choices: " in said
    assert "--algo ppo chooses among" in refusal(capsys, "evaluate", "./hover", "--algo", "ppo")
    size = ["--width", "64", "--height", "48", "--fps", "1", "--out", "a.mp4"]
    assert quadrl_command("render", "hover", *size) == 0
    assert imageio_ffmpeg.count_frames_and_secs("a.mp4")[0] == 10


def test_an_algorithm_has_its_own_defaults(capsys):
    batches = []
    for words in ([], ["--algo", "gae"], ["--algo=gae"], ["--algo", "gae", "--algo", "ppo"]):
        assert quadrl_command("train", "hover", *words, "--help") == 0
        text = " ".join(capsys.readouterr().out.split())
        batches.append(text.partition("Aircraft flown together. (default: ")[2].partition(")")[0])
    assert batches == ["256", "128", "128", "256"]


def test_resume_of_a_finished_run(copy, capsys):
    before = contents(copy)
    assert quadrl_command("train", "--resume", copy, "--no-video", "--episodes", "2") == 0
    assert f"going on with {copy} at iteration 6" in capsys.readouterr().out
    after = contents(copy)
    for name in ("policy.safetensors", "metrics.csv", "checkpoint.safetensors", "config.json"):
        assert after[name] == before[name]


def test_resume_takes_the_configuration_of_the_run(run, copy):
    for name in ("policy.safetensors", "checkpoint.safetensors", "metrics.csv"):
        (copy / name).unlink()
    # The flags of another training are not those of this one.
    assert quadrl_command("train", "landing", "--resume", copy, "--no-video", "--gamma", "0.5") == 0
    assert (copy / "policy.safetensors").read_bytes() == (run / "policy.safetensors").read_bytes()


def test_interrupted_it_says_how_to_go_on(run, tmp_path):
    folder = tmp_path / "run"
    longer = ["train", "hover", *TINY, "--steps", str(32 * 100_000), "--out", folder]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "-m", "quadrl", *map(str, longer)]
    process = subprocess.Popen(
        command,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell starts what runs in the background with it ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 120
    while not (folder / "checkpoint.safetensors").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate()
    assert process.returncode == 130
    assert error == (
        f"quadrl: stopped; the run is kept, go on with it: quadrl train --resume {folder}\n"
    )


# What it refuses.


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--num-envs", "0"], "num_envs = 0: 1 to 1048576 is allowed"),
        (["--num-envs", "-3"], "num_envs = -3: 1 to 1048576 is allowed"),
        (["--num-envs", "1000000000"], "num_envs = 1000000000: 1 to 1048576 is allowed"),
        (["--rollout", "1000000000"], "with rollout = 1000000000: 2 to 16777216 transitions"),
        (["--steps", "0"], "steps = 0: at least 1 is allowed"),
        (["--algo", "sac"], "unknown algorithm 'sac'; choices: "),
        (["--vehicle", "brick"], "unknown vehicle 'brick'; choices: "),
        (["--gamma", "2"], "gamma = 2.0: 0 to 1 is allowed"),
        (["--seed", "-1"], "seed = -1: 0 to 999 is allowed"),
        (["--episodes", "0"], "episodes = 0: 1 to 100000 is allowed"),
        (["--ppo.minibatch", "0"], "minibatch = 0: at least 1 is allowed"),
        (["--num-threads", "-1"], "num_threads = -1: 0 to 1024 is allowed"),
        (["--task-options", "horizn=5"], "unknown hover option 'horizn' (did you mean horizon?)"),
        (["--task-options", "horizon"], "option 'horizon': NAME=VALUE is expected"),
        (["--task-options", "horizon=far"], "horizon = 'far': a number is expected"),
        (["--task-options", "horizon=0"], "horizon = 0"),
    ],
)
def test_trainings_that_cannot_be_are_refused(capsys, tmp_path, arguments, says):
    folder = tmp_path / "run"
    assert says in refusal(capsys, "train", "hover", *TINY, "--out", folder, *arguments)
    assert not folder.exists()


def test_unknown_tasks_are_refused(capsys, run):
    for arguments in (["train"], ["tasks"], ["evaluate", run, "--task"], ["render", run, "--task"]):
        said = refusal(capsys, *arguments, "hovr")
        assert "unknown task 'hovr' (did you mean hover?); choices: hover, " in said


def test_what_tyro_reports(capsys, tmp_path):
    for arguments in (
        ["train", "hover", "--bogus"],
        ["train", "hover", "--steps", "many"],
        ["evaluate"],
        ["fly"],
        [],
    ):
        assert quadrl_command(*arguments) == 2
        said = capsys.readouterr()
        assert said.err and "Traceback" not in said.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("below", ["a regular file", "/proc"])
def test_unwritable_output_folder(capsys, tmp_path, below):
    parent = Path("/proc")
    if below == "a regular file":
        parent = tmp_path / "file"
        parent.write_text("something")
    said = refusal(capsys, "train", "hover", *TINY, "--out", parent / "run")
    assert f"cannot write the run folder {parent / 'run'}" in said
    assert "choose another with --out" in said


def test_a_folder_that_holds_a_run_is_left_alone(capsys, copy):
    before = contents(copy)
    said = refusal(capsys, "train", "hover", *TINY, "--out", copy)
    assert f"{copy} already holds a run" in said and f"quadrl train --resume {copy}" in said
    assert contents(copy) == before


def test_resume_without_a_run(capsys, tmp_path):
    for folder in (tmp_path, tmp_path / "nowhere"):
        said = refusal(capsys, "train", "--resume", folder)
        assert f"{folder} holds no run: there is no config.json in it" in said
    assert not list(tmp_path.iterdir())


def test_resume_with_a_damaged_checkpoint(capsys, copy):
    path = copy / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:100])
    before = contents(copy)
    assert f"{path} is damaged" in refusal(capsys, "train", "--resume", copy)
    assert contents(copy) == before


def test_a_disk_that_fills_up(capsys, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", str(tmp_path / "run" / "checkpoint"))

    monkeypatch.setattr("quadrl.learning.checkpoint.write_whole", full)
    folder = tmp_path / "run"
    assert quadrl_command("train", "hover", *TINY, "--no-video", "--out", folder) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "No space left on device" in line and f"quadrl train --resume {folder}" in line
    monkeypatch.undo()
    assert quadrl_command("train", "--resume", folder, "--no-video", "--episodes", "2") == 0


@pytest.mark.parametrize("command", ["evaluate", "render"])
@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "no policy at"),
        (b"", "is damaged or no safetensors file"),
        (b"PK\x03\x04 a torch checkpoint", "is damaged or no safetensors file"),
        (save({"weight": np.zeros(3, np.float32)}), "is no policy of this version of quadrl"),
    ],
)
def test_files_that_hold_no_policy(capsys, tmp_path, command, content, says):
    path = tmp_path / "policy.safetensors"
    if content is not None:
        path.write_bytes(content)
    for given in (path, tmp_path):
        said = refusal(capsys, command, given)
        assert says in said and str(path) in said


def test_a_truncated_policy(capsys, copy):
    path = copy / "policy.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    assert f"{path} is damaged" in refusal(capsys, "evaluate", copy, "--json")


def test_a_policy_that_sees_something_else(capsys, run):
    # Beside the 22 numbers of hover, tasks with a moving target show its velocity.
    said = refusal(capsys, "evaluate", run, "--task", "target_following")
    assert "a policy for hover sees 22 numbers, and the task target_following shows 25" in said
    assert "train one with quadrl train target_following" in said


def test_a_policy_for_a_task_that_is_not_there(capsys, run, monkeypatch):
    monkeypatch.delitem(tasks.TASKS, "hover")
    assert "unknown task 'hover'" in refusal(capsys, "evaluate", run)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--episodes", "0"], "episodes = 0: 1 to 100000 is allowed"),
        (["--episodes", "-1"], "episodes = -1: 1 to 100000 is allowed"),
        (["--seed", "-1"], "seed = -1: at least 0 is allowed"),
        (["--task-options", "x=1"], "unknown hover option 'x'"),
        (["--task-options", "x"], "option 'x': NAME=VALUE is expected"),
    ],
)
def test_evaluations_that_cannot_be(capsys, run, arguments, says):
    assert says in refusal(capsys, "evaluate", run, *arguments)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--camera", "sky"], "unknown camera 'sky'"),
        (["--camera", "chse"], "(did you mean chase?); choices: follow, "),
        (["--width", "161"], "161x480 pixels: a video needs an even width and height"),
        (["--width", "0"], "0x480 pixels: at most 1920x1080 can be drawn"),
        (["--height", "100000"], "848x100000 pixels: at most 1920x1080 can be drawn"),
        (["--fps", "0"], "fps = 0.0: 1 to 240 frames a second are allowed"),
        (["--fps", "1e9"], "1 to 240 frames a second are allowed"),
        (["--seed", "-1"], "seed = -1: at least 0 is allowed"),
        (["--out", "a.gif"], "a.gif: the name of a video must end in .mp4"),
    ],
)
def test_videos_that_cannot_be(capsys, run, tmp_path, arguments, says):
    assert says in refusal(capsys, "render", run, *arguments)
    assert not list(tmp_path.iterdir())


def test_pictures_that_cannot_be_written(capsys, run, tmp_path):
    file = tmp_path / "file"
    file.write_text("something")
    for command, name in (("render", "a.mp4"), ("plot", "a.png")):
        said = refusal(capsys, command, run, "--out", file / name)
        assert f"cannot write {file / name}" in said and "choose another with --out" in said
    assert file.read_text() == "something"


def test_plots_of_what_is_no_run(capsys, copy, tmp_path):
    assert "holds no run" in refusal(capsys, "plot", tmp_path / "nowhere")
    assert "a picture's name ends in one of" in refusal(capsys, "plot", copy, "--out", "a.xyz")
    (copy / "metrics.csv").write_text("")
    assert "has no rows" in refusal(capsys, "plot", copy)
    (copy / "metrics.csv").unlink()
    assert f"there is no {copy / 'metrics.csv'}" in refusal(capsys, "plot", copy)
    (copy / "config.json").write_text("{}")
    assert "does not say the run's algo, seed, task" in refusal(capsys, "plot", copy)


# Machines that lack something.


def test_without_graphics_it_trains_and_says_that_there_is_no_video(tmp_path):
    folder = tmp_path / "run"
    done = in_a_process("train", "hover", *TINY, "--out", folder, MUJOCO_GL="disabled")
    assert (done.returncode, done.stderr) == (0, "")
    assert "no video: no OpenGL context can be had here" in done.stdout
    assert {p.name for p in folder.iterdir()} == FILES
    done = in_a_process("render", folder, MUJOCO_GL="disabled")
    assert done.returncode == 2
    assert done.stderr.startswith("quadrl: no OpenGL context can be had here")
    assert "apt install libegl1" in done.stderr and done.stderr.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_without_a_compiler_it_says_what_to_install(run, tmp_path):
    folder = tmp_path / "run"
    nothing = {"PATH": str(tmp_path / "bin"), "CC": "", "QUADRL_CACHE": str(tmp_path / "cache")}
    for arguments in (["train", "hover", *TINY, "--out", folder], ["evaluate", run]):
        done = in_a_process(*arguments, **nothing)
        assert done.returncode == 2
        (line,) = done.stderr.splitlines()
        assert line.startswith("quadrl: no C compiler found")
        assert "apt-get install build-essential" in line
    assert not folder.exists()


def test_the_traceback_can_be_had(tmp_path):
    done = in_a_process("evaluate", tmp_path, QUADRL_TRACEBACK="1")
    assert done.returncode == 1 and "Traceback" in done.stderr and "PolicyError" in done.stderr


NO_EGL = """
import ctypes, ctypes.util
load, find = ctypes.CDLL.__init__, ctypes.util.find_library
def no_egl(self, name, *rest, **options):
    if "EGL" in str(name) or "OSMesa" in str(name):
        raise OSError(f"{name}: cannot open shared object file")
    load(self, name, *rest, **options)
ctypes.CDLL.__init__ = no_egl
ctypes.util.find_library = lambda name: None if name in ("EGL", "OSMesa") else find(name)
"""


def test_without_libegl_it_is_as_without_graphics(run, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(NO_EGL)  # as on a machine without the library
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    path = os.pathsep.join((str(tmp_path), str(REPOSITORY)))
    done = in_a_process("evaluate", run, "--episodes", "2", "--json", PYTHONPATH=path)
    assert (done.returncode, done.stderr) == (0, "")
    done = in_a_process("render", run, "--out", tmp_path / "a.mp4", PYTHONPATH=path)
    assert done.returncode == 2 and "apt install libegl1" in done.stderr


OWN = """
import dataclasses

import quadrl
from quadrl.tasks.hover import Hover
from quadrl.vehicle import Vehicle


@quadrl.register
@dataclasses.dataclass(frozen=True)
class NearHover(Hover):
    name = "near_hover"
    radius: float = 0.1


quadrl.VEHICLES["heavy"] = Vehicle(name="heavy", mass=0.8)
"""


def test_a_file_brings_in_tasks_and_aircraft(tmp_path):
    """In its own process: what it registers would stay in this one."""
    (tmp_path / "own.py").write_text(OWN)
    command = [sys.executable, "-m", "quadrl", "evaluate", "--import", "own.py", "--json"]
    command += ["--controller", "geometric", "--task", "near_hover", "--vehicle", "heavy"]
    command += ["--episodes", "2"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent)}
    outcome = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120
    )
    assert outcome.returncode == 0, outcome.stderr
    judged = json.loads(outcome.stdout)
    assert judged["task"] == "near_hover" and judged["success_rate"] == 1.0
    command = [*command[:3], "--import", "own.py", "train", "near_hover", "--no-video"]
    command += ["--num-envs", "8", "--rollout", "4", "--steps", "64", "--episodes", "1"]
    trained = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120
    )
    assert "next: quadrl --import own.py render runs/near_hover-ppo-0 --camera" in trained.stdout


def test_an_import_of_nothing_is_refused(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["--import", "nowhere.py", "tasks"])
    assert stop.value.code == 2
    assert "--import nowhere.py: the path of a Python file" in capsys.readouterr().err


def test_a_flight_needs_one_pilot(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["evaluate"])
    assert stop.value.code == 2
    assert "--controller geometric or lqr with --task" in capsys.readouterr().err
