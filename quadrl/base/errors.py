"""The exceptions of quadrl, and its warning."""

from __future__ import annotations

import reprlib
from typing import Any


class QuadrlError(ValueError):
    """An error that the caller can fix; the message is one line.

    Attributes:
        name: What was wrong: an option, a parameter, an argument; None where a file was.
        value: Its value.
        allowed: What it must be, in words.
        reason: Why, or what to do; the end of the message.
    """

    def __init__(
        self, reason: str = "", *, name: str | None = None, value: Any = None, allowed: str = ""
    ) -> None:
        """Compose the message: "name = value: must be ALLOWED; REASON"."""
        self.name, self.value, self.allowed, self.reason = name, value, allowed, reason
        if name is not None:
            must = f": must be {allowed}" if allowed else ""
            # Lists are easier to read than arrays.
            value = value.tolist() if hasattr(value, "tolist") else value
            reason = f"{name} = {reprlib.repr(value)}{must}" + (f"; {reason}" if reason else "")
        super().__init__(reason)


class UnknownKeyword(QuadrlError, TypeError):
    """An unknown name or keyword; a TypeError, too, as it is in Python."""


class NativeError(QuadrlError, RuntimeError):
    """The C part cannot be built, was built for another mujoco, or is not installed."""


class RenderingUnavailable(QuadrlError, RuntimeError):
    """Nothing can be drawn on this machine; simulation and training still work."""


class QuadrlWarning(UserWarning):
    """A warning to the caller; the work goes on, and the message is one line.

    The command line prints it as a line that begins with "quadrl: warning: ".
    """
