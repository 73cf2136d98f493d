"""Fly aircraft in a simulator that others wrote, in its own Python, where quadrl is not installed.

`quadrl.deploy.simulators` runs this file: `python -I driver.py NAME`. A line of JSON on stdin says
which aircraft, one on stdout what came of it. Then each line on stdin, with rows and seconds, is
followed by their motions (n, 17) and commands (n, 4), and answered by the motions at the end, in
the units and frames of quadrl's engines. Nothing is remembered from call to call.
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import json
import os
import sys
from typing import Any

import numpy as np

RPM = 60.0 / (2.0 * np.pi)  # in a rad/s


class Rotorpy:
    """Its Multirotor: quaternions end with their real part, a lag is a time."""

    def __init__(self, own: str, vehicle: dict[str, Any], brakes: list[float]) -> None:
        """Make its own aircraft of a name or, without one, quadrl's, by the means of its rotors."""
        rotors = {k: np.array([one[k] for one in vehicle["rotors"]]) for k in vehicle["rotors"][0]}
        air, drag = vehicle["aerodynamics"], vehicle["drag_coefficient"]
        if own:
            numbers = importlib.import_module(f"rotorpy.vehicles.{own}_params").quad_params
        else:
            thrust, flap = rotors["thrust_coefficient"].mean(), air["flapping_moment"]
            hover = np.sqrt(vehicle["mass"] * 9.81 / 4 / thrust)
            numbers = {
                "mass": vehicle["mass"],
                **dict(zip(("Ixx", "Iyy", "Izz"), vehicle["inertia"], strict=True)),
                **dict.fromkeys(("Ixy", "Ixz", "Iyz"), 0.0),
                **dict.fromkeys(("c_Dx", "c_Dy", "c_Dz"), drag),
                "num_rotors": 4,
                "rotor_pos": dict(zip("1234", rotors["position"], strict=True)),
                "rotor_directions": -rotors["spin"],  # of the torque on the aircraft
                "rotor_speed_min": 0.0,
                "rotor_speed_max": rotors["max_speed"].mean(),
                "k_eta": thrust,
                "k_m": rotors["torque_coefficient"].mean(),
                "k_d": air["rotor_drag"],
                "k_z": max(0.0, brakes[2] - drag) / (4 * hover),
                # Its moment is nose down in forward flight; in real flights it is nose up.
                "k_flap": -flap * np.array([[1.0], [air["flapping_pitch"]], [0.0]]),
                "tau_m": 2.0 / (rotors["lag_up"] + rotors["lag_down"]).mean(),
            }
        self.flown = importlib.import_module("rotorpy.vehicles.multirotor").Multirotor(numbers)
        self.hover = np.sqrt(numbers["mass"] * 9.81 / 4 / numbers["k_eta"])
        self.order = in_order(rotors["position"], np.array([*numbers["rotor_pos"].values()]))

    def advance(self, motion: np.ndarray, command: np.ndarray, seconds: float) -> np.ndarray:
        """Fly each row that has commands."""
        reached = motion.copy()
        for row in np.flatnonzero(np.isfinite(command).all(axis=1)):
            position, quaternion, velocity, rate, speed = np.split(motion[row], [3, 7, 10, 13])
            there, asked = np.empty(4), np.empty(4)
            there[self.order], asked[self.order] = speed, command[row]
            now = {"x": position, "v": velocity, "q": np.roll(quaternion, -1), "w": rate}
            now |= {"wind": np.zeros(3), "rotor_speeds": there}
            now = self.flown.step(now, {"cmd_motor_speeds": asked}, seconds)
            parts = now["x"], np.roll(now["q"], 1), now["v"], now["w"]
            reached[row] = np.concatenate([*parts, now["rotor_speeds"][self.order]])
        return reached


class Crazyflow:
    """Its Sim: single precision, quaternions end with their real part, rpm, a lag is a rate."""

    def __init__(
        self,
        own: str,
        vehicle: dict[str, Any],
        brakes: list[float],
        course: dict[str, Any] | None = None,
    ) -> None:
        """Take its own aircraft of a name or, without one, quadrl's, by the means of its rotors."""
        self.own, self.vehicle, self.brakes = own, vehicle, brakes
        # At least its own 500 Hz, in whole parts of quadrl's physics step.
        self.frequency = round(
            np.ceil(500 * vehicle["physics_timestep"]) / vehicle["physics_timestep"]
        )
        params = self.made(1).data.params
        _, linear, square = np.ravel(params.rpm2thrust).tolist()
        weight = float(np.ravel(params.mass)[0]) * 9.81 / 4
        self.hover = (np.sqrt(linear**2 + 4 * square * weight) - linear) / (2 * square) / RPM
        mix = np.asarray(params.mixing_matrix)  # its rows are y, -x and the torque
        places = np.array([one["position"] for one in vehicle["rotors"]])
        self.order = in_order(places, np.stack([-mix[1], mix[0]], axis=1))
        self.course = Course(self.made(1).spec, **course) if course else None

    @functools.cache  # noqa: B019 - it lives as long as the process
    def made(self, rows: int) -> Any:
        """The simulation of n aircraft."""
        drone = {"drone": self.own} if self.own else {}
        made = importlib.import_module("crazyflow.sim").Sim(
            n_worlds=rows, control="rotor_vel", freq=self.frequency, **drone
        )
        if not self.own:
            own, every = self.vehicle, self.vehicle["rotors"]
            rotors = {name: np.array([one[name] for one in every]) for name in every[0]}
            x, y, _ = rotors["position"].T
            curve, inertia = np.array([[0.0, 0.0, 1.0]]) / RPM**2, np.diag(own["inertia"])
            numbers = {
                "mass": np.array([own["mass"]]),
                "L": np.ones(1),
                "prop_inertia": np.array([own["aerodynamics"]["rotor_inertia"]]),
                "J": inertia,
                "J_inv": np.linalg.inv(inertia),
                "rpm2thrust": curve * rotors["thrust_coefficient"].mean(),
                "rpm2torque": curve * rotors["torque_coefficient"].mean(),
                "mixing_matrix": np.stack([y, -x, -rotors["spin"]]),
                "drag_matrix": -np.diag(self.brakes),
                "rotor_dyn_coef": np.array(
                    [[rotors["lag_up"].mean(), 0.0, rotors["lag_down"].mean(), 0.0]]
                ),
            }
            array = importlib.import_module("jax.numpy").asarray
            numbers = {name: array(value) for name, value in numbers.items()}
            made.data = made.data.replace(params=made.data.params.replace(**numbers))
            made.step_pipeline.pop("clip_rotor_vel_cmd")  # to the limits of another aircraft
            made._step = made.build_step_fn()
        return made

    def advance(self, motion: np.ndarray, command: np.ndarray, seconds: float) -> np.ndarray:
        """Fly all rows, what touches the course to NaN; without commands it does not matter."""
        sim, array = self.made(len(motion)), importlib.import_module("jax.numpy").asarray
        place, quaternion, velocity, rate, speed = np.split(motion, [3, 7, 10, 13], axis=1)
        there, asked = np.empty_like(speed), np.empty_like(speed)
        there[:, self.order], asked[:, self.order] = speed * RPM, np.nan_to_num(command) * RPM
        parts = {"pos": place, "quat": np.roll(quaternion, -1, axis=1), "vel": velocity}
        parts |= {"ang_vel": rate, "rotor_vel": there}
        parts = {name: array(part[:, None], dtype="float32") for name, part in parts.items()}
        sim.data = sim.data.replace(states=sim.data.states.replace(**parts))
        sim.rotor_vel_control(array(asked[:, None], dtype="float32"))
        steps = round(seconds * self.frequency)
        flies = np.isfinite(command[:, 0])
        for _ in range(steps if self.course else 1):
            sim.step(1 if self.course else steps)
            now = sim.data.states
            found = now.pos, np.roll(now.quat, 1, axis=2), now.vel, now.ang_vel, now.rotor_vel
            *parts, speed = (np.asarray(part, float)[:, 0] for part in found)
            if self.course:
                flies = self.course.free(flies, *parts[:2])
        reached = np.concatenate([*parts, speed[:, self.order] / RPM], axis=1)
        return np.where(flies[:, None], reached, np.nan) if self.course else reached


class Course:
    """Gates and poles in crazyflow's scene, and its aircraft's box, which must not touch them."""

    def __init__(self, spec: Any, shapes: list[Any], places: list[Any]) -> None:
        """Build it.

        Args:
            spec: The scene.
            shapes: Name and size of each solid, as MuJoCo has them.
            places: Position and quaternion (7,) of each, a list for each race.
        """
        self.mujoco = importlib.import_module("mujoco")
        made, self.places = spec.copy(), np.array(places)
        for k, (shape, size) in enumerate(shapes):
            body = made.worldbody.add_body(name=f"course{k}", mocap=True)
            body.add_geom(type=getattr(self.mujoco.mjtGeom, f"mjGEOM_{shape.upper()}"), size=size)
        self.model = made.compile()
        self.data = self.mujoco.MjData(self.model)
        solids = [self.model.body(f"course{k}") for k in range(len(shapes))]
        self.solids = [int(body.geomadr[0]) for body in solids]
        self.placed = [int(body.mocapid[0]) for body in solids]
        names = (self.model.geom(k).name for k in range(self.model.ngeom))
        self.box = next(name for name in names if name.startswith("col_box"))
        self.drone = int(self.model.body(self.model.geom(self.box).bodyid[0]).mocapid[0])

    def free(self, flies: np.ndarray, position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
        """Which of the aircraft (n,) that fly touch nothing, with their poses (n, 3), (n, 4)."""
        found, box = flies.copy(), self.model.geom(self.box).id
        for row in np.flatnonzero(flies):
            self.data.mocap_pos[self.placed] = self.places[row, :, :3]
            self.data.mocap_quat[self.placed] = self.places[row, :, 3:]
            self.data.mocap_pos[self.drone] = position[row]
            self.data.mocap_quat[self.drone] = quaternion[row]
            self.mujoco.mj_kinematics(self.model, self.data)
            away = np.linalg.norm(self.data.geom_xpos[self.solids] - position[row], axis=1)
            near = away < self.model.geom_rbound[self.solids] + 0.2
            found[row] = not any(
                self.mujoco.mj_geomDistance(self.model, self.data, box, geom, 0.1, None) < 0
                for geom in np.array(self.solids)[near]
            )
        return found


def in_order(wanted: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Which of the simulator's rotors (4, 2) stands in the direction of each of quadrl's (4, 2)."""
    one, other = (x[:, :2] / np.linalg.norm(x[:, :2], axis=1)[:, None] for x in (wanted, found))
    return np.argmax(one @ other.T, axis=1)


def main(name: str) -> None:
    """Answer until stdin ends."""
    given, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the simulator prints is no answer
    kinds: dict[str, Any] = {"rotorpy": Rotorpy, "crazyflow": Crazyflow}
    flies = kinds[name](**json.loads(given.readline()))
    known = {"version": importlib.metadata.version(name), "hover": float(flies.hover)}
    answers.write(json.dumps(known).encode() + b"\n")
    answers.flush()
    while line := given.readline():
        rows, seconds = json.loads(line)
        both = (given.read(8 * rows * width) for width in (17, 4))
        motion, command = (np.frombuffer(part).reshape(rows, -1) for part in both)
        answers.write(np.ascontiguousarray(flies.advance(motion, command, seconds)).tobytes())
        answers.flush()


if __name__ == "__main__":
    main(sys.argv[1])
