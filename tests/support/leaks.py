"""What a test may not leave behind."""

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import psutil
import pytest

# Passes of the event loop that cancelled tasks and closing transports get to finish.
GRACE_PASSES = 10


@asynccontextmanager
async def no_new_tasks() -> AsyncIterator[None]:
    """Fail when tasks are left in this event loop."""
    before = asyncio.all_tasks()
    yield
    for _ in range(GRACE_PASSES):
        await asyncio.sleep(0)
    if leaked := asyncio.all_tasks() - before - {asyncio.current_task()}:
        pytest.fail(f"asyncio tasks left behind: {', '.join(sorted(map(repr, leaked)))}")


def child_processes() -> set[psutil.Process]:
    """Child processes of this one; multiprocessing keeps one helper of its own for good.

    Those below them are theirs: a browser that several tests share starts processes when it likes.
    """
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:  # there are none, which is quicker to find out than to look at all processes
        return set()
    return {
        child
        for child in psutil.Process(os.getpid()).children()
        if "multiprocessing.resource_tracker" not in command_of(child)
    }


def command_of(child: psutil.Process) -> str:
    try:
        return f"{child.pid} {' '.join(child.cmdline()) or child.name()}"
    except psutil.Error:  # it ended in between
        return str(child.pid)
