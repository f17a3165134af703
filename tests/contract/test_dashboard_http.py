"""The dashboard over HTTP: the real application on a real socket, with a simulated daemon behind it."""

import asyncio
import contextlib
import json
import re
import shutil
import socket
import time
import uuid
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import structlog
from playwright.async_api import Page, async_playwright, expect
from prometheus_client import CONTENT_TYPE_LATEST

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import PointId
from ccatp.daemon.supervision.process import open_log
from ccatp.links.channels import format_error, format_ok
from ccatp.links.topics import TrackMessage, TruthMessage, Turn
from ccatp.report.dashboard.app import build_app
from tests.support.page_rig import DEADLINE_S, Rig, mission, page_rig
from tests.unit.report.dashboard.test_view import parse
from tests.unit.report.dashboard.test_views import fix_at

FILES = (
    "page.js", "map.js", "plots.js", "commands.js", "alarms.js", "history.js",
    "page.css", "icon.svg", "uPlot.iife.min.js", "uPlot.min.css"
)  # fmt: skip
TOKEN = "0123456789abcdef0123456789abcdef"


@pytest.fixture(scope="module")
def cfg() -> Config:
    return load_config(None, {"run.panels": 1, "dashboard.slow_client_s": 0.4, "dashboard.command_timeout_s": 0.5})


@pytest.fixture
async def rig(cfg: Config, runtime_dir: Path) -> AsyncIterator[Rig]:
    async with page_rig(cfg, runtime_dir) as rig:
        yield rig


async def test_the_page_and_all_that_it_needs_come_from_here(rig: Rig) -> None:
    page = await rig.ask("GET", "/")
    assert page.code == 200
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    policy = page.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self';")
    assert "unsafe" not in policy
    assert page.headers["x-content-type-options"] == "nosniff"
    assert b"://" not in page.body.replace(b"http://www.w3.org/2000/svg", b"")
    for name in FILES:
        file = await rig.ask("GET", f"/static/{name}")
        assert file.code == 200, name
        assert len(file.body) > 100
        assert file.headers["cache-control"] == "no-cache"
        again = await rig.ask("GET", f"/static/{name}", if_none_match=file.headers["etag"])
        assert (again.code, again.body) == (304, b"")
    ground = (await rig.ask("GET", "/ground")).data
    assert (ground["title"], ground["is_sim"]) == ("fyst-m1", True)
    assert len(ground["points"]) == 9


async def test_the_description_has_every_route_of_the_application_and_no_other(rig: Rig) -> None:
    found = (await rig.ask("GET", "/api/v1/openapi.json")).data
    assert found["openapi"].startswith("3.1.")
    assert {"title", "version"} <= found["info"].keys()
    names, described = [], set()
    for path, operations in found["paths"].items():
        for method, operation in operations.items():
            names.append(operation["operationId"])
            described.add((path, method.upper()))
            assert operation["responses"]["200"]["content"], path
            assert all(one["description"] for one in operation["responses"].values())
            scopes = [name for one in operation.get("security", []) for name in one]
            assert scopes == ["token"] * ("401" in operation["responses"])
            in_path = {
                one["name"] for one in operation.get("parameters", []) if one["required"] and one["in"] == "path"
            }
            assert in_path == set(re.findall(r"{(\w+)}", path))
    assert len(names) == len(set(names))
    assert found["components"]["securitySchemes"].keys() == {"token"}
    for reference in re.findall(r'"#/([^"]+)"', json.dumps(found)):
        part = found
        for key in reference.split("/"):
            part = part[key]  # a KeyError: it leads nowhere
    hub: Any = SimpleNamespace(state=dict, pages=0)
    starlette: Any = build_app(hub, hub, {}, load_config().dashboard, {}, structlog.get_logger())
    *routes, mount = starlette.routes
    for of_app in (routes, mount.routes):
        assert {(one.path, method) for one in of_app for method in one.methods - {"HEAD"}} == described
    assert {one["url"] for one in found["servers"]} == {"/", mount.path}
    for path, method in described - {("/events", "GET"), ("/static/{path}", "GET")}:
        body = b"{}" if method == "POST" else b""
        reply = await rig.ask(method, path, body=body)
        operation = found["paths"][path][method.lower()]
        assert str(reply.code) in operation["responses"], (path, reply.code)
        kind = reply.headers["content-type"].partition(";")[0]
        assert kind in operation["responses"][str(reply.code)]["content"]


async def test_the_name_of_a_token(rig: Rig) -> None:
    assert (await rig.ask("GET", "/operator")).code == 401
    reply = await rig.ask("GET", "/operator", authorization=f"Bearer {rig.token}")
    assert (reply.code, reply.data) == (200, {"status": "ok", "name": "operator"})


async def test_what_there_is_not_is_reported_as_the_telescope_does(rig: Rig) -> None:
    for method, path, code, message in (
        ("GET", "/nothing", 404, "bad endpoint: /nothing"),
        ("GET", "/static/none.js", 404, "bad endpoint: /static/none.js"),
        ("POST", "/static/page.js", 405, "method not GET"),
        ("GET", "/static/../app.py", 404, "bad endpoint: /static/../app.py"),
        ("GET", "/abort", 405, "method not POST"),
        ("POST", "/status", 405, "method not GET"),
        ("POST", "/events", 405, "method not GET"),
    ):
        reply = await rig.ask(method, path)
        assert (reply.code, reply.data) == (code, {"status": "error", "message": message})
        assert "content-security-policy" in reply.headers


async def test_status_health_and_metrics(rig: Rig) -> None:
    sick = await rig.ask("GET", "/healthz")
    assert (sick.code, sick.data) == (503, {"status": "error", "message": "main has sent no heartbeat"})
    well = await rig.until("/healthz", lambda reply: reply.code == 200)
    assert well.data == {"status": "ok"}
    status = (await rig.until("/status", lambda reply: reply.data["pose"] is not None)).data
    assert (status["status"], status["mission"]["state"], status["trouble"]) == ("ok", "driving", "")
    reply = await rig.until("/metrics", lambda reply: b"position_sigma" in reply.body)
    assert reply.headers["content-type"] == CONTENT_TYPE_LATEST
    metrics = parse(reply.body.decode())
    assert metrics["ccatp_up"] == {(): 1.0}
    assert metrics["ccatp_points"]["measured",] == 3.0


@pytest.mark.parametrize(("path", "of_pose"), [("/status", b'"covariance_m2"'), ("/metrics", b"position_sigma")])
async def test_the_first_state_has_a_pose(path: str, of_pose: bytes, rig: Rig) -> None:
    async def live() -> None:
        while True:
            rig.tell_alive()
            await asyncio.sleep(0.02)

    async with asyncio.TaskGroup() as tasks:
        living = tasks.create_task(live())
        await asyncio.sleep(0.5)  # it hears of the mission, and nobody has looked
        reply = await rig.ask("GET", path)
        living.cancel()
    assert of_pose in reply.body


async def test_a_command_goes_to_the_operator_channel(rig: Rig) -> None:
    for command in ("pause", "resume", "abort", "stop"):
        reply = await rig.ask("POST", f"/{command}")
        assert (reply.code, reply.data) == (200, {"status": "ok"})
        assert rig.asked[-1] == {"cmd": command, "by": "operator"}
        assert (rig.lines[-1]["command"], rig.lines[-1]["by"]) == (command, "operator")


async def test_an_alarm_is_acknowledged_by_the_name_of_the_token(rig: Rig) -> None:
    for path in ("/alarms/ack", "/api/v1/alarms/ack"):
        reply = await rig.ask("POST", path, body=b'{"name": "fan_weak", "by": "somebody else"}')
        assert (reply.code, rig.asked[-1]) == (200, {"cmd": "acknowledge", "name": "fan_weak", "by": "operator"})
    rig.asked.clear()
    reply = await rig.ask("POST", "/alarms/ack", body=b"[]")
    assert (reply.code, reply.data["message"], rig.asked) == (400, "alarms/ack: not a JSON object", [])
    assert (await rig.ask("GET", "/alarms/ack")).data["message"] == "method not POST"
    assert (await rig.ask("GET", "/alarms")).data == {"status": "ok", "alarms": []}


async def test_emergencies_go_to_the_observatory_channel(rig: Rig) -> None:
    async def latch(frame: bytes) -> bytes:
        return format_ok(id=json.loads(frame)["id"], latched=True, code=2)

    rig.answer = latch
    for fields in ({"kind": "fire"}, {"kind": "fire", "id": str(uuid.uuid4()), "note": "smoke"}):
        reply = await rig.ask("POST", "/emergency", body=json.dumps(fields).encode())
        assert (reply.code, reply.data["latched"], reply.data["code"]) == (200, True, 2)
        assert rig.asked[-1] == {"cmd": "emergency", "id": reply.data["id"], **fields}
    reply = await rig.ask("POST", "/clear", body=b'{"id": "x", "cmd": "emergency"}')
    assert (reply.code, rig.asked[-1]) == (200, {"cmd": "clear", "id": "x"})
    rig.asked.clear()
    for body in (b"", b"[1]", b"{", b'{"id": "\\ud800"}', b'{"id": 1, "id": 2}', b'{"id":' + b"[" * 60_000):
        reply = await rig.ask("POST", "/clear", body=body)
        assert (reply.code, rig.asked) == (400, []), body[:20]
        assert reply.data["message"].startswith("clear: ")


CHUNK = b"8000\r\n" + b"x" * 0x8000 + b"\r\n"


async def test_long_and_slow_bodies_are_refused(rig: Rig) -> None:
    chunked = {"transfer_encoding": "chunked"}
    for body, headers, code in (
        (b"x" * 65_536, {}, 200),
        (2 * CHUNK + b"0\r\n\r\n", chunked, 200),
        (b"x" * 1_000_000, {}, 413),
        (b"", {"content_length": "1000000000000"}, 413),  # none of it has been sent
        (3 * CHUNK, chunked, 413),  # nor the end
        (CHUNK, chunked, 408),
    ):
        reply = await rig.ask("POST", "/pause", body=body, **headers)
        assert (reply.code, len(rig.asked)) == (code, 1 if code == 200 else 0)
        rig.asked.clear()
    assert (await rig.ask("GET", "/status", content_length="65537")).code == 413


@pytest.mark.parametrize(("request_line", "code"), [(b"POST /pause", b"401"), (b"GET /events", b"200")])
async def test_an_endless_body_ends_with_its_connection(rig: Rig, request_line: bytes, code: bytes) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", rig.port)
    writer.write(request_line + b" HTTP/1.1\r\nhost: localhost\r\ntransfer-encoding: chunked\r\n\r\n")
    async with asyncio.timeout(DEADLINE_S):
        assert (await reader.readuntil(b"}\n")).startswith(b"HTTP/1.1 " + code)
        with contextlib.suppress(ConnectionError):
            while True:
                writer.write(CHUNK)
                await writer.drain()
    writer.close()


async def test_the_answer_comes_when_the_command_took_effect(rig: Rig) -> None:
    asked, took_effect = asyncio.Event(), asyncio.Event()

    async def later(_frame: bytes) -> bytes:
        asked.set()
        await took_effect.wait()
        return format_ok()

    rig.answer = later
    async with asyncio.TaskGroup() as tasks:
        reply = tasks.create_task(rig.ask("POST", "/pause"))
        await asked.wait()
        assert (await rig.ask("GET", "/ground")).code == 200  # others are served meanwhile
        assert not reply.done()
        took_effect.set()
    assert reply.result().code == 200


async def test_a_refusal_has_its_reason(rig: Rig) -> None:
    for command, answer, code, why in (
        ("resume", format_error("the mission is not held but turning"), 409, "the mission is not held but turning"),
        ("stop", b"maybe", 502, "the main loop answered with not UTF-8 JSON"),
    ):

        async def refuse(_frame: bytes, answer: bytes = answer) -> bytes:
            return answer

        rig.answer = refuse
        reply = await rig.ask("POST", f"/{command}")
        assert (reply.code, reply.data) == (code, {"status": "error", "message": f"{command}: {why}"})


async def test_no_daemon_is_reported_within_the_time(cfg: Config, runtime_dir: Path) -> None:
    async with page_rig(cfg, runtime_dir, has_daemon=False) as rig:
        reply = await rig.ask("POST", "/abort")
    assert reply.code == 504
    assert reply.data["message"] == "abort: no answer from the main loop within 0.5 s"


async def test_too_many_commands_at_a_time(rig: Rig) -> None:
    never = asyncio.Event()

    async def hang(_frame: bytes) -> bytes:
        await never.wait()
        return format_ok()

    rig.answer = hang
    async with asyncio.TaskGroup() as tasks:
        waiting = [tasks.create_task(rig.ask("POST", "/pause")) for _ in range(9)]
    codes = sorted(task.result().code for task in waiting)
    assert codes == [503, *[504] * 8]
    never.set()


async def test_pages_of_others_command_nothing_and_read_nothing(rig: Rig) -> None:
    for headers, code in (({"origin": "http://evil.example"}, 403), ({"host": "evil.org"}, 421)):
        assert ((await rig.ask("POST", "/abort", body=b"", **headers)).code, rig.asked) == (code, [])
    for path in ("/", "/status", "/events", "/ground", "/metrics", "/static/page.js"):
        assert (await rig.ask("GET", path, host="evil.example")).code == 421
        reply = await rig.ask("GET", path if path != "/events" else "/status", origin="http://evil.example")
        assert "access-control-allow-origin" not in reply.headers  # what a browser does not hand to their script


@pytest.mark.fault("O6")
async def test_every_command_needs_the_token_of_this_start(rig: Rig, measured: Callable[..., None]) -> None:
    for command in ("pause", "resume", "abort", "stop", "emergency", "clear", "api/v1/resume"):
        for wrong in ("", f"Bearer {TOKEN}", rig.token, f"Bearer {rig.token[:-1]}"):
            reply = await rig.ask("POST", f"/{command}?token={rig.token}", authorization=wrong)
            assert (reply.code, rig.asked) == (401, [])
    measured("O6", len(rig.asked))
    assert (await rig.ask("POST", "/abort")).code == 200
    assert rig.token not in str(rig.lines)


async def test_no_log_holds_a_token(rig: Rig, runtime_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = open_log(runtime_dir / "log.jsonl", "dashboard")
    authorization = f"Bearer {rig.token}"
    try:
        raise RuntimeError("with the token among the variables")
    except RuntimeError:
        log.exception("asgi_failed")
    text = (runtime_dir / "log.jsonl").read_text()
    assert "with the token among the variables" in text
    assert authorization not in text


async def test_commands_with_configured_tokens(cfg: Config, runtime_dir: Path) -> None:
    path = runtime_dir / "token"
    path.write_text(f"bob {TOKEN[::-1]}\nalice {TOKEN}\n")
    path.chmod(0o600)
    guarded = cfg.dashboard.model_copy(update={"token_file": str(path), "host_names": ("m1.local",)})
    async with page_rig(cfg.model_copy(update={"dashboard": guarded}), runtime_dir) as rig:
        assert (await rig.ask("GET", "/ground", host="m1.local")).code == 200
        for none in ("", "Bearer wrong", f"Bearer {rig.token}"):
            reply = await rig.ask("POST", "/abort", authorization=none)
            assert reply.code == 401
            assert reply.headers["www-authenticate"] == "Bearer"
            assert rig.asked == []
        assert (await rig.ask("POST", "/abort", authorization=f"Bearer {TOKEN}")).code == 200
        assert rig.lines[-1]["by"] == "alice"
        assert TOKEN not in str(rig.lines)
        assert (await rig.ask("GET", "/status")).code == 200  # looking needs none


def log_line(text: str) -> str:
    line = {"event": "operator_message", "level": "info", "timestamp": "2026-11-26T03:32:00.5Z", "text": text}
    return json.dumps(line) + "\n"


async def test_a_page_begins_with_everything_and_continues_with_news(rig: Rig, runtime_dir: Path) -> None:
    await rig.until("/healthz", lambda reply: reply.code == 200)
    async with rig.page() as first:
        assert b"text/event-stream" in first.head
        assert b"no-store" in first.head
        name, state = await first.event()
        assert name == "all"
        assert state["is_sim"] is True
        (runtime_dir / "log.jsonl").write_text(log_line("a line"))
        name, state = await first.until(lambda _, state: bool(state["log"]))
        assert (name, state["log"]) == ("news", [["2026-11-26T03:32:00.5Z", "info", "a line", 1, 1]])
        async with rig.page() as second:
            name, state = await second.event()
            assert (name, [row[2] for row in state["log"]]) == ("all", ["a line"])
        rig.tell_alive()
        _, state = await first.until(lambda _, state: state["pose"] is not None)
        assert state["losses"] == []


async def test_nobody_waits_for_us_and_nobody_works_for_us_while_nobody_looks(rig: Rig) -> None:
    # A run begins when track, estimate and verdict have subscribers: those of the run itself.
    def subscribed() -> set[str]:
        names = {"track", "estimate", "display_state", "mission"}
        found = {name for name in names if rig.main.has_subscriber(name)}
        return found | ({"verdict"} if rig.danger.has_subscriber("verdict") else set())

    await rig.until("/ground", lambda reply: reply.code == 200)
    assert subscribed() == set()
    async with rig.page() as page:
        while "display_state" not in subscribed():
            await page.event()
        assert subscribed() == {"display_state"}
        rig.tell_alive()
        await page.until(lambda _, state: state["pose"] is not None)
    async with asyncio.timeout(DEADLINE_S):
        while subscribed():
            await rig.ask("GET", "/ground")


async def test_a_dead_loop_shows_at_once_and_a_silent_one_soon(rig: Rig) -> None:
    await rig.until("/healthz", lambda reply: reply.code == 200)
    async with rig.page() as page:
        while not rig.main.has_subscriber("display_state"):
            await page.event()
        rig.tell_alive()
        rig.danger.close()
        _, state = await page.until(lambda _, state: bool(state["losses"]))
        assert state["losses"][0][0] == "the danger loop is gone"
        assert state["losses"][0][1] < 0.8  # cut, not merely silent for as long as it may be
        reply = await rig.ask("GET", "/healthz")
        assert reply.code == 503
        assert reply.data["message"].startswith("the danger loop is gone for ")
        _, state = await page.until(lambda _, state: len(state["losses"]) == 2)
        assert state["losses"][0][0] == "the main loop has not reported"
        assert state["losses"][0][1] >= 0.8


async def test_the_end_is_reported_and_comes_soon_with_a_page_open(rig: Rig) -> None:
    await rig.until("/healthz", lambda reply: reply.code == 200)
    async with rig.page() as page:
        await page.event()
        rig.main.send("mission", mission(state="done", outcome="complete", done=9, exit_status=0))
        await page.until(lambda _, state: state["is_over"])
        begun_s = time.monotonic()
        rig.stop.set()
        _, state = await page.until(lambda name, _: name == "end")
        assert state["mission"]["outcome"] == "complete"
        with pytest.raises(EOFError):
            await page.event()
        assert time.monotonic() - begun_s < 2.0  # nothing in it waits but for the server's own look, every 0.1 s


async def closed(reader: asyncio.StreamReader) -> bytes:
    """What came until the other end closed."""
    async with asyncio.timeout(DEADLINE_S):
        try:
            return await reader.read()
        except ConnectionError:
            return b""


ANSWERED = b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n\r\n"


async def test_a_client_that_sends_no_complete_request_is_disconnected(rig: Rig) -> None:
    # After a first request no keep-alive of the server's own counts.
    for sent in ((b"",), (b"GET / HTTP/1.1\r\nhost: local",), (ANSWERED, b"GET /healthz HTTP")):
        reader, writer = await asyncio.open_connection("127.0.0.1", rig.port)
        for part in sent:
            writer.write(part)
            if part == ANSWERED:
                async with asyncio.timeout(DEADLINE_S):
                    await reader.readuntil(b"}\n")
        assert b"200 OK" not in await closed(reader)
        writer.close()


async def test_a_client_that_reads_nothing_is_disconnected(rig: Rig, runtime_dir: Path) -> None:
    await rig.until("/healthz", lambda reply: reply.code == 200)
    lazy = socket.socket()
    lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    lazy.setblocking(False)
    loop = asyncio.get_running_loop()
    with contextlib.ExitStack() as stack:
        stack.enter_context(lazy)
        await loop.sock_connect(lazy, ("127.0.0.1", rig.port))
        await loop.sock_sendall(lazy, f"GET /events HTTP/1.1\r\nhost: 127.0.0.1:{rig.port}\r\n\r\n".encode())
        log = stack.enter_context((runtime_dir / "log.jsonl").open("a"))
        async with asyncio.timeout(DEADLINE_S):
            metrics: dict[tuple[str, ...], float] = {}
            while metrics != {(): 1.0}:
                metrics = parse((await rig.ask("GET", "/metrics")).body.decode())["ccatp_dashboard_pages"]
            while metrics != {(): 0.0}:
                log.write(log_line("x" * 50_000))
                log.flush()
                metrics = parse((await rig.ask("GET", "/metrics")).body.decode())["ccatp_dashboard_pages"]


STREAM = b"GET /events HTTP/1.1\r\nhost: localhost\r\n\r\n"


@pytest.mark.fault("O11")
@pytest.mark.parametrize("sent", [STREAM, b"GET / HTTP/1.1\r\nhost: local", b""])
async def test_many_connections_of_one_client_block_nobody(
    cfg: Config, runtime_dir: Path, sent: bytes, measured: Callable[..., None]
) -> None:
    patient = cfg.dashboard.model_copy(update={"slow_client_s": DEADLINE_S, "command_timeout_s": DEADLINE_S})
    begun, took_effect = asyncio.Event(), asyncio.Event()

    async def later(_frame: bytes) -> bytes:
        begun.set()
        await took_effect.wait()
        return format_ok()

    async with (
        page_rig(cfg.model_copy(update={"dashboard": patient}), runtime_dir) as rig,
        rig.page("127.0.0.2") as page,
    ):
        rig.answer = later
        async with asyncio.TaskGroup() as tasks:
            first = tasks.create_task(rig.ask("POST", "/pause"))
            await begun.wait()
            crowd = [await asyncio.open_connection("127.0.0.1", rig.port) for _ in range(40)]
            for _, writer in crowd:
                writer.write(sent)
            took_effect.set()
        assert first.result().code == 200  # the oldest connection of that address, but a command
        assert (await rig.ask("POST", "/resume")).code == 200
        assert (await rig.ask("GET", "/healthz")).code in (200, 503)
        async with rig.page() as another:
            await another.event()
        await page.event()
        measured("O11", 0)
        for _, writer in crowd:
            writer.close()


# -- in a real browser ------------------------------------------------------------------------------------------------

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium: the page is not tried in a browser")
async def test_what_a_page_shows_and_that_its_end_is_not_that_of_the_survey(runtime_dir: Path) -> None:
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = await browser.new_page(viewport={"width": 1280, "height": 900})
        page.set_default_timeout(20_000)
        async with page_rig(load_config(None, {"run.panels": 1}), runtime_dir) as rig:
            await page.goto(f"http://127.0.0.1:{rig.port}/")
            await expect(page.locator("#state")).not_to_have_text("connecting")
            rig.tell_alive()
            await expect(page.locator("#state")).to_have_text("driving")
            await is_laid_out(page, rig)
            await takes_a_token(page, rig)
        await expect(page.locator("#alarm")).to_contain_text("LINK LOST")
        await expect(page.locator("#alarm-text")).to_have_text("the dashboard has ended; the survey may continue")
        await expect(page.locator("#ended")).to_be_hidden()
        await expect(page.locator("#abort")).to_be_disabled()
        await browser.close()


async def takes_a_token(page: Page, rig: Rig) -> None:
    await expect(page.locator("#read-only")).to_contain_text("Read-only: commands need a token")
    await expect(page.locator("#pause")).to_be_disabled()
    for token, answer in ((rig.token[::-1], "refused: the token is not accepted"), (rig.token, "pause: done")):
        await page.goto(f"http://127.0.0.1:{rig.port}/?token={token}")
        await expect(page).to_have_url(f"http://127.0.0.1:{rig.port}/")
        rig.tell_alive(turn=Turn(kind="work", offers=("pause", "abort", "stop")))
        await expect(page.locator("#pause")).to_be_enabled()
        await page.locator("#pause").click()
        await expect(page.locator("#answer")).to_contain_text(answer)
        await expect(page.locator("#read-only")).to_be_visible(visible=token != rig.token)
    assert [request["cmd"] for request in rig.asked] == ["pause"]


async def is_laid_out(page: Page, rig: Rig) -> None:
    """Everything of a survey on a desktop without scrolling; a plot without values takes no room."""
    captions = page.locator("figcaption:visible")
    await expect(captions).to_have_count(0)
    await expect(page.locator("#no-plots")).to_be_visible()
    await page.locator("#engineer").check()
    await expect(captions).to_have_count(1)  # NIS is of every display state
    await expect(page.locator("#no-plots")).to_be_hidden()
    times_s = range(4)
    rows = [(100 * t_s, float(t_s), 1, 2, 0.0, 0.05, 0.0, 0.001) for t_s in times_s]
    true = [(100 * t_s, float(t_s), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0, 0) for t_s in times_s]
    rig.main.send("track", TrackMessage(seq=300, t_s=3.0, rows=rows))
    rig.truth.send("truth", TruthMessage(seq=300, t_s=3.0, rows=true))
    rig.main.send("fix", fix_at(PointId(1, 2, 7), 0.001))
    await expect(captions).to_have_count(4)
    await page.set_viewport_size({"width": 1440, "height": 900})
    assert await page.evaluate("document.documentElement.scrollHeight") <= 900
    for part in (".map", "#plot-arrival", "#plot-nis", "#log", "#controls"):
        box = await page.locator(part).bounding_box()
        assert box is not None
        assert box["y"] >= 0.0, part
        assert box["y"] + box["height"] <= 900.0, part
