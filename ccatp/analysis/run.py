"""A run for analysis, of any kind of mission, and how it is opened."""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ccatp.analysis.samples import SampleKind, samples
from ccatp.analysis.table import Table, table_of_records
from ccatp.daemon.operator.alarms import read_history
from ccatp.records.recorder import TELEMETRY, recordings
from ccatp.records.run_reader import RecordedFrame, RunReadError, open_recordings
from ccatp.report.record import RunFiles, kind_of_run

ALARM_COLUMNS = {
    "name": "name of the condition, see docs/alarms.md",
    "severity": "the highest while it was active",
    "cause": "the text for operators",
    "raised_utc": "when it was raised",
    "raised_t_s": "the same by the robot's clock",
    "ended_utc": "when it ended; empty while it is active",
    "ended_t_s": "the same by the robot's clock",
    "acknowledged_utc": "when it was acknowledged; empty if it was not",
    "acknowledged_by": "by whom",
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Run(ABC):
    """A run: finished, in progress, killed or simulated in one process.

    ``summary``: the content of summary.json; ``None`` if the run did not come to its end, or not yet. ``warnings``: a
    line for each part that is missing, damaged or not used. ``config``: its configuration. ``alarms``: a row for each
    time that a condition was raised; its times are UTC and by the robot's clock.
    """

    name: str
    is_simulation: bool | None
    summary: Mapping[str, Any] | None
    warnings: tuple[str, ...]
    config: Any
    alarms: Table
    frames: Callable[[], Iterable[Iterable[RecordedFrame]]]  # of each session, read again by each call
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


def shared_fields(run_dir: Path, files: RunFiles) -> dict[str, Any]:
    """The fields of ``Run`` that are the same for every kind of mission."""
    return {
        "name": files.name,
        "is_simulation": files.is_simulation,
        "summary": files.summary,
        "warnings": (*files.missing, *files.warnings),
        "alarms": alarm_table(run_dir),
        "frames": lambda: _frames(run_dir),
    }


def _frames(run_dir: Path) -> Iterable[Iterable[RecordedFrame]]:
    if not recordings(run_dir / TELEMETRY):
        raise RunReadError(f"{run_dir}: no {TELEMETRY} there, so no samples")
    return (recording.frames() for recording in open_recordings(run_dir))


def alarm_table(run_dir: Path) -> Table:
    """The alarms of a run in the order in which they were raised."""
    rows: list[dict[str, object]] = []
    newest: dict[str, dict[str, object]] = {}
    for event in read_history(run_dir):
        row = newest.get(event.name)
        if event.event == "raised" and (row is None or "ended_utc" in row):
            row = newest[event.name] = {"name": event.name, "raised_utc": event.utc, "raised_t_s": event.t_s}
            rows.append(row)
        if row is None:  # the line of its beginning was lost
            continue
        if event.event == "raised":
            row |= {"severity": event.severity, "cause": event.cause}
        elif event.event == "ended":
            row |= {"ended_utc": event.utc, "ended_t_s": event.t_s}
        else:
            row |= {"acknowledged_utc": event.utc, "acknowledged_by": event.by}
    return table_of_records(ALARM_COLUMNS, rows)
