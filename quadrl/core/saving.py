"""All that the next steps of an `Environment` depend on, as arrays."""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from quadrl.base import records
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import MAX_SEED
from quadrl.core.task import Snapshot

MOMENT = ("action", "rotor_command", "time")
"""Arrays of a snapshot that are its own."""
MOST_STEPS = 2.0**53
"""Whole numbers up to here are exact in double precision."""


class Copied:
    """An environment that is pickled and copied: made anew, it takes up where the other was."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Keep the arguments: copies are made with them too."""
        self = super().__new__(cls)
        self._made_with = args, kwargs
        return self

    def __getstate__(self: Any) -> tuple[Any, ...]:
        """For pickle and deepcopy: how it was made, and all that the next steps depend on."""
        return self._made_with, self._keys, self._episodes, self.save() if self._step else None

    def make_anew(self) -> None:
        """Take the place of itself: all that is live, such as `engine.wind`, is another array."""
        self.__setstate__(self.__getstate__())

    def __setstate__(self: Any, state: Any) -> None:
        """Make it anew and take up where the other was."""
        (args, kwargs), keys, episodes, saved = state
        self._made_with = args, kwargs
        self.__init__(*args, **kwargs)
        if saved is not None:
            self.restore(saved)
        self._keys[:], self._episodes[:] = keys, episodes


def save(environment: Any) -> dict[str, np.ndarray]:
    """Copies of those arrays by name."""
    if environment._step is None:
        raise RuntimeError("call reset before save")
    now = environment.snapshot
    saved = {f"engine.{name}": value for name, value in environment.engine.save().items()}
    saved |= records.arrays("task", now.task) | records.arrays("episode", environment.episode)
    saved |= {name: np.array(getattr(now, name)) for name in MOMENT}
    for name, part in _parts(environment).items():
        saved |= {f"{name}.{k}": value for k, value in part.save().items()}
    if environment.blowing:
        saved |= environment.blowing.save()
    return saved | {"keys": environment._keys.copy(), "episodes": environment._episodes.copy()}


def _parts(environment: Any) -> dict[str, Any]:
    """What remembers something of its own, by the name that its arrays begin with."""
    parts: dict[str, Any] = {}
    if environment.randomizer.active:
        parts["randomizer"] = environment.randomizer
    if environment.observer is not None:
        parts["observer"] = environment.observer
    return parts


def _check_sound(
    environment: Any, saved: dict[str, np.ndarray], own: dict[str, np.ndarray]
) -> None:
    """Refuse a saved state that is not finite, or of an aircraft that this environment never has.

    Raises:
        QuadrlError: The message names the array.
    """
    table, randomizer = "engine.parameters", environment.randomizer
    for name in own:
        begins = name.startswith(("randomizer.", "observer.", "episode."))
        checked = begins or name in ("engine.rows", "engine.solids", *MOMENT)
        if checked and not np.isfinite(saved[name]).all():
            raise QuadrlError(name=name, value=saved[name], allowed="finite")
    _check_counters(environment, saved)
    if randomizer.active:
        randomizer.check_saved(saved)
    drawn = environment.randomization.per_row and randomizer.sampler.explains(saved[table])
    if not (drawn or np.array_equal(saved[table], own[table])):
        reason = "the state was saved with another aircraft"
        raise QuadrlError(reason, name=table, value=saved[table], allowed="this aircraft's")


def _check_counters(environment: Any, saved: dict[str, np.ndarray]) -> None:
    """Refuse seeds and numbers that no environment counts to, or that contradict each other.

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
    counted = {"time": steps * environment.vehicle.control_timestep, "randomizer.steps": steps}
    for name, expected in counted.items():
        if name in saved and not np.array_equal(saved[name], expected):
            allowed = "that of episode.steps, which was saved beside it"
            raise QuadrlError(name=name, value=saved[name], allowed=allowed)


def restore(environment: Any, saved: dict[str, np.ndarray]) -> Snapshot:
    """Take up what `save` gave; returns the snapshot of that moment.

    Raises:
        QuadrlError: It is not of such an environment; nothing has changed then.
    """
    if fresh := environment._step is None:
        environment.reset()  # makes the records, which are filled below
        environment._episodes[:] = 0  # this episode does not count
    try:
        own = save(environment)
        records.check_alike(saved, own)
        _check_sound(environment, saved, own)
        if environment.blowing:
            environment.blowing.check(saved)
        elif "weather.table" in saved:
            reason = "the state was saved in wind"
            raise QuadrlError(reason, name="weather", value=None, allowed="the saved one's")
    except QuadrlError:
        if fresh:
            environment._step = None
        raise
    if environment.blowing:
        environment.blowing.restore(saved)
    engine = environment.engine
    engine.restore({key.removeprefix("engine."): saved[key] for key in saved})
    environment._keys[:], environment._episodes[:] = saved["keys"], saved["episodes"]
    for name, part in _parts(environment).items():
        start = f"{name}."
        mine = {k.removeprefix(start): v for k, v in saved.items() if k.startswith(start)}
        part.restore(mine)
    episode = records.of_arrays("episode", environment.episode, saved)
    task_state = records.of_arrays("task", environment.snapshot.task, saved)
    action, command, time = (np.array(saved[name]) for name in MOMENT)
    now = Snapshot(engine.state, task_state, environment._parameters, action, command, time)
    if environment.scene.solids:
        now.around = environment.scene.surroundings(engine)
    now.potentials = environment.task.measure(now)
    environment._take(now, episode)
    return now
