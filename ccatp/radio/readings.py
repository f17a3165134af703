"""Pure. What a radio tells of a beacon: ranges, bearings and signal strengths, each with its own time."""

from dataclasses import dataclass

BeaconId = int | str


@dataclass(frozen=True, slots=True)
class RangeReading:
    """A range to a beacon, as it was measured: scale error, offset and all.

    Attributes:
        time_s: when it was taken.
        beacon: which one answered.
        range_m: what was read, m.
    """

    time_s: float
    beacon: BeaconId
    range_m: float


@dataclass(frozen=True, slots=True)
class RangeBearingReading:
    """A range and a direction.

    Attributes:
        time_s: when it was taken.
        beacon: which one was seen.
        range_m: what was read, m; NaN where the direction alone was.
        bearing_rad: from the vehicle's heading, counter-clockwise.
    """

    time_s: float
    beacon: BeaconId
    range_m: float
    bearing_rad: float


@dataclass(frozen=True, slots=True)
class RssiReading:
    """A signal strength, with the direction where it was strongest if an antenna turns.

    Attributes:
        time_s: when it was taken.
        beacon: which one was heard.
        rssi_dbm: received signal strength, dBm.
        bearing_rad: from the vehicle's heading, counter-clockwise; None without a directional antenna.
    """

    time_s: float
    beacon: BeaconId
    rssi_dbm: float
    bearing_rad: float | None = None


Reading = RangeReading | RangeBearingReading | RssiReading
