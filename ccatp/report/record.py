"""A recorded survey as its report needs it, and its reader: a run that is complete, running or killed.

What cannot be read is reported and left out; only a directory without a run, or a configuration that this program
cannot use, is refused. Nothing is written. Raw sensor samples, nine tenths of a recording, are not read.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ccatp.config.load import is_radio_file, load_config
from ccatp.config.models import Config
from ccatp.core import FloatArray, IntArray, PanelId, Vector3
from ccatp.links.topics import ArrivalMessage, BadMessage, FixMessage, MissionStatus, decode_recorded
from ccatp.mirror.mirror import Mirror, build_mirror, deck_rows
from ccatp.mirror.panel_alignment import Measured
from ccatp.mirror.surface import MirrorError
from ccatp.records.recorder import TELEMETRY, damage_text, iter_messages, read_metadata, recordings
from ccatp.records.run_reader import CONFIG, STORE, RunReadError, read_truth
from ccatp.records.state_log import LogLine, ReadLine, StateChange, changes_of, read_log
from ccatp.records.store import StoredPoint, StoreError, point_name, read_survey

COMPLETE = "complete"
WITHIN_MM = 10.0  # the thesis's requirement on arrivals
SUMMARY, LOG = "summary.json", "log.jsonl"
TOPICS_READ = frozenset(("track", "truth", "arrival", "fix", "mission"))


class EstimatedTrack(NamedTuple):
    """Estimates after k frames, deck frame."""

    seq: IntArray  # shape (k,)
    t_s: FloatArray  # robot time, shape (k,)
    place_m: FloatArray  # points on the surface, shape (k, 3)
    sigma_m: FloatArray  # standard deviation of the place along any one direction, shape (k,)


class TrueTrack(NamedTuple):
    """True places after k frames, as in ``EstimatedTrack``."""

    seq: IntArray
    place_m: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSession:
    """One recording; a run that was resumed has several."""

    name: str
    version: str
    track: EstimatedTrack
    truth: TrueTrack | None  # None on a real robot
    arrivals: tuple[ArrivalMessage, ...]
    fixes: tuple[FixMessage, ...]
    statuses: tuple[MissionStatus, ...]
    changes: tuple[StateChange, ...]  # from the log; empty where it does not hold them in order

    @property
    def span_s(self) -> float:
        """Robot time from the first frame to the last one."""
        return float(self.track.t_s[-1] - self.track.t_s[0]) if len(self.track.t_s) else 0.0


class PointOutcome(NamedTuple):
    """How a run ended, in a few words; why, where that is recorded; and whether that is as it should be."""

    text: str
    cause: str
    is_good: bool


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RunFiles:
    """What every run leaves behind, whatever its mission."""

    name: str
    config_text: str
    changed: Mapping[str, tuple[object, object]]  # keys with another value than the shipped one: both values
    is_simulation: bool | None
    summary: Mapping[str, Any] | None
    log: tuple[LogLine, ...]
    files: Mapping[str, int]  # sizes in bytes
    missing: tuple[str, ...]  # what a complete run would hold and this one does not, one line each
    warnings: tuple[str, ...]

    @property
    def began(self) -> str:
        """Wall clock of the first line of the log, UTC; empty where it has none."""
        return next((line.wall[:19].replace("T", " ") + " UTC" for line in self.log if line.wall), "")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RunRecord(RunFiles):
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
        """Every recording with frames holds the simulated truth."""
        driven = [session for session in self.sessions if len(session.track.seq)]
        return bool(driven) and all(session.truth is not None for session in driven)


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
        missing.append(f"{LOG}: log of the processes, and when the mission changed its state")
    sessions, is_simulation = _sessions(run_dir, mirror, log, missing, warnings)
    points, measured = _survey(run_dir, mirror, missing, warnings)
    injected, _ = read_truth(run_dir, warnings)
    # Mirror and world have names of their own.
    ours, shipped = (one.model_dump(mode="json", exclude={"mirror", "world"}) for one in (cfg, load_config()))
    return RunRecord(
        cfg=cfg,
        mirror=mirror,
        sessions=sessions,
        points=points,
        measured=measured,
        injected=injected,
        is_simulation=is_simulation,
        changed=changed_keys(ours, shipped),
        **common_fields(run_dir, log, missing, warnings),
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


def changed_keys(
    ours: Mapping[str, Any], shipped: Mapping[str, Any], prefix: str = ""
) -> dict[str, tuple[object, object]]:
    """Keys of a configuration whose values differ: ours and the shipped ones; None where there is none."""
    found: dict[str, tuple[object, object]] = {}
    for key in dict.fromkeys((*ours, *shipped)):
        one, other = ours.get(key), shipped.get(key)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            found |= changed_keys(one, other, f"{prefix}{key}.")
        elif one != other:
            found[prefix + key] = (one, other)
    return found


def common_fields(run_dir: Path, log: Iterable[ReadLine], missing: list[str], warnings: list[str]) -> dict[str, Any]:
    """Fields of ``RunFiles`` that are read in the same way for every mission; completes ``missing``."""
    return {
        "name": run_dir.resolve().name,
        "config_text": (run_dir / CONFIG).read_text(encoding="utf-8", errors="replace"),
        "summary": _read_summary(run_dir / SUMMARY, missing, warnings),
        "log": tuple(line.shown for line in log if line.shown is not None),
        # The report is no part of the run: it is the same when it is made again.
        "files": {
            path.name: path.stat().st_size
            for path in sorted(run_dir.iterdir())
            if path.is_file() and not path.name.startswith(".") and path.suffix != ".html"
        },
        "missing": tuple(missing),
        "warnings": tuple(warnings),
    }


def _read_summary(path: Path, missing: list[str], warnings: list[str]) -> Mapping[str, Any] | None:
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


class Recording(NamedTuple):
    """The messages of a recording by topic, what made it, and whether that was a simulation (None if not known)."""

    messages: dict[str, list[Any]]
    version: str
    is_simulation: bool | None


def read_recording(
    path: Path, topics: Iterable[str], columns: Mapping[str, int], warnings: list[str]
) -> Recording | None:
    """Read a recording up to its end or its first damage; None if it cannot be read at all.

    Messages of topics in ``columns`` are tables and become arrays of shape (k, columns).
    """
    found: dict[str, list[Any]] = {topic: [] for topic in topics}
    damages, lost = list[str](), list[str]()
    try:
        metadata = read_metadata(path)
        for topic, _, payload in iter_messages(path, damages.append):
            if topic not in found:
                continue
            try:
                message: Any = decode_recorded(topic, payload)
                if topic in columns:
                    message = np.array(message.rows, dtype=np.float64).reshape(-1, columns[topic])
                found[topic].append(message)
            except (BadMessage, ValueError) as error:
                lost.append(str(error))
    except OSError as error:
        warnings.append(f"{path.name}: cannot be read: {error.strerror or error}")
        return None
    warnings += [damage_text(path, damage) for damage in damages]
    if lost:
        warnings.append(f"{path.name}: {len(lost)} messages cannot be read and are left out: {lost[0]}")
    is_simulation = {"true": True, "false": False}.get(metadata.get("simulation", ""))
    return Recording(found, metadata.get("ccatp", "unknown"), is_simulation)


def joined(batches: Sequence[FloatArray], columns: int, needed: int) -> FloatArray:
    """One table, the frames growing, each once; rows whose first ``needed`` columns are not finite are left out."""
    rows = np.concatenate(batches) if batches else np.empty((0, columns))
    rows = rows[np.isfinite(rows[:, :needed]).all(axis=1)]
    _, first = np.unique(rows[:, 0], return_index=True)
    return np.asarray(rows[first])


_COLUMNS = {"track": 8, "truth": 11}


def _sessions(
    run_dir: Path, mirror: Mirror, log: list[ReadLine], missing: list[str], warnings: list[str]
) -> tuple[tuple[RecordedSession, ...], bool | None]:
    paths = recordings(run_dir / TELEMETRY)
    if not paths:
        missing.append(f"{TELEMETRY}: path, estimates, arrivals and fixes over time")
        return (), None
    sessions, is_simulation = [], None
    for path, changes in zip(paths, changes_of(log, len(paths)), strict=True):
        found = read_recording(path, TOPICS_READ, _COLUMNS, warnings)
        if found is not None:
            is_simulation = is_simulation if found.is_simulation is None else found.is_simulation
            sessions.append(_session(path.name, found, mirror, changes, warnings))
    if log and not all(session.changes for session in sessions):
        missing.append("the frames of each change of state: the time budget is taken from the status, which is coarser")
    if is_simulation and not any(session.truth for session in sessions):
        missing.append("the simulated truth: errors are those that the laser saw")
    return tuple(sessions), is_simulation


def _session(
    name: str, found: Recording, mirror: Mirror, changes: Sequence[StateChange], warnings: list[str]
) -> RecordedSession:
    messages = found.messages
    track, truth = (joined(messages[topic], count, count) for topic, count in _COLUMNS.items())
    try:
        deck = deck_rows(mirror, track[:, 2:4].astype(np.int64), track[:, 4:7])
    except MirrorError as error:
        warnings.append(f"{name}: its estimates are not of this mirror and are left out: {error}")
        track, deck = track[:0], np.empty((0, 4))
    return RecordedSession(
        name=name,
        version=found.version,
        track=EstimatedTrack(track[:, 0].astype(np.int64), track[:, 1], deck[:, [0, 1, 3]], track[:, 7]),
        truth=TrueTrack(truth[:, 0].astype(np.int64), truth[:, 5:8]) if messages["truth"] else None,
        arrivals=tuple(messages["arrival"]),
        fixes=tuple(messages["fix"]),
        statuses=tuple(messages["mission"]),
        changes=tuple(changes),
    )


def _survey(
    run_dir: Path, mirror: Mirror, missing: list[str], warnings: list[str]
) -> tuple[tuple[StoredPoint, ...] | None, tuple[Measured, ...]]:
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
    return tuple(stored.points), tuple(Measured(one.point, one.fix) for one in stored.fixes)
