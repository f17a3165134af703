"""Pure. What a robot among beacons says beside the frame of every robot: steering, radios, distances, motes.

Extra keys of ``sensors`` on the robot link; a client that does not know them ignores them. ``docs/robot_link.md``.
"""

from typing import Annotated, NamedTuple

import msgspec
from msgspec import Meta

from ccatp.wire.robot import BadLine
from ccatp.wire.robot_messages import Name, Time

Angle = Annotated[float, Meta(ge=-100.0, le=100.0)]
Level = Annotated[float, Meta(ge=-200.0, le=100.0)]
Distance = Annotated[float, Meta(ge=0.0, le=1e4)]
Delay = Annotated[float, Meta(ge=0.0, le=10.0)]
Celsius = Annotated[float, Meta(ge=-100.0, le=200.0)]


class SteerSample(NamedTuple):
    """The steering angle as it was read, rad, left positive."""

    t_s: Time
    steer_rad: Angle


class RadioSample(NamedTuple):
    """A radio heard: which, how strong, from where (left of the heading; ``None`` without a direction)."""

    t_s: Time
    beacon: Name
    rssi_dbm: Level
    bearing_rad: Angle | None


class RadioScan(msgspec.Struct, frozen=True):
    """One turn of a reflector.

    Attributes:
        t: at its end.
        step: between two directions, rad; the first is straight ahead, they go to the left.
        levels: of each radio, dBm, one for each direction, ``None`` where a packet was lost.
    """

    t: Time
    step: Angle
    levels: dict[Name, list[Level | None]]


class MoteBurst(NamedTuple):
    """Pulses from one mote to another, or to the robot: delays after the radio message; the listener's thermometer."""

    t_s: Time
    sender: Name
    listener: Name
    temperature_c: Celsius
    delays_s: list[Delay]


class BeaconFrame(msgspec.Struct, frozen=True):
    """The extra keys of a frame.

    Attributes:
        steer: steering angles since the last frame.
        radio: radios heard since then, one by one.
        scan: turn of the reflector that ended since then.
        distances: of the distance sensors, m, in the order of the robot's ``hello``; empty where there was no reading.
        motes: pulses heard since then.
    """

    steer: list[SteerSample] = []
    radio: list[RadioSample] = []
    scan: RadioScan | None = None
    distances: list[Distance] = []
    motes: list[MoteBurst] = []


NOTHING = BeaconFrame()
_decoder = msgspec.json.Decoder(BeaconFrame)
_encoder = msgspec.json.Encoder()


def decode_beacon_frame(line: bytes) -> BeaconFrame:
    """The extra keys in a line that has passed as ``sensors``.

    Raises:
        BadLine: a value of theirs is of the wrong type or out of range.
    """
    try:
        return _decoder.decode(line)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadLine(str(error), "sensors") from None


def with_extras(line: bytes, extras: BeaconFrame) -> bytes:
    """A ``sensors`` line with the extra keys at its end.

    Args:
        line: with its LF.
        extras: what is empty is left out.
    """
    keys = {name: getattr(extras, name) for name in extras.__struct_fields__}
    more = _encoder.encode({name: value for name, value in keys.items() if value})
    return line if more == b"{}" else line.rstrip()[:-1] + b"," + more[1:] + b"\n"
