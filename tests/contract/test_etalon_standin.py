"""The Etalon stand-in to the byte, and under everything that a client may do wrong."""

import asyncio
import logging
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing

import numpy as np
import pytest
import zmq
import zmq.asyncio

from ccatp.config.models import SimEtalonConfig
from ccatp.links.multiline import FLAGS, ChannelData, parse_reply
from ccatp.sim import etalon_server as etalon_standin
from ccatp.sim.etalon_server import EtalonSimulator, FixedPuck, PuckSource, TruthUnavailable, ZmqPuck
from ccatp.sim.laser import PuckTruth
from tests.support.scenario import any_port
from tests.support.sockets import peer_of

CHANNELS = (1, 2, 3, 4)
COLLIMATORS = np.array([[0.0, 0.0, 5.0], [3.0, 0.0, 4.0], [0.0, 4.0, 3.0], [-6.0, 0.0, 8.0]])
QUIET = SimEtalonConfig(host="127.0.0.1", port=0, length_sigma_m=0.0, length_sigma_per_m=0.0, motion_tolerance_m=1e-4)
NOISY = QUIET.model_copy(update={"length_sigma_m": 1e-6})
AIR = b"-5.0,525.0,30.0"
CLEAN = b"400,2000," + AIR + b",0,0,0,0,0,0,0,0,0,0"
DEAD = b"0,0," + AIR + b",0,0,0,0,0,0,0,0,0,1"


def standin(truth: PuckSource | None = None, cfg: SimEtalonConfig = QUIET, seed: int = 3) -> EtalonSimulator:
    puck = truth or FixedPuck((0.0, 0.0, 0.0))
    return EtalonSimulator(cfg, CHANNELS, COLLIMATORS, puck, np.random.default_rng(seed))


@asynccontextmanager
async def running(server: EtalonSimulator) -> AsyncIterator[int]:
    port = await server.start(any_port())
    try:
        yield port
    finally:
        await server.close()


GOLDEN = [
    (b"isconnected\r\n", b"isconnected_1\r\n"),
    (b"laserready\r\n", b"laserready_1\r\n"),
    (b"environmentdata\r\n", b"environmentdata_" + AIR + b"\r\n"),
    (b"latestlengthvalid,1\r\n", b"channeldata_1,5000.0," + CLEAN + b"_0\r\n"),
    (b"latestlengthvalid,4,2\n", b"channeldata_4,10000.0," + CLEAN + b"_2,5000.0," + CLEAN + b"_0\r\n"),
    (b"latestlengthvalid,9\r\n", b"channeldata_9,0.0," + DEAD + b"_0\r\n"),
    (b"stopmeasnogui\r\n", b"measstopped\r\n"),
]


@pytest.mark.parametrize(("request_", "reply"), GOLDEN)
async def test_replies_to_the_byte(request_: bytes, reply: bytes) -> None:
    async with running(standin()) as port, peer_of(port) as client:
        assert await client.ask(request_) == reply


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"\r\n", b"unknown-request"),
        (b"isconnected,1\r\n", b"bad-arguments"),
        (b"latestlengthvalid,1,1\r\n", b"bad-channel"),
        (b"x" * 60_000 + b"\r\n", b"unknown-request"),
    ],
)
async def test_a_bad_line_is_answered_counted_and_nothing_else(line: bytes, reason: bytes) -> None:
    server = standin()
    async with running(server) as port, peer_of(port) as client:
        assert await client.ask(line) == b"error_" + reason + b"\r\n"
        assert server.counts == {"bad_requests": 1}
        assert await client.ask(b"isconnected\r\n") == b"isconnected_1\r\n"


@pytest.mark.parametrize("flag", FLAGS)
async def test_each_of_the_ten_error_flags_reaches_the_wire(flag: str) -> None:
    server = standin()
    server.model.flags = {2: {flag}}
    async with running(server) as port, peer_of(port) as client:
        data = parse_reply((await client.ask(b"latestlengthvalid,1,2\r\n")).rstrip())
    assert isinstance(data, ChannelData)
    assert [record.errors for record in data.records] == [(), (flag,)]


async def test_flags_blocked_beams_and_cold_lasers_reach_the_wire() -> None:
    server = standin(FixedPuck((0.0, 0.0, 0.0), moved_m=1.0))
    server.model.blocked = {2}
    server.model.flags = {3: {"usb_error"}}
    server.model.laser_ready = False
    server.connected = False
    async with running(server) as port, peer_of(port) as client:
        data = parse_reply((await client.ask(b"latestlengthvalid,1,2,3\r\n")).rstrip())
        assert isinstance(data, ChannelData)
        common = {"motion_tolerance_error", "laser_temp_error"}
        raised = [set(record.errors) for record in data.records]
        assert raised == [common, common | {"beam_break"}, common | {"usb_error"}]
        assert await client.ask(b"isconnected\r\n") == b"isconnected_0\r\n"
        assert await client.ask(b"laserready\r\n") == b"laserready_0\r\n"


async def test_a_slow_client_that_ends_its_side_still_gets_every_reply() -> None:
    # More replies than the socket buffers hold: the last ones are still with the server when the requests end.
    with socket.socket() as bound, socket.socket() as small:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        bound.bind(("127.0.0.1", 0))
        server = standin()
        await server.start(bound)
        small.connect(bound.getsockname())
        reader, writer = await asyncio.open_connection(sock=small)
        writer.write((b"latestlengthvalid," + b",".join(b"%d" % n for n in range(1, 33)) + b"\r\n") * 100)
        writer.write_eof()
        replies = 0
        async with asyncio.timeout(5.0):
            while line := await reader.readline():
                replies += line.endswith(b"_0\r\n")
        assert replies == 100
        writer.transport.abort()
        await server.close()


async def test_a_line_of_one_megabyte_closes_its_connection_and_no_other() -> None:
    server = standin()
    async with running(server) as port, peer_of(port) as client, peer_of(port) as flooder:
        flooder.writer.write(b"x" * 1_000_000)
        assert await flooder.is_closed()
        assert server.counts == {"oversized_lines": 1}
        assert await client.ask(b"isconnected\r\n") == b"isconnected_1\r\n"


async def test_a_connection_reset_in_the_middle_of_a_line_is_counted() -> None:
    server = standin()
    async with running(server) as port:
        with closing(socket.create_connection(("127.0.0.1", port))) as rude:
            rude.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\x00\x00\x00\x00\x00\x00\x00")
            rude.send(b"isconn")
            async with peer_of(port) as client:
                assert await client.ask(b"isconnected\r\n") == b"isconnected_1\r\n"
        async with peer_of(port) as client, asyncio.timeout(2.0):
            while not server.counts["lost_clients"]:
                assert await client.ask(b"isconnected\r\n") == b"isconnected_1\r\n"


async def test_a_client_that_never_reads_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(etalon_standin, "_SEND_TIMEOUT_S", 0.05)
    server = standin()
    async with running(server) as port, peer_of(port) as client, peer_of(port) as deaf:
        deaf.writer.transport.pause_reading()  # type: ignore[attr-defined]
        request = b"latestlengthvalid," + b",".join(b"%d" % n for n in range(1, 33)) + b"\r\n"
        async with asyncio.timeout(60.0):
            while not server.counts["lost_clients"]:
                if not deaf.writer.transport.is_closing():
                    deaf.writer.write(request * 50)
                assert await client.ask(b"isconnected\r\n") == b"isconnected_1\r\n"


async def test_more_clients_than_allowed_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(etalon_standin, "_MAX_CLIENTS", 2)
    server = standin()
    async with running(server) as port, peer_of(port) as first, peer_of(port) as second:
        assert await first.ask(b"isconnected\r\n") == await second.ask(b"isconnected\r\n")
        async with peer_of(port) as third:
            assert await third.is_closed()
        assert server.counts["refused_clients"] == 1
        assert await first.ask(b"isconnected\r\n") == b"isconnected_1\r\n"


async def test_the_stream_pushes_every_channel_until_it_is_stopped() -> None:
    server = standin(FixedPuck((0.0, 0.0, 0.0), step_s=0.2), NOISY)
    server.push_hz = 10_000.0
    async with running(server) as port, peer_of(port) as client, peer_of(port) as other:
        assert await client.ask(b"startmeasnogui\r\n") == b"measstarted\r\n"
        pushed = [await client.line() for _ in range(3)]
        assert len(set(pushed)) == 3  # time passes, so does the noise
        for line in pushed:
            data = parse_reply(line.rstrip())
            assert isinstance(data, ChannelData)
            assert [record.channel for record in data.records] == list(CHANNELS)
        # It is exclusive: this client may only stop it, another may ask but not start one.
        client.writer.write(b"isconnected\r\n")
        async with asyncio.timeout(2.0):
            while (line := await client.line()) != b"error_busy\r\n":
                assert line.startswith(b"channeldata_")
        assert await other.ask(b"startmeasnogui\r\n") == b"error_busy\r\n"
        assert await other.ask(b"isconnected\r\n") == b"isconnected_1\r\n"
        client.writer.write(b"stopmeasnogui\r\nlaserready\r\n")
        async with asyncio.timeout(2.0):
            while (line := await client.line()) != b"measstopped\r\n":
                assert line.startswith(b"channeldata_")
        assert await client.line() == b"laserready_1\r\n"
        for _ in range(50):  # and no record after measstopped
            assert await client.ask(b"laserready\r\n") == b"laserready_1\r\n"
        assert await other.ask(b"startmeasnogui\r\n") == b"measstarted\r\n"


class NoPuck:
    async def puck(self) -> PuckTruth:
        raise TruthUnavailable("gone")


async def test_without_the_puck_the_server_error_is_one() -> None:
    server = standin(NoPuck())
    async with running(server) as port, peer_of(port) as client:
        reply = await client.ask(b"latestlengthvalid,1,2\r\n")
        assert reply == b"channeldata_1,0.0," + DEAD + b"_2,0.0," + DEAD + b"_1\r\n"
        assert server.counts["truth_failures"] == 1


class BrokenPuck:
    async def puck(self) -> PuckTruth:
        raise ZeroDivisionError("surprise")


async def test_an_error_that_is_unexpected_ends_serve() -> None:
    server = standin(BrokenPuck())
    async with running(server) as port, peer_of(port) as client:
        client.writer.write(b"latestlengthvalid,1\r\n")
        with pytest.raises(ExceptionGroup) as caught:
            async with asyncio.timeout(2.0):
                await server.serve()
        assert caught.value.subgroup(ZeroDivisionError)


async def test_serve_lasts_until_closed_and_needs_a_start() -> None:
    server = standin()
    with pytest.raises(RuntimeError, match="not started"):
        await server.serve()
    await server.close()
    await server.start(any_port())
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.02):
            await server.serve()
    await server.close()
    await server.serve()


async def test_closing_with_clients_connected_is_quiet(caplog: pytest.LogCaptureFixture) -> None:
    server = standin()
    port = await server.start(any_port())
    async with peer_of(port) as client, peer_of(port) as streaming:
        assert await client.ask(b"isconnected\r\n") == b"isconnected_1\r\n"
        assert await streaming.ask(b"startmeasnogui\r\n") == b"measstarted\r\n"
        with caplog.at_level(logging.WARNING):
            await server.close()
            assert await client.is_closed()
            assert await streaming.is_closed()
    assert not caplog.records


class FakeTruth:
    """Answers requests for the puck out of a script; ``None`` is no answer."""

    def __init__(self) -> None:
        self.context = zmq.asyncio.Context()
        self.socket = self.context.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.endpoint = f"tcp://127.0.0.1:{self.socket.bind_to_random_port('tcp://127.0.0.1')}"
        self.asked: list[bytes] = []

    async def answer(self, *replies: bytes | None) -> None:
        for reply in replies:
            peer_id, _, request = await self.socket.recv_multipart()
            self.asked.append(request)
            if reply is not None:
                await self.socket.send_multipart([peer_id, b"", reply])

    def close(self) -> None:
        self.socket.close()
        self.context.term()


GOOD = b'{"t": 12.5, "puck": [0.1, 0.2, 0.3], "moved_m": 0.0}'


@asynccontextmanager
async def truth_link(timeout_s: float = 1.0) -> AsyncIterator[tuple[FakeTruth, ZmqPuck]]:
    fake = FakeTruth()
    puck = ZmqPuck(fake.endpoint, timeout_s=timeout_s)
    try:
        yield fake, puck
    finally:
        puck.close()
        fake.close()


async def test_the_puck_is_asked_from_the_robots_stand_in() -> None:
    async with truth_link() as (fake, puck), asyncio.TaskGroup() as group:
        group.create_task(fake.answer(GOOD, GOOD))
        assert await puck.puck() == PuckTruth(12.5, (0.1, 0.2, 0.3), 0.0)
        assert await puck.puck() == PuckTruth(12.5, (0.1, 0.2, 0.3), 0.0)
    assert fake.asked == [b"puck", b"puck"]


@pytest.mark.parametrize(
    "reply",
    [
        b"",
        b"junk",
        b"{}",
        b'{"error": "no truth"}',
        GOOD.replace(b"0.3]", b"0.3, 0.4]"),
        GOOD.replace(b"12.5", b'"12.5"'),
        GOOD.replace(b"12.5", b"NaN"),
        GOOD.replace(b"12.5", b"1e999"),
        GOOD.replace(b"[0.1, 0.2, 0.3]", b"null"),
    ],
)
async def test_a_bad_answer_about_the_puck_is_refused_and_the_next_taken(reply: bytes) -> None:
    async with truth_link() as (fake, puck), asyncio.TaskGroup() as group:
        group.create_task(fake.answer(reply, GOOD))
        with pytest.raises(TruthUnavailable, match=r"no puck from tcp://127\.0\.0\.1:\d+: "):
            await puck.puck()
        assert (await puck.puck()).t_s == 12.5


async def test_a_puck_that_does_not_answer_in_time_is_asked_anew() -> None:
    async with truth_link(timeout_s=0.05) as (fake, puck), asyncio.TaskGroup() as group:
        group.create_task(fake.answer(None, GOOD))
        with pytest.raises(TruthUnavailable, match=r"within 0\.05 s"):
            await puck.puck()
        assert (await puck.puck()).t_s == 12.5
