"""The daemon as a systemd service; real-time scheduling; the unit file."""

import configparser
import os
import platform
import re
import resource
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog
from structlog.testing import capture_logs

from ccatp.config.load import load_config
from ccatp.daemon.supervision.supervisor import Service
from ccatp.links import realtime
from ccatp.links.liveness import Liveness
from ccatp.links.service_manager import Notifier, is_journal, take_from
from ccatp.links.topics import Heartbeat, MissionStatus

UNIT = Path(__file__).parents[3] / "packaging" / "ccatp.service"
NO_STATUS = MissionStatus(seq=-1, t_s=0.0, state="")


class Manager:
    """A service manager's end of the notification socket."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self.socket.setblocking(False)

    def heard(self) -> list[str]:
        reported = []
        while True:
            try:
                reported.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return reported


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    manager = Manager(str(tmp_path / "notify") if request.param == "path" else f"@ccatp-test-{os.getpid()}")
    yield manager
    manager.socket.close()


def presence(name: str, t_s: float, phase: str = "joined", frame_age_s: float | None = 0.01) -> Heartbeat:
    return Heartbeat(seq=0, t_s=t_s, process=name, pid=1, phase=phase, frame_age_s=frame_age_s)


def both_alive(service: Service, t_s: float) -> None:
    for name in ("main", "danger"):
        service.on_heartbeat(presence(name, t_s))


def test_the_journal_is_known_by_its_descriptor(tmp_path: Path) -> None:
    with (tmp_path / "journal").open("w") as file:
        info = os.fstat(file.fileno())
        stream = {"JOURNAL_STREAM": f"{info.st_dev}:{info.st_ino}"}
        assert is_journal(file.fileno(), stream)
        assert not is_journal(file.fileno(), {})
        assert not is_journal(0, stream)
    assert not is_journal(-1, stream)


def test_a_service_manager_that_does_not_answer_delays_no_process(tmp_path: Path) -> None:
    Notifier("").send("READY=1")
    Notifier(str(tmp_path / "none")).send("READY=1")
    deaf = Manager(str(tmp_path / "notify"))
    for _ in range(10_000):  # more than its queue holds
        Notifier(deaf.address).send("WATCHDOG=1")
    assert 0 < len(deaf.heard()) < 10_000  # what its queue took is there, the rest was dropped without a wait
    deaf.socket.close()


@pytest.mark.parametrize(
    ("environ", "period_s"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "2000000"}, 2.0),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}, 2.0),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "-2"}, None),
        ({"WATCHDOG_USEC": "x"}, None),
    ],
)
def test_the_watchdog_is_for_the_process_it_names(environ: dict[str, str], period_s: float | None) -> None:
    environ |= {"NOTIFY_SOCKET": "/x", "PATH": "/bin"}
    notifier, found_s = take_from(environ)
    assert (notifier.has_listener, found_s) == (True, period_s)
    assert environ == {"PATH": "/bin"}  # children do not inherit the service manager


# -- what is alive ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("main", "danger", "trouble"),
    [
        (presence("main", 9.5), presence("danger", 9.5), ""),
        (presence("main", 8.9), presence("danger", 9.5), "main sent its last heartbeat 1.1 s ago"),
        (presence("main", 9.5), presence("danger", 8.0), "danger sent its last heartbeat 2.0 s ago"),
        (presence("main", 9.5, frame_age_s=0.6), presence("danger", 9.5), "main had its last frame .* 1.1 s ago"),
        (presence("main", 9.5), presence("danger", 9.5, frame_age_s=None), "danger has had no frame .*"),
        (presence("main", 9.5, "done", 7.0), presence("danger", 9.5), ""),
        (presence("main", 9.5), None, "danger has sent no heartbeat"),
    ],
)
def test_trouble(main: Heartbeat, danger: Heartbeat | None, trouble: str) -> None:
    liveness = Liveness(1.0)
    for one in (main, danger):
        if one is not None:
            liveness.update(one)
    assert re.fullmatch(trouble, liveness.trouble(10.0))


def test_a_service_from_its_start_to_its_end(manager: Manager) -> None:
    service = Service(Notifier(manager.address), 2.0)
    service.update(0.0, None)
    service.on_heartbeat(presence("main", 0.0))
    service.update(0.1, None)
    service.on_heartbeat(presence("danger", 0.1, "starting"))
    service.update(0.1, None)
    assert manager.heard() == []  # danger has not joined
    service.on_heartbeat(presence("danger", 0.1))
    service.update(0.2, None)
    assert manager.heard() == ["READY=1"]
    for tick in range(3, 33):
        both_alive(service, 0.1 * tick)
        service.update(0.1 * tick, NO_STATUS)
    reported = manager.heard()
    assert reported.count("WATCHDOG=1") == 6  # every half second
    assert [line for line in reported if line.startswith("STATUS")] == ["STATUS=, 0 of 0 points"]
    service.on_heartbeat(presence("main", 6.0))  # danger was last heard of at 3.2 s
    service.update(6.0, NO_STATUS)
    service.update(6.6, NO_STATUS)
    assert manager.heard() == ["STATUS=trouble: danger sent its last heartbeat 2.8 s ago"]
    both_alive(service, 6.7)
    service.update(6.7, NO_STATUS)
    assert manager.heard() == ["WATCHDOG=1", "STATUS=, 0 of 0 points"]
    service.stopping()
    assert manager.heard() == ["STOPPING=1\nSTATUS=holding the wheels and saving"]


@pytest.mark.parametrize(
    ("watchdog_s", "reported"),
    [
        # Silence counts well before a short watchdog bites.
        (0.4, ["WATCHDOG=1", "STATUS=joined the robot", "STATUS=trouble: main sent its last heartbeat 0.3 s ago"]),
        (None, ["STATUS=joined the robot"]),
    ],
)
def test_a_short_watchdog_and_none(manager: Manager, watchdog_s: float | None, reported: list[str]) -> None:
    service = Service(Notifier(manager.address), watchdog_s)
    both_alive(service, 0.0)
    for now_s in (0.0, 0.19, 0.3):
        service.update(now_s, None)
    assert manager.heard() == ["READY=1", *reported]


# -- real time --------------------------------------------------------------------------------------------------------


def test_without_permission_there_is_one_warning_that_says_what_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(resource, "setrlimit", refuse)
    with capture_logs() as lines:
        realtime.enter(0, structlog.get_logger())  # changes nothing
        realtime.enter(40, structlog.get_logger())
    (line,) = lines
    assert line["log_level"] == "warning"
    assert line["missing"][0] == "SCHED_FIFO 40: Operation not permitted; the unit grants it with LimitRTPRIO"
    assert "the unit grants it with LimitMEMLOCK=infinity" in line["missing"][1]
    assert "time-to-live" in line["without"]


REALTIME = """
import os, sys, structlog, zmq
from ccatp.links import realtime
context = zmq.Context()
ends = context.socket(zmq.PAIR), context.socket(zmq.PAIR)
ends[1].connect(f"tcp://127.0.0.1:{ends[0].bind_to_random_port('tcp://127.0.0.1')}")
ends[1].send(b"libzmq's thread is there and has its name")
ends[0].recv()
realtime.enter(7, structlog.wrap_logger(structlog.PrintLogger(), processors=[structlog.processors.KeyValueRenderer()]))
threads = [int(t) for t in os.listdir("/proc/self/task")]
fifo = [os.sched_getscheduler(t) & 3 == os.SCHED_FIFO for t in threads]
locked = next(int(l.split()[1]) for l in open("/proc/self/status") if l.startswith("VmLck"))
print(os.sched_getscheduler(0) & 3 == os.SCHED_FIFO, sum(fifo), len(threads), locked > 0)
context.destroy(linger=0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="SCHED_FIFO and mlockall are Linux's here")
def test_real_time_is_taken_where_it_is_permitted() -> None:
    result = subprocess.run([sys.executable, "-c", REALTIME], capture_output=True, text=True, timeout=60, check=True)
    said, state = result.stdout.splitlines()
    if "SCHED_FIFO 7: " not in said:
        # the caller and libzmq's I/O thread, not its reaper nor a thread of the linear algebra
        assert state.split()[:2] == ["True", "2"]
    else:
        assert state.split()[:2] == ["False", "0"]
    assert state.split()[3] == str("mlockall: " not in said)


CRUMBLING = """
import ctypes, sys
from ccatp.links import realtime
def resident_kib():
    return next(int(line.split()[1]) for line in open("/proc/self/smaps_rollup") if line.startswith("Anonymous:"))
reserve_bytes = int(sys.argv[1])
if not reserve_bytes:  # the memory that the imports left free would be used before new memory
    ctypes.CDLL(None).malloc_trim(0)
realtime.reserve_heap(reserve_bytes)
before = resident_kib()
blocks = [bytes(10_000) for _ in range(1000)]
print(resident_kib() - before)
blocks = None
print(resident_kib() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the heap of glibc")
@pytest.mark.parametrize(("reserve_bytes", "least_kib", "most_kib"), [(16 << 20, -64, 512), (0, 9_000, 11_000)])
def test_a_reserved_heap_grows_without_new_memory(reserve_bytes: int, least_kib: int, most_kib: int) -> None:
    command = [sys.executable, "-c", CRUMBLING, str(reserve_bytes)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    for grown_kib in map(int, result.stdout.split()):  # with 10 MB in use, and after that
        assert least_kib <= grown_kib <= most_kib


# -- the unit ---------------------------------------------------------------------------------------------------------


def analyze(tmp_path: Path, *args: str) -> "subprocess.CompletedProcess[str] | None":
    """What systemd says of the unit, with a program that exists here in the place of the installed one."""
    program = shutil.which("systemd-analyze")
    if program is None:
        return None
    path = tmp_path / UNIT.name
    path.write_text(UNIT.read_text().replace("/opt/ccatp/bin/ccatp", sys.executable))
    return subprocess.run([program, *args, str(path)], capture_output=True, text=True, timeout=60, check=False)


def settings() -> dict[str, str]:
    """The settings of [Service]; of those that are repeated the last one."""
    parser = configparser.ConfigParser(strict=False, interpolation=None, delimiters=("=",))
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read(UNIT)
    assert parser.sections() == ["Unit", "Service", "Install"]
    return dict(parser["Service"])


def test_systemd_has_nothing_to_say_about_the_unit(tmp_path: Path) -> None:
    result = analyze(tmp_path, "verify")
    if result is None:  # then at least it is a unit file, without unknown sections
        assert settings()
    else:
        assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


def test_the_unit_exposes_little(tmp_path: Path) -> None:
    # In tenths: 15 is an exposure of 1.5.
    result = analyze(tmp_path, "security", "--offline=true", "--no-pager", "--threshold=15")
    if result is None:  # then at least the settings that weigh most
        for key in ("NoNewPrivileges", "PrivateDevices", "PrivateUsers", "ProtectKernelModules", "RestrictNamespaces"):
            assert settings()[key] == "yes"
        assert settings()["CapabilityBoundingSet"] == ""
    else:
        assert result.returncode == 0, result.stdout


def test_the_unit_grants_what_the_loops_ask_for() -> None:
    wanted = {
        "Type": "notify",
        "LimitMEMLOCK": "infinity",
        "RestrictRealtime": "no",
        "RuntimeDirectoryMode": "0700",
        "Restart": "on-failure",
        "RestartPreventExitStatus": "1 2 4",
    }
    found = settings()
    assert {key: found[key] for key in wanted} == wanted
    assert int(found["LimitRTPRIO"]) >= load_config().run.realtime_priority > 0
    assert "--runtime-dir /run/ccatp" in found["ExecStart"]
    assert "--resume-last" in found["ExecStart"]  # what is restarted begins held
