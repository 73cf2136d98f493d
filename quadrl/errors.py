"""The exceptions of quadrl: what the user can fix, the C part, and the renderer."""

from __future__ import annotations

import reprlib
from typing import Any


class QuadrlError(ValueError):
    """Something that the caller can fix; the message is one line.

    Attributes:
        name: What was wrong: an option, a parameter, an argument; None where a file was.
        value: Its value.
        allowed: What it must be, in words.
    """

    def __init__(
        self, message: str = "", *, name: str | None = None, value: Any = None, allowed: str = ""
    ) -> None:
        """Compose the message: "name = value: must be ALLOWED; MESSAGE"."""
        self.name, self.value, self.allowed = name, value, allowed
        if name is not None:
            must = f": must be {allowed}" if allowed else ""
            message = f"{name} = {reprlib.repr(value)}{must}" + (f"; {message}" if message else "")
        super().__init__(message)


class NativeError(QuadrlError, RuntimeError):
    """The C part cannot be built, was built for another mujoco, or is not installed."""


class RenderingUnavailable(QuadrlError, RuntimeError):
    """Nothing can be drawn on this machine; simulation and training still work."""
