"""The tasks that come with quadrl, and all that a task of one's own is written with."""

from __future__ import annotations

from quadrl.base.rotation import (
    Array,
    cross,
    dot,
    filled,
    namespace,
    norm,
    stack,
    to_body,
    to_world,
    zeros,
)  # fmt: skip
from quadrl.conditions.solids import Box, Capsule, Cylinder, Gate, Pose, Sphere
from quadrl.core.catalogue import COMPOSED, TASKS, make, register
from quadrl.core.contact import stands, strikes_ground, touches_ground
from quadrl.core.markers import Marker
from quadrl.core.observation import OBSERVATION, ObservationTerm
from quadrl.core.one_of import OneOf
from quadrl.core.rewards import once, weighted
from quadrl.core.task import ROTATION, TARGET_MOTION, TARGET_VELOCITY, Target, Task, TaskState
from quadrl.tasks.all import All
from quadrl.tasks.deck_landing import DeckLanding
from quadrl.tasks.hover import Hover
from quadrl.tasks.landing import Landing
from quadrl.tasks.lsy_race import LsyRace
from quadrl.tasks.navigation import Navigation
from quadrl.tasks.perching import Perching
from quadrl.tasks.race import Race
from quadrl.tasks.random_waypoint import RandomWaypoint
from quadrl.tasks.recovery import Recovery
from quadrl.tasks.static_waypoint import StaticWaypoint
from quadrl.tasks.straight_and_level import StraightAndLevel
from quadrl.tasks.target_following import TargetFollowing
from quadrl.tasks.trajectory import Trajectory

__all__ = [
    "OBSERVATION", "ROTATION", "TARGET_MOTION", "TARGET_VELOCITY", "TASKS", "All", "Array", "Box",
    "Capsule", "Cylinder", "DeckLanding", "Gate", "Hover", "Landing", "LsyRace", "Marker",
    "Navigation", "ObservationTerm", "OneOf", "Perching", "Pose", "Race", "RandomWaypoint",
    "Recovery", "Sphere", "StaticWaypoint", "StraightAndLevel", "Target", "TargetFollowing", "Task",
    "TaskState", "Trajectory", "cross", "dot", "filled", "make", "namespace", "norm", "once",
    "register", "stack", "stands", "strikes_ground", "to_body", "to_world", "touches_ground",
    "weighted", "zeros",
]  # fmt: skip

for _task in (
    *(Hover, StaticWaypoint, RandomWaypoint, StraightAndLevel, Landing, TargetFollowing),
    *(Race, Recovery, Trajectory, Perching, DeckLanding, LsyRace, Navigation),
):
    register(_task)
COMPOSED.update({OneOf.name: OneOf, All.name: All})
