"""The observatory channel over TCP: real CURVE clients, listed and not, against the service of the danger process."""

import asyncio
import json
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pytest
import structlog
import zmq
import zmq.asyncio
from zmq.utils.monitor import parse_monitor_message

from ccatp.cli import main
from ccatp.config.models import ObservatoryConfig
from ccatp.daemon.operator.observatory import ObservatoryServer
from ccatp.danger import DangerMonitor
from ccatp.errors import ConfigError
from ccatp.links.auth import AuthorizedClient, KeyPair, read_pair, write_pair
from ccatp.links.channels import format_ok, format_request, parse_reply
from ccatp.links.rpc import MAX_CONNECTIONS, CurveClient, Router, ZapHandler, request, turn_away
from tests.contract.test_channels import Desk
from tests.support.command import refused

DEADLINE_S = 20.0
ID = "6f1c3c1e-5a0f-4d0e-9f2b-0c8f5b6a7d11"
PING = format_request("ping")
LOCKED_OUT = (
    zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_DISCONNECTED
)


@dataclass
class Site:
    """A folder with keys, and what is served from it."""

    folder: Path
    monitor: Desk
    logged: list[dict[str, Any]]
    endpoint: str = ""

    def pair(self, name: str) -> KeyPair:
        if not (self.folder / f"{name}.key").exists():
            write_pair(self.folder, name, is_replacing=False)
        return read_pair(self.folder / f"{name}.key_secret", "test")

    def enlist(self, **roles: str) -> None:
        tables = [
            f'[clients.{n}]\npublic_key = "{self.pair(n).public.decode()}"\nrole = "{r}"' for n, r in roles.items()
        ]
        (self.folder / "clients.toml").write_text("\n".join(tables) + "\n")

    def client(self, name: str, server: str = "server") -> CurveClient:
        return CurveClient(self.pair(server).public, self.pair(name))

    @property
    def config(self) -> ObservatoryConfig:
        return ObservatoryConfig(
            endpoint="tcp://127.0.0.1:*",
            key_file=str(self.folder / "server.key_secret"),
            clients_file=str(self.folder / "clients.toml"),
        )

    async def ask(self, name: str, payload: bytes = PING) -> dict[str, Any]:
        return await asyncio.to_thread(request, self.endpoint, payload, DEADLINE_S, self.client(name))

    def refusals(self) -> list[str]:
        return [line["why"] for line in self.logged if line["event"] == "observatory_refused"]


@pytest.fixture
def site(tmp_path: Path) -> Site:
    site = Site(tmp_path, Desk(), [])
    site.pair("server")
    site.enlist(observatory="clear", weather="raise")
    return site


def desk_of(site: Site) -> ObservatoryServer:
    def keep(_logger: object, _method: str, event: Any) -> Any:
        site.logged.append(dict(event))
        raise structlog.DropEvent

    log: structlog.typing.FilteringBoundLogger = structlog.wrap_logger(None, processors=[keep])
    monitor = cast(DangerMonitor, site.monitor)
    return ObservatoryServer(f"ipc://{site.folder}/emergency", site.config, monitor, lambda: 0.01, log)


@asynccontextmanager
async def served(site: Site) -> AsyncIterator[zmq.asyncio.Context]:
    """The observatory channel of a danger process."""
    context = zmq.asyncio.Context()
    observatory = desk_of(site)
    try:
        async with asyncio.timeout(DEADLINE_S), asyncio.TaskGroup() as tasks:
            task = tasks.create_task(observatory.serve(context))
            while not site.logged:  # noqa: ASYNC110 - it tells its port in the log
                await asyncio.sleep(0)
            site.endpoint = site.logged.pop()["endpoint"]
            try:
                yield context
            finally:
                task.cancel()
    finally:
        context.destroy(linger=0)


Setup = Callable[[zmq.asyncio.Socket], None]


async def is_locked_out(endpoint: str, set_up: Setup) -> bool:
    """Whether a client that sends a request is sent away without an answer."""
    with zmq.asyncio.Context() as context, context.socket(zmq.DEALER) as peer:
        peer.setsockopt(zmq.LINGER, 0)
        set_up(peer)
        with peer.get_monitor_socket(LOCKED_OUT) as events:
            peer.connect(endpoint)
            await peer.send(format_request("emergency", kind="fire", id=ID))
            await parse_event(events)
            await parse_event(events)  # it has tried again
            peer.disable_monitor()
        return not await peer.poll(0)


async def parse_event(events: Any) -> None:
    parse_monitor_message(await events.recv_multipart())


def with_curve(keys: CurveClient) -> Setup:
    def set_up(peer: zmq.asyncio.Socket) -> None:
        peer.setsockopt(zmq.CURVE_SERVERKEY, keys.server)
        peer.setsockopt(zmq.CURVE_PUBLICKEY, keys.own.public)
        peer.setsockopt(zmq.CURVE_SECRETKEY, keys.own.secret)

    return set_up


def plain(peer: zmq.asyncio.Socket) -> None:
    peer.setsockopt_string(zmq.PLAIN_USERNAME, "observatory")
    peer.setsockopt_string(zmq.PLAIN_PASSWORD, "secret")


@pytest.mark.fault("O5")
async def test_the_listed_get_answers_and_nobody_else_gets_in(site: Site, measured: Callable[..., None]) -> None:
    async with served(site):
        assert await site.ask("observatory") == {"ok": True, "code": 0, "age_s": 0.01}
        strangers: dict[str, Setup] = {
            "unlisted": with_curve(site.client("stranger")),
            "wrong server key": with_curve(site.client("observatory", server="another")),
            "no CURVE": lambda _: None,
            "password": plain,
        }
        for name, set_up in strangers.items():
            assert await is_locked_out(site.endpoint, set_up), name
        assert not site.monitor.latch.is_latched
        assert (await site.ask("weather"))["ok"]  # the server lives on
        stranger = site.pair("stranger").public.decode()
        assert f"127.0.0.1: key {stranger} is not on the list" in site.refusals()
    measured("O5", site.monitor.latch.is_latched)


async def test_garbage_and_silence_lose_the_connection_and_have_no_other_effect(site: Site) -> None:
    async with served(site):
        host, port = site.endpoint.removeprefix("tcp://").split(":")
        for payload in (b"GET / HTTP/1.1\r\n\r\n", b"\xff" * 100_000, b""):
            reader, writer = await asyncio.open_connection(host, int(port))
            writer.write(payload)
            try:
                while await reader.read(4096):
                    pass
            except ConnectionResetError:
                pass
            writer.close()
        assert (await site.ask("observatory"))["ok"]


@pytest.mark.fault("O6")
async def test_raising_needs_a_place_on_the_list_and_clearing_the_role(
    site: Site, measured: Callable[..., None]
) -> None:
    async with served(site):
        fire = format_request("emergency", kind="fire", id=ID)
        clear = format_request("clear", id=ID)
        assert await site.ask("weather", fire) == {"ok": True, "id": ID, "latched": True, "code": 2}
        refused = {"ok": False, "id": ID, "error": "this client may raise emergencies, not clear them"}
        assert await site.ask("weather", clear) == refused
        assert site.monitor.latch.is_latched
        measured("O6", not site.monitor.latch.is_latched)
        assert await site.ask("observatory", clear) == {"ok": True, "id": ID, "code": 0}
        assert not site.monitor.latch.is_latched
        assert [line["client"] for line in site.logged] == ["weather", "weather", "observatory"]


async def test_the_unix_socket_serves_the_user_of_the_daemon(site: Site) -> None:
    async with served(site):
        local = f"ipc://{site.folder}/emergency"
        for payload in (format_request("emergency", kind="fire", id=ID), format_request("clear", id=ID)):
            assert (await asyncio.to_thread(request, local, payload, DEADLINE_S))["ok"]


@pytest.mark.fault("O5")
@pytest.mark.parametrize("ruin", ["", "[clients", "gone"])
async def test_a_list_that_is_empty_or_unreadable_admits_no_client(site: Site, ruin: str) -> None:
    path = site.folder / "clients.toml"
    async with served(site):
        if ruin == "gone":
            path.unlink()
        else:
            path.write_text(ruin)
        assert await is_locked_out(site.endpoint, with_curve(site.client("observatory")))
        assert "clients_file" in site.refusals()[0]
        site.enlist(observatory="raise")
        assert (await site.ask("observatory"))["ok"]  # mended, without a restart


@pytest.mark.fault("O6")
async def test_a_client_removed_from_the_list_loses_its_rights_while_connected(site: Site) -> None:
    async with served(site) as context:
        with context.socket(zmq.DEALER) as peer:
            with_curve(site.client("observatory"))(peer)
            peer.connect(site.endpoint)
            await peer.send(PING)
            assert parse_reply(await peer.recv())["ok"]
            site.enlist(weather="raise")
            await peer.send(format_request("emergency", kind="fire", id=ID))
            assert parse_reply(await peer.recv()) == {"ok": False, "error": "this client is not on the list any more"}
        assert not site.monitor.latch.is_latched


@pytest.mark.fault("O5", "O6")
async def test_without_its_handler_nobody_gets_in(site: Site) -> None:
    # Left to itself libzmq would let in everybody who knows the server's key.
    context = zmq.asyncio.Context()
    listed = {site.pair("observatory").public.decode(): AuthorizedClient("observatory", "clear")}
    asked: list[str] = []

    def answer(_frame: bytes, user_id: str) -> bytes:
        asked.append(user_id)
        return format_ok()

    try:
        async with asyncio.timeout(DEADLINE_S), asyncio.TaskGroup() as tasks:
            zap = ZapHandler(context, lambda: listed, lambda _: None)
            router = Router("tcp://127.0.0.1:*", answer, context, site.pair("server"))
            async with router:
                serving = tasks.create_task(router.serve())
                site.endpoint = router.bound
                keys = with_curve(site.client("observatory"))
                assert await is_locked_out(site.endpoint, keys)  # not there yet
                async with zap:
                    handling = tasks.create_task(zap.serve())
                    assert (await site.ask("observatory"))["ok"]
                    handling.cancel()
                    await asyncio.wait([handling])
                assert await is_locked_out(site.endpoint, keys)  # gone
                with context.socket(zmq.REP) as dumb:
                    dumb.bind("inproc://zeromq.zap.01")
                    assert await is_locked_out(site.endpoint, keys)  # there, and silent
                serving.cancel()
                await asyncio.wait([serving])
        assert len(asked) == 1
    finally:
        context.destroy(linger=0)


async def test_a_handler_that_fails_takes_the_channel_with_it(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    def surprise(*_: object) -> None:
        raise LookupError("surprise")

    monkeypatch.setattr(ZapHandler, "callback", surprise)
    with pytest.raises(ExceptionGroup) as caught:
        async with served(site):
            await is_locked_out(site.endpoint, with_curve(site.client("observatory")))
    assert caught.group_contains(LookupError, match="surprise")


def test_what_cannot_be_served(site: Site) -> None:
    (site.folder / "clients.toml").write_text("")
    with pytest.raises(ConfigError, match=r"observatory\.clients_file: .*lists no client"):
        desk_of(site)
    site.enlist(weather="raise")
    (site.folder / "server.key_secret").chmod(0o644)
    with pytest.raises(ConfigError, match=r"observatory\.key_file: .*open to others"):
        desk_of(site)


async def test_the_command_talks_to_a_daemon_elsewhere(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    keys = ["--server-key", f"{site.folder}/server.key", "--timeout", "10"]
    async with served(site):
        argv = ["--endpoint", site.endpoint, *keys, "--key"]
        weather, observatory = f"{site.folder}/weather.key_secret", f"{site.folder}/observatory.key_secret"
        assert await asyncio.to_thread(main, ["emergency", "fire", "--id", ID, "--json", *argv, weather]) == 0
        assert json.loads(capsys.readouterr().out) == {"ok": True, "id": ID, "latched": True, "code": 2}
        assert await asyncio.to_thread(main, ["clear", ID, *argv, weather]) == 1
        assert capsys.readouterr().err == "ccatp: clear refused: this client may raise emergencies, not clear them\n"
        assert await asyncio.to_thread(main, ["clear", ID, *argv, observatory]) == 0
        site.pair("stranger")
        argv[argv.index("10")] = "0.3"
        assert await asyncio.to_thread(main, ["emergency", "fire", *argv, f"{site.folder}/stranger.key_secret"]) == 5
        assert "is ccatp running there, with this server key and you listed?" in capsys.readouterr().err
    assert not site.monitor.latch.is_latched


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--key", "k"], "go with --endpoint"),
        (["--endpoint", "tcp://h:1"], "--endpoint needs --server-key and --key"),
        (["--endpoint", "tcp://h:1", "--key", "k"], "--endpoint needs --server-key and --key"),
        (["--endpoint", "ipc://x"], "is not tcp://HOST:PORT"),
        (["--endpoint", "tcp://h:1", "--key", "none", "--server-key", "none"], "key: cannot read none"),
    ],
)
def test_half_an_address_is_misuse(argv: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert message in refused(capsys, "emergency", "fire", *argv)


# -- limits -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("transport", ["ipc", "tcp"])
async def test_connections_beyond_the_limit_are_turned_away(site: Site, transport: str) -> None:
    async with served(site) as context:
        path, port = f"{site.folder}/emergency", int(site.endpoint.rsplit(":", 1)[1])
        local = transport == "ipc"
        with context.socket(zmq.DEALER) as early:
            if not local:
                with_curve(site.client("observatory"))(early)
            early.connect(f"ipc://{path}" if local else site.endpoint)
            await early.send(PING)
            assert parse_reply(await early.recv())["ok"]
            crowd = []
            for _ in range(MAX_CONNECTIONS):
                crowd.append(await open_raw(path if local else port))
            ended = {asyncio.create_task(drained(reader)): n for n, (reader, _) in enumerate(crowd)}
            done, rest = await asyncio.wait(ended, return_when=asyncio.FIRST_COMPLETED)
            assert [ended[task] for task in done] == [MAX_CONNECTIONS - 1]  # the last; the others had their place
            await early.send(PING)
            assert parse_reply(await early.recv())["ok"]  # who is in stays in
            await asyncio.wait(rest)  # who says nothing gives the place back
            assert (await site.ask("weather"))["ok"]
            for _, writer in crowd:
                writer.close()


async def open_raw(address: str | int) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    if isinstance(address, int):
        return await asyncio.open_connection("127.0.0.1", address)
    peer = socket.socket(socket.AF_UNIX)
    await asyncio.to_thread(peer.connect, address)  # asyncio takes a full backlog of a unix socket for a connection
    return await asyncio.open_unix_connection(sock=peer)


async def drained(reader: asyncio.StreamReader) -> None:
    try:
        while await reader.read(4096):
            pass
    except ConnectionResetError:
        pass


def test_only_connections_of_the_endpoint_are_turned_away(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, (tmp_path / "file").open("w") as file:
        port = server.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as client, server.accept()[0] as accepted:
            assert not turn_away(accepted.fileno(), f"tcp://127.0.0.1:{port + 1}")
            assert not turn_away(file.fileno(), f"tcp://127.0.0.1:{port}")
            assert not turn_away(10_000, f"tcp://127.0.0.1:{port}")
            accepted.sendall(b"still there")
            assert client.recv(20) == b"still there"
            assert turn_away(accepted.fileno(), f"tcp://127.0.0.1:{port}")
            assert client.recv(20) == b""


async def test_a_flood_of_requests_leaves_the_event_loop_its_turns(tmp_path: Path) -> None:
    # Handlers answer at once, and messages wait: without giving way the loop would serve nothing else.
    turns = served_requests = 0
    over = asyncio.Event()

    def answer(_frame: bytes) -> bytes:
        nonlocal served_requests
        served_requests += 1
        if served_requests == 1:
            time.sleep(0.2)  # the others arrive meanwhile, and none has to be waited for
        if served_requests == 50:
            over.set()
        return format_ok()

    async def others() -> None:
        nonlocal turns
        while not over.is_set():
            turns += served_requests > 0
            await asyncio.sleep(0)

    context = zmq.asyncio.Context()
    try:
        async with asyncio.timeout(DEADLINE_S), Router(f"ipc://{tmp_path}/r", answer, context) as router:
            with context.socket(zmq.DEALER) as flood:
                flood.connect(f"ipc://{tmp_path}/r")
                for _ in range(60):
                    await flood.send(b"x")
                async with asyncio.TaskGroup() as tasks:
                    waiting = tasks.create_task(others())
                    serving = tasks.create_task(router.serve())
                    await waiting
                    serving.cancel()
        assert turns >= 40
    finally:
        context.destroy(linger=0)


@pytest.mark.fault("O5")
async def test_refusals_do_not_fill_the_log(site: Site) -> None:
    desk = desk_of(site)
    for _ in range(1000):
        desk.answer(b"nonsense")
        desk._log_refusal("unknown", "no")
    assert len(site.logged) == 10
