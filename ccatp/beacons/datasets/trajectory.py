"""Odometry and reference trajectory of a recorded run: filling gaps, correcting contradictions, the first pose."""

import numpy as np
import numpy.typing as npt

from ccatp.beacons.datasets.tables import Table, long_pauses
from ccatp.beacons.estimation.evaluation import truth_at
from ccatp.beacons.estimation.recording import ReferencePath, Steps, antenna_path, dead_reckoned, running_total
from ccatp.core import FloatArray
from ccatp.filters.metrics import wrapped

BEFORE_S = 1.0  # time before a gap over which the speed is measured
WINDOWS = 1000  # samples of the run at which the speed is compared with the speed before
LOST_RAD = float(np.pi / np.sqrt(3.0))  # standard deviation of a uniformly distributed heading: the largest possible
# Travel between positions that give a course: well above the centimetres of error of GNSS and camera references.
CHORD_M = 0.2
LONGEST_WAY_M = 1e6  # longer paths are impossible for a vehicle and are not cut into chords
AGREEMENT = 0.8  # length of the mean vector of (course - heading) above which the two differ by a constant
LARGEST_SIDESLIP_RAD = 0.3  # a smaller constant difference is sideslip; a larger one is an error of the reference
CONSTANT_RAD = 1e-6  # span of a heading that never changes
TURNED_RAD = 0.5  # by the odometry meanwhile
FEWEST_CHORDS = 20
DRIFTS = 40  # chords of a piece, in each of which the odometry has a heading of its own: it drifts
STRAIGHT = 0.95  # length of the mean vector of the course above which the path does not turn
PIECE_S = 10.0  # long enough for one or two turns, short enough for the drift of odometry
PIECE_POINTS = 40
LEAST_PIECES = 4
MISFIT_RATIO = 0.5  # a turning factor is accepted if it halves the misfit of a straight path
FIRST_WAY_M = 2.0  # length of path that gives the first heading if the reference has only positions


def amount_at(steps: Steps, amounts: FloatArray | float, times_s: FloatArray) -> FloatArray:
    """Running total of amounts per step (n,), interpolated at each time; the shape of ``times_s``."""
    total = running_total(np.broadcast_to(amounts, steps.distance_m.shape))
    found: FloatArray = np.interp(times_s, steps.times_s, total)
    return found


def motions_between(poses: Table) -> Table:
    """Odometry from rows of time, x, y and heading, shape (n, 4): the motion since the row before, along and across.

    The first row has none.
    """
    values = poses.values
    turn = wrapped(np.diff(values[:, 3]))
    dx, dy, middle = np.diff(values[:, 1]), np.diff(values[:, 2]), values[:-1, 3] + 0.5 * turn
    c, s = np.cos(middle), np.sin(middle)
    moves = np.column_stack([c * dx + s * dy, turn, c * dy - s * dx])
    return poses._replace(values=np.column_stack([values[:, 0], np.vstack([np.zeros((1, 3)), moves])]))


def way_at(steps: Steps, times_s: FloatArray) -> FloatArray:
    """Length of the way until each time, m; the shape of ``times_s``."""
    return amount_at(steps, np.hypot(steps.distance_m, steps.lateral_m), times_s)


def bridged(steps: Steps) -> Steps:
    """Steps without gaps: distances and turns that are NaN, or span a pause of the recording, are extrapolated.

    The extrapolation assumes that the vehicle keeps a share of its rate in the last ``BEFORE_S``. The share and its
    error come from the run: a least-squares fit, over all spans as long as the gap, of the rate in the span to the rate
    before it. With a heading error of sigma, the mean displacement is shorter by exp(-sigma^2 / 2); the rest of it
    becomes variance.
    """
    interval_s = np.diff(steps.times_s)
    unknown = np.isnan(steps.distance_m + steps.turn_rad + steps.lateral_m)
    unknown[long_pauses(steps.times_s)] = True
    if not unknown.any() or unknown.all():
        return steps
    known_s = running_total(interval_s[~unknown])
    way, turn = (running_total(column[~unknown]) for column in (steps.distance_m, steps.turn_rad))
    distance_m, turn_rad, lateral_m = steps.distance_m.copy(), steps.turn_rad.copy(), steps.lateral_m.copy()
    guess_m2, guess_rad2 = np.zeros(unknown.size), np.zeros(unknown.size)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], unknown, [False]]))).tolist()
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        gap = slice(first, stop)
        span_s = float(interval_s[gap].sum())
        begin_s = float(interval_s[:first][~unknown[:first]].sum())
        way_share, way_sigma = _guessed(known_s, way, span_s)
        turn_share, turn_sigma = _guessed(known_s, turn, span_s)
        lost_rad = min(turn_sigma, LOST_RAD)
        kept = float(np.exp(-0.5 * lost_rad**2))
        went_m = way_share * _rate_before(known_s, way, begin_s) * span_s
        part = interval_s[gap] / span_s
        distance_m[gap] = kept * went_m * part
        turn_rad[gap] = turn_share * _rate_before(known_s, turn, begin_s) * span_s * part
        lateral_m[gap] = 0.0
        guess_m2[gap] = (way_sigma * way_sigma + went_m * went_m * (1.0 - kept * kept)) * part
        guess_rad2[gap] = lost_rad**2 * part
    return Steps(steps.times_s, distance_m, turn_rad, lateral_m, guess_m2, guess_rad2)


def _rate_before(times_s: FloatArray, total: FloatArray, at_s: float) -> float:
    from_s = max(at_s - BEFORE_S, float(times_s[0]))
    if at_s <= from_s:
        return 0.0
    begin, end = np.interp((from_s, at_s), times_s, total).tolist()
    return float((end - begin) / (at_s - from_s))


def _guessed(times_s: FloatArray, total: FloatArray, span_s: float) -> tuple[float, float]:
    """Ratio of the rate in a span to the rate before it, and the standard deviation of the amount in the span.

    Spans are at most half the run.
    """
    whole_s = float(times_s[-1] - times_s[0])
    before_s, seen_s = min(BEFORE_S, 0.25 * whole_s), min(span_s, 0.5 * whole_s)
    t = np.linspace(times_s[0] + before_s, times_s[-1] - seen_s, WINDOWS)
    at, later, sooner = (np.interp(t + shift, times_s, total) for shift in (0.0, seen_s, -before_s))
    rate, went = (at - sooner) / before_s, (later - at) / seen_s
    square = float(rate @ rate)
    share = float(rate @ went) / square if square > 0.0 else 0.0
    return share, float(np.sqrt(np.mean((went - share * rate) ** 2))) * span_s


def chords(truth: ReferencePath, steps: Steps) -> npt.NDArray[np.int64]:
    """Rows of the truth about ``CHORD_M`` of travel apart, within the span of the odometry."""
    inside = (truth.times_s >= steps.times_s[0]) & (truth.times_s <= steps.times_s[-1])
    rows = np.flatnonzero(inside)
    way = running_total(np.hypot(np.diff(truth.x_m[rows]), np.diff(truth.y_m[rows])))
    if not rows.size or not CHORD_M <= way[-1] <= LONGEST_WAY_M:
        return rows[:0]
    marks = np.arange(0.0, way[-1], CHORD_M)
    return np.asarray(rows[np.unique(np.minimum(np.searchsorted(way, marks), rows.size - 1))])


# How else headings are written: the words for it, factor, direction of zero.
_DEGREE = np.pi / 180.0
WRITTEN = (
    ("in degrees", _DEGREE, 0.0),
    ("clockwise from the y axis, as those of a compass", -1.0, 0.5 * np.pi),
    ("in degrees clockwise from the y axis, as those of a compass", -_DEGREE, 0.5 * np.pi),
    ("clockwise", -1.0, 0.0),
    ("in degrees clockwise", -_DEGREE, 0.0),
)
CLEARLY = 0.3  # of the circular variance of course - heading remains if headings are read in the other way
CONTRADICTS = 0.5  # length of its mean vector, below which headings have little to do with the course


def heading_as_written(truth: ReferencePath, steps: Steps, warnings: list[str], *, turns: bool = True) -> FloatArray:
    """The heading of a truth, rad, counter-clockwise from x, continuous, shape (k,), whatever its unit and direction.

    The course of the truth decides between the ways of writing. To reverse the direction of turning, the odometry must
    turn as the course does, too. If the headings contradict a course with which the odometry agrees, they are NaN.
    ``turns``: whether to change them; else there is only the warning. ``truth``: with headings as they were written.
    """
    as_is = np.unwrap(truth.heading_rad)
    rows = chords(truth, steps)
    if rows.size < FEWEST_CHORDS or not np.isfinite(truth.heading_rad).all() or np.ptp(truth.heading_rad) == 0.0:
        return as_is
    t = truth.times_s[rows]
    ahead_m, left_m = (np.diff(amount_at(steps, column, t)) for column in (steps.distance_m, steps.lateral_m))
    way_m = np.hypot(ahead_m, left_m)
    moves = (np.diff(truth.x_m[rows]) + 1j * np.diff(truth.y_m[rows])) * (ahead_m - 1j * left_m)
    moves = np.where(way_m > 0.5 * CHORD_M, moves / np.maximum(np.abs(moves), 1e-9), 0.0)  # without jumps of the truth
    count = max(int((way_m > 0.5 * CHORD_M).sum()), 1)

    def mean_of(heading_rad: FloatArray) -> complex:
        ends = np.exp(1j * heading_rad)
        return complex((moves * (ends[1:] + ends[:-1]).conj()).sum() / (2.0 * count))

    def odometry_agrees(sign: float) -> float:
        middle = 0.5 * (turned[1:] + turned[:-1])
        parts = np.array_split(moves * np.exp(-1j * sign * middle), max(moves.size // DRIFTS, 1))
        return float(np.sum([abs(part.sum()) for part in parts]) / count)

    turned = amount_at(steps, steps.turn_rad, t)
    is_course = odometry_agrees(1.0) > max(AGREEMENT, odometry_agrees(-1.0))
    now = abs(mean_of(truth.heading_rad[rows]))
    for what, factor, zero_rad in WRITTEN:
        mean = mean_of(zero_rad + factor * truth.heading_rad[rows])
        fits = abs(mean) > AGREEMENT and 1.0 - abs(mean) < CLEARLY * (1.0 - now)
        if fits and (factor > 0.0 or (is_course and abs(np.angle(mean)) < LARGEST_SIDESLIP_RAD)):
            done = "they were converted" if turns else "they are used as they are"
            warnings.append(f"headings of the truth fit its course {what}: {done}")
            return np.unwrap(zero_rad + factor * truth.heading_rad) if turns else as_is
    if is_course and now < CONTRADICTS:
        done = "not used" if turns else "used as they are"
        warnings.append(f"headings of the truth contradict its course, with which the odometry agrees: {done}")
        return np.full(as_is.size, np.nan) if turns else as_is
    return as_is


def checked_heading(truth: ReferencePath, steps: Steps, warnings: list[str], *, turns: bool = True) -> ReferencePath:
    """The truth with its heading along the course; if it is not, it is rotated with a warning.

    Course and heading differ by the direction in which the odometry moves, and by its sideslip; a large constant rest
    means that the reference measures the heading from another direction. A heading that never changes while the course
    turns is none. ``turns``: whether to rotate it; else there is only the warning.
    """
    if not np.isfinite(truth.heading_rad).any():
        return truth
    rows = chords(truth, steps)
    if rows.size < 4:
        return truth
    t = truth.times_s[rows]
    course = np.arctan2(np.diff(truth.y_m[rows]), np.diff(truth.x_m[rows]))
    by_odometry_rad = float(np.ptp(running_total(steps.turn_rad)))
    is_constant = float(np.ptp(truth.heading_rad)) < CONSTANT_RAD and by_odometry_rad > TURNED_RAD
    if is_constant and abs(np.mean(np.exp(1j * course))) < STRAIGHT:
        warnings.append(
            f"the truth has no heading: it is {truth.heading_rad[0]:.3g} rad throughout, while its course turns; it is "
            "not used"
        )
        return truth._replace(heading_rad=np.full(len(truth.times_s), np.nan))
    heading = 0.5 * (truth.heading_rad[rows[1:]] + truth.heading_rad[rows[:-1]])
    ahead_m, left_m = (np.diff(amount_at(steps, column, t)) for column in (steps.distance_m, steps.lateral_m))
    way_m = np.hypot(ahead_m, left_m)
    rolls = way_m > 0.5 * CHORD_M  # by odometry too, to exclude jumps of the reference
    if rolls.sum() < 4:
        return truth
    vector = np.mean(
        np.exp(1j * (course - heading))[rolls] * ((ahead_m - 1j * left_m) / np.maximum(way_m, 1e-9))[rolls]
    )
    turned = float(np.angle(vector))
    if abs(vector) < AGREEMENT or abs(turned) < LARGEST_SIDESLIP_RAD:
        return truth
    by = float(np.copysign(np.pi, turned)) if abs(turned) > np.pi - LARGEST_SIDESLIP_RAD else turned
    what = "pi" if abs(by) == np.pi else f"{by:.3f} rad"
    done = "it was turned back" if turns else "it is used as it is"
    warnings.append(f"truth heading is turned by {what} against the course; {done}")
    return truth._replace(heading_rad=truth.heading_rad + by) if turns else truth


def turning_factor(truth: ReferencePath, steps: Steps) -> float | None:
    """The factor of the turns of the odometry for which its path has the shape of the true one.

    The path is cut into pieces of ``PIECE_S``. Each is fitted to the truth by its own rigid motion, and the factor with
    the least median misfit is taken. Needs no heading of the truth. None if no factor is much better than no turning at
    all, or if the vehicle hardly moves.
    """
    start_s, end_s = max(steps.times_s[0], truth.times_s[0]), min(steps.times_s[-1], truth.times_s[-1])
    pieces = int((end_s - start_s) / PIECE_S)
    if pieces < LEAST_PIECES:
        return None
    t = np.linspace(start_s, start_s + pieces * PIECE_S, pieces * PIECE_POINTS)

    def cut(times_s: FloatArray, x_m: FloatArray, y_m: FloatArray) -> npt.NDArray[np.complex128]:
        points = (np.interp(t, times_s, x_m) + 1j * np.interp(t, times_s, y_m)).reshape(pieces, PIECE_POINTS)[there]
        return np.asarray(points - points.mean(axis=1, keepdims=True))

    there = np.isfinite(truth_at(truth, t)[:, 0]).reshape(pieces, PIECE_POINTS).all(axis=1)
    if there.sum() < LEAST_PIECES:
        return None
    true = cut(*truth[:3])

    def misfit(factor: float) -> float:
        path = dead_reckoned(steps._replace(turn_rad=factor * steps.turn_rad), (0.0, 0.0, 0.0))
        own = cut(steps.times_s, path[:, 0], path[:, 1])
        turned = (own.conj() * true).sum(axis=1)
        turned /= np.maximum(np.abs(turned), 1e-12)
        return float(np.median(np.sqrt((np.abs(own * turned[:, None] - true) ** 2).mean(axis=1))))

    sizes = np.geomspace(1.0 / 64.0, 64.0, 85)
    factors = np.concatenate([-sizes, sizes])
    misfits = np.array([misfit(float(factor)) for factor in factors])
    best = float(factors[int(np.argmin(misfits))])
    fine = best * np.linspace(0.9, 1.1, 41)
    fine_misfits = np.array([misfit(float(factor)) for factor in fine])
    moved = float(np.median(np.abs(true).max(axis=1)))
    if moved < CHORD_M or fine_misfits.min() > MISFIT_RATIO * misfit(0.0):
        return None
    return float(fine[int(np.argmin(fine_misfits))])


def pose_of_truth(truth: ReferencePath | None, steps: Steps, warnings: list[str]) -> tuple[float, float, float]:
    """The first pose: x_m, y_m, heading_rad at the first odometry time; the origin without truth.

    If the reference has only positions, the heading is the least-squares rotation of the first metres of odometry onto
    the first metres of truth.
    """
    if truth is None:
        warnings.append("no reference trajectory: the first pose is the origin, errors of the path stay unknown")
        return (0.0, 0.0, 0.0)
    start_s = float(steps.times_s[0])
    if not truth.times_s[0] - 1.0 <= start_s <= truth.times_s[-1]:
        warnings.append(
            f"the truth (from {truth.times_s[0]:.3f} to {truth.times_s[-1]:.3f} s) does not cover the first odometry "
            f"({start_s:.3f} s): the first pose is the truth's nearest"
        )
    x = float(np.interp(start_s, truth.times_s, truth.x_m))
    y = float(np.interp(start_s, truth.times_s, truth.y_m))
    if np.isfinite(truth.heading_rad[0]):
        known = np.isfinite(truth.heading_rad)
        return (x, y, float(np.interp(start_s, truth.times_s[known], truth.heading_rad[known])))
    path = dead_reckoned(steps, (0.0, 0.0, 0.0))
    way = running_total(np.abs(steps.distance_m))
    end_s = steps.times_s[min(int(np.searchsorted(way, FIRST_WAY_M)), way.size - 1)]
    rows = (truth.times_s >= start_s) & (truth.times_s <= end_s)
    if rows.sum() < 3:
        return (x, y, 0.0)
    t = truth.times_s[rows]
    p = np.interp(t, steps.times_s, path[:, 0]) + 1j * np.interp(t, steps.times_s, path[:, 1])
    q = truth.x_m[rows] + 1j * truth.y_m[rows]
    return (x, y, float(np.angle(np.vdot(p - p.mean(), q - q.mean()))))


def at_antenna(
    steps: Steps, truth: ReferencePath | None, first_pose: tuple[float, float, float], antenna_m: tuple[float, float],
    warnings: list[str], *, is_given: bool = False,
) -> tuple[Steps, ReferencePath | None, tuple[float, float, float]]:  # fmt: skip
    """The run as the path of an antenna, mounted ahead and to the left of the odometry's reference point.

    A turn w about that point moves the antenna across its lever arm by 2 sin(w / 2) times the arm, in the frame at the
    middle of the turn. Positions of a truth without headings are the antenna's, so the first pose comes from them and
    the path of the antenna, unless it ``is_given``.
    """
    ahead_m, left_m = antenna_m
    swing = 2.0 * np.sin(0.5 * steps.turn_rad)
    steps = steps._replace(distance_m=steps.distance_m - swing * left_m, lateral_m=steps.lateral_m + swing * ahead_m)
    x_m, y_m, heading_rad = first_pose
    (x_m, y_m), *_ = antenna_path(np.array([first_pose]), antenna_m).tolist()
    if truth is not None and np.isfinite(truth.heading_rad).all():
        moved = antenna_path(np.column_stack([truth.x_m, truth.y_m, truth.heading_rad]), antenna_m)
        truth = truth._replace(x_m=moved[:, 0], y_m=moved[:, 1])
    elif truth is not None:
        warnings.append("the truth has no headings: its positions are taken as the antenna's")
        if not is_given:
            x_m, y_m, heading_rad = pose_of_truth(truth, steps, warnings)
    return steps, truth, (x_m, y_m, heading_rad)
