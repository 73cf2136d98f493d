"""The page docs/fly, whole in one file: quadrl's C as WebAssembly, policies, aircraft, three.js.

`scripts/web` runs it, with emcc on the path. It exports what the page's JavaScript has to know
(the book), compiles quadrl's kernels and the C of `quadrl.deploy.flights`, and puts everything into
one index.html, which needs no server and asks no other host for anything.
"""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.presets import VEHICLES
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.files import HEADER
from quadrl.base.philox import START
from quadrl.core.environment import Environment
from quadrl.deploy import flights
from quadrl.engines import mjcf, native
from quadrl.engines.free_flight import world
from quadrl.engines.state import c_rows
from quadrl.evaluation.policy import CLIP, FORMAT, UNSEALED, Policy, shipped
from quadrl.tasks import TASKS

GUST_TIME = 1.0  # [s], correlation time of the page's gusts
REPOSITORY = Path(__file__).resolve().parents[2]
SOURCE, BUILD = REPOSITORY / "docs" / "fly", REPOSITORY / "build" / "web"
SITE = REPOSITORY / "build" / "site" / "fly"
THREE = "nicegui/elements/lib/three/three.module.js"
"""Where the wheel that `scripts/web` downloads holds three.js."""
KERNELS = {
    "free_flight.c": "quadrl_free_flight",
    "state.c": "quadrl_state",
    "random.c": "quadrl_uniform",
}
"""Of quadrl/native, with what they export."""
MODULES = ("flight", "policy", "episode", "link", "scene", "plot", "main")
"""Of docs/fly, each after those that it imports."""
MEMORY = """// Written by quadrl/deploy/flights.py.
#include <math.h>
static double memory[{slots}][{size}];
double* flight_memory(int slot) {{ return memory[slot]; }}
"""


def main() -> None:
    """Build the page."""
    BUILD.mkdir(parents=True, exist_ok=True)
    book, source = make_book()
    wasm = compile_flights(source)
    book["wasm"] = _encoded(wasm)
    (BUILD / "book.json").write_text(json.dumps(book))
    page = join(book)
    SITE.mkdir(parents=True, exist_ok=True)
    (SITE / "index.html").write_text(page)
    size = f"{len(page) / 1e6:.2f} MB, WebAssembly {len(wasm) / 1e3:.0f} kB"
    print(f"{SITE / 'index.html'}: {size}", file=sys.stderr)


def make_book() -> tuple[dict[str, Any], str]:
    """What the JavaScript has to know, as JSON can hold it, and the C of the flights."""
    (slots,) = re.findall(r"export const SLOTS = (\d+)", (SOURCE / "flight.mjs").read_text())
    # Those that leave the air's laws alone: contact is MuJoCo's.
    tasks = {name: kind() for name, kind in TASKS.items() if not kind.contact}
    pairs, sources = {}, [MEMORY.format(slots=slots, size=flights.SIZE)]
    for task in tasks.values():
        for vehicle in VEHICLES.values():
            environment = Environment(task, vehicle=vehicle, seed=0)
            written = flights.write(environment)
            sources.append(written.source)
            pairs[f"{task.name}_{vehicle.name}"] = {
                "drawn": written.drawn,
                "size": environment.size,
                "origin": environment.origin.tolist(),
                # JSON knows no infinity, which is where the floor of these tasks is.
                "world": np.nan_to_num(world(environment.engine.model)).tolist(),
            }
    book = {
        "layout": {name: [flights.LAYOUT[name], size] for name, size in flights.PARTS.items()},
        "flightSize": flights.SIZE,
        "startStream": START,
        "gustTime": GUST_TIME,
        "policy": {"formats": [FORMAT, UNSEALED], "header": HEADER, "clip": CLIP},
        "tasks": {
            name: {
                **{word: getattr(task, word) for word in ("asks", "starts", "ends", "solved")},
                "timeLimit": task.time_limit,
            }
            for name, task in tasks.items()
        },
        "vehicles": {name: describe(vehicle) for name, vehicle in VEHICLES.items()},
        "pairs": pairs,
        "policies": {
            file.stem: {"task": policy.task, "file": _encoded(file.read_bytes())}
            for file in shipped()
            if (policy := Policy.load(file)).task in tasks
        },
    }
    return book, "\n".join(sources)


def describe(vehicle: Vehicle) -> dict[str, Any]:
    """The numbers of an aircraft, and what it looks like."""
    row = parameters.numbers(parameters.rows(vehicle))[0]
    return {
        "row": row.tolist(),
        "limits": [vehicle.resolved_speed, vehicle.resolved_turn],
        "rotors": vehicle.rotor_count,
        "substeps": vehicle.substeps,
        "physicsTimestep": vehicle.physics_timestep,
        "controlTimestep": vehicle.control_timestep,
        "layout": vehicle.layout.tolist(),
        "size": vehicle.size,
        "scale": vehicle.scale,
        "mass": vehicle.mass,
        "hoverSpeed": vehicle.hover_speed.tolist(),
        "actionScale": vehicle.action_scale,
        "maxSpeed": vehicle.max_speed.tolist(),
        "spin": [rotor.spin for rotor in vehicle.rotors],
        "axis": [list(rotor.axis) for rotor in vehicle.rotors],
        "radius": [rotor.radius for rotor in vehicle.rotors],
        "colour": [list(mjcf.rotor_colour(rotor.position)) for rotor in vehicle.rotors],
        **shapes(mjcf.compile_model(vehicle, drawn=True)),
    }


def shapes(model: mujoco.MjModel) -> dict[str, Any]:
    """What MuJoCo would draw of the aircraft: shapes in the body frame, and their meshes."""
    geoms, meshes = [], {}
    for k in np.flatnonzero(model.geom_bodyid == 1):
        material, name = model.geom_matid[k], model.geom(k).name
        kind = mujoco.mjtGeom(model.geom_type[k]).name.removeprefix("mjGEOM_").lower()
        # What only touches is not drawn, and the page has rims of its own.
        if model.geom_group[k] == 3 or name.endswith("_rim"):
            continue
        shape: dict[str, Any] = {
            "name": name,
            "kind": kind,
            "size": _rounded(model.geom_size[k]),
            "position": _rounded(model.geom_pos[k]),
            "quaternion": _rounded(model.geom_quat[k]),
            "rgba": _rounded(model.geom_rgba[k] if material < 0 else model.mat_rgba[material]),
        }
        if material >= 0:
            shape["shine"] = float(model.mat_shininess[material])
            shape["glow"] = float(model.mat_emission[material])
        if kind == "mesh":
            mesh = model.mesh(model.geom_dataid[k])
            shape["mesh"] = mesh.name
            parts = []
            for table, kept, first, count in (
                (model.mesh_vert, "<f4", mesh.vertadr[0], mesh.vertnum[0]),
                (model.mesh_face, "<u2", mesh.faceadr[0], mesh.facenum[0]),
            ):
                parts.append(_encoded(table[first : first + count].astype(kept).tobytes()))
            meshes[mesh.name] = dict(zip(("vertices", "faces"), parts, strict=True))
        geoms.append(shape)
    return {"shapes": geoms, "meshes": meshes}


def compile_flights(source: str) -> bytes:
    """The WebAssembly of quadrl's kernels and of the C of the flights."""
    (BUILD / "layout.h").write_text(parameters.c_structs() + c_rows())
    (BUILD / "flights.c").write_text(source)
    exported = ["flight_memory", *KERNELS.values(), *re.findall(r"^void (\w+)", source, re.M)]
    names = BUILD / "exported.json"
    names.write_text(json.dumps([f"_{name}" for name in exported]))
    folder = Path(native.__file__).parent
    kept = [flag for flag in native.FLAGS if flag not in ("-fPIC", "-shared")]
    command = [
        *("emcc", *kept, "-Wno-logical-op-parentheses", f"-I{BUILD}", f"-I{folder}"),
        *(str(folder / name) for name in KERNELS),
        *(str(BUILD / "flights.c"), "--no-entry", "-sSTANDALONE_WASM=1", "-sWASM_BIGINT=1"),
        *("-sTOTAL_STACK=131072", "-sINITIAL_MEMORY=1048576", "-sFILESYSTEM=0"),
        *(f"-sEXPORTED_FUNCTIONS=@{names}", "-o", str(BUILD / "flights.wasm")),
    ]
    subprocess.run(command, check=True)
    return (BUILD / "flights.wasm").read_bytes()


def join(book: dict[str, Any]) -> str:
    """The whole page in one text.

    Raises:
        QuadrlError: The page has no place, or several, for one of its parts.
    """
    code = []
    for name in MODULES:
        text = (SOURCE / f"{name}.mjs").read_text()
        text = re.sub(r'^import .* from "\./.*";\n', "", text, flags=re.M)
        code.append(re.sub(r"^export ", "", text, flags=re.M))
    (wheel,) = (BUILD / "wheels").glob("nicegui-*.whl")
    with zipfile.ZipFile(wheel) as opened:
        three = "data:text/javascript;base64," + _encoded(opened.read(THREE))
    parts = {
        "style": (SOURCE / "style.css").read_text(),
        "imports": json.dumps({"imports": {"three": three}}),
        # "</script" inside of a text would end the element.
        "book": json.dumps(book).replace("</", "<\\/"),
        "script": "\n".join(code),
    }
    page = (SOURCE / "index.html").read_text()
    for name, text in parts.items():
        mark = f"/*{name}*/"
        if page.count(mark) != 1:
            raise QuadrlError(f"docs/fly/index.html must hold {mark} once")
        page = page.replace(mark, text)
    return page


def _encoded(content: bytes) -> str:
    """Base64."""
    return base64.b64encode(content).decode()


def _rounded(values: np.ndarray) -> list[float]:
    """Numbers that are only drawn, with six digits."""
    return [float(f"{value:.6g}") for value in values]


if __name__ == "__main__":
    main()
