"""Localization error of a run frame by frame, and where its time went against the least that it takes."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ccatp.core import FloatArray, PointId, StopKind
from ccatp.links.topics import MissionStatus
from ccatp.report.record import WITHIN_MM, RecordedSession, RunRecord
from ccatp.survey.composition import plan_survey
from ccatp.survey.planning.legs import PlanError
from ccatp.survey.planning.route import ORDERS
from ccatp.survey.planning.search import leg_lengths, leg_time, stop_times

SIGMAS = 3.0


class ErrorSeries(NamedTuple):
    """Over the time of all sessions, one after the other.

    Attributes:
        t_s: robot time since the start of the first session, shape (k,).
        sigma3_mm: three standard deviations of the estimated place, shape (k,).
        error_mm: distance of the true place from the estimated one, shape (k,); NaN where the truth is not known.
        fix_t_s, fix_mm, fix_fused: of fixes: how far each moved the estimate, or would have, and whether it was taken.
    """

    t_s: FloatArray
    sigma3_mm: FloatArray
    error_mm: FloatArray
    breaks_s: tuple[float, ...]
    fix_t_s: FloatArray
    fix_mm: FloatArray
    fix_fused: "np.ndarray[tuple[int, ...], np.dtype[np.bool_]]"


class ErrorFigures(NamedTuple):
    """Localization error over all frames with a truth, mm; the share within three sigma and within 10 mm."""

    mean_mm: float
    p50_mm: float
    p99_mm: float
    max_mm: float
    within_sigma3: float
    within_limit: float


def error_series(record: RunRecord) -> ErrorSeries | None:
    """The series; None without an estimate."""
    sessions = [session for session in record.sessions if len(session.track.seq)]
    if not sessions:
        return None
    times, errors, breaks = list[FloatArray](), list[FloatArray](), list[float]()
    fixes = list[tuple[float, float, bool]]()
    start_s = 0.0
    for session in sessions:
        offset_s = start_s - float(session.track.t_s[0])
        times.append(session.track.t_s + offset_s)
        errors.append(_errors_mm(session))
        fixes += [(fix.t_s + offset_s, fix.jump_mm, fix.is_fused) for fix in session.fixes]
        start_s += session.span_s
        breaks.append(start_s)
    table = np.array(fixes, dtype=np.float64).reshape(-1, 3)
    return ErrorSeries(
        t_s=np.concatenate(times),
        sigma3_mm=1e3 * SIGMAS * np.concatenate([session.track.sigma_m for session in sessions]),
        error_mm=np.concatenate(errors),
        breaks_s=tuple(breaks[:-1]),
        fix_t_s=table[:, 0],
        fix_mm=table[:, 1],
        fix_fused=table[:, 2] > 0.0,
    )


def _errors_mm(session: RecordedSession) -> FloatArray:
    errors = np.full(len(session.track.seq), np.nan)
    if session.truth is not None:
        _, i, j = np.intersect1d(session.track.seq, session.truth.seq, assume_unique=True, return_indices=True)
        errors[i] = 1e3 * np.linalg.norm(session.track.place_m[i] - session.truth.place_m[j], axis=1)
    return errors


def error_figures(series: ErrorSeries) -> ErrorFigures | None:
    """The distribution of the errors; None where no truth is known."""
    is_known = np.isfinite(series.error_mm)
    errors = series.error_mm[is_known]
    if not len(errors):
        return None
    p50, p99 = np.percentile(errors, (50, 99))
    return ErrorFigures(
        mean_mm=float(errors.mean()),
        p50_mm=float(p50),
        p99_mm=float(p99),
        max_mm=float(errors.max()),
        within_sigma3=float(np.mean(errors <= series.sigma3_mm[is_known])),
        within_limit=float(np.mean(errors <= WITHIN_MM)),
    )


START_ANEW = "start anew"
KINDS = ("turn", "drive", "settle", "measure", "wait", "back off", "home", START_ANEW)
_KIND_OF = {
    "turning": "turn",
    "driving": "drive",
    "settling": "settle",
    "measuring": "measure",
    "backing off": "back off",
    "returning": "home",
    START_ANEW: START_ANEW,
}
_OVER = "done"
_NEVER_BEGUN = "idle"
_ROUNDING_S = 1e-3  # of a status; a frame takes ten times as long


class TimeSpan(NamedTuple):
    """The mission was in a state for some time."""

    state: str
    duration_s: float


class TimeBreakdown(NamedTuple):
    """Times of a run, s.

    Attributes:
        spent_s: by kind, in the order of ``KINDS``; kinds that did not occur are left out.
        least_s: by kind, of the same way from rest to rest; None where the way is not known.
        visits: how often the robot turned, drove, settled, measured, ...
        is_exact: from the log, frame by frame; else sampled from the status.
    """

    spent_s: dict[str, float]
    least_s: dict[str, float] | None
    visits: dict[str, int]
    is_exact: bool
    covers: str

    @property
    def total_s(self) -> float:
        """Robot time from the beginning to the end."""
        return sum(self.spent_s.values())

    @property
    def mission_s(self) -> float:
        """Without what passed while nobody was there to count it: ``mission_time_s`` of ``summary.json``."""
        return self.total_s - self.spent_s.get(START_ANEW, 0.0)

    @property
    def bound_s(self) -> float | None:
        """The least time of the same way."""
        return None if self.least_s is None else sum(self.least_s.values())


def time_budget(record: RunRecord) -> TimeBreakdown | None:
    """The budget of a run; None where its states are not recorded."""
    spells, is_exact = list[TimeSpan](), True
    for session in record.sessions:
        exact = spells_of(session)
        is_exact = is_exact and exact is not None
        spells += sampled_spells(session) if exact is None else exact
    if not spells:
        return None
    spent, visits = _booked(spells, record.cfg.etalon.measuring_time_s)
    least, covers = least_times(record)
    return TimeBreakdown(spent, least, visits, is_exact, covers)


def spells_of(session: RecordedSession) -> list[TimeSpan] | None:
    """Spells between the state changes in the log; None where it holds none, or the frames are not known.

    The last state of a main loop that died is not logged; the time until the first status of its successor counts as
    waiting, but for that in which there was none.
    """
    track = session.track
    if not session.changes or not len(track.seq):
        return None
    at = np.clip(np.searchsorted(track.seq, [change.seq for change in session.changes]), 0, len(track.seq) - 1)
    times = [float(track.t_s[0]), *track.t_s[at].tolist()]
    spells = [
        TimeSpan(change.before, end - start)
        for change, (start, end) in zip(session.changes, pairwise(times), strict=True)
    ]
    last = session.changes[-1].after
    spells.append(TimeSpan(last, float(track.t_s[-1]) - times[-1]))
    absent_s = sum(uncounted_s(one, later) for one, later in pairwise(_of_frames(session.statuses)))
    anew = [index for index, spell in enumerate(spells) if index and spell.state == _NEVER_BEGUN]
    # What its predecessor did last was not written down in time, so that it is not counted either.
    for index in (place for last in anew for place in (last, last - 1)):
        part_s = min(spells[index].duration_s, absent_s)
        absent_s -= part_s
        spells[index] = spells[index]._replace(duration_s=spells[index].duration_s - part_s)
        spells.append(TimeSpan(START_ANEW, part_s))
    return [spell for spell in spells if spell.duration_s > 0.0 and spell.state != _OVER]


def uncounted_s(one: MissionStatus, later: MissionStatus) -> float:
    """Robot time between two statuses of main that no mission counted: it was restarted in between."""
    passed_s = later.t_s - one.t_s
    missing_s = passed_s - (later.elapsed_s - one.elapsed_s)
    return missing_s if passed_s > 0.0 and missing_s > _ROUNDING_S else 0.0


def _of_frames(statuses: Iterable[MissionStatus]) -> list[MissionStatus]:
    """Those of a main loop that has seen a frame."""
    return [status for status in statuses if status.seq >= 0]


def sampled_spells(session: RecordedSession) -> list[TimeSpan]:
    """Spells as the status shows them: each lasts until the next."""
    spells = []
    for one, later in pairwise(_of_frames(session.statuses)):
        absent_s = uncounted_s(one, later)
        spells += [TimeSpan(one.state, later.t_s - one.t_s - absent_s), TimeSpan(START_ANEW, absent_s)]
    return [spell for spell in spells if spell.state != _OVER and spell.duration_s > 0.0]


def _booked(spells: Iterable[TimeSpan], measuring_s: float) -> tuple[dict[str, float], dict[str, int]]:
    """Spells by kind. A measurement that takes longer than its time was repeated, or waited for the laser."""
    spent, visits = defaultdict[str, float](float), defaultdict[str, int](int)
    for state, duration_s in spells:
        kind = _KIND_OF.get(state, "wait")
        visits[kind] += state != _NEVER_BEGUN
        if kind == "measure" and duration_s > measuring_s:
            spent["wait"] += duration_s - measuring_s
            spent[kind] += measuring_s
        else:
            spent[kind] += duration_s
    # Sums of a hundredth of a second do not come out at 0.
    kinds = [kind for kind in KINDS if spent[kind] > 1e-6]
    return {kind: spent[kind] for kind in kinds}, {kind: visits[kind] for kind in kinds}


def least_times(record: RunRecord) -> tuple[dict[str, float] | None, str]:
    """Least times of the planned way, up to the last point that was measured, and what that covers.

    Bang-bang times from rest to rest, turning in place at every stop (``ccatp.survey.planning.search``), as
    ``lower_bound_s`` of ``summary.json``, which is their sum for a mission that is complete and was not resumed.
    """
    cfg, mirror = record.cfg, record.mirror
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    try:
        stops = plan_survey(cfg, mirror, points, (), []).stops
    except PlanError:
        return None, ""
    measured = {one.point for one in record.measured}
    count = _driven([stop.point for stop in stops], measured)
    if not count:
        return None, ""
    lengths = leg_lengths(stops, mirror.base_pose, mirror)[:count]
    legs_s = sum(leg_time(length, cfg.limits) for length in lengths)
    times_s = sum(stop_times(stops, mirror.base_pose, cfg.limits, mirror)[:count])
    measurements = sum(stop.kind in (StopKind.MEASURE, StopKind.CALIBRATE) for stop in stops[:count])
    least = {"turn": times_s - legs_s, "drive": legs_s, "measure": measurements * cfg.etalon.measuring_time_s}
    whole = len(measured) >= len(points)
    return least, "the whole mission" if whole else "the planned way to the last measured point"


def _driven(points: Sequence[PointId | None], measured: set[PointId]) -> int:
    return max((i + 1 for i, point in enumerate(points) if point in measured), default=0)
