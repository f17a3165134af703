"""What follows from a recorded survey, computed once for page, figures and data: points, errors, times, alignment."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import dist, inf
from typing import NamedTuple

import numpy as np

from ccatp.core import Fix, PointId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.mirror_alignment import Comparison, SurveyResult, compare, survey_result
from ccatp.records.summary import arrival_error_m as true_arrival_error_m
from ccatp.records.summary import puck_targets
from ccatp.report.analysis import ErrorFigures, ErrorSeries, TimeBreakdown, error_figures, error_series, time_budget
from ccatp.report.record import COMPLETE, WITHIN_MM, PointOutcome, RecordedSession, RunRecord


class Grade(StrEnum):
    """How a point ended."""

    GOOD = "pass"  # measured, and within 10 mm at the first arrival
    CORRECTED = "corrected"  # measured within 10 mm, after a correction
    FAIL = "fail"  # measured where the robot was further away than that
    SKIPPED = "skipped"
    OPEN = "not measured"


class PointVerdict(NamedTuple):
    """One measurement point.

    Attributes:
        place_m: deck x, y.
        first_mm: distance at the first arrival, before any correction; None where it is not known.
        left_mm: distance where it was measured, as the laser saw it; None without a fix.
        why: why it was left out; empty where it was not, or no reason is recorded.
    """

    point: PointId
    place_m: tuple[float, float]
    first_mm: float | None
    left_mm: float | None
    grade: Grade
    why: str

    @property
    def shown_mm(self) -> float | None:
        """The first distance that is known."""
        return self.left_mm if self.first_mm is None else self.first_mm


def arrival_error_m(mirror: Mirror, point: PointId, fix: Fix, puck_height_m: float) -> float:
    """Distance on the surface from the foot of a measured puck to its measurement point, m."""
    return _foot_distance_m(mirror, point, fix.position_m, puck_height_m)


def _foot_distance_m(mirror: Mirror, point: PointId, puck_m: tuple[float, float, float], puck_height_m: float) -> float:
    x, y, _ = mirror.foot_of_puck(puck_m, puck_height_m)
    return dist(mirror.surface_point(x, y), mirror.surface_point(*mirror.point_on_deck(point)))


def point_verdicts(record: RunRecord) -> list[PointVerdict]:
    """Every point of the mission, by row, column and number; empty where the run holds no mission."""
    first = first_arrivals_mm(record)
    height_m = record.cfg.robot.puck_height_m
    left = {one.point: 1e3 * arrival_error_m(record.mirror, one.point, one.fix, height_m) for one in record.measured}
    reasons = _reasons(record)
    return [
        PointVerdict(
            row.point,
            record.mirror.point_on_deck(row.point),
            first.get(row.point),
            left.get(row.point),
            _grade(row.status, first.get(row.point), left.get(row.point)),
            reasons.get(row.point, ""),
        )
        for row in record.points or ()
    ]


def _grade(status: str, first_mm: float | None, left_mm: float | None) -> Grade:
    if left_mm is not None:
        if left_mm > WITHIN_MM:
            return Grade.FAIL
        # Where nobody saw the first arrival the fix has to do.
        return Grade.GOOD if (left_mm if first_mm is None else first_mm) <= WITHIN_MM else Grade.CORRECTED
    return Grade.SKIPPED if status == "skipped" else Grade.OPEN


def first_arrivals_mm(record: RunRecord) -> dict[PointId, float]:
    """Distance from each point when the robot came to rest there first, mm.

    From the simulated truth, as in ``summary.json``; on a real robot from the first fix there.
    """
    found: dict[PointId, float] = {}
    for session in record.sessions:
        known = _from_truth(record, session) if session.truth is not None else _from_fixes(record, session)
        found.update({point: error for point, error in known.items() if point not in found})
    return found


def _from_truth(record: RunRecord, session: RecordedSession) -> dict[PointId, float]:
    truth, mirror, height_m = session.truth, record.mirror, record.cfg.robot.puck_height_m
    if truth is None or not len(truth.seq):
        return {}
    first = {arrived.point: arrived.seq for arrived in reversed(session.arrivals)}
    targets = puck_targets(mirror, first, height_m)
    found = {}
    for point, seq in first.items():
        at = int(np.searchsorted(truth.seq, seq))
        if at < len(truth.seq) and truth.seq[at] == seq:
            place = truth.place_m[at]
            normal = mirror.surface.normal(float(place[0]), float(place[1]))
            found[point] = 1e3 * true_arrival_error_m(targets[point], place, normal, height_m)
    return found


def _from_fixes(record: RunRecord, session: RecordedSession) -> dict[PointId, float]:
    """The first fix of a point belongs to its first arrival: corrections follow it."""
    found: dict[PointId, float] = {}
    for fix in session.fixes:
        if fix.point is None or PointId(*fix.point) in found:
            continue
        point = PointId(*fix.point)
        error_m = _foot_distance_m(record.mirror, point, fix.position_m, record.cfg.robot.puck_height_m)
        found[point] = 1e3 * error_m if error_m < inf else inf
    return found


def _reasons(record: RunRecord) -> dict[PointId, str]:
    status = record.last_status
    by_reason: Mapping[str, list[str]] = {} if status is None else status.left_out
    if not by_reason and record.summary is not None:
        by_reason = (record.summary.get("points") or {}).get("left_out") or {}
    return {found: why for why, names in by_reason.items() for name in names if (found := _parsed(name)) is not None}


def _parsed(name: str) -> PointId | None:
    parts = name.replace("-", "/").split("/")
    return PointId(*map(int, parts)) if len(parts) == 3 and all(part.isdecimal() for part in parts) else None


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """A run and what follows from it. What the run does not hold is None or empty.

    Attributes:
        errors: localization error over time, and ``figures`` of its distribution.
    """

    record: RunRecord
    outcome: PointOutcome
    points: list[PointVerdict]
    errors: ErrorSeries | None
    figures: ErrorFigures | None
    budget: TimeBreakdown | None
    alignment: SurveyResult | None
    against: Comparison | None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is damaged in the run, and doubtful in its alignment."""
        return self.record.warnings + (self.alignment.warnings if self.alignment is not None else ())

    @property
    def counts(self) -> dict[Grade, int]:
        """How many points there are of each grade, those without any left out."""
        return {grade: count for grade in Grade if (count := sum(one.grade is grade for one in self.points))}


def findings_of(record: RunRecord) -> Findings:
    """Everything that follows from a recorded run."""
    errors = error_series(record)
    alignment = _alignment(record)
    known = alignment is not None and record.injected is not None
    return Findings(
        record=record,
        outcome=outcome_of(record),
        points=point_verdicts(record),
        errors=errors,
        figures=None if errors is None else error_figures(errors),
        budget=time_budget(record),
        alignment=alignment,
        against=compare(alignment.panels, record.injected) if known and alignment and record.injected else None,
    )


def _alignment(record: RunRecord) -> SurveyResult | None:
    if not record.measured:
        return None
    planned = {row.point.panel for row in record.points or ()}
    return survey_result(record.mirror, record.cfg.align, record.cfg.robot.puck_height_m, record.measured, planned)


def outcome_of(record: RunRecord) -> PointOutcome:
    """How the run ended, from the last status; a run without an end goes on or was killed."""
    status = record.last_status
    if status is None:
        return PointOutcome("no mission", "main never said where the mission stood", is_good=False)
    if status.outcome:
        return PointOutcome(status.outcome, status.cause, is_good=status.outcome == COMPLETE)
    if status.exit_status >= 0:
        return PointOutcome(f"ended with status {status.exit_status}, {status.state}", status.cause, is_good=False)
    if record.summary is None:
        return PointOutcome("no end is recorded", "the run goes on, or was killed", is_good=False)
    return PointOutcome("interrupted", status.cause or f"while {status.state}", is_good=False)
