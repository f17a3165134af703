"""Both loops of the daemon in one event loop: they end at once, a broken task ends them, no old frame drives."""

import ast
import asyncio
import inspect
import os
import random
import textwrap
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import msgspec
import pytest

import ccatp
from ccatp.conditions import text_of
from ccatp.core import Cause
from ccatp.daemon.loops.danger_loop import DangerLoop
from ccatp.daemon.loops.main_loop import MainLoop
from ccatp.daemon.loops.robot_loop import RobotLoop
from ccatp.errors import ExitStatus
from ccatp.links.robot_codec import decode_from_robot
from ccatp.links.robot_messages import Sensors
from ccatp.survey.events import Pause, Resume
from tests.faults.linking import Measured
from tests.support.cases import slow_case
from tests.support.daemon import Daemon, configuration, running_daemon, tell
from tests.support.scenario import SurveyLoop, begin

PACKAGE = Path(ccatp.__file__).parent

# -- the end -----------------------------------------------------------------------------------------------------------

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
@pytest.mark.parametrize(("first", "count"), [(0, TIMES), pytest.param(TIMES, SLOW_TIMES, marks=pytest.mark.slow)])
async def test_whenever_they_are_commanded_to_end(first: int, count: int, measured: Measured) -> None:
    for seed in range(first, first + count):
        measured("P10", await ended(seed))


@pytest.mark.fault("P10")
async def test_while_a_robot_that_took_the_connection_reports_nothing(measured: Measured) -> None:
    loop = asyncio.get_running_loop()
    async with running_daemon(configuration()) as daemon:
        for proxy in (daemon.to_main, daemon.to_danger):
            begin(proxy, "stall", "to_client")
        await asyncio.sleep(1.0)
        assert not daemon.sent
        begun_s = loop.time()
        daemon.stop.set()
        _, waiting = await asyncio.wait(daemon.loops, timeout=10.0)
        assert not waiting
        measured("P10", loop.time() - begun_s)


@pytest.mark.fault("P18")
async def test_a_main_loop_whose_mission_is_over_waits_for_a_supervisor_that_is_behind() -> None:
    with patch("ccatp.daemon.loops.main_loop.SHUTDOWN_REPORT_S", 0.01):
        async with running_daemon(configuration()) as daemon:
            daemon.main.finish(ExitStatus.COMPLETE)
            await daemon.until(lambda: len(daemon.events("shutdown_not_acknowledged")) >= 3)
            assert not daemon.loops[0].done()  # the supervisor would take it for dead, and start another one
            daemon.stop.set()
            await asyncio.wait(daemon.loops)
            assert daemon.main.status().exit_status == ExitStatus.COMPLETE


# -- a task that breaks ------------------------------------------------------------------------------------------------

# Every task that the two loops serve, by the method that it runs.
TASKS = (
    "ccatp.daemon.loops.robot_loop.RobotLoop.publish_heartbeat",
    "ccatp.daemon.loops.robot_loop.RobotLoop.watch",
    "ccatp.daemon.loops.fix_service.FixService.run",
    "ccatp.daemon.loops.robot_session.RobotSession.serve",
    "ccatp.daemon.operator.operator_channel.OperatorServer.serve",
    "ccatp.daemon.operator.observatory.ObservatoryServer.serve",
)


class Broken(Exception):
    """What nobody foresaw."""


def names(error: BaseException) -> list[str]:
    """The leaves of nested groups of exceptions."""
    if isinstance(error, BaseExceptionGroup):
        return [name for part in error.exceptions for name in names(part)]
    return [type(error).__name__]


async def breaks(*_: object, **__: object) -> None:
    await asyncio.sleep(0.05)
    raise Broken


@pytest.mark.fault("P9")
@pytest.mark.parametrize("task", TASKS)
async def test_a_task_that_breaks_ends_its_loop_by_that_exception(task: str, measured: Measured) -> None:
    unheard = list[dict[str, Any]]()
    asyncio.get_running_loop().set_exception_handler(lambda _, context: unheard.append(context))
    found = list[str]()
    with patch(task, breaks):
        try:
            async with running_daemon(configuration()) as daemon:
                await asyncio.wait(daemon.loops, return_when=asyncio.FIRST_COMPLETED)
        except BaseExceptionGroup as error:
            found = names(error)
    assert "Broken" in found
    measured("P9", len(unheard))


@pytest.mark.fault("P9")
def test_the_tasks_are_those_that_the_loops_serve() -> None:
    """The coroutines in the ``services`` of both loops and of what they have in common, read from their source."""
    found = set[str]()
    for loop in (MainLoop, DangerLoop, RobotLoop):
        for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(loop.services)))):
            if isinstance(node, ast.Return):
                assert isinstance(node.value, ast.Tuple)
                calls = [call.func for call in node.value.elts if isinstance(call, ast.Call)]
                found |= {function.attr for function in calls if isinstance(function, ast.Attribute)}
    assert {task.rsplit(".", 1)[1] for task in TASKS} == found


# -- frames and drives that come late ----------------------------------------------------------------------------------

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
            (both[:1], "to_robot"),
            (both[1:], "to_client"),
            (both[1:], "to_robot"),
            (both, "to_client"),
        ):
            await daemon.until(lambda: daemon.is_driving)
            begun_s = clock()
            for proxy in proxies:
                begin(proxy, "stall", direction)
            await asyncio.sleep(LONG_S)
            assert not daemon.is_driving, tell(daemon)  # held by the robot itself, or by zero drives
            healed_s = clock()
            for proxy in proxies:
                proxy.heal()
            await moving_again(daemon, healed_s)  # a pause that resumes by itself
            found += stale(daemon, begun_s + LONG_S / 2, healed_s)
        measured("L3", len(found) + len(daemon.late))
        assert len(asyncio.all_tasks()) == tasks

        missed, reported = daemon.main.status().missed_deadlines, len(daemon.events("frame_late"))
        await daemon.until(lambda: daemon.is_driving)
        begun_s = clock()
        time.sleep(0.12)  # noqa: ASYNC251 - this is what must not happen
        await moving_again(daemon, clock() + 0.05)
        status = daemon.main.status()
        measured("P8", 0 if status.missed_deadlines > missed and len(daemon.events("frame_late")) > reported else 1)
        assert status.worst_lateness_ms >= 60.0
        assert not stale(daemon, begun_s, begun_s + 0.2)


@pytest.mark.fault("P8")
async def test_planning_longer_than_a_frame_may_wait_pauses_nobody() -> None:
    # On a slow or busy machine it takes longer than the limit: a pause for that would end in planning anew.
    clock = asyncio.get_running_loop().time
    async with running_daemon(configuration()) as daemon:
        await daemon.until(lambda: daemon.is_driving)
        mission: Any = daemon.main._runner.mission
        plan, planned = mission.survey.planner.rejoin, []

        def plan_slowly(*args: object) -> object:
            time.sleep(0.12)
            planned.append(clock())
            return plan(*args)

        mission.survey.planner.rejoin = plan_slowly
        assert mission.handle(Pause(Cause("a test"))) is None
        await daemon.until(lambda: not daemon.is_driving)
        assert mission.handle(Resume()) is None
        await daemon.until(lambda: bool(planned))
        await moving_again(daemon, planned[0])
        # The danger loop, here in the same event loop, is blocked as well: that may cost another plan.
        assert len(planned) < 5
        assert not stale(daemon, planned[0] - 0.12, planned[-1] + 0.2)


@pytest.mark.fault("L13")
async def test_frames_that_are_old_for_good_are_reported_as_that_and_are_a_fault() -> None:
    async with running_daemon(configuration(health__pause_limit_s=1.0, health__hold_limit_s=3.0)) as daemon:
        await daemon.until(lambda: daemon.is_driving)
        begin(daemon.to_main, "delay", "to_client", delay_s=0.3, jitter_s=0.0)
        mission: Any = daemon.main._runner.mission
        await daemon.until(lambda: text_of(mission.state.cause).startswith("frames are more"))
        assert not daemon.is_driving
        assert text_of(mission.state.cause) == "frames are more than 150 ms old"
        assert not mission.state.is_faulted
        await daemon.until(lambda: mission.state.is_faulted)
        assert text_of(mission.state.cause).endswith("150 ms old, for more than 3 s")
        assert mission.state.is_lost
        assert {(entry["level"], entry["text"]) for entry in daemon.events("operator_message")} >= {
            ("error", text_of(mission.state.cause))
        }


@pytest.mark.parametrize("rate", [pytest.param(-0.01, marks=pytest.mark.slow), 0.01])
async def test_a_robot_whose_clock_is_wrong_by_a_hundredth_is_not_late(rate: float) -> None:
    """Its frames come every (1 + ``rate``) times their period."""
    boot_s = asyncio.get_running_loop().time()
    due_s = property(lambda robot: boot_s + (1.0 + rate) * robot.robot.next_t_s)
    with patch.object(SurveyLoop, "next_frame_s", due_s):
        async with running_daemon(configuration()) as daemon:
            await daemon.until(lambda: daemon.is_driving)
            begun_s = daemon.robot.robot.t_s
            await daemon.until(lambda: daemon.robot.robot.t_s > begun_s + 8.0)
            # By then it would be late by 80 ms, and for good.
            await moving_again(daemon, asyncio.get_running_loop().time())
            assert not daemon.main._runner.mission.state.is_faulted


@pytest.mark.fault("S12")
@pytest.mark.parametrize("by_s", [slow_case(5.0), -3.0])
async def test_it_drives_on_by_verdicts_of_the_new_time_after_the_robots_clock_has_jumped(by_s: float) -> None:
    offset_s = 0.0

    def decode(line: bytes) -> Any:
        frame = decode_from_robot(line)
        if not offset_s or not isinstance(frame, Sensors):
            return frame
        rows = {name: getattr(frame, name) for name in ("imu", "enc", "edge")}
        later = {name: [row._replace(t_s=row.t_s + offset_s) for row in found] for name, found in rows.items()}
        return msgspec.structs.replace(frame, t=frame.t + offset_s, gravity=None, **later)

    clock = asyncio.get_running_loop().time
    with patch("ccatp.links.robot_link.decode_from_robot", decode):
        async with running_daemon(configuration()) as daemon:
            await daemon.until(lambda: daemon.is_driving)
            offset_s = by_s
            await daemon.until(lambda: not daemon.is_driving)
            await moving_again(daemon, clock() + 2.0)
            assert not daemon.main._runner.mission.state.is_faulted


# -- another mirror ----------------------------------------------------------------------------------------------------


@pytest.mark.fault("P21")
async def test_a_robot_on_another_mirror_is_refused(measured: Measured) -> None:
    reported, real = configuration("fyst-m1"), configuration("fyst-m2")
    async with running_daemon(reported, real) as daemon:
        duty = daemon.robot.robot.fans.duty
        await daemon.until(daemon.main.loop.over.is_set)
        assert daemon.main.exit_status == ExitStatus.USAGE, tell(daemon)
        (line,) = (entry["text"] for entry in daemon.log if "right mirror" in entry.get("text", ""))
        assert "fyst-m1 has one of 24.7 deg there" in line
        measured("P21", len(daemon.executed))
        assert daemon.main.status().exit_status == 2
        assert duty <= daemon.robot.robot.fans.duty


# -- what the source must not contain ----------------------------------------------------------------------------------


@pytest.mark.fault("P10")
def test_nobody_uses_what_swallows_cancellations() -> None:
    """``asyncio.wait_for`` may lose a cancellation that meets the end of what it waits for; ``timeout`` does not."""
    found = [
        f"{name}:{node.lineno}"
        for name, text in sources().items()
        if "wait_for" in text
        for node in ast.walk(ast.parse(text))
        if (isinstance(node, ast.Attribute) and node.attr == "wait_for" and ast.unparse(node.value) == "asyncio")
        or (
            isinstance(node, ast.ImportFrom) and node.module == "asyncio" and "wait_for" in {n.name for n in node.names}
        )
    ]
    assert not found


@cache
def sources() -> dict[str, str]:
    """The package, file by file."""
    return {str(path.relative_to(PACKAGE)): path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}


CALLS = {("time", "time"), ("time", "time_ns"), ("time", "localtime"), ("time", "gmtime"), ("datetime", "now"),
         ("datetime", "today"), ("datetime", "utcnow"), ("date", "today")}  # fmt: skip
# Labels: names of run directories and the observatory's feed say when they were made. The check before a mission shows
# the clock itself.
LABELS = {
    "daemon/operator/alarms.py",  # as operators read it; what decides is the order
    "daemon/supervision/run_dir.py",
    "cli/prepare.py",
    "cli/runs.py",  # for how many days nothing has changed a file
    "daemon/operator/ocs_agent.py",
    "commissioning/probes.py",
    "records/recorder.py",  # log times in UTC; what is read again goes by the robot's clock
    "report/dashboard/view.py",  # the clock that the page shows
}


def wall_clocks(text: str) -> Iterator[int]:
    """Lines that read the wall clock."""
    if not any(f"{owner}.{name}" in text or f"from {owner} import" in text for owner, name in CALLS):
        return  # it need not be parsed
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name | ast.Attribute):
            owner = node.value.id if isinstance(node.value, ast.Name) else node.value.attr
            if (owner, node.attr) in CALLS:
                yield node.lineno
        elif isinstance(node, ast.ImportFrom) and any((node.module, alias.name) in CALLS for alias in node.names):
            yield node.lineno


def test_the_search_finds_them() -> None:
    text = "import time\ntime.time()\nfrom time import time_ns\ndatetime.datetime.now()\ntime.monotonic()\n"
    assert sorted(wall_clocks(text)) == [2, 3, 4]


@pytest.mark.fault("S13")
def test_nothing_that_decides_reads_the_wall_clock() -> None:
    assert {name for name, text in sources().items() if list(wall_clocks(text))} == LABELS
