"""The messages of the robot link (interface control document 1) as types; their codec is ``ccatp.links.robot_codec``.

Lines out of a byte stream with a hard limit, and the count of bad ones.
"""

from collections import deque
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from ccatp.core import EdgeSample, GravitySample, ImuSample, Time, WheelSample

PROTOCOL = "ccatp-robot/1"
AUTH_NONE: Literal["none"] = "none"
AUTH_HMAC: Literal["hmac-sha256"] = "hmac-sha256"

Role = Literal["controller", "monitor"]
RefusalReason = Literal["role taken", "bad mac", "bad join", "bad protocol", "busy"]
Sequence53 = Annotated[int, Meta(ge=0, le=2**53 - 1)]  # what every JSON reader keeps exact
Steer = Annotated[float, Meta(ge=-1.6, le=1.6)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
Length = Annotated[float, Meta(ge=-10.0, le=10.0)]
Positive = Annotated[float, Meta(gt=0.0, le=1e6)]
Name = Annotated[str, Meta(max_length=64)]


class Unknown(msgspec.Struct, frozen=True):
    """A well-formed message of a type that this side does not know."""

    type: str


class RobotLinkMessage(msgspec.Struct, tag_field="type", gc=False):
    """Base of all messages; ``type`` is the tag."""


class VehicleData(msgspec.Struct):
    """What a robot among beacons says besides: its kind, and its distance sensors, rad, left of the heading."""

    kind: Literal["ackermann", "differential"]
    axle_distance_m: Positive
    steer_max_rad: Steer
    distance_sensors_rad: list[Annotated[float, Meta(ge=-6.3, le=6.3)]]


class RobotData(msgspec.Struct, omit_defaults=True):
    """What the robot says of itself: lengths in m, robot frame; edge sensors in the order of ``EdgeSample``."""

    wheel_radius_m: Positive
    wheel_base_m: Positive
    edge_sensors_m: tuple[tuple[Length, Length], tuple[Length, Length], tuple[Length, Length], tuple[Length, Length]]
    puck_m: tuple[Length, Length, Length]
    max_wheel_rad_s: Positive
    fan_floor: Fraction
    vehicle: VehicleData | None = None


class Hello(RobotLinkMessage, tag="hello"):
    """First line of the robot on a new connection."""

    protocol: Name
    boot: Sequence53
    nonce: Annotated[str, Meta(pattern="^[0-9a-f]{32}$")]
    auth: Literal["none", "hmac-sha256"]
    lockstep: bool
    frame_hz: Positive
    ttl_s: Positive
    robot: RobotData


class Join(RobotLinkMessage, tag="join", omit_defaults=True):
    """Answer of a client to the hello; ``mac`` only where the robot asks for it, ``protocol`` is that of the hello."""

    role: Role
    client: Name
    mac: Name = ""
    protocol: Name = PROTOCOL


class Joined(RobotLinkMessage, tag="joined"):
    """The client has the role."""

    role: Role
    session: Sequence53


class Refused(RobotLinkMessage, tag="refused"):
    """The client does not get the role; the robot closes."""

    reason: Name


class CommandEcho(msgspec.Struct, gc=False):
    """The newest drive in force (seq 0: none), its age, that of the newest permit, and whether the wheels are held."""

    seq: Annotated[int, Meta(ge=-1, le=2**53 - 1)]
    age: Time
    permit_age: Time
    held: bool


class Sensors(RobotLinkMessage, tag="sensors", gc=True):
    """One frame of the robot: every sample taken since the one before, oldest first. Times are the robot's clock, s."""

    seq: Sequence53
    t: Time
    imu: list[ImuSample]
    enc: list[WheelSample]
    edge: list[EdgeSample]
    gravity: GravitySample | None
    fans: tuple[Fraction, Fraction]
    soc: Fraction
    cmd: CommandEcho
    faults: list[Name]


class Drive(RobotLinkMessage, tag="drive"):
    """Wheel angular-rate set points, rad/s, which the robot clamps; ``ack`` is the newest sensors frame they come from.

    ``steer``: angle of the steered wheel, rad, left positive; for robots that have one, the others ignore it.
    """

    seq: Sequence53
    ack: Sequence53
    wr: float
    wl: float
    steer: Steer | None = None


class Permit(RobotLinkMessage, tag="permit"):
    """The motion that the monitor allows until the next permit."""

    seq: Sequence53
    ack: Sequence53
    forward: bool
    reverse: bool
    turn: bool


class Fans(RobotLinkMessage, tag="fans"):
    """Fan duty (left, right); stays in force until changed."""

    seq: Sequence53
    duty: tuple[Fraction, Fraction]


FromRobot = Hello | Joined | Refused | Sensors
FromClient = Join | Drive | Permit | Fans

MAX_LINE_BYTES = 8192


class LineTooLong(ValueError):
    """A line over the limit; the session that sent it is of no further use."""


class LineBuffer:
    """Cuts a byte stream into lines, however it was chopped on its way.

    ``limit``: most bytes of a line, its LF not counted. No more than this is ever kept between two calls.

    Attributes:
        error: set from the first line on, finished or not, that is over the limit.
    """

    def __init__(self, limit: int = MAX_LINE_BYTES) -> None:
        self._limit = limit
        self._rest = b""
        self.error: LineTooLong | None = None

    def feed(self, data: bytes) -> list[bytes]:
        """Whole lines, without their LF, after ``data`` was appended; none from one over the limit on."""
        if self._rest:
            data = self._rest + data
        lines = data.split(b"\n")
        self._rest = lines.pop()
        limit = self._limit
        if len(data) > limit:  # else no line in it can be longer
            for k, line in enumerate((*lines, self._rest)):
                if len(line) > limit:
                    self._rest = b""
                    self.error = LineTooLong(f"line of more than {limit} bytes")
                    return lines[:k]
        return lines


class BadLineLimit:
    """So many lines at once, so many a second in the long run; more is a flood."""

    def __init__(self, lines: float, rate_hz: float) -> None:
        self._lines = self._left = lines
        self._rate_hz = rate_hz
        self._then_s = 0.0

    def take(self, lines: int, now_s: float) -> bool:
        """Take lines at ``now_s``; false when there are not so many left."""
        self._left = min(self._lines, self._left + self._rate_hz * (now_s - self._then_s)) - lines
        self._then_s = now_s
        return self._left >= 0.0


class BadLineCounter:
    """Counts bad lines, and whether there are too many of them in a window of time."""

    def __init__(self, limit: int = 20, window_s: float = 1.0) -> None:
        self._limit, self._window_s = limit, window_s
        self._lines: deque[tuple[float, str]] = deque(maxlen=limit + 1)
        self.total = 0

    @property
    def first_reason(self) -> str:
        """Reason of the oldest line of the window."""
        return self._lines[0][1] if self._lines else ""

    def add(self, now_s: float, reason: str) -> bool:
        """Count one bad line at ``now_s``; true when the session has to be closed."""
        self.total += 1
        self._lines.append((now_s, reason))
        return len(self._lines) > self._limit and now_s - self._lines[0][0] <= self._window_s
