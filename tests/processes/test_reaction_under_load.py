"""Reaction times of the daemon as it runs, while six programs want the processors and a seventh the disk.

The robot is a stand-in in this process, which is preferred where the system permits it: a real one is a machine of its
own. ``CCATP_REACTIONS`` says how often each kind of fault is made: a process is killed, is stopped, the link is silent.
For a daemon without real-time scheduling beside a robot with it, begin this process by ``chrt -R -f 60 setpriv
--bounding-set=-sys_nice --inh-caps=-sys_nice``: then it may not ask for more, and what it starts has neither.
"""

import asyncio
import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from unittest.mock import patch

import psutil
import pytest

from ccatp.config.load import dump_config, load_config
from ccatp.sim.fault_proxy import FaultProxy, Pipe
from tests.faults.linking import Measured
from tests.support.daemon import stand_ins
from tests.support.scenario import SurveyLoop, begin

TIMES = int(os.environ.get("CCATP_REACTIONS", "3"))
IN_A_SURVEY = 10  # faults that one daemon has to bear, at most ...
# ... but for those after which it is not there any more, or waits for an operator.
FEWER = {"kill all": 1, "stop danger": 2, "black hole": 2}
HOGS = 6
HOG = "while True: pass"
FSYNC = """
import os, sys
file = open(sys.argv[1], "wb", buffering=0)
while True:
    file.write(bytes(65536))
    os.fsync(file.fileno())
    file.seek(0)
"""
ROBOTS_PRIORITY = 60  # above the daemon's
PATIENT_S = 90.0
STOPPED_S = 0.6  # so long a process is stopped, or the link silent: longer than every time-out
EVIDENCE_S = 0.15  # data of this age are the first evidence that somebody is silent
STALE_S = 0.3  # longer than the robot's time-to-live: a drive that turns the wheels so long after it was sent is stale
DRIVE = re.compile(rb'"type":"drive","seq":\d+,"ack":\d+,"wr":([^,]+),"wl":([^}]+)}')
DENIED = b'"forward":false,"reverse":false,"turn":false'


@contextmanager
def load(folder: Path) -> Iterator[None]:
    """Six programs that want the processors, one that wants the disk."""
    programs = [subprocess.Popen([sys.executable, "-c", HOG]) for _ in range(HOGS)]
    programs.append(subprocess.Popen([sys.executable, "-c", FSYNC, str(folder / "busy")]))
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


class Wire:
    """What the host sends, and what the robot's wheels do.

    Attributes:
        turned_s: when a step ended in which the wheels turned.
        stale: steps in which they turned by a drive that had been sent long ago.
        duties: of the fans, each after the one before, from that of the start on.
    """

    def __init__(self, robot: SurveyLoop) -> None:
        self._robot = robot.robot
        self.turned_s = 0.0
        self.stale = 0
        self.duties = [self._robot.fans.duty]
        self._zeros_s: dict[int, list[float]] = {}
        self._last_go_s: dict[int, float] = {}
        self._sent_s = 0.0
        robot.each_frame.append(self._step)

    def _step(self) -> None:
        now_s, rules = time.monotonic(), self._robot.rules
        if self._robot.fans.duty != self.duties[-1]:
            self.duties.append(self._robot.fans.duty)
        if not rules.is_held and rules._drive is not None and any(rules._drive):
            self.turned_s = now_s
            self.stale += now_s - self._sent_s > STALE_S

    def heard(self, source: int, data: bytes) -> None:
        """What came from one of the loops; nothing is the end of its session."""
        now_s = time.monotonic()
        drives = DRIVE.findall(data)
        if drives:
            self._sent_s = now_s
        if not data or DENIED in data or any(float(right) == float(left) == 0.0 for right, left in drives):
            self._zeros_s.setdefault(source, []).append(now_s)
        elif data:
            self._last_go_s[source] = now_s

    def zero_after(self, instant_s: float) -> float | None:
        """When one of the loops said for good that the wheels have to stand: zeros, a denied permit, its end."""
        firsts = [
            next((zero_s for zero_s in zeros_s if zero_s >= max(instant_s, self._last_go_s.get(source, 0.0))), None)
            for source, zeros_s in self._zeros_s.items()
        ]
        return min((first_s for first_s in firsts if first_s is not None), default=None)

    @property
    def is_driving(self) -> bool:
        """Whether the wheels have turned just now, without a word against it."""
        last_s = max((zeros_s[-1] for zeros_s in self._zeros_s.values()), default=0.0)
        return time.monotonic() - self.turned_s < 0.05 and time.monotonic() - last_s > 0.3


class Survey:
    """A robot, and the daemon that drives it."""

    def __init__(self, wire: Wire, proxy: FaultProxy, daemon: subprocess.Popen[str], log: Path) -> None:
        self.wire, self.proxy, self.daemon, self._log = wire, proxy, daemon, log

    def pid_of(self, name: str) -> int:
        """Process id of one of the loops."""
        for child in psutil.Process(self.daemon.pid).children(recursive=True):
            if any(part.endswith(f"{name}_loop") for part in child.cmdline()):
                return child.pid
        raise AssertionError(f"no {name} loop")

    async def driving(self) -> None:
        """Wait until the robot drives."""
        deadline_s = time.monotonic() + PATIENT_S
        while not self.wire.is_driving:
            assert self.daemon.poll() is None, self._log.read_text()[-3000:]
            assert time.monotonic() < deadline_s, self._log.read_text()[-3000:]
            await asyncio.sleep(0.01)


@asynccontextmanager
async def survey(folder: Path, runtime_dir: Path) -> AsyncIterator[Survey]:
    """A survey that begins at base; the daemon is ended at the end."""
    settings = {"sim.robot.port": 0, "run.mirror": "fyst-m2", "run.filter": "kf", "run.panels": 20,
                "run.restart_limit": IN_A_SURVEY, "mission.calibration_length_m": 0}  # fmt: skip
    async with AsyncExitStack() as stack:
        peers = stand_ins(load_config(overrides=settings), runtime_dir)
        robot, port, laser_port = await stack.enter_async_context(peers)
        wire = Wire(robot)
        proxy = await stack.enter_async_context(FaultProxy("127.0.0.1", port, seed=1))
        stack.enter_context(patch.object(Pipe, "data_received", _tapped(wire)))
        stack.enter_context(patch.object(Pipe, "eof_received", _tapped_end(wire)))
        at = load_config(overrides={**settings, "robot.port": proxy.port, "etalon.port": laser_port})
        (folder / "config.toml").write_text(dump_config(at), encoding="utf-8")
        said = stack.enter_context((folder / "said").open("w"))
        command = [sys.executable, "-m", "ccatp", "run", "--config", str(folder / "config.toml")]
        command += ["--run-dir", str(folder / "run"), "--runtime-dir", str(runtime_dir)]
        daemon = subprocess.Popen(command, stdout=said, stderr=said, text=True)  # noqa: ASYNC220 - takes milliseconds
        try:
            yield Survey(wire, proxy, daemon, folder / "said")
        finally:
            await asyncio.to_thread(end, daemon)


def _tapped(wire: Wire) -> Callable[[Pipe, bytes], None]:
    receive = Pipe.data_received

    def tapped(pipe: Pipe, data: bytes) -> None:
        if pipe.way == "to_robot":
            wire.heard(id(pipe), data)
        receive(pipe, data)

    return tapped


def _tapped_end(wire: Wire) -> Callable[[Pipe], bool]:
    end = Pipe.eof_received

    def tapped(pipe: Pipe) -> bool:
        if pipe.way == "to_robot":
            wire.heard(id(pipe), b"")
        return end(pipe)

    return tapped


def end(daemon: subprocess.Popen[str]) -> None:
    """End a daemon and what it started, stopped or not."""
    with contextlib.suppress(psutil.NoSuchProcess):
        for child in psutil.Process(daemon.pid).children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                child.resume()
    daemon.terminate()
    try:
        daemon.wait(20.0)
    except subprocess.TimeoutExpired:
        daemon.kill()
        daemon.wait()


def sends(name: str, number: signal.Signals) -> Callable[[Survey], None]:
    return lambda it: os.kill(it.pid_of(name), number)


def kill_all(it: Survey) -> None:
    """The host is dead."""
    host = psutil.Process(it.daemon.pid)
    for process in [*host.children(recursive=True), host]:
        process.kill()


# What is done, and after how long there is the first evidence of it: a session that ends is seen at once.
FAULTS: dict[str, tuple[Callable[[Survey], None], float]] = {
    "kill main": (sends("main", signal.SIGKILL), 0.0),
    "kill danger": (sends("danger", signal.SIGKILL), 0.0),
    "kill all": (kill_all, 0.0),
    "stop main": (sends("main", signal.SIGSTOP), EVIDENCE_S),
    "stop danger": (sends("danger", signal.SIGSTOP), EVIDENCE_S),
    "black hole": (lambda it: begin(it.proxy, "black_hole", "both"), EVIDENCE_S),
}


@pytest.fixture
def preferred() -> Iterator[None]:
    """This process before all others, where that is permitted; one that was begun so stays so."""
    before = os.sched_getscheduler(0)
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(ROBOTS_PRIORITY))
    yield
    if before == os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def surveys() -> list[tuple[str, range]]:
    """Faults, and which of their times one daemon bears: each kind ``TIMES`` times, shared among the processes."""
    found = []
    for name in FAULTS:
        times = -(-TIMES // sum(other.split()[0] == name.split()[0] for other in FAULTS))
        each = FEWER.get(name, IN_A_SURVEY)
        found += [(name, range(first, min(first + each, times))) for first in range(0, times, each)]
    return found


@pytest.mark.slow
@pytest.mark.fault("P6", "P19")
@pytest.mark.parametrize(("fault", "times"), surveys(), ids=str)
@pytest.mark.usefixtures("preferred")
async def test_reaction(fault: str, times: range, tmp_path: Path, runtime_dir: Path, measured: Measured) -> None:
    async with survey(tmp_path, runtime_dir) as it:
        with load(tmp_path):
            for time_ in times:
                await it.driving()
                await asyncio.sleep(0.037 * (time_ % 10))
                await react(it, fault, measured)
            measured("P19", it.wire.stale, "stale_drives")
            # The daemon raises it at its start, and follows load and grip; nobody takes it back to what it was before.
            before, *duties = it.wire.duties
            measured("P19", sum(min(duty) <= max(before) for duty in duties), "fan_changes")


async def react(it: Survey, fault: str, measured: Measured) -> None:
    """Make a fault, and see what host and robot do."""
    make, evidence_s = FAULTS[fault]
    begun_s = time.monotonic()
    make(it)
    await asyncio.sleep(STOPPED_S)
    turned_s, zero_s = it.wire.turned_s, it.wire.zero_after(begun_s)
    assert zero_s is not None, "the host never said so"
    measured("P19", 1e3 * max(zero_s - begun_s - evidence_s, 0.0))
    measured("P19", 1e3 * (zero_s - begun_s), "from_event_ms")
    if fault.startswith("stop"):
        measured("P6", 1e3 * max(zero_s - begun_s - evidence_s, 0.0))
    if fault == "kill all":
        measured("P19", 1e3 * max(turned_s - begun_s, 0.0), "stopped_ms")
    if evidence_s:  # back again: what was due meanwhile must not be done now
        assert turned_s - begun_s < STOPPED_S - 0.1
        it.proxy.heal()
        for name in ("main", "danger"):
            with contextlib.suppress(AssertionError, ProcessLookupError):
                os.kill(it.pid_of(name), signal.SIGCONT)
        await asyncio.sleep(STOPPED_S)
