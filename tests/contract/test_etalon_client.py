"""The Etalon client against a scripted server that misbehaves in every way, and against the stand-in."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager

import numpy as np
import pytest

from ccatp.config.models import EtalonConfig
from ccatp.core import Fix, Vector3
from ccatp.etalon_client import (
    BadSolution,
    EtalonBadReply,
    EtalonClient,
    EtalonError,
    EtalonServerError,
    EtalonTimeout,
    EtalonUnreachable,
    Readiness,
    TooFewChannels,
)
from ccatp.links.multiline import ChannelData, ChannelRecord, Connected, Environment, LaserReady, Remark, format_reply
from tests.support.scenario import config_of
from tests.support.sockets import scripted

CHANNELS = (1, 2, 3, 4, 5, 6, 7, 8)
COLLIMATORS = np.array([[x, y, z] for x in (-4.0, 5.0) for y in (-5.0, 4.0) for z in (-3.0, 6.0)])
PUCK = (0.31, -1.13, 0.42)
EXPECTED = (0.30, -1.10, 0.40)
ELSEWHERE = (0.25, -1.05, 0.45)
GOOD_ASK = b"latestlengthvalid,1,2,3,4,5,6,7,8\r\n"
EXACT_M = 1e-8  # lengths without noise: the rest is rounding

Action = bytes | Callable[[asyncio.StreamWriter], Awaitable[None]]


def records(position: Vector3 = PUCK, channels: tuple[int, ...] = CHANNELS) -> list[ChannelRecord]:
    lengths_mm = np.linalg.norm(COLLIMATORS - position, axis=1) * 1e3
    return [ChannelRecord(channel, float(lengths_mm[channel - 1]), 400, 2000, 5.0, 525.0, 30.0) for channel in channels]


def lengths(position: Vector3 = PUCK, channels: tuple[int, ...] = CHANNELS, server_error: int = 0) -> bytes:
    return format_reply(ChannelData(tuple(records(position, channels)), server_error))


class ScriptedServer:
    """Answers each line, on whatever connection, with the next action of its script; then with good lengths."""

    def __init__(self) -> None:
        self.script: deque[Action] = deque()
        self.asked: list[bytes] = []
        self.connections = 0
        self.greeting: deque[bytes] = deque()
        self.port = 0
        self._serving = AsyncExitStack()

    async def start(self) -> None:
        self.port = await self._serving.enter_async_context(scripted(self._serve, self.port))

    async def stop(self) -> None:
        await self._serving.aclose()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        if self.greeting:
            writer.write(self.greeting.popleft())
        while line := await reader.readline():
            self.asked.append(line)
            action = self.script.popleft() if self.script else lengths()
            if isinstance(action, bytes):
                writer.write(action)
            else:
                await action(writer)
            await writer.drain()


async def silence(_: asyncio.StreamWriter) -> None:
    """No reply."""


async def hang_up(writer: asyncio.StreamWriter) -> None:
    writer.close()


async def cut_off(writer: asyncio.StreamWriter) -> None:
    writer.write(lengths()[:100])
    writer.close()


async def flood(writer: asyncio.StreamWriter) -> None:
    while True:
        writer.write(b"1234,5678_" * 1000)
        await writer.drain()


@pytest.fixture
async def server() -> AsyncIterator[ScriptedServer]:
    scripted = ScriptedServer()
    await scripted.start()
    yield scripted
    await scripted.stop()


def config(port: int, **changes: float) -> EtalonConfig:
    quick = {"connect_timeout_s": 1.0, "request_timeout_s": 1.0, "reconnect_delay_s": 0.001, "measuring_time_s": 0.001}
    sigmas = {"length_sigma_m": 1e-6, "length_sigma_per_m": 2.5e-7}
    values = {"host": "127.0.0.1", "port": port, "retries": 0, "reconnect_for_s": 0.0, **quick, **sigmas, **changes}
    return EtalonConfig.model_validate(config_of().etalon.model_dump() | values)


@asynccontextmanager
async def client_of(port: int, **changes: float) -> AsyncIterator[EtalonClient]:
    client = EtalonClient(config(port, **changes), CHANNELS, COLLIMATORS)
    try:
        yield client
    finally:
        await client.close()


def assert_at(fix: Fix, position: Vector3) -> None:
    assert fix.position_m == pytest.approx(position, abs=EXACT_M)


async def test_a_measurement_asks_once_and_gives_the_fix_at_the_time_of_standstill(server: ScriptedServer) -> None:
    async with client_of(server.port) as client:
        await client.connect()
        fix = await client.measure(123.45, EXPECTED)
    assert server.asked == [GOOD_ASK]
    assert fix.t_s == 123.45
    assert fix.channels == CHANNELS
    assert_at(fix, PUCK)
    assert fix.residual_rms_m < EXACT_M
    covariance = np.array(fix.covariance_m2).reshape(3, 3)
    # Lengths of some 7 m: sigma 2.75 um each, and eight of them.
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)
    assert np.sqrt(np.trace(covariance)) == pytest.approx(2.75e-6 * fix.dop, rel=0.2)  # lengths differ by 30 %


async def test_four_channels_suffice_and_three_do_not(server: ScriptedServer) -> None:
    server.script += [lengths(channels=(1, 4, 6, 8)), lengths(channels=(1, 4, 6))]
    async with client_of(server.port) as client:
        fix = await client.measure(0.0, EXPECTED)
        assert fix.channels == (1, 4, 6, 8)
        assert_at(fix, PUCK)
        with pytest.raises(TooFewChannels, match=r"3 valid channels, 4 needed \(2: absent, 3: absent.*8: absent"):
            await client.measure(0.0, EXPECTED)


async def test_a_server_error_is_reported_with_its_code(server: ScriptedServer) -> None:
    server.script += [lengths(server_error=3), format_reply(Remark("error", "busy"))]
    async with client_of(server.port) as client:
        with pytest.raises(EtalonServerError, match="server error 3; see its log"):
            await client.measure(0.0, EXPECTED)
        with pytest.raises(EtalonServerError, match="refused latestlengthvalid: 'busy'"):
            await client.measure(0.0, EXPECTED)
        assert_at(await client.measure(0.0, EXPECTED), PUCK)


@pytest.mark.fault("E2")
async def test_a_late_reply_never_answers_the_next_request(server: ScriptedServer) -> None:
    release = asyncio.Event()

    async def late(writer: asyncio.StreamWriter) -> None:
        await release.wait()
        writer.write(lengths(ELSEWHERE))

    server.script.append(late)
    async with client_of(server.port, request_timeout_s=0.05) as client:
        with pytest.raises(EtalonTimeout, match=r"no reply to latestlengthvalid within 0\.05 s"):
            await client.measure(1.0, EXPECTED)
        release.set()
        assert_at(await client.measure(2.0, EXPECTED), PUCK)
        assert client.counts["connects"] == server.connections == 2


async def test_each_error_that_is_followed_by_a_retry_is_reported(
    server: ScriptedServer, capfd: pytest.CaptureFixture[str]
) -> None:
    reported: list[tuple[str, int]] = []
    server.script.extend((b"garbage\r\n", silence))
    cfg = config(server.port, request_timeout_s=0.05, retries=2)
    client = EtalonClient(cfg, CHANNELS, COLLIMATORS, lambda error, left: reported.append((type(error).__name__, left)))
    assert_at(await client.measure(1.0, EXPECTED), PUCK)
    await client.close()
    assert reported == [("EtalonBadReply", 1), ("EtalonTimeout", 0)]
    assert capfd.readouterr() == ("", "")  # whoever uses it may have given standard output to JSON


async def test_a_cancelled_request_takes_its_connection_with_it(server: ScriptedServer) -> None:
    server.script.append(silence)
    async with client_of(server.port) as client:
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.05):
                await client.measure(1.0, EXPECTED)
        assert_at(await client.measure(2.0, EXPECTED), PUCK)
        assert client.counts["connects"] == 2


GARBAGE: list[Action] = [
    b"\r\n",
    b"\x00\xff\x00\xff\n",
    b"HTTP/1.1 400 Bad Request\r\n",
    b"channeldata_0_0_0\r\n",
    lengths()[:-30] + b"\r\n",
    lengths().replace(b".", b","),
    b"isconnected_1\r\n",
    b"measstarted\r\n",
    b"defanadata_1,2,3\r\n",
    lengths() + lengths(ELSEWHERE),
    lengths() + b"x",
    b"1" * 200_000,
    b"1" * 200_000 + b"\r\n",
    flood,
]


@pytest.mark.fault("E7", "E8")
@pytest.mark.parametrize("action", GARBAGE)
async def test_garbage_is_a_typed_error_and_the_next_request_is_clean(server: ScriptedServer, action: Action) -> None:
    server.script.append(action)
    async with client_of(server.port) as client:
        with pytest.raises(EtalonBadReply, match=r"^Etalon server 127\.0\.0\.1:\d+: .*; is this a MultiLine server\?$"):
            await client.measure(1.0, EXPECTED)
        assert_at(await client.measure(2.0, EXPECTED), PUCK)
        assert client.counts["connects"] == 2


@pytest.mark.parametrize("action", [hang_up, cut_off])
async def test_a_lost_connection_is_a_typed_error_and_made_anew(server: ScriptedServer, action: Action) -> None:
    server.script.append(action)
    async with client_of(server.port) as client:
        with pytest.raises(EtalonUnreachable, match="closed the connection; is it running"):
            await client.measure(1.0, EXPECTED)
        assert_at(await client.measure(2.0, EXPECTED), PUCK)


@pytest.mark.fault("E2")
@pytest.mark.parametrize("greeting", [lengths(ELSEWHERE), b"channeldata_1,12"])
async def test_what_came_unasked_is_not_taken_for_the_reply(server: ScriptedServer, greeting: bytes) -> None:
    server.greeting.append(greeting)
    async with client_of(server.port) as client, asyncio.timeout(5.0):
        await client.connect()
        while server.greeting:  # noqa: ASYNC110 - the server reports nothing
            await asyncio.sleep(0)
        assert_at(await client.measure(1.0, EXPECTED), PUCK)
        assert client.counts["drained"] == 1
        assert server.asked == [GOOD_ASK]


@pytest.mark.fault("E6")
async def test_a_server_that_restarts_is_found_again(server: ScriptedServer) -> None:
    async with client_of(server.port) as client:
        assert_at(await client.measure(1.0, EXPECTED), PUCK)
        await server.stop()
        with pytest.raises(EtalonUnreachable, match=r"is it running, are \[etalon\] host, port right\?"):
            await client.measure(2.0, EXPECTED)
        await server.start()
        assert_at(await client.measure(3.0, EXPECTED), PUCK)


@pytest.mark.parametrize(
    "action", [lengths(channels=(1, 2)), lengths(server_error=1), b"junk\r\n", hang_up, lengths((9.0, 9.0, 9.0))]
)
async def test_every_failure_is_retried_as_often_as_configured(server: ScriptedServer, action: Action) -> None:
    async with client_of(server.port, retries=2) as client:
        server.script += [action, action]
        assert_at(await client.measure(1.0, EXPECTED), PUCK)
        server.script += [action, action, action]
        with pytest.raises(EtalonError):
            await client.measure(2.0, EXPECTED)
        assert len(server.asked) == 6


async def test_lengths_that_contradict_each_other_are_refused(server: ScriptedServer) -> None:
    wrong = records()
    for k, error_mm in enumerate((20.0, -20.0, 15.0, -25.0, 20.0, -15.0, 25.0, -20.0)):
        wrong[k] = wrong[k]._replace(length_mm=wrong[k].length_mm + error_mm)
    server.script.append(format_reply(ChannelData(tuple(wrong))))
    async with client_of(server.port) as client:
        with pytest.raises(BadSolution, match=r"contradict each other by up to .* mm, more than 5 mm"):
            await client.measure(1.0, EXPECTED)


@pytest.mark.parametrize("error_mm", [0.1, 2.0, 10.0, 300.0, 5000.0, 1e308])
async def test_one_wrong_channel_is_not_used_and_only_it_is_named(server: ScriptedServer, error_mm: float) -> None:
    wrong = records()
    wrong[5] = wrong[5]._replace(length_mm=wrong[5].length_mm + error_mm)
    server.script.append(format_reply(ChannelData(tuple(wrong))))
    async with client_of(server.port) as client:
        fix = await client.measure(1.0, EXPECTED)
    assert_at(fix, PUCK)
    assert fix.channels == tuple(channel for channel in CHANNELS if channel != CHANNELS[5])
    if error_mm < 1e308:  # that one is no length at all
        assert fix.left_out == (CHANNELS[5],)
        assert fix.metrology == "good"


async def test_lengths_beyond_any_number_are_one_failed_measurement(server: ScriptedServer) -> None:
    wrong = [one._replace(length_mm=1e308) for one in records()]
    server.script.append(format_reply(ChannelData(tuple(wrong))))
    async with client_of(server.port) as client:
        with pytest.raises(EtalonError, match="1e\\+308"):
            await client.measure(1.0, EXPECTED)


@pytest.mark.parametrize(("channels", "rows"), [((1, 2, 3), 3), ((1, 2, 3, 4), 8), ((1, 2, 3, 3), 4)])
def test_channels_and_collimators_must_fit(channels: tuple[int, ...], rows: int) -> None:
    with pytest.raises(ValueError, match=r"need \(k, 3\), k >= 4"):
        EtalonClient(config(1), channels, COLLIMATORS[:rows])


async def test_readiness_is_asked_in_three_requests(server: ScriptedServer) -> None:
    air = Environment(5.0, 525.0, 30.0)
    server.script += [format_reply(reply) for reply in (Connected(True), LaserReady(False), air)]
    async with client_of(server.port) as client:
        assert await client.isready() == Readiness(True, False, air)
    assert server.asked == [b"isconnected\r\n", b"laserready\r\n", b"environmentdata\r\n"]


async def test_two_measurements_at_a_time_take_turns(server: ScriptedServer) -> None:
    server.script += [lengths(), lengths(ELSEWHERE)]
    async with client_of(server.port) as client:
        first, second = await asyncio.gather(client.measure(1.0, EXPECTED), client.measure(2.0, EXPECTED))
    assert_at(first, PUCK)
    assert_at(second, ELSEWHERE)
    assert server.connections == 1
