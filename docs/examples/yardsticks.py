"""Two controllers that know as much as the policies of `trajectory` and `recovery`, beside them.

    python docs/examples/yardsticks.py

`Preview` is the linear-quadratic regulator with the ten places ahead that a policy of `trajectory`
sees. `TurnOver` is the geometric controller with an attitude error by angle and axis, for any tilt.
Their settings were found in other episodes than those that are flown here.
"""

from dataclasses import dataclass

import numpy as np
import tyro

from quadrl.aircraft.rotors import GRAVITY
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.rotation import Array, norm, to_body, to_world
from quadrl.base.units import length, percent
from quadrl.control import Gains, GeometricController, LQRController, Weights
from quadrl.control.allocation import columns, product
from quadrl.control.loops import limited
from quadrl.control.lqr import STATES
from quadrl.control.reading import Reading
from quadrl.core.task import Task
from quadrl.evaluation.in_flight import scenario_of
from quadrl.evaluation.policy import Policy
from quadrl.evaluation.rollout import fly, summarize
from quadrl.tasks.trajectory import AHEAD, EVERY

FIGURES = ("pentagram", "zigzag", "lemniscate")
HEIGHTS = (3.0, 1.5)  # [m], of the start of a recovery


@dataclass
class Args:
    """How much is flown."""

    episodes: int = 300
    """Flights of each row."""
    seed: int = 100_300
    """First seed of the episodes."""


class Preview(LQRController):
    """The regulator around hover, with the cost of what is ahead in its command.

    With the cost (x - r)' q (x - r) + a' a and the references r(1), r(2), ... ahead of the state x
    the best action is -gain x + w s(1), with s(k) = q r(k) + (a - b gain)' s(k + 1) and
    w = (r + b' p b)^-1 b' (Anderson and Moore, "Optimal Control", chapter 4). After the last place
    the reference rests.
    """

    def __init__(self, vehicle: Vehicle, task: Task, weights: Weights | None = None) -> None:
        """Sum up what each place ahead adds to the action, with straight lines between them."""
        # Where the reference goes is known, so no speed is to be kept.
        weights = weights or Weights(position=0.05, velocity=1e3, tilt=0.6, body_rate=2.0)
        super().__init__(vehicle, task, weights)
        steps, position = round(EVERY / vehicle.control_timestep), STATES["position"]
        share = np.linalg.solve(self.r + self.b.T @ self.p @ self.b, self.b.T)
        places = np.zeros((AHEAD + 2, vehicle.rotor_count, 3))  # from now on; the last stays empty
        for step in range(1, AHEAD * steps + 1):
            cost = self.p if step == AHEAD * steps else self.q
            place, rest = divmod(step, steps)
            places[place] += (1 - rest / steps) * (share @ cost)[:, position]
            places[place + 1] += rest / steps * (share @ cost)[:, position]
            share = share @ (self.a - self.b @ self.gain).T
        slope = 2 * vehicle.hover_speed * vehicle.action_scale
        self.forward = (vehicle.mixer * slope) @ np.hstack(places[: AHEAD + 1])

    def __call__(self, observation: Array) -> Array:
        """The feedback of the motion, and what the places ahead add; they end the observation."""
        reading = Reading.of(np.asarray(observation, float), self.task.observation, self.vehicle)
        ahead = np.asarray(observation, float)[:, -3 * AHEAD :]
        ahead = [to_world(reading.rotation, place) for place in np.split(ahead, AHEAD, axis=1)]
        # The model's x and y lie along the heading, which stays near east.
        up, heading = reading.rotation[:, :, 2], reading.heading
        state = columns(
            0 * reading.velocity,
            reading.velocity,
            np.stack([-up[:, 1], up[:, 0], heading[:, 1]], axis=1),
            reading.body_rate,
            reading.rotor_speed - self.vehicle.hover_speed,
        )
        added = product(self.forward, columns(reading.to_goal, *ahead))
        return self._allocation.mix(product(self._feedback, state) + added)


class TurnOver(GeometricController):
    """The geometric controller with an attitude error that grows up to upside down.

    Its own falls again beyond 90 degrees, as the sine of the angle. Here body z turns towards the
    wanted force by the shortest way, at a rate from which it can stop, without thrust as long as
    that would push the wrong way.
    """

    # Of 172 drawn settings the one with most recoveries from 1.5 m, in 60 flights.
    speed_gain = np.array([2.8, 2.8, 6.6])  # [1/s]
    sideways, climb, sink = 3.2, 9.0, 6.9  # [m/s^2], largest accelerations asked for
    turn_gain = 6.4  # [1/s]
    brake = 0.26  # share of the largest angular acceleration that stops the turn
    gains = Gains(level=0.95, authority=1.0, max_speed=1.3)

    def __init__(self, vehicle: Vehicle, task: Task) -> None:
        """Take the gains of the loops within."""
        super().__init__(vehicle, task, self.gains)

    def action(self, reading: Reading, offset: Array, velocity: Array) -> Array:
        """From the error of the velocity to a force, to a body rate and a thrust, to the rotors."""
        loops, vehicle = self._loops, self.vehicle
        velocity = velocity + loops.approach_velocity(offset, self.gains.max_speed)
        wanted = self.speed_gain * (velocity - reading.velocity)
        level = limited(wanted[:, :2], self.sideways)
        force = columns(level, np.clip(wanted[:, 2:], -self.sink, self.climb) + GRAVITY)
        force = to_body(reading.rotation, force)
        up = force / norm(force)[:, None]
        axis = np.stack([-up[:, 1], up[:, 0], 0 * up[:, 0]], axis=1)
        axis = axis / np.maximum(norm(axis), 1e-9)[:, None]
        angle = np.arccos(np.clip(up[:, 2:], -1, 1))
        stopping = 2 * self.brake * loops._angular_acceleration[:2].min() * angle
        rate = axis * np.minimum(self.turn_gain * angle, np.sqrt(stopping))
        thrust = vehicle.mass * np.maximum(force[:, 2:], 0.0)
        command = loops.body_rate_command(reading, thrust, rate)
        return np.clip((command - vehicle.hover_speed) / vehicle.action_scale, -1.0, 1.0)


def main(args: Args) -> None:
    """Print a row for each figure and each height: the policy, then the controller."""
    for task, controller, options in (
        *(("trajectory", Preview, {"figure": figure}) for figure in FIGURES),
        *(("recovery", TurnOver, {"lowest": height, "highest": height}) for height in HEIGHTS),
    ):
        policy = Policy.pretrained(task)
        scenario = scenario_of(policy, engine="free_flight", task_options=options)
        flyers = {"policy": policy, "controller": controller(scenario.aircraft, scenario.task)}
        for name, flies in flyers.items():
            found = summarize(fly(flies, scenario, episodes=args.episodes, seed=args.seed))
            settled = f", {length(found['settled_m'])} settled" if task == "trajectory" else ""
            what = " ".join(f"{k}={x}" for k, x in options.items())
            print(f"{task} {what}, {name}: {percent(found['success_rate'])} successful{settled}")


if __name__ == "__main__":
    main(tyro.cli(Args))
