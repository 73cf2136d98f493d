"""The control step of a task, which advances the snapshot of N rows by the task's functions.

`core/compiled.py` has the other implementation, and chooses between the two.
"""

from __future__ import annotations

import abc
import dataclasses
import warnings
import weakref

import numpy as np

from quadrl.base import records
from quadrl.base.errors import QuadrlWarning
from quadrl.conditions.randomizer import Randomizer
from quadrl.conditions.world import World
from quadrl.core import transition
from quadrl.core.observer import Observer
from quadrl.core.snapshot import Snapshot
from quadrl.core.task import Task
from quadrl.core.transition import Clock, Episode, Observation, Transition
from quadrl.engines.engine import Engine

_REPORTED: weakref.WeakSet[type[Task]] = weakref.WeakSet()
"""Tasks that were reported as not compiled."""


@dataclasses.dataclass(frozen=True, slots=True)
class Inputs:
    """What a control step of N rows is flown with; the buffers stay where they are."""

    action: np.ndarray  # (N, k)
    command: np.ndarray  # (N, R) [rad/s], mean over the control step
    diverged: np.ndarray  # (N,) bool


@dataclasses.dataclass(eq=False, repr=False)
class Step(abc.ABC):
    """The control step of a task for N rows."""

    task: Task
    clock: Clock  # of its episodes
    engine: Engine  # of the aircraft
    inputs: Inputs  # read live
    observer: Observer | None  # what policies see; None where that is the true state
    loops: bool  # whether commands change with each physics step
    randomizer: Randomizer  # says which of them are late
    snapshot: Snapshot = dataclasses.field(init=False)
    """What tasks see now: live, valid until the next step."""
    episode: Episode = dataclasses.field(init=False)
    """How far the episodes are: as live as the snapshot."""
    not_compiled: str = dataclasses.field(default="", init=False)
    """Why it is not compiled; empty where it is."""

    def start(self, rows: np.ndarray, keys: np.ndarray, episodes: np.ndarray) -> Observation | None:
        """Begin episodes (n,) of aircraft as they are specified, in air that is at rest.

        Returns:
            The observation of those aircraft, terms (n, k); None, and nothing has changed, where
            the functions of the task have to begin them.
        """
        return None

    def fly(self) -> bool:
        """Command and fly the aircraft through a control step; False where that is not its part."""
        return False

    @abc.abstractmethod
    def read(self) -> np.ndarray | None:
        """Take the motion at the end of a control step; which aircraft have diverged, or None."""

    def note_diverged(self, rows: np.ndarray) -> None:
        """Note which aircraft, numbers or mask, have diverged."""
        self.inputs.diverged[rows] = True
        if self.loops:  # what they commanded may be no numbers
            self.inputs.command[rows] = self.engine.act[rows]

    @abc.abstractmethod
    def begin(self, now: Snapshot, episode: Episode) -> None:
        """Make a snapshot of all rows the present one."""

    @abc.abstractmethod
    def finish(self, world: World | None) -> Transition:
        """Bring the snapshot forward to the engine's state, as `transition.finish` does.

        Args:
            world: The world about the aircraft; None where the task declares no solids.
        """

    def flatten(self, observation: Observation) -> np.ndarray:
        """The terms of an observation as vectors (n, size), float32."""
        return np.concatenate(list(observation.values()), axis=-1, dtype=np.float32)


class WrittenStep(Step):
    """Calls the functions of the task."""

    def report_not_compiled(self, reason: str) -> None:
        """Note why it is not compiled; warn of the reason, once for each task."""
        self.not_compiled, task = reason, type(self.task)
        if task not in _REPORTED:
            _REPORTED.add(task)
            advice = "NumPy runs it; without `compiled = True` in the class nobody asks for more"
            message = f"the step of the task {task.name} is not compiled: {reason}; {advice}"
            warnings.warn(message, QuadrlWarning, stacklevel=2)

    def begin(self, now: Snapshot, episode: Episode) -> None:
        """Make a snapshot of all rows the present one."""
        self.snapshot, self.episode = now, episode

    def read(self) -> np.ndarray | None:
        """Take the motion at the end of a control step; which aircraft have diverged, or None."""
        if (diverged := self.engine.read()) is not None:
            self.note_diverged(diverged)
        return diverged

    def finish(self, world: World | None) -> Transition:
        """Bring the snapshot forward to the engine's state, as `transition.finish` does."""
        inputs, state, observer = records.copied(self.inputs), self.engine.state, self.observer
        look = observer.look(state, inputs.action, world) if observer else None
        self.snapshot, self.episode, done = transition.finish(
            *(self.task, self.clock, self.episode, self.snapshot, state),
            *(inputs.action, inputs.command, inputs.diverged, world, look),
        )
        # What a task remembers must not be a view of buffers that the next steps write.
        self.snapshot.task = records.owned(self.snapshot.task)
        if observer and look:
            observer.keep(look.after)
        return done
