"""Common start of processes, children, restarts, the page socket."""

import asyncio
import os
import socket
import time
from pathlib import Path
from typing import Any

import pytest

from ccatp.config.load import dump_config, load_config
from ccatp.config.models import Config
from ccatp.daemon import dashboard as page_socket
from ccatp.daemon.child_processes import ProcessEnd, ProcessManager, ProcessSpec, RestartPolicy, SilenceWatch
from ccatp.daemon.dashboard import open_page_socket, page_url
from ccatp.daemon.process import parse_args, unless_stopped
from ccatp.errors import DaemonUnreachableError


def test_sockets_are_for_their_owner_alone(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text(dump_config(load_config()), encoding="utf-8")
    before = os.umask(0)
    try:
        parse_args(["--run-dir", str(tmp_path), "--runtime-dir", str(tmp_path)])
        assert os.umask(0) == 0o022
    finally:
        os.umask(before)


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


# Ends with the status in its variable, or waits for its end.
CODE = "import os, sys, time; status = int(os.environ['STATUS']); sys.exit(status) if status else time.sleep(60.0)"
SPEC = ProcessSpec("page", "ending_child", is_needed=False, niceness=7)


@pytest.fixture
def child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ending_child.py").write_text(CODE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


def run_until_told(children: ProcessManager, said: list[str], lines: int) -> object:
    """Look until so many lines were said, or an end."""
    deadline = time.monotonic() + 30.0
    while len(said) < lines and time.monotonic() < deadline:
        if (end := children.poll(time.monotonic())) is not None:
            return end
        time.sleep(0.01)
    return None


def children_of(config: Config, said: list[str]) -> ProcessManager:
    children = ProcessManager(config.run, lambda _spec, _is_restarted: ([], ()), lambda _level, text: said.append(text))
    children.start(SPEC)
    return children


@pytest.mark.usefixtures("child")
@pytest.mark.parametrize(
    ("status", "first", "last", "restarts"),
    [
        (1, "ended with status 1: restarting it, the survey goes on", "more than 3 times within 60 s", 3),
        (2, "ended with status 2: the survey goes on without it", "the survey goes on without it", 0),  # final
    ],
)
def test_a_process_that_is_not_needed(
    config: Config, monkeypatch: pytest.MonkeyPatch, status: int, first: str, last: str, restarts: int
) -> None:
    said: list[str] = []
    monkeypatch.setenv("STATUS", str(status))
    children = children_of(config, said)
    assert run_until_told(children, said, restarts + 1) is None
    assert said[0] == f"process page {first}"
    assert last in said[-1]
    assert (children.restarts, children.fds) == (restarts, [])
    assert children.poll(time.monotonic()) is None
    assert not children.is_recovering(time.monotonic())
    children.stop_all()


@pytest.mark.usefixtures("child")
def test_niceness_and_the_time_of_the_last_process(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setenv("STATUS", "0")
    monkeypatch.setattr("ccatp.daemon.child_processes.STOP_TIMEOUT_S", 0.0)  # others have used it up
    monkeypatch.setattr("ccatp.daemon.child_processes.LEAST_STOP_S", 30.0)
    children = children_of(config, said)
    (found,) = children._children.values()
    own = os.getpriority(os.PRIO_PROCESS, 0)
    assert os.getpriority(os.PRIO_PROCESS, found.process.pid) == min(own + 7, 19)
    children.stop_all()
    children.kill_all()
    assert said == []


@pytest.mark.fault("P18")
def test_a_crash_loop_ends_and_rare_deaths_do_not() -> None:
    policy = RestartPolicy(3, 60.0)
    assert [policy.died("main", -9, t).end for t in (0.0, 1.0, 2.0)] == [ProcessEnd.RESTART] * 3
    decision = policy.died("main", -9, 59.0)
    assert decision == (
        ProcessEnd.HELD,
        "process main was killed by SIGKILL, more than 3 times within 60 s: run ended, wheels held",
    )
    assert policy.died("danger", 1, 59.0).end is ProcessEnd.RESTART  # each counts for itself
    seldom = RestartPolicy(3, 60.0)
    assert {seldom.died("main", -9, 21.0 * k).end for k in range(50)} == {ProcessEnd.RESTART}


@pytest.mark.parametrize(
    ("code", "options", "end", "text"),
    [
        (2, {}, ProcessEnd.END, "ended with status 2"),  # would end alike
        (5, {}, ProcessEnd.END, "ended with status 5"),
        (-11, {"is_replaceable": False}, ProcessEnd.HELD, "was killed by SIGSEGV: run ended, wheels held"),
        (1, {}, ProcessEnd.RESTART, "ended with status 1: restarting it, wheels held meanwhile"),
        (-40, {}, ProcessEnd.RESTART, "was killed by signal 40: restarting it, wheels held meanwhile"),
        (-9, {"why": "hung"}, ProcessEnd.RESTART, "hung: restarting it, wheels held meanwhile"),
        (-9, {"is_needed": False}, ProcessEnd.RESTART, "was killed by SIGKILL: restarting it, the survey goes on"),
        (2, {"is_needed": False}, ProcessEnd.WITHOUT, "ended with status 2: the survey goes on without it"),
    ],
)
def test_the_decision_on_a_death(code: int, options: dict[str, Any], end: ProcessEnd, text: str) -> None:
    assert RestartPolicy(3, 60.0).died("main", code, 0.0, **options) == (end, f"process main {text}")


@pytest.mark.fault("P7")
def test_silence_counts_while_somebody_listens() -> None:
    watch = SilenceWatch(30.0, 2.0)
    watch.reset()
    now_s = 0.0
    for _ in range(18):
        now_s += 0.1
        assert not watch.is_hung(now_s)
    now_s += 3600.0  # the supervisor itself was stopped
    assert not watch.is_hung(now_s)
    assert watch.is_hung(now_s + 0.2)
    watch.reset()
    assert not watch.is_hung(now_s + 0.3)


def test_a_start_may_take_longer() -> None:
    watch = SilenceWatch(1.0, 0.3)
    assert not any(watch.is_hung(0.1 * k) for k in range(10))
    assert watch.is_hung(1.1)
    assert watch.text == "sent no heartbeat for 1 s and was killed"


def test_a_run_goes_on_without_a_page_that_dies_again() -> None:
    policy = RestartPolicy(1, 60.0)
    ends = [policy.died("dashboard", -9, t_s, is_needed=False).end for t_s in (0.0, 1.0)]
    assert ends == [ProcessEnd.RESTART, ProcessEnd.WITHOUT]


def test_none_is_wanted(config: Config) -> None:
    page = open_page_socket(config.dashboard.model_copy(update={"enabled": False}))
    assert (page.socket, page.text) == (None, "")


def test_any_free_port(config: Config) -> None:
    page = open_page_socket(config.dashboard.model_copy(update={"port": 0}))
    assert page.socket is not None
    with page.socket:
        assert page.config.port == page.socket.getsockname()[1] != 0
        assert (page.level, page.text) == ("info", f"dashboard: http://127.0.0.1:{page.config.port}/")


def test_a_port_in_use_is_replaced_and_told(config: Config) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        page = open_page_socket(config.dashboard.model_copy(update={"port": port}))
        assert page.socket is not None
        with page.socket:
            assert page.config.port != port
            assert page.level == "warning"
            assert page.text == (f"dashboard: port {port} is in use, so it is at http://127.0.0.1:{page.config.port}/")


def test_an_address_that_is_not_ours_is_no_end_of_a_survey(config: Config) -> None:
    page = open_page_socket(config.dashboard.model_copy(update={"host": "192.0.2.1"}))
    assert page.socket is None
    assert page.level == "warning"
    assert page.text.startswith(
        "no dashboard: cannot listen on 192.0.2.1:7080: Cannot assign requested address; choose"
    )


def test_no_port_at_all(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_host: str, _port: int) -> socket.socket:
        raise OSError(98, "Address already in use")

    monkeypatch.setattr(page_socket, "_listen", refuse)
    page = open_page_socket(config.dashboard)
    assert page.socket is None
    assert page.text.startswith("no dashboard: cannot listen on 127.0.0.1:7080: Address already in use")


def test_addresses() -> None:
    assert page_url("127.0.0.1", 7080) == "http://127.0.0.1:7080/"
    assert page_url("::1", 7080) == "http://[::1]:7080/"
