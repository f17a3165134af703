"""A run for analysis, of any kind of mission, and how it is opened."""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ccatp.analysis.samples import SampleKind, SessionFrames, samples
from ccatp.analysis.table import Table, table_of_records
from ccatp.daemon.operator.alarms import read_history
from ccatp.links.topics import MissionStatus
from ccatp.records.recorder import TELEMETRY, recordings
from ccatp.records.run_reader import RunReadError, open_recordings
from ccatp.records.run_time import AlarmTimes, RecordingPlace
from ccatp.report.record import RunFiles, kind_of_run

ALARM_COLUMNS = {
    "name": "name of the condition, see docs/alarms.md",
    "severity": "the highest while it was active",
    "cause": "the text for operators",
    "raised_utc": "when it was raised",
    "raised_t_s": "mission time of the first status with it; NaN if none is recorded",
    "ended_utc": "when it ended; empty while it is active",
    "ended_t_s": "mission time of the first status after it ended",
    "acknowledged_utc": "when it was acknowledged; empty if it was not",
    "acknowledged_by": "by whom",
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Run(ABC):
    """A run: finished, in progress, killed or simulated in one process.

    ``summary``: the content of summary.json; ``None`` if the run did not come to its end, or not yet. ``warnings``: a
    line for each part that is missing, damaged or not used. ``config``: its configuration. ``alarms``: a row for each
    time that a condition was raised; its times are UTC and mission time.

    Mission time is one axis for all tables of a run. It equals the robot's clock until that first steps or restarts,
    and continues from there; the time between the end of a session and the next one is not part of it.
    """

    name: str
    is_simulation: bool | None
    summary: Mapping[str, Any] | None
    warnings: tuple[str, ...]
    config: Any
    alarms: Table
    frames: Callable[[], Iterable[SessionFrames]]  # read again by each call
    sample_kinds: Mapping[str, SampleKind]

    @abstractmethod
    def track(self) -> Table:
        """Estimated and true pose of each frame."""

    def samples(self, name: str) -> Table:
        """Samples of the sensors by their key on the robot link, as in ``samples("imu")``.

        Raises ValueError: no such key, or a simulation that kept no samples. RunReadError: no recording can be read.
        """
        return samples(name, self.frames(), self.sample_kinds)


def open_run(path: str | os.PathLike[str]) -> Run:
    """Open the directory of a run; nothing in it is changed.

    Its type is that of the kind of mission: ``SurveyRun`` for a survey. Raises RunReadError: no run is there, or none
    that this version can read; ConfigError: its configuration cannot be used.
    """
    run_dir = Path(path)
    kind = kind_of_run(run_dir)
    if kind.analysis is None:
        raise RunReadError(f"{run_dir}: a {kind.title} has no tables; read its recordings with ccatp recording")
    run: Run = kind.analysis.get()(run_dir)
    return run


def shared_fields(run_dir: Path, files: RunFiles, statuses: Sequence[tuple[float, MissionStatus]]) -> dict[str, Any]:
    """The fields of ``Run`` that are the same for every kind of mission; ``statuses``: with their times in the run."""
    return {
        "name": files.name,
        "is_simulation": files.is_simulation,
        "summary": files.summary,
        "warnings": (*files.missing, *files.warnings),
        "alarms": alarm_table(run_dir, AlarmTimes(statuses)),
        "frames": lambda: _frames(run_dir, files.recordings),
    }


def _frames(run_dir: Path, places: Sequence[RecordingPlace]) -> Iterable[SessionFrames]:
    if not recordings(run_dir / TELEMETRY):
        raise RunReadError(f"{run_dir}: no {TELEMETRY} there, so no samples")
    known = {place.name: place for place in places}
    for recording in open_recordings(run_dir):
        place = known.get(recording.path.name)
        if place is not None:  # not one of a session that began since
            yield SessionFrames(place.number, place.offset_s, recording.frames())


def alarm_table(run_dir: Path, times: AlarmTimes) -> Table:
    """The alarms of a run in the order in which they were raised."""
    rows: list[dict[str, object]] = []
    newest: dict[str, dict[str, object]] = {}
    for event in read_history(run_dir):
        row = newest.get(event.name)
        if event.event == "raised" and (row is None or "ended_utc" in row):
            row = newest[event.name] = {"name": event.name, "raised_utc": event.utc}
            row["raised_t_s"] = times.raised_s(event.name, event.utc)
            rows.append(row)
        if row is None:  # the line of its beginning was lost
            continue
        if event.event == "raised":
            row |= {"severity": event.severity, "cause": event.cause}
        elif event.event == "ended":
            row |= {"ended_utc": event.utc, "ended_t_s": times.ended_s(event.name, str(row["raised_utc"]))}
        else:
            row |= {"acknowledged_utc": event.utc, "acknowledged_by": event.by}
    return table_of_records(ALARM_COLUMNS, rows)
