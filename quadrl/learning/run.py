"""A whole run: train a policy, evaluate it, draw it."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shlex
import timeit
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.base.errors import QuadrlWarning
from quadrl.base.files import write_json
from quadrl.base.progress import Progress, ProgressBar
from quadrl.base.units import digits, percent
from quadrl.control.feasibility import warn_of_unreached
from quadrl.core.environment import Environment
from quadrl.core.launch import make_device
from quadrl.core.scenario import UNDISTURBED, Scenario
from quadrl.core.solved import missed
from quadrl.evaluation.evaluate import Evaluation, evaluate, html_table
from quadrl.evaluation.policy import Policy
from quadrl.learning import phases
from quadrl.learning.config import TrainConfig, prepare
from quadrl.learning.folder import EVALUATION, LEARNING_CURVE, TRAJECTORY, VIDEO
from quadrl.learning.show import curve
from quadrl.learning.train import Training
from quadrl.rendering import write_video
from quadrl.rendering.scenarios import comment

LATER = (0.01, 0.02)
"""How much later [s] commands also act, as by a radio, where the largest is a control step."""
FEW, GAIN = 20, 0.95
"""Control steps that are flown to see what compiling gains, and the share of the time to tell."""
STANDS = 0.98
"""Share of the flights that succeed with late commands of a policy for which they do not matter."""


@dataclasses.dataclass(frozen=True, repr=False)
class Run:
    """A finished training: its settings, its folder, and what its policy reached."""

    folder: Path
    """Holds the policy, the checkpoint, the settings, the metrics and the pictures."""
    config: TrainConfig
    """The settings."""
    policy: Policy
    """The trained policy: flat observations to the mean action."""
    evaluation: Evaluation
    """Metrics in MuJoCo, in episodes that the training has not seen."""
    seconds: float
    """Wall clock of the training [s], without imports and evaluation."""
    late: dict[float, float] = dataclasses.field(default_factory=dict)
    """Share of the flights that succeed, by how much later [s] commands act than in training; empty
    where that is no whole control step."""

    def __repr__(self) -> str:
        return "\n".join(filter(None, (self.summary, self.misses, self.causes)))

    @property
    def summary(self) -> str:
        """What it reached, in a line."""
        trained = f"trained with {self.config.algo.upper()} in {self.seconds:.1f} s"
        return f"{self.evaluation}; {trained}; in {self.folder}"

    @property
    def kept(self) -> str:
        """Which policy it is, in a line."""
        after = f"kept: the policy after {self.policy.metadata['steps']:,} control steps"
        after += " of the last training" * bool(self.config.phases)
        if self.config.keep == "last" or not self.config.evaluations:
            return f"{after}, the last"
        return f"{after}, the best in the evaluations along the training"

    @property
    def misses(self) -> str:
        """What it misses of what the task asks, and what to do next, in a line; "" if nothing."""
        what = missed(self.evaluation.task.asked, self.evaluation.metrics)
        return f"misses: {what}. {self._next()}" if what else ""

    @property
    def causes(self) -> str:
        """How the episodes ended and what the reward was made of, in two lines; "" if all is well.

        They are those of the evaluation.
        """
        if not self.misses:
            return ""
        ends, terms = (self._named(*marks) for marks in (("end_", "_rate"), ("reward_", "_mean")))
        how = ", ".join(f"{name.replace('_', ' ')} {percent(x)}" for name, x in ends if x)
        most, *rest = (f"{name} {digits(x)}" for name, x in terms)
        others = f", then {', '.join(rest)}" * bool(rest)
        return f"its episodes ended: {how}\nits reward an episode: mostly {most}{others}"

    def _named(self, begin: str, end: str) -> list[tuple[str, float]]:
        """Figures of the task's own names, the largest first, whatever their sign."""
        found = self.evaluation.metrics.items()
        own = [(k, x) for k, x in found if k.startswith(begin) and k.endswith(end)]
        own = [(k.removeprefix(begin).removesuffix(end), x) for k, x in own]
        return sorted(own, key=lambda one: -abs(one[1]))

    @property
    def lateness(self) -> str:
        """What late commands do to it, and what mends that, in a line; "" if it was not flown."""
        shares = [f"{1000 * s:g} ms later {percent(x)}" for s, x in self.late.items()]
        said = f"successful with commands that act {', '.join(shares)}" if shares else ""
        if said and min(self.late.values()) < STANDS:
            drawn = json.dumps({"command_delay": [0.0, max(self.late)]})
            said += f"; to stand that, train with --randomization {shlex.quote(drawn)}"
        return said

    def _next(self) -> str:
        """The command that goes on where targets are missed."""
        config, run, flown = self.config, shlex.quote(str(self.folder)), self.config.scenario
        own = {"task_options": config.conditions["task_options"]}  # some cannot be made without
        usual = TrainConfig(config.task, algo=config.algo, **own).scenario
        differ = [k for k in UNDISTURBED if getattr(flown, k) != getattr(usual, k)]
        if differ:
            calm = " ".join(f"--{name} {UNDISTURBED[name]}" for name in differ)
            return f"They count undisturbed: quadrl evaluate {run} {calm}"
        return f"Next: quadrl train --resume {run} --steps {2 * config.steps}"

    def _repr_html_(self) -> str:
        config = self.config
        aircraft = config.conditions["vehicle"]
        head = f"{config.task}, {config.algo.upper()}, seed {config.seed}, {aircraft}"
        rows = [("trained", head), ("folder", str(self.folder)), ("seconds", f"{self.seconds:.1f}")]
        rows += [("", line) for line in f"{self.misses}\n{self.causes}".split("\n") if line]
        return html_table(rows) + self.evaluation._repr_html_()

    def draw(
        self, *, video: bool = True, on_frame: Callable[[int, int], None] = lambda done, total: None
    ) -> Iterator[Path]:
        """Draw the pictures of the run into its folder, one at each step of the iterator.

        Args:
            video: Whether to draw a flight as the last of them.
            on_frame: Called with the number of frames drawn, and of all.

        Raises:
            RenderingUnavailable: There is no graphics library to draw the video with.
        """
        # They take a second, and the result comes first.
        from quadrl.evaluation import flight_figures, plotting

        flown = self.evaluation
        yield plotting.save(curve(self.folder), self.folder / LEARNING_CURVE)
        title = f"{flown.task.name}: mean action of the policy"
        drawn, carried = flight_figures.trajectory(flown.rollout, title), flown.scenario.to_json()
        yield plotting.save(drawn, self.folder / TRAJECTORY, comment=comment([carried]))
        if video:
            model, flight = flown.scenario.compile_model(), flown.trajectory()
            yield write_video(flight, model, self.folder / VIDEO, on_frame=on_frame)


def train(
    task: str | TrainConfig | None = None,
    *,
    out: str | Path | None = None,
    resume: str | Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    **settings: Any,
) -> Run:
    """Train a policy and evaluate it in MuJoCo; `quadrl train` in Python.

    Args:
        task: Name of the task, hover by default; or all settings.
        out: Folder of the run; by default runs/TASK-ALGO-SEED, with a number behind it if that
            holds a run already.
        resume: Continue the run in this folder, with its own settings. Of the settings only
            `steps`, `device`, `num_threads`, `checkpoint_seconds`, `evaluations` and `episodes` may
            be given.
        on_progress: Called after each iteration; by default a progress bar is shown.
        **settings: Fields of `TrainConfig`: `seed`, `algo`, `vehicle`, `steps`, ...

    Returns:
        The run. An interrupted training (Ctrl-C) leaves its last checkpoint and policy in the
        folder, which can be continued, evaluated and rendered.

    Raises:
        QuadrlError: A setting or the folder cannot be used, or the training diverged.
    """
    config, folder = prepare(task, out, resume, settings)
    with ProgressBar() as bar:
        show = on_progress or bar.show
        return train_in(folder, config, resume=resume is not None, show=show)


def train_in(
    folder: Path,
    config: TrainConfig,
    *,
    resume: bool,
    show: Callable[[Progress], None],
    heed: Callable[[Callable[..., None]], AbstractContextManager[Any]] = contextlib.nullcontext,
) -> Run:
    """Train as `train` does, with prepared settings and folder, within `heed(training.ask)`."""
    scenario = config.scenario
    asked = scenario.randomization, scenario.control_mode, scenario.mean_wind, scenario.lands
    warn_of_unreached(scenario.aircraft, *asked)
    before = 0.0
    if config.phases:
        phases.prepare(folder, config, kind_of, resume=resume, show=show, heed=heed)
        before, resume = phases.seconds(folder), True
    training = kind_of(config)(config, folder, resume=resume)
    with heed(training.ask):
        policy = training.run(phases.shown(show, len(config.phases) + 1, config))
    found = evaluate(policy, scenario, episodes=config.episodes)
    seconds = round(before + training.seconds, 2)
    record = {"training_s": seconds, "scenario": scenario.to_json()}
    late = _later(policy, scenario, config.episodes)
    if late:
        record["success_rate_later"] = {f"{s:g}": share for s, share in late.items()}
    write_json(folder / EVALUATION, found.metrics | record)
    return Run(folder, config, policy, found, seconds, late)


def kind_of(config: TrainConfig) -> type[Training]:
    """What trains: on a GPU alone where it can, else with aircraft that the processor flies.

    Raises:
        QuadrlError: There is no such device.
    """
    if make_device(config.device).type != "cuda":
        return Training
    from quadrl.learning.device import DeviceTraining, elsewhere

    if why := elsewhere(config):
        said = f"device = {config.device}: only the networks are there, and a processor flies"
        warnings.warn(f"{said} the aircraft, since {why}", QuadrlWarning, stacklevel=2)
        return Training
    return DeviceTraining


def would_gain(config: TrainConfig) -> str:
    """What `compiled = True` would gain for a task of one's own, in a line; "" for nothing."""
    scenario, took = config.training_scenario, dict[bool, float]()
    task, kind = scenario.task, type(scenario.task)
    if kind.__module__.startswith("quadrl.") or task.asks_compiled:
        return ""
    own = {field.name: getattr(task, field.name) for field in dataclasses.fields(task)}
    for asked in (False, True):
        made = dataclasses.dataclass(frozen=True)(type("Own", (kind,), {"compiled": asked}))
        flown = dataclasses.replace(scenario, task=made(**own))
        environment = Environment(flown, num_envs=config.num_envs, num_threads=config.num_threads)
        with warnings.catch_warnings():  # that it cannot be compiled
            warnings.simplefilter("ignore", QuadrlWarning)
            environment.reset()
        actions = np.zeros((config.num_envs, environment.action_size))
        times = timeit.repeat(lambda e=environment, a=actions: e.step(a), number=1, repeat=FEW)
        took[asked] = 1e6 * min(times)
    if environment.not_compiled or took[True] > GAIN * took[False]:
        return ""
    said = f"a control step of {config.num_envs} aircraft takes {took[True]:.0f} us, not"
    return f"with `compiled = True` in the class {kind.__name__}, {said} {took[False]:.0f}"


def _later(policy: Policy, scenario: Scenario, episodes: int) -> dict[float, float]:
    """Share of the flights that succeed where commands act LATER, if that is a control step.

    These delays take the place of drawn ones.
    """
    vehicle, shares = scenario.vehicle, dict[float, float]()
    for later in LATER if LATER[-1] >= vehicle.control_timestep else ():
        delay = round(later / vehicle.physics_timestep) * vehicle.physics_timestep
        late = dataclasses.replace(scenario.randomization, command_delay=(delay, delay))
        flown = {"engine": "free_flight", "randomization": late}
        found = evaluate(policy, scenario, episodes=episodes, **flown)
        shares[later] = float(found.metrics["success_rate"])
    return shares
