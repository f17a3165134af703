"""Pure. How well the robot knew where it was: true against estimated place in every frame, and its own three sigma."""

from typing import NamedTuple

import numpy as np

from ccatp.reporting.record import WITHIN_MM, FloatArray, RunRecord, Session

SIGMAS = 3.0


class ErrorSeries(NamedTuple):
    """Over the time of all sessions, one after the other.

    Attributes:
        t_s: robot time since the start of the first session, shape (k,).
        sigma3_mm: three standard deviations of the estimated place, shape (k,).
        error_mm: distance of the true place from the estimated one, shape (k,); NaN where the truth is not known.
        breaks_s: where a session ends and the next begins.
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


def _errors_mm(session: Session) -> FloatArray:
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
