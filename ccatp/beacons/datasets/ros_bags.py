"""A recorded run from a ROS bag (``.bag``, ``.db3``, ``.mcap``, a ROS 2 folder), with a file that names its topics.

Needs the extra ``ros`` (rosbags). It reads the message definitions in the bag, so topics of any type are accepted.
"""

import tomllib
from collections.abc import Iterator
from math import atan2, cos, sin
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from ccatp.beacons.datasets.events import Recording, name_of
from ccatp.beacons.datasets.tables import RadioDataError, tables_of
from ccatp.config.files import read_input
from ccatp.config.models import Model
from ccatp.kinematics import wrap_pi

SUFFIXES = (".bag", ".db3", ".mcap")
_MOST_TOPICS_BYTES = 100_000
_Place = Annotated[tuple[float, ...], Field(min_length=2, max_length=3)]


class OdometryTopic(Model):
    """Poses of the vehicle in a drifting frame, or velocities that are held until the next message."""

    topic: str
    use: Literal["pose", "twist"] = "pose"


class ReadingsTopic(Model):
    """Readings of beacons; fields are given as paths in the message, for example ``header.frame_id``."""

    topic: str
    each: str = ""  # field with the list of readings, if a message has several
    beacon: str = ""  # field with the name of the beacon,
    name: str = ""  # or the name itself, if all readings of the topic are of one beacon
    range: str = ""
    bearing: str = ""
    rssi: str = ""


class TruthTopic(Model):
    """Poses, transforms or points of a reference."""

    topic: str


class Topics(Model):
    """The topics of a bag, and data that it lacks."""

    odometry: OdometryTopic
    readings: list[ReadingsTopic]
    truth: TruthTopic | None = None
    antenna_m: _Place = (0.0, 0.0, 0.0)  # forward, left and up from the origin of the vehicle
    beacons: dict[str, _Place] = Field(default_factory=dict)


def read_bag(path: Path, topics_file: Path | None) -> Recording:
    """Read a run. Times are those of the message headers, or of the recorder for messages without one.

    Raises RadioDataError: rosbags is not installed, or the bag or its topics are invalid.
    """
    if topics_file is None:
        raise RadioDataError(path, "is a bag: give a TOML file that names its topics with --topics")
    topics = read_topics(topics_file)
    numbers: dict[str, float] = {}
    rows = list(_rows(path, topics, numbers))
    for name, place in topics.beacons.items():
        rows.append(("beacon", 0, [_number(numbers, name), *place, *[np.nan] * (3 - len(place))]))
    if any(topics.antenna_m):
        rows.append(("antenna", 0, [*topics.antenna_m, *[0.0] * (3 - len(topics.antenna_m))]))
    return Recording(path, name_of(path), "csv", tables_of(path, rows), tuple(numbers))


def read_topics(file: Path) -> Topics:
    """Read the file of topics. Raises RadioDataError: it is not valid."""
    try:
        return Topics.model_validate(tomllib.loads(read_input(file, _MOST_TOPICS_BYTES).decode()))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise RadioDataError(file, f"{where}: {first['msg'].lower()}; see docs/radio_data.md") from error
    except OSError as error:
        raise RadioDataError(file, f"cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise RadioDataError(file, f"is no TOML: {error}") from error


def _number(numbers: dict[str, float], name: str) -> float:
    return numbers.setdefault(name, float(len(numbers)))


def _rows(path: Path, topics: Topics, numbers: dict[str, float]) -> Iterator[tuple[str, int, list[float]]]:
    last: tuple[float, ...] = ()
    wanted = {topics.odometry.topic, *(one.topic for one in topics.readings)}
    wanted |= {topics.truth.topic} if topics.truth else set()
    for line, (topic, received_s, message) in enumerate(_messages(path, wanted), 1):
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        time_s = received_s if stamp is None else stamp.sec + 1e-9 * stamp.nanosec
        try:
            if topic == topics.odometry.topic:
                now = time_s, *(_velocity(message) if topics.odometry.use == "twist" else _pose(message))
                yield "odom", line, _moved(last or now, now, topics.odometry.use)
                last = now
            if topics.truth is not None and topic == topics.truth.topic:
                yield "truth", line, [time_s, *_pose(message)]
            for one in topics.readings:
                if one.topic == topic:
                    yield from _readings(one, message, time_s, line, numbers)
        except (ArithmeticError, AttributeError, TypeError, ValueError) as error:
            raise RadioDataError(path, f"message {line} of {topic} ({message.__msgtype__}): {error}") from error


def _messages(path: Path, wanted: set[str]) -> Iterator[tuple[str, float, Any]]:
    try:
        from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError as error:
        raise RadioDataError(path, "is a bag: to read it, install ccatp with its extra, ccatp[ros]") from error
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            if missing := sorted(wanted - {one.topic for one in reader.connections}):
                there = ", ".join(sorted({one.topic for one in reader.connections}))
                raise RadioDataError(path, f"has no topic {missing[0]}; there are {there}")
            chosen = [one for one in reader.connections if one.topic in wanted]
            for connection, time_ns, raw in reader.messages(connections=chosen):
                yield connection.topic, 1e-9 * time_ns, reader.deserialize(raw, connection.msgtype)
    except RadioDataError:
        raise
    except Exception as error:  # rosbags and its parsers raise many types on damaged bags
        raise RadioDataError(path, f"is no bag that can be read: {' '.join(str(error).split())[:200]}") from error


def _readings(
    topic: ReadingsTopic, message: Any, time_s: float, line: int, numbers: dict[str, float]
) -> Iterator[tuple[str, int, list[float]]]:
    for one in _field(message, topic.each) if topic.each else [message]:
        name = topic.name or str(_field(one, topic.beacon))
        for kind in ("range", "bearing", "rssi"):
            if field := getattr(topic, kind):
                yield kind, line, [time_s, _number(numbers, name), float(_field(one, field))]


def _field(message: Any, path: str) -> Any:
    for part in path.split("."):
        message = getattr(message, part)
    return message


def _pose(message: Any) -> tuple[float, float, float]:
    """x_m, y_m, heading_rad of a pose, transform or point, also if nested; heading NaN for a point."""
    for part in ("transform", "pose", "pose", "point"):
        message = getattr(message, part, message)
    place = next((getattr(message, part) for part in ("translation", "position") if hasattr(message, part)), message)
    turn = next((getattr(message, part) for part in ("rotation", "orientation") if hasattr(message, part)), None)
    if turn is None:
        return float(place.x), float(place.y), np.nan
    heading_rad = atan2(2.0 * (turn.w * turn.z + turn.x * turn.y), 1.0 - 2.0 * (turn.y**2 + turn.z**2))
    return float(place.x), float(place.y), heading_rad


def _velocity(message: Any) -> tuple[float, float, float]:
    for _ in range(2):
        message = getattr(message, "twist", message)
    return float(message.linear.x), float(message.linear.y), float(message.angular.z)


def _moved(last: tuple[float, ...], now: tuple[float, ...], use: str) -> list[float]:
    """A row of odometry: time; then motion forward, turn, and motion to the left since the previous message."""
    before_s, *before = last
    time_s, *values = now
    if use == "twist":
        ahead, left, rate = (value * (time_s - before_s) for value in before)
        return [time_s, ahead, rate, left]
    turn_rad = wrap_pi(values[2] - before[2])
    dx, dy, middle = values[0] - before[0], values[1] - before[1], before[2] + 0.5 * turn_rad
    return [time_s, cos(middle) * dx + sin(middle) * dy, turn_rad, cos(middle) * dy - sin(middle) * dx]
