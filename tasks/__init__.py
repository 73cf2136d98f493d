"""The tasks that come with quadrl."""

from __future__ import annotations

from quadrl.core.catalogue import COMPOSED, TASKS, make, register
from quadrl.core.one_of import OneOf
from quadrl.tasks.deck_landing import DeckLanding
from quadrl.tasks.hover import Hover
from quadrl.tasks.landing import Landing
from quadrl.tasks.lsy_race import LsyRace
from quadrl.tasks.perching import Perching
from quadrl.tasks.race import Race
from quadrl.tasks.random_waypoint import RandomWaypoint
from quadrl.tasks.recovery import Recovery
from quadrl.tasks.static_waypoint import StaticWaypoint
from quadrl.tasks.straight_and_level import StraightAndLevel
from quadrl.tasks.target_following import TargetFollowing
from quadrl.tasks.trajectory import Trajectory

__all__ = ["TASKS", "make", "register"]

for _task in (
    *(Hover, StaticWaypoint, RandomWaypoint, StraightAndLevel, Landing, TargetFollowing),
    *(Race, Recovery, Trajectory, Perching, DeckLanding, LsyRace),
):
    register(_task)
COMPOSED[OneOf.name] = OneOf
