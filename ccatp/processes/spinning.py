"""Glue. How lockstep gets its speed: an event loop that spins politely before it sleeps, and a core for main alone.

In lockstep a peer answers within microseconds, and a frame passes five doors between processes. Waking a sleeping
process costs some 30 microseconds, and a process that takes turns with others on one core computes at half its speed.
"""

import asyncio
import os
import selectors
import time
from collections.abc import Coroutine
from typing import Any

# Longer than a frame takes, so that a run in progress never sleeps; a run that waits for something else soon does.
SPIN_S = 1e-3


class SpinningSelector(selectors.EpollSelector):
    """Polls for ``SPIN_S`` before it blocks, giving the core to whoever wants it."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """As ``EpollSelector.select``."""
        if timeout is not None and timeout <= 0.0:
            return super().select(timeout)
        deadline = time.perf_counter() + (SPIN_S if timeout is None else min(SPIN_S, timeout))
        while time.perf_counter() < deadline:
            if ready := super().select(0.0):
                return ready
            os.sched_yield()
        return super().select(timeout)


def run(main: Coroutine[Any, Any, int], *, is_spinning: bool) -> int:
    """``asyncio.run``, spinning or not."""
    factory = (lambda: asyncio.SelectorEventLoop(SpinningSelector())) if is_spinning else None
    with asyncio.Runner(loop_factory=factory) as runner:
        return runner.run(main)


def leave_a_core(supervisor_pid: int) -> int | None:
    """Keep this thread, and those it starts, off one core; returns that core, or ``None`` where there is but one.

    Which one follows from the number of the supervisor's process, so that all processes of a run leave the same and two
    runs side by side not always so.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if len(cores) < 2:
        return None
    core = cores[supervisor_pid % len(cores)]
    os.sched_setaffinity(0, set(cores) - {core})
    return core


def take_core(core: int | None) -> None:
    """Run the calling thread alone on the core that the others left."""
    if core is not None:
        os.sched_setaffinity(0, {core})
