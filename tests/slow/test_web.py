"""The page docs/fly: what its WebAssembly and its JavaScript compute is what Python computes.

Where a tool is missing the tests are skipped; with QUADRL_REQUIRE_WEB=1 they fail.
"""

import base64
import itertools
import json
import os
import re
import shutil
import subprocess
import time

import chromium
import numpy as np
import pytest
from safetensors.numpy import save

import quadrl
from quadrl import tasks
from quadrl.base.files import HEADER, write_safetensors
from quadrl.control.geometric import GeometricController
from quadrl.core.environment import Environment
from quadrl.deploy import web
from quadrl.evaluation.policy import SHIPPED, Policy, shipped
from quadrl.learning.checkpoint import FORMAT as CHECKPOINT

VEHICLES = web.FLYING
PAIRS = [(task, vehicle) for task in web.FLOWN for vehicle in VEHICLES]
# Sine and cosine are the C library's, and differ in the last bit between two of them.
SINES = 1e-14
TRAINED = "hover_ppo"


def need(*commands):
    """Skip without these commands, or fail where they are required."""
    missing = [command for command in commands if not shutil.which(command)]
    if "emcc" in commands and not any((web.BUILD / "wheels").glob("*.whl")):
        missing.append("the wheel that holds three.js")
    if missing:
        reason = f"not here: {', '.join(missing)}; run scripts/web"
        pytest.fail(reason) if os.environ.get("QUADRL_REQUIRE_WEB") == "1" else pytest.skip(reason)


@pytest.fixture(scope="module")
def page():
    """The page, built."""
    need("emcc", "node")
    web.main()
    return web.SITE / "index.html"


@pytest.fixture(scope="module")
def node(page):
    """Run jobs of tests/fly.mjs."""

    def run(*jobs):
        command = ["node", web.REPOSITORY / "tests/fly.mjs", web.BUILD / "book.json"]
        given = dict(input=json.dumps(jobs), capture_output=True, text=True, timeout=300)
        done = subprocess.run(command, **given)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


def begun(task, vehicle, seed=0, **settings):
    flown = VEHICLES.get(vehicle, vehicle) if isinstance(vehicle, str) else vehicle
    environment = Environment(task, vehicle=flown, engine="free_flight", seed=seed, **settings)
    return environment, environment.flatten(environment.reset())


def coordinates(environment):
    engine = environment.engine
    return np.concatenate([engine.qpos[0], engine.qvel[0], engine.act[0]])


def test_a_seed_gives_the_same_episode(node):
    jobs, expected = [], []
    for (task, vehicle), seed in itertools.product(PAIRS, (0, 7, 2**40 + 1)):
        environment, observation = begun(task, vehicle, seed)
        for episode in range(2):
            where = dict(task=task, aircraft=vehicle, seed=seed, episode=episode)
            jobs.append(dict(job="begin", **where))
            expected.append((coordinates(environment), observation[0]))
            observation = environment.flatten(environment.reset())
    for found, (place, observation) in zip(node(*jobs), expected, strict=True):
        np.testing.assert_allclose(found["coordinates"], place, rtol=SINES, atol=SINES)
        np.testing.assert_allclose(found["observation"], observation, rtol=1e-6, atol=1e-7)


def test_policies_act_as_in_python(node):
    rng, jobs, expected = np.random.default_rng(0), [], []
    policies = {file.stem: Policy.load(file) for file in shipped()}
    for name, policy in policies.items():
        if policy.task in web.FLOWN and not policy.memory:
            scale = rng.uniform(0, 3, (200, 1))  # past where the observations are clipped
            away = scale * policy.deviation * rng.normal(size=(200, policy.size))
            observation = (policy.mean + away).astype(np.float32)
            jobs.append(dict(job="act", name=name, observations=observation.tolist()))
            expected.append(policy(observation))
    assert len(jobs) > 5
    for found, action in zip(node(*jobs), expected, strict=True):
        np.testing.assert_allclose(found, action, rtol=0, atol=1e-5)


def fly(task, vehicle, controller, pushes=(), steps=200, **settings):
    """The flight in Python: what each control step saw, did and gave."""
    environment, observation = begun(task, vehicle, 3, **settings)
    engine, flown = environment.engine, []
    for step in range(steps):
        seen, action = observation[0], np.asarray(controller(observation))
        for event in (event for event in pushes if event["step"] == step):
            if event["kind"] == "push":
                engine.qvel[0] += event["values"]
            else:
                engine.wind[0] = event["values"][:3]
        now = environment.step(action)
        observation = environment.flatten(now.observation)
        kept = {name: bool(getattr(now, name)[0]) for name in ("terminated", "truncated")}
        kept |= {"observation": seen, "action": action[0], "goal": environment.goals()[0]}
        kept |= {"coordinates": coordinates(environment), "succeeded": bool(now.is_success[0])}
        flown.append(kept | {"error": now.error[0], "reward": now.reward[0]})
        if now.terminated[0]:
            break
    return flown


def compared(node, expected, task, vehicle, controller, events=(), steps=200, **place):
    """A flight in JavaScript: its last step, and the largest difference of each quantity."""
    settings = {"task": task, "aircraft": vehicle, "seed": 3}
    job = dict(job="fly", settings=settings, controller=controller, steps=steps, events=events)
    (found,) = node(job | place)
    flown = found["flown"]
    assert len(flown) == len(expected)
    assert (found["outcome"] != "") == expected[-1]["terminated"]

    def difference(name):
        pairs = zip(flown, expected, strict=True)
        # Rotor speeds by the largest, as they are observed.
        unit = np.r_[np.ones(13), VEHICLES[vehicle].max_speed] if name == "coordinates" else 1.0
        return max(
            (np.abs(np.subtract(a[name], b[name], dtype=float)) / unit).max() for a, b in pairs
        )

    return flown[-1], {name: difference(name) for name in expected[0]}


PUSHES = [
    {"step": 20, "kind": "wind", "values": [1.5, -0.5, 0.0, 0.0]},
    {"step": 40, "kind": "push", "values": [0.8, -0.4, 0.2, 1.0, -2.0, 0.0]},
]


def test_what_happens_to_an_aircraft_is_what_happens_in_python(node):
    step, events = VEHICLES["paper"].control_timestep, []
    for at, kind, *values in ((0, "payload", 0.2), (30, "payload", 0.0), (60, "rotor", 2, 0.6)):
        events.append({"step": at, "kind": kind, "values": values})
    happening = {"payload": {"mass": 0.2, "at": 30 * step}}
    happening["rotor_failure"] = {"rotor": 2, "left": 0.6, "at": 60 * step}
    policy = Policy.load(SHIPPED / f"{TRAINED}.safetensors")
    expected = fly("hover", "paper", policy, events=happening)
    _, differences = compared(node, expected, "hover", "paper", TRAINED, events)
    assert differences["coordinates"] < 1e-5 and differences["observation"] < 1e-5
    # And it is seen: neither flight is the undisturbed one.
    calm = fly("hover", "paper", policy)
    assert abs(expected[10]["error"] - calm[10]["error"]) > 0.01


@pytest.mark.parametrize("events", ([], PUSHES), ids=("calm", "pushed"))
@pytest.mark.parametrize("name", [TRAINED, "hover_robust", "target_following_robust"])
def test_a_flight_of_a_policy_is_pythons(node, name, events):
    policy = Policy.load(SHIPPED / f"{name}.safetensors")
    needed = {"observe": policy.conditions["observe"]} if name != TRAINED else {}
    expected = fly(policy.task, policy.scenario.vehicle, policy, events, **needed)
    last, differences = compared(node, expected, policy.task, "paper", name, events)
    assert last["error"] < 0.1 and differences["succeeded"] == differences["truncated"] == 0
    assert last["truncated"] == last["succeeded"] == (policy.task == "hover")
    # The action is rounded to float32 and its sums to another order: what follows is stable.
    assert differences["action"] < 1e-5 and differences["coordinates"] < 1e-5
    assert differences["observation"] < 1e-5
    if name == TRAINED:
        assert differences["error"] < 1e-6 and differences["reward"] < 1e-3


def test_a_flight_through_a_forest_is_pythons(node):
    policy = Policy.load(SHIPPED / "navigation_ppo.safetensors")
    flown, needed = policy.scenario, {"control_mode": policy.scenario.control_mode}
    expected = fly("navigation", flown.vehicle, policy, steps=400, **needed)
    last, differences = compared(node, expected, "navigation", "paper", "navigation_ppo", steps=400)
    assert last["succeeded"] and len(expected) > 250 and differences["succeeded"] == 0
    # Sums are in another order, in float32.
    wanted = "observation", "action", "coordinates", "goal", "error", "reward"
    assert all(differences[name] < 1e-5 for name in wanted), differences
    seen = np.array([step["observation"][-40:] for step in expected])
    assert np.exp(seen).min() < 2.0  # it came by trees


def test_a_flight_ends_at_a_tree(node):
    settings = {"task": "navigation", "aircraft": "paper", "seed": 3}
    job = dict(job="fly", settings=settings, controller=None, steps=400, events=[])
    outcomes = {flight["outcome"] for flight in node(*(
        job | {"settings": settings | {"seed": seed}} for seed in range(8)
    ))}  # fmt: skip
    assert "at an obstacle" in outcomes  # the controller knows of none


@pytest.mark.parametrize("task", ["random_waypoint", "target_following"])
def test_a_flight_goes_on_with_another_task_from_where_it_is(node, task):
    turn = {"step": 40, "kind": "task", "values": [[*web.FLOWN].index(task)]}
    settings = {"task": "hover", "aircraft": "paper", "seed": 3}
    (found,) = node(dict(job="fly", settings=settings, controller=None, steps=160, events=[turn]))
    environment, seen = begun("hover", "paper", 3)
    controller = GeometricController(VEHICLES["paper"], environment.task)
    for _ in range(40):
        seen = environment.flatten(environment.step(controller(seen)).observation)
    place, environment = coordinates(environment), begun(task, "paper", 3)[0]
    start = dict(position=place[:3] - environment.origin, quaternion=place[3:7])
    start |= dict(velocity=place[7:10], body_rate=place[10:13], rotor_speed=place[13:])
    environment.seed(3)
    seen = environment.flatten(environment.reset(start=start))
    controller = GeometricController(VEHICLES["paper"], environment.task)
    for there in found["flown"][40:]:
        seen = environment.flatten(environment.step(controller(seen)).observation)
        own = coordinates(environment)
        np.testing.assert_allclose(there["coordinates"], own, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(there["goal"], environment.goals()[0], atol=1e-6)


def test_an_estimate_begins_with_what_an_aircraft_can_know(node):
    observe = Policy.load(SHIPPED / "hover_robust.safetensors").scenario.observe
    environment, _ = begun("hover", "paper", 3, observe=observe)
    start, paper = coordinates(environment), VEHICLES["paper"]
    start[13:] *= 0.9
    settings = {"task": "hover", "aircraft": "paper", "seed": 3}
    job = dict(job="fly", settings=settings, controller="hover_robust", steps=1, events=[])
    (found,) = node(job | {"start": start.tolist()})
    seen = np.array(found["flown"][0]["observation"])[environment.layout["rotor_speed"]]
    np.testing.assert_allclose(seen, paper.hover_speed / paper.max_speed, rtol=1e-6)


@pytest.mark.parametrize("task, vehicle", PAIRS)
def test_a_flight_of_the_geometric_controller_is_pythons(node, task, vehicle):
    controller = GeometricController(VEHICLES[vehicle], tasks.make(task))
    expected = fly(task, vehicle, controller)
    start = coordinates(begun(task, vehicle, 3)[0]).tolist()
    _, differences = compared(node, expected, task, vehicle, None, start=start)
    # Where the goal comes from sines, a last bit can round an observation to another float32.
    bound = 0 if task in ("hover", "static_waypoint") else 1e-6
    assert max(differences.values()) <= bound, differences


def test_gusts_have_the_deviation_that_is_asked_for(node):
    mean, keep = np.array([1.0, 0.0, 0.0]), np.exp(-0.05)
    events = [{"step": 0, "kind": "wind", "values": [*mean, 0.3]}]
    job = dict(job="fly", controller=TRAINED, steps=200, events=events)
    settings = ({"task": "hover", "aircraft": "paper", "seed": seed} for seed in range(30))
    flights = node(*(job | {"settings": each} for each in settings))
    wind = np.array([[step["wind"] for step in each["flown"]] for each in flights])
    # 30 flights of 10 s with a correlation time of 1 s are about 150 numbers: 3 deviations.
    np.testing.assert_allclose(wind.mean(axis=(0, 1)), mean, atol=0.08)
    np.testing.assert_allclose(wind.std(axis=(0, 1)), 0.3, rtol=0.18)
    steps = wind[:, 1:] - mean - keep * (wind[:, :-1] - mean)
    np.testing.assert_allclose(steps.std(), 0.3 * np.sqrt(1 - keep**2), rtol=0.05)


def observing(file, **options):
    """The same file, of a policy that says it observes with these options."""
    end = 8 + int.from_bytes(file[:8], "little")
    table = json.loads(file[8:end])
    header = json.loads(table["__metadata__"][HEADER])
    header["metadata"]["observe"] = options
    table["__metadata__"][HEADER] = json.dumps(header)
    text = json.dumps(table).encode()
    return len(text).to_bytes(8, "little") + text + file[end:]


def test_files_that_cannot_fly_are_refused(node, tmp_path):
    hover, other = ((SHIPPED / f"{name}.safetensors").read_bytes()
                    for name in (TRAINED, "target_following_ppo"))  # fmt: skip
    checkpoint = tmp_path / "checkpoint.safetensors"
    write_safetensors(checkpoint, {"steps": np.arange(3)}, {"format": CHECKPOINT}, save)
    for to in ("onnx", "torch"):
        (tmp_path / to).write_bytes(quadrl.export("hover", to).read_bytes())
    cases = [
        ((tmp_path / "onnx").read_bytes(), "hover", "paper", "an ONNX model.*policy.safetensors"),
        ((tmp_path / "torch").read_bytes(), "hover", "paper", "torch.*policy.safetensors"),
        (hover, "hover", "paper", "^$"),
        (hover, "random_waypoint", "paper", "^$"),
        (hover, "hover", "hexa", "4 rotors"),
        (hover, "hover", "crazyflie", "layout"),
        (other, "hover", "paper", "observes"),
        *(
            (observing(hover, **options), "hover", "paper", pattern)
            for options, pattern in (
                ({"rotor_speed": "estimated"}, "^$"),
                ({"rotor_speed": "none"}, "observes rotor_speed none"),
                ({"sensors": {"compass": {}}}, "observes the sensor compass"),
                ({"sensors": {"aim": {"near": 1.0}}}, "observes aim with its own near"),
                ({"sensors": {"aim": {}}}, "observes 22 numbers; hover shows 19"),
                ({"sensors": {"aim": {"beside_goal": True}}}, "^$"),
                ({"sensors": {"standard": {}}}, "observes 22 numbers; hover shows 31"),
            )
        ),
        *((part, "hover", "paper", "damaged") for part in (hover[:1000], hover[:-8], b"", b"no")),
        (b"\x02" + bytes(7) + b"{}", "hover", "paper", "no policy"),
        (checkpoint.read_bytes(), "hover", "paper", "checkpoint.*policy.safetensors"),
    ]
    jobs = [
        dict(job="read", file=base64.b64encode(file).decode(), task=task, aircraft=vehicle)
        for file, task, vehicle, _ in cases
    ]
    for message, (*_, pattern) in zip(node(*jobs), cases, strict=True):
        assert re.search(pattern, message), message


def test_a_link_keeps_the_settings(node):
    settings = {"task": "static_waypoint", "aircraft": "racer", "left": "static_waypoint_ppo"}
    others = [{"step": 9, "kind": "rotor", "values": [3, 0.5]}]
    others.append({"step": 9, "kind": "payload", "values": [0.25]})
    settings |= {"right": "geometric", "seed": 12, "at": 34, "events": PUSHES + others}
    (found,) = node(dict(job="link", settings=settings))
    assert found == settings
    wrong = "#task=constructor&aircraft=%3Cb%3E&seed=-1&at=1e99"
    wrong += "&events=push@1:1;wind@x:1,2,3,4;payload@1:-2"
    (found,) = node(dict(job="open", fragment=wrong))
    assert found == {"task": "hover", "aircraft": "paper", "left": "", "right": "geometric",
                     "seed": 0, "at": 20000, "events": []}  # fmt: skip
    fragments = (wrong, "#nonsense", "", "#task=hover&seed=7&events=push@1:1,0,0,0,0,0")
    unread = node(*(dict(job="unread", fragment=fragment) for fragment in fragments))
    assert unread == [["task", "aircraft", "seed", "at", "events"], ["nonsense"], [], []]


def test_a_flight_that_fails_says_why(node):
    level = np.array([0, 0, 3, 1, 0, 0, 0, *np.zeros(6), *VEHICLES["paper"].hover_speed])
    away, over, low = level.copy(), level.copy(), level.copy()
    away[0], over[3:5], low[2] = 3.5, (0, 1), 0.01
    settings = {"task": "hover", "aircraft": "paper", "seed": 3}
    job = dict(job="fly", settings=settings, controller=TRAINED, steps=2, events=[])
    outcomes = [
        flight["outcome"]
        for flight in node(*(job | {"start": x.tolist()} for x in (away, over, low)))
    ]
    assert outcomes == ["more than 3 m away", "tipped over", "on the ground"]


TIME = "Number(document.documentElement?.dataset.time)"  # [s]; JavaScript
STAYS = "!document.getElementById('problem').textContent"


def metres(side):
    """JavaScript: the error that the page shows of a side [m]."""
    return f"Number(document.getElementById('{side}-error').dataset.metres)"


@pytest.fixture
def browse(page, tmp_path):
    """Open the page with a fragment."""
    need("chromium")
    return lambda fragment: chromium.Page(page.as_uri() + fragment, tmp_path / "profile")


def test_the_page_flies_and_is_pushed(browse):
    with browse("#task=hover&aircraft=paper&seed=3") as shown:
        shown.wait(f"{TIME} > 4.5")
        for side in ("left", "right"):
            assert shown.value(metres(side)) < 0.08
        shown.press("ArrowLeft")
        shown.wait(f"{metres('left')} > 0.15 && {metres('right')} > 0.15")
        shown.press(" ")
        paused = shown.value(TIME)
        shown.press("l")
        shown.wait("/at=[1-9]\\d+&events=push@\\d+:/.test(location.hash)")
        time.sleep(1)
        assert shown.value(TIME) - paused < 0.3  # a figure behind at most
        errors = [shown.value(metres(side)) for side in ("left", "right")]
        link = shown.value("location.hash")
        assert shown.value(STAYS) and not shown.complaints
    with browse(link) as again:  # another page shows the same moment
        again.wait(f"{TIME} > 0")
        assert [again.value(metres(side)) for side in ("left", "right")] == errors
        assert again.value(STAYS) and not again.complaints


def test_every_task_and_aircraft_is_shown(browse):
    with browse("") as shown:
        shown.wait(f"{TIME} > 0")
        for task, vehicle in PAIRS:
            shown.value(f"location.hash = 'task={task}&aircraft={vehicle}&at=10'")
            shown.wait(f"document.getElementById('task').value === '{task}'")
            pressed = "document.querySelector('#aircraft [aria-pressed=true]')"
            shown.wait(f"{pressed}?.value === '{vehicle}'")
            flown = 10 * VEHICLES[vehicle].control_timestep
            shown.wait(f"Math.abs({TIME} - {flown}) < 0.01")
            # The gates of a race are farther apart than other goals, and a forest is 30 m long.
            far = {"race": 20, "navigation": 30}.get(task, 3)
            assert shown.value(metres("left")) < far
        assert shown.value(STAYS) and not shown.complaints


# What stands outside of its panel or of the window, and panels that scroll sideways; JavaScript.
OUTSIDE = """(() => {
  const inside = (own, { left, right }) => own.left > left - 0.5 && own.right < right + 0.5;
  const controls = [...document.querySelectorAll("button, select, input, .drop, output, dd, kbd")];
  const lost = controls.filter((one) => {
    const own = one.getBoundingClientRect(), panel = one.closest("header, aside, .view, #stage");
    const window = { left: 0, right: document.documentElement.clientWidth };
    return own.width && !(inside(own, panel.getBoundingClientRect()) && inside(own, window));
  });
  const wide = [...document.querySelectorAll("html, header, aside, .choice, .row, .view, figure")];
  const scroll = wide.filter((one) => one.scrollWidth > one.clientWidth);
  return [...lost, ...scroll].map((one) => one.id || one.value || one.className || one.tagName);
})()"""


def test_every_control_lies_inside_its_panel(browse):
    with browse("#task=hover&aircraft=crazyflie_brushless&seed=3") as shown:
        shown.wait(f"{TIME} > 0")
        for width in (360, 390, 480, 560, 561, 640, 768, 900, 901, 1024, 1366, 1600, 1920):
            size = dict(width=width, height=900, deviceScaleFactor=1, mobile=False)
            shown.ask("Emulation.setDeviceMetricsOverride", **size)
            shown.wait(f"innerWidth === {width}")
            assert shown.value(OUTSIDE) == [], width
        buttons = "[...document.querySelectorAll('#aircraft button')].map((one) => one.value)"
        assert shown.value(buttons) == [*VEHICLES]


def test_an_error_is_shown_with_its_digits(browse):
    units = {"m": 1, "cm": 0.01, "mm": 1e-3, "µm": 1e-6}
    with browse("#task=hover&aircraft=paper&seed=3") as shown:
        for moment in (0, 3, 8):
            shown.wait(f"{TIME} > {moment}")
            for side in ("left", "right"):
                text = f"document.getElementById('{side}-error').textContent"
                number, unit, metres_ = shown.value(f"`${{{text}}} ${{{metres(side)}}}`").split()
                metres_ = float(metres_)
                error = abs(float(number) * units[unit] - metres_)
                assert error <= max(0.06 * metres_, 1e-6), (number, unit)


def test_a_dropped_policy_flies(browse, tmp_path):
    mine, other = tmp_path / "mine.safetensors", tmp_path / "other.safetensors"
    mine.write_bytes((SHIPPED / "hover_trpo.safetensors").read_bytes())
    other.write_bytes(b"nothing")
    with browse("#task=target_following&aircraft=racer") as shown:
        shown.wait(f"{TIME} > 0")
        shown.give("#file", mine)  # goes to its own task and aircraft
        chosen = "document.getElementById('left-controller').value"
        shown.wait(f"{chosen} === 'my mine' && document.getElementById('task').value === 'hover'")
        shown.wait(f"{TIME} > 4")
        assert shown.value(metres("left")) < 0.1
        shown.give("#file", other)
        shown.wait("/damaged/.test(document.getElementById('note').textContent)")
        assert shown.value(chosen) == "my mine" and not shown.complaints


def test_the_page_asks_no_other_host(page):
    document = page.read_text()
    assert "default-src 'none'" in document
    # Names of formats and licences stand in three.js; nothing is loaded from anywhere.
    assert not re.search(r"<(script|link|img|iframe)[^>]+(src|href)=.https?:", document)
    own = "".join(file.read_text() for file in web.SOURCE.iterdir())
    assert not re.search(r"https?://|fetch\(|XMLHttpRequest|WebSocket", own)
