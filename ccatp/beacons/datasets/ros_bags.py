"""A recorded run from a ROS bag (``.bag``, ``.db3``, ``.mcap``, a ROS 2 folder), with a file that names its topics.

Needs the extra ``ros`` (rosbags). It reads the message definitions in the bag, so topics of any type are accepted.
"""

import tomllib
from collections.abc import Iterator
from contextlib import closing
from math import atan2
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from ccatp.beacons.datasets.events import Recording, name_of
from ccatp.beacons.datasets.tables import RadioDataError, tables_of
from ccatp.config.files import read_input
from ccatp.config.models import Model

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
    tag: str = ""  # field with the name of the vehicle's radio,
    of_tag: str = ""  # or the name itself, if all readings of the topic are of one radio
    range: str = ""
    bearing: str = ""
    rssi: str = ""
    unit: Literal["m", "cm", "mm", "ft"] = "m"  # of the ranges


class TruthTopic(Model):
    """Poses, transforms or points of a reference."""

    topic: str


class MarkersTopic(Model):
    """Surveyed beacons as markers, each with a pose; the last message of a beacon counts."""

    topic: str
    each: str = "markers"  # field with the list of markers; empty: a message is one marker
    name: str = "id"  # field with the name of the beacon


class Topics(Model):
    """The topics of a bag, and data that it lacks."""

    odometry: OdometryTopic
    readings: list[ReadingsTopic]
    truth: TruthTopic | None = None
    markers: MarkersTopic | None = None
    antenna_m: _Place = (0.0, 0.0, 0.0)  # forward, left and up from the origin of the vehicle
    tags: dict[str, _Place] = Field(default_factory=dict)  # the same of each of several radios
    use_tag: str = ""  # the only one that is used; empty: all whose place is given
    beacons: dict[str, _Place] = Field(default_factory=dict)


UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}
Row = tuple[str, int, list[float]]


class _Found:
    """What the messages of a bag have: rows by kind, names of beacons and tags, surveyed places."""

    def __init__(self) -> None:
        self.numbers: dict[str, float] = {}
        self.tags: dict[str, float] = {}
        self.rows: list[Row] = []
        self.places: dict[str, tuple[float, ...]] = {}


def read_bag(path: Path, topics_file: Path | None) -> tuple[Recording, str]:
    """Read a run, and ``use_tag``. Times are those of the message headers, or of the recorder if there are none.

    Raises RadioDataError: rosbags is not installed, or the bag or its topics are invalid.
    """
    if topics_file is None:
        raise RadioDataError(path, "is a bag: give a TOML file that names its topics with --topics")
    topics, warnings = read_topics(topics_file), list[str]()
    found = _read(path, topics, warnings)
    rows = found.rows
    for name, place in {**found.places, **topics.beacons}.items():
        rows.append(("beacon", 0, [_number(found.numbers, name), *place, *[np.nan] * (3 - len(place))]))
    for name, place in topics.tags.items():
        rows.append(("tag", 0, [_number(found.tags, name), *place, *[0.0] * (3 - len(place))]))
    if any(topics.antenna_m):
        rows.append(("antenna", 0, [*topics.antenna_m, *[0.0] * (3 - len(topics.antenna_m))]))
    tables = tables_of(path, rows)
    if (poses := tables.get("pose")) is not None and np.isnan(poses.values[:, 3]).all():
        raise RadioDataError(path, f"{topics.odometry.topic} has no orientations: no odometry comes from it")
    names, tags = tuple(found.numbers), tuple(found.tags)
    return Recording(path, name_of(path), "csv", tables, names, tuple(warnings), tags), topics.use_tag


def read_topics(file: Path) -> Topics:
    """Read the file of topics. Raises RadioDataError: it is not valid."""
    try:
        return Topics.model_validate(tomllib.loads(read_input(file, _MOST_TOPICS_BYTES).decode()))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise RadioDataError(file, f"{where}: {first['msg'].lower()}") from error
    except OSError as error:
        raise RadioDataError(file, f"cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise RadioDataError(file, f"is no TOML: {error}") from error


def _number(numbers: dict[str, float], name: str) -> float:
    return numbers.setdefault(name, float(len(numbers)))


def _read(path: Path, topics: Topics, warnings: list[str]) -> _Found:
    found = _Found()
    wanted = {topics.odometry.topic, *(one.topic for one in topics.readings)}
    wanted |= {one.topic for one in (topics.truth, topics.markers) if one}
    for line, (topic, received_s, message) in enumerate(_messages(path, wanted, warnings), 1):
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        time_s = received_s if stamp is None else stamp.sec + 1e-9 * stamp.nanosec
        try:
            if topic == topics.odometry.topic and topics.odometry.use == "twist":
                ahead, left, rate = _velocity(message)
                found.rows.append(("speed", line, [time_s, ahead, rate, left]))
            elif topic == topics.odometry.topic:
                found.rows.append(("pose", line, [time_s, *_pose(message)]))
            if topics.truth is not None and topic == topics.truth.topic:
                found.rows.append(("truth", line, [time_s, *_pose(message)]))
            if topics.markers is not None and topic == topics.markers.topic:
                for one in _field(message, topics.markers.each) if topics.markers.each else [message]:
                    place = one.pose.position
                    found.places[str(_field(one, topics.markers.name))] = float(place.x), float(place.y), float(place.z)
            for each in topics.readings:
                if each.topic == topic:
                    _take_readings(each, message, time_s, line, found)
        except (ArithmeticError, AttributeError, TypeError, ValueError) as error:
            raise RadioDataError(path, f"message {line} of {topic} ({message.__msgtype__}): {error}") from error
    return found


def _take_readings(topic: ReadingsTopic, message: Any, time_s: float, line: int, found: _Found) -> None:
    for one in _field(message, topic.each) if topic.each else [message]:
        name = topic.name or str(_field(one, topic.beacon))
        tag = topic.of_tag or (str(_field(one, topic.tag)) if topic.tag else "")
        for kind in ("range", "bearing", "rssi"):
            if field := getattr(topic, kind):
                value = float(_field(one, field)) * (UNITS[topic.unit] if kind == "range" else 1.0)
                by = _number(found.tags, tag) if tag else np.nan
                found.rows.append((kind, line, [time_s, _number(found.numbers, name), value, by]))


def _messages(path: Path, wanted: set[str], warnings: list[str]) -> Iterator[tuple[str, float, Any]]:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError as error:
        raise RadioDataError(path, "is a bag: to read it, install ccatp with its extra, ccatp[ros]") from error
    types = get_typestore(Stores.ROS2_JAZZY)
    try:
        try:
            reader = AnyReader([path], default_typestore=types)
            reader.open()
        except AnyReaderError:
            if not (files := [path] if path.suffix == ".mcap" else sorted(path.glob("*.mcap"))):
                raise
            warnings.append("the bag has no index, as after a crash: its messages are read up to its end")
            for file in files:
                yield from _unindexed(file, wanted, types)
            return
        with closing(reader):
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


def _unindexed(file: Path, wanted: set[str], types: Any) -> Iterator[tuple[str, float, Any]]:
    """Messages of an mcap file of ROS 2 from its beginning, up to where it was cut."""
    from mcap.exceptions import EndOfFile  # noqa: PLC0415 -- only for such bags
    from mcap.reader import NonSeekingReader  # noqa: PLC0415
    from rosbags.typesys import get_types_from_msg  # noqa: PLC0415

    with file.open("rb") as stream:
        try:
            for schema, channel, message in NonSeekingReader(stream).iter_messages([*wanted], log_time_order=False):
                if schema is None:
                    continue
                if schema.name not in types.fielddefs:
                    types.register(get_types_from_msg(schema.data.decode(), schema.name))
                yield channel.topic, 1e-9 * message.log_time, types.deserialize_cdr(message.data, schema.name)
        except EndOfFile:
            return


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
