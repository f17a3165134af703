"""The messages of the robot link (interface control document 1); their codec is ``ccatp.links.robot_codec``."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from ccatp.core import EdgeSample, GravitySample, ImuSample, Time, WheelSample

PROTOCOL = "ccatp-robot/1"
AUTH_NONE: Literal["none"] = "none"
AUTH_HMAC: Literal["hmac-sha256"] = "hmac-sha256"

Role = Literal["controller", "monitor"]
RefusalReason = Literal["role taken", "bad mac", "bad join", "bad protocol", "busy"]
Sequence53 = Annotated[int, Meta(ge=0, le=2**53 - 1)]  # largest integer that every JSON reader represents exactly
Steer = Annotated[float, Meta(ge=-1.6, le=1.6)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
Length = Annotated[float, Meta(ge=-10.0, le=10.0)]
Positive = Annotated[float, Meta(gt=0.0, le=1e6)]
Name = Annotated[str, Meta(max_length=64)]


class Unknown(msgspec.Struct, frozen=True):
    """A well-formed message of an unknown type."""

    type: str


class RobotLinkMessage(msgspec.Struct, tag_field="type", gc=False):
    """Base of all messages; ``type`` is the tag."""


class VehicleData(msgspec.Struct):
    """Further data of a robot on a floor: its kind; directions of its distance sensors, rad, left of the heading."""

    kind: Literal["ackermann", "differential"]
    axle_distance_m: Positive
    steer_max_rad: Steer
    distance_sensors_rad: list[Annotated[float, Meta(ge=-6.3, le=6.3)]]


class RobotData(msgspec.Struct, omit_defaults=True):
    """Data of the robot: lengths in m, robot frame; edge sensors in the order of ``EdgeSample``.

    The limits of a robot are those of ``ccatp.config.robot_limits``: a client refuses a robot beyond them by name.
    """

    wheel_radius_m: float
    wheel_base_m: float
    edge_sensors_m: tuple[tuple[Length, Length], tuple[Length, Length], tuple[Length, Length], tuple[Length, Length]]
    puck_m: tuple[Length, Length, Length]
    max_wheel_rad_s: float
    fan_floor: Fraction
    vehicle: VehicleData | None = None


class Hello(RobotLinkMessage, tag="hello"):
    """First line of the robot on a new connection."""

    protocol: Name
    boot: Sequence53
    nonce: Annotated[str, Meta(pattern="^[0-9a-fA-F]{32}$")]
    auth: Literal["none", "hmac-sha256"]
    lockstep: bool
    frame_hz: float
    ttl_s: float
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


class Sensors(RobotLinkMessage, tag="sensors", gc=True, omit_defaults=True):
    """One frame of the robot: all samples since the frame before, oldest first. Times by the robot's clock, s.

    ``sliding``: it has found a loss of grip itself, holds its wheels, and gives full fans.
    """

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
    sliding: bool = False


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
