"""What actions reach: exactly, in warnings, on the robustness card, and in `quadrl check`."""

import csv
import dataclasses
import json
import math
from typing import Any

import helpers
import numpy as np
import pytest
from runs import TINY
from scipy.optimize import linprog

import quadrl
from quadrl import cli
from quadrl.aircraft.parameters import rows
from quadrl.aircraft.presets import VEHICLES, in_real_air
from quadrl.aircraft.rotors import GRAVITY, mixer, ring
from quadrl.aircraft.specification import resolve
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base import units
from quadrl.base.errors import QuadrlWarning
from quadrl.conditions.sampler import AircraftSampler, vehicle_of
from quadrl.control import feasibility, modes
from quadrl.control.feasibility import MARGIN, Reach, limit, unreached
from quadrl.evaluation import card_figures
from quadrl.evaluation.card import Card
from quadrl.evaluation.check import OK, angular_acceleration, height_to_turn_over
from quadrl.evaluation.disturbances import DISTURBANCES
from quadrl.evaluation.policy import Policy, shipped
from quadrl.learning.variants import VARIANTS

PAPER = Vehicle()
# Action 1 commands 225.68 + 35 = 260.68 rad/s, which carry (260.68 / 225.68)^2 times the weight;
# action -1 commands 190.68 rad/s.
MOST, LEAST = (260.68 / 225.68) ** 2, (190.68 / 225.68) ** 2
WEAK = {"one_rotor": 0.7}
SLOW = dataclasses.replace(VEHICLES["hexa"], control_timestep=0.05)
SHORT = {"episodes": 1, "time_limit": 0.5}


# ------------------------------------------------------------------------------- the arithmetic


@pytest.mark.parametrize("name", ["paper", "racer", "hexa", "eight", "leaning"])
def test_loads_are_the_least_and_the_most_of_a_linear_program(name):
    vehicle = helpers.LAYOUTS[name]
    count, generator = vehicle.rotor_count, np.random.default_rng(3)
    table = np.repeat(rows(vehicle), 12)
    rotor = table["rotor"][:, :count]
    for field in ("thrust_coefficient", "torque_coefficient"):
        rotor[field] *= generator.uniform(0.6, 1.2, (12, count))
    reach, solved = Reach(vehicle, table), 0
    found = np.array(reach.loads(vehicle.action_scale))
    low, high = (speed**2 for speed in reach.speeds(vehicle.action_scale))
    for k, row in enumerate(table):
        matrix = mixer(row["rotor"][:count])
        scaled = matrix / np.abs(matrix).max(axis=1, keepdims=True)
        weight = vehicle.mass * GRAVITY / np.abs(matrix[0]).max()
        for end, sign in ((0, 1.0), (1, -1.0)):
            answer = linprog(
                sign * scaled[0],
                A_eq=scaled[1:],
                b_eq=np.zeros(3),
                bounds=[*zip(low[k], high[k], strict=True)],
            )
            if answer.status == 2:  # no thrust without a moment
                assert found[1, k] < found[0, k]
                continue
            assert found[end, k] == pytest.approx(sign * answer.fun / weight, rel=1e-6)
            solved += 1
    assert solved >= 6


@pytest.mark.parametrize(
    ("axis", "expected"),
    [
        ("mass", [LEAST, MOST]),
        ("thrust", [None, 100 * (1 - 1 / MOST)]),
        ("one_rotor", [None, 100 * (1 - 1 / MOST)]),
        ("inertia", [None, None]),
        ("delay", [None, None]),
        ("wind", [None, None]),
    ],
)
def test_where_a_disturbance_goes_beyond_the_actions(axis, expected):
    of = DISTURBANCES[axis]
    for end, level in zip((of.levels[0], of.levels[-1]), expected, strict=True):
        found = limit(of.at, of.usual, end, PAPER)
        assert found == (level if level is None else pytest.approx(level, rel=1e-4))
    mass, wide = DISTURBANCES["mass"], resolve("paper", {"action_scale": 90})
    # 225.68 + 90 = 315.68
    assert limit(mass.at, 1.0, 1.3, wide) == pytest.approx((315.68 / 225.68) ** 2, rel=1e-4)


# ------------------------------------------------------------------------- evaluate and train


def test_evaluate_says_what_no_policy_can_do():
    # 225.68 / sqrt(0.7) = 269.7
    words = r"100 % .* rotor \d of .* 269\.7 rad/s, .* 1 commands 260\.7 rad/s.*action_scale=70$"
    with pytest.warns(QuadrlWarning, match=words) as said:
        quadrl.evaluate("geometric", "hover", randomization=WEAK, **SHORT)
    assert len(said) == 1 and said[0].filename == __file__


def test_the_scale_that_is_named_is_enough():
    for drawn in (WEAK, {"mass": (0.5, 1.0)}, {"mass": (1.0, 1.5)}):
        share, lack, enough = unreached(PAPER, AircraftSampler(drawn, PAPER))
        wide = resolve("paper", {"action_scale": enough})
        assert unreached(wide, AircraftSampler(drawn, wide))[0] == 0
        table = np.concatenate(feasibility.samples(AircraftSampler(drawn, wide)))
        assert Reach(wide, table).loads(enough)[1].min() >= MARGIN * (1 - 1e-6)
        if drawn == {"mass": (1.0, 1.5)}:
            assert share == pytest.approx((1.5 - MOST) / 0.5, abs=0.03)
        if drawn == {"mass": (0.5, 1.0)}:  # too light: -1 asks for too much
            assert "an action of -1 commands 190.7" in lack and share > feasibility.FEW


def test_a_policy_is_warned_about_in_its_own_conditions():
    own = Policy.pretrained("hover")
    weak = dataclasses.replace(own, metadata=own.metadata | {"randomization": WEAK})
    with pytest.warns(QuadrlWarning, match="269.7 rad/s"):
        quadrl.evaluate(weak, **SHORT)
    quadrl.evaluate(weak, randomization="none", **SHORT)


@pytest.mark.parametrize("name", sorted(file.stem for file in shipped()))
def test_what_ships_can_hover_wherever_it_was_trained(name):
    policy, robust = Policy.pretrained(name), "_robust" in name
    vehicle = policy.scenario.aircraft
    given = policy.conditions.get("randomization")
    assert "mass" in (given or {}) or not robust
    flown = modes.kind(policy.control_mode).reach(vehicle)
    assert unreached(flown, AircraftSampler(given, vehicle))[0] == 0


def test_the_variant_robust_and_the_preset_light_are_flown_without_a_warning():
    drawn = VARIANTS["robust"]["randomization"]
    wide = resolve("paper", {"action_scale": 90})
    feasibility.warn_of_unreached(wide, drawn)
    for vehicle in VEHICLES.values():
        feasibility.warn_of_unreached(vehicle, "light")
    # A corner of one in a hundred is no reason; a quarter is.
    racer = resolve("racer", {"action_scale": 150})
    assert 0 < unreached(racer, AircraftSampler("full", racer))[0] < feasibility.FEW
    feasibility.warn_of_unreached(racer, "full")
    with pytest.warns(QuadrlWarning, match="28 %"):
        feasibility.warn_of_unreached(resolve("crazyflie", {"action_scale": 200}), "full")


@pytest.mark.parametrize("name", VEHICLES)
def test_the_presets_draw_no_aircraft_that_is_refused_or_cannot_hover(name):
    for vehicle in (VEHICLES[name], in_real_air(VEHICLES[name])):
        for drawn in ("light", "full"):
            sampler = AircraftSampler(drawn, vehicle)
            table, corners = feasibility.samples(sampler)
            # With every number at an end at once, which nothing draws, the paper's aircraft would
            # need 43 of its 35 rad/s.
            if (name, drawn) != ("paper", "full"):
                table = np.concatenate([table, corners])
            assert Reach(vehicle, table).carries(vehicle.action_scale).all()
            for row in np.concatenate([table[::64], corners[::16]]):
                vehicle_of(vehicle, row)


def test_no_torque_is_drawn_with_which_a_rotor_would_make_power():
    # The hexacopter's discs have a merit of 0.659; with 1.05 * 1.04 of the thrust and 0.96 of the
    # torque it is 0.659 * 1.092^1.5 / 0.96 = 0.783, which a torque factor below that would pass 1.
    air = in_real_air(VEHICLES["hexa"])
    lowest = {}
    for vehicle in (VEHICLES["hexa"], air, in_real_air(PAPER)):
        sampler = AircraftSampler("full", vehicle)
        torque = sampler.low[sampler.names.index("torque")]
        lowest[vehicle.name, vehicle.aerodynamics.uses_discs] = torque
    assert lowest["hexa", True] == pytest.approx(0.783, abs=1e-3)
    assert lowest["hexa", False] == lowest["paper", True] == 0.7
    with helpers.refused("torque", lists="1.21", match="momentum theory"):  # 0.659 * 1.5^1.5
        AircraftSampler({"thrust": (1.0, 1.5), "torque": (0.8, 1.2)}, air)
    # With the specified thrust the torque is raised to what its power needs.
    raised = AircraftSampler({"torque": (0.6, 1.2)}, air)
    assert raised.low[raised.names.index("torque")] == pytest.approx(0.659, abs=1e-3)


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ({"action_scale": 1000}, "actions over 0.093 change nothing"),
        ({"control_timestep": 1.0}, "an action lasts longer than the rotors take"),
    ],
)
def test_what_no_policy_can_make_up_for_is_said(numbers, said):
    with pytest.warns(QuadrlWarning, match=said):
        feasibility.warn_of_unreached(dataclasses.replace(VEHICLES["paper"], **numbers), "none")


def test_a_mode_whose_loops_answer_at_each_physics_step_holds_no_command_for_long():
    slow = dataclasses.replace(VEHICLES["paper"], control_timestep=1.0)
    feasibility.warn_of_unreached(slow, "none", "velocity")  # a warning is an error here


def test_train_says_it_before_it_begins(tmp_path, monkeypatch):
    def begin(*_, **__):
        raise InterruptedError

    monkeypatch.setattr("quadrl.learning.run.Training", begin)
    settings = {"randomization": WEAK, "algo": "ppo", "episodes": 1}
    with pytest.warns(QuadrlWarning, match="269.7 rad/s") as said, pytest.raises(InterruptedError):
        quadrl.train(TINY, out=tmp_path / "run", **settings)
    assert len(said) == 1


# ---------------------------------------------------------------------------------- the card


@pytest.fixture(scope="module")
def card():
    own = Policy.pretrained("hover")
    options = {"vehicle_options": {"action_scale": 20.0}}
    narrow = dataclasses.replace(own, metadata=own.metadata | options)
    given = {"disturbances": ("mass", "delay"), "recovery": False, "progress": False}
    return quadrl.robustness({"usual": own, "narrow": narrow}, **given, **SHORT)


@pytest.mark.slow
def test_a_card_knows_what_the_actions_of_each_that_flew_reach(card, tmp_path):
    reach = card.found["axes"]["mass"]["reach"]
    assert reach["usual"] == pytest.approx([LEAST, MOST], rel=1e-4)
    ends = [((225.68 + sign * 20) / 225.68) ** 2 for sign in (-1, 1)]
    assert reach["narrow"] == pytest.approx(ends, rel=1e-4)
    assert card.found["axes"]["delay"]["reach"] == {"usual": [None] * 2, "narrow": [None] * 2}
    assert "mass [of the specified] under 0.714 or over 1.33 (usual), under 0.831" in card.reach
    assert "delay" not in card.reach and card.reach in card._repr_html_()
    card.save(tmp_path / "card")
    assert Card.load(tmp_path / "card").found == card.found


def test_a_card_says_who_turns_and_circles(card, tmp_path):
    card.save(tmp_path / "card")
    with open(tmp_path / "card" / "robustness.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["level"] in ("1.0", "0.0")]
    for name, words in (("yaw_rate_rad_s", "turning"), ("circling_m_s", "circling")):
        reached = card.found["axes"]["mass"]["flown"]["usual"][name]
        assert len(reached) == len(card.found["axes"]["mass"]["levels"])
        undisturbed = reached[card.found["axes"]["mass"]["levels"].index(1.0)]
        (row,) = (row for row in card.table if row[0] == f"{words}, undisturbed")
        assert row[1] == units.quantity(name, undisturbed) and len(row) == 3
        usual = [float(row[name]) for row in rows if row["flown"] == "usual"]
        assert usual == [undisturbed] * 2


def drawn(found):
    figure = card_figures.card(found)
    patches: list[Any] = [panel.patches for panel in figure.axes]
    hatched = [[patch for patch in of if patch.get_hatch()] for of in patches]
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    return hatched, any("beyond the reach" in text for text in texts)


def test_a_picture_is_hatched_from_there_on(card):
    hatched, named = drawn(card.found)
    assert named and [len(patches) for patches in hatched] == [4, 0, 4, 0]
    boxes = [patch.get_bbox() for patch in hatched[0]]
    # The two ends of each that flew; those of the usual one lie beyond the levels, 0.8 to 1.3.
    ends = sorted([box.x1 for box in boxes if box.x1 < 1] + [box.x0 for box in boxes if box.x0 > 1])
    assert ends == pytest.approx([LEAST, 0.831, 1.185, MOST], abs=1e-3)
    far = json.loads(json.dumps(card.found)) | {"flown": ["usual"]}
    far["axes"]["mass"]["reach"] = {"usual": [0.3, 1.9]}  # farther than is shown
    assert drawn(far) == ([[], [], [], []], False)


# ------------------------------------------------------------------------------------- check


def found(**given):
    return {row.quantity: row for row in quadrl.check(**given).rows}


@pytest.mark.parametrize("name", VEHICLES)
def test_the_aircraft_that_come_with_quadrl_are_ok(name):
    rows = found(vehicle=name)
    late = rows.pop("longest delay")
    assert late.value == pytest.approx({"crazyflie": 10, "crazyflie_brushless": 5}.get(name, 0))
    assert late.verdict == OK or (late.value and "action_history=1" in late.verdict)
    assert {row.verdict for row in rows.values()} == {OK}


def test_the_dead_time_counts_in_the_loop():
    plain, late = found(), found(vehicle={"dead_time": 0.03}, randomization={"command_delay": 0.06})
    assert late["longest delay"].value == pytest.approx(90) and plain["longest delay"].value == 0
    assert "action_history=2" in late["longest delay"].verdict
    expected = math.pi / 4 / (0.18 + 0.09 + 0.05 / 2)
    assert late["attitude bandwidth"].value == pytest.approx(expected)
    looped = found(vehicle={"dead_time": 0.03}, control_mode="velocity")
    assert looped["longest delay"].value == pytest.approx(30)


def test_the_rows_of_the_paper_by_worked_numbers():
    seen = {name: row.value for name, row in found().items()}
    # 4 k_Q (260.68^2 - 225.68^2 + 225.68^2 - 190.68^2) / 2 / J_z: both pairs of rotors at their
    # ends, which change the moment from -2 k_Q to 2 k_Q of the squares.
    yaw = 2 * 7.5e-7 * (260.68**2 - 190.68**2) / 1.3e-2
    # Roll: the left rotor at its largest, the right one at its smallest.
    roll = 0.23 * 3.13e-5 * (260.68**2 - 190.68**2) / 7.5e-3
    for name, value in {
        "hover speed": 225.68,
        "hover over largest speed": 100 / math.sqrt(2),
        "tip speed in hover": 225.68 * PAPER.rotors[0].disc,
        "thrust over weight, action 1": MOST,
        "thrust over weight, limits": 2.0,
        # 9e-3 v^2 = 0.65 g sqrt(MOST^2 - 1)
        "steady wind held, action 1": math.sqrt(0.65 * 9.81 * math.sqrt(MOST**2 - 1) / 9e-3),
        "suggested action_scale": 35.0,
        "yaw acceleration, action 1": yaw,
        "roll acceleration, action 1": roll,
        "fastest rotor rate times step": 0.01 / 0.18,
        "resolved body rate": PAPER.resolved_turn,
        "slowest rotor lag": 180.0,
        "attitude bandwidth": math.pi / 4 / (0.18 + 0.05 / 2),
    }.items():
        assert seen[name] == pytest.approx(value, rel=1e-3), name


def test_rotor_drag_takes_from_the_wind_that_is_held():
    name = "steady wind held, action 1"
    assert found(aerodynamics="full")[name].value < 0.9 * found()[name].value
    still = resolve("paper", {"drag_coefficient": 0.0})
    assert found(vehicle=still)[name].value == math.inf


@pytest.mark.parametrize(
    ("given", "quantity", "words"),
    [
        ({"vehicle_options": {"action_scale": 10}}, "thrust over weight, action 1", "scale=22"),
        ({"vehicle_options": {"action_scale": 10}}, "suggested action_scale", "then the worst"),
        ({"vehicle_options": {"action_scale": 150}}, "action 1 over largest speed", "0.62"),
        ({"vehicle_options": {"mass": 1.2}}, "thrust over weight, limits", "stronger rotors"),
        ({"vehicle_options": {"mass": 1.2}}, "thrust over weight, action 1", "stronger rotors"),
        ({"randomization": {"mass": 1.3}}, "thrust over weight, worst drawn", "draw less"),
        ({"randomization": WEAK}, "drawn that cannot hover", "269.7 rad/s"),
        ({"time_limit": 3.0}, "yaw acceleration, action 1", "half a turn takes 1.9 s"),
        ({"randomization": {"command_delay": 0.06}}, "longest delay", "action_history=2"),
        ({"randomization": {"observation_delay": 0.1}}, "longest delay", "action_history=2"),
        ({"randomization": {"lag": 2.5}}, "attitude bandwidth", "until it is level"),
        ({"vehicle": SLOW}, "time between two commands", "control_timestep=0.025"),
        # Where the task leaves the heading free it needs no time to turn.
        ({"task": "random_waypoint", "time_limit": 3.0}, "yaw acceleration, action 1", OK),
    ],
)
def test_what_is_wrong_is_said_with_what_to_do(given, quantity, words):
    row = found(**given)[quantity]
    assert (row.verdict == OK) == (words == OK) and words in row.verdict


def test_coefficients_in_another_unit_show_in_the_speed_of_the_tips():
    # As a file of others gives them, per rpm^2: hover at 14,476 "rad/s" x 0.0231 m = 334 m/s.
    one = ring((45, 135, 225, 315), (-1, 1, -1, 1), 0.04, thrust_coefficient=3.16e-10,
               torque_coefficient=7.94e-12, lag_up=20.0, lag_down=20.0, max_speed=21_700.0,
               radius=0.0231)  # fmt: skip
    small = resolve("crazyflie", {"mass": 0.027, "action_scale": 3600.0})
    row = found(vehicle=dataclasses.replace(small, rotors=one))["tip speed in hover"]
    assert row.value == pytest.approx(334.4, rel=1e-3) and "not of rpm" in row.verdict


@pytest.mark.parametrize("name", quadrl.VEHICLES)
def test_tips_of_the_aircraft_that_come_with_quadrl_are_slow(name):
    assert found(vehicle=name)["tip speed in hover"].verdict == OK


def test_loops_answer_at_the_physics_step():
    looped, direct = (found(control_mode=mode) for mode in ("velocity", "rotor"))
    assert looped["time between two commands"].value == pytest.approx(10.0)
    assert looped["attitude bandwidth"].value > direct["attitude bandwidth"].value
    late = {"randomization": {"observation_delay": 0.1}}  # they see the true state
    assert found(control_mode="velocity", **late)["longest delay"].value == 0


def test_the_command_prints_rows_or_json(capsys):
    words = ["landing", "--vehicle", "crazyflie", "--randomization", "full"]
    cli.main(["check", *words])
    table = capsys.readouterr().out
    assert "thrust over weight, worst drawn" in table and "…" not in table
    cli.main(["check", *words, "--json"])
    read = json.loads(capsys.readouterr().out)
    assert read["vehicle"] == "crazyflie"
    values = {row["quantity"]: row for row in read["rows"]}
    assert values["slowest rotor lag"]["value"] == pytest.approx(2 * 87, rel=0.05)
    assert values["drawn that cannot hover"]["unit"] == "%"
    cli.main(["check", "--vehicle-options", "action_scale=10", "--task-options", "time_limit=3"])
    assert "action_scale=22" in capsys.readouterr().out


@pytest.mark.parametrize(("name", "scale"), [("paper", 35.0), ("crazyflie", 500.0)])
def test_the_height_to_turn_over_is_that_of_a_planar_flight(name, scale):
    vehicle, step = resolve(name), 1e-5
    least, most = (float(load[0]) for load in Reach(vehicle).loads(scale))
    turning = angular_acceleration(vehicle, scale)[:2].max()
    tilt, rate, height, speed = math.pi, 0.0, 0.0, 0.0
    while tilt > 1e-3 and rate <= 0:  # half round, braked from a quarter on
        rate += (-turning if tilt > math.pi / 2 else turning) * step
        tilt += rate * step
        speed += GRAVITY * ((least + most) / 2 * math.cos(tilt) - 1) * step
        height += speed * step
    lost = speed**2 / (2 * GRAVITY * (most - 1)) - height
    found = height_to_turn_over(vehicle, scale)
    assert found == pytest.approx(lost, rel=0.01)
    assert height_to_turn_over(vehicle, 0.0) == math.inf  # nothing but hover
