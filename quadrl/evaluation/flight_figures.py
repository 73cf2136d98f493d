"""Figures of flights, in space and over time, in the manner of the paper's figures 6 and 7."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure

from quadrl.base.rotation import roll_pitch_yaw
from quadrl.core.snapshot import Rollout
from quadrl.evaluation.plotting import BLACK, COLOURS, GREY, LEAST_ERROR, head, styled, tidy

PLACE, MOTION = (
    ("x east [m]", "y north [m]", "z up [m]"),
    ("roll [deg]", "pitch [deg]", "yaw [deg]"),
)


@styled
def trajectory(rollout: Rollout, title: str) -> Figure:
    """Flights in space and over time; figure 6 of the paper, and what led to it.

    Each flight has a colour. Goals are dashed: black where all flights have the same one that
    stays, else each in the colour of its flight. Flights in wind show it, and the airspeed. At most
    as many flights are drawn as there are COLOURS.
    """
    shown = min(len(COLOURS), rollout.position.shape[1])
    goals = rollout.goal[:, :shown]
    shared = bool(np.all(np.isnan(goals) | (np.abs(goals - goals[:1, :1]) < 1e-9)))
    figure = Figure(figsize=(14.0, 9.6), layout="constrained")
    upper, lower = cast(Any, figure.subfigures(2, 1, height_ratios=(1.75, 1)))
    left, right = _quantities(rollout, shown)
    grid = upper.add_gridspec(len(left), 3, width_ratios=(1.35, 1, 1))
    _space(upper.add_subplot(grid[:, 0], projection="3d"), rollout, goals, shared)
    for n, values in enumerate((left, right)):
        axes = [upper.add_subplot(grid[k, n + 1]) for k in range(len(values))]
        for axis, (name, value) in zip(axes, values.items(), strict=True):
            _flights(axis, rollout, value)
            axis.set_ylabel(name)
            axis.tick_params(labelbottom=axis is axes[-1])
            if name in PLACE:
                goal = goals[..., PLACE.index(name)]
                dashed = {"lw": 1.0, "ls": "--"} | ({"color": BLACK} if shared else {})
                _flights(axis, rollout, goal[:, :1] if shared else goal, **dashed)
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_yscale("linear" if n else "log")  # the error
        upper.align_ylabels(axes)
    _commands(lower, rollout, shown)
    head(figure, title)
    return figure


def _quantities(rollout: Rollout, shown: int) -> tuple[dict[str, np.ndarray], ...]:
    """Values (S or T, n) over time by their labels: place, wind and error; attitude and speeds."""
    wind, velocity = rollout.wind[:, :shown], rollout.velocity[:, :shown]
    windy = bool(np.nan_to_num(wind).any())
    roll, pitch, yaw = np.moveaxis(roll_pitch_yaw(rollout.quaternion[:, :shown]), -1, 0)
    attitude = np.degrees([roll, pitch, np.unwrap(yaw, axis=0)])
    left = {name: rollout.position[:, :shown, k] for k, name in enumerate(PLACE)}
    right = dict(zip(MOTION, attitude, strict=True))
    if windy:
        left["wind [m/s]"] = np.linalg.norm(wind, axis=-1)
        right["airspeed [m/s]"] = np.linalg.norm(velocity[1:] - wind, axis=-1)
    left["error [m]"] = np.maximum(rollout.error[:, :shown], LEAST_ERROR)
    right["speed [m/s]"] = np.linalg.norm(velocity, axis=-1)
    return left, right


def _flights(axis: Any, rollout: Rollout, values: np.ndarray, **style: Any) -> None:
    """Draw values of states (S, n) or of steps (T, n) over time, a colour each."""
    first = len(rollout.position) - len(values)
    time = np.arange(first, len(rollout.position)) * rollout.control_timestep
    for value, colour in zip(values.T, COLOURS, strict=False):
        axis.plot(time, value, **({"color": colour, "lw": 1.2, "alpha": 0.85} | style))
    tidy(axis)


def _space(space: Any, rollout: Rollout, goals: np.ndarray, shared: bool) -> None:
    """Draw the paths of flights and their goals (S, n, 3) in space."""
    for i, colour in zip(range(goals.shape[1]), COLOURS, strict=False):
        flown, goal = (path[: rollout.length[i] + 1, i] for path in (rollout.position, goals))
        ended = "successful" if rollout.is_success[i] else "not successful"
        space.plot(*flown.T, color=colour, lw=1.4, alpha=0.9, label=f"flight {i + 1}, {ended}")
        space.scatter(*flown[:1].T, color=colour, s=18, marker="o")
        if not shared:
            space.plot(*goal.T, color=colour, lw=1.0, ls="--", alpha=0.8)
        if not shared or i == 0:
            mark = BLACK if shared else colour
            space.scatter(*goal[-1:].T, color=mark, marker="*", s=110, label=None)
    dashes, words = (BLACK, "goal") if shared else (GREY, "goal of each flight")
    space.plot([], [], [], color=dashes, lw=1.0, ls="--", marker="*", ms=9, label=words)
    space.set(xlabel=PLACE[0], ylabel=PLACE[1], box_aspect=(1, 1, 1))
    space.set_zlabel(PLACE[2], labelpad=-30)  # inside, clear of the next axes
    space.set_aspect("equal", adjustable="datalim")
    space.legend(frameon=False, loc="upper left", fontsize=8, ncols=2, bbox_to_anchor=(0, 1.07))


def _commands(lower: Any, rollout: Rollout, shown: int) -> None:
    """Draw rotor speeds over actions, a column for each."""
    parts = ("rotor", rollout.rotor_speed), ("action", rollout.action)
    many = max(value.shape[-1] for _, value in parts)
    rows: Any = lower.subplots(2, many, sharex=True, sharey="row", squeeze=False)
    for axes, (name, value) in zip(rows, parts, strict=True):
        for k, axis in enumerate(axes):
            axis.set_visible(k < value.shape[-1])
            if k < value.shape[-1]:
                _flights(axis, rollout, value[:, :shown, k], lw=0.9)
                axis.set_title(f"{name} {k + 1}", loc="left", fontsize=9)
    rows[0][0].set_ylabel("speed [rad/s]")
    rows[1][0].set(ylabel="action", ylim=(-1.05, 1.05))
    for axis in rows[1]:
        axis.set_xlabel("time [s]")
