"""A batch whose step is one text: built for a processor it has the bits of `Environment`."""

import dataclasses
import re

import numpy as np
import pytest
import torch

import quadrl
from quadrl.base.errors import QuadrlError
from quadrl.core import batch as batch_module
from quadrl.core import launch
from quadrl.core.batch import Batch
from quadrl.core.environment import Environment
from quadrl.core.scenario import Scenario
from quadrl.core.source import text

AIRCRAFT, STEPS = 24, 60
UNCERTAIN = {
    **{"command_delay": (0.0, 0.04), "observation_delay": (0.0, 0.03), "mass": (0.9, 1.1)},
    **{"command_loss": (0.0, 2.0), "command_jitter": (0.0, 0.5), "noise": {"position": 0.01}},
    **{"pushes": {"rate": 2.0, "velocity": 0.5, "body_rate": 1.0}, "wind": (0.5, 1.5)},
}
SEES = {"rotor_speed": "estimated", "disturbance": True, "action_history": 2, "privileged": True}
SEES["sensors"] = {"disturbance": {"rate": 7.0}}  # in every third control step, about
CASES = [
    pytest.param("hover", {}, id="hover"),
    pytest.param("race", {"control_mode": "thrust_body_rate"}, id="race with loops"),
    pytest.param("trajectory", {"vehicle": "hexa"}, id="trajectory of a hexacopter"),
    pytest.param("hover", {"aerodynamics": "full"}, id="full air"),
    pytest.param("hover", {"randomization": UNCERTAIN, "observe": SEES, "weather": "light"},
                 id="uncertain"),
]  # fmt: skip


@pytest.fixture(autouse=True)
def _quickly(monkeypatch):
    monkeypatch.setattr(batch_module, "FEWEST", AIRCRAFT)
    monkeypatch.setenv("QUADRL_CFLAGS", "-O1")  # a third of the time to compile


def scenario(task="hover", **settings):
    return Scenario.of(task, engine="free_flight", **settings)


def flat(terms):
    return np.concatenate(list(terms.values()), axis=-1)


def flags(done):
    named = done.terminated, done.truncated, done.is_success, done.diverged
    return np.stack([*named, *done.ends.values()])


def same_flights(batch, environment, steps=STEPS):
    """Fly both; whether all that they give is the same. How many episodes ended.

    Where episodes begin with what a processor has drawn, that is so in the first one of each row.
    """
    rng, ended, same = np.random.default_rng(2), 0, np.ones(environment.num_envs, dtype=bool)
    if not np.array_equal(flat(environment.reset()), batch.reset().numpy()):
        return -1
    for _ in range(steps):
        batch.action[0].copy_(torch.from_numpy(rng.normal(0, 0.5, batch.action[0].shape)))
        done, found = environment.step(batch.action[0].numpy()), batch.step()
        for own, expected in (
            (found.final, flat(done.observation)),
            (found.reward, done.reward),
            (found.error, done.error),
            (found.terms, np.stack([*done.reward_terms.values()])),
            (torch.cat([batch.flags[0, 1:]]), flags(done)),
        ):
            rows = ..., same
            own = own.numpy()
            if own.shape[0] == len(same):
                own, expected = own.T, expected.T
            if not np.array_equal(own[rows], expected[rows]):
                return -1
        over = done.terminated | done.truncated
        ended += (over & same).sum()
        if batch.layout.pooled:
            same &= ~over
            continue
        if over.any():
            begun = flat(environment.reset(over))
            if not np.array_equal(found.observation.numpy()[over], begun):
                return -1
    return ended


@pytest.mark.parametrize(("task", "settings"), CASES)
def test_a_batch_flies_the_bits_of_an_environment(task, settings):
    flown = scenario(task, **settings)
    batch = Batch(flown, AIRCRAFT, 3, "cpu", "float64")
    assert same_flights(batch, Environment(flown, num_envs=AIRCRAFT, seed=3)) > 0


@pytest.mark.parametrize(
    ("planted", "instead"),
    [
        ("round < 10", "round < 9"),
        ("SUBSTEPS = 5", "SUBSTEPS = 4"),
        ("weight[4] = {1, 2, 2, 1}", "weight[4] = {1, 2, 2, 1.0000000000000002}"),
        ("= episode + 1;", "= episode + 2;"),
        ("force[k] -= drag", "force[k] += drag"),
        ("sound ? m[k][0] : last[k][0]", "last[k][0]"),
    ],
)
def test_a_planted_error_is_seen(planted, instead, monkeypatch):
    whole = launch.compile_generated

    def compiled(source):
        assert planted in source
        return whole(source.replace(planted, instead))

    monkeypatch.setattr(launch, "compile_generated", compiled)
    flown = scenario()
    batch = Batch(flown, AIRCRAFT, 3, "cpu", "float64")
    assert same_flights(batch, Environment(flown, num_envs=AIRCRAFT, seed=3)) == -1


def test_single_precision_is_near_double():
    exact, fast = (Batch(scenario(), AIRCRAFT, 3, "cpu", p) for p in ("float64", "float32"))
    exact.reset(), fast.reset()
    for _ in range(STEPS):
        fast.table.copy_(exact.table)
        fast.episodes.copy_(exact.episodes)
        exact.action[0].normal_(0, 0.4)
        fast.action[0].copy_(exact.action[0])
        exact.action[0].copy_(fast.action[0])
        over = exact.step().over | fast.step().over
        motion, other = (b.table[: b.layout.motion, ~over].double() for b in (exact, fast))
        assert ((motion - other).abs() / (1 + motion.abs())).max() < 1e-5


def test_a_policy_flies_in_single_precision_as_in_double():
    policy, errors = quadrl.Policy.pretrained("hover"), list[float]()
    for precision in ("float64", "float32"):
        flown = dataclasses.replace(policy.scenario, engine="free_flight")
        batch = Batch(flown, 200, 3, "cpu", precision)
        seen, ends = batch.reset(), torch.zeros(200)
        for _ in range(batch.environment.time_limit_steps):
            batch.action[0].copy_(torch.from_numpy(policy(seen.float().numpy())))
            now = batch.step()
            ends += now.success
            seen = now.observation
        assert (ends == 1).all()
        errors.append(float(now.error.mean()))
    assert errors[1] == pytest.approx(errors[0], abs=1e-4)


def test_no_number_of_single_precision_is_a_double():
    environment = Environment(scenario())
    environment.reset()
    code = re.sub(r"//.*", "", text(environment, "float32"))
    assert not re.search(r"\bdouble\b", code)
    assert re.search(r"\bfloat\b", code)


def test_a_batch_that_is_restored_continues():
    first, other = (Batch(scenario(), AIRCRAFT, 3, "cpu") for _ in range(2))
    first.reset()
    actions = torch.rand(40, *first.action[0].shape) - 0.5
    for action in actions[:20]:
        first.action[0].copy_(action)
        first.step()
    saved = first.save()
    assert torch.equal(other.restore(saved), first.slots[0].observation)
    for action in actions[20:]:
        for batch in (first, other):
            batch.action[0].copy_(action)
            batch.step()
        assert torch.equal(first.out, other.out) and torch.equal(first.flags, other.flags)
    with pytest.raises(QuadrlError, match="table"):
        Batch(scenario("race"), AIRCRAFT, 3, "cpu").restore(saved)


def test_a_row_goes_on_in_an_environment():
    batch, one = Batch(scenario(), 5, 3, "cpu", "float64"), Environment(scenario())
    batch.reset()
    for _ in range(10):
        batch.action[0].normal_(0, 0.3)
        batch.step()
    assert np.array_equal(flat(one.restore(batch.row(2)))[0], batch.slots[0].observation[2])
    batch.action[0].normal_(0, 0.3)
    done = one.step(batch.action[0, 2:3].numpy())
    assert np.array_equal(flat(done.observation)[0], batch.step().final[2])


def test_what_is_no_number_is_told():
    batch = Batch(scenario(), 5, 3, "cpu")
    batch.reset()
    batch.action[0, 3, 1] = float("nan")
    batch.step()
    with pytest.raises(QuadrlError, match=r"action .*aircraft 3"):
        batch.step()
    batch.action.zero_()
    batch.step()  # it is told once


@pytest.mark.parametrize(
    ("task", "settings", "what"),
    [
        ("landing", {}, "contact"),
        ("navigation", {"balls": 2, "ball_speed": 1.0}, "solids that move"),
        ("hover", {"events": "battery"}, "events"),
        (
            *("hover", {"control_mode": "velocity", "observe": {"rotor_speed": "estimated"}}),
            "sensors that follow",
        ),
    ],
)
def test_what_is_not_covered_is_refused(task, settings, what):
    with pytest.raises(QuadrlError, match=f"on a GPU has no {what}.*allowed: device 'cpu'"):
        Batch(scenario(task, **settings), 5, 3, "cpu")


def test_it_flies_in_free_flight_alone():
    with pytest.raises(QuadrlError, match="engine = 'mujoco': must be 'free_flight'"):
        Batch(dataclasses.replace(scenario(), engine="mujoco"), 5, 3, "cpu")


def test_torchrl_flies_the_same_as_on_the_processor(monkeypatch):
    pytest.importorskip("torchrl")
    from torchrl.envs.utils import check_env_specs

    from quadrl.envs import torchrl

    given = {"num_envs": AIRCRAFT, "seed": 3, "engine": "free_flight", "reward_terms": True}
    one = torchrl.QuadrotorEnv("hover", **given)
    monkeypatch.setattr(torchrl, "asks", lambda *_: True)
    other = torchrl.QuadrotorEnv("hover", **given, precision="float64")
    assert one.batch is None and other.batch.num_envs == other.num_envs == AIRCRAFT
    check_env_specs(other)
    other.set_seed(3)
    torch.manual_seed(0)
    actions = 1.2 * torch.rand(STEPS, AIRCRAFT, 4) - 0.6
    flown = []
    for env in (one, other):
        state, seen = env.reset(), []
        for action in actions:
            both, state = env.step_and_maybe_reset(state.set("action", action))
            seen.append(both)
        flown.append(torch.stack(seen))
    assert flown[0]["next", "done"].any()
    torch.testing.assert_close(flown[0], flown[1].select(*flown[0].keys(True, True)))
    # Those that reset by themselves: rows that have begun within the step do not begin again.
    for env in (one, other):
        env.set_seed(8)
    states = [env.reset() for env in (one, other)]
    for action in actions[:30]:
        after = [
            env.step(state.set("action", action))["next"]
            for env, state in zip((one, other), states, strict=True)
        ]
        for state in after:
            state["_reset"] = state["done"].clone()
        states = [env.reset(state) for env, state in zip((one, other), after, strict=True)]
        torch.testing.assert_close(states[0]["observation"], states[1]["observation"])


def test_a_device_that_is_not_there_is_one_line():
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(QuadrlError, match=r"device = 'cuda': must be a device that this torch"):
        Batch(scenario(), 5, 3, "cuda")


@pytest.mark.parametrize(
    ("chip", "free", "said"),
    [
        ((7, 0), 1 << 40, "compute capability 7.5 or newer"),
        ((9, 0), 1000, "are free: ask for fewer"),
    ],
)
def test_a_card_that_cannot_is_one_line(chip, free, said, monkeypatch):
    monkeypatch.setattr(batch_module, "make_device", torch.device)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: chip)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (free, 2 * free))
    if chip > (8, 0):
        monkeypatch.setattr(batch_module, "kernels", lambda *_: {})
    with pytest.raises(QuadrlError, match=said):
        Batch(scenario(), 5, 3, "cuda")


def test_another_seed_draws_other_starts():
    batch = Batch(scenario(weather="light"), AIRCRAFT, 3, "cpu", "float64")
    batch.seed(40)
    environment = Environment(scenario(weather="light"), num_envs=AIRCRAFT, seed=40)
    assert same_flights(batch, environment, 20) >= 0
    with pytest.raises(QuadrlError, match="one number where episodes begin"):
        batch.seed([*range(AIRCRAFT)])
    with pytest.raises(QuadrlError, match="num_envs"):
        Batch(scenario(), 0, 3, "cpu")
    with pytest.raises(QuadrlError, match="not compiled: its sensors remember"):
        Batch(scenario(observe={"observation_history": 16}), 5, 3, "cpu")


def test_actions_of_another_shape_are_refused():
    batch = Batch(scenario(), AIRCRAFT, 3, "cpu")
    batch.reset()
    with pytest.raises(QuadrlError, match=r"action .*\(24, 4\) on cpu"):
        batch.take(torch.ones(AIRCRAFT, 1))  # it would be spread over the rotors
    assert not batch.action.any()
