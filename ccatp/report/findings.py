"""Results of a recorded survey, computed once for page, figures and data: points, errors, times, alignment."""

from collections import defaultdict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from itertools import chain, pairwise
from math import sqrt
from typing import NamedTuple

import msgspec
import numpy as np

from ccatp.core import UNRELIABLE, DeckPose, Fix, FloatArray, PointId, StopKind
from ccatp.errors import ExitStatus
from ccatp.estimation.fixes import FixRefused, deck_foot
from ccatp.filters.metrics import Consistency, consistency, rms
from ccatp.mirror.layout import POINTS_PER_PANEL
from ccatp.mirror.mirror_alignment import Comparison, SurveyResult, align_survey, compare
from ccatp.mirror.network_points import CalibratedSurveys
from ccatp.records.summary import arrival_error_m, distribution, measured_error_m
from ccatp.records.timeline import common_rows, row_before, rows_of
from ccatp.report.network import remarks
from ccatp.report.record import COMPLETE, WITHIN_MM, PointOutcome, RecordedSession, SurveyFiles
from ccatp.survey.ending import End, ending_of, read_ending, why_text
from ccatp.survey.events import SurveyOutcome
from ccatp.survey.fix_gate import nis_of
from ccatp.survey.planning.legs import PlanError
from ccatp.survey.planning.route import ORDERS, plan_survey
from ccatp.survey.planning.search import leg_lengths, leg_time, stop_times

SIGMAS = 3.0
_FIX_FRAMES = 10  # a fix belongs to the newest estimate, which is at most this much older; the robot stands


class Grade(StrEnum):
    """Result of a point."""

    GOOD = "pass"  # measured, and within 10 mm at the first arrival
    CORRECTED = "corrected"  # measured within 10 mm, after a correction
    FAIL = "fail"  # measured at a distance of more than 10 mm
    SKIPPED = "skipped"
    OPEN = "not measured"


class PointVerdict(NamedTuple):
    """One measurement point; None if not known."""

    point: PointId
    place_m: tuple[float, float]  # deck x, y
    first_mm: float | None  # distance at the first arrival, before any correction
    left_mm: float | None  # distance at the measurement, by the laser
    grade: Grade
    why: str  # reason why it was skipped; may be empty

    @property
    def shown_mm(self) -> float | None:
        """The first distance that is known."""
        return self.left_mm if self.first_mm is None else self.first_mm

    def __str__(self) -> str:
        distances = {"first": self.first_mm, "measured at": self.left_mm}
        known = [f", {name} {mm:.2f} mm" for name, mm in distances.items() if mm is not None]
        return f"{'/'.join(map(str, self.point))}: {self.grade}{''.join(known)}"


def point_verdicts(record: SurveyFiles) -> list[PointVerdict]:
    """Every point of the mission, by row, column and number; empty if the run has no mission."""
    first, reasons = first_arrivals_mm(record), _reasons(record)
    mirror, height_m = record.mirror, record.cfg.robot.puck_height_m
    left = {
        one.point: 1e3 * measured_error_m(mirror, one.point, one.fix.position_m, height_m) for one in record.measured
    }
    found = []
    for row in record.points or ():
        first_mm, left_mm = first.get(row.point), left.get(row.point)
        if left_mm is None:
            grade = Grade.SKIPPED if row.status == "skipped" else Grade.OPEN
        elif left_mm > WITHIN_MM:
            grade = Grade.FAIL
        else:
            # If the first arrival is not known, the fix is used.
            grade = Grade.GOOD if (left_mm if first_mm is None else first_mm) <= WITHIN_MM else Grade.CORRECTED
        place_m = mirror.point_on_deck(row.point)
        found.append(PointVerdict(row.point, place_m, first_mm, left_mm, grade, reasons.get(row.point, "")))
    return found


def first_arrivals_mm(record: SurveyFiles) -> dict[PointId, float]:
    """Distance from each point at the first rest there, mm, by the truth or by the first fix there."""
    found: dict[PointId, float] = {}
    mirror, height_m = record.mirror, record.cfg.robot.puck_height_m
    for session in record.sessions:
        first: dict[PointId, float] = {}
        truth = session.truth
        if truth is None:
            # The first fix of a point belongs to its first arrival: corrections follow it.
            pucks = {PointId(*fix.point): fix.position_m for fix in reversed(session.fixes) if fix.point is not None}
            first = {point: 1e3 * measured_error_m(mirror, point, puck_m, height_m) for point, puck_m in pucks.items()}
        elif len(truth.seq):
            frames = {PointId(*arrival.point): arrival.seq for arrival in reversed(session.arrivals)}
            rows = zip(frames, rows_of(truth.seq, [*frames.values()]).tolist(), strict=True)
            for point, at in rows:
                if at >= 0:
                    first[point] = 1e3 * arrival_error_m(mirror, point, truth.place[at], height_m)
        found = first | found
    return found


def fix_times_s(record: SurveyFiles) -> dict[PointId, float]:
    """Time of the run at which each fix that counts was taken, s; without those whose recording is not there."""
    counted = {(one.point, one.fix.position_m) for one in record.measured}
    return {
        PointId(*fix.point): fix.t_s + session.offset_s
        for session in record.sessions
        for fix in session.fixes
        if fix.point is not None and (PointId(*fix.point), fix.position_m) in counted
    }


def _reasons(record: SurveyFiles) -> dict[PointId, str]:
    status = record.last_status
    by_reason: Mapping[str, list[str]] = {} if status is None else status.left_out
    if not by_reason and record.summary is not None:
        by_reason = (record.summary.get("points") or {}).get("left_out") or {}
    parsed = [(name.replace("-", "/").split("/"), why) for why, names in by_reason.items() for name in names]
    return {
        PointId(*map(int, parts)): why
        for parts, why in parsed
        if len(parts) == 3 and all(part.isdecimal() for part in parts)
    }


# -- localization error -----------------------------------------------------------------------------------------------


class ErrorSeries(NamedTuple):
    """Errors against the time of all sessions, one after the other; frames have shape (k,), fixes (n,)."""

    t_s: FloatArray  # robot time since the start of the first session
    sigma3_mm: FloatArray  # three standard deviations of the estimated place
    error_mm: FloatArray  # distance of the true place from the estimated one; NaN if the truth is not known
    breaks_s: tuple[float, ...]
    fix_t_s: FloatArray
    fix_mm: FloatArray  # change of the estimate by each fix, also if the fix was not fused
    fix_fused: "np.ndarray[tuple[int, ...], np.dtype[np.bool_]]"


def error_series(record: SurveyFiles) -> ErrorSeries | None:
    """The errors of a run; None without an estimate."""
    sessions = [session for session in record.sessions if len(session.track.seq)]
    if not sessions:
        return None
    times, all_errors, breaks = list[FloatArray](), list[FloatArray](), list[float]()
    fixes = list[tuple[float, float, bool]]()
    start_s = 0.0
    for session in sessions:
        track, truth = session.track, session.truth
        offset_s = start_s - float(track.t_s[0])
        times.append(track.t_s + offset_s)
        errors = np.full(len(track.seq), np.nan)
        if truth is not None:
            i, j = common_rows(track.seq, truth.seq)
            errors[i] = 1e3 * np.linalg.norm(track.place[i] - truth.place[j], axis=1)
        all_errors.append(errors)
        fixes += [(fix.t_s + offset_s, fix.jump_mm, fix.is_fused) for fix in session.fixes]
        start_s += session.span_s
        breaks.append(start_s)
    table = np.array(fixes, dtype=np.float64).reshape(-1, 3)
    return ErrorSeries(
        t_s=np.concatenate(times),
        sigma3_mm=1e3 * SIGMAS * np.concatenate([session.sigma_m for session in sessions]),
        error_mm=np.concatenate(all_errors),
        breaks_s=tuple(breaks[:-1]),
        fix_t_s=table[:, 0],
        fix_mm=table[:, 1],
        fix_fused=table[:, 2] > 0.0,
    )


def error_figures(series: ErrorSeries) -> dict[str, float] | None:
    """The distribution of the errors, mm, and the share within three sigma and within 10 mm; None without a truth."""
    is_known = np.isfinite(series.error_mm)
    errors = series.error_mm[is_known]
    if not len(errors):
        return None
    shown = distribution(errors, ("mean", "p50", "p99", "max"))
    return {
        **{f"{name}_mm": value for name, value in shown.items()},
        "within_sigma3": float(np.mean(errors <= series.sigma3_mm[is_known])),
        "within_limit": float(np.mean(errors <= WITHIN_MM)),
    }


# -- quality of the measurement ---------------------------------------------------------------------------------------


class Quality(NamedTuple):
    """Quality of the measurement; None if not known."""

    fixes: int  # in the recordings
    refused: int  # of them: doubted or not usable
    unreliable: int  # fixes that count, whose lengths contradict each other
    left_out: tuple[int, ...]  # channels that contradicted the others in a fix that counts
    lengths_um: FloatArray  # rms of the length residuals of each fix that counts
    plane: Consistency | None  # chi^2 of the fitted panels, divided by its degrees of freedom
    plane_rms_um: float | None  # of the residuals of their planes
    repeats: int  # measurements of a point beyond its first one
    repeat_um: float | None  # standard deviation of one deviation, from points measured more than once
    nis: Consistency | None  # of the position of each fix against the estimate before it


def quality_of(record: SurveyFiles, alignment: SurveyResult | None) -> Quality:
    """Residuals, repeatability, NIS. A consistent filter has NIS <= 1, because the recorded sigma is the largest."""
    panels = () if alignment is None else alignment.panels
    chi2, dof = np.array([(panel.model.chi2, panel.model.dof) for panel in panels]).reshape(-1, 2).T
    recorded = [(session, fix) for session in record.sessions for fix in session.fixes]
    nis, deviations_um = list[float](), defaultdict[object, list[float]](list)
    for session, fix in recorded:
        with suppress(FixRefused):  # what lies far from the mirror was no fix
            known = msgspec.convert(fix, Fix, from_attributes=True)
            foot = deck_foot(record.mirror, known, record.cfg.robot.puck_height_m)
            at = row_before(session.track.seq, fix.seq)
            # Where the estimates around a fix are lost, an older one says nothing about it.
            if fix.is_fused and at >= 0 and fix.seq - session.track.seq[at] <= _FIX_FRAMES:
                estimate = DeckPose(*session.track.pose[at].tolist())
                nis.append(nis_of(foot, estimate, session.sigma_m[at] ** 2 * np.eye(2)))
            if fix.is_fused and fix.point is not None:
                deviations_um[fix.point].append(1e6 * foot.deviation_m)
    repeats = sum(len(values) - 1 for values in deviations_um.values())
    squares = sum(len(values) * float(np.var(values)) for values in deviations_um.values())
    return Quality(
        fixes=len(recorded),
        refused=sum(not fix.is_fused for _, fix in recorded),
        unreliable=sum(one.fix.metrology == UNRELIABLE for one in record.measured),
        left_out=tuple(sorted({channel for one in record.measured for channel in one.fix.left_out})),
        lengths_um=1e6 * np.array([one.fix.residual_rms_m for one in record.measured]),
        plane=consistency(chi2, dof),
        plane_rms_um=rms(1e6 * np.concatenate([panel.fit.residuals_m for panel in panels] or [np.empty(0)])),
        repeats=repeats,
        repeat_um=sqrt(squares / repeats) if repeats else None,
        nis=consistency(np.array(nis), np.full(len(nis), 2.0)),
    )


# -- time budget ------------------------------------------------------------------------------------------------------

RESTART = "restart"
KINDS = ("turn", "drive", "settle", "measure", "wait", "back off", "home", RESTART)
_KIND_OF = {
    "turning": "turn", "driving": "drive", "settling": "settle", "measuring": "measure", "backing off": "back off",
    "returning": "home", RESTART: RESTART,
}  # fmt: skip
_OVER = "done"
_NEVER_BEGUN = "idle"
_ROUNDING_S = 1e-3  # of times in a status; a tenth of a frame

TimeSpan = tuple[str, float]  # a state of the mission and its duration, s


class TimeBreakdown(NamedTuple):
    """Times of a run by kind, s."""

    spent_s: dict[str, float]  # in the order of KINDS; kinds that did not occur are left out
    least_s: dict[str, float] | None  # of the same way from rest to rest; None if the way is not known
    visits: dict[str, int]  # how often the robot turned, drove, settled, measured, ...
    is_exact: bool  # to a frame, from the log; otherwise sampled from the status
    covers: str

    @property
    def total_s(self) -> float:
        """Robot time from the beginning to the end."""
        return sum(self.spent_s.values())

    @property
    def bound_s(self) -> float | None:
        """The least time of the same way."""
        return None if self.least_s is None else sum(self.least_s.values())


def time_budget(record: SurveyFiles) -> TimeBreakdown | None:
    """Times of a run; None if its states are not recorded. Measuring beyond the configured time counts as waiting."""
    measuring_s = record.cfg.etalon.measuring_time_s
    found = [spells_of(session) for session in record.sessions]
    spent, visits = defaultdict[str, float](float), defaultdict[str, int](int)
    for state, duration_s in chain.from_iterable(spells for spells, _ in found):
        kind = _KIND_OF.get(state, "wait")
        visits[kind] += state != _NEVER_BEGUN
        waited_s = max(duration_s - measuring_s, 0.0) if kind == "measure" else 0.0
        spent["wait"] += waited_s
        spent[kind] += measuring_s if waited_s else duration_s
    if not spent:
        return None
    least, covers = least_times(record)
    # Sums of hundredths of a second have rounding errors.
    kinds = [kind for kind in KINDS if spent[kind] > 1e-6]
    by_kind, counts = {kind: spent[kind] for kind in kinds}, {kind: visits[kind] for kind in kinds}
    return TimeBreakdown(by_kind, least, counts, all(is_exact for _, is_exact in found), covers)


def spells_of(session: RecordedSession) -> tuple[list[TimeSpan], bool]:
    """States with durations, and whether these are exact: from the changes in the log, otherwise from the status.

    The last state of a main loop that died is not logged. The time until the first status of the next main loop counts
    as waiting, except for the time without a main loop, which counts as a restart.
    """
    spells: list[TimeSpan] = []
    absent_s = 0.0  # robot time without mission time: the main loop was restarted
    for one, later in pairwise(status for status in session.statuses if status.seq >= 0):
        passed_s = later.t_s - one.t_s
        missing_s = passed_s - (later.elapsed_s - one.elapsed_s)
        part_s = missing_s if passed_s > 0.0 and missing_s > _ROUNDING_S else 0.0
        absent_s += part_s
        spells += [(one.state, passed_s - part_s), (RESTART, part_s)]
    track = session.track
    is_exact = bool(session.changes and len(track.seq))
    if is_exact:
        at = np.clip(np.searchsorted(track.seq, [change.seq for change in session.changes]), 0, len(track.seq) - 1)
        times = [float(track.t_s[0]), *track.t_s[at].tolist(), float(track.t_s[-1])]
        states = [*(change.before for change in session.changes), session.changes[-1].after]
        spells = [(state, end - start) for state, (start, end) in zip(states, pairwise(times), strict=True)]
        restarts = [index for index, state in enumerate(states) if index and state == _NEVER_BEGUN]
        # The log lacks the last state before a restart, so the time without a main loop is taken from that span, too.
        for index in (place for last in restarts for place in (last, last - 1)):
            state, duration_s = spells[index]
            part_s = min(duration_s, absent_s)
            absent_s -= part_s
            spells[index] = state, duration_s - part_s
            spells.append((RESTART, part_s))
    return [(state, duration_s) for state, duration_s in spells if duration_s > 0.0 and state != _OVER], is_exact


def least_times(record: SurveyFiles) -> tuple[dict[str, float] | None, str]:
    """Least times of the planned way up to the last measured point, and the covered part as text.

    These are bang-bang times from rest to rest with a turn in place at every stop (``ccatp.survey.planning.search``).
    Their sum is ``lower_bound_s`` of ``summary.json`` for a complete mission that was not resumed.
    """
    cfg, mirror = record.cfg, record.mirror
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    try:
        stops = plan_survey(cfg, mirror, points, (), []).stops
    except PlanError:
        return None, ""
    measured = {one.point for one in record.measured}
    stops = stops[: max((i + 1 for i, stop in enumerate(stops) if stop.point in measured), default=0)]
    if not stops:
        return None, ""
    legs_s = sum(leg_time(length, cfg.limits) for length in leg_lengths(stops, mirror.base_pose, mirror))
    times_s = sum(stop_times(stops, mirror.base_pose, cfg.limits, mirror))
    measurements = sum(stop.kind in (StopKind.MEASURE, StopKind.CALIBRATE) for stop in stops)
    least = {"turn": times_s - legs_s, "drive": legs_s, "measure": measurements * cfg.etalon.measuring_time_s}
    whole = len(measured) >= len(points)
    return least, "the whole mission" if whole else "the planned way to the last measured point"


# -- all of it --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """A run and its results; parts that the run lacks are None or empty."""

    record: SurveyFiles
    outcome: PointOutcome
    points: list[PointVerdict]
    errors: ErrorSeries | None  # over time
    figures: dict[str, float] | None  # of their distribution
    budget: TimeBreakdown | None
    alignment: SurveyResult | None
    network: CalibratedSurveys | None  # of the laser, by which the fixes were computed again
    against: Comparison | None
    quality: Quality

    @property
    def warnings(self) -> tuple[str, ...]:
        """Damaged parts of the run, and doubtful results of its alignment."""
        aligned = () if self.alignment is None else self.alignment.warnings
        return (*self.record.warnings, *remarks(self.network), *aligned)


def findings_of(record: SurveyFiles) -> Findings:
    """Compute the results of a recorded run."""
    errors, cfg = error_series(record), record.cfg
    alignment = network = against = None
    if record.measured:
        planned = {row.point.panel for row in record.points or ()}
        alignment, network = align_survey(cfg, record.mirror, record.measured, planned)
        against = compare(alignment.panels, record.injected) if record.injected else None
    # Without a point that was measured there is no figure of the localization, as in ``summary.json``.
    figures = None if errors is None or not record.measured else error_figures(errors)
    outcome, points, budget = outcome_of(record), point_verdicts(record), time_budget(record)
    quality = quality_of(record, alignment)
    return Findings(record, outcome, points, errors, figures, budget, alignment, network, against, quality)


def observation_of(record: SurveyFiles) -> dict[str, str]:
    """Time (UTC), place, observer and instruments; unknown values are left out."""
    date = {"date_obs": record.log[0].wall, "date_end": record.log[-1].wall} if record.log else {}
    values = {**date, "mirror": record.mirror.name, **record.cfg.observation.model_dump()}
    return {name: value for name, value in values.items() if value}


def metadata_of(found: Findings) -> dict[str, object]:
    """Metadata of the survey in each table; unknown values are left out."""
    record, wavefront = found.record, found.alignment and found.alignment.wavefront
    values = {
        "run": record.name,
        **observation_of(record),
        "simulation": record.is_simulation,
        "outcome": found.outcome.text,
        "cause": found.outcome.cause,
        **coverage_of(found),
        "half_wavefront_before_um": wavefront and round(1e6 * wavefront.before_m, 4),
        "half_wavefront_after_um": wavefront and round(1e6 * wavefront.after_m, 4),
        "puck_height_m": record.cfg.robot.puck_height_m,
        "puck_height_sigma_um": round(1e6 * record.cfg.align.puck_height_sigma_m, 4),
        "creator": " ".join(["ccatp", *sorted({session.version for session in record.sessions})]),
    }
    return {name: value for name, value in values.items() if value not in ("", None)}


def coverage_of(found: Findings) -> dict[str, int]:
    """Measured share of the mirror and of the plan."""
    panels = len(found.record.mirror.panels)
    return {
        "panels_determined": 0 if found.alignment is None else len(found.alignment.panels),
        "panels_of_the_mirror": panels,
        "points_measured": len(found.record.measured),
        "points_planned": len(found.points),
        "points_of_the_mirror": panels * POINTS_PER_PANEL,
    }


# Log line of the supervisor at the end of a complete mission.
_FINISHED = "run finished: status 0"
_OUTCOMES = {
    End.COMPLETE: COMPLETE,
    End.AT_BASE: str(SurveyOutcome.AT_BASE),
    End.STOPPED: str(SurveyOutcome.STOPPED),
    End.FAULTED: "ended with a fault",
    End.INTERRUPTED: "interrupted",
    End.FAILED: "failed",
}


def outcome_of(record: SurveyFiles) -> PointOutcome:
    """Outcome of the run by its summary, otherwise by the last status or the log; without all it runs or was killed."""
    status = record.last_status
    if (known := read_ending(record.summary)) is not None:
        return PointOutcome(_OUTCOMES[known.what], why_text(known), known.what is End.COMPLETE, known.alarms)
    if status is not None and (status.outcome or status.exit_status >= 0):
        ending = ending_of(status, ExitStatus(max(status.exit_status, 0)))
        text = status.outcome or f"ended with status {status.exit_status}, {status.state}"
        return PointOutcome(text, why_text(ending), is_good=status.outcome == COMPLETE, alarms=ending.alarms)
    if record.log and record.log[-1].text == _FINISHED:
        return PointOutcome(COMPLETE, "", is_good=True)
    if status is None:
        return PointOutcome("no mission", "main published no status of the mission", is_good=False)
    if record.summary is None:
        return PointOutcome("no end is recorded", "the run is in progress, or was killed", is_good=False)
    return PointOutcome("interrupted", status.cause or f"while {status.state}", is_good=False)
