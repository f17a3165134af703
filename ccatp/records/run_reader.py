"""Reads a run directory: recordings with configuration, ordered events and poses; and the survey of a run."""

import json
import tempfile
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np

from ccatp.config.files import read_input, read_text
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import Fix, FloatArray, IntArray, Measured, PanelId, PointId, Vector3
from ccatp.errors import UsageError
from ccatp.links import topics
from ccatp.links.bus_codec import BadMessage
from ccatp.links.robot_codec import BadLine, decode_from_robot
from ccatp.links.robot_messages import Sensors
from ccatp.links.runtime_dir import ORIGIN_FILE
from ccatp.mirror.mirror import Mirror, deck_rows
from ccatp.records.recorder import (
    RECORD_FORMAT,
    TELEMETRY,
    decode_recorded,
    iter_logged,
    iter_messages,
    read_metadata,
    recordings,
)
from ccatp.records.store import StoreError, read_survey
from ccatp.records.timeline import Timeline, first_of_each, iter_places, read_timeline

Injected = dict[PanelId, Vector3]  # piston (m), tip and tilt (rad)


class Marked(NamedTuple):
    """A frame, and the treatment of the localizer in it; number and mission time as in ``ccatp.records.timeline``."""

    number: int
    t_s: float
    sensors: Sensors
    at_rest: bool
    begun: tuple[float, ...] | None = None  # before the frame it was reset, with these values of ``Treatment``
    is_odometry_off: bool = False  # the robot stands; wheels and inertial unit are not used
    doubted: tuple[float, ...] | None = None  # after the samples its uncertainty was increased by this, m and rad
    coasted: tuple[float, ...] | None = None  # predicted motion of the wheels, in place of samples


class Fixed(NamedTuple):
    """A fix after frame ``number``, which is at or before it; ``t_s`` is its mission time.

    ``fix`` has the time by the robot's clock. One that ``was_set_aside`` was doubted and never given to the localizer.
    """

    number: int
    t_s: float
    fix: Fix
    was_fused: bool
    was_set_aside: bool = False


Event = Marked | Fixed
Message = Sensors | topics.Rest | topics.FixMessage | topics.Treatment


class Placed(NamedTuple):
    """A recorded message on the axis of its recording: number and mission time of its frame."""

    number: int
    t_s: float
    message: Message


class RecordedFrame(NamedTuple):
    """A frame on the axis of its recording: number and mission time, the message, and its line."""

    number: int
    t_s: float
    sensors: Sensors
    line: bytes


def _frames(timeline: Timeline, place: int, message: topics.SensorLines) -> list[RecordedFrame]:
    decoded = [(decode_from_robot(line), line) for line in map(bytes, message.lines)]
    read = [(sensors, line) for sensors, line in decoded if isinstance(sensors, Sensors)]
    numbers = timeline.line_numbers(place, [sensors.seq for sensors, _ in read])
    times_s = timeline.times(np.array(numbers)).tolist()
    return [RecordedFrame(*at, *one) for at, one in zip(zip(numbers, times_s, strict=True), read, strict=True)]


def _fixed(number: int, t_s: float, message: topics.FixMessage) -> Fixed:
    fix = msgspec.convert(message, Fix, from_attributes=True)
    return Fixed(number, t_s, fix, message.is_fused, message.is_set_aside)


def in_order(messages: Iterable[Placed]) -> Iterator[Event]:
    """Frames, rests, treatments and fixes in the order in which the localizer received them.

    Frames are recorded in batches; rests and fixes at once, with the number of their frame, so they precede the batch
    of the next frame. A rest and a treatment belong into their frame, a fix after it. Fixes after a frame beyond the
    end of the record are left out. ``messages`` are in the order of recording.
    """
    rests: set[int] = set()
    treatments: dict[tuple[int, str], tuple[float, ...]] = {}
    is_odometry_off = False
    fixes: deque[Fixed] = deque()
    last = -1
    for number, t_s, message in messages:
        if isinstance(message, topics.Rest):
            rests.add(number)
        elif isinstance(message, topics.FixMessage):
            fixes.append(_fixed(number, t_s, message))
        elif isinstance(message, topics.Treatment):
            treatments[number, message.kind] = message.values
        else:
            while fixes and fixes[0].number < number:
                yield fixes.popleft()
            last = number
            begun = treatments.pop((last, "begun"), None)
            if (last, "odometry_off") in treatments or (last, "odometry_on") in treatments or begun is not None:
                is_odometry_off = (last, "odometry_off") in treatments
            doubted, coasted = treatments.pop((last, "doubted"), None), treatments.pop((last, "coasted"), None)
            yield Marked(number, t_s, message, last in rests, begun, is_odometry_off, doubted, coasted)
            rests.discard(last)
    while fixes and fixes[0].number <= last:
        yield fixes.popleft()


class Trace(NamedTuple):
    """Poses after k frames."""

    seq: IntArray  # numbers of the frames, growing, shape (k,)
    t_s: FloatArray  # mission time, shape (k,)
    pose: FloatArray  # deck x, y (m) and heading (rad), shape (k, 3)
    height_m: FloatArray  # of the surface there, deck frame, shape (k,)
    covariance: FloatArray | None = None  # of ``pose``, shape (k, 3, 3); None where it is not known

    @property
    def place(self) -> FloatArray:
        """Points on the surface, deck frame, m, shape (k, 3)."""
        return np.column_stack([self.pose[:, :2], self.height_m])


def format_tum(trace: Trace) -> str:
    """The trace as a trajectory of the TUM format: t_s x y z qx qy qz qw a line, deck frame, m, turned about z."""
    half = 0.5 * trace.pose[:, 2]
    zeros = np.zeros_like(half)
    rows = np.column_stack([trace.t_s, trace.place, zeros, zeros, np.sin(half), np.cos(half)])
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows.tolist())


class TraceBuilder:
    """Collects poses in panel frames, in little memory."""

    def __init__(self) -> None:
        self._names = array("q")  # frame, row, column
        self._rows = array("d")  # time, x, y, heading
        self._covariances = array("d")

    def add(self, seq: int, t_s: float, row: int, col: int, pose: tuple[float, float, float]) -> None:
        """Add a pose (x, y, heading) in the frame of panel (row, col)."""
        self._names.extend((seq, row, col))
        self._rows.extend((t_s, *pose))

    def add_covariance(self, covariance: FloatArray) -> None:
        """Of the pose added last, deck frame, shape (3, 3)."""
        self._covariances.extend(covariance.ravel().tolist())

    def build(self, mirror: Mirror) -> Trace:
        """The trace, in the deck frame."""
        names = np.array(self._names, dtype=np.int64).reshape(-1, 3)
        rows = np.array(self._rows).reshape(-1, 4)
        covariance = np.array(self._covariances).reshape(-1, 3, 3) if self._covariances else None
        first = first_of_each(names[:, 0])
        names, rows, covariance = names[first], rows[first], covariance if covariance is None else covariance[first]
        deck = deck_rows(mirror, names[:, 1:].tolist(), rows[:, 1:])
        return Trace(names[:, 0], rows[:, 0], deck[:, :3], deck[:, 3], covariance)


def trace_of_truth(rows: Sequence[Sequence[float]] | FloatArray) -> Trace:
    """The simulated truth; rows as in the topic ``truth``, on the axis of the recording."""
    table = np.asarray(rows, dtype=np.float64).reshape(-1, 11)
    table = table[first_of_each(table[:, 0])]
    return Trace(table[:, 0].astype(np.int64), table[:, 1], table[:, 2:5], table[:, 7])


_T = TypeVar("_T")
CONFIG = "config.toml"
STORE = "mission.sqlite"
# Topics that a replay needs; the others are not decoded.
READ = frozenset(("sensors", "rest", "treatment", "fix", "track", "truth", "arrival"))


class RunReadError(UsageError):
    """A run that cannot be read."""


@dataclass(slots=True)
class Recording:
    """One recording of a run; a run that was resumed has several, each from the robot's start at base."""

    path: Path
    metadata: Mapping[str, str]
    # What was left out. It is complete when ``messages`` has come to its end, as are the arrivals.
    warnings: list[str] = field(default_factory=list)
    arrivals: list[int] = field(default_factory=list)  # frames at which the robot stood at a point for the first time
    sessions_without_frames: Sequence[Path] = ()  # other recordings of the run, which are left out
    _track: TraceBuilder = field(default_factory=TraceBuilder)
    _truth: list[tuple[float, ...]] = field(default_factory=list)
    _timeline: Timeline | None = None

    @property
    def is_simulation(self) -> bool:
        """Robot and laser system were simulated."""
        return self.metadata.get("simulation") == "true"

    @property
    def timeline(self) -> Timeline:
        """Numbers and mission times of the frames; ``RunReadError``: the file cannot be read."""
        if self._timeline is None:
            self._timeline = _readable(self.path, lambda path: read_timeline(path, is_simulation=self.is_simulation))
        return self._timeline

    @property
    def notes(self) -> list[str]:
        """What a reader has to know: restarts of the robot, steps of its clock, sessions that are left out."""
        left_out = [f"{path}: not used, it holds no frame of the robot" for path in self.sessions_without_frames]
        return [*left_out, *(f"{self.path}: {note}" for note in self.timeline.notes)]

    def has_frames(self) -> bool:
        """The robot sent at least one frame; reads up to the first one."""
        return _readable(self.path, lambda path: any(message.topic == "sensors" for message in iter_messages(path)))

    def config(self, overrides: Mapping[str, object]) -> Config:
        """The recorded configuration with ``overrides``; raises ``ConfigError`` where it cannot be used."""
        beside = self.path.with_name(CONFIG)
        kept = self.metadata.get("config")
        if kept is None or (beside.is_file() and _readable(beside, read_input).decode(errors="replace") == kept):
            return load_config(beside, overrides)
        # A later session of a resumed run has written its own.
        with tempfile.TemporaryDirectory(prefix="ccatp-replay-") as folder:
            file = Path(folder) / CONFIG
            file.write_text(kept, encoding="utf-8")
            return load_config(file, overrides)

    def messages(self) -> Iterator[Placed]:
        """Frames, rests and fixes in the order of recording; estimates and truth are collected on the way.

        A frame that was received twice comes twice, as to the localizer.
        """
        timeline, lost = self.timeline, list[str]()
        last_s = float(timeline.t_s[-1]) if len(timeline.t_s) else 0.0
        self.warnings += [f"{damage}; its last frame is of {last_s:.2f} s" for damage in timeline.damages]
        if timeline.missing:
            self.warnings.append(f"{self.path}: {timeline.missing} frames are missing in between")
        for place, topic, _, payload in iter_places(self.path):
            if topic not in READ:
                continue
            try:
                yield from self._take(timeline, place, decode_recorded(topic, payload))
            except (BadMessage, BadLine) as error:
                lost.append(str(error))
        if lost:
            what = f"{len(lost)} messages" if len(lost) > 1 else "a message"
            self.warnings.append(f"{self.path}: what cannot be read is not used: {what}, {lost[0]}")

    def _take(self, timeline: Timeline, place: int, message: object) -> list[Placed]:
        if isinstance(message, topics.SensorLines):
            return [Placed(number, t_s, sensors) for number, t_s, sensors, _ in _frames(timeline, place, message)]
        if isinstance(message, topics.Rest | topics.Treatment | topics.FixMessage):
            number = timeline.number_at(place, message.seq)
            return [Placed(number, timeline.at(number), message)]
        if not isinstance(message, topics.TrackMessage | topics.TruthMessage | topics.ArrivalMessage):
            return []
        placed = timeline.on_axis(place, message)
        if isinstance(placed, topics.TrackMessage):
            for seq, t_s, row, col, x_m, y_m, heading_rad, _ in placed.rows:
                self._track.add(seq, t_s, row, col, (x_m, y_m, heading_rad))
        elif isinstance(placed, topics.TruthMessage):
            self._truth += placed.rows
        else:
            self.arrivals.append(placed.seq)
        return []

    def frames(self) -> Iterator[RecordedFrame]:
        """Frames with growing numbers; what cannot be read is counted in ``warnings`` at the end."""
        timeline, last, lost = self.timeline, -1, list[str]()
        for place, topic, _, payload in iter_places(self.path):
            if topic != "sensors":
                continue
            try:
                message = decode_recorded(topic, payload)
                found = _frames(timeline, place, message) if isinstance(message, topics.SensorLines) else []
            except (BadMessage, BadLine) as error:
                lost.append(str(error))
                continue
            for frame in found:
                if frame.number > last:
                    yield frame
                    last = frame.number
        if lost:
            self.warnings.append(f"{self.path}: {len(lost)} batches of frames cannot be read: {lost[0]}")

    def recorded(self, mirror: Mirror) -> Trace:
        """The estimates of the run itself."""
        return self._track.build(mirror)

    def truth(self) -> Trace | None:
        """The simulated truth, where there is one."""
        return trace_of_truth(self._truth) if self._truth else None


def check_run_dir(run_dir: Path, file: str = CONFIG) -> None:
    """``RunReadError``: there is no such directory, or no such file of a run in it."""
    if not run_dir.is_dir():
        raise RunReadError(f"{run_dir}: no such directory; name the directory of a run")
    if not (recordings(run_dir / file) if file == TELEMETRY else (run_dir / file).is_file()):
        raise RunReadError(f"{run_dir}: no {file} there; name the directory of a run")


def open_recordings(path: Path) -> list[Recording]:
    """The recordings of a run directory, oldest first, or the one that is named; ``RunReadError``: none can be read.

    A session that was refused, or that ended before it had reached the robot, has recorded no frame. It is left out
    where another session has frames.
    """
    if path.is_file():
        return [_open(path)]
    check_run_dir(path, TELEMETRY)
    parts = [_open(part) for part in recordings(path / TELEMETRY)]
    with_frames = [part for part in parts if part.has_frames()]
    if not with_frames:
        return parts
    with_frames[-1].sessions_without_frames = [part.path for part in parts if part not in with_frames]
    return with_frames


def check_format(path: Path, metadata: Mapping[str, str]) -> None:
    """Raises ``RunReadError``: a newer version wrote the recording, and this one would misunderstand it."""
    number = metadata.get("format", "0")
    if not number.isdecimal() or int(number) > RECORD_FORMAT:
        raise RunReadError(
            f"{path}: recorded in format {number} by ccatp {metadata.get('ccatp', 'unknown')}, this one reads "
            f"up to {RECORD_FORMAT}: read it with a newer ccatp"
        )


def _open(path: Path) -> Recording:
    metadata = _readable(path, read_metadata)
    if not metadata:
        raise RunReadError(f"{path}: no recording of a run; name a telemetry.mcap, or the directory of a run")
    check_format(path, metadata)
    if "config" not in metadata:
        check_run_dir(path.parent)
    return Recording(path, metadata)


def _readable(path: Path, read: Callable[[Path], _T]) -> _T:
    try:
        return read(path)
    except OSError as error:
        raise RunReadError(f"{path}: cannot be read: {error.strerror or error}") from error


class RecordedSurvey(NamedTuple):
    """A run's survey; ``injected``: simulated misalignment of the panels, None on a real robot or if not recorded."""

    cfg: Config
    planned: tuple[PointId, ...]
    measured: tuple[Measured, ...]
    injected: Injected | None
    is_simulation: bool | None
    warnings: tuple[str, ...]


def read_run(run_dir: Path, overrides: Mapping[str, object]) -> RecordedSurvey:
    """Read the survey of a run directory without changing it; ``overrides`` are dotted keys of the configuration.

    ``RunReadError``: no such directory, or no run in it, or a database that cannot be read; ``ConfigError``: its
    configuration cannot be used.
    """
    check_run_dir(run_dir)
    cfg = load_config(run_dir / CONFIG, overrides)
    try:
        stored = read_survey(run_dir / STORE, cfg.mirror.name)
    except StoreError as error:
        raise RunReadError(str(error)) from error
    warnings = [*stored.warnings]
    injected, is_simulation = read_truth(run_dir, warnings)
    return RecordedSurvey(
        cfg, tuple(row.point for row in stored.points), stored.fixes, injected, is_simulation, tuple(warnings)
    )


def read_truth(run_dir: Path, warnings: list[str]) -> tuple[Injected | None, bool | None]:
    """The simulated misalignment of the panels, and whether they were simulated; defects are added to ``warnings``."""
    found: list[Injected] = []
    is_simulation = began_simulated(run_dir)
    for path in recordings(run_dir / TELEMETRY):
        try:
            if (mark := read_metadata(path).get("simulation")) is not None:  # it may be damaged
                is_simulation = mark == "true"
            injected = _injected(path) if is_simulation else None
        except OSError as error:
            warnings.append(f"{path}: cannot be read: {error.strerror or error}; the truth is not compared")
            continue
        if injected is not None:
            found.append(injected)
    if any(one != found[0] for one in found):
        warnings.append("the sessions of this run simulated differently misaligned panels; the truth is not compared")
        return None, is_simulation
    return (found[0] if found else None), is_simulation


def began_simulated(run_dir: Path) -> bool | None:
    """Whether a run began in simulation; ``None`` where that is not known, as in runs of older versions."""
    try:
        mark = json.loads(read_text(run_dir / ORIGIN_FILE))["simulation"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return mark if isinstance(mark, bool) else None


def begun_utc_ns(run_dir: Path) -> int | None:
    """When the recording of a run begins, ns since 1970; None where that is not known."""
    for path in recordings(run_dir / TELEMETRY):
        for utc_offset_ns, message in iter_logged(path):
            return None if utc_offset_ns is None else utc_offset_ns + round(1e9 * message.t_s)
    return None


def _injected(path: Path) -> Injected | None:
    for topic, _, payload in iter_messages(path):
        if topic == "truth":  # before the misalignment: an older recording, which does not have it
            break
        if topic == "misalignment":
            with suppress(BadMessage):
                message = decode_recorded(topic, payload)
                if isinstance(message, topics.Misalignment):
                    return {PanelId(row, col): (piston, tip, tilt) for row, col, piston, tip, tilt in message.panels}
            break
    return None
