"""What a policy needs beside its network on an aircraft's own computer, as functions of a row.

They are the traced functions of a control step (`core/program.py`) without what only a simulation
knows: no errors are drawn, the air is calm, the aircraft is as specified, and rewards and ends are
left out.
"""

from __future__ import annotations

import copy
import functools

import numpy as np

from quadrl.aircraft.parameters import ROW_SIZE, numbers
from quadrl.base import records
from quadrl.base.errors import QuadrlError
from quadrl.base.rotation import Array
from quadrl.base.trace import NotCompilable
from quadrl.core.environment import Environment
from quadrl.core.program import AGED, Program
from quadrl.core.senses import Look, arrays
from quadrl.core.snapshot import Snapshot
from quadrl.core.transition import begin
from quadrl.engines.rays import Rays
from quadrl.engines.rowwise import RowFunction
from quadrl.engines.state import Start, State


class Carried(Program):
    """The functions for the scenario of an environment.

    A motion is position [m], from the origin of the task's frame, quaternion, velocity [m/s], world
    frame, body rate [rad/s], body frame, rotor speeds [rad/s], and `around`. A memory is what the
    task and the sensors remember of an episode (`remembered`), its first numbers what the task does
    (`task_memory`).
    """

    def __init__(self, environment: Environment) -> None:
        """Trace the functions.

        Args:
            environment: Flies the scenario, undisturbed; it was reset.

        Raises:
            QuadrlError: The task or a sensor needs what no autopilot has.
        """
        task, observer = environment.task, environment.observer
        found = observer.senses.rays if observer else {}
        self.rays: dict[str, Rays] = {name: one for name, one in found.items() if one}
        """Rays of sensors, by name."""
        tracked = {name: term.size for name, term in task.tracks.items()}
        self.around = {name: one.count for name, one in self.rays.items()} | tracked
        """Numbers that an aircraft measures of what is around it, by name: distances [m] along the
        rays of a sensor, the largest where nothing is nearer, and what the task tracks."""
        if observer and observer.senses.loops and observer.follows:
            allowed = "rotor_speed none, or a control mode without loops"
            reason = "its rotor speeds follow commands of loops, which are the autopilot's own"
            raise QuadrlError(reason, name="rotor_speed", value="estimated", allowed=allowed)
        row = environment.engine.parameters[:1]
        self._row = numbers(row).reshape(1, ROW_SIZE)
        self.environment = environment
        written = environment.written()
        self._moving = written.engine.motions.shape[-1]
        try:
            super().__init__(written, environment.snapshot, environment.episode, row)
            motion, actions = self._moving + sum(self.around.values()), self.parts["action"]
            size = len(records.leaves(environment.snapshot.task))
            widths = [array.size for array in self._first_row()[:size]]
            self.task_width = sum(widths)
            """Numbers of a memory that are the task's own, which come first."""
            mode = environment.control_mode
            self.begun = RowFunction(self._begun, motion, self.task_width)
            """Memory and observation as an episode begins, from motion and the task's memory."""
            self.followed = 0 if written.loops else self.parts["command"]
            """Rotor commands [rad/s] of the last control step that `sensed` takes."""
            given = motion, motion, actions, self.followed, self.remembered.end
            self.sensed = RowFunction(self._sensed, *given, sound=False)
            """The same after a control step, from the motion, that before it, the action and the
            commands of the step, and the memory."""
            if self.world.end or task.tracks:
                self._check(RowFunction(self._sensed, *given, self.world.end, sound=False))
            self.asked = RowFunction(mode.values, actions)
            """What an action asks for, in the units of the control mode."""
            self.loops: dict[str, RowFunction] = {}
            """Of a mode with loops: its setpoint, from the motion and the action of a control step,
            and its commands of the rotors, from the motion of a physics step and the setpoint."""
            if mode.has_loops:
                aimed = RowFunction(self._aimed, motion, actions)
                looped = RowFunction(self._looped, motion, aimed.width)
                self.loops = {"aimed": aimed, "looped": looped}
        except NotCompilable as error:
            name = f"task {task.name}"
            allowed = "functions of arithmetic alone, which C can be made of"
            raise QuadrlError(str(error), name=name, value="Python", allowed=allowed) from error

    def around_of(self, now: Snapshot) -> np.ndarray:
        """What aircraft measure of what is around them, (N, k), where they are simulated."""
        task, world = self.environment.task, now.world
        seen = {name: one.distance(world.ranges(name)) for name, one in self.rays.items() if world}
        parts = [*seen.values(), *(getattr(task, name)(now) for name in task.tracks)]
        return np.concatenate([np.zeros((len(now.time), 0)), *parts], axis=1)

    def _check(self, whole: RowFunction) -> None:
        """Refuse an observation that tells more than an aircraft can know.

        Raises:
            QuadrlError: It depends on solids otherwise than by rays, or on how the task moves what
                it tracks; also by what is remembered.
        """
        task, memory = self.environment.task, whole.taken - self.world.end - self.remembered.end
        hidden = {*range(whole.taken - self.world.end, whole.taken)}
        hidden.update(range(memory, memory + self.task_width * bool(task.tracks)))
        shown, count = whole.depends(hidden), 0
        while count < len(hidden):
            count = len(hidden)
            hidden.update(memory + k for k in range(self.remembered.end) if shown[k])
            shown = whole.depends(hidden)
        if any(shown[self.remembered.end :]):
            allowed = "one whose observation an aircraft can measure: rays, and what `tracks` names"
            raise QuadrlError(name="task", value=task.name, allowed=allowed)

    def _begin_trace(self, motion: Array) -> Array:
        """Let the task track what a motion says; returns the numbers of the world, (1, k)."""
        ends = np.cumsum([self._moving, *self.around.values()])
        parts = np.split(motion, ends[:-1], axis=1)[1:]
        given = dict(zip(self.around, parts, strict=True))
        self.task = copy.copy(self.environment.task)
        for name in self.task.tracks:
            object.__setattr__(self.task, name, functools.partial(_tracked, given[name]))
        rays = [one.sharp.read(given[name], 0.0, motion[:, :0]) for name, one in self.rays.items()]
        if not self.world.end:
            return motion[:, :0]
        far = self.environment.scene.nothing_near(1)
        known = np.concatenate([a.reshape(1, -1) for a in records.leaves(far)], axis=1)
        known = known[:, : self.world.end - sum(one.count for one in self.rays.values())]
        return np.concatenate([known, *rays], axis=1)

    def _first_row(self) -> list[np.ndarray]:
        environment = self.environment
        return [np.asarray(a)[0] for a in self.leaves(environment.snapshot, environment.episode)]

    def task_memory(self) -> dict[str, np.ndarray]:
        """What the task remembers in the environment's present episode, by name."""
        named = records.named(self.environment.snapshot.task)
        return {name: np.asarray(array)[0] for name, array in named.items()}

    def _state(self, motion: Array) -> State:
        parts = np.split(motion[:, : self._moving], [3, 7, 10, 13], axis=1)
        height = float(self.written.engine.origin[2])
        return State.of_coordinates(*parts, origin_height=height)

    def _aimed(self, motion: Array, action: Array) -> Array:
        return self.environment.control_mode.setpoint(self._state(motion), action)

    def _looped(self, motion: Array, setpoint: Array) -> Array:
        return self.environment.control_mode.rotor_command(self._state(motion), setpoint)

    def _aged(self, motion: Array) -> Array:
        origin = self.written.engine.origin
        return np.concatenate([motion[:, :3] + origin, motion[:, 3:AGED]], axis=1)

    def _calm(self) -> tuple[Array, dict[str, Array], dict[str, Array]]:
        """Wind, what sensors are given, and the errors that are drawn: nothing."""
        if not (observer := self.written.observer):
            return np.zeros((1, 0)), {}, {}
        senses = observer.senses
        given = {name: np.zeros((1, width)) for name, width in senses.given.items()}
        errors = {name: np.zeros((1, width)) for name, (_, width) in senses.draws.items()}
        return np.zeros((1, 3)), given, errors

    def _begun(self, motion: Array, own: Array) -> Array:
        state, aircraft = self._state(motion), self._parameters(self._row)
        world = self._world_of(self._begin_trace(motion))
        like = self._like.task
        places = iter(records.Columns(0, records.leaves(like)).views(own.T))
        parts = state.position, state.quaternion, state.velocity, state.body_rate, state.rotor_speed
        remembered = self.task.remember(Start(*parts), records.filled(like, places))
        actions, look = self.parts["action"], None
        if observer := self.written.observer:
            wind, given, errors = self._calm()
            seen = np.zeros((1, actions)), wind, np.zeros(1), self._aged(motion), given, errors
            look = Look(observer.senses, observer.senses.moment(state, world, *seen), None)
        now, episode, seen = begin(self.task, state, remembered, aircraft, actions, world, look)
        truth = self.task.observe(now).values() if look else ()
        now.state = now.parameters = now.world = None  # type: ignore[assignment]
        kept = [*records.leaves(now), *records.leaves(episode)]
        sensors = arrays(look.after) if look else []
        found = [*self._numbers(kept, sensors, [*seen.values(), *truth])]
        return np.array(found[: self._known], dtype=object)[None]

    @property
    def _known(self) -> int:
        """Numbers of a memory and an observation."""
        return self.remembered.end + self.environment.size

    def _sensed(
        self,
        motion: Array,
        last: Array,
        action: Array,
        command: Array,
        was: Array,
        world: Array | None = None,
    ) -> Array:
        around = self._begin_trace(motion)
        if world is not None:
            rays = sum(one.count for one in self.rays.values())
            known = world[:, : self.world.end - rays], around[:, self.world.end - rays :]
            around = np.concatenate(known, axis=1)
        motion, last = motion[:, : self._moving], last[:, : self._moving]
        wind, given, errors = self._calm()
        steps = self._steps(was) + 1.0
        drawn = (np.concatenate([*part.values(), wind[:, :0]], axis=1) for part in (errors, given))
        normal, lasting = drawn
        command = command if self.followed else np.zeros((1, self.parts["command"]))
        whole = self._finish(
            *(motion, np.zeros((1, 1)), steps[:, None], self._aged(motion), normal, last),
            *(action, command, was, around, around, self._row, wind, lasting),
        )
        return whole[:, : self._known]

    def _steps(self, was: Array) -> Array:
        """Control steps since the start, of a memory."""
        places = iter(self.kept.views(was.T))
        _, episode = (records.filled(like, places) for like in (self._like, self._episode))
        return episode.steps


def _tracked(known: Array, now: Snapshot) -> Array:
    return known
