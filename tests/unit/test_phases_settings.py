"""Settings of trainings in turn."""

import json
import shlex

import pytest
from helpers import refused

from quadrl import cli
from quadrl.learning.config import TrainConfig
from quadrl.learning.defaults import written
from quadrl.tasks import TASKS

FIRST = {"algo": "apg"}


def test_another_algorithm_has_its_own_defaults_and_the_same_network_and_conditions():
    config = TrainConfig("recovery", seed=3, hidden=(32,), aerodynamics="full", episodes=7)
    (first,) = config.earlier
    own = TrainConfig("recovery", algo="apg")
    assert first.steps == own.steps and first.training_options == own.training_options
    assert first.conditions == config.conditions and first.hidden == (32,)
    assert (first.seed, first.episodes, first.phases) == (3, 7, ())


def test_the_same_algorithm_has_the_settings_of_this_one_but_what_it_says():
    given = ({"algo": "ppo", "steps": 8_192, "ppo": {"clip": 0.1}, "weather": "light"},)
    config = TrainConfig("hover", phases=given, gamma=0.9, ppo={"epochs": 2}, until={"success": 1})
    (first,) = config.earlier
    assert (first.steps, first.gamma, first.ppo.epochs, first.ppo.clip) == (8_192, 0.9, 2, 0.1)
    assert first.conditions["weather"] == "light" and config.conditions["weather"] != "light"
    assert first.until == {} and config.until == {"success": 1}


@pytest.mark.parametrize("task", ["recovery", "lsy_race"])
def test_tasks_for_which_one_training_is_not_enough_have_two(task):
    config = TrainConfig(task, algo="ppo")
    first, networks = config.earlier[0], ("hidden", "critic_hidden", "memory", "holds_goal")
    assert [getattr(first, x) for x in networks] == [getattr(config, x) for x in networks]
    stated = TASKS[task].training_with["ppo"]["phases"][0].get("training_options", {})
    assert stated.items() <= first.training_options.items()
    assert TrainConfig(task, algo="ppo", phases=()).phases == ()


def test_a_variant_names_its_algorithm_and_counts_for_its_own_aircraft():
    late, other = (
        TrainConfig("recovery", variant="robust", vehicle=v) for v in ("crazyflie", None)
    )
    assert late == other and [first.algo for first in late.earlier] == ["ppo"]
    drawn = late.conditions["randomization"]
    assert drawn["command_delay"] == (0.0, 0.03)  # and not the Crazyflie's in other tasks
    assert (
        "torque" not in drawn
        and "torque"
        in TrainConfig("hover", variant="robust", vehicle="crazyflie").conditions["randomization"]
    )
    assert TrainConfig("race").algo == "apg" and TrainConfig("race", variant="robust").algo == "ppo"
    assert TrainConfig("race", variant="robust", algo="trpo").algo == "trpo"


def test_the_networks_of_another_run_take_their_place(tmp_path):
    from quadrl.learning.folder import CHECKPOINT, write_config

    first = TrainConfig("recovery", algo="apg")
    write_config(tmp_path, first.resolved())
    (tmp_path / CHECKPOINT).write_bytes(b"")
    config = TrainConfig("recovery", algo="ppo", from_run=tmp_path)
    assert config.phases == ()
    assert "phases" not in repr(config)


def test_they_are_saved_and_what_was_saved_without_them_has_none():
    config = TrainConfig("recovery", algo="ppo")
    saved = config.resolved()
    assert TrainConfig.of_saved(saved).phases == config.phases == (FIRST,)
    del saved["phases"]
    assert TrainConfig.of_saved(saved).phases == ()


def test_the_command_takes_them_as_json():
    (words,) = written({"phases": (FIRST, {"algo": "ppo", "steps": 8_192})})
    config, _ = cli.parse(["train", "hover", *shlex.split(words)]).command.prepared()
    assert config.phases == (FIRST, {"algo": "ppo", "steps": 8_192})
    config, _ = cli.parse(["train", "recovery", "--phases", "[]"]).command.prepared()
    assert config.phases == ()
    with refused("phases", "[{", match="JSON"):
        cli.parse(["train", "hover", "--phases", "[{"]).command.prepared()


def test_what_cannot_be_a_phase_is_refused():
    with refused("phase 1", {"steps": 10}, match="algorithm"):
        TrainConfig("hover", phases=[{"steps": 10}])
    with refused("phase 2", "apg", match="algorithm"):
        TrainConfig("hover", phases=[FIRST, "apg"])
    for name, value in (("hidden", (8,)), ("seed", 1), ("vehicle", "hexa"), ("task", "landing")):
        with refused(f"{name} of phase 1", value, match="share"):
            TrainConfig("hover", phases=[FIRST | {name: value}])
    for given, words in (
        ({"algo": "sac"}, "algo"),
        ({"algo": "ppo", "ppo": {"clip": -1}}, "clip"),
        ({"algo": "apg", "engine": "mujoco"}, "engine"),
        ({"algo": "ppo", "speed": 1}, "speed"),
    ):
        with refused(match=words) as caught:
            TrainConfig("hover", phases=[given])
        assert str(caught.value).startswith("phases: ")
    with refused("phases", 3):
        TrainConfig("hover", phases=json.loads("3"))
