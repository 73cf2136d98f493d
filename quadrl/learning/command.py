"""The command that trains again what a run has trained."""

from __future__ import annotations

import dataclasses

from quadrl.base.errors import QuadrlError
from quadrl.core.catalogue import kind
from quadrl.learning.config import TrainConfig
from quadrl.learning.defaults import usual_vehicle, written
from quadrl.learning.folder import FREE

SAID = ("seed", "steps", "engine", "from_run", "training_options")
"""Settings that the command says where they are unusual."""


def command(config: TrainConfig) -> str:
    """The command `quadrl train` for a configuration, with what is not usual.

    Raises:
        QuadrlError: It has other unusual settings than the command names.
    """
    own = config.named()
    as_usual = TrainConfig(
        config.task, **{name: own[name] for name in ("algo", "vehicle", "variant")}
    )
    usual = as_usual.named()
    named = (*FREE, *SAID, *["randomization"] * bool(config.from_run))  # of a second training
    if dataclasses.replace(config, **{name: usual[name] for name in named}) != as_usual:
        raise QuadrlError(f"other settings than `quadrl train {config.task}` gives")
    practised = usual["training_options"]
    practice = {k: x for k, x in config.training_options.items() if x != practised.get(k)}
    told = {
        "algo": (config.algo, None),
        "seed": (config.seed, None),
        "vehicle": (own["vehicle"], usual_vehicle(kind(config.task), config.variant)),
        "from": (config.from_run.partition("@")[0], ""),
        "randomization": (own["randomization"], usual["randomization"]),
        "training_options": (practice, {}),
        "engine": (own["engine"], usual["engine"]),
        "steps": (own["steps"], usual["steps"]),
        "variant": (config.variant, "ideal"),
    }
    words = written({name: value for name, (value, given) in told.items() if value != given})
    return " ".join(("quadrl train", config.task, *words))
