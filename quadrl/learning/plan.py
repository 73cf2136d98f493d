"""Study files, which name trainings by their tasks, algorithms, settings and seeds."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from quadrl.base.errors import QuadrlError
from quadrl.base.files import read_table
from quadrl.base.philox import seeds as seeds_of
from quadrl.base.validation import choice, keys, names, number
from quadrl.evaluation.rollout import MAX_SEED
from quadrl.learning import foreign
from quadrl.learning.config import TrainConfig
from quadrl.learning.defaults import ALIASES, algorithm_of, merged
from quadrl.learning.executor import PlannedRun
from quadrl.learning.train_settings import USUAL

KEYS = ("tasks", "algorithms", "seeds", "episodes", "settings", "only", "variants")
SOME = ("tasks", "algorithms")
"""Keys by which a table of `only` limits its settings to some trainings."""
OWN = {
    "task": "the key tasks",
    "algo": "the key algorithms",
    "seed": "the key seeds",
    "episodes": "the key episodes",
    "num_threads": "left out: a training of a study has one thread",
}
"""Settings that no table of a study may hold, and what to write instead."""
MAX_RUNS = 10_000


class Plan(NamedTuple):
    """All trainings of a study."""

    folder: Path
    runs: tuple[PlannedRun, ...]


def read_plan(what: str | Path | Mapping[str, Any], out: Path | None) -> Plan:
    """Expand a study file (.toml or .json), or a dict with the same keys, to its trainings.

    Args:
        what: The file, or the dict.
        out: Folder of the run folders; by default runs/NAME, NAME that of the file.

    Raises:
        QuadrlError: The file cannot be read, or something in it is unknown, out of range, or does
            not fit together; the line names the file and the key.
    """
    if isinstance(what, Mapping):
        source, name, content = "the study", "study", what
    else:
        source, name, content = str(what), Path(what).stem, read_table(Path(what), "study")
    try:
        return _plan(content, out or Path("runs", name))
    except QuadrlError as error:
        raise QuadrlError(f"{source}: {error}") from error


def _plan(content: Mapping[str, Any], folder: Path) -> Plan:
    """List the trainings of a study seed by seed, so that a stopped study has whole seeds."""
    keys("key", content, KEYS)
    if "tasks" not in content:
        raise QuadrlError('tasks is missing: name what to train, such as tasks = ["hover"]')
    tasks = names("tasks", content["tasks"])
    algorithms = names("algorithms", content.get("algorithms", ["ppo"]))
    seeds = seeds_of(content.get("seeds", [0]), MAX_SEED)
    own = {"episodes": content.get("episodes", TrainConfig.episodes), "num_threads": 1}
    whole = {"tasks": tasks, "algorithms": algorithms}
    common = _settings("settings", content.get("settings", {}), algorithms)
    only = _only(content.get("only", []), whole)
    variants = _variants(content.get("variants", []), algorithms)
    number("trainings", len(tasks) * len(algorithms) * len(seeds) * len(variants), 1, MAX_RUNS)
    runs: list[PlannedRun] = []
    known: dict[str, str] = {}
    for seed, task, algo, variant in itertools.product(seeds, tasks, algorithms, variants):
        name = "-".join([task, algo, *filter(None, [variant]), str(seed)])
        settings, as_called = dict[str, Any](), ALIASES.get(algo, algo)
        for of, some in ((whole, common), *only, (whole, variants[variant])):
            if task in of["tasks"] and algo in of["algorithms"]:
                others = {ALIASES.get(one, one) for one in of["algorithms"]} - {as_called}
                mine = {name: value for name, value in some.items() if name not in others}
                settings = merged(settings, mine)
        try:
            config = TrainConfig(task, algo=algo, seed=seed, **own, **settings)
        except QuadrlError as error:
            raise QuadrlError(f"{name}: {error}") from error
        other = known.setdefault(json.dumps(dataclasses.asdict(config), sort_keys=True), name)
        if other != name:
            raise QuadrlError(f"{other} and {name} have the same settings: remove one of them")
        runs.append(PlannedRun(config, folder / name, variant))
    return Plan(folder, tuple(runs))


def _settings(key: str, given: Any, algorithms: list[str]) -> dict[str, Any]:
    """Check the names in a table of settings; `TrainConfig` checks their values."""
    if not isinstance(given, dict):
        raise QuadrlError(name=key, value=given, allowed="a table of settings of a training")
    for name in OWN.keys() & given.keys():
        raise QuadrlError(name=f"{key}.{name}", value=given[name], allowed=OWN[name])
    known = [name for name in USUAL if name not in OWN]
    algo = algorithm_of(TrainConfig.task, algorithms[0])
    foreign.refuse_unknown(f"setting in {key}", given, known, algo)
    return given


def _only(given: Any, of: dict[str, list[str]]) -> list[tuple[dict[str, list[str]], dict]]:
    """Read the settings of some trainings, each with its tasks and algorithms; by default all."""
    found = []
    for table in _tables("only", given):
        whom = {key: names(f"only.{key}", table.get(key, of[key])) for key in SOME}
        for key, wanted in whom.items():
            for name in wanted:
                choice(f"only.{key}", name, of[key])
        rest = {key: value for key, value in table.items() if key not in SOME}
        found.append((whom, _settings("only", rest, whom["algorithms"])))
    return found


def _tables(key: str, given: Any) -> list[dict[str, Any]]:
    """Check that a value is a list of tables."""
    if not isinstance(given, (list, tuple)) or not all(isinstance(one, dict) for one in given):
        raise QuadrlError(name=key, value=given, allowed=f"a list of tables: [[{key}]]")
    return [dict(one) for one in given]


def _variants(given: Any, algorithms: list[str]) -> dict[str, dict[str, Any]]:
    """Read the settings by the name of the variant; without variants, one without a name."""
    variants: dict[str, dict[str, Any]] = {}
    for one in _tables("variants", given):
        name: Any = one.get("name")
        plain = isinstance(name, str) and name.replace("_", "").replace(".", "").isalnum()
        if not plain or name in variants or name.startswith("."):
            allowed = "a name of its own, of letters, digits, _ and ."
            raise QuadrlError(name="variants.name", value=name, allowed=allowed)
        rest = {key: value for key, value in one.items() if key != "name"}
        variants[name] = _settings(f"variants.{name}", rest, algorithms)
    return variants or {"": {}}
