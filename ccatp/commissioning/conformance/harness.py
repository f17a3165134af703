"""Common parts of all checks: the list of checks, message types, and clients of the server under test.

Messages are decoded without validation, so that a check can continue; ``parse`` validates the parts that a check needs.
"""

import json
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from time import monotonic
from typing import Annotated, Any, Literal, NamedTuple, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ccatp.config.messages import format_key
from ccatp.config.robot_limits import (
    FRAME_HZ,
    VEHICLE_FRAME_HZ,
    TimeToLive,
    WheelBase,
    WheelRadius,
    top_speed_problem,
)
from ccatp.core import ALL_MOTION, Permits
from ccatp.links.robot_codec import LineBuffer, encode, format_drive, format_permit, join_mac
from ccatp.links.robot_messages import AUTH_HMAC, Fans, Join, Role
from ccatp.mirror.mirror import Mirror

Need = Literal["motion", "body", "turn", "real time", "lockstep", "hmac"]
Key = Literal["drive", "permit"]
Ending = Literal["FIN", "RST"]
Message = dict[str, Any]
Pair = tuple[float, float]
STILL: Pair = (0.0, 0.0)
POLL_S = 0.05
COMMAND_LIMIT_S = 2.0  # robot time within which a command must be in force
DUTY_TOLERANCE = 0.01  # the robot may store a duty in eight bits
# The numbers between two steps are for messages that must be older or newer than others.
SEQ_STEP = 10
# Far above the 8192 allowed: a server's line that is too long fails a check and does not overflow the buffer.
_LIMIT_BYTES = 1 << 20
_CHUNK_BYTES = 1 << 16
_RESET = b"\x01\0\0\0\0\0\0\0"  # linger on, for 0 s: close sends RST


class CheckFailed(AssertionError):
    """The server violates the interface control document; the text is what was observed."""


class NotApplicable(Exception):
    """The requirement does not apply to this server or cannot be observed; the text is the reason."""


Run = Callable[[Any], str]
Fixture = Callable[["CheckContext"], AbstractContextManager[Any]]


class Check(NamedTuple):
    """One check: ``run`` returns what was observed, or raises ``CheckFailed`` or ``NotApplicable``."""

    check_id: str
    promise: str
    run: Callable[["CheckContext"], str]
    needs: tuple[Need, ...]  # without which it is not applicable


class CheckList(list[Check]):
    """Checks in the order in which they run."""

    def add(self, check_id: str, promise: str, *needs: Need, fixture: Fixture = nullcontext) -> Callable[[Run], Run]:
        """Decorator: append a function whose argument is the value of ``fixture``, by default the context."""

        def append(run: Run) -> Run:
            def check(context: CheckContext) -> str:
                with fixture(context) as given:
                    return run(given)

            self.append(Check(check_id, promise, check, needs))
            return run

        return append


def require(is_kept: bool, seen: str) -> None:
    """Raise ``CheckFailed`` with the text ``seen`` unless the condition is true."""
    if not is_kept:
        raise CheckFailed(seen)


# -- messages -----------------------------------------------------------------------------------------------------


class MessagePart(BaseModel):
    """Part of a message. Numbers must be finite, not booleans or text; additional keys are ignored."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False)


PartT = TypeVar("PartT", bound=MessagePart)
Positive = Annotated[float, Field(gt=0.0)]
Two = Annotated[list[float], Field(min_length=2, max_length=2)]
Three = Annotated[list[float], Field(min_length=3, max_length=3)]


def parse(model: type[PartT], message: Message, where: str = "") -> PartT:
    """Validate a part of a message; ``CheckFailed`` names the first key that is missing or wrong."""
    try:
        return model.model_validate(message)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = format_key(first["loc"])
        seen = f"no {name}" if first["type"] == "missing" else f"{name} = {first['input']!r}"
        own = first.get("ctx", {}).get("error")
        raise CheckFailed(where + (seen if own is None else f"{name}: {own}" if name else f"{own}")) from None


class RobotTiming(MessagePart):
    """Clock of the robot, in its hello; a robot with a vehicle may send fewer frames."""

    lockstep: bool
    frame_hz: Positive
    ttl_s: TimeToLive
    robot: Any = None

    @model_validator(mode="after")
    def _check_rate(self) -> Self:
        robot = self.robot
        vehicle = robot.get("vehicle") if isinstance(robot, dict) else getattr(robot, "vehicle", None)
        limits = FRAME_HZ if vehicle is None else VEHICLE_FRAME_HZ
        if problem := limits.problem("frame_hz", self.frame_hz, " Hz"):
            raise ValueError(problem)
        return self

    @property
    def frame_s(self) -> float:
        """Period of the frames."""
        return 1.0 / self.frame_hz


class RobotBody(MessagePart):
    """Sizes of the robot that the checks need. With impossible sizes no check that moves the wheels runs."""

    wheel_radius_m: WheelRadius
    wheel_base_m: WheelBase
    max_wheel_rad_s: Positive
    fan_floor: float
    vehicle: Any = None  # of a robot on a floor

    @property
    def is_steered(self) -> bool:
        """Whether a steered wheel turns it: its wheels have one speed."""
        return isinstance(self.vehicle, dict) and self.vehicle.get("kind") == "ackermann"

    @model_validator(mode="after")
    def _check_speed(self) -> Self:
        if problem := top_speed_problem(self.wheel_radius_m, self.max_wheel_rad_s):
            raise ValueError(problem)
        return self


class Facts(RobotTiming):
    """The parts of the server's hello that the checks need."""

    auth: Any = None
    robot: RobotBody

    @property
    def needs_mac(self) -> bool:
        """Whether a join needs a mac."""
        return bool(self.auth == AUTH_HMAC)


class Echo(MessagePart):
    """The command echo of a frame."""

    seq: int
    age: float
    permit_age: float
    held: bool


class Frame(MessagePart):
    """The parts of a sensors frame that the checks need.

    ``enc`` has samples (t, right, left) of the wheels in s and rad/s; ``imu`` (t, ax, wz) in s, m/s^2, rad/s.
    """

    seq: int
    t: float
    fans: Two
    imu: list[Any] = []
    enc: list[Any]
    gravity: Any = None
    cmd: Echo

    def age_s(self, key: Key) -> float:
        """Age of the drive in force or of the newest permit."""
        return self.cmd.age if key == "drive" else self.cmd.permit_age

    def arrival_s(self, key: Key) -> float:
        """Arrival time of that drive or permit, robot's clock."""
        return self.t - self.age_s(key)

    def has_fans(self, wanted: Sequence[float]) -> bool:
        """Whether the fan duties equal ``wanted`` within ``DUTY_TOLERANCE``."""
        return all(abs(a - b) <= DUTY_TOLERANCE for a, b in zip(self.fans, wanted, strict=True))


def whole_samples(samples: object, size: int) -> list[list[float]]:
    """The samples of a list that have ``size`` numbers; the check ``frames-samples`` reports the others."""
    whole = [one for one in samples if isinstance(one, list) and len(one) == size] if isinstance(samples, list) else []
    return [one for one in whole if all(isinstance(value, int | float) for value in one)]


def read_message(line: bytes) -> Message | None:
    """The JSON object in a line, or ``None``. Repeated keys, NaN and infinity are accepted."""
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def shorten(line: bytes, most: int = 60) -> str:
    """The first ``most`` bytes of a line as text."""
    text = line[:most].decode("utf-8", "backslashreplace")
    return text if len(line) <= most else text + "..."


# -- clients ------------------------------------------------------------------------------------------------------


class RawConnection:
    """One connection; ``lines`` are received and not yet read, without their LF. Raises OSError: no connection.

    ``timeout_s`` limits the time to connect and the time of each send.
    """

    def __init__(self, address: tuple[str, int], timeout_s: float) -> None:
        self._socket = socket.create_connection(address, timeout_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffer = LineBuffer(_LIMIT_BYTES)
        self.lines: deque[bytes] = deque()
        self.is_ended = False

    @property
    def is_open(self) -> bool:
        """Whether this side has not closed the connection."""
        return self._socket.fileno() >= 0

    def fileno(self) -> int:
        """For ``select``."""
        return self._socket.fileno()

    def send(self, data: bytes) -> None:
        """Send; on an error the data are lost and ``is_ended`` is true."""
        try:
            self._socket.sendall(data)
        except OSError:
            self.is_ended = True

    def receive(self) -> None:
        """Read the available data; call it only if ``select`` reports data. ``CheckFailed``: an endless line."""
        try:
            data = self._socket.recv(_CHUNK_BYTES)
        except OSError:
            data = b""
        self.is_ended = self.is_ended or not data
        self.lines.extend(self._buffer.feed(data))
        if self._buffer.error is not None:
            raise CheckFailed(f"the server's line is too long: {self._buffer.error}")

    def end(self, ending: Ending) -> None:
        """Send FIN and keep the socket for reading (a close with unread data sends RST), or close with RST."""
        with suppress(OSError):
            if ending == "FIN":
                self._socket.shutdown(socket.SHUT_WR)
                return
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
        if ending == "RST":
            self._socket.close()

    def close(self) -> None:
        """Close."""
        with suppress(OSError):
            self._socket.close()


class CheckContext:
    """Clients of one check; call ``clear`` before the next check. ``last_seq``: highest sequence number used so far.

    ``mirror``: the robot stands at its base; ``None`` if not known.
    """

    facts: Facts
    mirror: Mirror | None = None

    def __init__(self, address: tuple[str, int], key: bytes | None, timeout_s: float) -> None:
        self._address, self.key, self.timeout_s = address, key, timeout_s
        self.last_seq = 0
        self._connections: list[RawConnection] = []

    def next_seq(self) -> int:
        """A sequence number above all numbers used so far."""
        self.last_seq += SEQ_STEP
        return self.last_seq

    def connect(self) -> RawConnection:
        """A new connection. Raises OSError: the server does not accept it."""
        self._connections.append(RawConnection(self._address, self.timeout_s))
        return self._connections[-1]

    def poll(self, wait_s: float = POLL_S) -> None:
        """Receive on all connections with data; wait at most ``wait_s`` for the first."""
        reading = [one for one in self._connections if one.is_open and not one.is_ended]
        for one in select.select(reading, [], [], wait_s)[0]:
            one.receive()

    def until(self, is_done: Callable[[], bool], wait_s: float | None = None) -> bool:
        """Receive until ``is_done`` is true; false after ``wait_s`` (the time-out by default)."""
        deadline_s = time.monotonic() + (self.timeout_s if wait_s is None else wait_s)
        while not is_done():
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                return False
            self.poll(min(left_s, POLL_S))
        return True

    def is_closed(self, connection: RawConnection, wait_s: float | None = None) -> bool:
        """Whether the server closes a connection within ``wait_s`` (the time-out by default)."""
        return self.until(lambda: connection.is_ended, wait_s)

    def message(self, connection: RawConnection, *kinds: str) -> Message:
        """The next message on a connection; ``CheckFailed`` if it has none of these types, or none comes."""
        wanted = " or ".join(kinds)
        self.until(lambda: bool(connection.lines) or connection.is_ended)
        seen = "connection closed" if connection.is_ended else "silence"
        require(bool(connection.lines), f"{seen} instead of {wanted}")
        line = connection.lines.popleft()
        message = read_message(line)
        if message is None or message.get("type") not in kinds:
            raise CheckFailed(f"{shorten(line)} instead of {wanted}")
        return message

    def greet(self) -> tuple[RawConnection, Message]:
        """A new connection and its hello; ``CheckFailed`` if it is not accepted or no hello comes."""
        try:
            connection = self.connect()
        except OSError as error:
            raise CheckFailed(f"connection not accepted: {error.strerror or error}") from error
        return connection, self.message(connection, "hello")

    def join_line(self, hello: Message, role: Role, mac: str | None = None) -> bytes:
        """The join that answers a hello, with the right mac or the given one; ``NotApplicable`` without the key."""
        if mac is None and self.facts.needs_mac:
            if self.key is None:
                raise NotApplicable("the server asks for a mac, and there is no key")
            mac = join_mac(self.key, str(hello.get("nonce")), role)
        return encode(Join(role=role, client="conformance", mac=mac or ""))

    def request(self, role: Role) -> tuple[RawConnection, Message]:
        """A new connection that requests a role, and the server's answer."""
        connection, hello = self.greet()
        connection.send(self.join_line(hello, role))
        return connection, self.answer(connection)

    def answer(self, connection: RawConnection) -> Message:
        """The server's answer to a join."""
        return self.message(connection, "joined", "refused")

    def join(self, role: Role, retry_s: float | None = None) -> RawConnection:
        """A new session; ``CheckFailed`` if refused.

        The previous session may not have ended yet, so a role that is taken is requested again for ``retry_s`` (the
        time-out by default).
        """
        deadline_s = time.monotonic() + (self.timeout_s if retry_s is None else retry_s)
        while True:
            connection, answer = self.request(role)
            if answer["type"] == "joined":
                return connection
            connection.close()
            is_over = time.monotonic() > deadline_s
            require(answer.get("reason") == "role taken" and not is_over, f"{role} refused: {answer.get('reason')}")
            self.until(lambda: False, POLL_S)

    def clear(self) -> None:
        """Close all connections."""
        for connection in self._connections:
            connection.close()
        self._connections.clear()


class ControllerAndMonitor:
    """Two sessions that answer every frame.

    ``rates``: (right, left) set points of the drive that answers each frame, rad/s; ``None`` sends none. ``allowed``:
    (forward, reverse, turn) of the permit that answers each frame; ``None`` sends none. ``messages``: sensors messages
    as received, of the controller and of the monitor. ``duty``: (left, right) fan duties that a check has set.
    ``received_s``: arrival time of each of the ``frames``; ``sent_s``: send time of each drive by its number. Both are
    times of this machine's monotonic clock.
    """

    def __init__(self, context: CheckContext) -> None:
        self.context, self.facts = context, context.facts
        self.join()
        self.rates: Pair | None = STILL
        self.allowed: Permits | None = ALL_MOTION
        self.duty: Pair = STILL
        self.frames: list[Frame] = []
        self.received_s: list[float] = []
        self.sent_s: dict[int, float] = {}
        self.messages: tuple[list[Message], list[Message]] = ([], [])
        self.raw: list[bytes] = []

    def join(self) -> None:
        """Begin both sessions."""
        # The monitor joins first: after that the robot always needs drive and permit.
        self.monitor = self.context.join("monitor")
        self.controller = self.context.join("controller")
        self.answer_again()

    def rejoin(self) -> None:
        """End both sessions, and begin new ones."""
        self._take()
        self.controller.close()
        self.monitor.close()
        self.join()

    @property
    def newest(self) -> Frame:
        """The newest frame."""
        return self.frames[-1]

    # -- commands -------------------------------------------------------------------------------------------------

    def drive(self, seq: int | None = None, rates: Pair = STILL, ack: int | None = None, before: bytes = b"") -> int:
        """Send ``before`` and a drive that answers the newest frame (or frame ``ack``); return the drive's number."""
        seq = self.context.next_seq() if seq is None else seq
        self.sent_s[seq] = monotonic()
        self.controller.send(before + format_drive(seq, self.newest.seq if ack is None else ack, *rates))
        if ack is None:
            self.mark_driven()
        return seq

    def permit(self, seq: int | None = None, allowed: Permits = ALL_MOTION, ack: int | None = None) -> int:
        """Send a permit that answers the newest frame (or frame ``ack``); return its number."""
        seq = self.context.next_seq() if seq is None else seq
        self.monitor.send(format_permit(seq, self.newest.seq if ack is None else ack, *allowed))
        if ack is None:
            self._permitted = self.newest.seq
        return seq

    def fans(self, duty: Pair, seq: int | None = None) -> int:
        """Send fan duties; return the number of the message."""
        seq = self.context.next_seq() if seq is None else seq
        self.controller.send(encode(Fans(seq=seq, duty=duty)))
        return seq

    def mark_driven(self) -> None:
        """Regard the newest frame as answered by a drive."""
        self._driven = self.newest.seq

    def withhold(self, key: Key) -> None:
        """Stop answering frames with a drive, or with a permit."""
        if key == "drive":
            self.rates = None
        else:
            self.allowed = None

    def answer_again(self) -> None:
        """Regard the newest frame as unanswered: the robot may have dropped the answers."""
        self._driven = self._permitted = -1

    # -- frames ---------------------------------------------------------------------------------------------------

    def find(self, is_wanted: Callable[[Frame], bool], robot_s: float = COMMAND_LIMIT_S) -> Frame | None:
        """Answer frames until ``is_wanted`` is true; ``None`` after ``robot_s`` of robot time, or after the time-out.

        The wanted frame itself is not answered yet.
        """
        start = len(self.frames)
        begin_s: float | None = None  # time of the first new frame: a long pause may precede it
        quiet_s = time.monotonic()
        while True:
            self._answer()
            self.context.poll()
            if self._take():
                quiet_s = time.monotonic()
            for frame in self.frames[start:]:
                begin_s = frame.t if begin_s is None else begin_s
                if is_wanted(frame):
                    return frame
                if frame.t - begin_s > robot_s:
                    return None
            start = len(self.frames)
            if time.monotonic() - quiet_s > self.context.timeout_s:
                return None

    def expect(self, is_wanted: Callable[[Frame], bool], otherwise: str) -> Frame:
        """Answer frames until ``is_wanted`` is true; ``CheckFailed`` with ``otherwise`` if no such frame comes."""
        frame = self.find(is_wanted)
        if frame is None:
            self._check_sessions()
            raise CheckFailed(otherwise)
        return frame

    def next_frame(self, otherwise: str) -> Frame:
        """Answer frames until a newer one comes."""
        newest = self.newest.seq
        return self.expect(lambda frame: frame.seq > newest, otherwise)

    def run(self, robot_s: float) -> list[Frame]:
        """Answer frames for ``robot_s`` of robot time; return these frames."""
        start = len(self.frames)
        if not self.frames:
            self.expect(lambda _: True, "no frames after the join")
        self._take()
        end_s = self.newest.t + robot_s
        if self.find(lambda frame: frame.t >= end_s, 2.0 * robot_s) is None:
            self._check_sessions()
            raise CheckFailed(f"no more frames after frame {self.newest.seq}")
        return self.frames[start:]

    def run_frames(self, count: int) -> list[Frame]:
        """Answer frames for ``count`` frame periods; return these frames."""
        return self.run(count * self.facts.frame_s)

    def pause(self, wall_s: float) -> list[Frame]:
        """Answer nothing for ``wall_s``; return the frames received."""
        start = len(self.frames)
        end_s = time.monotonic() + wall_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            self.context.poll(min(left_s, POLL_S))
            self._take()
        return self.frames[start:]

    def echoed(self, *seqs: int, otherwise: str) -> Frame:
        """Send no newer drive until the robot echoes one of these drives; return that frame.

        Lockstep needs newer drives; there each drive is in force for one frame.
        """
        self.rates = STILL if self.facts.lockstep else None
        return self.expect(lambda frame: frame.cmd.seq in seqs, otherwise)

    def steady(self) -> Frame:
        """Answer frames until a drive of zero and a permit are in force and the robot is not held."""
        self.rates, self.allowed = STILL, ALL_MOTION
        first = self.context.next_seq()
        return self.expect(
            lambda frame: not frame.cmd.held and frame.cmd.seq > first,
            "held in spite of a new drive and a new permit for each frame",
        )

    def settle(self) -> list[Frame]:
        """Answer frames until all messages sent before are in force; return these frames."""
        start = len(self.frames)
        mark = self.context.next_seq()
        self.expect(lambda frame: frame.cmd.seq > mark, "drives no longer come into force")
        return self.frames[start:]

    def _check_sessions(self) -> None:
        for name, connection in (("controller", self.controller), ("monitor", self.monitor)):
            require(not (connection.is_open and connection.is_ended), f"the {name}'s session was closed")

    def _answer(self) -> None:
        if self.frames and self.rates is not None and self._driven < self.newest.seq:
            self.drive(rates=self.rates)
        if self.frames and self.allowed is not None and self._permitted < self.newest.seq:
            self.permit(allowed=self.allowed)

    def _take(self) -> bool:
        """Parse the received lines; return whether there is a new frame."""
        before = len(self.frames)
        for connection, messages in zip((self.controller, self.monitor), self.messages, strict=True):
            while connection.lines:
                line = connection.lines.popleft()
                self.raw.append(line)
                message = read_message(line)
                if message is None or message.get("type") != "sensors":
                    continue
                messages.append(message)
                frame = parse(Frame, message, "a sensors frame with ")
                if not self.frames or frame.seq > self.newest.seq:
                    self.frames.append(frame)
                    self.received_s.append(monotonic())
        return len(self.frames) > before


@contextmanager
def steady(context: CheckContext) -> Iterator[ControllerAndMonitor]:
    """Both sessions joined, with drive and permit in force."""
    pair = ControllerAndMonitor(context)
    pair.steady()
    yield pair
