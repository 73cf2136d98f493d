"""Fly a controller through fresh episodes, calm or in gusts, and judge it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.signal import lfilter, welch

from quadrl.environment import Environment
from quadrl.state import State
from quadrl.task import OptionError, Task
from quadrl.vehicle import Vehicle

if TYPE_CHECKING:
    from quadrl.rendering import Flight

Controller = Callable[[np.ndarray], np.ndarray]
"""Flat observations (N, size) float32 to actions (N, 4); its attribute `action` names the interface
that they are for."""

EVALUATION_SEED = 2_000_000_000
"""Beyond the seeds of every training (1000 * 2**20), so that evaluation episodes are fresh ones."""
FINAL_STRETCH = 2.0  # [s], over which position_error_m is the mean
GUST_TIME = 1.0  # [s], correlation time of the gusts
SEGMENT = 40  # control steps in a segment of a spectrum
WOBBLE_HZ = 2.0  # body rates above it are wobble, not flight: a position loop is slower


@dataclasses.dataclass(frozen=True)
class Record:
    """Flights step by step, of the N aircraft of an evaluation; T steps are the horizon.

    What follows the end of an aircraft's episode is not a number.
    """

    position: np.ndarray  # (T, N, 3) [m], world, from the origin of the task's frame
    quaternion: np.ndarray  # (T, N, 4) (w, x, y, z)
    velocity: np.ndarray  # (T, N, 3) [m/s], world
    body_rate: np.ndarray  # (T, N, 3) [rad/s], body
    rotor_speed: np.ndarray  # (T, N, 4) [rad/s]
    goal: np.ndarray  # (T, N, 3) [m], task frame
    action: np.ndarray  # (T, N, 4), within [-1, 1]
    error: np.ndarray  # (T, N) [m]
    reward: np.ndarray  # (T, N)
    length: np.ndarray  # (N,) steps of each episode
    terminated: np.ndarray  # (N,) bool
    is_success: np.ndarray  # (N,) bool
    diverged: np.ndarray  # (N,) bool
    markers: tuple[Any, ...]  # (T,) of what the task asks to be drawn, of the first aircraft
    control_step: float  # [s]
    task: Task

    def flight(self, vehicle: Vehicle, episode: int = 0) -> Flight:
        """One aircraft's flight, to be drawn."""
        from quadrl.rendering import Flight

        steps = slice(0, int(self.length[episode]))
        origin = np.array([0.0, 0.0, self.task.origin_height(vehicle)])
        position = self.position[steps, episode] + origin
        return Flight(
            time=np.arange(1, len(position) + 1) * self.control_step,
            qpos=np.concatenate([position, self.quaternion[steps, episode]], axis=1),
            rotor_speed=self.rotor_speed[steps, episode],
            error=self.error[steps, episode],
            reward=self.reward[steps, episode],
            goal=self.goal[steps, episode] + origin,
            control_step=self.control_step,
            max_rotor_speed=vehicle.max_speed,
            task=self.task.name,
            markers=self.markers[steps],
        )


def fly(
    controller: Controller,
    task: str | Task,
    *,
    episodes: int,
    seed: int = EVALUATION_SEED,
    vehicle: Vehicle | None = None,
    action: str | None = None,
    gusts: float = 0.0,
) -> Record:
    """One episode of each of N aircraft.

    Args:
        controller: A `Policy`, or any function of observations.
        task: A name of the catalogue or a task.
        episodes: N.
        seed: Aircraft i is seeded with seed + i.
        vehicle: The aircraft; None for the paper's.
        action: What actions mean; None for what the controller says, or "rotor".
        gusts: Standard deviation of the wind in each direction [m/s]; see `make_gusts`. The
            aircraft does not see it, and each flies in one of its own, which its seed gives.

    Raises:
        OptionError: The controller's actions are for another interface, or the gusts are no speed.
    """
    own = getattr(controller, "action", None)
    if None not in (action, own) and action != own:
        raise OptionError(
            f"{type(controller).__name__} gives actions for the interface {own!r}, not for "
            f"{action!r}: fly it with action={own!r}"
        )
    environment = Environment(
        task, num_envs=episodes, seed=seed, vehicle=vehicle, action=action or own or "rotor"
    )
    observation = environment.flatten(environment.reset())
    winds = _wind(environment, gusts, seed) if gusts else None
    names = [f.name for f in dataclasses.fields(Record)][:9]
    history: dict[str, list[np.ndarray]] = {name: [] for name in names}
    alive = np.ones(episodes, dtype=bool)
    length = np.zeros(episodes, dtype=int)
    ends = {name: np.zeros(episodes, bool) for name in ("terminated", "is_success", "diverged")}
    fields, drawn, markers = None, (), []
    while alive.any() and len(history["error"]) < environment.horizon_steps:
        taken = np.clip(controller(observation), -1.0, 1.0)
        if winds is not None:
            environment.simulation.wind[:] = winds[len(history["error"])]
        now = environment.step(taken)
        observation = environment.flatten(now.observation)
        state: State = environment.simulation.state
        if environment.fields is not fields:  # else nothing has changed
            fields, drawn = environment.fields, environment.markers()
        markers.append(drawn)
        goal = environment.task.goal(state, environment.fields)
        moment = {"goal": goal, "action": taken, "error": now.error, "reward": now.reward}
        for name in names:
            value = np.array(moment[name] if name in moment else getattr(state, name), dtype=float)
            value[~alive] = np.nan
            history[name].append(value)
        length += alive
        for name, flag in ends.items():
            flag |= alive & getattr(now, name)
        alive &= ~(now.terminated | now.truncated)
    return Record(
        **{name: np.stack(values) for name, values in history.items()},
        length=length,
        **ends,
        markers=tuple(markers),
        control_step=environment.vehicle.control_step,
        task=environment.task,
    )


def make_gusts(
    deviation: float, steps: int, control_step: float, seed: int | Sequence[int]
) -> np.ndarray:
    """Wind (steps, 3) [m/s], world: three processes of Ornstein and Uhlenbeck without a mean.

    The spectrum is that of the longitudinal gusts of Dryden's model (MIL-F-8785C, 3.7.2.2) with
    `GUST_TIME` for length over airspeed, in every direction.

    Args:
        deviation: Of each component, at any time [m/s].
        steps: Control steps.
        control_step: [s].
        seed: Of the noise.
    """
    keep = np.exp(-control_step / GUST_TIME)
    noise = np.random.default_rng(seed).normal(size=(steps, 3))
    noise[1:] *= np.sqrt(1 - keep**2)  # the first is drawn from the distribution itself
    return deviation * np.asarray(lfilter([1.0], [1.0, -keep], noise, axis=0))


def _wind(environment: Environment, deviation: float, seed: int) -> np.ndarray:
    """The wind of each control step for each aircraft of a batch, (steps, N, 3) [m/s]."""
    if not (deviation >= 0 and np.isfinite(deviation)):
        raise OptionError(f"gusts = {deviation}: a speed in m/s, at least 0, is allowed")
    settings = (deviation, environment.horizon_steps, environment.vehicle.control_step)
    # Other streams than those of the episodes, which have one word of entropy.
    each = [make_gusts(*settings, seed=[seed + i, 1]) for i in range(environment.num_envs)]
    return np.stack(each, axis=1)


def judge(record: Record) -> dict[str, Any]:
    """The figures of an evaluation.

    Returns:
        episodes; success_rate and survival_rate (shares); position_error_m and
        position_error_std_m: mean, and deviation over the episodes, of the error over the last 2 s
        [m]; where the heading matters heading_error_deg: mean of |yaw| over the same time;
        return_mean and return_std; length_mean_s; diverged; and the task's own.
    """
    steps = max(1, round(FINAL_STRETCH / record.control_step))
    number = np.arange(len(record.error))[:, None]
    last = (number >= record.length - steps) & (number < record.length)
    final = _means(record.error, last)
    returns = np.nansum(record.reward, 0)
    w, x, y, z = np.moveaxis(record.quaternion, -1, 0)
    yaw = np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)))
    heading = {"heading_error_deg": float(_means(np.abs(yaw), last).mean())}
    return {
        "episodes": int(len(returns)),
        "success_rate": float(record.is_success.mean()),
        "survival_rate": float(1 - (record.terminated & ~record.is_success).mean()),
        "position_error_m": float(final.mean()),
        "position_error_std_m": float(final.std()),
        **(heading if record.task.heading_matters else {}),
        "return_mean": float(returns.mean()),
        "return_std": float(returns.std()),
        "length_mean_s": float(record.length.mean() * record.control_step),
        "diverged": int(record.diverged.sum()),
    } | record.task.figures(record)


def _means(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The mean of values (T, N) of each aircraft over the chosen steps, (N,)."""
    return np.sum(np.where(chosen, values, 0.0), 0) / chosen.sum(0)


def smoothness(record: Record) -> dict[str, Any]:
    """How smoothly the flights that succeed were flown; not a number where there are none.

    A fall is no flight: its figures would say nothing of the flying. Figures are means over the
    flights that last for at least a segment of the spectrum.

    Returns:
        flights: how many. action_variation_1_s: sum of |change of an action|, mean of the rotors,
        over the time [1/s]. Root mean squares: body_rate_rad_s, angular_acceleration_rad_s2,
        jerk_m_s3 (from differences of the velocity), wobble_rad_s (of the body rate less its mean,
        over the last 2 s). wobble_share: of the body rate's power, that above `WOBBLE_HZ`.
        frequency_hz, body_rate_spectrum [rad^2/s^2/Hz], jerk_spectrum [m^2/s^6/Hz]: by Welch's
        method, summed over the axes.
    """
    step = record.control_step
    hold = round(FINAL_STRETCH / step)
    names = (
        "action_variation_1_s", "body_rate_rad_s", "angular_acceleration_rad_s2", "jerk_m_s3",
        "wobble_rad_s",
    )  # fmt: skip
    rows, spectra = [], []
    for i in np.flatnonzero(record.is_success):
        flown = slice(0, int(record.length[i]))
        rate, velocity = record.body_rate[flown, i], record.velocity[flown, i]
        variation = np.abs(np.diff(record.action[flown, i], axis=0)) / step
        jerk = np.diff(velocity, n=2, axis=0) / step**2
        if len(jerk) < SEGMENT:
            continue
        square = (rate, np.diff(rate, axis=0) / step, jerk, rate[-hold:] - rate[-hold:].mean(0))
        rows.append([variation.mean(), *(np.sqrt((x**2).sum(-1).mean()) for x in square)])
        welched = [welch(x, fs=1 / step, nperseg=SEGMENT, axis=0)[1].sum(-1) for x in (rate, jerk)]
        spectra.append(welched)
    means = np.mean(rows, axis=0) if rows else np.full(len(names), np.nan)
    frequency = np.fft.rfftfreq(SEGMENT, step)
    spectrum = np.mean(spectra, axis=0) if spectra else np.full((2, len(frequency)), np.nan)
    still = np.finfo(float).tiny  # no power at all: none of it is wobble
    fast = spectrum[0][frequency > WOBBLE_HZ].sum() / np.maximum(spectrum[0].sum(), still)
    return {
        "flights": len(rows),
        **{name: float(value) for name, value in zip(names, means, strict=True)},
        "wobble_share": float(fast),
        "frequency_hz": frequency.tolist(),
        "body_rate_spectrum": spectrum[0].tolist(),
        "jerk_spectrum": spectrum[1].tolist(),
    }
