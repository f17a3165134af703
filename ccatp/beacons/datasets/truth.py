"""The reference trajectory of a recorded run: put right where it contradicts itself, and its first pose."""

import numpy as np
import numpy.typing as npt

from ccatp.beacons.slam.recording import ReferencePath, Steps, dead_reckoned
from ccatp.core import FloatArray

# Travel over which a course is told from positions: well above the centimetres of GNSS and camera references.
CHORD_M = 0.2
LONGEST_WAY_M = 1e6  # longer ways are no vehicle's; they are not cut into chords
AGREEMENT = 0.8  # length of the mean vector of (course - heading) above which the two differ by a constant
LARGEST_SIDESLIP_RAD = 0.3  # a constant difference below it is the vehicle's own; above it is the reference's frame
PIECE_S = 10.0  # long enough for a turn or two, short enough for odometry
PIECE_POINTS = 40
LEAST_PIECES = 4
TELLING = 0.5  # a turning factor is believed if it halves the misfit of a straight path
FIRST_WAY_M = 2.0  # way whose shape gives the first heading if the reference has positions alone


def way_at(steps: Steps, times_s: FloatArray) -> FloatArray:
    """Signed way travelled by odometry up to each time, m, the shape of ``times_s``."""
    way: FloatArray = np.interp(times_s, steps.times_s, np.concatenate([[0.0], np.cumsum(steps.distance_m)]))
    return way


def turn_at(steps: Steps, times_s: FloatArray) -> FloatArray:
    """Turn by odometry up to each time, rad, the shape of ``times_s``."""
    turn: FloatArray = np.interp(times_s, steps.times_s, np.concatenate([[0.0], np.cumsum(steps.turn_rad)]))
    return turn


def guessed_between(steps: Steps, times_s: FloatArray) -> npt.NDArray[np.bool_]:
    """Whether any of the way between one time (n,) and the next was guessed, shape (n - 1,)."""
    guess = np.broadcast_to(steps.guess_m2, steps.distance_m.shape)
    total = np.interp(times_s, steps.times_s, np.concatenate([[0.0], np.cumsum(guess)]))
    return np.asarray(np.diff(total) > 0.0)


def chords(truth: ReferencePath, steps: Steps) -> npt.NDArray[np.int64]:
    """Rows of the truth some ``CHORD_M`` of travel apart, within the span of the odometry."""
    inside = (truth.times_s >= steps.times_s[0]) & (truth.times_s <= steps.times_s[-1])
    rows = np.flatnonzero(inside)
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(truth.x_m[rows]), np.diff(truth.y_m[rows])))])
    if not rows.size or not CHORD_M <= way[-1] <= LONGEST_WAY_M:
        return rows[:0]
    marks = np.arange(0.0, way[-1], CHORD_M)
    return np.asarray(rows[np.unique(np.minimum(np.searchsorted(way, marks), rows.size - 1))])


def checked_heading(truth: ReferencePath, steps: Steps, warnings: list[str]) -> ReferencePath:
    """The truth with its heading along the course, turned if it is not, and told.

    Course and heading of a vehicle that rolls differ by its sideslip; a large constant difference means that the
    reference counts the heading from elsewhere.
    """
    if not np.isfinite(truth.heading_rad).any():
        return truth
    rows = chords(truth, steps)
    if rows.size < 4:
        return truth
    course = np.arctan2(np.diff(truth.y_m[rows]), np.diff(truth.x_m[rows]))
    heading = 0.5 * (truth.heading_rad[rows[1:]] + truth.heading_rad[rows[:-1]])
    way = np.diff(way_at(steps, truth.times_s[rows]))
    rolls = np.abs(way) > 0.5 * CHORD_M  # by odometry too, so that it is no jump of the reference
    if rolls.sum() < 4:
        return truth
    vector = np.mean(np.exp(1j * (course - heading))[rolls] * np.sign(way[rolls]))
    turned = float(np.angle(vector))
    if abs(vector) < AGREEMENT or abs(turned) < LARGEST_SIDESLIP_RAD:
        return truth
    by = float(np.copysign(np.pi, turned)) if abs(turned) > np.pi - LARGEST_SIDESLIP_RAD else turned
    what = "pi" if abs(by) == np.pi else f"{by:.3f} rad"
    warnings.append(f"truth heading is turned by {what} against the course; it was turned back")
    return truth._replace(heading_rad=truth.heading_rad + by)


def turning_factor(truth: ReferencePath, steps: Steps) -> float | None:
    """By what the turns of the odometry must be multiplied so that its path has the shape of the true one.

    The path is cut into pieces of some ``PIECE_S``; each is laid on the truth by its own rigid motion, and the factor
    with the least median misfit is taken. Needs no heading of the truth. None where no factor is much better than not
    turning at all, or the vehicle hardly moves.
    """
    start_s, end_s = max(steps.times_s[0], truth.times_s[0]), min(steps.times_s[-1], truth.times_s[-1])
    pieces = int((end_s - start_s) / PIECE_S)
    if pieces < LEAST_PIECES:
        return None
    t = np.linspace(start_s, start_s + pieces * PIECE_S, pieces * PIECE_POINTS)
    true = np.interp(t, truth.times_s, truth.x_m) + 1j * np.interp(t, truth.times_s, truth.y_m)
    true = true.reshape(pieces, PIECE_POINTS)
    true -= true.mean(axis=1, keepdims=True)

    def misfit(factor: float) -> float:
        path = dead_reckoned(steps._replace(turn_rad=factor * steps.turn_rad), (0.0, 0.0, 0.0))
        own = np.interp(t, steps.times_s, path[:, 0]) + 1j * np.interp(t, steps.times_s, path[:, 1])
        own = own.reshape(pieces, PIECE_POINTS)
        own = own - own.mean(axis=1, keepdims=True)
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
    if moved < CHORD_M or fine_misfits.min() > TELLING * misfit(0.0):
        return None
    return float(fine[int(np.argmin(fine_misfits))])


def pose_of_truth(truth: ReferencePath | None, steps: Steps, warnings: list[str]) -> tuple[float, float, float]:
    """The first pose: x_m, y_m, heading_rad at the first odometry time; the origin if there is no truth then.

    If the reference has positions alone, the heading is the one that lays the first metres of odometry on the first
    metres of truth, by the least-squares rotation between the two.
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
    return (x, y, _heading_of_first_way(truth, steps))


def _heading_of_first_way(truth: ReferencePath, steps: Steps) -> float:
    path = dead_reckoned(steps, (0.0, 0.0, 0.0))
    way = np.concatenate([[0.0], np.cumsum(np.abs(steps.distance_m))])
    end_s = steps.times_s[min(int(np.searchsorted(way, FIRST_WAY_M)), way.size - 1)]
    rows = (truth.times_s >= steps.times_s[0]) & (truth.times_s <= end_s)
    if rows.sum() < 3:
        return 0.0
    t = truth.times_s[rows]
    p = np.interp(t, steps.times_s, path[:, 0]) + 1j * np.interp(t, steps.times_s, path[:, 1])
    q = truth.x_m[rows] + 1j * truth.y_m[rows]
    return float(np.angle(np.vdot(p - p.mean(), q - q.mean())))
