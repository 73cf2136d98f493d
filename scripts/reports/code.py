"""Parts of the pages that come from the code: tasks, actions, aircraft with sources, commands."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
from collections.abc import Iterable, Mapping
from typing import Any

from quadrl import VEHICLES, cli, tasks
from quadrl.aircraft import presets, rotors
from quadrl.aircraft.rotors import GRAVITY, Rotor
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.docstrings import docstrings
from quadrl.cli.flown import Conditioned
from quadrl.cli.new import content
from quadrl.cli.tasks import observation_rows, reward_rows
from quadrl.conditions.observing import Observing
from quadrl.conditions.randomization import Errors, Pushes, Randomization, Sizes
from quadrl.conditions.randomizations import RANDOMIZATIONS
from quadrl.control import CONTROL_MODES
from quadrl.control.modes import modes_of
from quadrl.core import snapshot
from quadrl.core.scenario import Conditions
from quadrl.engines import state
from quadrl.learning.description import describe, describe_action
from quadrl.learning.foreign import COLUMNS
from scripts.reports.report import Parts, table

FIRST_SOURCE = "gym-aero"
"""What the docstrings of a Vehicle name in brackets, for the numbers of the paper's aircraft."""


def shown(value: Any) -> str:
    """A value in few characters."""
    if isinstance(value, tuple):
        return ", ".join(map(shown, value))
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)


def task_table(columns: Mapping[str, str]) -> str:
    """Attributes of each task by the heads of the columns."""
    rows = (
        (f"[`{name}`](tasks/{name}.md)", *(shown(getattr(task, x)) for x in columns.values()))
        for name, task in tasks.TASKS.items()
    )
    return table(("task", *columns), rows)


def control_modes() -> str:
    """What the control modes ask for, and how much of it on each aircraft."""
    rows = []
    for name, kind in CONTROL_MODES.items():
        modes = [kind(x) for x in VEHICLES.values() if name in modes_of(x)]
        terms = [(f"{term.name}: {term.meaning}", term.unit) for term in modes[0].terms]
        if not kind.has_loops:  # as many terms as rotors, and all alike
            at_0 = "half the largest" if name.startswith("share") else "hover"
            order = ", clockwise from ahead on the right" if kind.quadrotors_alone else ""
            said = f"one number per rotor{order}: its speed command, from {at_0}"
            terms = [(said, terms[0][1])]
        for k, term in enumerate(terms):
            ends = ((f"{mode.scale[k]:.3g}", f"{mode.scale_down[k]:.3g}") for mode in modes)
            scales = (up if up == down else f"{up} up, {down} down" for up, down in ends)
            scales = [*scales, *[""] * (len(VEHICLES) - len(modes))]
            rows.append((f"`{name}`" if k == 0 else "", *term, *scales))
    scales = (f"scale, {name}" for name in VEHICLES)
    return table(("`control_mode=`", "what it asks for", "unit", *scales), rows)


def every_task(rows: Any, *head: str) -> str:
    """What `quadrl tasks` shows of all tasks, with the names as code."""
    written = rows([describe(tasks.make(name)) for name in tasks.TASKS])
    return table(head, ((f"`{name}`", *rest) for name, *rest in written))


def thrust_over_weight(vehicle: Vehicle) -> float:
    """At the largest rotor speeds."""
    thrust = sum(r.thrust_coefficient * r.max_speed**2 * r.axis[2] for r in vehicle.rotors)
    return thrust / (vehicle.mass * GRAVITY)


def vehicles() -> str:
    """The aircraft that come with quadrl."""
    rows = []
    for name, v in VEHICLES.items():
        cells = [f"`{name}`", f"{v.mass:g} kg", v.rotor_count, f"{v.size:.3g} m"]
        cells.append(f"{1 / v.rotors[0].lag_up:.3g} s, {1 / v.rotors[0].lag_down:.3g} s")
        cells.append(f"{thrust_over_weight(v):.2g}")
        rows.append([*cells, f"{v.physics_timestep:g} s, {v.control_timestep:g} s"])
    head = ("vehicle", "mass", "rotors", "arm", "time constants, up and down")
    return table((*head, "thrust over weight", "physics and control step"), rows)


def aircraft(name: str) -> str:
    """Every number of an aircraft that is known by name, with its source."""
    vehicle, sources = VEHICLES[name], written_sources(name)
    about = sources.pop("name", "The paper's; the default")
    rows: list[tuple[str, ...]] = []
    for kind, owner in ((Vehicle, vehicle), (Rotor, vehicle.rotors[0])):
        for field, text in docstrings(kind).items():
            if field in ("name", "rotors", "position", "spin", "axis", "aerodynamics"):
                continue
            first = FIRST_SOURCE if name == "paper" and FIRST_SOURCE in text else ""
            label = f"`{field}`" if kind is Vehicle else f"rotor: `{field}`"
            meaning = text.replace(f" ({FIRST_SOURCE})", "")
            rows.append((label, shown(getattr(owner, field)), meaning, sources.get(field, first)))
    rows.append(("hover speed", shown(vehicle.hover_speed[0]), "Of a rotor [rad/s]", "follows"))
    ratio = f"{thrust_over_weight(vehicle):.3g}"
    rows.append(("thrust over weight", ratio, "At the largest rotor speeds", "follows"))
    for k, rotor in enumerate(vehicle.rotors):
        where = ", ".join(f"{x:.3g}" for x in rotor.position)
        way = "counter-clockwise" if rotor.spin > 0 else "clockwise"
        source = sources.get("arm", sources.get("spin", "")) if k == 0 else ""
        rows.append((f"rotor {k + 1}", where, f"Where its thrust acts [m]; turns {way}", source))
    head = ("parameter", "value", "meaning and unit", "source")
    return f"{about[0].upper()}{about[1:]}.\n\n{table(head, rows)}"


def written_sources(name: str) -> dict[str, str]:
    """Comments beside the numbers of an aircraft in quadrl/aircraft, by parameter."""
    code = inspect.getsource(rotors if name == "paper" else presets)
    start = "PAPER_ROTORS = plus(" if name == "paper" else f"\n{name.upper()} = Vehicle("
    found: dict[str, str] = {}
    above = ""
    for line in code.partition(start)[2].partition("\n)\n")[0].splitlines():
        number, _, comment = line.partition("  # ")
        if line.strip().startswith("# "):
            above = line.strip().removeprefix("# ")
            continue
        key = re.match(r"\s*(\w+)=", number)
        if text := "; ".join(filter(None, [above.rstrip("."), comment])):
            found[key[1] if key else "arm"] = text
        above = ""
    return found


def new(what: str, name: str) -> str:
    """The file that `quadrl new-task` or `quadrl new-aircraft` writes."""
    return f"```python\n{content(what, name)}```"


def command(name: str) -> str:
    """What a command does, and its options."""
    kind, rows, meanings = cli.COMMANDS[name], [], docstrings(cli.COMMANDS[name])
    for field in dataclasses.fields(kind):
        if not (meaning := meanings.get(field.name)):
            continue
        option = f"--{field.name.replace('_', '-')}"
        if "Positional" in str(field.type):
            option = field.name.upper()
        none = field.default in (dataclasses.MISSING, "", (), None)
        rows.append((f"`{option}`", "" if none else f"`{field.default}`", f"{meaning}."))
    if issubclass(kind, Conditioned):
        rows.insert(0, ("`--CONDITION`", "", "See [conditions](#conditions)."))
    text = inspect.cleandoc(kind.__doc__ or "")
    return f"{text}\n\n{table(('option', 'default', 'meaning'), rows)}"


def conditions() -> str:
    """The options that every command which flies has."""
    said = docstrings(Conditions).items()
    rows = ((f"`--{name.replace('_', '-')}`", f"{text}.") for name, text in said)
    return table(("option", "meaning"), rows)


def fields(kind: type) -> str:
    """The fields of a record, with the comments beside them, and its properties."""
    rows = []
    for line in inspect.getsource(kind).splitlines():
        found = re.match(r"    (\w+): (\w+).*?(?:  # (?:type: ignore\S+ - )?(.+))?$", line)
        if found:
            rows.append((f"`{found[1]}`", found[3] or f"a `{found[2]}`"))
    for name, member in vars(kind).items():
        if isinstance(member, property) and member.__doc__:
            rows.append((f"`{name}`", (inspect.getdoc(member) or "").partition("\n")[0]))
    return table(("name", "shape, unit, frame"), rows)


def randomization() -> str:
    """What can be drawn at each reset, and what the presets draw."""

    def drawn(value: Any) -> str:
        if dataclasses.is_dataclass(value):
            return ", ".join(f"{name} {size:g}" for name, size in vars(value).items() if size)
        return f"{value[0]:g} to {value[1]:g}" if isinstance(value, tuple) else f"{value:g}"

    rows: list[Iterable[str]] = []
    for field, meaning in docstrings(Randomization).items():
        values = (getattr(RANDOMIZATIONS[name], field) for name in ("light", "full"))
        usual = getattr(Randomization(), field)
        cells = ("" if value == usual else drawn(value) for value in values)
        rows.append((f"`{field}`", f"{meaning}.", *cells))
    records = (Errors, "`noise`, `bias`"), (Pushes, "`pushes`"), (Sizes, "`sizes`")
    for kind, name in records:
        rows += [(f"{name}: `{k}`", f"{text}.", "", "") for k, text in docstrings(kind).items()]
    return table(("field", "meaning and unit", "`light`", "`full`"), rows)


def observing() -> str:
    """Options of the observation."""
    usual = vars(Observing())
    rows = ((f"`{k}`", f"`{usual[k]}`", f"{text}.") for k, text in docstrings(Observing).items())
    return table(("option", "default", "meaning"), rows)


SHORT = {"asks": "asks", "solved": "solved"}
LONG = {"asks": "asks", "starts": "starts", "ends early": "ends", "solved": "solved",
        "time limit [s]": "time_limit"}  # fmt: skip
OBSERVATION = ("observation", "numbers", "unit", "meaning and frame")
REWARD = ("reward", "meaning", "weight", "where it differs")
RECORDS = {"state": state.State, "snapshot": snapshot.Snapshot,
           "potentials": snapshot.Potentials, "end": snapshot.EpisodeEnd}  # fmt: skip
NEW = {"task": "my_task", "aircraft": "small"}
"""Names in the files that the pages show."""
PARTS: Parts = {
    "curve-columns": lambda: table(
        ("here", "in a csv"),
        [
            (name, ", ".join(f"`{one}`" for one in others.split()))
            for name, others in COLUMNS.items()
        ],
    ),
    "task-list": lambda: task_table(SHORT),
    "tasks": lambda: task_table(LONG),
    "action": lambda: f"{describe_action(Vehicle())}.",
    "control-modes": control_modes,
    "observation": lambda: every_task(observation_rows, *OBSERVATION),
    "reward": lambda: every_task(reward_rows, *REWARD),
    "vehicles": vehicles,
    **{f"aircraft-{name}": functools.partial(aircraft, name) for name in VEHICLES},
    **{f"command-{name}": functools.partial(command, name) for name in cli.COMMANDS},
    **{f"new-{what}": functools.partial(new, what, name) for what, name in NEW.items()},
    **{f"fields-{name}": functools.partial(fields, kind) for name, kind in RECORDS.items()},
    "conditions": conditions,
    "randomization": randomization,
    "observing": observing,
}
