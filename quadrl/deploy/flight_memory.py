"""The memory of one flight in the browser: an array of doubles, whose parts C and JavaScript know.

The functions that `quadrl.deploy.flights` writes read it, and so do the kernels of free flight, of
the state, of solids and of rays.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from quadrl.aircraft.parameters import AIR, PLACES, ROW_SIZE, Parameters
from quadrl.aircraft.vehicle import MAX_ROTORS
from quadrl.base import records
from quadrl.base.rotation import Array
from quadrl.base.trace import Trace
from quadrl.conditions.sensor import Moment
from quadrl.conditions.targets import Aim
from quadrl.conditions.world import World
from quadrl.core.environment import Environment
from quadrl.core.snapshot import Snapshot
from quadrl.core.transition import Observation
from quadrl.engines.solids import NEARBY, SOLID
from quadrl.engines.state import FIRST, State

MAX_SOLIDS, MAX_RAYS, MAX_BALLS = 48, 64, 32
PARTS = {
    "parameters": ROW_SIZE,  # the aircraft's row, as it is specified
    "flown": ROW_SIZE,  # the one that flies: the same, with what happens to it
    "limits": 2,  # its largest speed [m/s] and spin [rad/s]: as in `Rows` of state.c
    "world": 4,  # physics step [s], gravity along z [m/s^2], floor and reach [m]: `World` of C
    "origin": 3,  # of the task's frame [m], world
    "drawn": 256,  # random numbers of the start, or of the solids
    "qpos": 7,
    "qvel": 6,
    "act": MAX_ROTORS,
    "ctrl": MAX_ROTORS,
    "warm": 6,
    "wind": AIR,
    "ceiling": MAX_ROTORS,  # largest commands [rad/s]
    "state": FIRST["rotor_speed"] + MAX_ROTORS,  # as native/state.c fills it
    "kept": 64,  # what the task remembers, the distances, how far the episode is
    "action": MAX_ROTORS,
    "diverged": 1,
    "commanded": MAX_ROTORS,  # mean commands of the last control step [rad/s]
    "observation": 96,
    "scale": 1,  # of actions [rad/s]: Vehicle.action_scale, or that of a policy's training
    "moving": 6,  # as quadrl.conditions.sensors.moving gives it
    "disturbance": 3,  # [m/s^2], world frame
    "felt": 3,  # the same in the body frame, as policies see it
    "share": 1,  # of a change in it that a control step shows, as Disturbance.share
    "modelled": MAX_ROTORS,  # rotor speeds that are seen [rad/s]: true, or following the commands
    "aim_sum": 3,  # what quadrl.conditions.targets.Aim remembers [m], world frame
    "aim": 3,  # what it gives [m], body frame
    "given": 8,  # error [m], reward, goal (3) [m, world], terminated, truncated, is_success
    "keys": 1,  # of the random numbers, an int64 each
    "episodes": 1,
    "near": 1,  # a byte: as in `Rows` of free_flight.c
    "solids": MAX_SOLIDS * SOLID.itemsize // 8,
    "nearby": NEARBY.itemsize // 8,  # those near by
    "clearance": 1,  # [m], least distance from a solid
    "ranges": MAX_RAYS,  # distances along rays [m]
    "setpoint": 8,  # of the loops of a control mode
    "outline": 5 * MAX_BALLS,  # balls about the aircraft: `Ball` of solids.c
    "along": 3 * MAX_RAYS,  # directions of rays
    "eye": 4,  # where they begin (3) [m], body frame, and how far they reach [m]
    "flight_rows": 10,  # that `Rows`, for pointers of 32 bits
    "state_rows": 8,  # `Rows` of state.c
    "solid_rows": 5,  # `Rows` of solids.c
    "finder": 7,  # `Finder` of rays.c
}
"""Numbers in each part of a flight's memory."""
LAYOUT = dict(zip(PARTS, np.cumsum([0, *PARTS.values()]).tolist(), strict=False))
"""Where each part begins."""
SIZE = sum(PARTS.values())


class FlightMemory:
    """The memory of one flight, as symbols of a trace."""

    def __init__(self, environment: Environment) -> None:
        """Begin a trace."""
        # Compiled once for all visitors: no number of operations is too large.
        self.trace = Trace(max_operations=math.inf)
        self._rotors = environment.vehicle.rotor_count
        self._timestep = environment.vehicle.control_timestep

    def read(self, part: str, numbers: Array | int, place: str = "m[{}]") -> Array:
        """Symbols of the numbers of a part, by their places in it; a count reads (1, count)."""
        numbers = np.arange(numbers)[None] if isinstance(numbers, int) else numbers
        return self.trace.read(place, numbers + LAYOUT[part])

    def parameters(self) -> Parameters:
        """The aircraft's row; each number says where it stands."""
        own = Parameters.of(PLACES, self._timestep, self._rotors)
        return own.map(lambda numbers: self.read("parameters", numbers))

    def state(self) -> State:
        """The state that native/state.c fills."""
        places = State.of_table(np.arange(FIRST["rotor_speed"] + self._rotors)[:, None])
        return records.mapped(lambda numbers: self.read("state", numbers), places)

    def estimate(self) -> State:
        """The same state with the rotor speeds that are observed."""
        seen = self.read("modelled", self._rotors)
        return dataclasses.replace(self.state(), rotor_speed=seen)

    def world(self, environment: Environment) -> World | None:
        """The solids and the ground about the aircraft, as they are measured."""
        scene = environment.scene
        if not (scene.solids or scene.rays):
            return None
        clear, first = self.read("clearance", 1)[:, 0], 0
        parts: list[Array] = [np.zeros((1, 0))]
        for rays in scene.rays.values():
            distance = self.read("ranges", np.arange(first, first + rays.count)[None])
            parts.append(rays.sharp.read(distance, 0.0, distance[:, :0]))
            first += rays.count
        about = scene.nothing_near(1)
        return dataclasses.replace(about, clearance=clear, rays=np.concatenate(parts, axis=1))

    def aim(self, now: Snapshot, seen: Observation, *, begins: bool) -> dict[str, Any]:
        """What the sensor "aim" remembers and gives with an observation."""
        state, sensor = now.state, Aim()
        # Of all that sensors may read, this one reads these.
        given = {"state": state, "wind": self.read("wind", 3), "parameters": now.parameters}
        given |= {"estimated": seen, "memory": {"sum": self.read("aim_sum", 3)}}
        rest: Any = dict.fromkeys(field.name for field in dataclasses.fields(Moment))
        moment = Moment(**rest | given)
        moment.memory = sensor.begin(moment) if begins else sensor.update(moment)
        return {"aim_sum": moment.memory["sum"], "aim": sensor.sense(moment)}

    def kept(self, *like: Any) -> list[Any]:
        """Records of the same shapes as the given ones, read from `kept` one after the other."""
        columns = records.Columns(0, [array for one in like for array in records.leaves(one)])
        places = iter(columns.views(np.arange(columns.end)[:, None]))
        placed = [records.filled(record, places) for record in like]
        found = [records.mapped(lambda numbers: self.read("kept", numbers), one) for one in placed]
        return [*found, self.read("kept", np.array([columns.end]))]
