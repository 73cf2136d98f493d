"""One of several tasks, drawn for each episode: rows of one environment fly different tasks.

Each member's functions are called for all rows, with what it remembers itself; a row takes the
numbers of its own member, which are bit for bit those of that task alone. The frame of the lowest
member is that of all; others see heights above their own.
"""

from __future__ import annotations

import dataclasses
import functools
import graphlib
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from quadrl.aircraft.parameters import Parameters
from quadrl.base import records
from quadrl.base.errors import QuadrlError
from quadrl.base.philox import MEMBERS, START
from quadrl.base.primitives import Primitive
from quadrl.base.rotation import Array, namespace, stack
from quadrl.base.validation import MAX_OPTION, number, numbers
from quadrl.core.catalogue import make
from quadrl.core.markers import Marker
from quadrl.core.observation import ObservationTerm
from quadrl.core.snapshot import EpisodeEnd, Rollout, Snapshot, TaskState
from quadrl.core.task import Task, ends_of
from quadrl.core.transition import Clock
from quadrl.engines.rng import Rng
from quadrl.engines.state import Start

WORLD = ("true_parameters",)
"""What members have alike, since there is one world for all rows."""
EXAMPLE = '["hover", {"task": "random_waypoint", "farthest": 2.0}]'


@dataclasses.dataclass(frozen=True)
class Chosen(TaskState):
    """Which task an episode is of, and what it remembers."""

    which: Array  # (N,) number of the member, from 0 on
    own: tuple[TaskState, ...]  # of each member; of a row, that of its own member counts


def _raised(position: Array, by: float) -> Array:
    """Places (..., 3) [m] by so much higher [m]; the same array without that."""
    return stack(position[..., 0], position[..., 1], position[..., 2] + by) if by else position


def _select(which: Array, values: Sequence[Any]) -> Any:
    """Of each row the value of its member, an array (N, ...) or a record of arrays.

    Where a member has none, 0; None if none has one.
    """
    there = [(k, value) for k, value in enumerate(values) if value is not None]
    found, xp = there[-1][1] if there else None, namespace(which)
    if dataclasses.is_dataclass(found):
        columns = zip(*map(records.leaves, values), strict=True)
        return records.filled(found, (_select(which, column) for column in columns))
    if all(value is found for value in values):
        return found
    if len(there) < len(values):
        found = xp.zeros_like(found)
    for k, value in there[: len(values) - 1]:
        found = xp.where((which == k)[(..., *(value.ndim - 1) * [None])], value, found)
    return found


def _terms(which: Array, given: list[Any], names: Sequence[str]) -> dict[str, Array]:
    """Of each row the named values of its member, 0 where it has none."""
    return {name: _select(which, [terms.get(name) for terms in given]) for name in names}


def _by_row(function: str) -> Any:
    """A function of a task that gives of each row what the function of its member gives."""

    def of_member(self: OneOf, now: Snapshot, *more: Any) -> Any:
        return _select(now.task.which, self.each(function, now, *more))

    return of_member


@functools.cache
def _in_order(orders: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """All names, those of each member in its order: the sum of the terms is then that alone."""
    sorter = graphlib.TopologicalSorter[str]()
    for order in orders:
        for last, name in zip(("", *order), order, strict=False):
            sorter.add(name, *filter(None, [last]))
    try:
        return tuple(sorter.static_order())
    except graphlib.CycleError as error:
        allowed = "the same terms in the same order in every member"
        raise QuadrlError(name="one_of reward", value=error.args[1], allowed=allowed) from None


def _member(given: Any) -> Task:
    """A task of what a caller gives for one."""
    options = {**cast(Any, given)} if isinstance(given, Mapping) else {"task": given}
    return make(options.pop("task", None), **options)


@dataclasses.dataclass(frozen=True)
class OneOf(Task):
    """Fly the task that is drawn for the episode."""

    name = "one_of"
    compiled = True
    asks = "fly the task that is drawn for the episode, which the observation names"
    starts = ends = solved = "as the task that is drawn"
    keeps_place = False

    time_limit: float = MAX_OPTION
    """Largest time limit of an episode [s]: members with a longer one have this instead."""
    members: tuple[Task, ...] = dataclasses.field(default_factory=tuple)
    """The tasks, at least two: each a task, a name, or a name with options, as in {"task": "hover",
    "radius": 0.3}."""
    shares: tuple[float, ...] = ()
    """How often each is drawn, in proportion to the others; () for equally often."""

    def __post_init__(self) -> None:
        """Make the members, and refuse those that cannot share a world or an observation."""
        given: Any = self.members
        if not isinstance(given, (list, tuple)) or len(cast(Any, given)) < 2:
            raise self._refused("members", given, f"at least two tasks, such as {EXAMPLE}")
        members, known = [*map(_member, cast(Any, given))], dict[str, Any]()
        longest = max(member.time_limit for member in members)
        limit = min(longest, number("one_of time_limit", self.time_limit, positive=True))
        cut = (m.replace(time_limit=limit) if m.time_limit > limit else m for m in members)
        vars(self).update(members=tuple(cut))
        for name in WORLD:
            known[name], *others = {getattr(member, name) for member in members}
            if others:
                said = ", ".join(f"{k} {getattr(one, name)!r}" for k, one in self.named.items())
                raise self._refused("members", said, f"with one {name}, since they share a world")
        known["altitude"] = min(member.altitude for member in members)
        known["contact"] = any(member.contact for member in members)
        for name, member in self.named.items():
            if member.solids() or type(member).scene is not Task.scene or isinstance(member, OneOf):
                allowed = "tasks without solids, which stand in the way of others, none a one_of"
                raise self._refused("member", name, allowed)
        for field in dataclasses.fields(Task):
            value = getattr(self, field.name)
            if value not in (field.default, known.get(field.name)) and field.name != "time_limit":
                raise self._refused(field.name, value, f"an option of members, as in {EXAMPLE}")
        targets = (
            dataclasses.replace(one, metric=f"{k}_{one.metric}", words=f"{k}: {one.words}")
            for k, member in self.named.items()
            for one in member.targets
        )
        meaning = f"1 for the task that is flown, else 0: {', '.join(self.named)}"
        flag = {"task": ObservationTerm(len(members), "1", meaning)}
        known["observation"] = self._joined("observation", flag)
        known["sensors"] = self._joined("sensors", {})
        vars(self).update(known, targets=tuple(targets), time_limit=limit)
        super().__post_init__()
        if not sum(numbers("one_of shares", self._weights, len(members), 0.0)) > 0:
            raise self._refused("shares", self.shares, "not all 0")

    @functools.cached_property
    def named(self) -> dict[str, Task]:
        """The members by name; the second with the same name is NAME_2, and so on."""
        names, found = [member.name for member in self.members], dict[str, Task]()
        for k, (name, member) in enumerate(zip(names, self.members, strict=True)):
            found[f"{name}_{names[:k].count(name) + 1}" if name in found else name] = member
        return found

    @property
    def parts(self) -> tuple[Task, ...]:
        """Its members."""
        return self.members

    @property
    def asks_compiled(self) -> bool:
        """Whether all its members ask for it, too."""
        return super().asks_compiled and all(member.asks_compiled for member in self.members)

    def to_json(self) -> dict[str, Any]:
        """Its options, as JSON can hold them."""
        members = [{"task": member.name, **member.to_json()} for member in self.members]
        return super().to_json() | {"members": members}

    def check(self, parameters: Parameters) -> None:
        """Refuse an aircraft that cannot do what a member asks, or end it in time."""
        for member in self.members:
            member.check(parameters)
            Clock.of(member, parameters.control_timestep)

    def begin(self, rng: Rng, parameters: Parameters) -> tuple[Start, Chosen]:
        """As the member that is drawn begins alone, from the same random numbers."""
        begun = [member.begin(rng.stream(START), parameters) for member in self.members]
        starts, own = zip(*begun, strict=True)
        drawn = rng.stream(MEMBERS).uniform(0.0, sum(self._weights))
        xp, which = namespace(drawn), 0.0 * drawn
        for edge in itertools.accumulate(self._weights[:-1]):
            which = xp.where(drawn >= edge, which + 1.0, which)
        moved = [self._moved(*pair) for pair in zip(starts, self._heights, strict=True)]
        return _select(which, moved), self._chosen(which, own)

    def remember(self, start: Start, drawn: Any) -> Chosen:
        """What each member remembers of the start."""
        each = zip(self.members, drawn.own, self._heights, strict=True)
        own = tuple(member.remember(self._moved(start, -h), kept) for member, kept, h in each)
        return self._chosen(drawn.which, own)

    def update(self, before: Snapshot, now: Snapshot) -> Chosen:
        """What each member remembers."""
        own = self.each("update", before, now)
        kept = all(one is was for one, was in zip(own, now.task.own, strict=True))
        return now.task if kept else self._chosen(now.task.which, tuple(own))

    def duration(self, now: Snapshot) -> tuple[Array, Array]:
        """Those of the member, rounded to control steps as alone."""
        timestep = now.parameters.control_timestep
        clocks = [Clock.of(member, timestep) for member in self.members]
        limits = [0.0 * now.time + clock.time_limit_steps * timestep for clock in clocks]
        settles = [0.0 * now.time + clock.settle_steps * timestep for clock in clocks]
        return _select(now.task.which, limits), _select(now.task.which, settles)

    target_velocity, error = map(_by_row, ("target_velocity", "error"))
    measure, succeeded = map(_by_row, ("measure", "succeeded"))

    def goal(self, now: Snapshot) -> Array:
        """Where the member wants to be."""
        pairs = zip(self.each("goal", now), self._heights, strict=True)
        return _select(now.task.which, [_raised(*pair) for pair in pairs])

    def terminated(self, now: Snapshot) -> dict[str, Array]:
        """The ends of the member, none of others."""
        ends = dict[str, Array]()
        for k, member in enumerate(self.members):
            for name, holds in ends_of(member, self._seen(now, k)).items():
                own = (now.task.which == k) & holds
                ends[name] = ends[name] | own if name in ends else own
        return ends

    def observe(self, now: Snapshot) -> dict[str, Array]:
        """Which member it is, and what that sees, 0 in the entries of others."""
        which, zero = now.task.which, 0.0 * now.task.which
        numbers, xp = range(len(self.members)), namespace(which)
        flags = [xp.where(which == k, zero + 1.0, zero) for k in numbers]
        names = [name for name in self.observation if name != "task"]
        return {"task": stack(*flags)} | _terms(which, self.each("observe", now), names)

    def reward(self, before: Snapshot, now: Snapshot, end: EpisodeEnd) -> dict[str, Array]:
        """The terms of the member, 0 in those of others."""
        terms: list[dict[str, Array]] = self.each("reward", before, now, end)
        return _terms(now.task.which, terms, _in_order(tuple(tuple(one) for one in terms)))

    def markers(self, now: Snapshot) -> Sequence[Marker | Primitive]:
        """What the member shows."""
        number = int(now.task.which[0])
        up = np.array([0.0, 0.0, self._heights[number]])
        return [one.moved(up) for one in self.members[number].markers(self._seen(now, number))]

    def flown(self, rollout: Rollout) -> dict[str, Rollout]:
        """The flights of each member that was drawn, as a rollout of its own, by its name."""
        kept, found = rollout.remembered, dict[str, Rollout]()
        for k, (name, member) in enumerate(self.named.items()):
            own = {of.removeprefix(f"own.{k}."): values for of, values in kept.items()}
            if (rows := np.flatnonzero(kept["which"][0] == k)).size:
                found[name] = rollout.part(rows, member, own, self._heights[k])
        return found

    def each(self, function: str, *given: Any) -> list[Any]:
        """What a function of each member gives, for snapshots and what else it takes."""
        return [
            getattr(member, function)(*(self._seen(one, k) for one in given))
            for k, member in enumerate(self.members)
        ]

    @functools.cached_property
    def _heights(self) -> tuple[float, ...]:
        """Of the frames of the members above that of all [m]."""
        return tuple(member.altitude - self.altitude for member in self.members)

    def _seen(self, given: Any, number: int) -> Any:
        """A snapshot as a member sees it; other arguments as they are."""
        if not isinstance(given, Snapshot):
            return given
        state = self._moved(given.state, -self._heights[number])
        return dataclasses.replace(given, state=state, task=given.task.own[number])

    def _chosen(self, which: Array, own: tuple[Any, ...]) -> Chosen:
        """What is remembered, with the goal of each row's member."""
        pairs = zip(own, self._heights, strict=True)
        return Chosen(_select(which, [_raised(one.goal, h) for one, h in pairs]), which, own)

    @staticmethod
    def _moved(at: Any, by: float) -> Any:
        """A start or a state so much higher [m]."""
        return dataclasses.replace(at, position=_raised(at.position, by)) if by else at

    @property
    def _weights(self) -> tuple[float, ...]:
        return self.shares or (1.0,) * len(self.members)

    def _refused(self, name: str, value: Any, allowed: str) -> QuadrlError:
        return QuadrlError(name=f"{self.name} {name}", value=value, allowed=allowed)

    def _joined(self, attribute: str, found: dict[str, Any]) -> dict[str, Any]:
        """What is declared by name, and that of all members."""
        for member, task in self.named.items():
            for name, value in getattr(task, attribute).items():
                if found.setdefault(name, value) != value:
                    what = f"{attribute} {name!r} of {member}"
                    raise self._refused(what, value, f"as everywhere here, {found[name]}")
        return found
