"""What a test may not leave behind."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

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
