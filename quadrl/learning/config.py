"""The settings of a training, and where their defaults come from; without torch."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

from quadrl.aircraft.aerodynamics import FULL
from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.specification import FILE, of_file
from quadrl.base.errors import QuadrlError
from quadrl.base.files import free_name
from quadrl.base.machine import deciding_versions
from quadrl.base.records import as_json, tuples
from quadrl.base.validation import number, numbers, resolved
from quadrl.conditions.sampler import AircraftSampler
from quadrl.conditions.weather import Weather
from quadrl.core.record import import_again, warn_of_changes
from quadrl.core.scenario import GIVEN, Scenario
from quadrl.core.task import Task
from quadrl.learning import foreign
from quadrl.learning.defaults import (
    ALGORITHMS,
    algorithm_of,
    flat,
    merged,
    training_defaults,
    usual_vehicle,
)
from quadrl.learning.folder import CHANGEABLE, CONFIG, read_config
from quadrl.learning.origin import NETWORKS, Origin, with_networks
from quadrl.learning.settings import ALGORITHM_CONFIGS
from quadrl.learning.train_settings import PAIRED, USUAL, TrainSettings
from quadrl.tasks import TASKS

ONE = ("task", "seed", "variant", "device", "num_threads", "checkpoint_seconds", "evaluations",
       "keep", "log", "episodes", "reward_scale", *NETWORKS)  # fmt: skip
"""Settings that trainings in turn share, beside the conditions of flight."""
LAST = ("phases", "from_run", "until", "checkpoint_every")
"""Settings of the last of them alone."""
ALIKE = (*ONE, *LAST, "vehicle", "control_mode", "observe")
"""What cannot differ between them: a policy's networks fit one task, aircraft and observation."""


@dataclasses.dataclass(frozen=True, init=False)
class TrainConfig(TrainSettings):
    """All settings of a training but its folder; `sources` says where each comes from."""

    recorded: ClassVar[Mapping[str, Any] | None] = None
    """The scenario of the run that it was read from, whose numbers it keeps; a changed copy
    (`dataclasses.replace`) is of no run, and its names mean what they do today."""

    def __init__(
        self, task: str = "hover", *, recorded: Mapping[str, Any] | None = None, **settings: Any
    ) -> None:
        """Fill in the defaults (`quadrl.learning.defaults`) of all settings that are not given.

        Args:
            task: Name of the task.
            recorded: The scenario of a run, as `Scenario.to_json` gave it.
            **settings: The other settings, as `named` has them, None for the default; those of an
                algorithm (`ppo`) may be a dict with some of them.

        Raises:
            QuadrlError: A setting is unknown or out of range.
        """
        object.__setattr__(self, "recorded", recorded)
        conditions = settings.pop("conditions", None) or {}  # of a copy
        if not isinstance(conditions, Mapping):
            allowed = "a mapping of conditions by name"
            raise QuadrlError(name="conditions", value=conditions, allowed=allowed)
        settings = _given({**conditions, **settings})
        algo = algorithm_of(task, settings.get("algo"), settings.get("variant"))
        foreign.refuse_unknown("setting", settings, USUAL, algo)
        settings = with_networks(settings)
        # An unknown task is refused with the defaults.
        usual = usual_vehicle(TASKS.get(task, Task), settings.get("variant"))
        vehicle = settings.setdefault("vehicle", usual)
        if isinstance(vehicle, str) and vehicle.endswith(FILE):
            vehicle = settings["vehicle"] = of_file(vehicle)
        variant = settings.get("variant", TrainConfig.variant)
        varied = self._known(vehicle), variant, settings.get("memory")
        values, _ = training_defaults(task, algo, *varied)
        if settings.get("from_run"):  # which has learned what they are for
            values["phases"] = ()
        for name, own in ALGORITHM_CONFIGS.items():
            given = settings.get(name, {})
            if name != algo:
                with_it, _ = training_defaults(task, name, *varied)
                foreign.refuse_idle(name, given, (values[name], with_it[name]), algo)
                given = {}
            if isinstance(given, dict):
                foreign.refuse_unknown(f"setting of {name}", given, values[name], algo)
                given = values[name] | _given(given)
            settings[name] = resolved(name, given, own, word="setting")
        for name, how in GIVEN.items():
            if dataclasses.is_dataclass(given := settings.get(name)):
                short = getattr(given, "given", lambda record=given: as_json(record))
                settings[name] = short() or how["usual"]
        if isinstance(given := settings.get("task_options"), dict):
            usual = values["training_options"]  # they do not replace options that are given
            values["training_options"] = {k: v for k, v in usual.items() if k not in given}
        for name in PAIRED:
            if isinstance(settings.get(name), dict) and recorded is None:
                settings[name] = values[name] | settings[name]
        whole = tuples(values | settings | {"task": task, "algo": algo})
        whole["conditions"] = flown = {name: whole.pop(name) for name in GIVEN}
        vars(self).update(whole)
        flown["aerodynamics"] = flown["aerodynamics"] or self._wind_brings()
        self.check_values()
        self._check()

    def __repr__(self) -> str:
        usual, values = tuples(self._defaults()[0]), self.named()
        own = [name for name in values if name in ("algo", "seed") or values[name] != usual[name]]
        held = {**vars(self), **self.conditions}
        given = ", ".join(f"{name}={held[name]!r}" for name in own if name != "task")
        return f"TrainConfig({self.task!r}, {given})"

    def _defaults(self) -> tuple[dict[str, Any], dict[str, str]]:
        chosen = self.task, self.algo, self._known(self.conditions["vehicle"])
        values, sources = training_defaults(*chosen, self.variant, self.memory)
        if not values["aerodynamics"] and (brought := self._wind_brings()):
            values["aerodynamics"], sources["aerodynamics"] = brought, "in wind"
        if self.from_run:
            values["phases"] = ()
            with contextlib.suppress(QuadrlError):  # it may be gone by now
                origin = Origin.of(self.from_run)
                values |= (networks := origin.networks())
                sources |= dict.fromkeys(networks, f"run {origin.folder}")
        return values, sources

    def _known(self, vehicle: str) -> str:
        """The aircraft whose defaults count; a run may have one that is no longer known."""
        return USUAL["vehicle"] if self.recorded and vehicle not in VEHICLES else vehicle

    def _wind_brings(self) -> str:
        """Effects of the air if none are given: the full set in wind, none in calm weather."""
        return "" if Weather.of(self.conditions["weather"]).calm else FULL

    def sources(self) -> Iterator[tuple[str, Any, str]]:
        """Name, value and origin of every setting that this training uses.

        The origin is a layer of `quadrl.learning.defaults`, or "given" where the value differs from
        what the layers say.
        """
        usual, layers = self._defaults()
        others = {*ALGORITHMS} - {self.algo}
        values = dict(flat(usual))
        for name, value in flat(self.named()):
            if name.partition(".")[0] not in others:
                same = name in values and tuples(values[name]) == value
                yield name, value, layers[name] if same else "given"

    def _check(self) -> None:
        scenario, _ = self.training_scenario, self.scenario
        if self.gammas:
            given = numbers("gammas", self.gammas, len(scenario.task.parts), 0, 1)
            object.__setattr__(self, "gammas", given)
        AircraftSampler(scenario.randomization, scenario.aircraft)
        self._check_phases()
        getattr(self, self.algo).check(self)

    def _check_phases(self) -> None:
        if not isinstance(self.phases, tuple):
            allowed = "a list of trainings, a table of settings each"
            raise QuadrlError(name="phases", value=self.phases, allowed=allowed)
        for count, given in enumerate(self.phases, 1):
            name = f"phase {count}"
            if not isinstance(given, dict) or "algo" not in given:
                allowed = 'a table of settings with its algorithm, such as {"algo": "apg"}'
                raise QuadrlError(name=name, value=given, allowed=allowed)
            if alike := [one for one in ALIKE if one in given]:
                reason = "trainings in turn share it"
                value = given[alike[0]]
                allowed = "given for all of them"
                raise QuadrlError(
                    reason, name=f"{alike[0]} of {name}", value=value, allowed=allowed
                )
        try:
            _ = self.earlier
        except QuadrlError as error:
            raise QuadrlError(f"phases: {error}") from error

    @functools.cached_property
    def earlier(self) -> tuple[TrainConfig, ...]:
        """The settings of the trainings that come before, in their order."""
        whole, found = self.named(), list[TrainConfig]()
        for given in self.phases:
            same = algorithm_of(self.task, given["algo"]) == self.algo
            kept = whole if same else {name: whole[name] for name in (*ONE, *GIVEN)}
            kept = {name: value for name, value in kept.items() if name not in LAST}
            settings = merged(kept, given, {"phases": ()})
            recorded = None if given.keys() & GIVEN.keys() else self.recorded
            found.append(TrainConfig(**settings, recorded=recorded))
        return tuple(found)

    @property
    def scenario(self) -> Scenario:
        """What the policy has to fly, in MuJoCo, and what it observes."""
        return Scenario.of(self.base, engine="mujoco", observe=self.base.observe.for_policy())

    @property
    def training_scenario(self) -> Scenario:
        """What is flown in the training."""
        return Scenario.of(self.base, task_options=self.training_options)

    @functools.cached_property
    def base(self) -> Scenario:
        """What its settings name, or the run that it was read from has recorded; made once."""
        named = {name: value for name, value in self.conditions.items() if value not in ("", {})}
        return Scenario.of(self.recorded or {"task": self.task, **named})

    def resolved(self) -> dict[str, Any]:
        """Return the settings and the scenario behind their names, as they come back from JSON."""
        scenario = self.base.to_json()
        if self.recorded:
            scenario["changed"] = self.recorded.get("changed", {})
        whole = self.named() | {"scenario": scenario, "versions": deciding_versions()}
        for name in {*ALGORITHMS} - {self.algo}:  # they do nothing
            del whole[name]
        return json.loads(json.dumps(whole))

    @classmethod
    def of_folder(cls, folder: Path) -> TrainConfig:
        """Read the configuration of a run.

        Where an aircraft or a task is another one today, those of the run stay, with a warning.

        Raises:
            QuadrlError: The folder holds no run, or its task is not known here.
        """
        import_again(saved := read_config(folder), folder)
        config = cls.of_saved(saved)
        warn_of_changes(saved["scenario"], config.base, "run")
        return config

    @classmethod
    def of_saved(cls, saved: Mapping[str, Any], **changes: Any) -> TrainConfig:
        """Make it of what `resolved` gave; a setting that this lacks has its default.

        Raises:
            QuadrlError: Its task is not known here, or something in it cannot be used.
        """
        given = {name: saved[name] for name in USUAL if name in saved} | changes
        given.setdefault("phases", ())
        if not isinstance(recorded := saved.get("scenario"), Mapping):
            raise QuadrlError(name="scenario of a run", value=recorded, allowed="a table")
        return cls(**given, recorded=recorded)


def prepare(
    task: str | TrainConfig | None,
    out: str | Path | None,
    resume: str | Path | None,
    settings: dict[str, Any],
) -> tuple[TrainConfig, Path]:
    """Make settings and folder of a training from the arguments of `quadrl.train`.

    Raises:
        QuadrlError: A setting is unknown or out of range, or may not change when a run is
            continued.
    """
    if resume is not None:
        config = TrainConfig.of_folder(folder := Path(resume))
        given = _given({"task": task, "out": out} | settings)
        for name in given:
            if name not in CHANGEABLE:
                reason = f"a run keeps its settings; only {', '.join(CHANGEABLE)} may change"
                raise QuadrlError(reason, name=name, value=given[name], allowed="left out")
        number("steps", given.get("steps", config.steps), config.steps, whole=True)
        if "steps" in given:  # it goes on to them, whatever ended it before
            given = {"until": {}} | given
        return TrainConfig.of_saved(read_config(folder), **given), folder
    if isinstance(task, TrainConfig):
        config = dataclasses.replace(task, **settings)
    else:
        config = TrainConfig(task or "hover", **settings)
    named = Path("runs") / f"{config.task}-{config.algo}-{config.seed}"
    return config, free_name(named, CONFIG) if out is None else Path(out)


def _given(settings: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if value is not None}
