"""Posts of alarms to a server on loopback that behaves badly."""

import json
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import msgspec
import pytest
import structlog
from structlog.testing import capture_logs

from ccatp.config.models import AlarmsConfig
from ccatp.daemon import webhook
from ccatp.daemon.webhook import AlarmWebhook, changes
from ccatp.links.topics import Alarm, MissionStatus
from tests.support.scenario import config_of

PATIENCE_S = 30.0


def alarm(name: str = "fan_weak", **fields: Any) -> Alarm:
    whole = Alarm(name=name, severity="return", cause="weak", advice="", since="A", since_s=1.0)
    return msgspec.structs.replace(whole, **fields)


def status(*alarms: Alarm) -> MissionStatus:
    return MissionStatus(seq=1, t_s=1.0, state="held", alarms=list(alarms))


class Server(ThreadingHTTPServer):
    """Answers with the next of ``answers``, then with 200."""

    answers: list[int]
    bodies: list[dict[str, Any]]


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["content-length"])))
        code = self.server.answers.pop(0) if self.server.answers else 200
        self.send_response(code)
        self.end_headers()
        self.server.bodies.append(body | {"answered": code})

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    with Server(("127.0.0.1", 0), Handler) as found:
        found.answers, found.bodies = [], []
        thread = threading.Thread(target=found.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield found
        found.shutdown()
        thread.join()


def hook_to(port: int, give_up_s: float = 600.0, known: Iterable[Alarm] = ()) -> AlarmWebhook:
    url = f"http://127.0.0.1:{port}/hook"
    cfg = AlarmsConfig(webhook_url=url, webhook_timeout_s=20.0, webhook_give_up_s=give_up_s)
    return AlarmWebhook(cfg, "tonight", structlog.get_logger(), known)


def until(server: Server, count: int) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while len(server.bodies) < count:
        assert time.monotonic() < deadline_s, server.bodies
        time.sleep(0.005)


@pytest.mark.parametrize(
    ("before", "after", "events"),
    [
        ([], [alarm()], ["raised"]),
        ([alarm()], [alarm()], []),
        ([alarm()], [alarm(severity="fault")], ["raised"]),
        ([alarm()], [alarm(count=2)], ["raised"]),
        ([alarm()], [alarm(acknowledged_by="anna")], ["acknowledged"]),
        ([alarm()], [alarm(ended="B")], ["ended"]),
        ([alarm()], [], ["ended"]),
        ([alarm(ended="B")], [], []),
        ([alarm("a")], [alarm("b", acknowledged_by="anna", ended="B")], ["raised", "acknowledged", "ended", "ended"]),
    ],
)
def test_what_is_posted(before: list[Alarm], after: list[Alarm], events: list[str]) -> None:
    by_name = [{one.name: one for one in alarms} for alarms in (before, after)]
    assert [event for event, _ in changes(*by_name)] == events


def test_a_post_that_is_not_taken_comes_again_in_order(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook, "FIRST_PAUSE_S", 0.01)
    server.answers += [500, 429]
    hook = hook_to(server.server_port)
    hook.update(None)
    hook.update(status(alarm()))
    hook.update(status(alarm()))
    hook.update(status(alarm(ended="B")))
    until(server, 4)
    hook.close(PATIENCE_S)
    assert [(body["event"], body["answered"]) for body in server.bodies] == [
        ("raised", 500), ("raised", 429), ("raised", 200), ("ended", 200),
    ]  # fmt: skip
    assert (server.bodies[0]["run"], server.bodies[0]["state"]) == ("tonight", "held")
    assert server.bodies[0]["alarm"]["cause"] == "weak"


def test_a_resumed_run_posts_what_changed_since_the_session_before(server: Server) -> None:
    over, lasting, gone = alarm("over", ended="B"), alarm("lasting"), alarm("gone", acknowledged_by="root")
    hook = hook_to(server.server_port, known=(over, lasting, gone))
    hook.update(status(over, lasting, alarm("new")))
    until(server, 2)
    hook.close(PATIENCE_S)
    found = [(body["event"], body["alarm"]["name"]) for body in server.bodies]
    assert found == [("raised", "new"), ("ended", "gone")]


def test_a_refusal_is_logged_and_the_next_one_is_posted(server: Server) -> None:
    server.answers.append(404)
    with capture_logs() as logs:
        hook = hook_to(server.server_port)
        hook.update(status(alarm()))
        until(server, 1)
        hook.update(status(alarm(ended="B")))
        until(server, 2)
        hook.close(PATIENCE_S)
    assert [(log["event"], log["why"]) for log in logs] == [("alarm_not_posted", "refused: status 404")]


def test_a_server_that_never_answers_delays_nothing_and_the_queue_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook, "MOST_WAITING", 3)
    with socket.create_server(("127.0.0.1", 0)) as silent, capture_logs() as logs:
        hook = hook_to(silent.getsockname()[1])
        for count in range(1, 11):
            hook.update(status(alarm(count=count)))
        hook.close(0.05)
    assert logs == [{"event": "alarm_posts_left_out", "log_level": "warning", "count": 10}]


def test_an_old_post_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook, "FIRST_PAUSE_S", 0.01)
    with socket.create_server(("127.0.0.1", 0)) as gone:
        port = gone.getsockname()[1]
    with capture_logs() as logs:
        hook = hook_to(port, give_up_s=0.02)
        hook.update(status(alarm()))
        deadline_s = time.monotonic() + PATIENCE_S
        while not logs and time.monotonic() < deadline_s:
            time.sleep(0.005)
        hook.close(PATIENCE_S)
    assert [log["event"] for log in logs] == ["alarm_not_posted"]


def test_without_an_address_there_is_no_thread() -> None:
    hook = AlarmWebhook(config_of().alarms, "run", structlog.get_logger())
    hook.update(status(alarm()))
    hook.close(PATIENCE_S)
    assert not [thread for thread in threading.enumerate() if thread.name == "webhook"]
