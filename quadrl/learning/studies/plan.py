"""What a study trains: a file of tasks, algorithms, settings and seeds; without torch."""

from __future__ import annotations

import dataclasses
import itertools
import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from quadrl.base.errors import QuadrlError
from quadrl.base.validation import keys, number
from quadrl.evaluation.rollout import MAX_EPISODES, MAX_SEED
from quadrl.learning.config import TrainConfig
from quadrl.learning.folder import CONFIG, EVALUATION, FREE

KEYS = ("tasks", "algorithms", "seeds", "episodes", "settings", "variants")
OWN = {
    "task": "the key tasks",
    "algo": "the key algorithms",
    "seed": "the key seeds",
    "num_threads": "left out: a training of a study has one thread",
}
"""Settings of a training that no table of a study may hold, and what to write instead."""
MAX_SEEDS = 1000
MAX_RUNS = 10_000
EPISODES = 100


@dataclasses.dataclass(frozen=True)
class PlannedRun:
    """One training of a study."""

    config: TrainConfig
    folder: Path
    variant: str = ""
    """The name of its settings in the study."""

    @property
    def name(self) -> str:
        """The name of its folder."""
        return self.folder.name

    @property
    def done(self) -> bool:
        """Whether it is trained and evaluated.

        Raises:
            QuadrlError: The folder holds a run with other settings.
        """
        if not (self.folder / CONFIG).exists():
            return False
        free = {name: getattr(TrainConfig, name) for name in FREE}
        found = dataclasses.replace(TrainConfig.of_folder(self.folder), **free)
        if found != dataclasses.replace(self.config, **free):
            raise QuadrlError(
                f"{self.folder} holds a run with other settings than this study's: "
                "choose another folder (--out), or move that run away"
            )
        return (self.folder / EVALUATION).exists()


@dataclasses.dataclass(frozen=True)
class Plan:
    """All trainings of a study."""

    name: str
    runs: tuple[PlannedRun, ...]
    episodes: int
    """Of the evaluation at the end of each."""


def read_plan(what: str | Path | Mapping[str, Any], out: Path | None) -> Plan:
    """The trainings of a study file (.toml or .json), or of a dict with the same keys.

    Args:
        what: The file, or the dict.
        out: Folder of the run folders; by default runs/NAME, NAME that of the file.

    Raises:
        QuadrlError: The file cannot be read, or something in it is unknown, out of range, or does
            not fit together; the line names the file and the key.
    """
    source = "the study" if isinstance(what, Mapping) else str(what)
    name = "study" if isinstance(what, Mapping) else Path(what).stem
    content = dict(what) if isinstance(what, Mapping) else _load(Path(what))
    try:
        return _plan(name, content, out or Path("runs", name))
    except QuadrlError as error:
        raise QuadrlError(f"{source}: {error}") from error


def parse_seeds(given: Any) -> list[int]:
    """Seeds from "0:5" for 0 to 4, from "3,5,8", or from a list of numbers.

    Raises:
        QuadrlError: They are no such numbers.
    """
    seeds: list[int] = []
    try:
        if isinstance(given, str):
            first, colon, last = given.partition(":")
            words = given.split(",")
            if 0 < (int(last) - int(first) if colon else len(words)) <= MAX_SEEDS:
                seeds = list(range(int(first), int(last)) if colon else map(int, words))
        elif isinstance(given, (list, tuple)) and all(type(seed) is int for seed in given):
            seeds = list(given)
    except ValueError:
        seeds = []
    within = 0 < len(seeds) <= MAX_SEEDS and 0 <= min(seeds) and max(seeds) <= MAX_SEED
    if not within or len(set(seeds)) < len(seeds):
        allowed = f"FIRST:END such as 0:5, or numbers such as 3,5,8; at most {MAX_SEEDS}"
        raise QuadrlError(name="seeds", value=given, allowed=allowed)
    return seeds


def _load(path: Path) -> dict[str, Any]:
    """The content of a study file."""
    if path.suffix not in (".toml", ".json"):
        raise QuadrlError(name="study", value=str(path), allowed="a .toml or a .json file")
    try:
        text = path.read_text(encoding="utf-8")
        content = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except OSError as error:
        raise QuadrlError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise QuadrlError(f"{path} is not {path.suffix[1:].upper()}: {reason}") from error
    if not isinstance(content, dict):
        raise QuadrlError(f"{path} must hold a table with the keys {', '.join(KEYS)}")
    return content


def _plan(name: str, content: dict[str, Any], folder: Path) -> Plan:
    """The trainings of a study's content: seed by seed, so that a stopped one has whole seeds."""
    keys("key", content, KEYS)
    if "tasks" not in content:
        raise QuadrlError('tasks is missing: name what to train, such as tasks = ["hover"]')
    tasks = _names("tasks", content["tasks"])
    algorithms = _names("algorithms", content.get("algorithms", ["ppo"]))
    seeds = parse_seeds(content.get("seeds", [0]))
    episodes = number("episodes", content.get("episodes", EPISODES), 1, MAX_EPISODES, whole=True)
    common = _settings("settings", content.get("settings", {}))
    variants = _variants(content.get("variants", []))
    number("trainings", len(tasks) * len(algorithms) * len(seeds) * len(variants), 1, MAX_RUNS)
    runs = []
    for seed, task, algo, variant in itertools.product(seeds, tasks, algorithms, variants):
        words = [task, algo, *filter(None, [variant]), str(seed)]
        settings = _merged(common, variants[variant])
        try:
            config = TrainConfig(task, algo=algo, seed=seed, num_threads=1, **settings)
        except QuadrlError as error:
            raise QuadrlError(f"{'-'.join(words)}: {error}") from error
        runs.append(PlannedRun(config, folder / "-".join(words), variant))
    known: dict[str, str] = {}
    for run in runs:
        other = known.setdefault(json.dumps(fields(run.config), sort_keys=True), run.name)
        if other != run.name:
            raise QuadrlError(f"{other} and {run.name} have the same settings: remove one of them")
    return Plan(name, tuple(runs), episodes)


def fields(config: TrainConfig) -> dict[str, Any]:
    """All settings, as JSON can hold them."""
    return dataclasses.asdict(config)


def _names(key: str, given: Any) -> list[str]:
    """A list of different names."""
    names = list(given) if isinstance(given, (list, tuple)) else []
    if not names or not all(isinstance(name, str) and name for name in names):
        raise QuadrlError(name=key, value=given, allowed='a list of names, such as ["hover"]')
    if len(set(names)) < len(names):
        raise QuadrlError(name=key, value=given, allowed="different names")
    return names


def _settings(key: str, given: Any) -> dict[str, Any]:
    """A table of settings; `TrainConfig` judges their values."""
    if not isinstance(given, dict):
        raise QuadrlError(name=key, value=given, allowed="a table of settings of a training")
    known = [field.name for field in dataclasses.fields(TrainConfig)]
    for name in given:
        if name in OWN:
            raise QuadrlError(name=f"{key}.{name}", value=given[name], allowed=OWN[name])
    keys(f"setting in {key}", given, [name for name in known if name not in OWN])
    return given


def _variants(given: Any) -> dict[str, dict[str, Any]]:
    """Settings by the name of the variant; one without a name where there are none."""
    if not isinstance(given, (list, tuple)) or not all(isinstance(one, dict) for one in given):
        raise QuadrlError(name="variants", value=given, allowed="a list of tables: [[variants]]")
    variants: dict[str, dict[str, Any]] = {}
    for one in given:
        name = one.get("name")
        plain = isinstance(name, str) and name.replace("_", "").replace(".", "").isalnum()
        if not plain or name in variants or name.startswith("."):
            allowed = "a name of its own, of letters, digits, _ and ."
            raise QuadrlError(name="variants.name", value=name, allowed=allowed)
        rest = {key: value for key, value in one.items() if key != "name"}
        variants[name] = _settings(f"variants.{name}", rest)
    return variants or {"": {}}


def _merged(common: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Settings with those of a variant; tables such as ppo are joined."""
    merged = common | own
    for name in common.keys() & own.keys():
        if isinstance(common[name], dict) and isinstance(own[name], dict):
            merged[name] = common[name] | own[name]
    return merged
