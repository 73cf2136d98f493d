"""Options that the commands which fly a policy or a controller share."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from quadrl.base.errors import QuadrlError
from quadrl.base.records import tuples
from quadrl.base.validation import choice
from quadrl.cli import choices
from quadrl.control import CONTROLLERS
from quadrl.core.scenario import GIVEN, Conditions
from quadrl.evaluation.controllers import comes_with_quadrl
from quadrl.evaluation.policy import Policy
from quadrl.learning.train_settings import PAIRED
from quadrl.tasks import TASKS

ConditionOptions: Any = choices.optional(Conditions, lambda name: "")


class Conditioned(ConditionOptions):
    """Options of a command for the conditions of flight."""

    def conditions(self) -> dict[str, Any]:
        """Those that are given, as `Scenario.of` takes them.

        Raises:
            QuadrlError: One begins like JSON and is none, or has no equals sign.
        """
        return parsed({name: getattr(self, name) for name in Conditions.__annotations__})


def parsed(given: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a command line as Python takes them, at any depth, without what is not given.

    Raises:
        QuadrlError: One begins like JSON and is none, or has no equals sign.
    """
    whole: dict[str, Any] = {k: parsed(v) if isinstance(v, dict) else v for k, v in given.items()}
    return {
        name: parse_options(value, _alone(name)) if name in PAIRED else parse_named(name, value)
        for name, value in whole.items()
        if value not in (None, "", {}) and (value or name not in PAIRED)
    }


@choices.command
class Flown(Conditioned):
    """Options for a policy or a controller, and for what it flies."""

    policy: Annotated[Positional[str], arg(metavar="[POLICY]")] = ""
    """A run folder, a .safetensors file, or the name of a shipped policy: a task's name or, for
    example, hover_robust (write ./NAME for a folder of that name). Conditions that are not given
    are those of its training."""
    algo: choices.Algorithm = ""
    """Algorithm of the shipped policy; by default the algorithm with which its task is trained."""
    controller: choices.ControllerName = ""
    """A controller instead of a policy: geometric or lqr. It flies the aircraft that the task is
    trained on."""
    task: choices.TaskName = ""
    """The task; by default the one that the policy was trained for, and hover for a controller."""
    seed: int = 0
    """Seed of the episodes, between 0 and 2^32 - 1."""


def flies(policy: str, controller: str, algo: str) -> str | Path | Policy:
    """A policy or a controller, as the Python functions take it, from the words of the options.

    Raises:
        QuadrlError: It is unknown, or the choice is ambiguous.
    """
    if bool(policy) == bool(controller):
        raise QuadrlError(
            "give either a policy (a run folder, a .safetensors file, or the name of a task) "
            f"or --controller {' or '.join(CONTROLLERS)}"
        )
    if algo and policy not in TASKS:
        raise QuadrlError(
            "--algo chooses among the policies that come with quadrl: give the name of a task, "
            "or leave it out"
        )
    if controller:
        return choice("controller", controller, CONTROLLERS)
    return Policy.pretrained(policy, algo) if algo else policy_named(policy)


def policy_named(word: str) -> str | Path:
    """A policy as the Python functions take it; a controller's name is no policy, but a folder."""
    return word if comes_with_quadrl(word) else Path(word)


def parse_named(name: str, text: Any) -> Any:
    """A name as it is, or what JSON such as {"mass": [0.8, 1.2]} or [{"algo": "apg"}] stands for.

    Raises:
        QuadrlError: It begins like JSON and is none.
    """
    if not isinstance(text, str) or not text.startswith(("{", "[")):
        return text
    try:
        return tuples(json.loads(text))
    except (ValueError, RecursionError) as error:
        example = GIVEN.get(name, {}).get("example")
        allowed = f"a name, or JSON{f' such as {json.dumps(example)}' if example else ''}"
        raise QuadrlError(f"{error}", name=name, value=text, allowed=allowed) from None


def _alone(name: str) -> Any:
    return GIVEN.get(name, {}).get("alone")


def parse_options(pairs: tuple[str, ...], alone: Any = None) -> dict[str, Any]:
    """Options given as NAME=VALUE; a value is read as JSON where it is valid, lists as tuples.

    Args:
        pairs: As they were typed.
        alone: The value of a NAME alone; None where it needs one.

    Raises:
        QuadrlError: One has no equals sign, or stands there twice.
    """
    options: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals and alone is None:
            allowed = "NAME=VALUE, such as time_limit=5"
            raise QuadrlError(name="task option", value=pair, allowed=allowed)
        if name in options:
            raise QuadrlError(name=name, value=pair, allowed="given once")
        try:
            options[name] = tuples(json.loads(text)) if equals else alone
        except (ValueError, RecursionError):
            options[name] = text
    return options
