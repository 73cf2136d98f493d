"""Signals: end a process cleanly, or stop a training at the end of an iteration.

Handlers belong to whoever owns the process, the command line or the process of a study's training.
A library leaves them alone.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Generator, Mapping
from typing import Any

Handler = Callable[[int, Any], object]


class Stopped(KeyboardInterrupt):
    """A signal has stopped a training at the end of an iteration, after its checkpoint."""

    def __init__(self, number: int) -> None:
        """Remember the number of the signal."""
        super().__init__()
        self.number = number


@contextlib.contextmanager
def handling(handlers: Mapping[int, Handler]) -> Generator[None]:
    """Handle signals with these functions; do nothing outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def ending(number: int, _: Any) -> None:
    """End the program through an exception, so that everything is cleaned up."""
    raise SystemExit(128 + number)


def unheeded(*_: Any) -> None:
    """Ignore a signal that is meant for a training while none is running."""


IN_ORDER: Mapping[int, Handler] = {signal.SIGTERM: ending, signal.SIGUSR1: unheeded}
"""Handlers of signals for a command."""


@contextlib.contextmanager
def heeded(ask: Callable[..., None]) -> Generator[None]:
    """Let signals `ask` a training for a checkpoint at the end of its iteration.

    After SIGTERM and Ctrl-C it stops there (`ask(stop=True)`); a further Ctrl-C stops it at once.
    After SIGUSR1 it continues.

    Raises:
        Stopped: A signal has stopped it.
    """
    came: list[int] = []

    def stop(number: int, frame: Any) -> None:
        if came and number == signal.SIGINT:
            signal.default_int_handler(number, frame)
        came.append(number)
        ask(stop=True)

    def check(number: int, frame: Any) -> None:
        ask()

    handlers: dict[int, Handler] = {signal.SIGTERM: stop, signal.SIGUSR1: check}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # in the background it is not
        handlers[signal.SIGINT] = stop
    with handling(handlers):
        yield
    if came:
        raise Stopped(came[0])
