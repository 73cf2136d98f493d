"""The settings of a training: where defaults come from, what is refused, what is saved."""

import dataclasses
import json
import math
import warnings

import numpy as np
import pytest
import torch
from helpers import refused
from policies import linear
from runs import TINY

import quadrl
from quadrl import tasks
from quadrl.base.records import as_json
from quadrl.cli import COMMANDS
from quadrl.evaluation import evaluate as evaluation
from quadrl.learning import foreign
from quadrl.learning.config import TrainConfig, prepare
from quadrl.learning.environments import make_env
from quadrl.learning.folder import read_config, write_config
from quadrl.learning.settings import ALGORITHM_CONFIGS, APGConfig, PPOConfig, VPGConfig
from quadrl.learning.variants import OF_VEHICLE, VARIANTS
from quadrl.tasks.hover import Hover
from quadrl.tasks.random_waypoint import RandomWaypoint


@dataclasses.dataclass(frozen=True)
class Tuned(Hover):
    """A task with training defaults of its own."""

    name = "tuned"
    training = {"gamma": 0.5, "num_envs": 32, "hidden": (8, 8), "vpg": {"critic_rate": 0.25}}


@pytest.fixture
def tuned(monkeypatch):
    monkeypatch.setitem(tasks.TASKS, "tuned", Tuned)


def test_a_default_comes_from_the_last_layer_that_has_one(tuned):
    config = TrainConfig("tuned")
    assert (config.gamma, config.num_envs, config.hidden) == (0.5, 32, (8, 8))
    assert (config.rollout, config.steps) == (TrainConfig.rollout, TrainConfig.steps)
    assert config.vpg == VPGConfig() and config.ppo == PPOConfig()  # PPO trains
    given = TrainConfig("tuned", algo="vpg", gamma=0.7, vpg={"critic_epochs": 3}, hidden=None)
    assert (given.gamma, given.hidden) == (0.7, (8, 8))
    own = Tuned.training_with["vpg"]["vpg"]  # which come after those that all algorithms share
    assert given.vpg == VPGConfig(**own, critic_epochs=3)
    # An algorithm changes fields: one step of the policy per batch wants smaller ones.
    usual, plain = (TrainConfig("static_waypoint", algo=algo) for algo in ("ppo", "vpg"))
    assert (plain.num_envs, plain.rollout) == (128, 8)
    assert (usual.num_envs, usual.rollout) == (256, 16)
    assert TrainConfig("tuned", algo="vpg").num_envs == 32  # the task's layer is over that
    assert TrainConfig(algo="gae") == TrainConfig(algo="vpg")


def test_every_setting_has_a_source():
    config = TrainConfig("hover", variant="robust", vehicle="racer", steps=4096, memory="gru")
    found = {name: (value, source) for name, value, source in config.sources()}
    for name, value, source in (
        ("num_envs", 256, "field"),
        ("seed", 0, "field"),
        ("ppo.epochs", 5, "field"),
        ("rollout", 40, "field, at its control rate"),  # 2.5 times 16, as the racer's rate
        ("training_options.tilt", 0.2, "variant robust"),
        ("gamma", 0.9797, "variant robust, at its control rate"),  # 0.95^(1 / 2.5)
        ("variant", "robust", "given"),
        ("steps", 4096, "given"),
        ("memory", "gru", "given"),
    ):
        assert found[name] == (value, source)
    assert not any(name.startswith(("trpo.", "vpg.", "apg.")) for name in found)
    own = {name: source for name, _, source in TrainConfig("hover").sources()}
    assert own["gae_lambda"] == own["ppo.beta2"] == "hover x ppo" and own["ppo.clip"] == "field"


def test_a_training_has_at_least_the_steps_that_are_asked_for():
    # Batches of 32 steps: 64 and 65 take two and three of them, and one step a whole one.
    batches = {64: 2, 65: 3, 1: 1}
    for steps, iterations in batches.items():
        assert TrainConfig("hover", num_envs=8, rollout=4, steps=steps).iterations == iterations
    assert TrainConfig(seed=2**32 - 1).seed == 2**32 - 1


@pytest.mark.parametrize(
    ("change", "name", "value"),
    [
        ({"gamma": 2.0}, "gamma", 2.0),
        ({"seed": 2**32}, "seed", 2**32),
        ({"num_envs": 0}, "num_envs", 0),
        ({"num_envs": 1, "rollout": 1}, "num_envs * rollout", 1),
        ({"steps": -5}, "steps", -5),
        ({"hidden": (16, 0)}, "width of a hidden layer", 0),
        ({"hidden": 16}, "hidden", 16),
        ({"initial_deviation": 0.0}, "initial_deviation", 0.0),
        ({"algo": "sac"}, "algo", "sac"),
        ({"memory": "lstm"}, "memory", "lstm"),
        ({"memory": "gru", "memory_width": 0}, "memory_width", 0),
        ({"memory": "gru", "holds_goal": True}, "holds_goal", True),
        ({"holds_goal": 1}, "holds_goal", 1),
        ({"ppo": {"minibatch": -1}}, "ppo.minibatch", -1),
        ({"ppo": {"learning_rate": math.inf}}, "ppo.learning_rate", math.inf),
        ({"ppo": {"entropy": -0.1}}, "ppo.entropy", -0.1),
        ({"trpo": {"iterations": 0.5}}, "trpo.iterations", 0.5),
        ({"randomization": {"command_delay": 0.003}}, "command_delay", (0.003, 0.003)),
        ({"weather": "foul"}, "weather", "foul"),
        ({"variant": "sturdy"}, "variant", "sturdy"),
        ({"vehicle_options": {"mass": -1.0}}, "mass", -1.0),
        ({"task": "hovver"}, "task", "hovver"),
        ({"gama": 0.9}, "setting", "gama"),
        ({"ppo": {"clp": 0.2}}, "setting of ppo", "clp"),
        ({"ppo": 3}, "ppo", 3),
        ({"task_options": {"horizn": 5}}, "hover option", "horizn"),
        ({"task_options": "time_limit=5"}, "task_options", "time_limit=5"),
        ({"training_options": {"time_limit": -1}}, "hover time_limit", -1),
        ({"training_options": 3}, "training_options", 3),
    ],
)
def test_settings_that_cannot_be_trained_are_refused(change, name, value):
    with refused(name, value):
        TrainConfig(**change)


IDLE = [  # a setting of an algorithm that does not train: what names it, and what is meant
    ("hover", {"apg": {"learning_rate": 0.1}}, "apg.learning_rate", "ppo.learning_rate"),
    ("hover", {"apg": APGConfig(learning_rate=0.1)}, "apg.learning_rate", "ppo.learning_rate"),
    ("hover", {"algo": "trpo", "ppo": {"epochs": 3}}, "ppo.epochs", "trpo.critic_epochs"),
    ("hover", {"algo": "gae", "ppo": {"lr": 3}}, "ppo.lr", "vpg.learning_rate"),
    ("hover", {"apg": {"step": 0.1}}, "apg.step", None),
    ("race", {"ppo": {"minibatch": 64}}, "ppo.minibatch", "apg.minibatch"),  # its own is apg
]


@pytest.mark.parametrize(("task", "given", "name", "meant"), IDLE)
def test_a_setting_of_another_algorithm_is_refused(tmp_path, task, given, name, meant):
    with refused(name) as caught:
        quadrl.train(task, out=tmp_path / "run", **given)
    said = str(caught.value)
    assert said.endswith(f"; did you mean {meant}?" if meant else "left out with algo ppo")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("algo", ["ppo", "trpo", "vpg"])
def test_a_changed_copy_keeps_what_was_usual(algo):
    for task in ("hover", "race"):  # both have settings of their own for PPO
        config = TrainConfig(task, algo=algo)
        for other in ("ppo", "trpo", "vpg"):
            changed = dataclasses.replace(config, algo=other, seed=3)
            assert changed.algo == other and changed.seed == 3
        assert dataclasses.replace(config, ppo=PPOConfig(), memory="gru", holds_goal=False)
    assert dataclasses.replace(TrainConfig(algo="vpg"), task="race").task == "race"


FOREIGN = [  # what other programs call a setting, and what the answer says
    ({"learning_rate": 1e-3}, 'ppo.learning_rate, given as ppo={"learning_rate": ...}'),
    ({"ppo": {"lr": 1e-3}}, 'ppo.learning_rate, given as ppo={"learning_rate": ...}'),
    ({"lr": 1e-3, "algo": "vpg"}, "did you mean vpg.learning_rate"),
    ({"task": "race", "lr": 1e-3}, "did you mean apg.learning_rate"),
    ({"lr": 1e-3, "algo": "trpo"}, "did you mean trpo.max_kl"),
    ({"batch_size": 64}, "did you mean ppo.minibatch"),
    ({"total_timesteps": 1}, r"did you mean steps\?"),
    ({"n_steps": 1}, r"did you mean rollout\?"),
    ({"wandb": True}, "did you mean log?"),
    ({"algo": "PPO"}, r"did you mean ppo\?"),
    ({"algo": "sac"}, "Stable-Baselines3 has it"),
    ({"task": "quadrl/RandomWaypoint-v0"}, r"did you mean random_waypoint\?"),
    ({"task": "quadrl/Race-v0"}, r"did you mean race\?"),
]


@pytest.mark.parametrize(("given", "said"), FOREIGN)
def test_foreign_names_lead_to_ours(given, said):
    with refused(match=said):
        TrainConfig(**given)


def test_what_foreign_names_lead_to_is_there():
    own = {field.name for one in ALGORITHM_CONFIGS.values() for field in dataclasses.fields(one)}
    ours = own | {field.name for field in dataclasses.fields(TrainConfig)} | {"out", "config"}
    assert {name for names in foreign.SETTINGS for name in names.split()} <= ours
    theirs = [*foreign.SETTINGS.values(), *foreign.OTHERWISE.values()]
    assert len(names := " ".join(theirs).split()) == len(set(names))
    for word, answer in (foreign.COMMANDS | foreign.ALGORITHMS).items():
        assert " " in answer or answer in (*COMMANDS, *ALGORITHM_CONFIGS), word


def test_an_unknown_training_default_of_a_task_is_refused(tuned, monkeypatch):
    monkeypatch.setattr(Tuned, "training", {"gama": 0.9})
    with refused(value="gama"):
        TrainConfig("tuned")


def test_the_settings_of_a_run_are_found_again(tmp_path):
    config = TINY.resolved()
    write_config(tmp_path, config)
    assert TrainConfig.of_folder(tmp_path) == TINY
    saved = read_config(tmp_path)
    assert saved["scenario"]["task_options"]["time_limit"] == 0.5
    assert saved["training_options"]["radius"] == 0.75  # as it is practised
    assert saved["scenario"]["vehicle"]["mass"] == 0.65
    assert len(saved["scenario"]["vehicle"]["rotors"]) == 4
    assert set(saved["versions"]) == {"quadrl", "mujoco", "torch", "torchrl", "numpy"}


def test_a_run_in_wind_says_what_the_air_does(tmp_path):
    windy = TrainConfig("hover", weather="light")
    brought = [config.conditions["aerodynamics"] for config in (windy, TINY)]
    assert brought == ["full", ""]
    assert ("aerodynamics", "full", "in wind") in windy.sources()
    write_config(tmp_path, windy.resolved())
    assert TrainConfig.of_folder(tmp_path) == windy


def test_a_setting_that_an_older_run_lacks_has_its_default(tmp_path):
    older = TINY.resolved()
    del older["keep"], older["ppo"]["critic"]
    write_config(tmp_path, older)
    assert TrainConfig.of_folder(tmp_path) == TINY


@pytest.mark.parametrize("text", [None, "", "{", "[]", "{}", '{"task": "hover"}'])
def test_damaged_settings_are_refused(tmp_path, text):
    if text is not None:
        (tmp_path / "config.json").write_text(text)
    with refused(match=str(tmp_path)):
        TrainConfig.of_folder(tmp_path)


@pytest.mark.parametrize(
    ("part", "name"), [("task_options", "speed_weight"), ("vehicle", "mass"), ("vehicle", "name")]
)
def test_a_run_keeps_its_numbers_where_its_task_or_aircraft_has_changed(tmp_path, part, name):
    config = TINY.resolved()
    was = config["scenario"][part][name] = "once" if name == "name" else 0.7
    config["vehicle"] = config["scenario"]["vehicle"]["name"]
    write_config(tmp_path, config)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        read = TrainConfig.of_folder(tmp_path)
        again, folder = prepare(None, None, tmp_path, {"steps": 2 * TINY.steps})
    assert [f"{name} = {was}" in str(one.message) for one in said] == [True, True] * (
        name != "name"
    )
    for flown in (read.scenario, read.training_scenario):
        assert as_json(flown.task if part == "task_options" else flown.vehicle)[name] == was
    assert again.resolved()["scenario"] == config["scenario"] and folder == tmp_path


def test_a_task_may_be_trained_with_other_options_than_it_is_flown_with():
    config = TrainConfig("random_waypoint", task_options={"time_limit": 5}, num_envs=512, rollout=1)
    asked, trained = config.scenario.task, config.training_scenario.task
    assert asked.time_limit == trained.time_limit == 5
    assert trained.farthest > asked.farthest == RandomWaypoint().farthest
    env = make_env(config, torch.device("cpu"))
    env.reset()
    way = np.linalg.norm(env.environment.goals() - env.environment.origin, axis=1)
    assert asked.farthest < way.max() <= trained.farthest
    assert config.resolved()["scenario"]["task_options"]["farthest"] == asked.farthest
    asked = TrainConfig("random_waypoint", task_options={"farthest": 4})  # holds in both
    assert asked.training_scenario.task.farthest == asked.scenario.task.farthest == 4
    assert dataclasses.replace(asked, seed=3).training_scenario.task == asked.training_scenario.task
    both = dataclasses.replace(asked, training_options={"farthest": 5})
    assert both.training_scenario.task.farthest == 5 and both.scenario.task.farthest == 4


def test_a_variant_is_settings_that_go_together():
    config, usual = TrainConfig("hover", variant="robust"), TrainConfig("hover")
    assert (config.named()["weather"], usual.named()["weather"]) == ("light", "calm")
    landing, small = TrainConfig("landing", variant="robust"), "crazyflie_brushless"
    weights = VARIANTS["robust"]["task_options"] | {"progress_weight": 200.0}
    assert landing.named()["task_options"] == weights | {"attitude_weight": 60.0}
    often = config.scenario.aircraft.control_timestep / 0.02
    quick = TrainConfig("hover", variant="robust", vehicle=small)
    assert quick.steps == OF_VEHICLE["robust", small]["steps"] * often
    assert config.scenario.aircraft.action_scale > usual.scenario.aircraft.action_scale
    # What is given is added to the dicts, and stands in place of the rest.
    own = TrainConfig("hover", variant="robust", weather="calm", observe={"airspeed": True})
    seen = config.conditions["observe"] | {"airspeed": True}
    assert (own.conditions["observe"], own.conditions["weather"]) == (seen, "calm")
    assert TrainConfig(**json.loads(json.dumps(dataclasses.asdict(own)))) == own
    racer = TrainConfig("hover", variant="robust", vehicle="racer")
    assert racer.conditions["vehicle_options"] == {}


def test_a_task_may_leave_out_what_others_see_in_a_variant():
    seen = TrainConfig("navigation", variant="robust").conditions["observe"]
    assert {*seen["sensors"]} == {"range_finder"} and not seen["disturbance"]
    usual = TrainConfig("hover", variant="robust").conditions["observe"]
    assert {*usual["sensors"]} == {"aim", "disturbance"}


def test_a_variant_may_have_an_aircraft_and_a_control_rate_of_its_own():
    config = TrainConfig("hover", variant="raptor")
    assert (config.conditions["vehicle"], config.scenario.aircraft.control_timestep) == (
        "racer",
        0.01,
    )
    assert config.gamma == 0.9898  # 0.95^(0.01 / 0.05)
    assert (config.rollout, config.iterations * config.rollout * config.num_envs) == (32, 5_013_504)
    small = TrainConfig("hover", variant="raptor", vehicle="crazyflie")
    assert small.scenario.aircraft.control_timestep == 0.01 and small.gamma == config.gamma


def test_numbers_of_the_aircraft_can_differ_and_go_with_the_policy(tmp_path):
    config = TrainConfig("hover", vehicle_options={"mass": 0.7, "inertia": [0.01, 0.01, 0.015]})
    vehicle = config.scenario.aircraft
    assert (vehicle.mass, vehicle.inertia) == (0.7, (0.01, 0.01, 0.015))
    linear(22, 4, **config.scenario.to_json()).save(tmp_path / "policy.safetensors")
    flown = evaluation.setting(tmp_path)[2].aircraft
    assert flown == vehicle
    named = evaluation.setting(tmp_path, vehicle="paper")[2].aircraft
    assert named == vehicle
    given = evaluation.setting(tmp_path, vehicle=quadrl.Vehicle())[2].aircraft
    assert given == quadrl.Vehicle()


def test_a_randomization_and_options_of_the_observation_are_settings():
    drawn = quadrl.Randomization(mass=(0.9, 1.1), noise={"position": 0.01})
    config = TrainConfig("hover", randomization=drawn, observe=quadrl.Observing(airspeed=True))
    assert config.conditions["observe"] == {"airspeed": True}
    again = TrainConfig(**json.loads(json.dumps(dataclasses.asdict(config))))
    assert again == config
    assert again.scenario.randomization == drawn


def test_a_task_names_aircraft_and_algorithm_of_its_trainings_and_no_others_options():
    config = TrainConfig("race")
    flown = config.conditions
    assert (flown["vehicle"], flown["vehicle_options"]) == ("racer", {"action_scale": 1250.0})
    sources = {name: origin for name, _, origin in config.sources()}
    assert sources["vehicle"] == sources["vehicle_options.action_scale"] == "race x apg"
    assert (config.algo, sources["algo"]) == ("apg", "race x apg")
    assert TrainConfig("race", algo="ppo").algo == "ppo" and TrainConfig("hover").algo == "ppo"
    flown = TrainConfig("race", vehicle="paper").conditions
    assert (flown["vehicle"], flown["vehicle_options"]) == ("paper", {})
    assert TrainConfig("hover").conditions["vehicle"] == "paper"
