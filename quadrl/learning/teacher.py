"""A teacher that is told what was drawn: a linear-quadratic regulator for each quadrotor.

Near hover a quadrotor, seen as an X, is four chains: lift, and the ways to the left, ahead and
about z. Each is integrators behind the lag of the rotors and the time until commands arrive. For
each drawn aircraft the regulator minimises the sum of squares of COST over all time to come; its
Riccati equation is solved by doubling (Anderson 1978).
"""

from __future__ import annotations

import math

import numpy as np

from quadrl.aircraft.quadrotor import authority
from quadrl.aircraft.rotors import GRAVITY
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array
from quadrl.control.modes import ShareOfX
from quadrl.core.environment import Environment

MODES = np.array([[1, 1, -1, -1], [1, 1, 1, 1], [1, -1, 1, -1], [1, -1, -1, 1]], float)
"""Which rotors, in the order of `quadrotor.PLACES`, turn faster to go up, left, ahead, and to yaw
counter-clockwise (a column each)."""
STATES = 5
"""Of each chain: offset from the goal [m], velocity [m/s], tilt towards it [rad], its rate [rad/s],
change of the rotor speed from hover, as a share of the largest."""
COST = np.array([[100, 11, 0, 0, 0], [30, 6, 40, 2, 0], [30, 6, 40, 2, 0], [0, 0, 0, 5, 0]], float)
"""Weights of the squares of the states of each chain."""
EFFORT = np.array([100.0, 300.0, 300.0, 400.0])
"""Weights of the squares of the commanded changes of the rotor speed."""
LARGEST = np.array([0.25, 0.25, 0.25, 0.12])
"""Largest changes that are commanded, as shares of the largest speed: where rotors reach their
limits, tilt goes before yaw."""
WHO = "the teacher of algo dagger needs it"
DOUBLINGS = 14
TERMS = 14  # of the series of a matrix exponential


class Teacher:
    """The regulators of N quadrotors, which know what policies have to find out."""

    def __init__(self, environment: Environment) -> None:
        """Take the environment that it teaches in.

        Raises:
            QuadrlError: It lacks the sensor `level`, the control mode share_of_x, or as many past
                actions as can be on their way.
        """
        vehicle, mode = environment.vehicle, environment.control_mode
        sensors = environment.observer.senses.channels if environment.observer else {}
        dead = round(vehicle.dead_time / vehicle.physics_timestep)
        most = dead + environment.randomizer.sampler.delays["command_delay"][1]
        self.late = math.ceil(most / vehicle.substeps)
        """Most actions that can be on their way."""
        history = sensors["action_history"].width // 4 if "action_history" in sensors else 0
        if not isinstance(mode, ShareOfX):
            raise QuadrlError(WHO, name="control_mode", value=mode.name, allowed=ShareOfX.name)
        for name, value, wrong, allowed in (
            ("sensors", [*sensors], "level" not in sensors, "with level"),
            ("action_history", history, history < self.late, f"at least {self.late}"),
        ):
            if wrong:
                raise QuadrlError(WHO, name=name, value=value, allowed=allowed)
        self._environment, self._order = environment, mode.order
        self._dead, count = dead, environment.num_envs
        self._hover = np.zeros((count, 1))  # share of the largest speed
        self._gains = np.zeros((count, 4, STATES + self.late))
        self._known = np.zeros(count, bool)

    def action(self) -> Array:
        """What it would do now, (N, 4), in [-1, 1]."""
        environment, largest = self._environment, self._environment.vehicle.max_speed
        self._known &= environment.randomizer.steps > 0
        if len(rows := np.flatnonzero(~self._known)):
            self._learn(rows)
        seen = environment.observer.again()  # pyright: ignore[reportOptionalMemberAccess]
        up, aim, velocity, rate = np.split(seen["level"], 4, axis=-1)
        speed = (environment.engine.act / largest)[:, self._order]
        turns = ((speed - self._hover) @ MODES / 4).T
        zero = np.zeros(len(up))
        # In the order of MODES, and of the states.
        chains = [
            [-(aim * up).sum(-1), (velocity * up).sum(-1), zero, zero, turns[0]],
            [-aim[:, 1], velocity[:, 1], -up[:, 1], -rate[:, 0], turns[1]],
            [-aim[:, 0], velocity[:, 0], -up[:, 0], rate[:, 1], turns[2]],
            [zero, zero, zero, rate[:, 2], turns[3]],
        ]
        state = np.concatenate([np.moveaxis(np.array(chains), -1, 0), self._on_their_way(seen)], -1)
        command = np.clip(-(self._gains * state).sum(-1), -LARGEST, LARGEST)
        return np.clip(2 * (self._hover + command @ MODES.T) - 1, -1.0, 1.0)

    def _on_their_way(self, seen: dict[str, Array]) -> Array:
        """The changes that the last actions commanded, (N, 4, late), the newest first."""
        past = seen["action_history"].reshape(len(self._hover), -1, 4)[:, : self.late]
        change = ((past + 1) / 2 - self._hover[:, None]) @ MODES / 4
        # Before its first command, an aircraft hovers.
        given = self._environment.randomizer.steps[:, None] > np.arange(self.late)
        return np.swapaxes(np.where(given[..., None], change, 0.0), 1, 2)

    def _learn(self, rows: np.ndarray) -> None:
        """Make the regulators of aircraft (n,) that have begun an episode."""
        environment, vehicle = self._environment, self._environment.vehicle
        begun = environment.engine.begun
        table = begun[rows] if len(begun) > 1 else begun[[0] * len(rows)]
        most = np.exp(authority(table)).reshape(-1, 4, 4).mean(1)  # (n, 4): [g], [rad/s^2]
        hover = 0.5 / np.sqrt(most[:, :1])
        gain = 8 * hover * most * [GRAVITY, 1, 1, 1]  # by four rotors; the square's derivative
        rotor = table["rotor"][:, :4]
        lag = np.exp(np.log([rotor["lag_up"], rotor["lag_down"]]).mean((0, 2)))  # (n,) [1/s]
        delay = environment.randomizer.column("command_delay")[rows] / vehicle.physics_timestep
        late = self._dead + np.rint(delay)
        step = vehicle.physics_timestep, vehicle.substeps
        self._hover[rows], self._known[rows] = hover, True
        self._gains[rows] = regulators(*sampled(gain, lag, late, *step, self.late))


def sampled(
    gain: Array, lag: Array, late: Array, timestep: float, substeps: int, most: int
) -> tuple[Array, Array]:
    """The chains of n aircraft from one control step to the next.

    Args:
        gain: (n, 4) acceleration [m/s^2] or angular acceleration [rad/s^2] of each chain, of a
            change of the rotor speed by its largest.
        lag: (n,) [1/s], inverse time constant of the rotors.
        late: (n,) physics steps until a command arrives.
        timestep: Physics timestep [s].
        substeps: Physics steps in a control step.
        most: Most actions that can be on their way.

    Returns:
        Matrices (n, 4, k, k) and inputs (n, 4, k); k states: STATES, then what the last actions
        commanded, the newest first.
    """
    rates = np.zeros((len(gain), 4, STATES + 1, STATES + 1))  # the last one is the command
    rates[:, :3, 0, 1] = rates[:, 1:3, 2, 3] = 1.0
    rates[:, 1:3, 1, 2] = GRAVITY
    rates[:, 0, 1, 4], rates[:, 1:, 3, 4] = gain[:, 0], gain[:, 1:]
    rates[:, :, 4, 4], rates[:, :, 4, 5] = -lag[:, None], lag[:, None]
    power = flow = np.zeros_like(rates) + np.eye(STATES + 1)
    for k in range(1, TERMS):
        power = power @ rates * (timestep / k)
        flow = flow + power
    moved, pushed = flow[..., :STATES, :STATES], flow[..., :STATES, STATES]
    # What each command gives within a control step, the present one first.
    gives, whole = np.zeros((1 + most, *pushed.shape)), np.zeros_like(moved) + np.eye(STATES)
    for k in range(substeps):
        whole = moved @ whole
        gives = (moved @ gives[..., None])[..., 0]
        ago = np.ceil((late - k) / substeps).clip(0)  # (n,) which command acts
        gives += np.where((ago == np.arange(1 + most)[:, None])[..., None, None], pushed, 0.0)
    size = STATES + most
    matrix, given = np.zeros((len(gain), 4, size, size)), np.zeros((len(gain), 4, size))
    matrix[..., :STATES, :STATES] = whole
    matrix[..., :STATES, STATES:] = np.moveaxis(gives[1:], 0, -1)
    matrix[..., np.arange(STATES + 1, size), np.arange(STATES, size - 1)] = 1.0
    given[..., :STATES] = gives[0]
    given[..., STATES : STATES + 1] = 1.0  # if one can be on its way
    return matrix, given


def regulators(matrix: Array, given: Array) -> Array:
    """Gains (n, 4, k) of the regulators of chains: the command is minus gain times state.

    Args:
        matrix: (n, 4, k, k) from one control step to the next.
        given: (n, 4, k) what a command adds.
    """
    size = matrix.shape[-1]
    cost = np.zeros((4, size, size))
    cost[:, range(STATES), range(STATES)] = COST
    value = np.zeros_like(matrix) + cost
    moved, reach = matrix, given[..., :, None] * given[..., None, :] / EFFORT[:, None, None]
    for _ in range(DOUBLINGS):
        inverse = np.linalg.inv(np.eye(size) + reach @ value)
        back = np.swapaxes(moved, -1, -2)
        value = value + back @ value @ inverse @ moved
        reach = reach + moved @ inverse @ reach @ back
        moved = moved @ inverse @ moved
    weighed = (value @ given[..., None])[..., 0]
    scale = EFFORT + (weighed * given).sum(-1)
    return (weighed[..., None, :] @ matrix)[..., 0, :] / scale[..., None]
