"""The run whose networks a training begins with; without torch."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from quadrl.base.errors import QuadrlError
from quadrl.base.records import tuples
from quadrl.evaluation.policy import Policy
from quadrl.learning.folder import CHECKPOINT, read_config

NETWORKS = ("hidden", "critic_hidden", "memory", "memory_width", "holds_goal")
"""Settings of the networks: those of that run are the defaults, and other values do not fit."""
WRITTEN = re.compile(r"(.+)@([0-9a-f]{16})")


class Origin(NamedTuple):
    """A run at a moment of its training; as text FOLDER@DIGEST."""

    folder: Path
    digest: str
    """Of its checkpoint."""

    def __str__(self) -> str:
        return f"{self.folder}@{self.digest}"

    @classmethod
    def of(cls, given: Any) -> Origin:
        """Make it of a folder as it is now, or of text that `str` made.

        Raises:
            QuadrlError: The folder holds no run with a checkpoint.
        """
        if found := WRITTEN.fullmatch(str(given)):
            return cls(Path(found[1]), found[2])
        folder = Path(str(given))
        read_config(folder)
        return cls(folder, _digest(folder))

    def networks(self) -> dict[str, Any]:
        """Return the settings of its networks."""
        config = read_config(self.folder)
        return {name: tuples(config[name]) for name in NETWORKS if name in config}

    def checkpoint(self, size: int, actions: int) -> Path:
        """Return its checkpoint, for a training with observations and actions of these sizes.

        Raises:
            QuadrlError: Its policy has other sizes, or its checkpoint has changed or is gone.
        """
        if (now := _digest(self.folder)) != self.digest:
            reason = f"{self.folder} has another checkpoint than when this was begun"
            raise QuadrlError(reason, name="from", value=f"{self.folder}@{now}", allowed=str(self))
        policy = Policy.load(self.folder)
        for name, theirs, own in (
            ("observation", policy.size, size),
            ("action", policy.action_size, actions),
        ):
            if theirs != own:
                reason = f"its policy has {theirs} numbers in an {name}, this training {own}"
                allowed = "a run whose policy sees and does the same"
                raise QuadrlError(reason, name="from", value=str(self.folder), allowed=allowed)
        return self.folder / CHECKPOINT


def with_networks(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Add to the settings of a training its origin as text, and the networks of that run.

    Raises:
        QuadrlError: The folder holds no run, or the settings ask for other networks.
    """
    given = settings.get("from_run", "")
    if not given or (WRITTEN.fullmatch(str(given)) and not {*NETWORKS} - settings.keys()):
        return {**settings}
    origin = Origin.of(given)
    networks = origin.networks()
    for name in networks.keys() & settings.keys():
        if (own := tuples(settings[name])) != networks[name]:
            reason = f"the networks of {origin.folder} are others"
            raise QuadrlError(reason, name=name, value=own, allowed=repr(networks[name]))
    return {**networks, **settings, "from_run": str(origin)}


def _digest(folder: Path) -> str:
    try:
        return hashlib.sha256((folder / CHECKPOINT).read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise QuadrlError(f"{folder} has no {CHECKPOINT} that can be read") from error
