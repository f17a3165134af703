"""The client's end of the robot link: joins the robot, hands over its frames, sends commands. Decides nothing."""

import asyncio
import os
import socket
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

from ccatp.config.robot_limits import hello_problems
from ccatp.errors import DaemonUnreachableError, one_line
from ccatp.links.robot_codec import (
    BadLine,
    BadLineCounter,
    BadLineLimit,
    LineBuffer,
    decode_from_robot,
    encode,
    format_drive,
    format_permit,
    join_mac,
)
from ccatp.links.robot_messages import (
    AUTH_HMAC,
    PROTOCOL,
    FromRobot,
    Hello,
    Join,
    Joined,
    Refused,
    Role,
    Sensors,
    Unknown,
)
from ccatp.links.robot_messages import Fans as FansMessage

# Commands may wait in the kernel only: if they waited here, they would be too old on arrival.
MAX_UNSENT_BYTES = 4096
# A robot in real time that sends more lines than this floods the link. After a stall all waiting frames may arrive at
# once, those of half a minute, the longest stall; otherwise three times the frame rate is allowed.
BACKLOG_S = 30.0
FLOOD_FACTOR = 3.0
# A dead peer is detected within seconds: by unacknowledged data for 1000 ms, or by silence for 1 s and 3 probes of 1 s.
LINUX_OPTIONS = {"TCP_USER_TIMEOUT": 1000, "TCP_KEEPIDLE": 1, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}
LONGEST_REASON = 160  # characters of what is wrong with a bad line; it may contain names that the robot sent


class RobotLinkError(DaemonUnreachableError):
    """The robot cannot be joined."""


class RobotRefused(RobotLinkError):
    """The robot refused the join; ``reason`` is its own."""

    def __init__(self, where: str, role: str, reason: str) -> None:
        super().__init__(f"the robot at {where} refused the role {role}: {reason}{_HINTS.get(reason, '')}")
        self.reason = reason


class ImpossibleRobot(RobotLinkError):
    """The robot has values beyond the limits of the link, ``ccatp.config.robot_limits``: no mission works with it."""


class WrongProtocol(RobotLinkError):
    """Whatever answers does not speak this protocol."""


class RobotTimeout(RobotLinkError):
    """The robot did not answer in time."""


_HINTS = {
    "role taken": "; another program drives it",
    "bad mac": "; check robot.key_file",
    "busy": "; too many connections",
}


class LineWriter:
    """Sends lines on a TCP connection at once, not when the event loop goes on; ends with the transport.

    Only what the kernel does not take waits in the transport. Lines after the end of the connection are dropped.
    """

    def __init__(self, transport: asyncio.Transport) -> None:
        self._transport = transport
        self._fd: int = transport.get_extra_info("socket").fileno()

    def write(self, data: bytes) -> None:
        """Send one or more lines."""
        transport, written = self._transport, 0
        if transport.is_closing():
            return
        if not transport.get_write_buffer_size():
            try:
                written = os.write(self._fd, data)
            except OSError:  # nothing is taken now; an error of the connection shows again in the transport
                written = 0
        if written < len(data):
            transport.write(data[written:])


@dataclass(frozen=True, slots=True)
class LinkHandler:
    """What is called on the events of a session, within the event loop's read.

    Attributes:
        on_sensors: with each frame and its line (without LF).
        on_lost: once, with the reason, when a joined session ends, unless ``close`` ended it.
        on_joined: with the robot's hello when the session begins, before its first frame.
        on_first: with the first frame, before ``on_sensors``.
        on_bad_line: after each line of a joined session that fails a check.
        on_repeated: when the newest frame comes unchanged again.
    """

    on_sensors: Callable[[Sensors, bytes], None]
    on_lost: Callable[[str], None]
    on_joined: Callable[[Hello], None] = lambda _hello: None
    on_first: Callable[[Sensors], None] = lambda _sensors: None
    on_bad_line: Callable[[], None] = lambda: None
    on_repeated: Callable[[], None] = lambda: None


class RobotLink(asyncio.Protocol):
    """One session with the robot.

    Frames that are not newer than the last one are dropped and counted, and so are bad lines; neither reaches the
    handler. While the robot does not take what was sent, drives and permits are dropped and counted: a burst of old
    commands must never follow a stall.

    Attributes:
        counts: bad_lines, unknown_types, unexpected, repeated_frames, unsent.
        newest: the newest frame of the session.
        first_bad_line: what is wrong with the first bad line of the session, with its field; empty without one.
        session: the robot's number of the session, once it is joined.
    """

    def __init__(
        self,
        *,
        host: str,
        port: int,
        role: Role,
        client: str,
        key: bytes | None,
        handler: LinkHandler,
    ) -> None:
        self._host = host
        self._port = port
        self._role = role
        self._client = client
        self._key = key
        self._handler = handler
        self.counts: Counter[str] = Counter()
        self._transport: asyncio.Transport | None = None
        self._writer: LineWriter | None = None
        self._hello: Hello | None = None
        self._joining: asyncio.Future[Hello] | None = None
        self._is_joined = False
        self._is_closing = False
        self._is_paused = False
        self._lines = LineBuffer()
        self._bad = BadLineCounter()
        self._budget: BadLineLimit | None = None
        self._last_seq = self.session = -1
        self.newest: Sensors | None = None
        self._why = ""
        self._oddity = ""
        self.first_bad_line = ""

    @property
    def has_frames(self) -> bool:
        """A valid frame came in this session."""
        return self._last_seq >= 0

    @property
    def _where(self) -> str:
        return f"{self._host}:{self._port}"

    async def connect(self, deadline_s: float) -> Hello:
        """Connect and join. A link is used once: for another session make another.

        ``RobotTimeout``: it took longer; ``RobotRefused``: the robot refused; ``WrongProtocol``: another protocol, or
        the peer is not a robot; ``RobotLinkError``: no answer, or the connection ended.
        """
        loop = asyncio.get_running_loop()
        joining: asyncio.Future[Hello] = loop.create_future()
        self._joining = joining
        try:
            async with asyncio.timeout(deadline_s):
                await loop.create_connection(lambda: self, self._host, self._port)
                return await joining
        except TimeoutError:
            came = f"; what came: {self._oddity}" if self._oddity else ""
            raise RobotTimeout(f"no answer from the robot at {self._where} within {deadline_s:g} s{came}") from None
        except OSError as error:
            reason = error.strerror or str(error)
            raise RobotLinkError(f"cannot reach the robot at {self._where}: {reason}; is it running?") from error
        finally:
            if not self._is_joined:
                joining.cancel()
                self.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)  # a TCP connection has no other
        self._transport.set_write_buffer_limits(high=MAX_UNSENT_BYTES)
        self._writer = LineWriter(self._transport)
        peer = self._transport.get_extra_info("socket")
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in LINUX_OPTIONS.items():
            if hasattr(socket, name):
                peer.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def data_received(self, data: bytes) -> None:
        lines = self._lines.feed(data)
        if self._budget is not None and not self._budget.take(len(lines), asyncio.get_running_loop().time()):
            self.abort("a flood of lines from the robot")
        for line in lines:
            if self._is_closing or self._why:
                return
            try:
                message = decode_from_robot(line)
            except BadLine as error:
                self._oddity = str(error)
                self._count_bad(self._oddity)
                continue
            if type(message) is Sensors and self._is_joined and message.seq > self._last_seq:
                if self._last_seq < 0:
                    self._handler.on_first(message)
                self._last_seq, self.newest = message.seq, message
                self._handler.on_sensors(message, line)
            else:
                self._take(message)
        if self._lines.error is not None:
            self.abort("the robot sent a line over the limit")

    def connection_lost(self, exc: Exception | None) -> None:
        why = self._why or (f"connection lost: {exc}" if exc else "the robot closed the connection")
        self._transport = self._writer = None
        if self._joining is not None and not self._joining.done():
            if self._hello is None and self._bad.total:
                self._joining.set_exception(WrongProtocol(f"no robot answers at {self._where}: {why}"))
            else:
                self._joining.set_exception(RobotLinkError(f"the robot at {self._where} did not let us join: {why}"))
        elif self._is_joined and not self._is_closing:
            self._is_joined = False
            self._handler.on_lost(why)

    def pause_writing(self) -> None:
        self._is_paused = True

    def resume_writing(self) -> None:
        self._is_paused = False

    def _take(self, message: FromRobot | Unknown) -> None:
        """Take whatever is not a new frame of a joined session."""
        joining = self._joining
        if isinstance(message, Unknown):
            self.counts["unknown_types"] += 1
        elif isinstance(message, Sensors):
            self.counts["repeated_frames" if self._is_joined else "unexpected"] += 1
            newest = self.newest if self._is_joined else None
            if newest is not None and (message.seq, message.t) == (newest.seq, newest.t):
                self._handler.on_repeated()
        elif joining is None or joining.done():
            self.counts["unexpected"] += 1
        elif isinstance(message, Refused):
            joining.set_exception(RobotRefused(self._where, self._role, message.reason))
        elif isinstance(message, Hello) and self._hello is None:
            self._answer(message, joining)
        elif isinstance(message, Joined) and self._hello is not None and message.role == self._role:
            self._is_joined, self.session = True, message.session
            if not self._hello.lockstep:  # in lockstep the client sets the frame rate
                rate_hz = self._hello.frame_hz
                self._budget = BadLineLimit(BACKLOG_S * rate_hz, FLOOD_FACTOR * rate_hz)
            joining.set_result(self._hello)
            self._handler.on_joined(self._hello)
        else:
            if isinstance(message, Joined) and message.role != self._role:
                self._oddity = f"joined as {message.role}, not as {self._role}"
            self.counts["unexpected"] += 1

    def _answer(self, hello: Hello, joining: "asyncio.Future[Hello]") -> None:
        needs_key, robot = hello.auth == AUTH_HMAC, hello.robot
        problems = hello_problems(
            frame_hz=hello.frame_hz,
            ttl_s=hello.ttl_s,
            wheel_radius_m=robot.wheel_radius_m,
            wheel_base_m=robot.wheel_base_m,
            max_wheel_rad_s=robot.max_wheel_rad_s,
            has_vehicle=robot.vehicle is not None,
        )
        if hello.protocol != PROTOCOL:
            error = f"the robot at {self._where} speaks {hello.protocol}, this program {PROTOCOL}"
            joining.set_exception(WrongProtocol(error))
        elif problems:
            error = f"the robot at {self._where} cannot be driven: {'; '.join(problems)}; correct its firmware"
            joining.set_exception(ImpossibleRobot(error))
        elif needs_key and self._key is None:
            error = f"the robot at {self._where} asks for a key: name its file in robot.key_file"
            joining.set_exception(RobotLinkError(error))
        else:
            mac = join_mac(self._key, hello.nonce, self._role) if needs_key and self._key is not None else ""
            self._hello = hello
            self.send_raw(encode(Join(role=self._role, client=self._client, mac=mac)))

    def _count_bad(self, reason: str) -> None:
        self.counts["bad_lines"] += 1
        self.first_bad_line = self.first_bad_line or one_line(reason.removeprefix("bad line: "), LONGEST_REASON)
        if self._bad.add(asyncio.get_running_loop().time(), reason):
            self.abort(f"too many bad lines from the robot, the first: {self._bad.first_reason}")
        elif self._is_joined:
            self._handler.on_bad_line()

    def abort(self, why: str) -> None:
        """Break the connection at once, whatever waits to be sent; ``on_lost`` is called with ``why``."""
        self._why = self._why or why
        if self._transport is not None:
            self._transport.abort()

    def send_drive(self, seq: int, ack: int, wr_rad_s: float, wl_rad_s: float, steer_rad: float | None = None) -> None:
        """Send wheel set points, and the steering angle of a robot that has one.

        ``ValueError``: a set point that is not finite.
        """
        line = format_drive(seq, ack, wr_rad_s, wl_rad_s, steer=steer_rad)
        if self._is_paused:
            self.counts["unsent"] += 1
        elif self._writer is not None:
            self._writer.write(line)

    def send_permit(self, seq: int, ack: int, forward: bool, reverse: bool, turn: bool) -> None:
        """Send what motion is allowed."""
        if self._is_paused:
            self.counts["unsent"] += 1
        else:
            self.send_raw(format_permit(seq, ack, forward, reverse, turn=turn))

    def send_fans(self, seq: int, duty: tuple[float, float]) -> None:
        """Send fan duties (left, right), 0 to 1."""
        self.send_raw(encode(FansMessage(seq=seq, duty=duty)))

    def send_raw(self, data: bytes) -> None:
        """Send bytes as they are; nothing happens when the connection is gone."""
        if self._writer is not None:
            self._writer.write(data)

    def close(self) -> None:
        """End the session after what was sent; ``on_lost`` is not called."""
        self._is_closing = True
        if self._transport is not None:
            self._transport.close()
