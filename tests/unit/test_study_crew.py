"""What becomes of trainings whose processes and machines die, with a crew that only pretends."""

import dataclasses

import pytest

from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import EVALUATION, write_config, write_json
from quadrl.learning.studies import crew
from quadrl.learning.studies.crew import End, train_all
from quadrl.learning.studies.plan import PlannedRun

DIED = End("its machine was lost", lost=True)
NEVER_RAN = dataclasses.replace(DIED, ran=False)
DONE = End()


class Worker:
    """Ends at once, as it is told."""

    def __init__(self, run, end):
        self.run, self.end = run, end

    def poll(self):
        if self.end == DONE:
            self.run.folder.mkdir(exist_ok=True)
            write_config(self.run.folder, self.run.config.resolved())
            write_json(self.run.folder / EVALUATION, {})
        return self.end

    def stop(self):
        pass


class Crew:
    """One at a time; `ends` has what becomes of each training, begin by begin."""

    def __init__(self, **ends):
        self.ends, self.begun = ends, []

    def slots(self):
        return 1

    def begin(self, run, log):
        self.begun.append(run.name)
        ends = self.ends[run.name]
        return Worker(run, ends.pop(0) if len(ends) > 1 else ends[0])


@pytest.fixture
def study(tmp_path, monkeypatch):
    """Trains what a crew is told of; returns what failed, what was begun, and the lines."""
    monkeypatch.setattr(crew, "POLL_SECONDS", 0.0)
    monkeypatch.setattr(crew, "PAUSE_SECONDS", 0.01)

    def trained(**ends):
        runs = [
            PlannedRun(TrainConfig("hover", seed=k), tmp_path / name) for k, name in enumerate(ends)
        ]
        pretended, lines = Crew(**ends), []
        return train_all(runs, pretended, lines.append), pretended.begun, lines

    return trained


def test_only_what_ran_and_died_is_an_attempt(study):
    failed, begun, lines = study(one=[NEVER_RAN, DIED, NEVER_RAN, NEVER_RAN, DIED, DONE])
    assert not failed and len(begun) == 6
    assert "one: begun (attempt 3 of 3), 0 waiting" in lines


def test_after_three_attempts_it_has_failed_whatever_never_ran_in_between(study):
    failed, begun, _ = study(one=[DIED, NEVER_RAN, DIED, NEVER_RAN, DIED, DONE])
    assert len(begun) == 5 and failed["one"].startswith("its machine was lost (see ")


def test_what_never_runs_is_given_up(study):
    failed, begun, lines = study(one=[NEVER_RAN])
    assert len(begun) == crew.BEGINNINGS
    assert failed["one"].startswith("its machine was lost; begun 10 times, it never ran (see ")
    assert not [line for line in lines if "attempt" in line]


def test_while_one_pauses_the_others_are_trained(study, monkeypatch):
    monkeypatch.setattr(crew, "PAUSE_SECONDS", 0.3)
    failed, begun, _ = study(one=[NEVER_RAN, DONE], two=[DONE], three=[DONE])
    assert not failed and begun == ["one", "two", "three", "one"]
