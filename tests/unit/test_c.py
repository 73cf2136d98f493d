"""Policies as C: the bits of the reference, the flights of the policy, and what is refused."""

import dataclasses
import re

import helpers
import numpy as np
import pytest
from flown_in_c import Flown, compiled, motions_of, tasks_of

from quadrl.base.errors import QuadrlError
from quadrl.conditions.solids import Sphere
from quadrl.core.environment import Environment
from quadrl.core.observation import ObservationTerm
from quadrl.core.scenario import UNDISTURBED, Scenario
from quadrl.core.task import TaskState
from quadrl.deploy.c import Header
from quadrl.deploy.export import export
from quadrl.evaluation.memory import GRU
from quadrl.evaluation.policy import Policy
from quadrl.tasks import TASKS
from quadrl.tasks.hover import Hover


def sampling():
    """A policy whose sensors have rates and delays."""
    held = {"airspeed": {"rate": 5}, "state": {"delay": 0.05}, "disturbance": {"rate": 10}}
    return seeing({"sensors": held, "observation_history": 1})


def seeing(observe, task="hover"):
    """A policy by hand for a task and options of its observation."""
    rng, plain = np.random.default_rng(1), Policy.pretrained("hover")
    metadata = plain.metadata | {"observe": observe, "task": task}
    size = Environment(Scenario.of({"task": task, "observe": observe})).size
    weights = rng.normal(0, 0.3, (12, size)), rng.normal(0, 0.3, (8, 12))
    biases = rng.normal(0, 0.3, 12), rng.normal(0, 0.3, 8)
    singles = (tuple(x.astype(np.float32) for x in arrays) for arrays in (weights, biases))
    seen = np.zeros(size, np.float32), np.ones(size, np.float32)
    return Policy(*singles, *seen, task, metadata)


def remembering(neurons=0):
    """A policy with a memory for the robust hover, behind a layer where there are neurons."""
    rng, plain = np.random.default_rng(0), Policy.pretrained("hover", variant="robust")
    size, width = plain.size, 5
    shapes = (3 * width, neurons or size), (3 * width, width), (3 * width,), (3 * width,)
    shapes += ((neurons, size), (neurons,)) if neurons else ()
    memory = GRU(*(rng.normal(0, 0.3, shape).astype(np.float32) for shape in shapes))
    weights = rng.normal(0, 0.3, (16, width + size * (not neurons))), rng.normal(0, 0.3, (8, 16))
    biases = rng.normal(0, 0.3, 16), rng.normal(0, 0.3, 8)
    singles = (tuple(x.astype(np.float32) for x in arrays) for arrays in (weights, biases))
    return Policy(*singles, plain.mean, plain.deviation, "hover", plain.metadata, memory)


@dataclasses.dataclass(frozen=True)
class Passed(TaskState):
    """What a task remembers: the way of the last step."""

    way: np.ndarray  # (N, 3) [m]


class Passing(Hover):
    """A task of one's own that sees how far the aircraft came in a step, by the state before."""

    name = "passing"
    compiled = True
    observation = Hover.observation | {"way": ObservationTerm(3, "m", "way of the last step")}

    def begin(self, rng, parameters):
        start, state = super().begin(rng, parameters)
        return start, Passed(state.goal, np.zeros_like(start.position))

    def update(self, before, now):
        return Passed(now.task.goal, now.state.position - before.state.position)

    def observe(self, now):
        return super().observe(now) | {"way": now.task.way}


def passing():
    """A policy for a task whose memory looks at the motion before."""
    plain, rng = Policy.pretrained("hover"), np.random.default_rng(2)
    (first, *rest), size = plain.weights, plain.size + 3
    weights = np.concatenate([first, rng.normal(0, 3.0, (len(first), 3))], axis=1), *rest
    seen = np.zeros(size, np.float32), np.ones(size, np.float32)
    single = tuple(weight.astype(np.float32) for weight in weights)
    return Policy(single, plain.biases, *seen, "passing", plain.metadata | {"task": "passing"})


@dataclasses.dataclass(frozen=True)
class Bumped(TaskState):
    """What a task remembers: whether a post was touched."""

    bumped: np.ndarray  # (N,)


class Bumping(Hover):
    """A task of one's own beside a post, which sees what an aircraft cannot measure."""

    name = "bumping"
    compiled = True
    observation = Hover.observation | {"way": ObservationTerm(1, "m", "to the post")}
    remembers = True

    def solids(self):
        return [Sphere("post", position=(1.0, 0.0, 0.0), radius=0.1)]

    def begin(self, rng, parameters):
        start, state = super().begin(rng, parameters)
        return start, Bumped(state.goal, 0.0 * state.goal[..., 0])

    def update(self, before, now):
        return Bumped(now.task.goal, now.task.bumped + now.touched[..., 0])

    def observe(self, now):
        known = now.task.bumped if self.remembers else now.clearance
        return super().observe(now) | {"way": known[..., None]}


class Nearing(Bumping):
    """The same by the distance."""

    name = "nearing"
    remembers = False


@pytest.fixture(autouse=True)
def task_of_ones_own(monkeypatch):
    for task in (Passing, Bumping, Nearing):
        monkeypatch.setitem(TASKS, task.name, task)


POLICIES = {
    "passing": passing,
    "hover": lambda: Policy.pretrained("hover"),
    "robust": lambda: Policy.pretrained("hover", variant="robust"),
    "race": lambda: Policy.pretrained("race"),
    "trajectory": lambda: Policy.pretrained("trajectory"),
    "remembering": remembering,
    "remembering alone": lambda: remembering(9),
    "sampling": sampling,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", POLICIES)
def test_the_c_has_the_bits_of_the_reference(name, tmp_path):
    """And of the environment, to a few units of single precision, with each optimisation."""
    policy = POLICIES[name]()
    header, path = Header(policy), export(policy, "c", tmp_path / "policy.h")
    environment, motions, seen = header.environment, [], []
    task, observation = tasks_of(environment), environment.reset(seed=0)
    flight = policy.flying(1)
    for _ in range(12):
        motions.append(motions_of(environment)[0])
        seen.append(environment.flatten(observation)[0])
        observation = environment.step(flight(seen[-1][None])).observation
    environment.reset(seed=0)
    expected = [*header.flown(np.array(motions))]
    assert header.exact
    for flags in ("-O0", "-O2", "-O3"):
        flown = Flown(compiled(path, tmp_path, flags), policy)
        assert flown.library.test() == 0
        assert flown.begin(motions[0], task) == 0
        looked = zip(motions, expected, strict=True)
        for step, (motion, (observation, action, command)) in enumerate(looked):
            assert flown.step(motion) == 0
            np.testing.assert_array_equal(flown.observation[0], observation)
            # The reference is of the same functions, so it is held against the environment, too.
            np.testing.assert_allclose(observation, seen[step], rtol=1e-5, atol=1e-5)
            np.testing.assert_array_equal(flown.action[0], action)
            np.testing.assert_array_equal(flown.command[0], command)


# A trajectory magnifies the rounding of a flight; tests/slow/test_in_the_loop.py flies it.
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in POLICIES if name != "trajectory"])
def test_the_c_flies_as_the_policy_does(name, tmp_path):
    policy = POLICIES[name]()
    pair = [Environment(policy.scenario, seed=5, **UNDISTURBED) for _ in range(2)]
    flown = Flown(compiled(export(policy, "c", tmp_path / "x.h"), tmp_path, "-O2"), policy)
    for _ in range(2):
        observation, _ = (each.reset() for each in pair)
        flight = policy.flying(1)
        assert flown.begin(motions_of(pair[1]), tasks_of(pair[1])) == 0
        made = name in (
            "passing",
            "remembering",
            "remembering alone",
            "sampling",
        )  # by hand, so that it falls
        for _ in range(60 if made else 1000):
            assert flown.step(motions_of(pair[1])) == 0
            action = flight(pair[0].flatten(observation))
            np.testing.assert_allclose(flown.action, action, rtol=0, atol=2e-3)
            done, own = pair[0].step(action), pair[1].step(flown.action.astype(float))
            observation, over = done.observation, own.terminated[0] | own.truncated[0]
            if over:
                break
        assert (over or made) and own.is_success == done.is_success
        np.testing.assert_allclose(own.error, done.error, rtol=1e-2, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["hover_robust", "target_following", "deck_landing", "perching", "navigation", "all"],
)
def test_what_the_c_sees_is_the_observation(name, tmp_path):
    policy = Policy.pretrained(name)
    environment = Environment(policy.scenario, seed=2, **UNDISTURBED)
    observation = environment.reset()
    flown = Flown(compiled(export(policy, "c", tmp_path / "x.h"), tmp_path, "-O2"), policy)
    assert flown.library.test() == 0
    given, motion = Header(policy).carried.around_of(environment.snapshot), motions_of(environment)
    np.testing.assert_allclose(given, motion[:, motion.shape[1] - given.shape[1] :], rtol=1e-5)
    assert flown.begin(motion, tasks_of(environment)) == 0
    for _ in range(40):
        assert flown.step(motions_of(environment)) == 0
        seen = environment.flatten(observation)
        np.testing.assert_allclose(flown.observation, seen, rtol=1e-5, atol=1e-5)
        observation = environment.step(flown.action.astype(float)).observation


def test_a_header_says_what_it_costs():
    """Cycles by hand: one more for each of 3,328 weights, 13 more to divide 161 times and more."""
    header = Header(Policy.pretrained("hover"))
    found = header.cost
    assert 3328 + 13 * 161 < found.cycles - found.instructions < 3328 + 13 * 200
    assert header.memory == 4 * (17 + 22 + 4 + 4 + 22 + 0 + 1)
    assert "23,000 cycles (0.14 ms at 168 MHz)" in found.said()


def test_another_number_fails_the_test_of_the_header(tmp_path):
    path = export("hover_robust", "c", tmp_path / "x.h")
    text = path.read_text()
    path.write_text(re.sub(r"(static const float bias_1\[\] = \{)[^,]+", r"\g<1>0x1p-3f", text))
    assert compiled(path, tmp_path, "-O1").test() != 0
    path.write_text(text.replace("a * over", "1.0001f * a * over"))
    assert compiled(path, tmp_path, "-O2").test() != 0


def test_numbers_that_are_not_finite_change_nothing(tmp_path):
    policy = Policy.pretrained("hover")
    environment = Environment(policy.scenario, seed=0, **UNDISTURBED)
    environment.reset()
    flown = Flown(compiled(export(policy, "c", tmp_path / "x.h"), tmp_path, "-O1"), policy)
    motion, task = motions_of(environment), tasks_of(environment)
    assert flown.begin(np.where(np.arange(motion.shape[1]) == 4, np.nan, motion), task) == -1
    assert flown.begin(motion, task) == 0 and flown.step(motion) == 0
    memory, command = flown.memory.copy(), flown.command.copy()
    for bad in (np.nan, np.inf, -np.inf):
        assert flown.step(np.where(np.arange(motion.shape[1]) == 8, bad, motion)) == -1
        np.testing.assert_array_equal(flown.memory, memory)
        np.testing.assert_array_equal(flown.command, command)


def test_what_no_autopilot_knows_is_refused():
    for own in ("bumping", "nearing"):
        with helpers.refused(match=f"task = '{own}'", lists="rays"):
            Header(seeing({}, own))
    plain = Policy.pretrained("target_following")
    options = plain.metadata | {"task_options": {"sees_motion": True}}
    del options["changed"]  # so that it is a record by hand
    more = [np.concatenate([a, np.ones(6, np.float32)]) for a in (plain.mean, plain.deviation)]
    first, *rest = plain.weights
    wider = np.concatenate([first, np.ones((len(first), 6), np.float32)], axis=1), *rest
    with helpers.refused(match="task = 'target_following'", lists="tracks"):
        Header(Policy(wider, plain.biases, *more, plain.task, options))
    with helpers.refused(match="sensor = 'ring'", lists="--to c"):
        Header(seeing({"sensors": {"ring": {}}})).check_holds_a_place()
    plain = Policy.pretrained("hover", variant="robust")
    other = plain.metadata | {"control_mode": "thrust_body_rate"}
    looped = Policy(plain.weights, plain.biases, plain.mean, plain.deviation, "hover", other)
    with pytest.raises(QuadrlError, match="commands of loops"):
        Header(looped)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["thrust_body_rate", "velocity", "position"])
def test_the_loops_of_a_control_mode_are_in_the_header(mode, tmp_path):
    plain = Policy.pretrained("hover")
    policy = dataclasses.replace(plain, metadata=plain.metadata | {"control_mode": mode})
    library = compiled(export(policy, "c", tmp_path / "policy.h"), tmp_path, "-O2")
    assert library.test() == 0
    environment = Environment(policy.scenario, seed=3, **UNDISTURBED)
    environment.reset()
    flown = Flown(library, policy)
    assert flown.begin(motions_of(environment), tasks_of(environment)) == 0
    for _ in range(20):
        assert flown.step(motions_of(environment)) == 0
        environment.begin(flown.action.astype(float))
        for steps in environment.commands():
            found, bad = flown.loops(motions_of(environment, environment.engine.peek()))
            assert bad == 0
            # Loops ask for thrusts: near none, a rounding of one is much of a speed.
            thrust, rounding = environment.engine.ctrl**2, 1e-6 * environment.vehicle.max_speed**2
            assert found.astype(float) ** 2 == pytest.approx(thrust, rel=2e-4, abs=rounding.max())
            environment.engine.advance(steps)
        environment.finish()
    lost = motions_of(environment)
    lost[0, 8] = np.nan
    assert flown.loops(lost)[1] == -1


def test_a_header_without_loops_has_none(tmp_path):
    assert "_loops" not in export("hover", "c", tmp_path / "hover.h").read_text()
