"""Read what a study trains: a file of tasks, algorithms, settings and seeds; without torch."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
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
        # A listing, since a shared file system remembers for a while which files are not there.
        files = os.listdir(self.folder) if self.folder.is_dir() else []
        if CONFIG not in files:
            return False
        free = {name: getattr(TrainConfig, name) for name in FREE}
        found = dataclasses.replace(TrainConfig.of_folder(self.folder), **free)
        if found != dataclasses.replace(self.config, **free):
            raise QuadrlError(
                f"{self.folder} holds a run with other settings than this study's: "
                "choose another folder (--out), or move that run away"
            )
        return EVALUATION in files


@dataclasses.dataclass(frozen=True)
class Plan:
    """All trainings of a study."""

    folder: Path
    runs: tuple[PlannedRun, ...]
    episodes: int
    """Of the evaluation at the end of each."""


def read_plan(what: str | Path | Mapping[str, Any], out: Path | None) -> Plan:
    """Expand a study file (.toml or .json), or a dict with the same keys, to its trainings.

    Args:
        what: The file, or the dict.
        out: Folder of the run folders; by default runs/NAME, NAME that of the file.

    Raises:
        QuadrlError: The file cannot be read, or something in it is unknown, out of range, or does
            not fit together; the line names the file and the key.
    """
    given = isinstance(what, Mapping)
    source, name = ("the study", "study") if given else (str(what), Path(what).stem)
    content = what if given else _load(Path(what))
    try:
        return _plan(content, out or Path("runs", name))
    except QuadrlError as error:
        raise QuadrlError(f"{source}: {error}") from error


def parse_seeds(given: Any) -> list[int]:
    """Read seeds: "0:5" for 0 to 4, "3,5,8", or a list of numbers.

    Raises:
        QuadrlError: They are no such numbers.
    """
    found, seeds = given if isinstance(given, (list, tuple)) else [], []
    try:
        if isinstance(given, str):
            first, colon, last = given.partition(":")
            found = range(int(first), int(last)) if colon else [*map(int, given.split(","))]
        seeds = list(found) if len(found) <= MAX_SEEDS else []
    except (OverflowError, ValueError):
        pass
    known = all(type(seed) is int and 0 <= seed <= MAX_SEED for seed in seeds)
    if not seeds or not known or len(set(seeds)) < len(seeds):
        allowed = f"FIRST:END such as 0:5, or numbers such as 3,5,8; at most {MAX_SEEDS}"
        raise QuadrlError(name="seeds", value=given, allowed=allowed)
    return seeds


def _load(path: Path) -> Mapping[str, Any]:
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


def _plan(content: Mapping[str, Any], folder: Path) -> Plan:
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
    runs: list[PlannedRun] = []
    known: dict[str, str] = {}
    for seed, task, algo, variant in itertools.product(seeds, tasks, algorithms, variants):
        name = "-".join([task, algo, *filter(None, [variant]), str(seed)])
        settings = common | variants[variant]
        for table in common.keys() & variants[variant].keys():  # such as ppo: they are joined
            if isinstance(common[table], dict) and isinstance(settings[table], dict):
                settings[table] = common[table] | settings[table]
        try:
            config = TrainConfig(task, algo=algo, seed=seed, num_threads=1, **settings)
        except QuadrlError as error:
            raise QuadrlError(f"{name}: {error}") from error
        other = known.setdefault(json.dumps(dataclasses.asdict(config), sort_keys=True), name)
        if other != name:
            raise QuadrlError(f"{other} and {name} have the same settings: remove one of them")
        runs.append(PlannedRun(config, folder / name, variant))
    return Plan(folder, tuple(runs), episodes)


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
    for name in OWN.keys() & given.keys():
        raise QuadrlError(name=f"{key}.{name}", value=given[name], allowed=OWN[name])
    known = [field.name for field in dataclasses.fields(TrainConfig) if field.name not in OWN]
    keys(f"setting in {key}", given, known)
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
