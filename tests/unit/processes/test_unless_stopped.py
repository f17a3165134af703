"""What takes long is left when the process is to end."""

import asyncio

import pytest

from ccatp.daemon.process import unless_stopped
from ccatp.errors import DaemonUnreachableError


async def refuse() -> None:
    raise DaemonUnreachableError("nobody there")


def test_work_is_left_when_stopped_and_else_done() -> None:
    async def story() -> None:
        stop, never, before = asyncio.Event(), asyncio.Event(), asyncio.all_tasks()
        assert await unless_stopped(stop, asyncio.sleep(0))
        with pytest.raises(DaemonUnreachableError, match="nobody there"):
            await unless_stopped(stop, refuse())

        async def wait_for_ever() -> None:
            await never.wait()

        asyncio.get_running_loop().call_soon(stop.set)
        assert not await unless_stopped(stop, wait_for_ever())
        assert asyncio.all_tasks() == before  # nothing is left behind

    asyncio.run(asyncio.wait_for(story(), 10.0))
