"""Data of a recorded survey for its report, and their reader. The run may be complete, running or killed.

Unreadable parts are reported and left out. Only a directory without a run, or a configuration that this program cannot
use, is an error. Nothing is written. Raw sensor samples, nine tenths of a recording, are not read.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ccatp.config.files import read_text
from ccatp.config.load import kind_in, load_config
from ccatp.config.models import Config
from ccatp.core import FloatArray, Measured, PanelId, Vector3
from ccatp.links.bus_codec import BadMessage
from ccatp.links.topics import ArrivalMessage, FixMessage, MissionStatus
from ccatp.mirror.mirror import Mirror, build_mirror, deck_rows
from ccatp.mirror.surface import MirrorError
from ccatp.missions import SURVEY, MissionKind
from ccatp.records.recorder import TELEMETRY, damage_text, decode_recorded, read_metadata, recordings
from ccatp.records.run_reader import (
    CONFIG,
    STORE,
    RunReadError,
    Trace,
    began_simulated,
    check_format,
    check_run_dir,
    read_truth,
    trace_of_truth,
)
from ccatp.records.run_time import RecordingPlace, places_of
from ccatp.records.state_log import LogLine, StateChange, changes_of, is_in_progress, read_log
from ccatp.records.store import StoredPoint, StoreError, read_survey
from ccatp.records.timeline import Timeline, first_of_each, iter_places, read_timeline
from ccatp.survey.ending import AlarmAtEnd

COMPLETE = "complete"
WITHIN_MM = 10.0  # the thesis's requirement on arrivals
SUMMARY, LOG = "summary.json", "log.jsonl"
TOPICS_READ = frozenset(("track", "truth", "arrival", "fix", "mission"))


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSession:
    """One recording; a run that was resumed has several.

    Frames and times of all its parts are on the axis of the recording, see ``ccatp.records.timeline``.
    """

    name: str
    number: int  # of the recording, from 1
    offset_s: float  # time of the run less mission time of the recording
    version: str
    track: Trace  # the estimates
    sigma_m: FloatArray  # largest standard deviation of the place in any direction, shape (k,)
    truth: Trace | None  # None on a real robot
    arrivals: tuple[ArrivalMessage, ...]
    fixes: tuple[FixMessage, ...]
    statuses: tuple[MissionStatus, ...]
    changes: tuple[StateChange, ...]  # from the log; empty if the log does not have them in order

    @property
    def span_s(self) -> float:
        """Mission time from the first frame to the last one."""
        return float(self.track.t_s[-1] - self.track.t_s[0]) if len(self.track.t_s) else 0.0


class PointOutcome(NamedTuple):
    """Outcome of a run in a few words, by whom and why if recorded, whether it is complete, and alarms at its end."""

    text: str
    cause: str
    is_good: bool
    alarms: Sequence[AlarmAtEnd] = ()


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RunFiles:
    """Files and data of every run, independent of the type of its mission."""

    name: str
    config_text: str
    changed: Mapping[str, tuple[object, object]]  # keys that differ from the shipped configuration: both values
    is_simulation: bool | None
    summary: Mapping[str, Any] | None
    recordings: tuple[RecordingPlace, ...]
    log: tuple[LogLine, ...]
    files: Mapping[str, int]  # sizes in bytes
    missing: tuple[str, ...]  # parts of a complete run that this run lacks, one line each
    warnings: tuple[str, ...]

    @property
    def when(self) -> str:
        """Time of the first and of the last line of the log, UTC; empty if there is none."""
        times = [line.wall[:19].replace("T", " ") + " UTC" for line in self.log if line.wall]
        return f"{times[0]} to {times[-1]}" if times else ""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SurveyFiles(RunFiles):
    """A survey."""

    cfg: Config
    mirror: Mirror
    sessions: tuple[RecordedSession, ...]
    points: tuple[StoredPoint, ...] | None  # by row, column and number; None without a mission database
    measured: tuple[Measured, ...]
    injected: Mapping[PanelId, Vector3] | None  # piston (m), tip and tilt (rad) of the simulated panels

    @property
    def last_status(self) -> MissionStatus | None:
        """The last status of the mission."""
        statuses = [status for session in self.sessions for status in session.statuses]
        return statuses[-1] if statuses else None

    @property
    def has_truth(self) -> bool:
        """Whether every recording with frames has the simulated truth."""
        driven = [session for session in self.sessions if len(session.track.seq)]
        return bool(driven) and all(session.truth is not None for session in driven)


def read_record(run_dir: Path) -> SurveyFiles:
    """Read the data for the report of a survey.

    Raises RunReadError: no such directory, no run in it, or no survey; ConfigError: its configuration cannot be used.
    """
    kind = kind_of_run(run_dir)
    if SURVEY not in kind.systems:
        raise RunReadError(f"{run_dir}: a {kind.title}; this is for surveys, ccatp report takes both")
    cfg = load_config(run_dir / CONFIG)
    mirror = build_mirror(cfg.mirror)
    folder = RunFolder(run_dir, "log of the processes, and when the mission changed its state")
    found = folder.recordings(TOPICS_READ, _COLUMNS, "path, estimates, arrivals and fixes over time")
    all_changes = changes_of(folder.log, len(found))
    # The log names frames by the robot's own numbers, which are those of the axis until it restarts.
    sessions = [
        _session(one, place, mirror, () if one.timeline.has_restart else changes, folder.warnings)
        for one, place, changes in zip(found, folder.places, all_changes, strict=True)
        if one is not None
    ]
    if found and folder.log and not all(session.changes for session in sessions):
        why = "the time budget is taken from the status, which is coarser"
        folder.missing.append(f"the frames of each change of state: {why}")
    if folder.is_simulation and not any(session.truth for session in sessions):
        folder.missing.append("the simulated truth: errors are those that the laser saw")
    points, measured = _survey(folder, mirror)
    injected, _ = read_truth(run_dir, folder.warnings)
    return SurveyFiles(
        cfg=cfg,
        mirror=mirror,
        sessions=tuple(sessions),
        points=points,
        measured=measured,
        injected=injected,
        changed=changed_from_shipped(cfg),
        **folder.fields(),
    )


def changed_from_shipped(cfg: Config) -> dict[str, tuple[object, object]]:
    """``changed_keys`` of a survey, without mirror and world, which have names of their own."""
    ours, shipped = (one.model_dump(mode="json", exclude={"mirror", "world"}) for one in (cfg, load_config()))
    return changed_keys(ours, shipped)


def kind_of_run(run_dir: Path) -> MissionKind:
    """The kind of mission of a run. Raises RunReadError, ConfigError: no run, or it cannot be read."""
    check_run_dir(run_dir)
    return kind_in(run_dir / CONFIG)


def changed_keys(
    ours: Mapping[str, Any], shipped: Mapping[str, Any], prefix: str = ""
) -> dict[str, tuple[object, object]]:
    """Keys of a configuration whose values differ: own and shipped value, None if there is none."""
    found: dict[str, tuple[object, object]] = {}
    for key in dict.fromkeys((*ours, *shipped)):
        one, other = ours.get(key), shipped.get(key)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            found |= changed_keys(one, other, f"{prefix}{key}.")
        elif one != other:
            found[prefix + key] = (one, other)
    for name, server in {} if prefix else ours.get("sim", {}).items():
        if isinstance(server, Mapping) and server.get("port") == 0:  # any free one, another in each run
            found = {key: pair for key, pair in found.items() if key not in (f"{name}.port", f"sim.{name}.port")}
    return found


class RecordedMessages(NamedTuple):
    """The messages of a recording by topic, on its axis, and its metadata."""

    name: str
    messages: dict[str, list[Any]]
    version: str
    timeline: Timeline


class RunFolder:
    """Reads the parts that every mission has; collects missing and unreadable parts."""

    def __init__(self, run_dir: Path, log_holds: str) -> None:
        self.run_dir = run_dir
        self.is_simulation = began_simulated(run_dir)  # or as the last recording says
        self.missing: list[str] = []
        self.warnings: list[str] = []
        self.places: tuple[RecordingPlace, ...] = ()  # of the recordings that were read
        self.log = [*read_log(run_dir / LOG, self.warnings)]
        if not self.log:
            self.missing.append(f"{LOG}: {log_holds}")

    def fields(self) -> dict[str, Any]:
        """The fields of ``RunFiles``; call it after everything else has been read."""
        return {
            "name": self.run_dir.resolve().name,
            "is_simulation": self.is_simulation,
            "config_text": (self.run_dir / CONFIG).read_text(encoding="utf-8", errors="replace"),
            "summary": self._summary(self.run_dir / SUMMARY),
            "recordings": self.places,
            "log": tuple(line.shown for line in self.log if line.shown is not None),
            # The report is not part of the run, so that a repeated report is the same.
            "files": {
                path.name: path.stat().st_size
                for path in sorted(self.run_dir.iterdir())
                if path.is_file() and not path.name.startswith(".") and path.suffix != ".html"
            },
            "missing": tuple(self.missing),
            "warnings": tuple(self.warnings),
        }

    def _summary(self, path: Path) -> Mapping[str, Any] | None:
        try:
            if isinstance(found := json.loads(read_text(path)), dict):
                if not is_in_progress(self.log):
                    return found
                self.missing.append(
                    f"{path.name}: it is of an earlier session; the last one is in progress or was killed"
                )
                return None
            self.warnings.append(f"{path.name}: is no summary")
        except FileNotFoundError:
            self.missing.append(f"{path.name}: the run is in progress, or was killed before its end")
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) and error.strerror else "damaged"
            self.warnings.append(f"{path.name}: cannot be read: {why}")
        return None

    def recordings(
        self, topics: Iterable[str], columns: Mapping[str, int], holds: str
    ) -> list[RecordedMessages | None]:
        """All recordings, without their damaged parts; None in place of an unreadable one.

        Messages of topics in ``columns`` are tables and become arrays of shape (k, columns).
        """
        paths = recordings(self.run_dir / TELEMETRY)
        if not paths:
            self.missing.append(f"{TELEMETRY}: {holds}")
        found = [self._recording(path, topics, columns) for path in paths]
        timelines = (None if one is None else one.timeline for one in found)
        self.places = places_of(zip((path.name for path in paths), timelines, strict=True))
        return found

    def _recording(self, path: Path, topics: Iterable[str], columns: Mapping[str, int]) -> RecordedMessages | None:
        found: dict[str, list[Any]] = {topic: [] for topic in topics}
        lost = list[str]()
        try:
            metadata = read_metadata(path)
            check_format(path, metadata)
            timeline = read_timeline(path, is_simulation=metadata.get("simulation") == "true")
            for place, topic, _, payload in iter_places(path):
                if topic not in found:
                    continue
                try:
                    message: Any = timeline.on_axis(place, decode_recorded(topic, payload))
                    if topic in columns:
                        message = np.array(message.rows, dtype=np.float64).reshape(-1, columns[topic])
                    found[topic].append(message)
                except (BadMessage, ValueError) as error:
                    lost.append(str(error))
        except OSError as error:
            self.warnings.append(f"{path.name}: cannot be read: {error.strerror or error}")
            return None
        self.warnings += [damage_text(path, damage) for damage in timeline.damages]
        self.warnings += [f"{path.name}: {note}" for note in timeline.notes]
        if timeline.missing:
            self.warnings.append(f"{path.name}: {timeline.missing} frames are missing in between")
        if lost:
            self.warnings.append(f"{path.name}: {len(lost)} messages cannot be read and are not used: {lost[0]}")
        if (mark := metadata.get("simulation")) is not None:
            self.is_simulation = mark == "true"
        return RecordedMessages(path.name, found, metadata.get("ccatp", "unknown"), timeline)


def joined(batches: Sequence[FloatArray], columns: int, needed: int) -> FloatArray:
    """One table with increasing and unique frames, without rows whose first ``needed`` columns are not finite."""
    rows = np.concatenate(batches) if batches else np.empty((0, columns))
    rows = rows[np.isfinite(rows[:, :needed]).all(axis=1)]
    return np.asarray(rows[first_of_each(rows[:, 0])])


_COLUMNS = {"track": 8, "truth": 11}


def _session(
    found: RecordedMessages,
    place: RecordingPlace,
    mirror: Mirror,
    changes: Sequence[StateChange],
    warnings: list[str],
) -> RecordedSession:
    messages = found.messages
    track, truth = (joined(messages[topic], count, count) for topic, count in _COLUMNS.items())
    try:
        deck = deck_rows(mirror, track[:, 2:4].astype(np.int64).tolist(), track[:, 4:7])
    except MirrorError as error:
        warnings.append(f"{found.name}: its estimates are not of this mirror and are not used: {error}")
        track, deck = track[:0], np.empty((0, 4))
    return RecordedSession(
        name=found.name,
        number=place.number,
        offset_s=place.offset_s,
        version=found.version,
        track=Trace(track[:, 0].astype(np.int64), track[:, 1], deck[:, :3], deck[:, 3]),
        sigma_m=track[:, 7],
        truth=trace_of_truth(truth) if messages["truth"] else None,
        arrivals=tuple(messages["arrival"]),
        fixes=tuple(messages["fix"]),
        statuses=tuple(messages["mission"]),
        changes=tuple(changes),
    )


def _survey(folder: RunFolder, mirror: Mirror) -> tuple[tuple[StoredPoint, ...] | None, tuple[Measured, ...]]:
    path = folder.run_dir / STORE
    if not path.is_file():
        folder.missing.append(f"{STORE}: points, their fixes, and the panel alignment")
        return None, ()
    try:
        stored = read_survey(path, mirror.name)
    except StoreError as error:
        folder.warnings.append(str(error).replace(f"{folder.run_dir}/", ""))
        return None, ()
    folder.warnings += stored.warnings
    return stored.points, stored.fixes
