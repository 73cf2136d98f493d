"""Build the page docs/fly in one file: quadrl's C as WebAssembly, policies, aircraft, three.js.

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
from collections.abc import Iterable
from pathlib import Path
from typing import Any, get_args

import numpy as np

from quadrl.aircraft import parameters
from quadrl.aircraft.presets import VEHICLES, with_effects
from quadrl.aircraft.vehicle import Vehicle
from quadrl.base.errors import QuadrlError
from quadrl.base.files import HEADER
from quadrl.base.philox import SOLIDS, START
from quadrl.base.primitives import Primitive
from quadrl.conditions.sensors import Disturbance
from quadrl.conditions.targets import Aim, Standard
from quadrl.core.environment import Environment
from quadrl.core.markers import Marker
from quadrl.core.task import Task
from quadrl.deploy import flights
from quadrl.deploy.flight_memory import LAYOUT, PARTS, SIZE
from quadrl.engines import mjcf, native
from quadrl.engines.free_flight import world
from quadrl.engines.native import compiling
from quadrl.engines.rays import Frame
from quadrl.engines.solids import KINDS
from quadrl.engines.state import c_state
from quadrl.evaluation.policy import Policy, shipped
from quadrl.evaluation.policy_file import CLIP, FORMAT
from quadrl.rendering import drawing
from quadrl.tasks import TASKS

FLYING = {name: with_effects(vehicle, "none") for name, vehicle in VEHICLES.items()}
"""The aircraft as they fly on the page: by the paper's equations, without noise of the air."""
SMALLEST = 0.35  # scale of the aircraft for which goals and trails are drawn, at least
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
    "rays.c": "quadrl_rays",
    "solids.c": "quadrl_clearance",
}
"""Of quadrl/native, with what they export."""
MODULES = ("flight", "policy", "episode", "link", "scene", "plot", "main")
"""Of docs/fly, each after those that it imports."""
FLOWN = tuple(name for name, task in TASKS.items() if not task.contact)
"""Tasks of the page: without contact, which MuJoCo computes."""
MEMORY = """// Written by quadrl/deploy/web.py.
#include <math.h>
#include <stdint.h>
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
    sys.stderr.write(f"{SITE / 'index.html'}: {size}\n")


def make_book() -> tuple[dict[str, Any], str]:
    """Collect the data for the JavaScript, as JSON can hold it, and the C of the flights."""
    (slots,) = re.findall(r"export const SLOTS = (\d+)", (SOURCE / "flight.mjs").read_text())
    tasks = {name: TASKS[name]() for name in FLOWN}
    pairs, sources = {}, [MEMORY.format(slots=slots, size=SIZE)]
    for task in tasks.values():
        for vehicle in FLYING.values():
            environment = Environment(task, vehicle=vehicle, seed=0)
            source, drawn = flights.write(environment)
            about = world(environment.engine.model, vehicle.physics_timestep)
            sources.append(source)
            pairs[f"{task.name}_{vehicle.name}"] = {
                "drawn": drawn,
                "layout": {k: [part.start, part.stop] for k, part in environment.layout.items()},
                "origin": environment.origin.tolist(),
                # JSON knows no infinity, which is where the floor of these tasks is.
                "world": np.nan_to_num(about).tolist(),
                **surrounded(environment),
            }
    book = {
        "drawn": {
            "trailWidth": drawing.TRAIL_WIDTH,
            "places": _rounded(drawing.PLACES),
            "box": drawing.STREAK_BOX.tolist(),
            "seconds": drawing.STREAK_SECONDS,
            "rgba": drawing.STREAK_RGBA.tolist(),
        },
        "layout": {name: [LAYOUT[name], size] for name, size in PARTS.items()},
        "flightSize": SIZE,
        "startStream": START,
        "solidStream": SOLIDS,
        "massPlace": int(parameters.PLACES["mass"][0]),
        "gustTime": GUST_TIME,
        "smoothing": Disturbance.smoothing,
        "hides": {
            "aim": [Aim(beside_goal=beside).hides for beside in (False, True)],
            "standard": [Standard().hides],
        },
        "standard": Standard.tasks,
        "policy": {"format": FORMAT, "header": HEADER, "clip": CLIP},
        "tasks": {
            name: {
                **{word: getattr(task, word) for word in ("asks", "starts", "ends", "solved")},
                "timeLimit": task.time_limit,
                "scene": surroundings(task),
            }
            for name, task in tasks.items()
        },
        "vehicles": {name: describe(vehicle) for name, vehicle in FLYING.items()},
        "pairs": pairs,
        "policies": {
            file.stem: {"task": policy.task, "file": _encoded(file.read_bytes())}
            for file in shipped()
            # None with a memory, which the page has not.
            if not (policy := Policy.load(file)).memory
            and any(part.name in tasks for part in policy.scenario.task.parts)
        },
    }
    return book, "\n".join(sources)


def surrounded(environment: Environment) -> dict[str, Any]:
    """What a flight knows of solids, of rays, and of the loops of the task's own control mode."""
    scene, solids, found = environment.scene, environment.engine.solids, dict[str, Any]()
    if scene.solids:
        parts = [(s, part) for s in scene.solids for part in (s.count or 1) * [*s.parts]]
        looks = [{"kind": KINDS[part.kind], "rgba": [*s.rgba]} for s, part in parts]
        found["solids"] = {"outline": solids.outline.tolist(), "looks": looks}
    for rays in scene.rays.values():  # one at most, on this page
        frame = get_args(Frame).index(rays.frame)
        eye = [*rays.place, rays.reach]
        found["rays"] = {"along": rays.along.T.tolist(), "eye": eye, "frame": frame}
    if mode := flights.loops_of(environment):
        scale = mode.vehicle.action_scale
        found["loops"] = {"mode": mode.name, "size": mode.size, "scale": scale}
    return found


def surroundings(task: Task) -> dict[str, Any]:
    """The world of a task, and what stands in it for whole episodes, such as gates."""
    environment = Environment(task)
    environment.reset()
    asked = task.markers(environment.snapshot)
    stands = (one.moved(environment.origin) for one in asked if isinstance(one, Primitive))
    world = drawing.world(mjcf.compile_model(FLYING["paper"], scene=task.scene))
    return shapes([*world, *stands])


def describe(vehicle: Vehicle) -> dict[str, Any]:
    """The numbers of an aircraft, and what it looks like."""
    row = parameters.numbers(parameters.rows(vehicle))[0]
    seen = drawing.parts(mjcf.compile_model(vehicle), body=1)
    radius = drawing.GOAL_RADIUS * max(vehicle.scale, SMALLEST)
    return {
        "row": row.tolist(),
        "limits": [vehicle.resolved_speed, vehicle.resolved_turn],
        "rotors": vehicle.rotor_count,
        "substeps": vehicle.substeps,
        "physicsTimestep": vehicle.physics_timestep,
        "controlTimestep": vehicle.control_timestep,
        "deadSteps": round(vehicle.dead_time / vehicle.physics_timestep),
        "layout": vehicle.layout.tolist(),
        "size": vehicle.size,
        "wide": max(vehicle.scale, SMALLEST),
        "mass": vehicle.mass,
        "actionScale": vehicle.action_scale,
        "maxSpeed": vehicle.max_speed.tolist(),
        "hoverSpeed": vehicle.hover_speed.tolist(),
        "spin": [rotor.spin for rotor in vehicle.rotors],
        "axis": [list(rotor.axis) for rotor in vehicle.rotors],
        "radius": [rotor.radius for rotor in vehicle.rotors],
        "colour": [list(mjcf.rotor_colour(rotor.position)) for rotor in vehicle.rotors],
        # Discs have edges of their own on the page.
        **shapes(one for one in seen if not one.name.endswith("_rim")),
        # Of a goal a metre above the ground; the page moves it.
        "goal": shapes(drawing.markers([Marker("goal", (0, 0, 1), radius)]))["shapes"],
    }


def shapes(primitives: Iterable[Primitive]) -> dict[str, Any]:
    """Primitives as the page reads them, and their meshes."""
    listed, meshes = [], {}
    for one in primitives:
        shape: dict[str, Any] = {"name": one.name, "kind": one.shape}
        for name in ("size", "position", "quaternion", "rgba", "points", "glow", "shine"):
            shape[name] = _rounded(getattr(one, name))
        if one.mesh is not None:
            shape["mesh"] = one.mesh.name
            vertices, faces = one.mesh.vertices.astype("<f4"), one.mesh.faces.astype("<u2")
            kept = {"vertices": _encoded(vertices.tobytes()), "faces": _encoded(faces.tobytes())}
            meshes[one.mesh.name] = kept
        listed.append(shape)
    return {"shapes": listed, "meshes": meshes}


def compile_flights(source: str) -> bytes:
    """The WebAssembly of quadrl's kernels and of the C of the flights."""
    (BUILD / "layout.h").write_text(parameters.c_structs() + c_state())
    (BUILD / "flights.c").write_text(source)
    exported = ["flight_memory", *KERNELS.values(), *re.findall(r"^void (\w+)", source, re.M)]
    names = BUILD / "exported.json"
    names.write_text(json.dumps([f"_{name}" for name in exported]))
    folder = Path(native.__file__).parent
    kept = [flag for flag in compiling.FLAGS if flag not in ("-fPIC", "-shared")]
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
    """Join the whole page into one text.

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


def _rounded(values: Any) -> Any:
    """Numbers that are only drawn, rounded to six digits."""
    rounded = np.vectorize(lambda value: float(f"{value:.6g}"), otypes=[float])
    return rounded(np.asarray(values, dtype=float)).tolist()


if __name__ == "__main__":
    main()
