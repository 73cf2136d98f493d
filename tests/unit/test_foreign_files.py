"""Files that others wrote: what they hold reaches neither other files nor the terminal."""

import json

import pytest
from helpers import refused

import quadrl
from quadrl.base import files
from quadrl.core.environment import Environment
from quadrl.evaluation.card import Card
from quadrl.rendering.scenarios import read_scenarios

ESCAPE = "hover\x1b[2Jand more"
RIGHT_TO_LEFT = "hover\u202eppo"


@pytest.mark.parametrize("text", [ESCAPE, RIGHT_TO_LEFT, "a\rb", "\x07"])
@pytest.mark.parametrize("where", ["value", "key", "nested"])
def test_a_file_with_a_text_that_a_terminal_would_obey_is_refused(text, where, tmp_path):
    content = {"value": {"of": text}, "key": {text: 1}, "nested": {"of": [1, {"a": [text]}]}}[where]
    policy = quadrl.Policy.pretrained("hover")
    metadata = policy.metadata | content
    path = tmp_path / "policy.safetensors"
    quadrl.Policy(policy.weights, policy.biases, policy.mean, policy.deviation, "hover",
                  metadata).save(path)  # fmt: skip
    files.write_sealed_json(tmp_path / "sealed.json", content, "form")
    (tmp_path / "study.json").write_text(json.dumps(content))
    for read in (
        lambda: quadrl.Policy.load(path),
        lambda: files.read_sealed_json(tmp_path / "sealed.json", "form"),
        lambda: files.read_table(tmp_path / "study.json", "study"),
        lambda: Card.load(tmp_path / "study.json"),
    ):
        with refused(match="control characters") as error:
            read()
        assert str(error.value).isprintable()


def test_line_breaks_and_other_alphabets_are_texts():
    files.check_texts({"Höhe": ["飛行\n\tzwei Zeilen"]})


@pytest.mark.parametrize(("kind", "deep"), [("json", "[" * 100_000), ("toml", "a=" + "[" * 20_000)])
def test_a_table_nested_too_deeply_is_refused_in_a_line(kind, deep, tmp_path):
    path = tmp_path / f"deep.{kind}"
    path.write_text(deep)
    with refused(match=f"is not {kind.upper()}"):
        files.read_table(path, "study")
    if kind == "json":
        with refused(match="holds no robustness card"):
            Card.load(path)


@pytest.mark.parametrize("name", ["../out", "/tmp/out", "a b", "a\x1b[2J", "", ".", "a/b", 5])
def test_the_name_of_an_aircraft_is_no_path(name):
    with refused("name", name):
        quadrl.Vehicle(name=name)
    assert quadrl.Vehicle(name="5-inch_racer").name == "5-inch_racer"


def test_a_link_under_the_name_of_an_unfinished_file_is_not_followed(tmp_path, monkeypatch):
    names = []
    monkeypatch.setattr(files.secrets, "token_hex", lambda n: names.append(n) or "known")
    (victim := tmp_path / "victim").write_text("precious")
    (tmp_path / "a.json.known.part").symlink_to(victim)
    with pytest.raises(FileExistsError):
        files.write_json(tmp_path / "a.json", {})
    assert victim.read_text() == "precious"
    assert names == [8]  # as many random bytes: nobody guesses them


def test_a_file_that_is_written_whole_has_the_usual_permissions(tmp_path):
    (usual := tmp_path / "usual").write_text("")
    files.write_json(tmp_path / "a.json", {})
    assert (tmp_path / "a.json").stat().st_mode == usual.stat().st_mode


def test_a_track_of_thousands_of_gates_is_refused_at_once():
    with refused("number of gates"):
        Environment("race", gates=[[4.0 * k, 0.0, 2.0, 0.0, 0.0] for k in range(3000)])


def test_a_picture_whose_comment_is_nested_too_deeply_is_refused(tmp_path):
    from PIL import Image

    path = tmp_path / "a.gif"
    Image.new("L", (8, 8)).save(path, comment=b"[" * 100_000)
    with refused(match="carries no scenario"):
        read_scenarios(path)
