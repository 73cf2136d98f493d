"""All that the next steps of an `Environment` depend on, as arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np

from quadrl.aircraft.parameters import LAYOUT, named, refitted
from quadrl.base import records
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import MAX_SEED, Seed, seeds_of_rows
from quadrl.conditions.process import Process
from quadrl.core.snapshot import Snapshot
from quadrl.core.transition import Episode
from quadrl.engines.engine import Engine

MOMENT = ("action", "rotor_command", "time")
"""Arrays of a snapshot that are its own."""
TABLES = "engine.parameters", "engine.begun"
"""Rows of the aircraft: those that fly, and those with which their episodes began. In between an
event may have changed any number but these:"""
MADE_OF = "mark", "size", "rotor_count", "effects"
MOST_STEPS = 2.0**53
"""Whole numbers up to here are exact in double precision."""


@dataclasses.dataclass
class Seeds:
    """Which episode each of N rows flies: all its random numbers follow from that."""

    keys: np.ndarray  # (N,) int64, the seed of each row
    episodes: np.ndarray  # (N,) int64, begun since

    def renewed(self, seed: Seed, rows: np.ndarray) -> Seeds:
        """The same with some rows (n,) seeded anew, as `Environment.seed` does.

        Raises:
            QuadrlError: A seed is not a whole number from 0 on, or there are not N of them.
        """
        chosen, own = seeds_of_rows(seed, rows, len(self.keys))
        fresh = records.copied(self)
        fresh.keys[chosen], fresh.episodes[chosen] = own, 0
        return fresh


class Copied:
    """An environment that can be pickled and copied: the copy is made anew and continues."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Keep the arguments: copies are made with them too."""
        self = super().__new__(cls)
        self._made_with = args, kwargs
        return self

    def __getstate__(self: Any) -> tuple[Any, ...]:
        """For pickle and deepcopy: how it was made, and all that the next steps depend on."""
        return self._made_with, records.copied(self.seeds), self.save() if self.has_begun else None

    def __setstate__(self: Any, state: Any) -> None:
        """Make it anew and continue where the other was."""
        (args, kwargs), seeds, saved = state
        self.__dict__.clear()
        self._made_with = args, kwargs
        self.__init__(*args, **kwargs)
        if saved is not None:
            self.restore(saved)
        self.seeds = seeds

    def make_anew(self) -> None:
        """Make itself anew and continue; live arrays such as `engine.wind` are other ones then."""
        self.__setstate__(self.__getstate__())


@dataclasses.dataclass(frozen=True)
class Memory:
    """The parts of an environment that are saved and restored."""

    engine: Engine
    seeds: Seeds
    snapshot: Snapshot
    episode: Episode
    processes: Sequence[Process]

    def _parts(self) -> dict[str, Engine | Process]:
        """Parts that save arrays of their own, by the name that these begin with."""
        return {"engine": self.engine, **{process.name: process for process in self.processes}}

    def save(self) -> dict[str, np.ndarray]:
        """Copies of all arrays by name."""
        saved = {f.name: getattr(self.seeds, f.name).copy() for f in dataclasses.fields(Seeds)}
        saved |= records.arrays("task", self.snapshot.task)
        saved |= records.arrays("episode", self.episode)
        # In C's order, as every file format wants them: compiled steps keep columns.
        moment = {name: getattr(self.snapshot, name) for name in MOMENT}
        saved |= {name: np.array(array, order="C") for name, array in moment.items()}
        for name, part in self._parts().items():
            saved |= {f"{name}.{k}": value for k, value in part.save().items()}
        return saved

    def fitted(self, saved: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """What was saved, with the numbers that an aircraft's row or a process did not have then.

        Raises:
            QuadrlError: The row has a number that is not known here.
        """
        for process in self.processes:
            saved = process.fitted(saved)
        layout, own = saved.get("engine.layout"), self.engine.begun
        if layout is None or not saved.keys() >= {*TABLES} or np.array_equal(layout, LAYOUT):
            return saved
        tables = {name: refitted(saved[name], layout, own) for name in TABLES}
        return {**saved, **tables, "engine.layout": LAYOUT}

    def check(self, saved: Mapping[str, np.ndarray]) -> None:
        """Refuse the state of another environment, or one that no environment can be in.

        Raises:
            QuadrlError: The message names the array.
        """
        own = self.save()
        records.check_alike(saved, own)
        for name in own:
            # What a task remembers is its own.
            if not (name.startswith("task.") or np.isfinite(saved[name]).all()):
                raise QuadrlError(name=name, value=saved[name], allowed="finite")
        self._check_counters(saved)
        for process in self.processes:
            process.check(saved)
        now, then = (named(saved[name]) for name in TABLES)
        for name in MADE_OF:
            if not np.array_equal(now[name], then[name]):
                allowed = "as when the episode began: it does not change in flight"
                raise QuadrlError(name=f"{TABLES[0]} {name}", value=now[name], allowed=allowed)

    def _check_counters(self, saved: Mapping[str, np.ndarray]) -> None:
        """Refuse seeds and counters that are out of range or contradict each other.

        Raises:
            QuadrlError: The message names the array.
        """
        for name in ("keys", "episodes", "randomizer.place", "weather.streams"):
            if name in saved and not ((saved[name] >= 0) & (saved[name] <= MAX_SEED)).all():
                allowed = f"whole numbers from 0 to {MAX_SEED}"
                raise QuadrlError(name=name, value=saved[name], allowed=allowed)
        steps = saved["episode.steps"]
        if not ((steps >= 0) & (steps <= MOST_STEPS) & (steps % 1 == 0)).all():
            allowed = f"whole numbers from 0 to {MOST_STEPS:.0f}"
            raise QuadrlError(name="episode.steps", value=steps, allowed=allowed)
        counted = {"time": steps * self.engine.vehicle.control_timestep, "randomizer.steps": steps}
        counted["events.steps"] = steps
        for name, expected in counted.items():
            if name in saved and not np.array_equal(saved[name], expected):
                allowed = "that of episode.steps, which was saved beside it"
                raise QuadrlError(name=name, value=saved[name], allowed=allowed)

    def restore(self, saved: Mapping[str, np.ndarray]) -> tuple[Snapshot, Episode]:
        """Restore what `save` returned and `check` has accepted.

        Returns:
            The snapshot of that moment, without its potentials, and how far its episodes are.
        """
        for name, part in self._parts().items():
            own = [key for key in saved if key.startswith(f"{name}.")]
            part.restore({key.removeprefix(f"{name}."): saved[key] for key in own})
        for field in dataclasses.fields(Seeds):
            getattr(self.seeds, field.name)[:] = saved[field.name]
        episode = records.of_arrays("episode", self.episode, saved)
        task_state = records.of_arrays("task", self.snapshot.task, saved)
        action, command, time = (np.array(saved[name]) for name in MOMENT)
        known = task_state, self.snapshot.parameters, action, command, time
        return Snapshot(self.engine.state, *known), episode
