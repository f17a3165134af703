"""Real-time scheduling and locked memory.

The bounds on reaction times hold under load only with real-time scheduling: a loop that shares its core waits for its
turn, and a page that was swapped out waits for the disk. It is for robots in real time.
"""

import ctypes
import os
import resource
import sys
from pathlib import Path

import structlog

MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # of mallopt(3)
# The memory that a loop uses is constant after its first minute, but by fragmentation the heap of main would grow by
# 4 MiB in an hour, with a page fault in the middle of a cycle for each page. So this much is reserved at the start and
# never released.
RESERVE_BYTES = 16 << 20
# libzmq's threads that move messages. Threads that write to disk or compute keep the ordinary scheduling.
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
    libc.mallopt(M_MMAP_MAX, 0)  # larger blocks would not be taken from the heap
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
