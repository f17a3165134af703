"""Connections to the server under test: raw ones, and a controller with a monitor that answer every frame."""

import select
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Literal, NamedTuple

from ccatp.commissioning.conformance.checks import (
    CheckedFrame,
    CheckFailed,
    Message,
    NotApplicable,
    parse_frame,
    read_message,
    require,
    shorten,
)
from ccatp.links.robot_codec import encode, format_drive, format_permit, join_mac
from ccatp.links.robot_messages import Fans, Join, LineBuffer, Role

# Far over the 8192 allowed: a line of the server that is too long fails a check, not the buffer.
_LIMIT_BYTES = 1 << 20
_CHUNK_BYTES = 1 << 16
Ending = Literal["FIN", "RST"]
_RESET = b"\x01\0\0\0\0\0\0\0"  # linger on, for 0 s: close sends RST


class RawConnection:
    """One connection; ``lines`` were received and not yet taken, without their LF.

    ``timeout_s`` is the longest wait for the connection, and for the server to take what is sent.

    Raises:
        OSError: no connection.
    """

    def __init__(self, address: tuple[str, int], timeout_s: float) -> None:
        self._socket = socket.create_connection(address, timeout_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffer = LineBuffer(_LIMIT_BYTES)
        self.lines: deque[bytes] = deque()
        self.is_ended = False

    @property
    def is_open(self) -> bool:
        """Whether this side has not closed."""
        return self._socket.fileno() >= 0

    def send(self, data: bytes) -> None:
        """Send; what the server no longer takes is lost, and the link ended."""
        try:
            self._socket.sendall(data)
        except OSError:
            self.is_ended = True

    def receive(self) -> None:
        """Take what is there; to be called when there is something."""
        try:
            data = self._socket.recv(_CHUNK_BYTES)
        except OSError:
            data = b""
        if not data:
            self.is_ended = True
            return
        self.lines.extend(self._buffer.feed(data))

    def end(self, ending: Ending) -> None:
        """End with FIN and go on reading (closing would send RST while something is unread), or close with RST."""
        with suppress(OSError):
            if ending == "FIN":
                self._socket.shutdown(socket.SHUT_WR)
                return
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        if ending == "RST":
            self._socket.close()

    def close(self) -> None:
        """Close."""
        self._socket.close()

    def fileno(self) -> int:
        """For ``select``."""
        return self._socket.fileno()


def receive_any(links: Iterable[RawConnection], wait_s: float) -> None:
    """Receive on all links that have something, waiting for the first at most so long."""
    reading = [link for link in links if link.is_open and not link.is_ended]
    if not reading:
        select.select([], [], [], wait_s)
        return
    for link in select.select(reading, [], [], wait_s)[0]:
        link.receive()


POLL_S = 0.05
# Numbers between two of these are free for messages that must be older or newer than others.
SEQ_STEP = 10


class Facts(NamedTuple):
    """What the checks need of the server's hello."""

    is_lockstep: bool
    frame_hz: float
    ttl_s: float
    needs_mac: bool
    wheel_radius_m: float
    wheel_base_m: float
    max_wheel_rad_s: float
    fan_floor: float

    @property
    def frame_s(self) -> float:
        """Period of the frames."""
        return 1.0 / self.frame_hz


class CheckContext:
    """Connections of one check; ``clear`` before the next. ``first_seq`` is above every number used so far."""

    def __init__(
        self, address: tuple[str, int], facts: Facts, key: bytes | None, timeout_s: float, first_seq: int
    ) -> None:
        self._address, self.facts, self.key, self.timeout_s = address, facts, key, timeout_s
        self._seq = first_seq
        self._links: list[RawConnection] = []

    def next_seq(self) -> int:
        """A number above all that were used."""
        self._seq += SEQ_STEP
        return self._seq

    def poll(self, wait_s: float = POLL_S) -> None:
        """Receive on all connections, waiting at most so long."""
        receive_any(self._links, wait_s)

    def until(self, is_done: Callable[[], bool], wait_s: float | None = None) -> bool:
        """Receive until something is done; false when it is not within ``wait_s`` (the time-out by default)."""
        deadline_s = time.monotonic() + (self.timeout_s if wait_s is None else wait_s)
        while not is_done():
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                return False
            self.poll(min(left_s, POLL_S))
        return True

    def message(self, link: RawConnection, *kinds: str) -> Message:
        """The next message on a connection; ``CheckFailed`` where it is not of one of these types."""
        wanted = " or ".join(kinds)
        self.until(lambda: bool(link.lines) or link.is_ended)
        require(bool(link.lines), f"{'connection closed' if link.is_ended else 'silence'} instead of {wanted}")
        line = link.lines.popleft()
        message = read_message(line)
        if message is None or message.get("type") not in kinds:
            raise CheckFailed(f"{shorten(line)} instead of {wanted}")
        return message

    def greet(self) -> tuple[RawConnection, Message]:
        """A new connection and its hello; ``CheckFailed`` where it is not accepted or there is no hello."""
        try:
            link = RawConnection(self._address, self.timeout_s)
        except OSError as error:
            raise CheckFailed(f"connection not accepted: {error.strerror or error}") from error
        self._links.append(link)
        return link, self.message(link, "hello")

    def join_line(self, hello: Message, role: Role, mac: str | None = None) -> bytes:
        """The right answer to a hello, or one with another mac; ``NotApplicable`` without the key it needs."""
        if mac is None and self.facts.needs_mac:
            if self.key is None:
                raise NotApplicable("the server asks for a mac, and there is no key")
            mac = join_mac(self.key, str(hello.get("nonce")), role)
        return encode(Join(role=role, client="conformance", mac=mac or ""))

    def answer(self, link: RawConnection) -> Message:
        """The server's answer to a join."""
        return self.message(link, "joined", "refused")

    def join(self, role: Role, retry_s: float | None = None) -> RawConnection:
        """A session; ``CheckFailed`` if refused.

        The session before may not have ended yet, so a role that is taken is requested again for ``retry_s`` (the
        time-out by default).
        """
        deadline_s = time.monotonic() + (self.timeout_s if retry_s is None else retry_s)
        while True:
            link, hello = self.greet()
            link.send(self.join_line(hello, role))
            answer = self.answer(link)
            if answer["type"] == "joined":
                return link
            link.close()
            is_over = time.monotonic() > deadline_s
            require(answer.get("reason") == "role taken" and not is_over, f"{role} refused: {answer.get('reason')}")
            self.until(lambda: False, POLL_S)

    def is_closed(self, link: RawConnection, wait_s: float | None = None) -> bool:
        """Whether the server closes the connection in time."""
        return self.until(lambda: link.is_ended, wait_s)

    def clear(self) -> None:
        """Close all connections."""
        for link in self._links:
            with suppress(OSError):
                link.close()
        self._links.clear()


Rates = tuple[float, float]
Allowed = tuple[bool, bool, bool]
STILL: Rates = (0.0, 0.0)
ALL: Allowed = (True, True, True)
NOTHING: Allowed = (False, False, False)
COMMAND_LIMIT_S = 2.0  # robot's time in which a command must have come into force


class ControllerAndMonitor:
    """Two sessions that answer every frame.

    Attributes:
        rates: (right, left) set points of the drive that answers each frame, rad/s; ``None`` sends none.
        allowed: (forward, reverse, turn) of the permit that answers each frame; ``None`` sends none.
        messages: sensors messages as they came, of the controller and of the monitor.
    """

    def __init__(self, context: CheckContext) -> None:
        self.context, self.facts = context, context.facts
        self._join()
        self.rates: Rates | None = STILL
        self.allowed: Allowed | None = ALL
        self.frames: list[CheckedFrame] = []
        self.messages: tuple[list[Message], list[Message]] = ([], [])
        self.raw: list[bytes] = []

    def _join(self) -> None:
        # The monitor first: from its join on the robot needs both keys, so it never waits for one alone.
        self.monitor: RawConnection = self.context.join("monitor")
        self.controller: RawConnection = self.context.join("controller")
        self._driven = self._permitted = -1

    def rejoin(self) -> None:
        """End both sessions, and begin new ones."""
        self._take()
        self.controller.close()
        self.monitor.close()
        self._join()

    @property
    def newest(self) -> CheckedFrame:
        """The newest frame."""
        return self.frames[-1]

    # -- commands -------------------------------------------------------------------------------------------------

    def drive(self, seq: int | None = None, rates: Rates = STILL, ack: int | None = None, before: bytes = b"") -> int:
        """Send a drive that answers the newest frame (or another), with other bytes in front; returns its number."""
        seq = self.context.next_seq() if seq is None else seq
        self.controller.send(before + format_drive(seq, self.newest.seq if ack is None else ack, *rates))
        if ack is None:
            self.mark_driven()
        return seq

    def permit(self, seq: int | None = None, allowed: Allowed = ALL, ack: int | None = None) -> int:
        """Send a permit now that answers the newest frame (or another); returns its number."""
        seq = self.context.next_seq() if seq is None else seq
        self.monitor.send(format_permit(seq, self.newest.seq if ack is None else ack, *allowed))
        if ack is None:
            self._permitted = self.newest.seq
        return seq

    def fans(self, duty: tuple[float, float], seq: int | None = None) -> int:
        """Send fan duties now; returns their number."""
        seq = self.context.next_seq() if seq is None else seq
        self.controller.send(encode(Fans(seq=seq, duty=duty)))
        return seq

    # -- frames ---------------------------------------------------------------------------------------------------

    def find(self, is_wanted: Callable[[CheckedFrame], bool], robot_s: float = COMMAND_LIMIT_S) -> CheckedFrame | None:
        """Answer frames until one is wanted; ``None`` after so much of the robot's time, or silence.

        The wanted frame itself is not answered yet.
        """
        start = len(self.frames)
        begin_s: float | None = None  # of the first frame that comes: before it may have been a long pause
        quiet_s = time.monotonic()
        while True:
            self._answer()
            self.context.poll()
            if self._take():
                quiet_s = time.monotonic()
            for k in range(start, len(self.frames)):
                begin_s = self.frames[k].t_s if begin_s is None else begin_s
                if is_wanted(self.frames[k]):
                    return self.frames[k]
                if self.frames[k].t_s - begin_s > robot_s:
                    return None
            start = len(self.frames)
            if time.monotonic() - quiet_s > self.context.timeout_s:
                return None

    def expect(self, is_wanted: Callable[[CheckedFrame], bool], otherwise: str) -> CheckedFrame:
        """Answer frames until one is wanted; ``CheckFailed`` with ``otherwise`` if none comes."""
        frame = self.find(is_wanted)
        if frame is None:
            self._check_sessions()
            raise CheckFailed(otherwise)
        return frame

    def run(self, robot_s: float) -> list[CheckedFrame]:
        """Answer frames for so much of the robot's time; these frames."""
        start = len(self.frames)
        if not self.frames:
            self.expect(lambda _: True, "no frames after the join")
        self._take()
        end_s = self.newest.t_s + robot_s
        if self.find(lambda frame: frame.t_s >= end_s, 2.0 * robot_s) is None:
            self._check_sessions()
            raise CheckFailed(f"no more frames after frame {self.newest.seq}")
        return self.frames[start:]

    def pause(self, wall_s: float) -> list[CheckedFrame]:
        """Answer nothing for so much time of this machine; the frames that come all the same."""
        start = len(self.frames)
        end_s = time.monotonic() + wall_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            self.context.poll(min(left_s, POLL_S))
            self._take()
        return self.frames[start:]

    def echoed(self, *seqs: int, otherwise: str) -> CheckedFrame:
        """Send nothing newer, until the robot echoes one of these drives.

        In lockstep newer drives have to follow; there each is in force for a frame.
        """
        self.rates = STILL if self.facts.is_lockstep else None
        return self.expect(lambda frame: frame.drive_seq in seqs, otherwise)

    def steady(self) -> CheckedFrame:
        """Drive and permit in force: standing still by command, not held."""
        self.rates, self.allowed = STILL, ALL
        first = self.context.next_seq()
        return self.expect(
            lambda frame: not frame.is_held and frame.drive_seq > first,
            "held in spite of a new drive and a new permit for each frame",
        )

    def settle(self) -> list[CheckedFrame]:
        """Answer frames until all that was sent before is in force; these frames."""
        start = len(self.frames)
        mark = self.context.next_seq()
        self.expect(lambda frame: frame.drive_seq > mark, "drives no longer come into force")
        return self.frames[start:]

    def mark_driven(self) -> None:
        """The newest frame has been answered by a drive that was sent some other way."""
        self._driven = self.newest.seq

    def answer_again(self) -> None:
        """Regard the newest frame as unanswered: what was sent may have been dropped."""
        self._driven = self._permitted = -1

    def _check_sessions(self) -> None:
        for name, link in (("controller", self.controller), ("monitor", self.monitor)):
            require(not (link.is_open and link.is_ended), f"the {name}'s session was closed")

    def _answer(self) -> None:
        if not self.frames:
            return
        newest = self.newest.seq
        if self.rates is not None and self._driven < newest:
            self._driven = newest
            self.drive(rates=self.rates)
        if self.allowed is not None and self._permitted < newest:
            self._permitted = newest
            self.permit(allowed=self.allowed)

    def _take(self) -> bool:
        """Read what came; whether any of it is a new frame."""
        before = len(self.frames)
        for link, messages in zip((self.controller, self.monitor), self.messages, strict=True):
            while link.lines:
                line = link.lines.popleft()
                self.raw.append(line)
                message = read_message(line)
                if message is None or message.get("type") != "sensors":
                    continue
                messages.append(message)
                frame = parse_frame(message)
                if not self.frames or frame.seq > self.newest.seq:
                    self.frames.append(frame)
        return len(self.frames) > before


def steady_pair(context: CheckContext) -> ControllerAndMonitor:
    """Both sessions joined, with drive and permit in force."""
    pair = ControllerAndMonitor(context)
    pair.steady()
    return pair
