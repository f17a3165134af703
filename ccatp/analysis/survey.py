"""A survey for analysis: fixes, points, panels, moves of adjusters, and the track."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ccatp.analysis.run import Run, shared_fields
from ccatp.analysis.samples import KINDS
from ccatp.analysis.table import Table, table_of_records
from ccatp.core import FloatArray
from ccatp.report import tables
from ccatp.report.findings import Findings, findings_of
from ccatp.report.record import RecordedSession, read_record

_POINT = ("row", "col", "point", "status", "first_arrival_mm", "measured_at_mm")
_TRACK = {
    "session": "number of the recording, from 1; a run that was resumed has several",
    "frame": "number of the frame in its recording, which grows also where the robot restarts",
    "t_s": "mission time of the run",
    "x_m": "estimated position, deck frame",
    "y_m": "estimated position, deck frame",
    "heading_rad": "estimated heading, deck frame",
    "sigma_m": "largest standard deviation of the position in any direction",
    "true_x_m": "simulated position; NaN on a real robot",
    "true_y_m": "simulated position; NaN on a real robot",
    "true_heading_rad": "simulated heading; NaN on a real robot",
}


@dataclass(frozen=True, eq=False, kw_only=True)
class SurveyRun(Run):
    """The survey of a mirror. The times of all tables are mission time of the run.

    ``points``: every planned point. ``fixes``: a row for each measured point. ``panels``: position and tilt of each
    planned panel, NaN where its points do not determine it. ``adjuster_moves``: the moves that align the others.
    ``warnings`` also has the doubts about the laser network and the alignment.
    """

    findings: Findings

    @cached_property
    def points(self) -> Table:
        """Every planned point: status, distance of the retroreflector from it at the first arrival and at the fix."""
        table = tables.fixes_table(self.findings)
        return table_of_records({name: table.columns[name] for name in _POINT}, table.rows)

    @cached_property
    def fixes(self) -> Table:
        """The fix of each measured point, with covariance, deviation from the ideal surface, and channels."""
        table = tables.fixes_table(self.findings)
        columns = {name: text for name, text in table.columns.items() if name not in ("status", "first_arrival_mm")}
        return table_of_records(columns, [row for row in table.rows if "x_m" in row])

    @cached_property
    def panels(self) -> Table:
        """Position, tilt and moves of each planned panel; no rows without a measured point."""
        table = tables.all_panels_table(self.findings)
        return table_of_records(table.columns, table.rows)

    @cached_property
    def adjuster_moves(self) -> Table:
        """A row for each adjuster of each determined panel."""
        table = tables.moves_table(self.findings)
        return table_of_records(table.columns, table.rows)

    def track(self) -> Table:
        """Estimated and true pose of each frame, deck frame."""
        sessions = [_track(one) for one in self.findings.record.sessions]
        rows = np.concatenate(sessions) if sessions else np.empty((0, len(_TRACK)))
        whole = {name: rows[:, at].astype(np.int64) for at, name in enumerate(("session", "frame"))}
        return Table({name: whole.get(name, rows[:, at]) for at, name in enumerate(_TRACK)}, _TRACK)


def _track(session: RecordedSession) -> FloatArray:
    track, truth = session.track, np.full((len(session.track.seq), 3), np.nan)
    if session.truth is not None:
        _, ours, theirs = np.intersect1d(track.seq, session.truth.seq, assume_unique=True, return_indices=True)
        truth[ours] = session.truth.pose[theirs]
    numbers, times_s = np.full(len(truth), session.number), track.t_s + session.offset_s
    return np.column_stack([numbers, track.seq, times_s, track.pose, session.sigma_m, truth])


def open_survey(run_dir: Path) -> SurveyRun:
    """The survey of a run directory; errors as ``open_run``."""
    findings = findings_of(read_record(run_dir))
    record = findings.record
    statuses = [(one.t_s + session.offset_s, one) for session in record.sessions for one in session.statuses]
    fields = shared_fields(run_dir, record, statuses) | {"warnings": (*record.missing, *findings.warnings)}
    return SurveyRun(config=record.cfg, findings=findings, sample_kinds=KINDS, **fields)
