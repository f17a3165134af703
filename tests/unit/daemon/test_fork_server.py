"""The server that forks the processes of a run: what a fork has, and what happens when the server does not."""

import json
import os
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from ccatp.daemon.supervision import fork_server
from ccatp.daemon.supervision.fork_server import COMMAND_LINE_BYTES, SUPERVISOR_PID, ForkedProcess, ForkServer
from ccatp.daemon.supervision.supervisor import PROCESSES
from tests.support.runs import until

ROOT = Path(__file__).parents[3]
# Writes what it is into the file that is named first, then imports modules or waits for its end.
PROBE = """
import json, os, random, sys, threading, time
import numpy
from pathlib import Path

out, *words = sys.argv[1:]
before = sorted(sys.modules)
links = {fd: f"/proc/self/fd/{fd}" for fd in os.listdir("/proc/self/fd")}
# Newer versions of libffi keep their own file open, in every process that uses ctypes.
descriptors = [fd for fd, at in links.items() if os.path.lexists(at) and "/libffi.so" not in os.readlink(at)]
for word in words:
    if word.isdecimal():
        os.write(int(word), b"written")
    elif word != "wait":
        __import__(word)
found = {
    "before": before, "modules": sorted(sys.modules), "tasks": len(os.listdir("/proc/self/task")),
    "parent": os.getppid(), "session": os.getsid(0), "group": os.getpgrp(), "name": __name__, "random": random.random(),
    "numpy_random": numpy.random.random(),
    "argv": sys.argv, "environment": dict(os.environ), "stdin": os.readlink("/proc/self/fd/0"),
    "descriptors": descriptors, "threads": threading.active_count(),
}
Path(out + ".part").write_text(json.dumps(found))
os.rename(out + ".part", out)
if "wait" in words:
    time.sleep(60.0)
raise SystemExit(7)
"""


@contextmanager
def begun(folder: Path) -> Iterator[ForkServer]:
    """A server that can fork the probe."""
    (folder / "probe_of_fork.py").write_text(PROBE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(folder), *sys.path]))
        patch.setenv("PYTHONWARNINGS", "error")  # a fork of a process with threads warns
        patch.setenv("NOTIFY_SOCKET", "/of/the/supervisor")
        with ForkServer() as server:
            yield server


@pytest.fixture
def server(tmp_path: Path) -> Iterator[ForkServer]:
    with begun(tmp_path) as server:
        yield server


def started(server: ForkServer, out: Path, *words: str, fds: tuple[int, ...] = ()) -> ForkedProcess:
    process = server.start("probe_of_fork", [str(out), *words], fds)
    assert process is not None
    return process


def probed(server: ForkServer, out: Path, *words: str, fds: tuple[int, ...] = ()) -> dict[str, Any]:
    """What a process says that ran to its end."""
    process = started(server, out, *words, fds=fds)
    assert process.wait(30.0) == process.poll() == 7
    found: dict[str, Any] = json.loads(out.read_text())
    return found | {"pid": process.pid}


def forbidden_by(contract: str) -> set[str]:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (found,) = (one for one in contracts if one["id"] == contract)
    return set(found["forbidden_modules"])


def are_under(names: list[str], packages: set[str]) -> list[str]:
    return [name for name in names if any(f"{name}.".startswith(f"{package}.") for package in packages)]


def test_a_fork_is_what_a_started_process_would_be(server: ForkServer, tmp_path: Path) -> None:
    reader, writer = os.pipe()
    try:
        first = probed(server, tmp_path / "first", str(writer), fds=(writer,))
        second = probed(server, tmp_path / "second")
    finally:
        os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        assert pipe.read() == b"written"  # by the same number, and nobody holds the other end any longer
    assert (first["name"], first["argv"][1:]) == ("__main__", [str(tmp_path / "first"), str(writer)])
    assert Path(first["argv"][0]).name == "probe_of_fork.py"
    assert first["parent"] == os.getpid()
    assert first["session"] == first["group"] == first["pid"]  # Ctrl-C in the terminal does not reach it
    assert first["environment"][SUPERVISOR_PID] == str(os.getpid())
    assert first["environment"]["OPENBLAS_NUM_THREADS"] == "1"
    assert "NOTIFY_SOCKET" not in first["environment"]
    assert (first["stdin"], first["tasks"], first["threads"]) == ("/dev/null", 1, 1)
    assert first["random"] != second["random"]
    assert first["numpy_random"] != second["numpy_random"]
    # Besides input and output it has no descriptors of server or supervisor but those that were given.
    assert set(first["descriptors"]) == {"0", "1", "2", str(writer)}
    assert set(second["descriptors"]) == {"0", "1", "2"}


def test_ps_shows_the_command_of_the_process_as_far_as_there_is_room(server: ForkServer, tmp_path: Path) -> None:
    process = started(server, tmp_path / "out", "wait")
    until((tmp_path / "out").exists)
    shown = Path(f"/proc/{process.pid}/cmdline").read_bytes().rstrip(b"\0").split(b"\0")
    assert shown == [os.fsencode(w) for w in (sys.executable, "-m", "probe_of_fork", str(tmp_path / "out"), "wait")]
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.01)
    process.terminate()
    assert process.wait(30.0) == -signal.SIGTERM
    long = started(server, tmp_path / "long", *["1"] * COMMAND_LINE_BYTES, "wait")
    until((tmp_path / "long").exists)
    shown_of_long = Path(f"/proc/{long.pid}/cmdline").read_bytes().split(b"\0")
    assert shown_of_long[3:6] == [os.fsencode(tmp_path / "long"), b"1", b"1"]
    assert COMMAND_LINE_BYTES < sum(map(len, shown_of_long)) + len(shown_of_long) < 2 * COMMAND_LINE_BYTES
    long.kill()
    assert long.wait(30.0) == -signal.SIGKILL


@pytest.mark.parametrize(
    ("contract", "modules"),
    [
        ("danger", ("ccatp.daemon.loops.danger_loop", "ccatp.danger")),
        ("drivers", ("ccatp.daemon.loops.main_loop", "ccatp.daemon.loops.survey_runner")),
    ],
)
def test_a_fork_has_none_of_the_modules_that_the_import_contract_forbids(
    server: ForkServer, tmp_path: Path, contract: str, modules: tuple[str, ...]
) -> None:
    found, forbidden = probed(server, tmp_path / "out", *modules), forbidden_by(contract)
    assert set(modules) <= set(found["modules"])
    assert are_under(found["modules"], forbidden) == []
    # The server has what all processes need, and SciPy: nothing of a mission, database or picture.
    of_one = {
        "ccatp.survey",
        "ccatp.safety",
        "ccatp.sim",
        "ccatp.beacons",
        "ccatp.report",
        "sqlite3",
        "mcap",
    }
    assert are_under(found["before"], forbidden | of_one | {spec.module for spec in PROCESSES}) == []
    assert "zmq.asyncio" in found["before"]


def test_processes_outlive_the_server_which_then_starts_nothing(tmp_path: Path) -> None:
    with begun(tmp_path) as server:
        process = started(server, tmp_path / "out", "wait")
        psutil.Process(server.pid).kill()
        for _ in range(2):
            assert server.start("probe_of_fork", [str(tmp_path / "none")]) is None
        until((tmp_path / "out").exists)
        assert process.poll() is None
    assert process.poll() is None
    process.kill()
    assert process.wait(30.0) == -signal.SIGKILL
    assert not (tmp_path / "none").exists()


def test_a_server_that_does_not_answer_is_given_up_and_what_it_forks_later_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fork_server, "TIMEOUT_S", 0.2)
    with begun(tmp_path) as server:
        assert probed(server, tmp_path / "first")
        stopped = psutil.Process(server.pid)
        stopped.suspend()
        with monkeypatch.context() as patch:
            patch.setattr(subprocess.Popen, "kill", lambda _: stopped.resume())  # it forks before it ends
            assert server.start("probe_of_fork", [str(tmp_path / "late")]) is None
        # The process that it forked is a child of this one, and has ended by itself.
        pid, status = os.waitpid(-1, 0)
        assert (pid != server.pid, os.waitstatus_to_exitcode(status)) == (True, 1)
    assert not (tmp_path / "late").exists()
