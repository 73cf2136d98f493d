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
from quadrl.base.rotation import Array, namespace, square_norm
from quadrl.core.snapshot import Snapshot

REWARD_TIME = 0.05  # [s], the control step of the paper's aircraft
Name = Literal["progress", "attitude", "speed", "spin", "control", "survival", "smoothness"]


def weighted(task: Any, names: Iterable[Name], before: Snapshot, now: Snapshot) -> dict[str, Array]:
    """Terms by their names, in their order, weighted by the task's options `NAME_weight`.

    Where the weight of smoothness is 0, it is left out.
    """
    terms = {
        "progress": progress(task.progress_weight, before, now),
        "attitude": attitude(task.attitude_weight, before, now),
        "speed": speed(task.speed_weight, before, now),
        "spin": spin(task.spin_weight, before, now),
        "control": control(task.control_weight, now),
        "survival": survival(task.survival_weight, now),
        **smoothness(task.smoothness_weight, before, now),
    }
    asked = (name for name in names if name != "smoothness" or task.smoothness_weight != 0)
    return {name: terms[name] for name in asked}


def progress(weight: float, before: Snapshot, now: Snapshot) -> Array:
    """The distance to the goal [m] falls."""
    return weight * (before.potentials.distance - now.potentials.distance)


def attitude(weight: float, before: Snapshot, now: Snapshot) -> Array:
    """The attitude error falls."""
    return weight * (before.potentials.attitude - now.potentials.attitude)


def speed(weight: float, before: Snapshot, now: Snapshot) -> Array:
    """The speed [m/s] falls, relative to the target where there is one."""
    return weight * (before.potentials.speed - now.potentials.speed)


def spin(weight: float, before: Snapshot, now: Snapshot) -> Array:
    """The body rate [rad/s] falls."""
    return weight * (before.potentials.angular_speed - now.potentials.angular_speed)


def control(weight: float, now: Snapshot) -> Array:
    """The cost of commands off the hover speed: sum((Omega_c - Omega_hover)^2) / Omega_max^2."""
    rotor = now.parameters.rotor
    effort = square_norm((now.rotor_command - rotor.hover_speed) / rotor.max_speed)
    return (-weight * time_share(now.parameters)) * effort


def survival(weight: float, now: Snapshot) -> Array:
    """The time in the air."""
    return 0.0 * now.time + weight * time_share(now.parameters)


def smoothness(weight: float, before: Snapshot, now: Snapshot) -> dict[str, Array]:
    """The cost of commands that change: sum((Omega_c - Omega_c before)^2) / Omega_max^2.

    Returns:
        The term by its name; none where its weight is 0.
    """
    if weight == 0:
        return {}
    change = (now.rotor_command - before.rotor_command) / now.parameters.rotor.max_speed
    return {"smoothness": (-weight * time_share(now.parameters)) * square_norm(change)}


def once(weight: float, happens: Array, now: Snapshot) -> Array:
    """What happens (N,) bool in this control step, the end of the episode for example."""
    zero = 0.0 * now.time
    return namespace(zero).where(happens, zero + weight, zero)


def time_share(parameters: Parameters) -> float:
    """The part of 0.05 s that a control step takes."""
    return parameters.control_timestep / REWARD_TIME


def total(terms: dict[str, Array]) -> Array:
    """The sum of reward terms, from the first to the last."""
    return functools.reduce(operator.add, terms.values())
