"""Whenever the loops are told to end, or are cancelled, they end at once: nothing swallows a cancellation."""

import ast
import asyncio
import os
import random
from pathlib import Path

import pytest

import ccatp
from tests.faults.daemon_rig import configuration, running_daemon
from tests.faults.linking import Measured

TIMES = 4
SLOW_TIMES = int(os.environ.get("CCATP_CANCELLATIONS", "200"))


async def ended(seed: int) -> float:
    """How long both loops take to end, s, at a random instant of joining, standing or driving."""
    rng = random.Random(seed)
    loop = asyncio.get_running_loop()
    async with running_daemon(configuration()) as daemon:
        await asyncio.sleep(rng.choice((rng.uniform(0.0, 0.05), rng.uniform(0.0, 0.4), rng.uniform(2.0, 3.0))))
        for _ in range(rng.randrange(20)):
            await asyncio.sleep(0)
        begun_s = loop.time()
        if rng.random() < 0.5:
            daemon.stop.set()
        else:
            for task in daemon.loops:
                task.cancel()
        _, waiting = await asyncio.wait(daemon.loops, timeout=10.0)
        assert not waiting
        return loop.time() - begun_s


@pytest.mark.fault("P10")
async def test_whenever_they_are_told_to_end(measured: Measured) -> None:
    for seed in range(TIMES):
        measured("P10", await ended(seed))


@pytest.mark.fault("P10")
async def test_while_a_robot_that_took_the_connection_says_nothing(measured: Measured) -> None:
    loop = asyncio.get_running_loop()
    async with running_daemon(configuration()) as daemon:
        for proxy in (daemon.to_main, daemon.to_danger):
            proxy.stall("to_client")
        await asyncio.sleep(1.0)
        assert not daemon.sent
        begun_s = loop.time()
        daemon.stop.set()
        _, waiting = await asyncio.wait(daemon.loops, timeout=10.0)
        assert not waiting
        measured("P10", loop.time() - begun_s)


@pytest.mark.slow
@pytest.mark.fault("P10")
async def test_many_times(measured: Measured) -> None:
    for seed in range(TIMES, TIMES + SLOW_TIMES):
        measured("P10", await ended(seed))


@pytest.mark.fault("P10")
def test_nobody_uses_what_swallows_cancellations() -> None:
    """``asyncio.wait_for`` may lose a cancellation that meets the end of what it waits for; ``timeout`` does not."""
    package = Path(ccatp.__file__).parent
    found = [
        f"{path.relative_to(package)}:{node.lineno}"
        for path in sorted(package.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if (isinstance(node, ast.Attribute) and node.attr == "wait_for" and ast.unparse(node.value) == "asyncio")
        or (
            isinstance(node, ast.ImportFrom) and node.module == "asyncio" and "wait_for" in {n.name for n in node.names}
        )
    ]
    assert not found
