"""Studies: every training as if it were alone, whatever dies, here and on a Ray cluster."""

import contextlib
import csv
import functools
import hashlib
import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from helpers import refused
from processes import python

import quadrl
from quadrl import cli
from quadrl.core.record import import_own
from quadrl.core.scenario import Scenario
from quadrl.learning import executor
from quadrl.learning.cluster import carry_out_here
from quadrl.learning.executor import Process
from quadrl.learning.folder import lock_folder
from quadrl.learning.plan import read_plan
from quadrl.learning.run import train

SETTINGS = {
    "num_envs": 8,
    "rollout": 4,
    "hidden": [16],
    "critic_hidden": [16],
    "task_options": {"time_limit": 0.5},
    "checkpoint_seconds": 0.1,
    "ppo": {"epochs": 2, "minibatch": 16},
}
SHORT = SETTINGS | {"steps": 8 * 4 * 6}
LONG = SETTINGS | {"steps": 8 * 4 * 300}
"""So many iterations that a kill comes in the middle."""
STUDY = {"tasks": ["hover"], "seeds": "0:2", "episodes": 2, "settings": LONG}
OWN = """
import dataclasses
import quadrl
from quadrl.tasks.hover import Hover

@dataclasses.dataclass(frozen=True)
class Near(Hover):
    name = "near"

quadrl.tasks.TASKS.pop("near", None)
quadrl.register(Near)
"""
PATIENCE = 240.0  # [s] for what takes a few seconds on an idle machine


def digest(folder: Path) -> str:
    return hashlib.sha256((folder / "policy.safetensors").read_bytes()).hexdigest()


def wait_for(happened, what):
    until = time.monotonic() + PATIENCE
    while not (found := happened()):
        assert time.monotonic() < until, what
        time.sleep(0.02)
    return found


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Digests of the study's policies, each trained in this process by `quadrl.train`."""
    found = []
    for seed in (0, 1):
        folder = tmp_path_factory.mktemp("alone") / "run"
        train(
            "hover",
            seed=seed,
            num_threads=1,
            out=folder,
            episodes=2,
            **(LONG | {"checkpoint_seconds": 60}),
        )
        found.append(digest(folder))
    assert found[0] != found[1]
    return found


@contextlib.contextmanager
def once_begun(folder, act, awaited="checkpoint.safetensors"):
    """Acts in a thread as soon as the folder holds a checkpoint of a training that goes on."""
    errors = []

    def work():
        try:
            wait_for((folder / awaited).exists, f"{awaited} in {folder}")
            assert not (folder / "evaluation.json").exists()
            act()
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    yield
    thread.join()
    assert not errors, errors


@pytest.fixture
def begun(monkeypatch):
    """The processes that trainings are carried out in, as they are begun."""
    processes = []

    class Noted(Process):
        def __init__(self, what, log):
            folder = Path(what["folder"])
            self.held = (folder / "checkpoint.safetensors").exists()
            super().__init__(what, log)
            processes.append(self)

    monkeypatch.setattr(executor, "Process", Noted)
    return processes


def test_a_killed_worker_goes_on_and_ends_as_if_alone(alone, tmp_path, begun):
    lines = []
    with once_begun(tmp_path / "hover-ppo-0", lambda: begun[0]._process.kill()):
        found = quadrl.study(STUDY, out=tmp_path, jobs=1, on_line=lines.append)
    assert len(begun) == 3 and any("attempt 2 of 3" in line for line in lines)
    assert [digest(tmp_path / f"hover-ppo-{seed}") for seed in (0, 1)] == alone
    assert not found.failed and found.rows[0]["seeds"] == 2
    assert (tmp_path / "learning_curves_hover.png").exists()
    row = next(csv.DictReader((tmp_path / "table.csv").read_text().splitlines()))
    errors = [run["metrics"]["position_error_m"] for run in found.runs]
    assert float(row["position_error_m"]) == pytest.approx(sum(errors) / 2)
    assert float(row["position_error_m_low"]) <= min(errors)  # t is 12.7 for two seeds
    study = json.loads((tmp_path / "study.json").read_text())
    assert study["rows"][0]["task"] == "hover"
    flown = [run.config.scenario for run in read_plan(STUDY, tmp_path).runs]
    assert [Scenario.of(run["scenario"]) for run in study["runs"]] == flown
    lines.clear()
    again = quadrl.study(STUDY, out=tmp_path, on_line=lines.append)
    assert len(begun) == 3 and lines == ["2 of 2 trainings are done already"]
    assert again.rows == found.rows


def test_a_terminated_worker_loses_no_iteration(alone, tmp_path, begun):
    """It has a checkpoint before it ends, which is the only one, and goes on from that."""
    folder = tmp_path / "hover-ppo-0"
    lines, settings = [], LONG | {"checkpoint_seconds": 60}
    study = STUDY | {"seeds": [0], "settings": settings}
    with once_begun(folder, lambda: begun[0]._process.terminate(), "metrics.csv"):
        found = quadrl.study(study, out=tmp_path, jobs=1, on_line=lines.append)
    assert [one.held for one in begun] == [False, True]
    assert any("killed by signal 15" in line for line in lines)
    assert not found.failed and digest(folder) == alone[0]


def test_ctrl_c_leaves_a_study_that_the_same_command_ends(alone, tmp_path):
    file = tmp_path / "two.json"
    file.write_text(json.dumps(STUDY))
    command = [sys.executable, "-m", "quadrl", "study", str(file), "--jobs", "1"]
    given = {"cwd": tmp_path, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    # A shell that runs the tests in the background lets all that they start ignore Ctrl-C.
    given["preexec_fn"] = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    first = subprocess.Popen(command, **given)
    with once_begun(tmp_path / "runs/two/hover-ppo-0", lambda: first.send_signal(signal.SIGINT)):
        said, _ = first.communicate(timeout=PATIENCE)
    assert first.returncode == 130 and "the same command goes on" in said
    cli.main(["study", str(file), "--jobs", "1", "--out", str(tmp_path / "runs/two")])
    assert [digest(tmp_path / f"runs/two/hover-ppo-{seed}") for seed in (0, 1)] == alone


def test_a_failed_training_is_told_at_the_end_and_stops_no_other(tmp_path, monkeypatch):
    order = executor.order

    def broken(run, *rest):
        what = order(run, *rest)
        if run.config.seed == 0:
            what["versions"] = what["versions"] | {"torch": "0.1"}
        return what

    monkeypatch.setattr(executor, "order", broken)
    found = quadrl.study(STUDY | {"settings": SHORT}, out=tmp_path, jobs=2, on_line=str)
    assert list(found.failed) == ["hover-ppo-0"] and "0.1, as where" in found.failed["hover-ppo-0"]
    assert found.rows[0]["seeds"] == 1 and found.rows[0]["success_rate_low"] is None


def test_a_training_waits_until_a_lost_one_has_left_its_folder(tmp_path):
    (run,) = read_plan(STUDY | {"seeds": [0], "settings": SHORT}, tmp_path).runs
    run.folder.mkdir()
    unlock = lock_folder(run.folder)
    process = Process(executor.order(run), tmp_path / "log.txt")
    try:
        time.sleep(15)  # in which it would have ended, well or with an error
        assert process.poll() is None
    finally:
        unlock()
    assert process.wait() == executor.End() and run.done


@pytest.fixture
def cluster(monkeypatch):
    """Two nodes with a CPU each beside a head with none, all on this machine."""
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_worker_register_timeout_seconds", str(int(PATIENCE)))
    small = {"object_store_memory": 80 << 20, "include_dashboard": False}
    head = {"num_cpus": 0, **small}
    made = patiently(lambda: Cluster(initialize_head=True, head_node_args=head))
    try:
        yield made, [patiently(lambda: made.add_node(num_cpus=1, **small)) for _ in range(2)]
    finally:
        ray.shutdown()
        made.shutdown()


def patiently(start):
    """What a start returns: Ray gives a node 30 s, which a machine with much to do may not have."""
    for _ in range(4):
        try:
            return start()
        except Exception as error:
            if "timed out" not in str(error):
                raise
    return start()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("graceful", [True, False], ids=["told to go", "killed"])
def test_a_node_that_dies_changes_no_policy_and_costs_no_attempt(
    alone, tmp_path, cluster, graceful
):
    """Of one that is killed the cluster knows late: it sends trainings there for a while."""
    made, nodes = cluster
    lines = []
    with once_begun(
        tmp_path / "hover-ppo-0", lambda: made.remove_node(nodes[0], allow_graceful=graceful)
    ):
        found = quadrl.study(STUDY, out=tmp_path, ray=made.address, on_line=lines.append)
    assert not any("attempt" in line for line in lines), lines
    assert [digest(tmp_path / f"hover-ppo-{seed}") for seed in (0, 1)] == alone
    assert not found.failed and (tmp_path / "hover-ppo-1" / "learning_curve.png").exists()


def test_a_folder_that_the_machines_do_not_share_is_named(tmp_path):
    (run, _) = read_plan(STUDY, tmp_path / "elsewhere").runs
    own = Path("own.py").absolute()
    for missing in (run.folder, own):
        end = carry_out_here(executor.order(run, [own]), tmp_path / "log.txt")
        assert str(missing) in end.message and "--out" in end.message and not end.lost
        run.folder.mkdir(parents=True, exist_ok=True)


@pytest.mark.filterwarnings("ignore")
def test_ray_on_this_machine_with_a_task_of_ones_own(tmp_path, monkeypatch):
    pytest.importorskip("ray")
    own = tmp_path / "own_task.py"
    own.write_text(OWN)
    monkeypatch.setitem(quadrl.tasks.TASKS, "near", None)
    import_own(own)
    content = STUDY | {"tasks": ["near"], "settings": SHORT}
    folders = [tmp_path / "here", tmp_path / "ray"]
    for folder, ray in zip(folders, (None, "local"), strict=True):
        quadrl.study(content, out=folder, ray=ray, jobs=1, own=(own,), on_line=str)
    for name in ("near-ppo-0", "near-ppo-1"):
        assert digest(folders[0] / name) == digest(folders[1] / name)


def test_a_cluster_that_is_not_there(tmp_path):
    pytest.importorskip("ray")
    for address, said in (("127.0.0.1:1", "there is no Ray cluster at"), ("there", "HOST:PORT")):
        with refused(match=said):
            quadrl.study(STUDY, out=tmp_path, ray=address)
    assert not list(tmp_path.iterdir())


def test_without_ray(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with refused(match=r"pip install 'quadrl\[ray\]'"):
        quadrl.study(STUDY, out=tmp_path, ray="local")


@pytest.mark.filterwarnings("ignore")
def test_the_example_with_collectors_on_two_nodes_repeats_itself(tmp_path, cluster):
    made, _ = cluster
    script = Path(quadrl.__file__).parents[1] / "docs" / "examples" / "ray_collector.py"
    options = ["--num-envs", "8", "--steps", "1024", "--episodes", "2", "--address", made.address]
    runs = []
    for seed in (0, 0, 1):
        said = python(script, *options, "--seed", seed)
        runs.append(json.loads(said.stdout.splitlines()[-1]) | {"seconds": 0})
    assert runs[0] == runs[1] and runs[0]["steps"] == 1024
    assert runs[0]["sum_of_weights"] != runs[2]["sum_of_weights"]
