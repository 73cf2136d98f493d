"""The shapes that are written behind the fields of records, held against flights."""

import dataclasses
import inspect
import re
from collections.abc import Mapping

import helpers
import numpy as np
import pytest

from quadrl import tasks
from quadrl.aircraft.presets import VEHICLES
from quadrl.engines.rng import Rng
from quadrl.evaluation.rollout import fly

DECLARED = re.compile(r"^ +(\w+): [^#\n]*# \(((?:\w+, ?)*\w*)\)", re.MULTILINE)
NAMED = {"N", "n", "R", "S", "T", "k"}


def declared(kind):
    """The shape of each field of a class by name: numbers, and letters for lengths."""
    shapes = {}
    for name, sizes in DECLARED.findall(inspect.getsource(kind)):
        parts = tuple(part.strip() for part in sizes.split(",") if part.strip())
        if name in {f.name for f in dataclasses.fields(kind)} and all(
            part in NAMED or part.isdigit() for part in parts
        ):
            shapes[name] = parts
    return shapes


def check(record, **lengths):
    """Every declared shape of a record and of the records in it; how many there were."""
    count = 0
    for kind in type(record).__mro__:
        if not dataclasses.is_dataclass(kind):
            continue
        for name, parts in declared(kind).items():
            given = getattr(record, name)
            expected = tuple(int(p) if p.isdigit() else lengths[p] for p in parts)
            # Each array of those that have names.
            for value in given.values() if isinstance(given, Mapping) else [given]:
                if value is not None:
                    assert np.shape(value)[: len(expected)] == expected, f"{kind.__name__}.{name}"
                    exact = not isinstance(value, tuple)  # of markers, whose own lengths differ
                    assert not exact or np.ndim(value) == len(expected), f"{kind.__name__}.{name}"
            count += given is not None
    for field in dataclasses.fields(record):
        inner = getattr(record, field.name)
        if dataclasses.is_dataclass(inner) and not isinstance(inner, type):
            count += check(inner, **lengths)
    return count


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(tasks.TASKS))
def test_arrays_have_the_shapes_that_stand_behind_them(name):
    count, rotors = 3, 6  # and four actions
    environment = helpers.begun(name, count, vehicle="hexa", control_mode="velocity")
    lengths = {"N": count, "n": count, "R": rotors, "k": environment.action_size}
    begun = environment.task.begin(
        Rng(np.arange(count), np.zeros(count, dtype=np.int64)), environment.snapshot.parameters
    )
    assert check(begun[0], **lengths) == 5
    before = check(environment.snapshot, **lengths)
    environment.step(np.zeros((count, environment.action_size)))
    # State 14, task state 1 at least, potentials 5, and 3 of the snapshot itself.
    assert check(environment.snapshot, **lengths) == before >= 23


def test_rollouts_and_trajectories_have_the_shapes_that_stand_behind_them():
    def still(observation):
        return np.zeros((len(observation), 4))

    flown = fly(still, tasks.make("hover", time_limit=0.5), episodes=2)
    longest = int(flown.length.max())
    assert check(flown, S=longest + 1, T=longest, N=2, R=4, k=4) == 21
    steps = int(flown.length[0])
    drawn = flown.trajectory(VEHICLES["paper"])
    assert check(drawn, T=steps, R=4) == 7
