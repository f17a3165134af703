"""The client's end of the robot link against a scripted robot."""

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import uvloop
from msgspec.structs import replace

from ccatp.config.files import read_key
from ccatp.errors import ConfigError, ExitStatus
from ccatp.links.robot_codec import RobotFrame, encode, join_mac
from ccatp.links.robot_link import (
    LONGEST_REASON,
    LineWriter,
    LinkHandler,
    RobotLink,
    RobotLinkError,
    RobotRefused,
    RobotTimeout,
    WrongProtocol,
)
from ccatp.links.robot_messages import CommandEcho, Sensors
from tests.support.daemon import HELLO as OF_ROBOT
from tests.support.daemon import Waiting, link_to
from tests.support.sockets import Script, scripted

HELLO = encode(replace(OF_ROBOT, lockstep=True))
HELLO_HMAC = HELLO.replace(b'"none"', b'"hmac-sha256"')
JOINED = b'{"type":"joined","role":"controller","session":1}\n'
DEADLINE_S = 2.0  # what never happens in a good run may take this long in a bad one


def frame(seq: int) -> bytes:
    return encode(RobotFrame(seq, seq / 100.0, (), (), (), None, (0.0, 0.0), 1.0, CommandEcho(-1, 0.0, 0.0, True), ()))


class Seen(Waiting):
    """What a link told."""

    def __init__(self) -> None:
        self.frames: list[int] = []
        self.lines: list[bytes] = []
        self.lost: list[str] = []
        self.bad_lines = self.repeated = 0
        self.changed = asyncio.Event()

    def on_sensors(self, sensors: Sensors, line: bytes) -> None:
        self.frames.append(sensors.seq)
        self.lines.append(line)
        self.changed.set()

    def on_bad_line(self) -> None:
        self.bad_lines += 1

    def on_repeated(self) -> None:
        self.repeated += 1

    def on_lost(self, reason: str) -> None:
        self.lost.append(reason)
        self.changed.set()


@asynccontextmanager
async def robot(script: Script, *, key: bytes | None = None) -> AsyncIterator[tuple[RobotLink, Seen]]:
    """A robot that runs ``script`` for the client it gets, and a link to it."""
    seen = Seen()
    hears = {name: getattr(seen, name) for name in ("on_sensors", "on_lost", "on_bad_line", "on_repeated")}
    async with scripted(script) as port:
        link = link_to(port, key=key, **hears)
        yield link, seen
        link.close()


def after_join(*pieces: bytes, then: Script | None = None, hello: bytes = HELLO, joined: bytes = JOINED) -> Script:
    async def script(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(hello)
        await reader.readline()
        writer.write(joined)
        for piece in pieces:
            writer.write(piece)
            await writer.drain()
        if then is not None:
            await then(reader, writer)
        else:
            await reader.read()

    return script


async def test_join_frames_and_commands() -> None:
    received: asyncio.Queue[bytes] = asyncio.Queue()

    async def listen(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            received.put_nowait(line)

    async with robot(after_join(frame(0), frame(1), then=listen)) as (link, seen):
        hello = await link.connect(DEADLINE_S)
        assert (hello.boot, hello.lockstep, hello.robot.wheel_radius_m) == (1, True, 0.03)
        await seen.until(lambda: seen.frames == [0, 1])
        assert seen.lines == [frame(0)[:-1], frame(1)[:-1]]
        link.send_drive(4, 1, 3.5, -0.25)
        link.send_permit(5, 1, True, False, True)
        link.send_fans(6, (0.8, 0.75))
        link.send_raw(b"as it is\n")
        async with asyncio.timeout(DEADLINE_S):
            assert [await received.get() for _ in range(4)] == [
                b'{"type":"drive","seq":4,"ack":1,"wr":3.5,"wl":-0.25}\n',
                b'{"type":"permit","seq":5,"ack":1,"forward":true,"reverse":false,"turn":true}\n',
                b'{"type":"fans","seq":6,"duty":[0.8,0.75]}\n',
                b"as it is\n",
            ]
    assert seen.lost == []  # closed by us
    link.send_drive(9, 1, 0.0, 0.0)  # after the end nothing happens


async def test_repeated_and_older_frames_are_dropped_and_counted() -> None:
    pieces = [frame(k) for k in (0, 1, 1, 0, 3, 2, 4)]
    async with robot(after_join(*pieces)) as (link, seen):
        await link.connect(DEADLINE_S)
        await seen.until(lambda: seen.frames == [0, 1, 3, 4])
    assert link.counts["repeated_frames"] == 3
    assert seen.repeated == 1  # only the newest one is to be answered again


async def test_bad_lines_and_unknown_types_are_counted_and_dropped() -> None:
    bad = b'garbage\n{"type":"sensors","seq":1}\n{"type":"weather","t":1}\n'
    async with robot(after_join(bad + frame(7), JOINED, frame(8))) as (link, seen):
        await link.connect(DEADLINE_S)
        await seen.until(lambda: seen.frames == [7, 8])
    assert (link.counts["bad_lines"], link.counts["unknown_types"], link.counts["unexpected"]) == (2, 1, 1)
    assert seen.bad_lines == 2
    assert link.first_bad_line == "JSONDecodeError: Expecting value: line 1 column 1 (char 0)"


async def test_the_first_bad_line_of_a_session_is_kept_after_many_others() -> None:
    first = frame(1).replace(b'"imu":[]', b'"imu":[[0.01,NaN,0.0]]')
    async with robot(after_join(first, *[b"garbage\n"] * 30)) as (link, seen):
        await link.connect(DEADLINE_S)
        await seen.until(lambda: seen.lost != [])
    assert link.counts["bad_lines"] > 20
    assert link.first_bad_line == "imu[0][1] is NaN"


@pytest.mark.parametrize("name", [b"k" * 4000, b"\\u0007\\n\\u202e", "Ł".encode() * 500])
async def test_the_reason_of_a_bad_line_is_one_printable_line_of_bounded_length(name: bytes) -> None:
    bad = b'{"type":"sensors","' + name + b'":NaN}\n'
    async with robot(after_join(bad + frame(7))) as (link, seen):
        await link.connect(DEADLINE_S)
        await seen.until(lambda: seen.frames == [7])
    assert link.first_bad_line
    assert link.first_bad_line.isprintable()
    assert len(link.first_bad_line) <= LONGEST_REASON


@pytest.mark.fault("S15")
@pytest.mark.parametrize(
    ("flood", "reason"),
    [
        (frame(1).replace(b'"imu":[]', b'"imu":[[0.01,NaN,0.0]]') * 21, "the first: bad line: imu[0][1] is NaN"),
        (b"garbage\n" * 21, "too many bad lines from the robot, the first: bad line: JSONDecodeError"),
        (b"x" * 8193, "line over the limit"),
    ],
)
async def test_a_robot_that_talks_nonsense_is_left(flood: bytes, reason: str) -> None:
    async with robot(after_join(frame(0) + flood + frame(1))) as (link, seen):
        await link.connect(DEADLINE_S)
        await seen.until(lambda: bool(seen.lost))
        assert len(seen.lost) == 1
        assert reason in seen.lost[0]
        assert seen.frames == [0]


async def test_a_lost_connection_is_reported_once() -> None:
    async def hang_up(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.close()

    async with robot(after_join(frame(0), then=hang_up)) as (link, seen):
        await link.connect(DEADLINE_S)
        await seen.until(lambda: bool(seen.lost))
        assert seen.lost == ["the robot closed the connection"]


async def test_an_error_in_the_callback_ends_the_session_aloud() -> None:
    async with robot(after_join(frame(0))) as (link, seen):
        asyncio.get_running_loop().set_exception_handler(lambda *_: None)

        def fail(sensors: Sensors, line: bytes) -> None:
            raise RuntimeError("surprise")

        link._handler = LinkHandler(on_sensors=fail, on_lost=seen.on_lost)
        await link.connect(DEADLINE_S)
        await seen.until(lambda: bool(seen.lost))
        assert "surprise" in seen.lost[0]


# -- joining that fails -----------------------------------------------------------------------------------------------


async def test_nobody_listens(free_port: int) -> None:
    seen = Seen()
    link = link_to(free_port, "monitor", on_lost=seen.on_lost)
    with pytest.raises(
        RobotLinkError, match=f"cannot reach the robot at 127.0.0.1:{free_port}.*is it running"
    ) as caught:
        await link.connect(DEADLINE_S)
    assert caught.value.exit_status == ExitStatus.UNREACHABLE
    assert seen.lost == []


def saying(text: bytes, *, hangs_up: bool = False) -> Script:
    async def script(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(text)
        await writer.drain()
        if not hangs_up:
            await reader.read()

    return script


def refusing(reason: str) -> Script:
    return after_join(joined=b'{"type":"refused","reason":"%b"}\n' % reason.encode())


HTTP = b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n"
NO_ANSWER = "no answer from the robot at .* within 0.3 s"
JOINING_THAT_FAILS: dict[str, tuple[Script, type[RobotLinkError], str]] = {
    "role taken": (refusing("role taken"), RobotRefused, "refused the role controller: role taken; another program"),
    "bad mac": (refusing("bad mac"), RobotRefused, "refused the role controller: bad mac; check robot.key_file"),
    "bad join": (refusing("bad join"), RobotRefused, "refused the role controller: bad join$"),
    "another reason": (refusing("full moon"), RobotRefused, "refused the role controller: full moon$"),
    "busy": (
        saying(HELLO + b'{"type":"refused","reason":"busy"}\n', hangs_up=True),
        RobotRefused,
        "busy; too many connections",
    ),
    "another version": (
        after_join(hello=HELLO.replace(b"robot/1", b"robot/2")),
        WrongProtocol,
        "speaks ccatp-robot/2, this program ccatp-robot/1",
    ),
    "no robot": (saying(HTTP, hangs_up=True), WrongProtocol, "no robot answers"),
    "hung up": (saying(b"", hangs_up=True), RobotLinkError, "did not let us join: the robot closed the connection"),
    "bad hello": (
        saying(b'{"type":"hello","protocol":"ccatp-robot/1"}\n'),
        RobotTimeout,
        f"{NO_ANSWER}; .*what came: bad line: .*boot",
    ),
    "another role": (
        saying(HELLO + JOINED.replace(b"controller", b"monitor")),
        RobotTimeout,
        f"{NO_ANSWER}; .*joined as monitor, not as controller",
    ),
    "silence": (saying(b""), RobotTimeout, NO_ANSWER),
    "no key": (after_join(hello=HELLO_HMAC), RobotLinkError, "asks for a key: name its file"),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.fault("L6")] if name == "silence" else []) for name in JOINING_THAT_FAILS],
)
async def test_joining_that_fails(name: str) -> None:
    script, error, match = JOINING_THAT_FAILS[name]
    async with robot(script) as (link, seen):
        with pytest.raises(error, match=match) as caught:
            await link.connect(0.3 if error is RobotTimeout else DEADLINE_S)
        assert type(caught.value) is error
        assert seen.lost == []
    if isinstance(caught.value, RobotRefused):
        assert caught.value.reason in match


async def test_frames_before_the_join_is_over_are_not_served() -> None:
    async with robot(after_join(frame(5), hello=HELLO + frame(4))) as (link, seen):
        await link.connect(DEADLINE_S)
        await seen.until(lambda: seen.frames == [5])
    assert link.counts["unexpected"] == 1


# -- the key ----------------------------------------------------------------------------------------------------------


async def test_the_key_is_used_where_the_robot_asks_for_it() -> None:
    joins: list[bytes] = []

    async def script(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(HELLO_HMAC)
        joins.append(await reader.readline())
        writer.write(JOINED)
        await reader.read()

    async with robot(script, key=b"secret") as (link, _):
        await link.connect(DEADLINE_S)
    mac = join_mac(b"secret", OF_ROBOT.nonce, "controller")
    assert joins == [b'{"type":"join","role":"controller","client":"test","mac":"%b"}\n' % mac.encode()]


def test_read_key(tmp_path: Path) -> None:
    assert read_key("") is None
    for name in ("key", "empty"):
        (tmp_path / name).touch(mode=0o600)
    (tmp_path / "key").write_bytes(b" secret\n")
    assert read_key(str(tmp_path / "key")) == b"secret"
    (tmp_path / "empty").write_bytes(b"\n")
    with pytest.raises(ConfigError, match=r"robot\.key_file: .*empty is empty"):
        read_key(str(tmp_path / "empty"))
    with pytest.raises(ConfigError, match=r"robot\.key_file: cannot read .*No such file"):
        read_key(str(tmp_path / "none"))
    (tmp_path / "key").chmod(0o604)
    assert read_key(str(tmp_path / "key")) == b"secret"
    with pytest.raises(ConfigError, match=r"key is open to others \(mode 0604\); chmod go= .*key$"):
        read_key(str(tmp_path / "key"), must_be_private=True)


# -- a robot that does not read ---------------------------------------------------------------------------------------


@pytest.mark.fault("L3")
async def test_commands_do_not_pile_up() -> None:
    resume = asyncio.Event()
    lines: list[bytes] = []

    async def stall(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        transport = writer.transport
        assert isinstance(transport, asyncio.ReadTransport)
        transport.pause_reading()
        await resume.wait()
        transport.resume_reading()
        lines.extend((await reader.read()).splitlines())

    async with robot(after_join(then=stall)) as (link, _):
        await link.connect(DEADLINE_S)
        assert link._transport is not None
        link._transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)  # soon full
        await asyncio.sleep(0)  # let the robot stop reading
        async with asyncio.timeout(60.0):
            seq = 0
            while link.counts["unsent"] < 1000:
                link.send_drive(seq, 0, 1.0, 1.0)
                link.send_permit(seq, 0, True, True, True)
                seq += 1
                if seq % 1000 == 0:
                    await asyncio.sleep(0)
        assert link._transport.get_write_buffer_size() < 3 * 4096
        resume.set()


def test_a_line_is_sent_before_the_event_loop_continues() -> None:
    async def send() -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            transport, _ = await asyncio.get_running_loop().create_connection(asyncio.Protocol, sock=ours)
            writer = LineWriter(transport)
            writer.write(b"a line\n")
            assert theirs.recv(100, socket.MSG_DONTWAIT) == b"a line\n"
            transport.abort()
            writer.write(b"after the end\n")
            await asyncio.sleep(0.01)
            assert theirs.recv(100, socket.MSG_DONTWAIT) == b""

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(send())
