"""Reads the run directory of a survey or a beacon mission for a report: a run that is complete, running or killed.

What cannot be read is reported and left out; only a directory without a run, or a configuration that this program
cannot use, is refused. Nothing is written. Raw sensor samples, nine tenths of a recording, are not read.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.load import is_radio_file, load_config, load_radio_config
from ccatp.config.models import Config
from ccatp.core import FloatArray, PointId
from ccatp.links.beacon_messages import TRACK_COLUMNS, TRUTH_COLUMNS, pose_track, pose_truth, table, truth_in
from ccatp.links.topics import (
    ArrivalMessage,
    BadMessage,
    BeaconArrival,
    BeaconMapMessage,
    BeaconPlaces,
    BeaconTrack,
    BeaconTruth,
    DangerEvent,
    FixMessage,
    Message,
    MissionStatus,
    TrackMessage,
    TruthMessage,
    decode_recorded,
)
from ccatp.mirror.mirror import Mirror, build_mirror, deck_rows
from ccatp.mirror.panel_alignment import Measured
from ccatp.mirror.surface import MirrorError
from ccatp.records.recorder import damage_text, iter_messages, read_metadata, recordings
from ccatp.records.run_reader import CONFIG, TELEMETRY, RunReadError
from ccatp.records.state_log import ReadLine, StateChange, changes_of, read_log
from ccatp.records.store import read_survey
from ccatp.records.store_rows import StoreError, point_name
from ccatp.records.survey_reader import STORE, read_truth
from ccatp.report.record import (
    Arrived,
    BeaconRecord,
    EstimatedTrack,
    PlannedRow,
    RecordedSession,
    RunRecord,
    TrueTrack,
    changed_keys,
)

TOPICS_READ = frozenset(("track", "truth", "arrival", "fix", "mission", "danger_event"))
_TRACK_COLUMNS, _TRUTH_COLUMNS = 8, 11


class _Collected:
    def __init__(self) -> None:
        self.track: list[FloatArray] = []
        self.truth: list[FloatArray] = []
        self.arrivals: list[Arrived] = []
        self.fixes: list[FixMessage] = []
        self.statuses: list[MissionStatus] = []
        self.verdicts: list[DangerEvent] = []

    def take(self, message: object) -> None:
        if isinstance(message, TrackMessage):
            self.track.append(np.array(message.rows, dtype=np.float64).reshape(-1, _TRACK_COLUMNS))
        elif isinstance(message, TruthMessage):
            self.truth.append(np.array(message.rows, dtype=np.float64).reshape(-1, _TRUTH_COLUMNS))
        elif isinstance(message, ArrivalMessage):
            self.arrivals.append(Arrived(PointId(*message.point), message.seq, message.t_s, message.error_mm))
        elif isinstance(message, FixMessage):
            self.fixes.append(message)
        elif isinstance(message, MissionStatus):
            self.statuses.append(message)
        elif isinstance(message, DangerEvent):
            self.verdicts.append(message)


def read_session(path: Path, mirror: Mirror, changes: Sequence[StateChange], warnings: list[str]) -> RecordedSession:
    """Read a recording up to its end or its first damage.

    Args:
        changes: of the mission's state in this session, from the log.

    Raises:
        OSError: it cannot be read at all.
    """
    found, damages, lost = _Collected(), list[str](), list[str]()
    metadata = read_metadata(path)
    for topic, _, payload in iter_messages(path, damages.append):
        if topic not in TOPICS_READ:
            continue
        try:
            message: Message | object = decode_recorded(topic, payload)
            found.take(message)
        except (BadMessage, ValueError) as error:
            lost.append(str(error))
    warnings += [damage_text(path, damage) for damage in damages]
    if lost:
        warnings.append(f"{path.name}: {len(lost)} messages cannot be read and are left out: {lost[0]}")
    return RecordedSession(
        name=path.name,
        version=metadata.get("ccatp", "unknown"),
        track=_track(found.track, mirror, path.name, warnings),
        truth=_truth(found.truth),
        arrivals=tuple(found.arrivals),
        fixes=tuple(found.fixes),
        statuses=tuple(found.statuses),
        verdicts=tuple(found.verdicts),
        changes=tuple(changes),
    )


def _track(batches: Sequence[FloatArray], mirror: Mirror, name: str, warnings: list[str]) -> EstimatedTrack:
    rows = _ordered(batches, _TRACK_COLUMNS)
    try:
        deck = deck_rows(mirror, rows[:, 2:4].astype(np.int64), rows[:, 4:7])
    except MirrorError as error:
        warnings.append(f"{name}: its estimates are not of this mirror and are left out: {error}")
        rows, deck = rows[:0], np.empty((0, 4))
    return EstimatedTrack(rows[:, 0].astype(np.int64), rows[:, 1], deck[:, [0, 1, 3]], deck[:, 2], rows[:, 7])


def _truth(batches: Sequence[FloatArray]) -> TrueTrack | None:
    if not batches:
        return None
    rows = _ordered(batches, _TRUTH_COLUMNS)
    return TrueTrack(rows[:, 0].astype(np.int64), rows[:, 1], rows[:, 5:8], rows[:, 4], rows[:, 8])


def _ordered(batches: Sequence[FloatArray], columns: int) -> FloatArray:
    """One table, the frames growing: a frame that was recorded twice counts once."""
    rows = np.concatenate(batches) if batches else np.empty((0, columns))
    rows = rows[np.isfinite(rows).all(axis=1)]
    _, first = np.unique(rows[:, 0], return_index=True)
    return np.asarray(rows[first])


SUMMARY, LOG = "summary.json", "log.jsonl"


def read_record(run_dir: Path) -> RunRecord:
    """Everything that a report shows of a run.

    Raises:
        RunReadError: no such directory, no run in it, or none of a survey.
        ConfigError: its configuration cannot be used.
    """
    if is_beacon_run(run_dir):
        raise RunReadError(f"{run_dir}: a mission among beacons; this is for surveys, ccatp report takes both")
    cfg = load_config(run_dir / CONFIG)
    mirror = build_mirror(cfg.mirror)
    missing: list[str] = []
    warnings: list[str] = []
    log = list(read_log(run_dir / LOG, warnings))
    if not log:
        missing.append(f"{LOG}: what the processes said, and when the mission changed its state")
    sessions, is_simulation = _sessions(run_dir, mirror, log, missing, warnings)
    points, measured = _survey(run_dir, mirror, missing, warnings)
    injected, _ = read_truth(run_dir, warnings)
    return RunRecord(
        name=run_dir.resolve().name,
        cfg=cfg,
        config_text=(run_dir / CONFIG).read_text(encoding="utf-8", errors="replace"),
        changed=_changed(cfg),
        mirror=mirror,
        is_simulation=is_simulation,
        summary=read_summary(run_dir / SUMMARY, missing, warnings),
        sessions=sessions,
        points=points,
        measured=measured,
        injected=injected,
        log=tuple(line.shown for line in log if line.shown is not None),
        files=files_of(run_dir),
        missing=tuple(missing),
        warnings=tuple(warnings),
    )


def is_beacon_run(run_dir: Path) -> bool:
    """Whether a run is a mission among beacons.

    Raises:
        RunReadError: no such directory, or no run in it.
        ConfigError: its configuration cannot be read.
    """
    if not run_dir.is_dir():
        raise RunReadError(f"{run_dir}: no such directory; name the directory of a run")
    if not (run_dir / CONFIG).is_file():
        raise RunReadError(f"{run_dir}: no {CONFIG} there; name the directory of a run")
    return is_radio_file(run_dir / CONFIG)


def _changed(cfg: Config) -> dict[str, tuple[object, object]]:
    """Keys other than as shipped, but for mirror and world, which have names of their own."""
    own = {"mirror", "world"}
    ours, shipped = (one.model_dump(mode="json", exclude=own) for one in (cfg, load_config()))
    return changed_keys(ours, shipped)


def _sessions(
    run_dir: Path, mirror: Mirror, log: list[ReadLine], missing: list[str], warnings: list[str]
) -> tuple[tuple[RecordedSession, ...], bool | None]:
    paths = recordings(run_dir / TELEMETRY)
    if not paths:
        missing.append(f"{TELEMETRY}: path, estimates, arrivals and fixes over time")
        return (), None
    sessions, is_simulation = [], None
    for path, changes in zip(paths, changes_of(log, len(paths)), strict=True):
        try:
            is_simulation = {"true": True, "false": False}.get(read_metadata(path).get("simulation", ""), is_simulation)
            sessions.append(read_session(path, mirror, changes, warnings))
        except OSError as error:
            warnings.append(f"{path.name}: cannot be read: {error.strerror or error}")
    if log and not all(session.changes for session in sessions):
        missing.append("the frames of each change of state: the time budget is taken from the status, which is coarser")
    if is_simulation and not any(session.truth for session in sessions):
        missing.append("the simulated truth: errors are those that the laser saw")
    return tuple(sessions), is_simulation


def _survey(
    run_dir: Path, mirror: Mirror, missing: list[str], warnings: list[str]
) -> tuple[tuple[PlannedRow, ...] | None, tuple[Measured, ...]]:
    if not (run_dir / STORE).is_file():
        missing.append(f"{STORE}: points, their fixes, and how the panels lie")
        return None, ()
    try:
        stored = read_survey(run_dir / STORE, mirror.name)
    except StoreError as error:
        warnings.append(str(error).replace(f"{run_dir}/", ""))
        return None, ()
    warnings += [
        f"point {point_name(point)}: its stored fix is damaged and left out; measure it again"
        for point in stored.damaged
    ]
    points = tuple(PlannedRow(row.point, row.status, row.t_s) for row in stored.points)
    return points, tuple(Measured(one.point, one.fix) for one in stored.fixes)


def read_summary(path: Path, missing: list[str], warnings: list[str]) -> Mapping[str, Any] | None:
    """``summary.json``; None where there is none, or none that can be read, and a line that says so."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        missing.append(f"{path.name}: the run goes on, or was killed before its end")
        return None
    except (OSError, ValueError) as error:
        warnings.append(f"{path.name}: cannot be read: {error}")
        return None
    if not isinstance(found, dict):
        warnings.append(f"{path.name}: is no summary")
        return None
    return found


def files_of(run_dir: Path) -> dict[str, int]:
    """Names and sizes in bytes of what a run wrote."""
    return dict(_files(run_dir))


def _files(run_dir: Path) -> Iterator[tuple[str, int]]:
    for path in sorted(run_dir.iterdir()):
        # The report is no part of the run: it is the same when it is made again.
        if path.is_file() and not path.name.startswith(".") and path.suffix != ".html":
            yield path.name, path.stat().st_size


BEACON_TOPICS_READ = frozenset(
    ("beacon_track", "beacon_truth", "beacon_map", "beacon_arrival", "beacon_places", "mission", "danger_event")
)


def read_beacon_record(run_dir: Path) -> BeaconRecord:
    """Everything that a report shows of a mission among beacons.

    Raises:
        ConfigError: its configuration cannot be used.
    """
    cfg = load_radio_config(run_dir / CONFIG)
    missing: list[str] = []
    warnings: list[str] = []
    log = list(read_log(run_dir / LOG, warnings))
    if not log:
        missing.append(f"{LOG}: what the processes said")
    found = _BeaconMessages()
    paths = recordings(run_dir / TELEMETRY)
    if not paths:
        missing.append(f"{TELEMETRY}: path, map and readings over time")
    for path in paths:
        found.read(path, warnings)
    if found.is_simulation and paths and not found.truth:
        missing.append("the simulated truth: errors are not known")
    track = _rows_of(found.track, TRACK_COLUMNS)
    return BeaconRecord(
        name=run_dir.resolve().name,
        version=found.version,
        cfg=cfg,
        config_text=(run_dir / CONFIG).read_text(encoding="utf-8", errors="replace"),
        changed=_changed_keys(cfg),
        is_simulation=found.is_simulation,
        summary=read_summary(run_dir / SUMMARY, missing, warnings),
        track=pose_track(track),
        truth=truth_in(pose_truth(_rows_of(found.truth, TRUTH_COLUMNS)), track[:, 0]) if found.truth else None,
        maps=tuple(found.maps),
        arrivals=tuple(found.arrivals),
        statuses=tuple(found.statuses),
        verdicts=tuple(found.verdicts),
        places=found.places,
        log=tuple(line.shown for line in log if line.shown is not None),
        files=files_of(run_dir),
        missing=tuple(missing),
        warnings=tuple(warnings),
    )


class _BeaconMessages:
    def __init__(self) -> None:
        self.version = "unknown"
        self.is_simulation: bool | None = None
        self.track: list[FloatArray] = []
        self.truth: list[FloatArray] = []
        self.maps: list[BeaconMapMessage] = []
        self.arrivals: list[BeaconArrival] = []
        self.statuses: list[MissionStatus] = []
        self.verdicts: list[DangerEvent] = []
        self.places: dict[str, tuple[float, float]] = {}

    def read(self, path: Path, warnings: list[str]) -> None:
        """One recording, up to its end or its first damage."""
        damages, lost = list[str](), list[str]()
        try:
            metadata = read_metadata(path)
            self.version = metadata.get("ccatp", self.version)
            told = {"true": True, "false": False}.get(metadata.get("simulation", ""))
            self.is_simulation = self.is_simulation if told is None else told
            for topic, _, payload in iter_messages(path, damages.append):
                if topic not in BEACON_TOPICS_READ:
                    continue
                try:
                    self._take(decode_recorded(topic, payload))
                except (BadMessage, ValueError) as error:
                    lost.append(str(error))
        except OSError as error:
            warnings.append(f"{path.name}: cannot be read: {error.strerror or error}")
        warnings += [damage_text(path, text) for text in damages]
        if lost:
            warnings.append(f"{path.name}: {len(lost)} messages cannot be read and are left out: {lost[0]}")

    def _take(self, message: object) -> None:
        if isinstance(message, BeaconTrack):
            self.track.append(table(message.rows, TRACK_COLUMNS))
        elif isinstance(message, BeaconTruth):
            self.truth.append(table(message.rows, TRUTH_COLUMNS))
        elif isinstance(message, BeaconPlaces):
            self.places = message.places
        elif isinstance(message, BeaconMapMessage):
            self.maps.append(message)
        elif isinstance(message, BeaconArrival):
            self.arrivals.append(message)
        elif isinstance(message, MissionStatus):
            self.statuses.append(message)
        elif isinstance(message, DangerEvent):
            self.verdicts.append(message)


def _rows_of(batches: Sequence[FloatArray], columns: int) -> FloatArray:
    """One table, the frames growing: a frame that was recorded twice counts once."""
    rows = np.concatenate(batches) if batches else np.empty((0, columns))
    rows = rows[np.isfinite(rows[:, :5]).all(axis=1)]
    _, first = np.unique(rows[:, 0], return_index=True)
    return np.asarray(rows[first])


def _changed_keys(cfg: RadioConfig) -> dict[str, tuple[object, object]]:
    shipped = load_radio_config(None, {"system": cfg.system})
    return changed_keys(cfg.model_dump(mode="json"), shipped.model_dump(mode="json"))
