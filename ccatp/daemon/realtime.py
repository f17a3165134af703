"""Real-time scheduling and locked memory, and the busy-polling event loop of lockstep.

The bounds on reaction times hold under load only with real-time scheduling: a loop that shares its core waits for its
turn, and a page that was swapped out waits for the disk. It is for robots in real time.

In lockstep a peer answers within microseconds and a frame passes five sockets between processes. Waking a sleeping
process costs some 30 microseconds, and two processes that take turns on one core run at half speed: so the loop polls
before it sleeps, and main has a core for itself.
"""

import ctypes
import os
import resource
import selectors
import sys
import time
from pathlib import Path

import structlog

MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # of mallopt(3)
# What a loop uses stays the same from its first minute on, but its free memory crumbles: the heap of main grows by 4
# MiB in an hour, each page a fault in the middle of a cycle. So much is there from the start, and is never given
# back.
RESERVE_BYTES = 16 << 20
# libzmq's threads that move messages; those that write to disk or compute on the side stay behind.
IO_THREADS = "ZMQbg/IO"
WITHOUT = "reaction times hold while the machine has a core to spare; the robot's own time-to-live holds in any case"


def enter(priority: int, log: structlog.typing.FilteringBoundLogger) -> None:
    """Schedule this thread and libzmq's with SCHED_FIFO, and lock memory; one warning where that is not permitted.

    A ``priority`` of 0 changes nothing.
    """
    if not priority:
        return
    reserve_heap(RESERVE_BYTES)
    missing = [reason for reason in (_schedule(priority), _lock_memory()) if reason]
    if missing:
        log.warning("realtime_scheduling_denied", missing=missing, without=WITHOUT)
    else:
        log.info("realtime_scheduling", policy="SCHED_FIFO", priority=priority)


def reserve_heap(size: int) -> None:
    """Grow the heap of glibc by ``size`` free bytes in memory; no effect with another C library."""
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallopt"):
        return
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, (ctypes.c_size_t,)
    libc.free.argtypes = (ctypes.c_void_p,)
    libc.mallopt(M_TRIM_THRESHOLD, (1 << 31) - 1)
    libc.mallopt(M_MMAP_MAX, 0)  # a block of this size would be no part of the heap
    block = libc.malloc(size)
    libc.mallopt(M_MMAP_MAX, 1 << 16)  # glibc's own number
    if block is not None:
        ctypes.memset(block, 0, size)
        libc.free(block)


def _schedule(priority: int) -> str:
    if not hasattr(os, "sched_setscheduler"):
        return f"SCHED_FIFO: not on {sys.platform}"
    try:
        for thread in (0, *_io_threads()):
            os.sched_setscheduler(thread, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as error:
        return f"SCHED_FIFO {priority}: {error.strerror}; the unit grants it with LimitRTPRIO"
    return ""


def _io_threads() -> list[int]:
    names = {int(task.name): (task / "comm").read_text() for task in Path("/proc/self/task").iterdir()}
    return [thread for thread, name in names.items() if name.startswith(IO_THREADS)]


def _lock_memory() -> str:
    """Lock present and future pages; not with a limit, because an allocation would fail some day."""
    if sys.platform != "linux":
        return f"mlockall: not on {sys.platform}"
    _, most = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    try:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    except (OSError, ValueError):
        return f"mlockall: only {most} bytes may be locked; the unit grants it with LimitMEMLOCK=infinity"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT):
        return f"mlockall: {os.strerror(ctypes.get_errno())}"
    return ""


# Longer than a frame takes, so that a run in progress never sleeps; a run that waits for something else soon does.
SPIN_S = 1e-3


class SpinningSelector(selectors.EpollSelector):
    """Polls for ``SPIN_S`` before it blocks, and yields the core in between."""

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


def leave_a_core(supervisor_pid: int) -> int | None:
    """Keep this thread, and those it starts, off one core; returns that core, or ``None`` where there is only one.

    The core follows from the supervisor's process number: all processes of a run leave the same one, and two runs side
    by side usually different ones.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if len(cores) < 2:
        return None
    core = cores[supervisor_pid % len(cores)]
    os.sched_setaffinity(0, set(cores) - {core})
    return core


def take_core(core: int | None) -> None:
    """Run the calling thread on the core that the other processes left."""
    if core is not None:
        os.sched_setaffinity(0, {core})
