"""Threads that process parts of N aircraft at the same time."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

ROWS_PER_THREAD = 256
"""Smallest number of aircraft that is worth a thread."""
LANES = 8
"""Number of aircraft that a kernel flies side by side."""


class Threads:
    """Calls kernels for parts of N aircraft, each part in a thread of its own."""

    def __init__(self, count: int, threads: int) -> None:
        """Divide N aircraft among threads, at least one."""
        parts = max(1, min(threads, count // ROWS_PER_THREAD))
        # Whole groups of lanes to each, so that no group is flown twice.
        ends = [LANES * (count * k // parts // LANES) for k in range(parts)] + [count]
        self._parts = list(zip(ends, ends[1:], strict=False))
        self._pool = ThreadPoolExecutor(parts - 1) if parts > 1 else None

    def call(self, kernel: Callable[[int, int], int]) -> int:
        """Call a kernel with the first index of each part and the one after its last.

        It must release the interpreter's lock, as calls through ctypes do.

        Returns:
            The sum of its results.
        """
        waiting: list[Future[int]] = []
        if self._pool is not None:
            waiting = [self._pool.submit(kernel, *part) for part in self._parts[1:]]
        return kernel(*self._parts[0]) + sum(part.result() for part in waiting)
