"""Terms of rewards that tasks share: each is weighted, (N,).

Four pay what falls over a control step, a distance from what is asked (`Task.measure`): they add up
to the same whatever the step is, and a way there and back earns nothing. What is paid for as long
as the episode goes on is paid by time, for each 0.05 s.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable
from typing import Any, Literal

from quadrl.aircraft.parameters import Parameters
from quadrl.base.rotation import Array, filled, namespace, square_norm, zeros
from quadrl.core.snapshot import Snapshot

REWARD_TIME = 0.05  # [s], the control step of the paper's aircraft
Name = Literal["progress", "attitude", "speed", "spin", "control", "survival", "smoothness"]


def weighted(task: Any, names: Iterable[Name], before: Snapshot, now: Snapshot) -> dict[str, Array]:
    """Shared terms by their names, in their order, weighted by the task's options `NAME_weight`.

    Where the weight of smoothness is 0, it is left out.
    """
    was, is_, rotor = before.potentials, now.potentials, now.parameters.rotor
    share, command = time_share(now.parameters), now.rotor_command

    def cost(weight: float, change: Array) -> Array:
        return (-weight * share) * square_norm(change / rotor.max_speed)

    terms = {
        "progress": lambda: task.progress_weight * (was.distance - is_.distance),
        "attitude": lambda: task.attitude_weight * (was.attitude - is_.attitude),
        "speed": lambda: task.speed_weight * (was.speed - is_.speed),
        "spin": lambda: task.spin_weight * (was.angular_speed - is_.angular_speed),
        "control": lambda: cost(task.control_weight, command - rotor.hover_speed),
        "survival": lambda: filled(task.survival_weight * share, now.time),
        "smoothness": lambda: cost(task.smoothness_weight, command - before.rotor_command),
    }
    asked = (name for name in names if name != "smoothness" or task.smoothness_weight != 0)
    return {name: terms[name]() for name in asked}


def once(weight: float, happens: Array, now: Snapshot) -> Array:
    """The worth of what happens (N,) bool in this control step, such as the end of an episode."""
    zero = zeros(now.time)
    return namespace(zero).where(happens, zero + weight, zero)


def time_share(parameters: Parameters) -> float:
    """The part of 0.05 s that a control step takes."""
    return parameters.control_timestep / REWARD_TIME


def total(terms: dict[str, Array]) -> Array:
    """The sum of reward terms, from the first to the last."""
    return functools.reduce(operator.add, terms.values())
