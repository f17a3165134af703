"""Pure. Everything that is thought out about a run, once, for the page, the figures and the data alike."""

from dataclasses import dataclass

from ccatp.aligning.comparison import Comparison, compare
from ccatp.aligning.survey_result import SurveyResult, survey_result
from ccatp.reporting.errors import ErrorFigures, ErrorSeries, error_figures, error_series
from ccatp.reporting.points import Grade, PointVerdict, point_verdicts
from ccatp.reporting.record import COMPLETE, Outcome, RunRecord
from ccatp.reporting.time_budget import TimeBudget, time_budget


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """A run and what follows from it. What the run does not hold is None or empty.

    Attributes:
        record: the run.
        outcome: how it ended.
        points: pass or fail of each.
        errors: localization error over time, and ``figures`` of its distribution.
        budget: where the time went.
        alignment: how the panels lie.
        against: recovered against injected misalignment.
    """

    record: RunRecord
    outcome: Outcome
    points: list[PointVerdict]
    errors: ErrorSeries | None
    figures: ErrorFigures | None
    budget: TimeBudget | None
    alignment: SurveyResult | None
    against: Comparison | None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is damaged in the run, and doubtful in its alignment."""
        return self.record.warnings + (self.alignment.warnings if self.alignment is not None else ())

    @property
    def has_failed(self) -> bool:
        """A point was measured too far from its place."""
        return any(verdict.grade is Grade.FAIL for verdict in self.points)


def findings_of(record: RunRecord) -> Findings:
    """Think about a run."""
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


def outcome_of(record: RunRecord) -> Outcome:
    """How the run ended, from what main said last; a run without an end goes on or was killed."""
    status = record.last_status
    if status is None:
        return Outcome("no mission", "main never said where the mission stood", is_good=False)
    if status.outcome:
        return Outcome(status.outcome, status.cause, is_good=status.outcome == COMPLETE)
    if status.exit_status >= 0:
        return Outcome(f"ended with status {status.exit_status}, {status.state}", status.cause, is_good=False)
    if record.summary is None:
        return Outcome("no end is recorded", "the run goes on, or was killed", is_good=False)
    return Outcome("interrupted", status.cause or f"while {status.state}", is_good=False)
