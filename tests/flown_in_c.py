"""Policies exported to C, compiled here and flown for rows of aircraft."""

import ctypes
import re
import subprocess

import numpy as np

from quadrl.base import records
from quadrl.engines.native.compiling import compiler

FLAGS = ("-std=c99", "-Wall", "-Werror", "-Wno-unused-function", "-ffp-contract=off")
SOURCE = """#include "{path}"
int test(void) {{ return {name}_test(); }}
int room(void) {{ return (int)sizeof({name}_memory); }}
int commands(void) {{ return {upper}_COMMANDS; }}
int begin({name}_memory* m, const {name}_motion* now, const float* task, int rows) {{
  int bad = 0;
  for (int k = 0; k < rows; ++k) bad |= {name}_begin(m + k, now + k, task + k * {upper}_TASK);
  return bad;
}}
int step({name}_memory* m, const {name}_motion* now, float* action, float* command, float* seen,
         int rows) {{
  int bad = 0;
  for (int k = 0; k < rows; ++k) {{
    bad |= {name}_step(m + k, now + k, action + k * {upper}_ACTIONS,
                       command + k * {upper}_COMMANDS);
    memcpy(seen + k * {upper}_OBSERVATION, m[k].observation, sizeof m[k].observation);
  }}
  return bad;
}}
#ifdef {upper}_PHYSICS_TIMESTEP
int loops({name}_memory* m, const {name}_motion* now, float* command, int rows) {{
  int bad = 0;
  for (int k = 0; k < rows; ++k) bad |= {name}_loops(m + k, now + k, command + k * {upper}_ROTORS);
  return bad;
}}
#endif
"""


def name_of(path):
    """The name of a header's policy."""
    (name,) = re.findall(r"^static int (\w+)_test\(void\)", path.read_text(), re.M)
    return name


def compiled(path, folder, *flags):
    """The functions of a header as a library."""
    name = name_of(path)
    source, made = folder / "policy.c", folder / f"{'_'.join(flags)}.so"
    source.write_text(SOURCE.format(path=path, name=name, upper=name.upper()))
    command = [compiler(), *FLAGS, *flags, "-shared", "-fPIC", source, "-o", made, "-lm"]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return ctypes.CDLL(str(made))


def motions_of(environment, now=None):
    """Motions (N, k) as the C takes them; by default as a control step begins.

    They end with distances along rays, which a sensor may read as logarithms, and with what the
    task tracks.
    """
    seen, task = environment.snapshot, environment.task
    now = now or seen.state
    parts = [now.position, now.quaternion, now.velocity, now.body_rate, now.rotor_speed]
    for sensor in environment.observer.senses.sensors if environment.observer else ():
        if sensor.rays:
            read = seen.world.ranges(sensor.name)
            parts.append(np.exp(read) if sensor.log else read)
    parts += [getattr(task, name)(seen) for name in task.tracks]
    return np.concatenate(parts, axis=1).astype(np.float32)


def tasks_of(environment):
    """What the task remembers (N, k)."""
    count = environment.num_envs
    parts = [array.reshape(count, -1) for array in records.leaves(environment.snapshot.task)]
    return np.concatenate([np.zeros((count, 0)), *parts], axis=1).astype(np.float32)


class Flown:
    """A policy in C, in flight with N rows."""

    def __init__(self, library, policy, rows=1):
        self.library, self.rows = library, rows
        self.memory = np.zeros(rows * library.room(), np.uint8)
        widths = policy.action_size, library.commands(), policy.size
        self.action, self.command, self.observation = (
            np.zeros((rows, width), np.float32) for width in widths
        )

    def begin(self, motions, tasks):
        return self._call(self.library.begin, motions, tasks)

    def step(self, motions):
        return self._call(self.library.step, motions, self.action, self.command, self.observation)

    def loops(self, motions, rotors=4):
        """Commands (N, R) of the loops; whether they are."""
        found = np.zeros((self.rows, rotors), np.float32)
        return found, self._call(self.library.loops, motions, found)

    def _call(self, function, *arrays):
        given = [self.memory, *(np.ascontiguousarray(a, np.float32) for a in arrays)]
        return function(*(a.ctypes.data_as(ctypes.c_void_p) for a in given), self.rows)
