"""Frames and drives that come late: whatever blocks or stalls, no old drive turns the wheels."""

import asyncio
import time

import pytest

from tests.faults.daemon_rig import Daemon, configuration, running_daemon, tell
from tests.faults.linking import Measured

LONG_S = 0.4  # longer than the robot's time-to-live, and than any age at which data still count


def stale(daemon: Daemon, since_s: float, until_s: float) -> list[int]:
    """Drives of before ``since_s`` that turned the wheels after ``until_s``."""
    return [step.seq for step in daemon.executed if step.at_s > until_s and daemon.sent[step.seq] < since_s]


async def moving_again(daemon: Daemon, since_s: float) -> None:
    await daemon.until(lambda: bool(daemon.executed) and daemon.executed[-1].at_s > since_s)


@pytest.mark.fault("L3", "P8")
async def test_stalls_and_blocks(measured: Measured) -> None:
    clock = asyncio.get_running_loop().time
    async with running_daemon(configuration()) as daemon:
        await daemon.until(lambda: daemon.is_driving)
        assert daemon.robot.robot.t_s > 1.5  # gravity had to agree first
        found: list[int] = []
        tasks = len(asyncio.all_tasks())
        both = daemon.to_main, daemon.to_danger
        for proxies, direction in (
            (both[:1], "to_client"),
            (both[:1], "to_server"),
            (both[1:], "to_client"),
            (both[1:], "to_server"),
            (both, "to_client"),
        ):
            await daemon.until(lambda: daemon.is_driving)
            begun_s = clock()
            for proxy in proxies:
                proxy.stall(direction)  # type: ignore[arg-type]
            await asyncio.sleep(LONG_S)
            assert not daemon.is_driving, tell(daemon)  # held by the robot itself, or by zero drives
            healed_s = clock()
            for proxy in proxies:
                proxy.heal()
            await moving_again(daemon, healed_s)  # a pause that resumes by itself
            found += stale(daemon, begun_s + LONG_S / 2, healed_s)
        measured("L3", len(found) + len(daemon.late))
        assert len(asyncio.all_tasks()) == tasks

        slips, told = daemon.main.status().missed_deadlines, len(daemon.events("frame_late"))
        await daemon.until(lambda: daemon.is_driving)
        begun_s = clock()
        time.sleep(0.12)  # noqa: ASYNC251 - this is what must not happen
        await moving_again(daemon, clock() + 0.05)
        status = daemon.main.status()
        measured("P8", 0 if status.missed_deadlines > slips and len(daemon.events("frame_late")) > told else 1)
        assert status.worst_lateness_ms >= 60.0
        assert not stale(daemon, begun_s, begun_s + 0.2)


@pytest.mark.fault("P8")
async def test_planning_longer_than_a_frame_may_wait_pauses_nobody() -> None:
    # On a slow or busy machine it takes longer than the limit: a pause for that would end in planning anew.
    clock = asyncio.get_running_loop().time
    async with running_daemon(configuration()) as daemon:
        await daemon.until(lambda: daemon.is_driving)
        mission = daemon.main._runner._mission  # type: ignore[attr-defined]
        plan, planned = mission._travels._plan_rest, []

        def plan_slowly(*args: object) -> object:
            time.sleep(0.12)
            planned.append(clock())
            return plan(*args)

        mission._travels._plan_rest = plan_slowly
        assert mission.pause("a test") is None
        await daemon.until(lambda: not daemon.is_driving)
        assert mission.resume() is None
        await daemon.until(lambda: bool(planned))
        await moving_again(daemon, planned[0])
        # The danger loop, here in the same event loop, is blocked as well: that may cost another plan.
        assert len(planned) < 5
        assert not stale(daemon, planned[0] - 0.12, planned[-1] + 0.2)
