"""The folder for a model hub: what its card says is what was flown, seen and drawn."""

import functools
import json

import pytest

import quadrl
from quadrl.deploy import hub
from quadrl.deploy.crosscheck import Crosscheck, Row
from quadrl.evaluation.evaluate import evaluate
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.robustness import robustness

NAME = "hover_robust"


ELSEWHERE = Crosscheck({}, [Row("rotorpy 3", "matched", 0.02, 3, 0.67, 0.012, 0.33)], [])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hub, "EPISODES", 3)
        patch.setattr(hub, "robustness", functools.partial(robustness, disturbances=["delay"]))
        patch.setattr(hub, "there", lambda name: name == "rotorpy")
        patch.setattr(hub, "crosscheck", lambda policy, simulators: ELSEWHERE)
        return quadrl.export(NAME, "hub", tmp_path_factory.mktemp("hub") / "card")


@pytest.mark.slow
def test_the_policy_in_it_is_the_same(folder):
    own, there = Policy.pretrained(NAME), Policy.load(folder / "policy.safetensors")
    assert there.metadata == own.metadata and (there.weights[0] == own.weights[0]).all()


def test_hubs_read_what_it_reached(folder):
    _, front, _ = (folder / "README.md").read_text().split("---\n", 2)
    header = dict(line.split(": ", 1) for line in front.splitlines())
    (model,) = json.loads(header["model-index"])
    assert json.loads(header["library_name"]) == "quadrl" and "hover" in json.loads(header["tags"])
    rows = {one["task"]["name"]: one["metrics"] for one in model["results"]}
    assert list(rows) == list(hub.FLOWN)
    for words, metrics in rows.items():
        got = evaluate(NAME, episodes=3, **hub.FLOWN[words][0]).metrics
        assert {one["type"]: one["value"] for one in metrics}.items() <= got.items()


def test_its_text_says_what_was_drawn_and_what_was_not(folder):
    text, own = (folder / "README.md").read_text(), Policy.pretrained(NAME).scenario
    drawn = own.randomization.given()
    assert drawn and all(f"\n| {name} | " in text for name in drawn)
    same = text.partition("where it differs: ")[2].partition(".\n")[0].split(", ")
    assert same and not {*same} & {*drawn} and "inertia_axes" in same
    assert "Commands" not in same and f"| {own.weather.wind_speed:g}" in text


def test_its_text_says_what_it_withstands_and_what_it_reached_elsewhere(folder):
    text = (folder / "README.md").read_text()
    card = robustness(NAME, episodes=3, disturbances=["delay"], recovery=False, progress=False)
    rows = card.table[1:]
    assert "delay" in rows[0][0] and all(f"| {' | '.join(row)} |" in text for row in rows)
    assert "| rotorpy 3 | matched | 20 ms | 67 % | 1.2 cm | 33 % |" in text


def test_it_says_why_a_policy_was_not_flown_elsewhere(monkeypatch):
    monkeypatch.setattr(hub, "there", lambda name: False)
    assert "not installed; `quadrl crosscheck" in hub._elsewhere(Policy.pretrained(NAME))
    monkeypatch.setattr(hub, "there", lambda name: True)
    assert "one without ground and solids" in hub._elsewhere(Policy.pretrained("landing"))


def test_a_policy_without_disturbances_in_its_training_is_flown_in_fewer_rows(monkeypatch):
    monkeypatch.setattr(hub, "evaluate", lambda *_, **how: type("", (), {"metrics": how}))
    assert [words for words, _ in hub._results(Policy.pretrained("hover"))] == [*hub.FLOWN][1:]
