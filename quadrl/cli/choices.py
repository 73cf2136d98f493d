"""The words that options choose from, as types: help shows them and completion offers them.

The parser takes any word, since files of one's own add tasks and aircraft after it has parsed; what
is unknown is refused later, in one line that names the nearest.
"""

from __future__ import annotations

from typing import Any

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from quadrl.aircraft.presets import VEHICLES
from quadrl.conditions.randomization import RANDOMIZATIONS
from quadrl.conditions.weather import WEATHERS
from quadrl.control import CONTROL_MODES, CONTROLLERS
from quadrl.engines.mujoco import ENGINES
from quadrl.learning.config import ALGORITHMS, ALIASES, MEMORIES
from quadrl.learning.defaults import VARIANTS
from quadrl.tasks import TASKS


class TaskName(str):
    """The name of a task."""


class VariantName(str):
    """A name of `VARIANTS`."""


class VehicleName(str):
    """The name of an aircraft."""


class Algorithm(str):
    """The name of an algorithm."""


class ControllerName(str):
    """The name of a controller."""


class ControlModeName(str):
    """The name of a control mode."""


class EngineName(str):
    """The name of an engine."""


class MemoryName(str):
    """The name of a memory."""


class RandomizationName(str):
    """The name of a randomization."""


class WeatherName(str):
    """The name of a weather."""


class Camera(str):
    """The name of a camera."""


CAMERAS = ("follow", "track", "chase", "onboard", "fixed")
SETTINGS = {
    "task": TaskName,
    "variant": VariantName,
    "vehicle": VehicleName,
    "algo": Algorithm,
    "control_mode": ControlModeName,
    "engine": EngineName,
    "weather": WeatherName,
    "randomization": RandomizationName,
    "memory": MemoryName,
}
"""Of the fields of `TrainConfig`."""


def registry(enforced: bool = False) -> ConstructorRegistry:
    """What the parser has to know; completion offers the words where they are enforced."""
    words: dict[Any, tuple[str, ...]] = {
        TaskName: tuple(TASKS),
        VariantName: tuple(VARIANTS),
        VehicleName: tuple(VEHICLES),
        Algorithm: (*ALGORITHMS, *ALIASES),
        ControllerName: tuple(CONTROLLERS),
        ControlModeName: tuple(CONTROL_MODES),
        EngineName: tuple(ENGINES),
        RandomizationName: tuple(RANDOMIZATIONS),
        MemoryName: MEMORIES,
        WeatherName: tuple(WEATHERS),
        Camera: CAMERAS,
    }
    rules = ConstructorRegistry()

    @rules.primitive_rule
    def choice(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[str] | None:
        if info.type not in words:
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar=f"{{{','.join(words[info.type])}}}",
            instance_from_str=lambda given: given[0],
            is_instance=lambda value: isinstance(value, str),
            str_from_instance=lambda value: [value or "none"],
            choices=words[info.type] if enforced else None,
        )

    return rules
