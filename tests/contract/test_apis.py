"""What every API has to do alike: seeds, resets, copies, divergence, refusals."""

import re

import numpy as np
import pytest
from apis import APIS, StableBaselines, Vector
from helpers import refused
from processes import python

from quadrl.base.errors import QuadrlError
from quadrl.testing import varied_actions

ACTIONS = varied_actions(12, 4)[:, 2:]  # (T, N, 4); one dives, one does anything


every_api = pytest.mark.parametrize("api", APIS, ids=lambda api: api.__name__)


def episode(flown, actions=ACTIONS):
    """The observations of an episode (T + 1, N, size)."""
    seen = [flown.observation(flown.reset())]
    return np.stack(seen + [flown.observation(flown.step(a[: flown.rows])) for a in actions])


@pytest.mark.slow
@every_api
def test_a_seed_gives_the_episodes_one_after_the_other(api):
    one, same, other = api(seed=3), api(seed=3), api(seed=5)
    first, second = episode(one), episode(one)
    np.testing.assert_array_equal(first, episode(same))
    np.testing.assert_array_equal(second, episode(same))
    starts = [first[0], second[0], episode(other)[0], episode(api())[0], episode(api())[0]]
    assert len(np.unique(np.concatenate(starts), axis=0)) == 5 * api.rows


@every_api
@pytest.mark.parametrize("seed", [-1, 1.5, "three", True])
def test_an_impossible_seed_is_refused(api, seed):
    if api is StableBaselines and seed in ("three", True):
        pytest.skip("it adds the number of the row to it")
    with refused("seed", seed):
        api(seed=seed).reset()


@pytest.mark.parametrize(
    ("api", "settings"),
    [
        *((api, {}) for api in APIS),
        (Vector, {"mode": "NEXT_STEP"}),
        (Vector, {"mode": "SAME_STEP"}),
    ],
    ids=lambda value: value.get("mode", "") if isinstance(value, dict) else value.__name__,
)
def test_what_is_handed_out_is_never_changed_later(api, settings):
    flown = api(seed=0, time_limit=0.2, **settings)  # four steps, so that resets are among them
    handed_out = [flown.reset()]
    copies = [flown.copied(handed_out[0])]
    for t, actions in enumerate(ACTIONS):
        handed_out.append(flown.step(actions[: flown.rows]))
        copies.append(flown.copied(handed_out[-1]))
        if t % 4 == 3 and not settings:
            handed_out.append(flown.reset())
            copies.append(flown.copied(handed_out[-1]))
    for given, copy in zip(handed_out, copies, strict=True):
        again = flown.copied(given)
        assert again.keys() == copy.keys()
        for name, value in copy.items():
            np.testing.assert_array_equal(again[name], value)


@every_api
def test_a_divergence_ends_the_episode(api):
    flown = api(seed=0)
    flown.reset()
    still = np.zeros((flown.rows, 4), np.float32)
    before = flown.observation(flown.step(still))
    row = flown.rows - 1
    flown.core.engine.qvel[row, 0] = 1e12
    given = flown.step(still)
    assert flown.terminated(given) == [False] * row + [True]
    np.testing.assert_array_equal(flown.observation(given)[row], before[row])
    assert np.isfinite(flown.observation(flown.reset())).all()
    assert not any(flown.terminated(flown.step(still)))


@every_api
@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"task": "hoover"}, "task"),
        ({"tollerance": 1.0}, "hover option"),
        ({"vehicle": "papr"}, "vehicle"),
    ],
    ids=lambda value: str(value) if isinstance(value, str) else None,
)
def test_an_unknown_name_or_value_is_refused(api, settings, name):
    with refused(name) as caught:
        api(**settings)
    if name == "hover option":  # what the API takes beside the options of the task is listed too
        assert {"vehicle", "engine", "randomization", "observe", "tolerance"} <= set(
            re.findall(r"\w+", str(caught.value))
        )


@every_api
@pytest.mark.parametrize(
    ("action", "name"),
    [
        (np.zeros(3), "action shape"),
        (np.zeros((1, 4)), "action shape"),
        (np.array([0, 0, np.nan, 0]), "action[0, 2]"),
        (np.array([0, -np.inf, 0, 0]), "action[0, 1]"),
    ],
    ids=["short", "nested", "nan", "infinite"],
)
def test_an_impossible_action_is_refused(api, action, name):
    flown = api()
    flown.reset()
    with pytest.raises((QuadrlError, RuntimeError)) as caught:
        flown.step(np.stack([action] * flown.rows))
    if isinstance(caught.value, QuadrlError):  # TorchRL itself refuses a wrong shape
        assert caught.value.name == name
    flown.step(np.zeros((flown.rows, 4), np.float32))  # nothing has broken


def test_the_import_and_a_policy_are_light_and_set_no_variable():
    code = (
        "import gymnasium, os, sys; before = dict(os.environ); import quadrl;"
        "assert dict(os.environ) == before;"
        "heavy = {'torch', 'dm_control', 'matplotlib', 'quadrl.rendering'};"
        "assert not (heavy | {'scipy'}) & set(sys.modules), heavy & set(sys.modules);"
        "import quadrl.evaluation.rollout; quadrl.Policy.pretrained('hover')([0.0] * 22);"
        "heavy |= {'tensordict', 'torchrl', 'mediapy', 'PIL'};"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules);"
        "quadrl.suite, quadrl.rendering, quadrl.testing"
    )
    python("-W", "error", "-c", code)


@pytest.mark.slow
def test_without_dm_control_its_own_api_alone_is_missing_and_says_so_in_a_line():
    code = (
        "import sys; sys.modules.update(dm_control=None, dm_env=None);"
        "from quadrl import *; import gymnasium, quadrl;"
        "from quadrl.learning import benchmark;"
        "flown = gymnasium.make('quadrl/Hover-v0'); flown.reset(seed=0);"
        "flown.step(quadrl.Policy.pretrained('hover')([0.0] * 22));"
        "calls = (lambda: quadrl.load('hover'), suite.register, lambda: envs.dm_control);"
        "\nfor call in calls:"
        "\n    try: call()"
        "\n    except ImportError as error: print(error)"
    )
    line = "dm_control's API needs dm-control: python -m pip install dm-control, "
    line += "with Python 3.12 or older; every other API works without it"
    assert python("-W", "error", "-c", code).stdout.splitlines() == [line] * 3
