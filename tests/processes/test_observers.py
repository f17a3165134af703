"""Who looks at a run in real time, or speaks to it: a viewer, the check, dashboards, clients. The survey goes on."""

import http.client
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

import psutil
import pytest
import zmq

from ccatp.cli import main
from ccatp.config.load import load_config
from ccatp.daemon.operator.streaming import streamed_schemas
from ccatp.errors import RefusedError
from ccatp.links.bus import Subscriber
from ccatp.links.client import HttpClient, OperatorClient
from ccatp.links.topics import DisplayState
from ccatp.records.recorder import iter_messages
from ccatp.studies.sil_run import rehearse
from tests.docs.test_docs import blocks
from tests.processes.conftest import Start
from tests.support.dashboards import WITH_PAGE, open_page, page_port
from tests.support.examples import is_like
from tests.support.runs import NO_CALIBRATION, NO_REPORT, Run, figures_of
from tools.generated_docs import DOCS, ROOT

URL = re.compile(r"http://127\.0\.0\.1:(\d+)/")
DEADLINE_S = 30.0


def ask(port: int, method: str, path: str) -> tuple[int, Any]:
    """One request, and its answer as JSON."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=DEADLINE_S)
    try:
        connection.request(method, path)
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())
    finally:
        connection.close()


def mission_of(port: int) -> dict[str, Any]:
    """Where the mission stands, once the dashboard has received it."""
    deadline = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline:
        mission: dict[str, Any] | None = ask(port, "GET", "/status")[1]["mission"]
        if mission is not None:
            return mission
    raise AssertionError("the dashboard receives nothing")


# -- runs of their own ------------------------------------------------------------------------------------------------


def test_the_dashboard_is_restarted_and_clients_pause_resume_and_call_home(start: Start, runtime_dir: Path) -> None:
    run = start("--panels", "1", "--realtime", *WITH_PAGE, "--set", "run.budget_s=10")
    run.until_state("turning", "driving")
    port = page_port(run)
    assert mission_of(port)["total"] == 9
    first = run.child("dashboard")
    # It gets what time the others leave.
    assert first.nice() > psutil.Process(run.process.pid).nice()
    first.kill()
    second = run.child("dashboard", not_pid=first.pid)
    # The port is held by the supervisor: who comes meanwhile is served by the next one.
    code, status = ask(port, "GET", "/status")
    assert (code, status["restarts"]) == (200, {"main": 0, "danger": 0})
    assert second.is_running()

    daemon = OperatorClient(runtime_dir)
    assert daemon.status().total == 9
    assert daemon.pause().state == "held"
    page = HttpClient(f"http://127.0.0.1:{port}", (runtime_dir / "dashboard.token").read_text().strip())
    healthy_by_s = time.monotonic() + 20.0  # the page that was restarted has to receive a heartbeat of each loop
    while not page.is_healthy():
        assert time.monotonic() < healthy_by_s
        time.sleep(0.05)
    assert page.status()["mission"]["total"] == 9
    command = [sys.executable, "-m", "ccatp", "status", "--runtime-dir", str(runtime_dir)]
    status = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=True).stdout
    page.resume()
    daemon.wait(lambda status: status.state != "held", timeout_s=20.0)
    with pytest.raises(RefusedError, match="resume refused"):
        daemon.resume()
    assert daemon.observatory.ping().code == 0
    latched = daemon.observatory.emergency("weather", "wind")
    assert latched.code == 2
    # At base the daemon ends; requests then time out, and its exit status says the rest.
    assert run.wait() == 3
    assert re.search(
        r"order thesis takes about \d min .* more than run\.budget_s \(0 min 10 s\); no order keeps", run.stderr
    )
    assert "process dashboard was killed by SIGKILL: restarting it, the survey continues" in run.stderr
    shown = re.search(r"dashboard: http://127\.0\.0\.1:\d+/\?token=([0-9a-f]{32})\n", run.stderr)
    assert shown is not None
    assert shown[1] == page.token  # after the restart, too
    assert f"http://127.0.0.1:{port}/?token={page.token}\n" in status
    assert not [path for path in run.run_dir.iterdir() if page.token.encode() in path.read_bytes()]
    assert "Traceback" not in run.stderr


@pytest.mark.slow
def test_a_port_in_use_stops_no_survey_and_the_summary_is_the_same(start: Start) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        run = start("--panels", "1", "--set", "dashboard.enabled=true", "--set", f"dashboard.port={taken}")
        run.until_state("driving")
        with open_page(page_port(run)):
            assert run.wait() == 0, run.stderr
    assert f"warning: dashboard: port {taken} is in use, so it is at http://127.0.0.1:{page_port(run)}/" in run.stderr
    # Looking on changes nothing: as in process, without any display.
    assert figures_of(run.summary) == figures_of(rehearse(load_config(run.run_dir / "config.toml")).summary)


def test_the_simulated_servers_are_ready(runtime_dir: Path, tmp_path: Path) -> None:
    status, found = check("--sim", "--mirror", "fyst-m2", "--runtime-dir", runtime_dir, "--runs-dir", tmp_path)
    wrong = {name for name, one in found.items() if one["outcome"] not in ("pass", "warn")}
    assert wrong <= {"frames", "robot clock"}  # of which a loaded machine is part
    assert status == (1 if wrong else 0)
    assert found["laser fix"]["outcome"] == "pass"
    assert "the slope is that of fyst-m2" in found["gravity"]["found"]


# -- the first look of the documentation: its commands print what it shows ---------------------------------------------

EXAMPLE = re.compile(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", re.MULTILINE)


@pytest.fixture(scope="module")
def looked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """The directory in which the commands ran, and what they printed otherwise than the page shows."""
    folder = tmp_path_factory.mktemp("first_look")
    unlike = []
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("HOME", str(folder))
        patch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
        for command, shown in EXAMPLE.findall("".join(blocks(DOCS / "first_look.md", "console"))):
            status, printed = run_example(command)
            if status or not is_like(shown, printed):
                unlike.append(f"$ {command}\n{printed}")
    return folder, unlike


def run_example(command: str) -> tuple[int, str]:
    """Exit status and standard output; a command of ``ccatp`` that starts no processes, in this one."""
    name, *words = shlex.split(command)
    if name == "ccatp" and words[0] != "run":
        with redirect_stdout(StringIO()) as printed:
            return main(words), printed.getvalue()
    env = os.environ | (NO_REPORT if name == "ccatp" else {})
    done = subprocess.run(command, shell=True, env=env, capture_output=True, text=True, timeout=300, check=False)
    return done.returncode, done.stdout


def test_the_commands_print_what_the_page_shows(looked: tuple[Path, list[str]]) -> None:
    assert looked[1] == []


@pytest.fixture(scope="module")
def recorded(looked: tuple[Path, list[str]]) -> dict[str, set[str]]:
    """Names of the fields of the recorded messages, by topic."""
    fields: dict[str, set[str]] = {}
    for topic, _, payload in iter_messages(looked[0] / "runs" / "first" / "telemetry.mcap"):
        fields.setdefault(topic, set()).update(json.loads(payload))
    return fields


def named_in(node: Any) -> Iterator[tuple[str, str]]:
    """Topic and field of whatever a layout of Foxglove shows; no field where it shows whole messages."""
    if isinstance(node, list):
        for one in node:
            yield from named_in(one)
    for key, value in node.items() if isinstance(node, dict) else ():
        if key == "topics":
            yield from ((topic, "") for topic in value)
        elif key == "topicToRender":
            yield value, ""
        elif key == "value":
            topic, _, field = value.partition(".")
            yield topic, field
        else:
            yield from named_in(value)


def panels_of(node: Any) -> list[str]:
    return [node] if isinstance(node, str) else [*panels_of(node["first"]), *panels_of(node["second"])]


def is_there(topic: str, field: str, recorded: dict[str, set[str]]) -> bool:
    is_recorded = topic in recorded and (not field or field in recorded[topic])
    return is_recorded and topic in dict(streamed_schemas())


def test_what_foxgloves_layout_shows_is_recorded_and_streamed(recorded: dict[str, set[str]]) -> None:
    layout = json.loads((ROOT / "packaging" / "foxglove" / "ccatp.json").read_text(encoding="utf-8"))
    assert sorted(panels_of(layout["layout"])) == sorted(layout["configById"])
    shown = list(named_in(layout["configById"]))
    assert len(shown) > 15
    assert [one for one in shown if not is_there(*one, recorded)] == []


def test_what_plotjugglers_layout_plots_is_recorded_and_streamed(recorded: dict[str, set[str]]) -> None:
    root = ET.parse(ROOT / "packaging" / "plotjuggler" / "ccatp.xml").getroot()
    curves = [str(curve.get("name")) for curve in root.iter("curve")]
    assert len(curves) > 15
    series = [one.rpartition("/") for one in curves]
    assert [topic + field for topic, _, field in series if not is_there(topic, field, recorded)] == []
    for splitter in root.iter("DockSplitter"):
        assert splitter.get("count") == str(len(splitter)) == str(len(str(splitter.get("sizes")).split(";")))


# -- beside one run, last in the file, so that it ends with them -------------------------------------------------------


class Beside(NamedTuple):
    """A run that lasts longer than these tests, and `ccatp stream` beside it."""

    run: Run
    stream: "subprocess.Popen[str]"


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Beside]:
    with tempfile.TemporaryDirectory(prefix="ccatp-") as sockets:
        command = [sys.executable, "-m", "ccatp", "stream", "--runtime-dir", sockets, "--port", "0"]
        args = ("--realtime", "--panels", "9", "--mirror", "thesis-m1", *NO_CALIBRATION)
        # The stream begins before the run, which must not mistake it for its recorder.
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as stream:
            try:
                with Run(tmp_path_factory.mktemp("beside") / "run", Path(sockets), *args) as run:
                    run.until_state("driving")
                    yield Beside(run, stream)
            finally:
                stream.kill()


def test_a_late_viewer_sees_the_run(beside: Beside) -> None:
    assert beside.stream.stderr is not None
    where = beside.stream.stderr.readline().rpartition(" ")[2].strip()
    with zmq.Context() as context, context.socket(zmq.SUB) as viewer:
        viewer.setsockopt(zmq.LINGER, 0)
        viewer.setsockopt(zmq.RCVTIMEO, 20_000)
        viewer.setsockopt(zmq.SUBSCRIBE, b"")
        viewer.connect(where)
        found: dict[str, dict[str, object]] = {}
        wanted = {"run", "view/panels", "view/frames", "view/robot", "view/sensors", "view/error", "mission"}
        while wanted - found.keys():
            topic, payload, t_s = viewer.recv_multipart()
            found[topic.decode()] = json.loads(payload)
            float(t_s)
    assert found["run"] | {"run_dir": ""} == {
        "mirror": "thesis-m1", "world": "thesis", "simulation": True, "seed": 1, "filter": "ekf", "run_dir": "",
    }  # fmt: skip
    assert abs(float(str(found["view/error"]["position_mm"]))) < 50.0
    beside.stream.send_signal(signal.SIGTERM)
    assert beside.stream.wait(10.0) == 0


def check(*args: object) -> tuple[int, dict[str, dict[str, Any]]]:
    """Exit status and findings of `ccatp check`."""
    command = [sys.executable, "-m", "ccatp", "check", "--json", *map(str, args)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    assert "Traceback" not in done.stderr
    return done.returncode, {one["name"]: one for one in json.loads(done.stdout)["checks"]}


def test_the_check_does_not_disturb_a_robot_that_is_driven(beside: Beside, tmp_path: Path) -> None:
    run = beside.run
    config = run.run_dir / "config.toml"
    status, found = check("--config", config, "--runtime-dir", run.runtime_dir, "--runs-dir", tmp_path)
    assert status == 1
    assert "role taken" in found["robot link"]["found"]
    assert "a daemon runs in" in found["runtime directory"]["found"]
    # A machine that starts a command may serve a frame late, and the daemon holds for that, but never for the check.
    at = run.ask("status")["status"]
    assert at["state"] != "held" or "late" in at["cause"], at["cause"]


def test_the_main_loop_samples_its_display_state_for_a_history_while_nobody_watches(beside: Beside) -> None:
    main = f"ipc://{beside.run.runtime_dir / 'main'}"
    with zmq.Context() as context:
        history = Subscriber(context, [main], ["display_state"], is_uncounted=True)
        samples = [history.receive(DEADLINE_S) for _ in range(2)]
        history.close()
    assert all(sample is not None and isinstance(sample[2], DisplayState) for sample in samples)


def test_an_attached_dashboard_ends_with_a_page_open(beside: Beside) -> None:
    with attached(beside.run) as (process, port):
        assert ask(port, "GET", "/ground")[1]["is_sim"] is True
        assert mission_of(port)["total"] == 81
        with open_page(port) as page:
            process.send_signal(signal.SIGTERM)
            assert process.wait(DEADLINE_S) == 0
            received = b"".join(iter(lambda: page.recv(65_536), b""))
    assert b"event: end" in received
    assert received.endswith(b"0\r\n\r\n")
    assert beside.run.ask("status")["ok"]  # the daemon does not mind


@contextmanager
def attached(run: Run) -> Iterator[tuple["subprocess.Popen[str]", int]]:
    """`ccatp dashboard` beside a run."""
    command = [sys.executable, "-m", "ccatp", "dashboard", "--port", "0", "--runtime-dir", str(run.runtime_dir)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            found = URL.search(process.stdout.readline())
            assert found is not None
            yield process, int(found[1])
        finally:
            if process.poll() is None:
                process.kill()
