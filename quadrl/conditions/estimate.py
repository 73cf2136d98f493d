"""The state estimate: what is known on board of position, attitude, motion and rotor speeds."""

from __future__ import annotations

import numpy as np

from quadrl.aircraft import parameters
from quadrl.base.philox import NOISE
from quadrl.base.rotation import Array
from quadrl.conditions.randomization import NONE
from quadrl.conditions.randomizer import Randomizer
from quadrl.engines import native
from quadrl.engines.engine import Engine, Frame
from quadrl.engines.state import State


class StateEstimate:
    """The estimated state of N aircraft, with the noise and the bias of the randomization.

    Everything that is observed of the state follows from this one estimate.
    """

    def __init__(self, engine: Engine, randomizer: Randomizer, *, modelled: bool) -> None:
        """Set up the tables.

        Args:
            engine: Flies the aircraft.
            randomizer: Of those aircraft.
            modelled: Whether the rotor speeds follow from the commands with the specified lag,
                instead of being measured.
        """
        self._engine, self._randomizer, self._modelled = engine, randomizer, modelled
        given, vehicle = randomizer.sampler.randomization, engine.vehicle
        count, rotors = engine.ctrl.shape
        self._noise, self._noisy = given.noise.sizes, given.noise != NONE.noise
        self._lags = np.array([[r.lag_up, r.lag_down] for r in vehicle.rotors]).T  # [1/s]
        self.rotor_speed = np.zeros((count, rotors))
        """By the model (N, R) [rad/s]."""
        self.frame = Frame(count, rotors)
        """Table of the estimated state."""
        self._coordinates = np.zeros((count, 13 + rotors))
        self._limits = parameters.limits(parameters.rows(vehicle))
        self._library = native.library()
        first = self._coordinates.ctypes.data
        places = [first, first + 7 * 8, first + 13 * 8, engine.origin.ctypes.data]
        places += [self._limits.ctypes.data, engine.air.ctypes.data]
        places += [self._coordinates.shape[1], 0, self.frame.columns, rotors]
        self._state_rows = np.array(places)  # as `Rows` in native/state.c

    def begin(self, rows: np.ndarray) -> State:
        """The first estimate of episodes (n,)."""
        self.rotor_speed[rows] = self._engine.act[rows]
        return self._fill(rows)

    def follow(self, command: Array, seconds: float) -> None:
        """Let the modelled rotor speeds follow commands (N, R) [rad/s] for a time [s]."""
        if self._modelled:
            goal = np.minimum(command, self._engine.vehicle.max_speed)
            up, down = 1 - np.exp(-seconds * self._lags)
            speed = self.rotor_speed
            speed += np.where(goal > speed, up, down) * (goal - speed)

    def update(self) -> State:
        """The estimate after a control step."""
        return self._fill(None)

    def _fill(self, rows: np.ndarray | None) -> State:
        """Estimate the state of some aircraft (n,), or of all."""
        source, own, engine = self._randomizer, self._coordinates, self._engine
        ids, count = (None, len(own)) if rows is None else (rows.ctypes.data, len(rows))
        speed = self.rotor_speed if self._modelled else engine.act
        bias = source.sampler.columns(source.drawn, "position_bias_x", 12)
        arrays = (*source.place, source.steps, engine.qpos, engine.qvel, speed, self._noise, bias)
        strided = (engine.qpos, speed, bias, own)
        # As `Rows` in native/disturbances.c.
        where = np.array(
            [*(array.ctypes.data for array in (*arrays, own)),
             *(array.strides[0] // 8 for array in strided), speed.shape[1], self._noisy, NOISE]
        )  # fmt: skip
        self._library.quadrl_estimate(where.ctypes.data, count, ids)
        self._library.quadrl_state(self._state_rows.ctypes.data, count, ids, self.frame.address)
        return self.frame.state if rows is None else State.of_table(self.frame.table[:, rows])
