"""Pure. Long series made short without a visible change: lines by their corners, series by what a pixel shows."""

from typing import NamedTuple

import numpy as np

from ccatp.drawing.shapes import FloatArray


def thinned(points: FloatArray, tolerance: float) -> FloatArray:
    """A line with fewer points that stays within ``tolerance`` of the given one (Ramer, Douglas and Peucker).

    Args:
        points: shape (k, 2); rows of NaN part the line, and stay.
        tolerance: in the unit of the points.
    """
    if not len(points):
        return points
    gap = np.isnan(points).any(axis=1)
    pieces: list[FloatArray] = []
    start = 0
    for end in [*np.flatnonzero(gap).tolist(), len(points)]:
        if end > start:
            pieces += [_thinned_piece(points[start:end], tolerance), np.full((1, 2), np.nan)]
        start = end + 1
    return np.concatenate(pieces[:-1]) if pieces else points[:0]


def _thinned_piece(points: FloatArray, tolerance: float) -> FloatArray:
    points = _without_standing(points, 0.5 * tolerance)
    keep = np.zeros(len(points), dtype=np.bool_)
    keep[[0, -1]] = True
    open_spans = [(0, len(points) - 1)]
    while open_spans:
        first, last = open_spans.pop()
        if last - first < 2:
            continue
        distances = _distances(points[first + 1 : last], points[first], points[last])
        worst = int(np.argmax(distances))
        if distances[worst] > 0.5 * tolerance:
            keep[first + 1 + worst] = True
            open_spans += [(first, first + 1 + worst), (first + 1 + worst, last)]
    return points[keep]


def _without_standing(points: FloatArray, step: float) -> FloatArray:
    """Leave out what hardly differs from the point kept before it."""
    rounded = np.floor(points / step)
    is_new = np.ones(len(points), dtype=np.bool_)
    is_new[1:] = (rounded[1:] != rounded[:-1]).any(axis=1)
    is_new[-1] = True
    return points[is_new]


def _distances(points: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """From the straight piece between two points, shape (k,)."""
    along = end - start
    length2 = float(along @ along)
    offset = points - start
    if length2 > 0.0:
        offset = offset - np.clip(offset @ along / length2, 0.0, 1.0)[:, None] * along
    return np.asarray(np.hypot(offset[:, 0], offset[:, 1]))


class Envelope(NamedTuple):
    """Least and largest value in each interval that has any: centres x, least y, largest y, mean y; shape (k,)."""

    x: FloatArray
    low: FloatArray
    high: FloatArray
    mean: FloatArray


def envelope(x: FloatArray, y: FloatArray, intervals: int) -> Envelope:
    """A series as so many intervals of equal length show it; values that are not finite are left out.

    Args:
        x: shape (k,), in any order.
        y: shape (k,).
        intervals: at least 1.
    """
    is_good = np.isfinite(x) & np.isfinite(y)
    x, y = x[is_good], y[is_good]
    if not len(x):
        empty = np.empty(0)
        return Envelope(empty, empty, empty, empty)
    low, high = float(x.min()), float(x.max())
    width = (high - low) / intervals or 1.0
    index = np.minimum(((x - low) / width).astype(np.int64), intervals - 1)
    order = np.argsort(index, kind="stable")
    found, starts, counts = np.unique(index[order], return_index=True, return_counts=True)
    sorted_y = y[order]
    return Envelope(
        low + (found + 0.5) * width,
        np.minimum.reduceat(sorted_y, starts),
        np.maximum.reduceat(sorted_y, starts),
        np.add.reduceat(sorted_y, starts) / counts,
    )
