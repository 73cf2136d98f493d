"""Measures quadrl beside the other quadrotor simulators that pip can install by name.

Run it on a machine that does nothing else. Each simulator gets an environment of its own and is
measured in several rounds, so that the machine's drift affects all alike. What cannot be installed
or run is reported with the reason.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
from pathlib import Path

import tyro

from quadrl import native
from scripts.reports import report
from scripts.reports.report import ENVIRONMENT, Result, say, table

PROGRAM = Path(__file__).parent / "simulators.py"
ENVIRONMENTS = native.cache_folder() / "peers"  # some gigabytes
REQUIREMENTS = {
    "quadrl": (),  # measured in the environment that runs this
    "PyFlyt": ("PyFlyt==0.29.0",),
    "rotorpy": ("rotorpy[batched,learning]==3.0.0",),
    "crazyflow": ("crazyflow==0.4.0",),
}
OURS = "rotor lag, drag, aerodynamic moment; commands rotor speeds"
FITTED = "attitude response fitted to flights, no rotors; commands attitude and thrust"
FACTS = {
    "quadrl, MuJoCo": (5, 0.01, "RK4, MuJoCo's", "float64", OURS),
    "quadrl, free flight": (5, 0.01, "RK4, analytic", "float64", OURS),
    "PyFlyt": (6, 1 / 240, "semi-implicit Euler, Bullet's", "float64",
               "motor lag and noise, drag, contact; commands body rates"),
    "rotorpy": (1, 0.01, "RK4, torchdiffeq's", "float64",
                "rotor lag and noise, drag, flapping; commands rotor speeds"),
    "crazyflow, 50 Hz": (10, 0.002, "Euler, analytic", "float32", FITTED),
    "crazyflow, 500 Hz": (1, 0.002, "Euler, analytic", "float32", FITTED),
    "crazyflow, RK4": (10, 0.002, "RK4, analytic", "float32",
                       "rotor lag, drag; commands rotor speeds")
}  # fmt: skip
"""Physics steps in a control step, their length [s], integrator, precision, model."""
LIMIT = 1800.0  # [s], of an installation and of a round


class PeerError(Exception):
    """A simulator cannot be installed or run; the message is one line."""


def main(
    peers: tuple[str, ...] = tuple(REQUIREMENTS),
    num_envs: tuple[int, ...] = (1024, 4096),
    seconds: float = 0.5,
    rounds: int = 7,
) -> None:
    """Make the environments, measure everything in turn, write it down.

    Args:
        peers: What to measure.
        num_envs: Sizes of the batches.
        seconds: Seconds of a measurement.
        rounds: Measurements of each.
    """
    result: Result = {"load_before": os.getloadavg()[0], "num_envs": num_envs, "seconds": seconds}
    answers: dict[str, list[Result]] = {name: [] for name in peers}
    missing: dict[str, str] = {}
    for number in range(rounds):
        for name in [name for name in peers if name not in missing]:
            say(f"round {number + 1} of {rounds}: {name}")
            try:
                arguments = (environment(name), "-P", PROGRAM, name, seconds, *num_envs)
                answers[name].append(json.loads(call(name, *map(str, arguments))))
            except PeerError as error:
                missing[name] = str(error)
                say(f"{name}: {error}")
    there = {name: found for name, found in answers.items() if name not in missing}
    result |= {"repeats": rounds, "missing": missing, "rows": []}
    result["versions"] = {name: found[0]["version"] for name, found in there.items()}
    for found in there.values():
        for rows in zip(*(answer["rows"] for answer in found), strict=True):
            known = {name: rows[0][name] for name in ("system", "what", "aircraft")}
            rates = [row["rate"] for row in rows]  # [control steps/s]
            result["rows"].append(known | {"rates": rates})
    report.save("peers", result)


def environment(name: str) -> Path:
    """The Python of a simulator's environment, which is made unless it is there.

    Raises:
        PeerError: It cannot be made.
    """
    wanted = REQUIREMENTS[name]
    if not wanted:
        return Path(sys.executable)
    version = wanted[0].rpartition("=")[2]
    home = ENVIRONMENTS / f"{name}-{version}-python{sys.version_info[0]}.{sys.version_info[1]}"
    if not home.exists():
        say(f"{name}: making its environment {home}")
        try:
            call(name, sys.executable, "-m", "venv", str(home))
            python = str(home / "bin" / "python")
            call(name, python, "-m", "pip", "install", "--quiet", "--no-input", *wanted)
        except BaseException:
            shutil.rmtree(home, ignore_errors=True)
            raise
    return home / "bin" / "python"


def call(name: str, *command: str) -> str:
    """Standard output of a command.

    Raises:
        PeerError: It fails, or takes too long.
    """
    # On the CPU only, and without this repository's package unless it is quadrl itself.
    settings = {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""}
    env = ENVIRONMENT | settings | ({} if name == "quadrl" else {"PYTHONPATH": ""})
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, env=env)
    except subprocess.TimeoutExpired:
        raise PeerError(f"took more than {LIMIT:.0f} s") from None
    if done.returncode:
        lines = [x.strip() for x in (done.stderr or done.stdout).splitlines() if x.strip()]
        errors = [x for x in lines if x.lower().startswith("error") or "Error: " in x]
        raise PeerError((errors or lines or ["no output"])[-1])
    return done.stdout


def compared() -> str:
    """The figures, and what the systems compute."""
    result = report.load("peers")
    sizes, speeds, facts = result["num_envs"], [], []
    for system in dict.fromkeys(row["system"] for row in result["rows"]):
        substeps, step, *rest = FACTS[system]
        cells, fastest = dict.fromkeys(("one", *sizes, "physics"), ""), 0.0
        for row in (row for row in result["rows"] if row["system"] == system):
            what, aircraft, rate = row["what"], row["aircraft"], statistics.median(row["rates"])
            fastest = max(fastest, rate * substeps * step)
            if what == "physics":
                cells[what] = f"{rate * substeps:,.0f} ({aircraft:,} aircraft)"
            elif what == "batch" and aircraft not in sizes:  # it has no batch of its own
                cells[sizes[0]] = f"{rate:,.0f} ({aircraft} processes)"
            else:
                cells["one" if what == "one" else aircraft] = f"{rate:,.0f}"
        speeds.append((system, *cells.values(), f"{fastest:,.0f}"))
        facts.append((system, f"{substeps} of {1000 * step:.3g} ms", *rest))
    head = ("system", "one environment", *(f"batch of {n:,}" for n in sizes))
    head += ("simulator alone, physics steps/s", "simulated per wall clock time, at most")
    facts_head = ("system", "physics steps in a control step", "integrator", "precision", "model")
    versions = ", ".join(f"{name} {number}" for name, number in result["versions"].items())
    missing = "".join(f"Not measured: {x}: {why}.  \n" for x, why in result["missing"].items())
    return (
        f"{table(head, speeds)}\n\n{table(facts_head, facts)}\n\nMedians of {result['repeats']} "
        f"repeats of {result['seconds']:g} s; load of the machine before: "
        f"{result['load_before']:.1f}. Versions: {versions}.  \n{missing}{report.source(result)}"
    )


PARTS: report.Parts = {"peers": compared}

if __name__ == "__main__":
    tyro.cli(main)
