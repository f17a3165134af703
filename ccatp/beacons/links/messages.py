"""Extra keys of ``sensors`` of a robot among beacons (``docs/robot_link.md``): steering, radios, distances, motes.

The rows of the topics ``beacon_track`` and ``beacon_truth`` as arrays, and the error between them.
"""

from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from ccatp.core import FloatArray, Time
from ccatp.links.robot_codec import BadLine
from ccatp.links.robot_messages import Name

Angle = Annotated[float, Meta(ge=-100.0, le=100.0)]
Level = Annotated[float, Meta(ge=-200.0, le=100.0)]
Distance = Annotated[float, Meta(ge=0.0, le=1e4)]
Delay = Annotated[float, Meta(ge=0.0, le=10.0)]
Celsius = Annotated[float, Meta(ge=-100.0, le=200.0)]


class SteerSample(NamedTuple):
    """A reading of the steering angle, rad, left positive."""

    t_s: Time
    steer_rad: Angle


class RadioSample(NamedTuple):
    """A received radio: its name, level, and direction (left of the heading; ``None`` without a direction)."""

    t_s: Time
    beacon: Name
    rssi_dbm: Level
    bearing_rad: Angle | None


class RadioScan(msgspec.Struct, frozen=True):
    """One turn of a reflector.

    ``step``: angle between two directions, rad, from straight ahead to the left. ``levels``: of each radio,
    dBm, one for each direction, ``None`` where a packet was lost.
    """

    t: Time
    step: Angle
    levels: dict[Name, list[Level | None]]


class MoteBurst(NamedTuple):
    """Pulses from one mote to another or to the robot: delays after the radio message, temperature of the listener."""

    t_s: Time
    sender: Name
    listener: Name
    temperature_c: Celsius
    delays_s: list[Delay]


class BeaconFrame(msgspec.Struct, frozen=True):
    """The extra keys of a frame.

    ``steer``: steering angles since the last frame. ``distances``: of the distance sensors, m, in the order of the
    robot's ``hello``; empty where there was no reading.
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
    """The extra keys of a line that is a valid ``sensors`` message; ``BadLine``: wrong type or range."""
    try:
        return _decoder.decode(line)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadLine(str(error), "sensors") from None


def with_extras(line: bytes, extras: BeaconFrame) -> bytes:
    """A ``sensors`` line with the extra keys at its end."""
    keys = {name: getattr(extras, name) for name in extras.__struct_fields__}
    more = _encoder.encode({name: value for name, value in keys.items() if value})
    return line if more == b"{}" else line.rstrip()[:-1] + b"," + more[1:] + b"\n"


Ellipse = tuple[float, float, float, float, float]  # x, y and their covariance xx, xy, yy


def worst_sigma_m(xx: float, xy: float, yy: float) -> float:
    """Standard deviation of a position in its worst direction."""
    middle, spread = 0.5 * (xx + yy), (0.25 * (xx - yy) ** 2 + xy * xy) ** 0.5
    return float(max(middle + spread, 0.0) ** 0.5)


TRACK_COLUMNS, TRUTH_COLUMNS = 13, 8
_COVARIANCE = [5, 6, 8, 6, 7, 9, 8, 9, 10]  # stored as xx, xy, yy, xh, yh, hh


class PoseTrack(NamedTuple):
    """Estimates of k frames, as in the topic ``beacon_track``."""

    seq: FloatArray  # shape (k,)
    t_s: FloatArray  # robot time, shape (k,)
    place_m: FloatArray  # x, y, shape (k, 2)
    heading_rad: FloatArray  # shape (k,)
    covariance: FloatArray  # of x, y, heading, shape (k, 3, 3)
    reckoned_m: FloatArray  # x, y by dead reckoning alone, shape (k, 2)

    @property
    def sigma_m(self) -> FloatArray:
        """Standard deviation of the place in its worst direction, shape (k,)."""
        return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(self.covariance[:, :2, :2])[:, -1], 0.0)))

    def at(self, rows: Any) -> "PoseTrack":
        """Some of the frames: an index, a slice or a mask of them."""
        return PoseTrack(*(column[rows] for column in self))


class PoseTruth(NamedTuple):
    """The simulated truth of k frames; NaN where a frame has none."""

    seq: FloatArray  # shape (k,)
    t_s: FloatArray  # robot time, shape (k,)
    place_m: FloatArray  # x, y, shape (k, 2)
    heading_rad: FloatArray  # shape (k,)
    target_m: FloatArray  # the radio that moves, shape (k, 2)
    clearance_m: FloatArray  # of the body to the nearest obstacle, shape (k,)

    def at(self, rows: Any) -> "PoseTruth":
        """Some of the frames: an index, a slice or a mask of them."""
        return PoseTruth(*(column[rows] for column in self))


def table(rows: Sequence[Sequence[float | None]], columns: int) -> FloatArray:
    """Rows as arrays, shape (k, columns); NaN for what is not known."""
    filled = [[np.nan if value is None else value for value in row] for row in rows]
    return np.array(filled, dtype=np.float64).reshape(-1, columns)


def pose_track(rows: FloatArray) -> PoseTrack:
    """Rows of the topic ``beacon_track``, shape (k, 13)."""
    P = rows[:, _COVARIANCE].reshape(-1, 3, 3)
    return PoseTrack(rows[:, 0], rows[:, 1], rows[:, 2:4], rows[:, 4], P, rows[:, 11:13])


def pose_truth(rows: FloatArray) -> PoseTruth:
    """Rows of the topic ``beacon_truth``, shape (k, 8)."""
    return PoseTruth(rows[:, 0], rows[:, 1], rows[:, 2:4], rows[:, 4], rows[:, 5:7], rows[:, 7])


def truth_in(truth: PoseTruth, seq: FloatArray) -> PoseTruth:
    """The truth in frames ``seq``, shape (k,); NaN in those of which it has none."""
    rows = np.full((len(seq), TRUTH_COLUMNS), np.nan)
    _, here, there = np.intersect1d(seq, truth.seq, return_indices=True)
    rows[here] = np.column_stack(truth)[there]
    rows[:, 0] = seq
    return pose_truth(rows)


def pose_errors(track: PoseTrack, truth: PoseTruth) -> FloatArray:
    """Estimate less truth of the same frames: x, y (m), heading (rad, in [-pi, pi]), shape (k, 3)."""
    turn = track.heading_rad - truth.heading_rad
    return np.column_stack([track.place_m - truth.place_m, np.arctan2(np.sin(turn), np.cos(turn))])
