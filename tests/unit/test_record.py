"""What flew is what a run says: numbers that are newer than a file, and files of one's own."""

import json
import sys
import warnings

import numpy as np
import pytest
from helpers import refused
from runs import TINY, stopped, train

import quadrl
from quadrl.aircraft.parameters import AIRCRAFT, LAYOUT
from quadrl.base.errors import QuadrlWarning
from quadrl.base.files import read_sealed_json, write_sealed_json
from quadrl.core import record
from quadrl.core.catalogue import TASKS
from quadrl.core.environment import Environment
from quadrl.core.record import IMPORTED, import_own
from quadrl.core.saving import TABLES
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.policy_file import FILE, RUN, RUN_FORMAT
from quadrl.learning import checkpoint
from quadrl.learning.config import TrainConfig

SINCE = {"vehicle": "dead_time", "task_options": "smoothness_weight", "weather": "gust_time",
         "randomization": "corners", "observe": "privileged"}  # fmt: skip
"""A number of each record that a file may lack."""
ROW = ("body_lift", "disc_radius")
"""Numbers of an aircraft's row, and of a rotor in it."""


def older(scenario):
    """A scenario in JSON as it was written before these numbers existed."""
    for part, name in SINCE.items():
        del scenario[part][name]
    del scenario["vehicle"]["rotors"][0]["axis"]
    del scenario["vehicle"]["aerodynamics"]["body_lift"]


def older_rows(saved):
    """A saved environment whose rows lack `ROW`."""
    fields = [field for field in json.loads(LAYOUT.tobytes()) if field[0] not in ROW]
    for field in fields:
        if field[0] == "rotor":
            field[1] = [one for one in field[1] if one[0] not in ROW]
    rotor = [(name, kind, *map(tuple, shape)) for name, kind, *shape in fields[-1][1]]
    plain = [(name, kind, *map(tuple, shape)) for name, kind, *shape in fields[:-1]]
    kind = np.dtype([*plain, ("rotor", rotor, AIRCRAFT["rotor"].shape)])
    layout, tables = np.frombuffer(json.dumps(fields).encode(), np.uint8), {}
    for place in TABLES:
        now = np.ascontiguousarray(saved[place]).view(AIRCRAFT)[:, 0]
        table = np.zeros(len(now), kind)
        for name in kind.names[:-1]:
            table[name] = now[name]
        table["size"] = kind.itemsize // 8
        for name in kind["rotor"].base.names:
            table["rotor"][name] = now["rotor"][name]
        tables[place] = table.view(float).reshape(len(table), -1)
        assert tables[place].shape[1] < saved[place].shape[1]
    return saved | tables | {"engine.layout": layout}


def test_a_run_of_before_a_number_existed_goes_on_to_the_same_policy(tmp_path):
    whole = train(TINY, tmp_path / "whole")
    run = stopped(TINY, tmp_path / "run", 3)
    config = read_sealed_json(run / RUN, RUN_FORMAT)
    older(config["scenario"])
    del config["keep"], config["reward_scale"]
    write_sealed_json(run / RUN, config, RUN_FORMAT)
    tensors, numbers = checkpoint.load(run / checkpoint.CHECKPOINT)
    older(numbers["config"]["scenario"])
    del numbers["config"]["keep"], numbers["config"]["reward_scale"]
    flown = {name: value.numpy() for name, value in tensors["environment"].items()}
    tensors["environment"] = older_rows(flown)
    checkpoint.save(run / checkpoint.CHECKPOINT, tensors, numbers)
    policy = Policy.load(run)
    older(policy.metadata)
    policy.save(run / FILE)
    assert quadrl.evaluate(run, episodes=1).scenario == TINY.scenario
    train(TrainConfig.of_folder(run), run, resume=True)
    for one, other in zip(Policy.load(run).weights, Policy.load(whole).weights, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("randomization", ["none", "full"])
def test_rows_that_lack_numbers_fly_on_and_unknown_numbers_are_refused(randomization):
    environment, other = (
        Environment("hover", num_envs=2, seed=seed, randomization=randomization) for seed in (0, 1)
    )
    environment.reset()
    saved = environment.save()
    other.restore(older_rows(saved))
    for _ in range(3):
        environment.step(np.zeros((2, 4))), other.step(np.zeros((2, 4)))
        np.testing.assert_array_equal(environment.engine.qpos, other.engine.qpos)
    strange = json.dumps([["of_tomorrow" if n == "mass" else n, *k]
                          for n, *k in json.loads(LAYOUT.tobytes())])  # fmt: skip
    layout = np.frombuffer(strange.encode(), np.uint8)
    before = other.save()
    with refused("number of an aircraft", "of_tomorrow"):
        other.restore(saved | {"engine.layout": layout})
    with refused(match="cannot be read"):
        other.restore(saved | {"engine.layout": layout[:-5]})
    for name, array in other.save().items():
        np.testing.assert_array_equal(array, before[name])


OWN = """
import dataclasses
import quadrl
from quadrl.tasks.hover import Hover

@quadrl.register
@dataclasses.dataclass(frozen=True)
class Ringed(Hover):
    "A task of a file."

    name = "ringed"
    radius: float = 0.3
    "Size [m]."
"""


def forget():
    """As in a new process, which has imported nothing."""
    TASKS.pop("ringed", None)
    sys.modules.pop("ringed", None)
    IMPORTED.clear()


@pytest.fixture
def ringed(tmp_path, monkeypatch):
    """A run of a task of one's own, and the file of that task."""
    monkeypatch.setenv("QUADRL_CACHE", str(tmp_path / "cache"))
    (file := tmp_path / "ringed.py").write_text(OWN)
    forget()  # what other tests have imported is no file of this run
    import_own(file)
    run = train(TrainConfig("ringed", steps=64, num_envs=4, rollout=8), tmp_path / "run")
    forget()
    yield run, file
    forget()


def test_a_run_imports_the_file_of_its_task_by_itself(ringed):
    run, file = ringed
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert quadrl.evaluate(run, episodes=1).task.name == "ringed"
        forget()
        assert TrainConfig.of_folder(run).scenario.task.radius == 0.3
        assert Policy.load(run).scenario.task.radius == 0.3  # once is enough
    forget()
    file.write_text(OWN.replace("0.3", "0.2"))
    with pytest.warns(QuadrlWarning) as said:
        assert quadrl.evaluate(run, episodes=1).task.radius == 0.3
    told = [str(one.message) for one in said]
    assert [("ringed.py is not what it was" in x, "radius = 0.3; ringed is now 0.2" in x)
            for x in told] == [(True, False), (False, True)]  # fmt: skip


def test_a_run_of_somebody_else_chooses_no_file_to_run(ringed, monkeypatch, tmp_path):
    run, file = ringed
    (key := record.cache_folder() / record.KEY).write_bytes(b"x" * record.KEY_SIZE)
    file.write_text(f"{OWN}\nfrom pathlib import Path; Path({str(tmp_path / 'ran')!r}).touch()")
    for act in (quadrl.evaluate, lambda run: TrainConfig.of_folder(run)):
        with refused(match="ringed"):
            act(run)
    with refused("task", "ringed", match="give --import ringed.py"):
        quadrl.evaluate(run)
    assert not (tmp_path / "ran").exists()
    import_own(file)
    assert [one["path"] for one in record.sealed_imports()] == [str(file)]
    key.chmod(0o644)  # others can read it, so it seals nothing
    assert record.sealed_imports() == []
    with pytest.warns(QuadrlWarning, match="ringed.py is not what it was"):
        assert quadrl.evaluate(run, episodes=1).task.name == "ringed"


def test_no_key_is_made_where_nothing_was_imported(tmp_path, monkeypatch):
    monkeypatch.setenv("QUADRL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(record, "IMPORTED", {})
    assert record.sealed_imports() == []
    record.import_again({"imports": []}, tmp_path)
    assert not [*tmp_path.rglob(record.KEY)]
