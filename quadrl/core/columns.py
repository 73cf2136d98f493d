"""Where the numbers of an aircraft stand in the tables of a batch, a column for each aircraft."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import numpy as np

from quadrl.aircraft import parameters
from quadrl.conditions.randomization import OFF
from quadrl.core.compiled import CompiledStep
from quadrl.core.environment import Environment
from quadrl.engines.air import DRAWN, FILTERS, FIXED, ROWS


class Layout:
    """Where the numbers of an aircraft stand in the tables of a batch."""

    def __init__(self, environment: Environment) -> None:
        """Lay them out for an environment whose episodes have begun."""
        program = cast(CompiledStep, environment.control_step).program
        vehicle, observer = environment.vehicle, environment.observer
        self.program, self.motion = program, 13 + vehicle.rotor_count
        self.kept, self.observed = program.remembered.end, environment.size
        self.terms, self.ends = program.rewarded, program.ended
        self.privileged = np.zeros(0, int)
        """Where in what is kept the privileged observation stands."""
        if observer and (channel := observer.senses.channels.get("privileged")):
            numbers = np.arange(program.seen.end)[:, None]
            self.privileged = channel.seen(program.memory(numbers)["privileged"])[0]
        self.seen = self.observed + len(self.privileged)
        """Rows of what is observed: by policies, then by the critic alone."""
        self.pooled = not environment.plain or environment.blowing is not None
        """Whether episodes begin with columns of a pool."""
        rows = parameters.numbers(environment.engine.begun)
        self.varying: list[int] = np.flatnonzero((rows != rows[:1]).any(0)).tolist()
        """Parameters that differ between aircraft."""
        randomizer, weather = environment.randomizer, environment.blowing
        ages = len(randomizer.past) > 0
        self.late = len(randomizer.queue) if randomizer.late else 0
        self.linked = bool(randomizer.late and randomizer.linked)
        changing = [*DRAWN, "steps", *FILTERS] if weather else []
        changing += FIXED if weather and environment.randomization.wind != OFF else ()
        self.weather = [k for k, name in enumerate(ROWS) if name in changing]
        """Rows of the weather's table that differ between aircraft, or change."""
        self.solids = _solids(environment)
        parts = {
            "motion": self.motion,
            "kept": self.kept,
            "parameters": len(self.varying),
            "given": program.parts["given"],
            "delay": int(self.late > 0),
            "ages": 2 * ages,
            "link": 4 * self.linked,
            "last": vehicle.rotor_count * self.linked,
            "weather": len(self.weather),
            "solids": sum(varies.sum() for _, varies in self.solids),
            "queue": self.late * vehicle.rotor_count,
            "past": self.late * 13 * ages,
        }
        ends = np.cumsum([0, *parts.values()]).tolist()
        self.first = dict(zip(parts, ends, strict=False))
        """The first row of each part of the table."""
        self.begun, self.rows = self.first["queue"], ends[-1]
        """Rows of a column of the pool without its observation, and of all."""
        self.reward = 2 * self.seen
        self.out = self.reward + 2 + len(self.terms)
        """Rows of what a step gives."""
        self.flags = 5 + len(self.ends)

    def pool(self, environment: Environment, observed: Mapping[str, np.ndarray]) -> np.ndarray:
        """The columns with which the episodes of an environment have just begun.

        Args:
            environment: The environment.
            observed: What its reset returned.
        """
        engine, observer = environment.engine, environment.observer
        randomizer, weather = environment.randomizer, environment.blowing
        count, tables = environment.num_envs, cast(CompiledStep, environment.control_step).tables
        table = tables.pages[engine.turn].whole
        given = [*observer.given.values()] if observer else []
        varying = len(self.varying)
        parts = [
            np.concatenate([engine.qpos, engine.qvel, engine.act], axis=1).T,
            table[: self.kept, :count],
            np.broadcast_to(parameters.numbers(engine.begun)[:, self.varying].T, (varying, count)),
            *(array.T for array in given),
        ]
        if self.late:
            ages = [randomizer.ages] if len(randomizer.past) else []
            parts += [randomizer.usual_delay[None], *ages]
        if self.linked:
            often = randomizer.jitters, randomizer.losses, randomizer.outages, randomizer.left
            parts += [np.stack(often), engine.act.T]
        if weather:
            parts.append(weather.table[self.weather])
        every = engine.solids.table
        numbers = every.view(np.float64).reshape(*every.shape, every.itemsize // 8)
        parts += [numbers[:, k, varies].T for k, (_, varies) in enumerate(self.solids)]
        seen = [array.T for array in observed.values()], table[self.privileged, :count]
        made = np.concatenate([*parts, *seen[0], seen[1]])
        assert len(made) == self.begun + self.seen
        return made


def _solids(environment: Environment) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of each solid its numbers, as `Solid` of native/solids.h, and which differ between rows."""
    table = environment.engine.solids.table
    numbers = table.view(np.float64).reshape(*table.shape, table.itemsize // 8)
    return [(own[0], (own != own[:1]).any(0)) for own in numbers.swapaxes(0, 1)]


def uncovered(environment: Environment) -> str:
    """What of an environment a GPU does not fly, in words; empty where it flies all of it."""
    task, observer = environment.task, environment.observer
    follows = environment.control_mode.has_loops and bool(observer and observer.follows)
    rays = [own for own in observer.senses.rays.values() if own] if observer else []
    for name, holds in {
        "contact (the task touches the ground or solids)": task.contact,
        "solids that move": task.moves,
        "events": environment.events is not None,
        "sensors that follow the commands of loops": follows,
        "two sensors with rays": len(rays) > 1,
    }.items():
        if holds:
            return name
    return ""
