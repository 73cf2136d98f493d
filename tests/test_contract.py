"""Every task keeps the contract of quadrl.testing, which notices those that do not."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from quadrl.rotation import namespace
from quadrl.task import OBSERVATION, Part
from quadrl.tasks import TASKS
from quadrl.tasks.hover import Hover
from quadrl.tasks.static_waypoint import StaticWaypoint
from quadrl.testing import check_task


@pytest.mark.parametrize("name", TASKS)
def test_task_keeps_the_contract(name):
    check_task(name)


@pytest.mark.parametrize(
    "task",
    [
        Hover(radius=1.0, horizon=1.0),
        # The first waypoint is reached at once, the second by the aircraft that climbs.
        StaticWaypoint(waypoints=((0.0, 0.1, 0.3), (0.1, 0.0, 0.9), (0.0, 0.0, 5.0)), reach=0.35),
    ],
    ids=["hover", "route"],
)
def test_a_variant_of_a_task_keeps_it_too(task):
    check_task(task)


BROKEN = []


def broken(message):
    """Register a task with a fault and what the contract has to say of it."""

    def register(kind):
        kind = dataclasses.dataclass(frozen=True)(kind)
        BROKEN.append(pytest.param(kind, message, id=kind.__name__))
        return kind

    return register


@broken("the option limit has no docstring")
class UndocumentedOption(Hover):
    limit: float = 1.0


@broken("solved is no text: ''")
class SaysNothing(Hover):
    solved = ""


@broken("the part 'goal' lacks a size, a unit or a meaning")
class NoUnit(Hover):
    observation = OBSERVATION | {"goal": Part(3, "", "from the aircraft to the goal")}


@broken("sample gives two starts for one draw")
class OtherRandomNumbers(Hover):
    def sample(self, draw, vehicle):
        start, fields = super().sample(draw, vehicle)
        return start, dataclasses.replace(fields, goal=np.random.normal(size=fields.goal.shape))


@broken("every episode begins alike")
class AlwaysTheSame(Hover):
    def sample(self, draw, vehicle):
        draw._block = 0.0 * draw._block + 0.5
        return super().sample(draw, vehicle)


@broken("a start's quaternion has length")
class NoRotation(Hover):
    def sample(self, draw, vehicle):
        start, fields = super().sample(draw, vehicle)
        return dataclasses.replace(start, quaternion=2 * start.quaternion), fields


@broken("sample of one aircraft and of a batch differ: start.position")
class MeanOfTheBatch(Hover):
    def sample(self, draw, vehicle):
        start, fields = super().sample(draw, vehicle)
        if start.position.ndim == 2:
            start = dataclasses.replace(start, position=start.position - start.position.mean(0))
        return start, fields


@broken("sample with a draw of shape .* fails.*64 random numbers")
class TooManyDraws(Hover):
    def sample(self, draw, vehicle):
        draw.uniform(0, 1, 60)
        return super().sample(draw, vehicle)


@broken(r"the part 'position' has shape \(4, 2\), \(4, 3\) is expected")
class TwoDimensions(Hover):
    def observe(self, state, measures, fields, vehicle):
        parts = super().observe(state, measures, fields, vehicle)
        return parts | {"position": parts["position"][..., :2]}


@broken("observe gives .*'position', 'wind'")
class UndeclaredPart(Hover):
    def observe(self, state, measures, fields, vehicle):
        parts = super().observe(state, measures, fields, vehicle)
        return {"position": parts.pop("position"), "wind": state.velocity} | parts


@broken("entries .2. of the part 'goal' never change")
class ConstantEntry(Hover):
    def observe(self, state, measures, fields, vehicle):
        parts = super().observe(state, measures, fields, vehicle)
        return parts | {"goal": parts["goal"] * namespace(parts["goal"]).asarray([1.0, 1.0, 0.0])}


@broken("one aircraft and a batch get different numbers: progress")
class RewardOfTheBatch(Hover):
    def reward(self, *args):
        terms = super().reward(*args)
        return terms | {"progress": terms["progress"] - terms["progress"].mean()}


@broken("the reward has no terms")
class NoReward(Hover):
    def reward(self, *args):
        return {}


@broken("survival is 10.0, no array of float")
class RewardOfPythonsOwn(Hover):
    def reward(self, *args):
        return super().reward(*args) | {"survival": 10.0}


@broken("not finite.*'closeness': nan")
class RewardNotANumber(Hover):
    def reward(self, before, now, *rest):
        terms = super().reward(before, now, *rest)
        xp = namespace(now.distance)
        far = now.distance > 2.0  # not at once
        return terms | {"closeness": xp.where(far, 0 * now.distance + xp.nan, now.distance)}


@broken("terminated is float64, not bool")
class TerminatedByNumber(Hover):
    def terminated(self, *args):
        return super().terminated(*args) * 1.0


@broken(r"terminated has shape \(\)")
class TerminatedTogether(Hover):
    def terminated(self, *args):
        return super().terminated(*args).any()


@broken("markers fails.*'str'")
class DrawsWords(Hover):
    def markers(self, fields):
        return ["a sphere"]


@broken("an error of .* is negative")
class NegativeError(Hover):
    def error(self, state, measures, fields):
        return measures.distance - 0.5


@broken("a function on arrays of leading shape .* fails.*read-only")
class ChangesItsFields(Hover):
    def update(self, state, measures, fields, vehicle):
        fields.goal[..., 0] += 0.1
        return fields


@broken(r"a function on arrays of leading shape \(\) fails.*axis 2")
class KnowsTheBatch(Hover):
    def touches_ground(self, state, vehicle):
        return np.linalg.norm(state.rotation, axis=2).sum(axis=1) < 0


@broken("with tensors|requires grad")
class NumpyAlone(Hover):
    def error(self, state, measures, fields):
        return np.sqrt(measures.distance)


@broken("reward through .* is not that of mj_step|get different numbers")
class Remembers(Hover):
    def reward(self, *args):
        calls = self.__dict__.setdefault("calls", [])
        calls.append(1)
        terms = super().reward(*args)
        return terms | {"survival": terms["survival"] + 1e-9 * len(calls)}


class NotADataclass(Hover):
    """Its option is none, for want of @dataclass."""

    limit: float = 1.0


BROKEN.append(pytest.param(NotADataclass, "no frozen dataclass of its own", id="NotADataclass"))


@pytest.mark.parametrize(("kind", "message"), BROKEN)
def test_a_fault_is_noticed(kind, message):
    with pytest.raises(AssertionError, match=f"(?s){message}"):
        check_task(kind)


def test_an_unfair_door_is_noticed(monkeypatch):
    from quadrl.envs.gymnasium import QuadrotorEnv

    step = QuadrotorEnv.step

    def off_by_a_bit(self, action):
        observation, reward, *rest = step(self, action)
        return observation, np.nextafter(reward, np.inf).item(), *rest

    monkeypatch.setattr(QuadrotorEnv, "step", off_by_a_bit)
    with pytest.raises(AssertionError, match="reward through gymnasium is not that of mj_step"):
        check_task("hover")


def test_the_contract_needs_neither_pytest_nor_torch():
    code = (
        "import sys; sys.modules.update(pytest=None, torch=None, torchrl=None, tensordict=None);"
        "import quadrl, quadrl.testing; quadrl.testing.check_task('hover')"
    )
    folder = str(Path(__file__).parents[1])
    environment = {"PYTHONPATH": folder, "MUJOCO_GL": "egl", "HOME": str(Path.home())}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
