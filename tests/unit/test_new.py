"""Files of one's own that the command writes: they work as they stand, and hide nothing."""

import ast
import sys

import pytest
from helpers import refused

import quadrl
from quadrl import cli, tasks
from quadrl.core.record import import_own
from quadrl.evaluation.policy import Policy

SHORT = ["--steps", "8192", "--num-envs", "64", "--episodes", "2", "--no-video", "--out", "run"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working folder; what its files register is forgotten."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("quadrl.learning.run.Run.draw", lambda *_, **__: ())
    known = [(one, {**one}) for one in (tasks.TASKS, quadrl.VEHICLES)]
    yield tmp_path
    for path in tmp_path.glob("*.py"):
        sys.modules.pop(path.stem, None)
    for registry, before in known:
        registry.clear()
        registry.update(before)


def printed(capsys, *words):
    cli.main([*words])
    return capsys.readouterr().out


def imported(path):
    return {
        (getattr(node, "module", ""), one.name)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for one in node.names
    }


def test_a_new_task_keeps_the_contract_and_trains(here, capsys):
    said = printed(capsys, "new-task", "my_task")
    assert "quadrl train my_task --import my_task.py" in said
    path = here / "my_task.py"
    assert imported(path) == {("", "dataclasses"), ("", "quadrl"), ("quadrl", "tasks")}
    assert len(path.read_text().splitlines()) <= 50
    own = "my_task", "--import", "my_task.py"
    assert printed(capsys, "check", *own).startswith("my_task keeps what every task must keep\n")
    printed(capsys, "train", "my_task", *SHORT)  # as the check has imported it
    assert Policy.load(here / "run").task == "my_task"


BENT = """
    def reward(self, before, now, end):
        turning = (now.state.body_rate**2).sum(-1) ** 0.5  # without a gradient at rest
        return super().reward(before, now, end) | {"turning": -turning}
"""


def test_a_task_that_breaks_the_contract_is_refused_by_the_check(here):
    pytest.importorskip("torch")
    cli.main(["new-task", "my_task"])
    path = here / "my_task.py"
    path.write_text(path.read_text() + BENT)
    import_own(path)
    with refused(match="my_task: 'turning' has no gradient at rest in the goal"):
        cli.parse(["check", "my_task"]).command.run()


def test_a_new_aircraft_is_checked_and_flies(here, capsys):
    said = printed(capsys, "new-aircraft", "mine")
    assert "quadrl train hover --vehicle mine --import mine.py" in said
    assert imported(here / "mine.py") == {("", "quadrl")}
    own = "--vehicle", "mine", "--import", "mine.py"
    rows = printed(capsys, "check", *own).splitlines()[1:]
    assert len(rows) > 20 and all(row.split()[-1] == "ok" for row in rows)
    printed(capsys, "train", "hover", *own, *SHORT)
    assert Policy.load(here / "run").scenario.vehicle == quadrl.VEHICLES["mine"]


@pytest.mark.parametrize(
    ("what", "name"),
    [
        *(("task", name) for name in ("hover", "Hover", "one_of", "2x", "a-b", "class", "none")),
        ("task", "random"),  # a module
        ("aircraft", "paper"),
    ],
)
def test_names_that_are_taken_or_none_are_refused(here, what, name):
    with refused(f"name of the {what}", name):
        cli.parse([f"new-{what}", name]).command.run()
    assert not [*here.iterdir()]


def test_a_file_that_is_there_stays(here):
    (here / "mine.py").write_text("mine")
    with refused(match="mine.py exists already"):
        cli.parse(["new-aircraft", "mine"]).command.run()
    assert (here / "mine.py").read_text() == "mine"
