"""Parts of the pages that list what the code has: settings, aircraft with sources, helpers."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
from collections.abc import Iterator
from typing import Any, get_args

from quadrl import VEHICLES
from quadrl.aircraft import presets
from quadrl.aircraft import vehicle as vehicle_module
from quadrl.aircraft.rotors import GRAVITY, Rotor
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.docstrings import docstrings
from quadrl.cli import Completion
from quadrl.cli.benchmark import Benchmark
from quadrl.cli.check import Check
from quadrl.cli.evaluate import Evaluate
from quadrl.cli.plot import Plot
from quadrl.cli.render import Render
from quadrl.cli.study import Study
from quadrl.cli.tasks import Tasks
from quadrl.cli.train import Train
from quadrl.cli.view import View
from quadrl.conditions.observing import Observing
from quadrl.conditions.randomization import RANDOMIZATIONS, Errors, Pushes, Randomization
from quadrl.core import snapshot
from quadrl.core.markers import Kind, Marker
from quadrl.engines import state
from quadrl.engines.rng import Rng
from quadrl.learning.config import TrainConfig
from quadrl.learning.settings import ALGORITHM_CONFIGS
from scripts.reports.report import Parts, table

FIRST_SOURCE = "gym-aero"
"""What the docstrings of a Vehicle name in brackets, for the numbers of the paper's aircraft."""


def train_settings() -> str:
    """The settings of a training that belong to no algorithm."""
    return table(("setting", "default", "meaning"), _settings(TrainConfig, "--"))


def algorithm_settings(name: str) -> str:
    """Those of one algorithm, and what else it changes."""
    kind = ALGORITHM_CONFIGS[name]
    text = table(("setting", "default", "meaning"), _settings(kind, f"--{name}."))
    others = ", ".join(f"`--{k.replace('_', '-')} {v}`" for k, v in kind.training.items())
    return f"{text}\n\nWith this algorithm the other defaults are {others}." if others else text


def command(name: str) -> str:
    """What a command does, and its options."""
    kind = COMMANDS[name]
    meanings, rows = docstrings(kind), []
    for field in dataclasses.fields(kind):
        if not (meaning := meanings.get(field.name)):
            continue
        option = f"--{field.name.replace('_', '-')}"
        if "Positional" in str(field.type):
            option = field.name.upper()
        default = "" if field.default in (dataclasses.MISSING, "", (), None) else field.default
        rows.append((f"`{option}`", f"`{default}`" if default != "" else "", f"{meaning}."))
    text = inspect.cleandoc(kind.__doc__ or "")
    return f"{text}\n\n{table(('option', 'default', 'meaning'), rows)}"


def _settings(kind: type, prefix: str) -> Iterator[tuple[str, ...]]:
    meanings = docstrings(kind)
    for field in dataclasses.fields(kind):
        value = getattr(kind, field.name, None)
        if field.name in ALGORITHM_CONFIGS:
            continue
        option = field.name if field.name == "task" else f"{prefix}{field.name.replace('_', '-')}"
        shown = " ".join(map(str, value)) if isinstance(value, tuple) else value
        yield f"`{option}`", "" if shown is None else f"`{shown}`", f"{meanings[field.name]}."


def aircraft(name: str) -> str:
    """Every number of an aircraft that is known by name, with its source."""
    vehicle, sources = VEHICLES[name], _sources(name)
    about = sources.pop("name", "The paper's; the default")
    rows: list[tuple[Any, ...]] = []
    for kind, owner in ((Vehicle, vehicle), (Rotor, vehicle.rotors[0])):
        for field, text in docstrings(kind).items():
            if field in ("name", "rotors", "position", "spin", "axis", "aerodynamics"):
                continue
            meaning = re.sub(rf" \({FIRST_SOURCE}\)", "", text)
            first = FIRST_SOURCE if name == "paper" and FIRST_SOURCE in text else ""
            source = sources.get(field, first)
            label = f"`{field}`" if kind is Vehicle else f"rotor: `{field}`"
            rows.append((label, _number(getattr(owner, field)), meaning, source))
    rows.append(
        ("hover speed", _number(float(vehicle.hover_speed[0])), "Of a rotor [rad/s]", "follows")
    )
    thrust = sum(r.thrust_coefficient * r.max_speed**2 * r.axis[2] for r in vehicle.rotors)
    share = f"{thrust / (vehicle.mass * GRAVITY):.3g}"
    rows.append(("thrust over weight", share, "At the largest rotor speeds", "follows"))
    for k, rotor in enumerate(vehicle.rotors):
        where = ", ".join(f"{x:.3g}" for x in rotor.position)
        way = "counter-clockwise" if rotor.spin > 0 else "clockwise"
        source = sources.get("arm" if "arm" in sources else "spin", "") if k == 0 else ""
        rows.append((f"rotor {k + 1}", where, f"Where its thrust acts [m]; turns {way}", source))
    head = ("parameter", "value", "meaning and unit", "source")
    return f"{about[0].upper()}{about[1:]}.\n\n{table(head, rows)}"


def _sources(name: str) -> dict[str, str]:
    """Comments beside the numbers of an aircraft in quadrl/aircraft, by parameter."""
    code = inspect.getsource(vehicle_module if name == "paper" else presets)
    if name == "paper":
        body = code.partition("PAPER_ROTORS = plus(")[2].partition("\n)\n")[0]
    else:
        body = code.partition(f"\n{name.upper()} = Vehicle(")[2].partition("\n)\n")[0]
    found: dict[str, str] = {}
    above = ""
    for line in body.splitlines():
        code_part, _, comment = line.partition("  # ")
        if line.strip().startswith("# "):
            above = line.strip().removeprefix("# ")
            continue
        key = re.match(r"\s*(\w+)=", code_part)
        if text := "; ".join(filter(None, [above.rstrip("."), comment])):
            found[key[1] if key else "arm"] = text
        above = ""
    return found


def _number(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(_number, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def fields(kind: type) -> str:
    """The fields of a record, with the comments beside them, and its properties."""
    rows = []
    for line in inspect.getsource(kind).splitlines():
        found = re.match(r"    (\w+): (\w+).*?(?:  # (?:type: ignore\S+ - )?(.+))?$", line)
        if found:
            rows.append((f"`{found[1]}`", found[3] or f"a `{found[2]}`"))
    for name, member in vars(kind).items():
        if isinstance(member, property):
            rows.append((f"`{name}`", (inspect.getdoc(member) or "").partition("\n")[0]))
    return table(("name", "shape, unit, frame"), rows)


def drawing() -> str:
    """The methods of the random numbers that a start is made of."""
    rows = []
    for name, method in vars(Rng).items():
        if name.startswith("_"):
            continue
        _, *parameters = inspect.signature(method).parameters.values()
        words = (p.name if p.default is p.empty else f"{p.name}=..." for p in parameters)
        text = (inspect.getdoc(method) or "").partition("\n")[0]
        rows.append((f"`rng.{name}({', '.join(words)})`", text))
    return table(("method", "gives"), rows)


def markers() -> str:
    """What a marker is."""
    meanings = docstrings(Marker)
    kinds = ", ".join(f"`{kind}`" for kind in get_args(Kind))
    rows = []
    for field in dataclasses.fields(Marker):
        value = "" if field.default is dataclasses.MISSING else f"`{field.default!r}`"
        rows.append((f"`{field.name}`", value, f"{meanings[field.name]}."))
    return f"The kinds are {kinds}.\n\n{table(('field', 'default', 'meaning'), rows)}"


def randomization() -> str:
    """What can be drawn at each reset, and what the presets draw."""
    rows = []
    for field, meaning in docstrings(Randomization).items():
        presets = (getattr(RANDOMIZATIONS[name], field) for name in ("light", "full"))
        usual = getattr(Randomization(), field)
        shown = ("" if value == usual else _range(value) for value in presets)
        rows.append((f"`{field}`", f"{meaning}.", *shown))
    for kind, name in ((Errors, "`noise`, `bias`"), (Pushes, "`pushes`")):
        rows += [(f"{name}: `{k}`", f"{text}.", "", "") for k, text in docstrings(kind).items()]
    return table(("field", "meaning and unit", "`light`", "`full`"), rows)


def _range(value: Any) -> str:
    if dataclasses.is_dataclass(value):
        return ", ".join(f"{name} {size:g}" for name, size in vars(value).items() if size)
    return f"{value[0]:g} to {value[1]:g}" if isinstance(value, tuple) else f"{value:g}"


def observing() -> str:
    """Options of the observation."""
    usual = vars(Observing())
    rows = [(f"`{k}`", f"`{usual[k]}`", f"{text}.") for k, text in docstrings(Observing).items()]
    return table(("option", "default", "meaning"), rows)


COMMANDS = {
    kind.__name__.lower(): kind
    for kind in (Tasks, Check, Train, Study, Evaluate, Render, View, Plot, Benchmark, Completion)
}
PARTS: Parts = {
    **{f"command-{name}": functools.partial(command, name) for name in COMMANDS},
    "train-settings": train_settings,
    **{
        f"settings-{name}": functools.partial(algorithm_settings, name)
        for name in ALGORITHM_CONFIGS
    },
    **{f"aircraft-{name}": functools.partial(aircraft, name) for name in VEHICLES},
    "fields-state": lambda: fields(state.State),
    "fields-snapshot": lambda: fields(snapshot.Snapshot),
    "fields-potentials": lambda: fields(snapshot.Potentials),
    "fields-end": lambda: fields(snapshot.EpisodeEnd),
    "drawing": drawing,
    "markers": markers,
    "randomization": randomization,
    "observing": observing,
}
