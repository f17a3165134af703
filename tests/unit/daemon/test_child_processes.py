"""Common start of processes, children, restarts, listening sockets."""

import asyncio
import os
import re
import signal
import socket
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
import zmq

from ccatp.config.load import dump_config, load_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, Fix, PointId
from ccatp.daemon.supervision.child_processes import (
    ChildDeath,
    ProcessEnd,
    ProcessManager,
    ProcessSpec,
    RestartPolicy,
    SilenceWatch,
    open_page_socket,
    page_url,
)
from ccatp.daemon.supervision.collector import Collector
from ccatp.daemon.supervision.process import Endpoints, RunContext, parse_args, unless_stopped
from ccatp.daemon.supervision.survey_record import SurveyRecord
from ccatp.errors import DaemonUnreachableError
from ccatp.links.bus import HeartbeatPublisher, Publisher
from ccatp.links.topics import Heartbeat, MissionStatus
from ccatp.records.recorder import RobotClock
from ccatp.records.store import MissionStore, StoredPoint

# Ends with the status in its variable, or waits for its end.
CODE = "import os, sys, time; status = int(os.environ['STATUS']); sys.exit(status) if status else time.sleep(60.0)"
UNENDING = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60.0)"
# Each of two ends when both were asked to.
TOGETHER = """
import pathlib, signal, sys, time

def end(*_):
    pathlib.Path(sys.argv[1]).touch()
    while not all(pathlib.Path(name).exists() for name in ("one", "two")):
        time.sleep(0.01)
    raise SystemExit

signal.signal(signal.SIGTERM, end)
pathlib.Path(sys.argv[1] + ".ready").touch()
time.sleep(60.0)
"""
PAGE = ProcessSpec("page", "ending_child", is_needed=False, niceness=7)
MAIN = ProcessSpec("main", "m", is_loop=True)
SIMULATOR = replace(MAIN, is_replaceable=False)
RESTART, END, HELD, WITHOUT = ProcessEnd.RESTART, ProcessEnd.END, ProcessEnd.HELD, ProcessEnd.WITHOUT


def test_the_command_line_of_a_process_and_sockets_for_its_owner_alone(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text(dump_config(load_config()), encoding="utf-8")
    before = os.umask(0)
    try:
        folders = ["--run-dir", str(tmp_path), "--runtime-dir", str(tmp_path)]
        plain, restarted = parse_args(folders), parse_args([*folders, "--restarted", "--listen-fd", "7"])
        assert os.umask(0) == 0o022
    finally:
        os.umask(before)
    assert (plain.is_taking_over, plain.listen_fd, plain.config) == (False, None, load_config())
    assert (restarted.is_taking_over, restarted.is_resuming, restarted.listen_fd) == (True, False, 7)


async def test_work_is_left_when_stopped_and_else_done() -> None:
    async def refuse() -> None:
        raise DaemonUnreachableError("nobody there")

    async with asyncio.timeout(10.0):
        stop, before = asyncio.Event(), asyncio.all_tasks()
        assert await unless_stopped(stop, asyncio.sleep(0))
        with pytest.raises(DaemonUnreachableError, match="nobody there"):
            await unless_stopped(stop, refuse())
        asyncio.get_running_loop().call_soon(stop.set)
        assert not await unless_stopped(stop, asyncio.Event().wait())
        assert asyncio.all_tasks() == before  # nothing is left behind


# -- children ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def children(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, config: Config, said: list[str]) -> ProcessManager:
    (tmp_path / "ending_child.py").write_text(CODE)
    (tmp_path / "unending_child.py").write_text(UNENDING)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return ProcessManager(config.run, lambda _spec, _is_restarted: ([], ()), lambda _level, text: said.append(text))


@pytest.mark.parametrize(
    ("status", "first", "last", "restarts"),
    [
        (1, "ended with status 1: restarting it, the survey continues", "more than 3 times within 60 s", 3),
        (2, "ended with status 2: the survey continues without it", "the survey continues without it", 0),  # final
    ],
)
def test_a_process_that_is_not_needed(
    children: ProcessManager,
    said: list[str],
    monkeypatch: pytest.MonkeyPatch,
    status: int,
    first: str,
    last: str,
    restarts: int,
) -> None:
    monkeypatch.setenv("STATUS", str(status))
    children.start(PAGE)
    deadline = time.monotonic() + 30.0
    while len(said) <= restarts and time.monotonic() < deadline:
        assert children.poll(time.monotonic()) is None
        time.sleep(0.01)
    assert said[0] == f"process page {first}"
    assert last in said[-1]
    assert children.restarts == restarts
    assert children.poll(time.monotonic()) is None
    assert not children.is_recovering(time.monotonic())


def test_niceness_and_the_time_of_the_last_process(
    children: ProcessManager, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATUS", "0")
    monkeypatch.setattr("ccatp.daemon.supervision.child_processes.STOP_TIMEOUT_S", 0.0)  # others have used it up
    monkeypatch.setattr("ccatp.daemon.supervision.child_processes.LEAST_STOP_S", 30.0)
    own = os.getpriority(os.PRIO_PROCESS, 0)
    # What starts later has the same, though the supervisor has stepped back.
    with monkeypatch.context() as patch:
        patch.setattr("ccatp.daemon.supervision.child_processes.os.getpriority", lambda *_: 19)
        children.start(PAGE)
    (found,) = children._children.values()
    assert os.getpriority(os.PRIO_PROCESS, found.process.pid) == min(own + 7, 19)
    children.stop_all()
    children.kill_all()
    assert said == []


@pytest.mark.parametrize(
    ("spec", "lines"),
    [
        (replace(PAGE, module="unending_child"), []),  # has nothing to save
        (ProcessSpec("main", "unending_child"), ["process main did not stop within 0 s and was killed"]),
    ],
)
def test_a_process_that_does_not_stop_is_killed(
    children: ProcessManager, said: list[str], monkeypatch: pytest.MonkeyPatch, spec: ProcessSpec, lines: list[str]
) -> None:
    monkeypatch.setattr("ccatp.daemon.supervision.child_processes.STOP_TIMEOUT_S", 0.0)
    monkeypatch.setattr("ccatp.daemon.supervision.child_processes.LEAST_STOP_S", 0.2)
    children.start(spec)
    (found,) = children._children.values()
    status = Path(f"/proc/{found.process.pid}/status")
    while not int(re.findall(r"SigIgn:\s+(\w+)", status.read_text())[0], 16) >> (signal.SIGTERM - 1) & 1:
        time.sleep(0.01)
    children.stop_all()
    assert found.process.poll() == -signal.SIGKILL
    assert said == lines


def test_servers_stop_together(
    tmp_path: Path, config: Config, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr("ccatp.daemon.supervision.child_processes.STOP_TIMEOUT_S", 30.0)
    Path("together.py").write_text(TOGETHER)
    children = ProcessManager(config.run, lambda spec, _: ([spec.name], ()), lambda _level, text: said.append(text))
    for name in ("one", "two"):
        children.start(ProcessSpec(name, "together"))
        while not Path(f"{name}.ready").exists():
            time.sleep(0.01)
    children.stop_all()
    assert said == []


def test_a_collector_takes_so_many_messages_at_a_time(tmp_path: Path, config: Config) -> None:
    endpoints, received = Endpoints(tmp_path), list[Heartbeat]()
    with (
        zmq.Context() as context,
        closing(Publisher(context, endpoints.of("main"))) as publisher,
        Collector(context, RunContext(config, tmp_path, endpoints, is_sim=False), received.append) as collector,
    ):
        while not publisher.has_subscriber("heartbeat.main"):
            time.sleep(0.01)
        for _ in range(30):
            HeartbeatPublisher(publisher, "main").publish()
        while (before := len(received)) < 30:
            collector.collect(10, limit=10)
            assert len(received) <= before + 10


def test_a_summary_counts_the_points_of_the_database_where_the_last_status_was_lost(
    tmp_path: Path, config: Config
) -> None:
    plan = [StoredPoint(PointId(1, 2, n), 0.0, 0.0) for n in range(1, 10)]
    with MissionStore.create(
        tmp_path / "mission.sqlite", mirror="fyst-m1", seed=1, config_toml="[run]\n", points=plan, reserve_bytes=0
    ) as store:
        for n, (point, *_) in enumerate(plan[:3]):
            fix = Fix(
                1.0 + n, (0.0, 0.0, 3.6), (1e-12, 0.0, 0.0, 0.0, 1e-12, 0.0, 0.0, 0.0, 1e-12), 1.0, (1, 2, 3), 0.0
            )
            store.record_fix(point, fix, DeckPose(0.0, 0.0, 0.0)).result()
        store.record_skipped(plan[3].point, 9.0).result()
    survey = SurveyRecord(config, tmp_path, RobotClock(is_simulation=False), False)
    survey.take(MissionStatus(seq=1, t_s=1.0, state="driving", total=9, done=2, elapsed_s=5.0))
    points, time_s = (survey.build(1.0)[key] for key in ("points", "mission_time_s"))
    assert (points["total"], points["measured"], points["skipped"], time_s) == (9, 3, 1, 5.0)


@pytest.mark.fault("P18")
def test_a_crash_loop_ends_and_rare_deaths_do_not() -> None:
    policy = RestartPolicy(3, 60.0)
    assert [policy.died(MAIN, -9, t).end for t in (0.0, 1.0, 2.0)] == [RESTART] * 3
    line = "process main was killed by SIGKILL, more than 3 times within 60 s: run ended, wheels held"
    assert policy.died(MAIN, -9, 59.0) == ChildDeath("main", -9, HELD, line)
    assert policy.died(replace(MAIN, name="danger"), 1, 59.0).end is RESTART  # each counts for itself
    seldom = RestartPolicy(3, 60.0)
    assert {seldom.died(MAIN, -9, 21.0 * k).end for k in range(50)} == {RESTART}
    once = RestartPolicy(1, 60.0)
    assert [once.died(PAGE, -9, t_s).end for t_s in (0.0, 1.0)] == [RESTART, WITHOUT]


@pytest.mark.parametrize(
    ("spec", "code", "why", "end", "text"),
    [
        (MAIN, 2, "", END, "main ended with status 2"),  # would end alike
        (MAIN, 5, "", END, "main ended with status 5"),
        (SIMULATOR, -11, "", HELD, "main was killed by SIGSEGV: run ended, wheels held"),
        (MAIN, 1, "", RESTART, "main ended with status 1: restarting it, wheels held meanwhile"),
        (MAIN, -40, "", RESTART, "main was killed by signal 40: restarting it, wheels held meanwhile"),
        (MAIN, -9, "hung", RESTART, "main hung: restarting it, wheels held meanwhile"),
        (
            replace(MAIN, name="laser", is_loop=False),
            -9,
            "",
            RESTART,
            "laser was killed by SIGKILL: restarting it, measurements wait for it",
        ),
        (PAGE, -9, "", RESTART, "page was killed by SIGKILL: restarting it, the survey continues"),
        (PAGE, 2, "", WITHOUT, "page ended with status 2: the survey continues without it"),
    ],
)
def test_the_decision_on_a_death(spec: ProcessSpec, code: int, why: str, end: ProcessEnd, text: str) -> None:
    death = RestartPolicy(3, 60.0).died(spec, code, 0.0, why)
    assert death == ChildDeath(spec.name, code, end, f"process {text}")


@pytest.mark.fault("P7")
def test_silence_counts_while_somebody_listens() -> None:
    watch = SilenceWatch(30.0, 2.0)
    watch.reset()
    assert not any(watch.is_hung(0.1 * k) for k in range(1, 19))
    now_s = 1.8 + 3600.0  # the supervisor itself was stopped
    assert not watch.is_hung(now_s)
    assert watch.is_hung(now_s + 0.2)
    watch.reset()
    assert not watch.is_hung(now_s + 0.3)
    starting = SilenceWatch(1.0, 0.3)  # a start may take longer
    assert not any(starting.is_hung(0.1 * k) for k in range(10))
    assert starting.is_hung(1.1)
    assert starting.text == "sent no heartbeat for 1 s and was killed"


# -- the socket of the page -------------------------------------------------------------------------------------------


def test_any_free_port_a_port_in_use_and_no_page(config: Config) -> None:
    none = open_page_socket(config.dashboard.model_copy(update={"enabled": False}))
    assert (none.socket, none.text) == (None, "")
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        for port, level, before in ((0, "info", ""), (taken, "warning", f"port {taken} is in use, so it is at ")):
            page = open_page_socket(config.dashboard.model_copy(update={"port": port}))
            assert page.socket is not None
            with page.socket:
                assert taken != page.config.port == page.socket.getsockname()[1]
            assert (page.level, page.text) == (level, f"dashboard: {before}http://127.0.0.1:{page.config.port}/")


def test_an_address_that_cannot_be_had_is_no_end_of_a_survey(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = open_page_socket(config.dashboard.model_copy(update={"host": "192.0.2.1"}))

    def refuse(_host: str, _port: int) -> socket.socket:
        raise OSError(98, "Address already in use")

    monkeypatch.setattr("ccatp.daemon.supervision.child_processes.listen_at", refuse)
    for page, why in (
        (elsewhere, "192.0.2.1:7080: Cannot assign requested address; choose another dashboard.host"),
        (open_page_socket(config.dashboard), "127.0.0.1:7080: Address already in use; choose another dashboard.host"),
    ):
        assert (page.socket, page.level, page.text) == (None, "warning", f"no dashboard: cannot listen on {why}")


def test_addresses() -> None:
    assert page_url("127.0.0.1", 7080) == "http://127.0.0.1:7080/"
    assert page_url("::1", 7080) == "http://[::1]:7080/"
