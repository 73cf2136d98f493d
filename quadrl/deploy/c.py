"""A policy as one C99 header without dependencies: observation, network, commands, and their test.

All is plain single precision (`single`): every compiler that does not contract or reorder the
operations gives the same bits, and the header's own test asks for these.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from string import Template

import numpy as np

from quadrl.base.errors import QuadrlError
from quadrl.core.carried import Carried
from quadrl.core.environment import Environment
from quadrl.core.scenario import UNDISTURBED
from quadrl.deploy.c_cost import Cost, cost
from quadrl.deploy.c_network import acted, network
from quadrl.deploy.single import function, functions, in_single, is_exact, numbers
from quadrl.evaluation.policy import Policy

PARTS = "begun", "sensed", "asked"
TEST_STEPS = 4
TEMPLATE = Path(__file__).with_name("templates") / "policy.h.in"
LOOPS = {
    "setpoint": "\n  float setpoint[{width}];",
    "aimed": """
  memcpy(x + {upper}_MOTION, wanted, sizeof wanted);
  {name}_aimed(x, m->setpoint);""",
    "loops": """
// The loops of the control mode, for an autopilot without its own: rotor speeds [rad/s] for a
// motion, every {upper}_PHYSICS_TIMESTEP between two steps. Returns 0, or -1 and gives nothing
// where a number is not finite.
#define {upper}_PHYSICS_TIMESTEP {timestep}f
static int {name}_loops(const {name}_memory* m, const {name}_motion* now, float* rotor_speed) {{
  float x[{upper}_MOTION + {width}], y[{upper}_ROTORS];
  memcpy(x, now, {upper}_MOTION * sizeof(float));
  memcpy(x + {upper}_MOTION, m->setpoint, sizeof m->setpoint);
  if (!{name}_sound(x, {upper}_MOTION + {width})) return -1;
  {name}_looped(x, y);
  if (!{name}_sound(y, {upper}_ROTORS)) return -1;
  memcpy(rotor_speed, y, sizeof y);
  return 0;
}}

""",
    "tested": """
    wrong |= {name}_loops(&m, &now, command);
    for (int i = 0; i < {upper}_ROTORS; ++i) {{
      const float known = expected[k][{upper}_OBSERVATION + {upper}_COMMANDS + i];
      const float most = {slack} * (1.0f + fabsf(known)), off = command[i] - known;
      wrong |= !(off <= most && -off <= most);
    }}""",
}
"""What a header has more where its control mode has loops."""


class Header:
    """What the header of a policy says and does, beside its text."""

    def __init__(self, policy: Policy) -> None:
        """Trace what it flies.

        Raises:
            QuadrlError: The task or a sensor needs what no autopilot has.
        """
        self.policy = policy
        self.environment = Environment(policy.scenario, seed=0, **UNDISTURBED)
        self.environment.reset()
        self.carried = Carried(self.environment)
        self.functions = {name: getattr(self.carried, name) for name in PARTS}
        """The traced functions, by name."""
        self.loops = self.carried.loops
        """Those of a control mode with loops."""
        self.exact = all(map(is_exact, (self.functions | self.loops).values()))
        """Whether every compiler gives the same bits."""
        variant = str(policy.metadata.get("variant") or "ideal")
        stem = policy.task if variant == "ideal" else f"{policy.task}_{variant}"
        self.name = re.sub(r"\W", "_", stem)
        """What the names of its functions begin with."""
        speeds = range(13, 13 + self.environment.vehicle.rotor_count)
        self.reads_speeds = any(f"x[{k}][i]" in self.carried.sensed.body for k in speeds)
        """Whether it has to be given measured rotor speeds, not only those of the start."""

    def check_holds_a_place(self) -> None:
        """Refuse a policy that does not hold a place by the commands of rotors.

        Raises:
            QuadrlError: The task asks for something else, or the control mode has loops.
        """
        task = self.environment.task
        if task.contact or not task.keeps_place or {*self.carried.task_memory()} != {"goal"}:
            allowed = "one that holds a place, such as hover; any other flies by --to c"
            raise QuadrlError(name="task", value=task.name, allowed=allowed)
        if around := self.carried.around:
            allowed = "none; a policy that measures what is around it flies by --to c"
            raise QuadrlError(name="sensor", value=", ".join(around), allowed=allowed)
        if self.environment.control_mode.has_loops:
            reason, allowed = "the firmware has loops of its own", "rotor or share"
            mode = self.policy.control_mode
            raise QuadrlError(reason, name="control_mode", value=mode, allowed=allowed)

    def check_speeds(self, board: str) -> None:
        """Refuse a policy that looks at measured rotor speeds.

        Raises:
            QuadrlError: It does.
        """
        if self.reads_speeds:
            allowed = f"estimated: {board} does not measure it. The variant robust learns so"
            raise QuadrlError(name="rotor_speed", value="measured", allowed=allowed)

    @property
    def motion(self) -> int:
        """Numbers that it is given in each step."""
        return 13 + self.environment.vehicle.rotor_count + sum(self.carried.around.values())

    @property
    def memory(self) -> int:
        """Bytes of what is remembered of an episode."""
        numbers = self.motion + self.carried.remembered.end
        numbers += self.environment.action_size + self.carried.asked.width
        held = self.loops["aimed"].width if self.loops else 0
        return 4 * (numbers + held + self.environment.size + self.policy.state_size + 1)

    @property
    def cost(self) -> Cost:
        """What it costs on a board."""
        size = self.environment.size
        test = TEST_STEPS * (self.motion + size + self.carried.asked.width)
        # The next memory is made beside the last one, and the last motion is taken with this one.
        return cost(self.policy, self.functions, test, 2 * self.memory // 4 - size)

    def flown(self, motions: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Observation, action and command for motions (steps, k), in single precision.

        The first one begins an episode. NumPy computes them, an operation at a time.
        """
        carried, width = self.carried, self.carried.remembered.end
        own = [np.ravel(array) for array in carried.task_memory().values()]
        found = in_single(carried.begun, np.concatenate([motions[0], *own]))
        state = np.zeros(self.policy.state_size, np.float32)
        action = command = np.zeros(0, np.float32)
        for step, motion in enumerate(motions):
            if step:
                done = motion, motions[step - 1], action, command[: carried.followed], found[:width]
                found = in_single(carried.sensed, np.concatenate(done))
            observation = found[width:]
            action, state = acted(self.policy, observation, state)
            command = in_single(carried.asked, action)
            yield observation, action, command


def content(policy: Policy, metadata: Mapping[str, str]) -> bytes:
    """The header of a policy.

    Args:
        policy: The policy.
        metadata: As `quadrl.deploy.export.described` gives it.

    Raises:
        QuadrlError: The task or a sensor needs what no autopilot has.
    """
    return written(Header(policy), metadata)


def written(header: Header, metadata: Mapping[str, str]) -> bytes:
    """The text of a header; the metadata as for `content`."""
    policy, environment = header.policy, header.environment
    carried, name = header.carried, header.name
    said = {name: json.loads(value) for name, value in metadata.items()}
    task, vehicle = carried.task_memory(), environment.vehicle
    motions = _motions(header)
    flown = [
        np.concatenate([seen, asked, *looped(header, motion, action)])
        for motion, (seen, action, asked) in zip(motions, header.flown(motions), strict=True)
    ]
    slack = "0.0f" if header.exact else "1e-5f"
    more = dict.fromkeys(LOOPS, "")
    if header.loops:
        given = {"name": name, "upper": name.upper(), "width": header.loops["aimed"].width}
        given |= {"timestep": repr(float(vehicle.physics_timestep)), "slack": slack}
        more = {key: part.format(**given) for key, part in LOOPS.items()}
    first, places = 0, list[str]()
    for key, array in task.items():
        label = re.sub(r"\W", "_", f"{name}_{key}_at").upper()
        places.append(f"  {label} = {first},  // {array.size} number{'s' * (array.size > 1)}")
        first += array.size
    sizes = (
        f"  {name.upper()}_COMMANDS = {carried.asked.width},",
        f"  {name.upper()}_FOLLOWED = {carried.followed},  // of these, by modelled rotor speeds",
    )
    seen = [
        f"//   {x['first']}-{x['last']} {x['name']} [{x['unit']}]: {x['formula'] or x['meaning']}"
        for x in said["observation"]
    ]
    asked = [
        f"//   {k} {x['name']} [{x['unit']}], {x['least']:.6g} to {x['most']:.6g}: {x['meaning']}"
        for k, x in enumerate(said["action"])
    ]
    spent = f"// {header.cost.said()};", f"// {header.memory} bytes of memory."
    text = Template(TEMPLATE.read_text()).substitute(
        name=name,
        upper=name.upper(),
        version=said["quadrl"],
        task=policy.task,
        vehicle=vehicle.name,
        timestep=repr(float(vehicle.control_timestep)),
        timestep_said=f"{vehicle.control_timestep:g}",
        height=f"{environment.origin[2]:g}",
        observation="\n".join(_wrapped(seen)),
        commands="\n".join(_wrapped(asked)),
        size=environment.size,
        actions=environment.action_size,
        rotors=vehicle.rotor_count,
        cost="\n".join(_wrapped(spent)),
        task_width=carried.task_width,
        places="\n".join([*places, *sizes]),
        kept=carried.remembered.end,
        state_size=policy.state_size,
        motion=header.motion,
        around="".join(f"\n{line}" for line in _around(header)),
        speeds="measured" if header.reads_speeds else "read at the start: hovering if unknown",
        functions="\n".join(
            [
                functions(name, (header.functions | header.loops).values()),
                *(function(name, *part) for part in (header.functions | header.loops).items()),
            ]
        ),
        network=network(name, policy),
        usual=numbers(x for array in task.values() for x in np.ravel(array)) or "0",
        tolerance=", to the last bit" if header.exact else "",
        steps=len(motions),
        motions=", ".join(f"{{{numbers(row)}}}" for row in motions),
        expected=", ".join(f"{{{numbers(row)}}}" for row in flown),
        slack=slack,
        rooms=max(vehicle.rotor_count, carried.asked.width),
        given=vehicle.rotor_count if header.loops else 0,
        **more,
    )
    return text.encode()


def looped(header: Header, motion: np.ndarray, action: np.ndarray) -> Iterator[np.ndarray]:
    """The commands (R,) of the loops as a control step begins, in single precision, if any."""
    if header.loops:
        aimed, loops = header.loops.values()
        setpoint = in_single(aimed, np.concatenate([motion, action]))
        yield in_single(loops, np.concatenate([motion, setpoint]))


def _around(header: Header) -> Iterator[str]:
    """What is measured of what is around, as members of a motion."""
    for name, rays in header.carried.rays.items():
        angles = np.degrees(np.transpose([rays.azimuth, rays.elevation])).round(2) + 0.0
        listed = ", ".join(f"{left:g} {up:g}" for left, up in angles)
        said = f"turned with the {rays.frame}, from {rays.place} m on the body"
        yield from _wrapped([f"  // Degrees to the left and up of each ray, {said}: {listed}"])
        yield f"  float {name}[{rays.count}];  // [m], {rays.reach:g} where nothing is nearer"
    for name, term in header.environment.task.tracks.items():
        yield f"  float {name}[{term.size}];  // [{term.unit}], {term.meaning}"


def _motions(header: Header) -> np.ndarray:
    """Motions (steps, k) of a flight by the policy, single precision, task frame."""
    environment, flight = header.environment, header.policy.flying(1)
    observation, motions = environment.reset(seed=0), list[np.ndarray]()
    for _ in range(TEST_STEPS):
        now = environment.snapshot.state
        parts = now.position, now.quaternion, now.velocity, now.body_rate, now.rotor_speed
        seen = header.carried.around_of(environment.snapshot)
        motions.append(np.concatenate([*parts, seen], axis=1)[0].astype(np.float32))
        done = environment.step(flight(environment.flatten(observation)))
        observation = done.observation
    environment.reset(seed=0)
    return np.array(motions)


def _wrapped(lines: Sequence[str]) -> Iterator[str]:
    """Comments in lines of at most 100 characters."""
    for line in lines:
        while len(line) > 100:
            at = line.rfind(" ", 0, 100)
            yield line[:at]
            line = f"//      {line[at:]}"
        yield line
