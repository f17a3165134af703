"""Headers of tables that others have written: which quantity a column has, in which unit, of which beacon."""

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ccatp.beacons.datasets.events import READING_KINDS

# Headers of each quantity, in lower case with underscores, without unit; of several columns the earlier name counts.
HEADERS = {
    "time": (
        "time", "t", "timestamp", "time_stamp", "stamp", "unix_time", "epoch", "datetime", "date_time", "sec", "secs",
        "seconds", "stamp_sec", "stamp_secs",
    ),
    "fraction": ("nanosec", "nsec", "nsecs", "nanoseconds", "stamp_nanosec", "stamp_nsec", "stamp_nsecs"),
    "beacon": (
        "beacon", "anchor", "beacon_id", "anchor_id", "beaconid", "anchorid", "anchor_name", "responder",
        "responder_id", "to_id", "dest_id", "destination_id", "node", "node_id", "mote", "landmark",
        "landmark_id", "address", "id",
    ),
    "tag": ("tag", "tag_id", "tagid", "tag_name", "initiator", "initiator_id", "src", "source", "source_id", "from_id"),
    "range": ("range", "distance", "dist", "r"),
    "bearing": ("bearing", "aoa", "azimuth"),
    "rssi": ("rssi", "level", "rx_power", "signal_strength"),
    "x": ("x", "pos_x", "position_x", "px", "tx"),
    "y": ("y", "pos_y", "position_y", "py", "ty"),
    "z": ("z", "pos_z", "position_z", "pz", "tz"),
    "beacon_x": ("anchor_x", "beacon_x", "landmark_x", "x_anchor", "x_beacon"),
    "beacon_y": ("anchor_y", "beacon_y", "landmark_y", "y_anchor", "y_beacon"),
    "beacon_z": ("anchor_z", "beacon_z", "landmark_z", "z_anchor", "z_beacon"),
    "sigma": ("sigma", "std", "accuracy"),
    "heading": ("heading", "yaw", "theta", "phi", "orientation"),
    "qx": ("qx", "q_x", "orientation_x"),
    "qy": ("qy", "q_y", "orientation_y"),
    "qz": ("qz", "q_z", "orientation_z"),
    "qw": ("qw", "q_w", "orientation_w"),
    "speed": ("speed", "v", "vx", "velocity", "linear", "linear_x"),
    "left": (
        "vy", "v_y", "lateral_speed", "lateral_velocity", "linear_y", "v_lateral", "vlat", "speed_left", "left_speed",
        "side_speed", "speed_lateral", "velocity_y",
    ),
    "lateral": (
        "lateral", "lateral_distance", "distance_lateral", "sideways", "side", "aside", "strafe", "dlateral",
        "d_lateral", "distance_left", "left_distance", "sway",
    ),
    "rate": ("w", "omega", "rate", "yaw_rate", "turn_rate", "wz", "angular", "angular_z"),
    "turn": ("turn", "dtheta", "dyaw", "dphi"),
    "forward_m": ("forward", "ahead"),
    "left_m": ("left",),
    "up_m": ("up",),
}  # fmt: skip
SECONDS = HEADERS["time"].index("sec")  # from this name on, a time is one of whole seconds beside its fraction
# Last words of columns beside that of a reading, which are none.
OF_QUALITY = (
    "std", "stddev", "sigma", "var", "variance", "err", "error", "quality", "snr", "valid", "raw", "true", "count",
    "status", "flag",
)  # fmt: skip
DEGREE = np.pi / 180.0
TIMES = {
    "s": 1.0, "sec": 1.0, "secs": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "milliseconds": 1e-3, "us": 1e-6,
    "µs": 1e-6, "usec": 1e-6, "microseconds": 1e-6, "ns": 1e-9, "nsec": 1e-9, "nanoseconds": 1e-9,
}  # fmt: skip
LENGTHS = {
    "m": 1.0, "meter": 1.0, "meters": 1.0, "metres": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "km": 1e3,
    "ft": 0.3048, "feet": 0.3048,
}  # fmt: skip
ANGLES = {"rad": 1.0, "radians": 1.0, "mrad": 1e-3, "deg": DEGREE, "degree": DEGREE, "degrees": DEGREE, "°": DEGREE}
SPEEDS = {
    "m/s": 1.0, "m_s": 1.0, "mps": 1.0, "cm/s": 1e-2, "cm_s": 1e-2, "mm/s": 1e-3, "mm_s": 1e-3, "km/h": 1.0 / 3.6,
    "kmh": 1.0 / 3.6, "kph": 1.0 / 3.6, "mph": 0.44704,
}  # fmt: skip
RATES = {
    "rad/s": 1.0, "rad_s": 1.0, "rads": 1.0, "deg/s": DEGREE, "deg_s": DEGREE, "°/s": DEGREE, "dps": DEGREE,
    "rpm": np.pi / 30.0,
}  # fmt: skip
LEVELS = {"dbm": 1.0, "db": 1.0}
UNITS_OF = {
    "time": TIMES, "fraction": TIMES, "range": LENGTHS, "x": LENGTHS, "y": LENGTHS, "z": LENGTHS, "sigma": LENGTHS,
    "beacon_x": LENGTHS, "beacon_y": LENGTHS, "beacon_z": LENGTHS,
    "forward_m": LENGTHS, "left_m": LENGTHS, "up_m": LENGTHS, "bearing": ANGLES, "heading": ANGLES, "turn": ANGLES,
    "speed": SPEEDS, "left": SPEEDS, "lateral": LENGTHS | SPEEDS, "rate": RATES, "rssi": LEVELS,
}  # fmt: skip
SUFFIXES = {unit for units in UNITS_OF.values() for unit in units}
NO_UNIT = ("", "-", "1", "none", "utc")
NANOSECOND = 1e-9
BRACKET = re.compile(r"^(?P<name>.*?)[ _]*[\[(](?P<unit>[^\])]*)[\])]$")


class Column(NamedTuple):
    """What a column has: quantity, beacon of a column of one beacon alone, factor to SI units, place of its name."""

    quantity: str
    beacon: str
    factor: float
    rank: int = 0
    problem: str = ""  # why its values cannot be read
    unit: str = ""


def column_of(header: str) -> Column | None:
    """What the column of a header has; None: nothing that a recording consists of."""
    name, unit = _bracketed(header)
    for own, its_unit in ((name, unit), *([] if unit else _with_suffix(name))):
        for words in _names(own):
            for quantity, names in HEADERS.items():
                if words in names and (unit or not its_unit or its_unit in UNITS_OF.get(quantity, {})):
                    return _column(header, quantity, its_unit, rank=names.index(words))
    for own, its_unit in (*([] if unit else _with_suffix(name)), (name, unit)):
        for quantity in READING_KINDS:
            if beacon := _beacon_of(own, HEADERS[quantity]):
                return _column(header, quantity, its_unit, beacon=beacon)
    return None


def _column(header: str, quantity: str, unit: str, beacon: str = "", rank: int = 0) -> Column:
    units = UNITS_OF.get(quantity, {})
    if not units or unit in NO_UNIT:
        return Column(quantity, beacon, NANOSECOND if quantity == "fraction" else 1.0, rank)
    if unit in units:
        return Column(quantity, beacon, units[unit], rank, unit=unit)
    problem = f"column {header.strip()!r}: {unit!r} is no unit of a {quantity}: {', '.join(units)} are known"
    return Column(quantity, beacon, np.nan, rank, problem)


def _bracketed(header: str) -> tuple[str, str]:
    """Name and unit of ``range [mm]`` or ``range (mm)``."""
    match = BRACKET.match(header.strip())
    return (match["name"], match["unit"].strip().lower()) if match else (header.strip(), "")


def _with_suffix(name: str) -> list[tuple[str, str]]:
    """Name and unit of ``range_mm`` or ``speed_m_s``, if it has one."""
    words = name.split("_")
    ends = ((count, "_".join(words[-count:]).lower()) for count in (2, 1) if len(words) > count)
    return [("_".join(words[:-count]), unit) for count, unit in ends if unit in SUFFIXES]


def _names(name: str) -> Iterator[str]:
    """The name, and that of a field of a message without what stands before it: of ``pose.position.x`` position_x.

    A single letter at the end says nothing without the word before it.
    """
    parts = [part for part in re.split(r"[./]", name) if part]
    for first in range(len(parts)):
        if first == 0 or len(parts) - first > 1 or len(parts[first]) > 1:
            yield _words("_".join(parts[first:]))


def _words(name: str) -> str:
    return re.sub(r"[\s-]", "_", name.strip().lower()).strip("_")


def _beacon_of(name: str, synonyms: tuple[str, ...]) -> str:
    """The beacon of a column of one beacon alone, as in ``range A``, ``dist_A`` or ``range1``."""
    words = _words(name)
    if words.split("_")[-1] in {*OF_QUALITY, *SUFFIXES}:
        return ""
    for synonym in synonyms:
        beacon = words.removeprefix(synonym)
        if len(synonym) > 1 and beacon != words and (beacon.startswith("_") or beacon.isdigit()):
            return name.strip(" _-")[-len(beacon) :].strip(" _-")
    return ""
