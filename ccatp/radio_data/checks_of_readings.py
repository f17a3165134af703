"""Pure. What readings say against truth and survey, a line each: scale, sign, beacons that are not in their place."""

from collections.abc import Generator, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ccatp.radio.recording import RecordedRun, Truth
from ccatp.samples import FloatArray, IntArray

MANY_SIGMA = 1.4826  # of a Gaussian, over its median absolute deviation
SCALE_WARNING = 0.03
OFFSET_WARNING_M = 0.1
STRANGER_M = 0.3  # readings of a beacon are strange if half of them miss its place by that,
STRANGER_RATIO = 5.0  # and by that many times what the others miss
FITTING = 0.3  # of what they miss their own place by: then they fit another,
EXCHANGED = 0.75  # or, if those of the other fit here as well as theirs there, are exchanged with it
TELLING = 1.5  # times what the others miss, without which nothing is exchanged
AGREEMENT = 0.5  # length of the mean vector of bearing errors that share a constant
CLOSE = 0.9  # the same, of bearings that tell places
PIECES = 4  # of the run, looked at one by one
FEW = 20
FITS = " fit "  # in a line that says whose place it is


class _Seen(NamedTuple):
    """Readings with truth and surveyed place.

    Attributes:
        times_s: shape (m,).
        pose: true x_m, y_m, heading_rad, shape (m, 3).
        beacon: shape (m,).
        range_m: shape (m,).
        bearing_rad: shape (m,); NaN where none was read.
    """

    times_s: FloatArray
    pose: FloatArray
    beacon: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray

    def where(self, rows: npt.NDArray[np.bool_]) -> "_Seen":
        return _Seen(self.times_s[rows], self.pose[rows], self.beacon[rows], self.range_m[rows], self.bearing_rad[rows])


def readings_against(run: RecordedRun, truth: Truth) -> Iterator[str]:
    """What looks wrong in readings where truth and places are known."""
    placed = np.array([run.beacon_truth_m.get(name, (np.nan, np.nan)) for name in run.beacon_ids]).reshape(-1, 2)
    r, t = run.readings, run.readings.times_s
    inside = (t >= truth.times_s[0]) & (t <= truth.times_s[-1]) & np.isfinite(r.range_m)
    inside &= np.isfinite(placed[r.beacon, 0])
    if inside.sum() < FEW:
        return
    pose = np.column_stack([np.interp(t[inside], truth.times_s, column) for column in truth[1:]])
    if not np.isfinite(truth.heading_rad).all():
        pose[:, 2] = np.nan
    seen = _Seen(t[inside], pose, r.beacon[inside], r.range_m[inside], r.bearing_rad[inside])
    told, off_rad = _bearings(seen, placed)
    strange = yield from _misplaced(run.beacon_ids, placed, seen, off_rad)
    yield from _ranges(seen, placed, strange)
    yield from told


def unit_slip(scale: float, units: tuple[tuple[str, float], ...]) -> str:
    """The question whether they are in that unit, for a scale that is near one's."""
    near = [name for name, factor in units if abs(scale / factor - 1.0) < 0.15]
    return f": are they in {near[0]}?" if near else ""


def _ranges(seen: _Seen, placed: FloatArray, strange: list[int]) -> Iterator[str]:
    """Slope and offset over true distances; of beacons that are not in their place nothing follows."""
    sound = ~np.isin(seen.beacon, strange)
    if sound.sum() >= FEW:
        seen = seen.where(sound)
    scale, offset = _robust_line(np.hypot(*(placed[seen.beacon] - seen.pose[:, :2]).T), seen.range_m)
    unit = unit_slip(1.0 / scale if scale else 0.0, (("millimetres", 1e-3), ("centimetres", 1e-2), ("feet", 0.3048)))
    if unit:
        yield f"ranges read {scale:.4g} times the truth{unit}"
    elif abs(scale - 1.0) > SCALE_WARNING:
        yield f"ranges read {100.0 * (scale - 1.0):+.1f} per cent and {offset:+.2f} m off (fit to the truth)"
    elif abs(offset) > OFFSET_WARNING_M:
        yield f"ranges read {offset:+.2f} m off (fit to the truth)"


def _bearings(seen: _Seen, placed: FloatArray) -> tuple[list[str], float | None]:
    """What is told of bearings, and their constant error, rad; None where they tell no place."""
    to = placed[seen.beacon] - seen.pose[:, :2]
    expected = np.arctan2(to[:, 1], to[:, 0]) - seen.pose[:, 2]
    known = np.isfinite(seen.bearing_rad + expected)
    if known.sum() < FEW:
        return [], None
    bearing, expected = seen.bearing_rad[known], expected[known]
    mean, mirrored = (complex(np.mean(np.exp(1j * (sign * bearing - expected)))) for sign in (1.0, -1.0))
    if abs(mirrored) > max(AGREEMENT, abs(mean)) and abs(np.angle(mirrored)) < 0.5:
        return ["bearings fit the truth with the other sign: are they clockwise?"], None
    if abs(mean) <= AGREEMENT:
        return [], None
    off_rad = float(np.angle(mean))
    told = [f"bearings read {off_rad:+.3f} rad off (against the truth)"] if abs(off_rad) > 0.05 else []
    return told, off_rad if abs(mean) > CLOSE else None


def _robust_line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Slope and offset of y over x, outliers left out by and by."""
    keep = np.ones(x.size, dtype=bool)
    slope, offset = 1.0, 0.0
    for _ in range(5):
        slope, offset = np.polyfit(x[keep], y[keep], 1).tolist()
        residual = y - slope * x - offset
        sigma = MANY_SIGMA * float(np.median(np.abs(residual - np.median(residual))))
        keep = np.abs(residual) <= max(3.0 * sigma, 1e-9)
    return slope, offset


def _misplaced(
    names: tuple[str, ...], placed: FloatArray, seen: _Seen, off_rad: float | None
) -> Generator[str, None, list[int]]:
    """Beacons that do not fit their surveyed place, all along or for a part of the run; returns them."""
    whole = _unlike(names, _misses(placed, seen), _misses(placed, seen, off_rad))
    explained = {k for line, beacons in whole.items() if FITS in line for k in beacons}
    edges = np.linspace(seen.times_s[0], seen.times_s[-1], PIECES + 1)
    parts: dict[str, list[int]] = {}
    partly: set[int] = set()
    for piece in range(PIECES):
        now = seen.where((seen.times_s >= edges[piece]) & (seen.times_s <= edges[piece + 1]))
        for line, beacons in _unlike(names, _misses(placed, now), _misses(placed, now, off_rad)).items():
            if FITS in line and not explained.intersection(beacons):  # a few readings may all be off: no misses
                parts.setdefault(line.split(" (by ")[0], []).append(piece)
                partly.update(beacons)
    yield from (line for line, beacons in whole.items() if not partly.intersection(beacons))
    for line, pieces in parts.items():
        yield f"from {edges[pieces[0]]:.0f} to {edges[pieces[-1] + 1]:.0f} s alone: {line}"
    return sorted(partly.union(*whole.values()))


def _misses(placed: FloatArray, seen: _Seen, off_rad: float | None = None) -> FloatArray:
    """Median miss, m, of the readings of one beacon at the place of another, shape (n, n); NaN where there are few.

    With the constant error of the bearings it is that of the place where they point, else that of the range.
    """
    count = len(placed)
    miss = np.full((count, count), np.nan)
    way = seen.bearing_rad - (off_rad or 0.0) + seen.pose[:, 2]
    pointed = seen.pose[:, :2] + seen.range_m[:, None] * np.column_stack([np.cos(way), np.sin(way)])
    for k in range(count):
        rows = seen.beacon == k
        if rows.sum() < FEW:
            continue
        for other in np.flatnonzero(np.isfinite(placed[:, 0])).tolist():
            if off_rad is not None and np.isfinite(pointed[rows]).all():
                off = np.hypot(*(placed[other] - pointed[rows]).T)
            else:
                off = np.abs(seen.range_m[rows] - np.hypot(*(placed[other] - seen.pose[rows, :2]).T))
            miss[k, other] = np.median(off)
    return miss


def _unlike(names: tuple[str, ...], miss: FloatArray, pointed: FloatArray) -> dict[str, tuple[int, ...]]:
    """Lines on beacons whose readings do not fit their surveyed place, each with those beacons."""
    if not np.isfinite(np.diag(miss)).any():
        return {}
    own, usual = _own_and_usual(pointed)
    gain = pointed / own[:, None]
    mutual = np.maximum(gain, gain.T)  # the worse of both directions
    mutual[~(np.minimum.outer(own, own) > TELLING * usual)] = np.nan
    lines: dict[str, tuple[int, ...]] = {}
    paired: set[int] = set()
    for k, other in zip(*np.unravel_index(np.argsort(mutual, axis=None), mutual.shape), strict=True):
        if k < other and mutual[k, other] < EXCHANGED and not paired & {k, other}:
            paired |= {int(k), int(other)}
            line = f"beacons {names[k]} and {names[other]} look exchanged: each one's ranges fit the other's place"
            lines[line] = (int(k), int(other))
    own, usual = _own_and_usual(miss)
    strange = [k for k in range(len(names)) if own[k] > max(STRANGER_M, STRANGER_RATIO * usual) and k not in paired]
    for k in strange:
        best = int(np.nanargmin(miss[k]))
        if miss[k, best] < FITTING * own[k]:
            line = f"ranges of beacon {names[k]} fit the place of {names[best]}, not its own (by {own[k]:.1f} m)"
        else:
            line = f"ranges of beacon {names[k]} miss its surveyed place by {own[k]:.1f} m (half of them)"
        lines[line] = (k,)
    return lines


def _own_and_usual(miss: FloatArray) -> tuple[FloatArray, float]:
    """What each misses its own place by, and what is usual: most may be wrong."""
    own = np.diag(miss)
    return own, float(np.nanquantile(own, 0.25))
