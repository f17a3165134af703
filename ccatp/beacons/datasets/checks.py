"""Warnings about a recorded run: units, gaps, readings and odometry against truth and survey."""

from collections.abc import Generator, Iterator

import numpy as np
import numpy.typing as npt

from ccatp.beacons.datasets.consistency import inconsistencies
from ccatp.beacons.datasets.mounting import misplaced_radios, robust_fit
from ccatp.beacons.datasets.tables import GAP_S, instant, long_pauses, plural
from ccatp.beacons.datasets.trajectory import amount_at, chords, turning_factor, way_at
from ccatp.beacons.estimation.evaluation import truth_at
from ccatp.beacons.estimation.recording import BoolArray, Readings, RecordedRun, ReferencePath, Steps, first_of_each
from ccatp.beacons.rigid_motion import aligned_rms_m, best_motion
from ccatp.core import FloatArray

MANY_SIGMA = 1.4826  # of a Gaussian, over its median absolute deviation
SCALE_WARNING = 0.03
OFFSET_WARNING_M = 0.1
STRANGER_M = 0.3  # readings of a beacon are suspicious if their median miss of its position is larger,
STRANGER_RATIO = 5.0  # also relative to the usual miss of the beacons
FITTING = 0.3  # readings fit another position if they miss it by less than this share of the miss of their own
EXCHANGED = 0.75  # two beacons are exchanged if the readings of each fit the other position by this share,
EXCHANGE_FACTOR = 1.5  # and miss their own position by this many times the usual miss
LEAST_FRAME = 3  # beacons that tell a frame
AGREEMENT = 0.5  # length of the mean vector of bearing errors above which they have a common constant
CLOSE = 0.9  # the same, above which bearings are good enough to compute positions
PIECES = 4  # of the run, checked separately
FEW = 20
FITS = " fit "  # in a warning that names the fitting position
LENGTHS = (("millimetres", 1e-3), ("centimetres", 1e-2), ("feet", 0.3048))


def readings_against(run: RecordedRun, truth: ReferencePath) -> Iterator[str]:
    """Warnings about readings while the truth is known, of beacons with known positions."""
    placed = np.array([run.beacon_truth_m.get(name, (np.nan, np.nan)) for name in run.beacon_ids]).reshape(-1, 2)
    r, t = run.readings, run.readings.times_s
    pose = truth_at(truth, t)
    inside = np.isfinite(pose[:, 0]) & np.isfinite(r.range_m) & np.isfinite(placed[r.beacon, 0])
    if inside.sum() < FEW:
        return
    pose, seen = pose[inside], r.where(inside)
    if not np.isfinite(truth.heading_rad).all():
        pose[:, 2] = np.nan
        seen = seen._replace(arm_m=None)  # without a heading the radios are about where the vehicle is
    pose[:, :2] = seen.radios_at(pose)
    if frame := _other_frame(seen, pose, placed):
        yield frame
        return
    lines, off_rad = _bearings(seen, pose, placed)
    strange = yield from _misplaced(run.beacon_ids, placed, seen, pose, off_rad)
    yield from _ranges(seen, pose, placed, strange)
    yield from lines


def _other_frame(seen: Readings, pose: FloatArray, placed: FloatArray) -> str:
    """A warning if the survey fits the places that ranges from the true path give only after a rigid motion.

    r^2 = |p|^2 - 2 p b + |b|^2 is linear in the place b and |b|^2.
    """
    found, given = [], []
    for k in np.unique(seen.beacon).tolist():
        rows = (seen.beacon == k) & (seen.range_m > 0.0)
        if rows.sum() < FEW:
            continue
        middle = pose[rows, :2].mean(axis=0)
        p, r = pose[rows, :2] - middle, seen.range_m[rows]
        terms, *_ = robust_fit(np.column_stack([-p, 0.5 + 0.0 * r]) / r[:, None], 0.5 * (r**2 - (p**2).sum(axis=1)) / r)
        found.append(middle + terms[:2])
        given.append(placed[k])
    if len(found) < LEAST_FRAME:
        return ""
    miss_m = float(np.sqrt(np.mean(np.sum((np.array(found) - given) ** 2, axis=1))))
    fit_m = aligned_rms_m(np.array(found), np.array(given))
    if miss_m < max(STRANGER_RATIO * fit_m, 2.0 * STRANGER_M):
        return ""
    motion = best_motion(np.array(given), np.array(found))
    return (
        f"the survey is in another frame than the truth: its beacons are {miss_m:.2g} m from where ranges on the true "
        f"path have them, and {fit_m:.2g} m if the survey is turned by {motion.angle_rad:.3g} rad and moved"
    )


def _unit_slip(scale: float, units: tuple[tuple[str, float], ...] = LENGTHS) -> str:
    near = [name for name, factor in units if abs(scale / factor - 1.0) < 0.15]
    return f": are they in {near[0]}?" if near else ""


def _ranges(seen: Readings, pose: FloatArray, placed: FloatArray, strange: list[int]) -> Iterator[str]:
    sound = ~np.isin(seen.beacon, strange)
    if sound.sum() >= FEW:
        seen, pose = seen.where(sound), pose[sound]
    scale, offset = _robust_line(np.hypot(*(placed[seen.beacon] - pose[:, :2]).T), seen.range_m)
    unit = _unit_slip(1.0 / scale if scale else 0.0)
    if unit:
        yield f"ranges read {scale:.4g} times the truth{unit}"
    elif abs(scale - 1.0) > SCALE_WARNING:
        yield f"ranges read {100.0 * (scale - 1.0):+.1f} per cent and {offset:+.2f} m off (fit to the truth)"
    elif abs(offset) > OFFSET_WARNING_M:
        yield f"ranges read {offset:+.2f} m off (fit to the truth)"


def _bearings(seen: Readings, pose: FloatArray, placed: FloatArray) -> tuple[list[str], float | None]:
    to = placed[seen.beacon] - pose[:, :2]
    expected = np.arctan2(to[:, 1], to[:, 0]) - pose[:, 2]
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
    lines = [f"bearings read {off_rad:+.3f} rad off (against the truth)"] if abs(off_rad) > 0.05 else []
    return lines, off_rad if abs(mean) > CLOSE else None


def _robust_line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    keep = np.ones(x.size, dtype=bool)
    slope, offset = 1.0, 0.0
    for _ in range(5):
        if keep.sum() < FEW or np.ptp(x[keep]) == 0.0:  # most rows are far from any line
            break
        slope, offset = np.polyfit(x[keep], y[keep], 1).tolist()
        residual = y - slope * x - offset
        sigma = MANY_SIGMA * float(np.median(np.abs(residual - np.median(residual))))
        keep = np.abs(residual) <= max(3.0 * sigma, 1e-9)
    return slope, offset


def _misplaced(
    names: tuple[str, ...], placed: FloatArray, seen: Readings, pose: FloatArray, off_rad: float | None
) -> Generator[str, None, list[int]]:
    whole = _unlike(names, _misses(placed, seen, pose), _misses(placed, seen, pose, off_rad))
    explained = {k for line, beacons in whole.items() if FITS in line for k in beacons}
    edges = np.linspace(seen.times_s[0], seen.times_s[-1], PIECES + 1)
    parts: dict[str, list[int]] = {}
    partly: set[int] = set()
    for piece in range(PIECES):
        rows = (seen.times_s >= edges[piece]) & (seen.times_s <= edges[piece + 1])
        now, there = seen.where(rows), pose[rows]
        for line, beacons in _unlike(names, _misses(placed, now, there), _misses(placed, now, there, off_rad)).items():
            # Only a fit to another position counts: in a short piece all readings may happen to miss.
            if FITS in line and not explained.intersection(beacons):
                parts.setdefault(line.split(" (by ")[0], []).append(piece)
                partly.update(beacons)
    yield from (line for line, beacons in whole.items() if not partly.intersection(beacons))
    for line, pieces in parts.items():
        yield f"from {edges[pieces[0]]:.0f} to {edges[pieces[-1] + 1]:.0f} s alone: {line}"
    return sorted(partly.union(*whole.values()))


def _misses(placed: FloatArray, seen: Readings, pose: FloatArray, off_rad: float | None = None) -> FloatArray:
    """Median miss, m, of the readings of beacon i at the position of beacon j, shape (n, n); NaN for few readings.

    With ``off_rad``, the constant error of the bearings, it is the miss of the position from range and bearing, else of
    the range.
    """
    count = len(placed)
    miss = np.full((count, count), np.nan)
    way = seen.bearing_rad - (off_rad or 0.0) + pose[:, 2]
    pointed = pose[:, :2] + seen.range_m[:, None] * np.column_stack([np.cos(way), np.sin(way)])
    for k in range(count):
        rows = seen.beacon == k
        if rows.sum() < FEW:
            continue
        for other in np.flatnonzero(np.isfinite(placed[:, 0])).tolist():
            if off_rad is not None and np.isfinite(pointed[rows]).all():
                off = np.hypot(*(placed[other] - pointed[rows]).T)
            else:
                off = np.abs(seen.range_m[rows] - np.hypot(*(placed[other] - pose[rows, :2]).T))
            miss[k, other] = np.median(off)
    return miss


def _unlike(names: tuple[str, ...], miss: FloatArray, pointed: FloatArray) -> dict[str, tuple[int, ...]]:
    if not np.isfinite(np.diag(miss)).any():
        return {}
    own, usual = _own_and_usual(pointed)
    gain = pointed / own[:, None]
    mutual = np.maximum(gain, gain.T)  # the worse of both directions
    mutual[~(np.minimum.outer(own, own) > EXCHANGE_FACTOR * usual)] = np.nan
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
    own = np.diag(miss)
    return own, float(np.nanquantile(own, 0.25))


TRUTH_GAP_S = 1.0
SAME = 0.01  # odometry is a copy of the truth if single steps differ by a smaller share
TURN_WARNING = 0.05
STANDS = 0.01  # share of the other's motion, below which odometry or truth does not move
STANDS_M = 0.2
LIKE = 0.3
SPOT_M = 0.05  # radius of a turn on the spot,
FEW_SPOTS = 0.2  # and their share of all turning, up to which positions tell how much the vehicle turns
STEPS_APART = 4.0  # of the odometry, between which its turn is compared with the truth
LEAST_TURNING_RAD2 = 0.1
FASTEST_TURN_RAD_S = 10.0  # a faster turn means a wrong unit
FASTEST_M_S = 50.0


def suspicions(run: RecordedRun) -> list[str]:
    """All warnings, the most basic first. A check that fails on strange data gives a warning that says so."""
    found: list[str] = []
    for check in (_gaps, _units, _signs, inconsistencies, _against_truth, _map_of):
        try:
            found += check(run)
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            what = check.__name__.strip("_").replace("_", " ")
            found.append(f"the check of {what} cannot be made on these data ({' '.join(str(error).split())[:80]})")
    return found


def _against_truth(run: RecordedRun) -> Iterator[str]:
    if run.truth is None:
        return
    against = list(_standing(run.truth, run.steps)) or list(_odometry_against(run.truth, run.steps))
    yield from against
    if not any(line.startswith("the truth never moves") for line in against):
        yield from readings_against(run, run.truth)
        poses = truth_at(run.truth, run.readings.times_s)
        yield from misplaced_radios(run, poses, run.beacon_truth_m, "truth and survey")


def _gaps(run: RecordedRun) -> Iterator[str]:
    columns = [("odometry", run.steps.times_s, GAP_S), ("readings", run.readings.times_s, GAP_S)]
    if run.truth is not None:
        columns.append(("truth", run.truth.times_s, TRUTH_GAP_S))
    for what, times_s, least_s in columns:
        long, pauses = long_pauses(times_s, least_s), np.diff(times_s)
        if long.size:
            worst = int(long[np.argmax(pauses[long])])
            guessed = "; the way there is guessed by the speed before" if what == "odometry" else ""
            yield (
                f"{what}: {plural(long.size, 'gap')}, the longest of {pauses[worst]:.1f} s at "
                f"{instant(times_s[worst])} (usual interval {float(np.median(pauses[pauses > 0.0])):.3f} s){guessed}"
            )


def _units(run: RecordedRun) -> Iterator[str]:
    steps = run.steps
    interval_s = np.maximum(np.diff(steps.times_s), 1e-3)
    turning = float(np.percentile(np.abs(steps.turn_rad) / interval_s, 99))
    if turning > FASTEST_TURN_RAD_S:
        yield f"odometry turns by up to {turning:.0f} rad/s: are the turns in degrees?"
    moving = float(np.percentile(np.abs(steps.distance_m) / interval_s, 99))
    if moving > FASTEST_M_S:
        yield f"odometry moves by up to {moving:.0f} m/s: are the distances in millimetres?"
    wild = np.flatnonzero(np.abs(steps.distance_m) / interval_s > FASTEST_M_S)
    if wild.size and moving <= FASTEST_M_S:
        first = int(wild[0])
        yield (
            f"odometry: {plural(wild.size, 'step')} faster than {FASTEST_M_S:.0f} m/s, the first of "
            f"{steps.distance_m[first]:.3g} m at {steps.times_s[first]:.3f} s: what follows is lost"
        )
    widest = np.abs(run.readings.bearing_rad[np.isfinite(run.readings.bearing_rad)]).max(initial=0.0)
    if widest > 2.0 * np.pi + 0.01:
        yield f"bearings reach {widest:.0f} rad: are they in degrees?"
    if run.truth is not None and np.isfinite(run.truth.heading_rad).any():
        heading = run.truth.heading_rad[np.isfinite(run.truth.heading_rad)]
        turned = np.abs(np.diff(heading)).sum()
        by_odometry = np.abs(steps.turn_rad).sum()
        if turned > 15.0 * by_odometry > 15.0:
            yield f"truth turns {turned / by_odometry:.0f} times as much as the odometry: is its heading in degrees?"


def _signs(run: RecordedRun) -> Iterator[str]:
    readings = run.readings
    negative = int((readings.range_m < 0.0).sum())
    if negative:
        yield f"{plural(negative, 'range')} below zero"
    positive = int((readings.rssi_dbm > 0.0).sum())
    if positive:
        yield f"{plural(positive, 'signal strength')} above 0 dBm: is the sign missing?"


def _odometry_against(truth: ReferencePath, steps: Steps) -> Iterator[str]:
    rows = chords(truth, steps)
    if rows.size < FEW:
        return
    yield from _copied_odometry(truth, steps)
    t = truth.times_s[rows]
    # Forward and backward cancel where the vehicle has no motion sideways, as in the noise of one that stands.
    way = np.diff(way_at(steps, t) if steps.lateral_m.any() else amount_at(steps, steps.distance_m, t))
    true_way = np.hypot(np.diff(truth.x_m[rows]), np.diff(truth.y_m[rows]))
    half_turn = np.minimum(0.5 * np.abs(np.diff(amount_at(steps, steps.turn_rad, t))), 1.0)
    chord = np.abs(way) * np.sinc(half_turn / np.pi)  # of the arc
    measured = (np.diff(amount_at(steps, steps.guess_m2, t)) <= 0.0) & _without_gap(truth, rows)
    true_way, chord = true_way[measured], chord[measured]
    if chord.sum() > 0.0:
        scale = float(true_way.sum() / chord.sum())
        if abs(scale - 1.0) > SCALE_WARNING:
            yield f"odometry distance: true ways are {scale:.3g} times it{_unit_slip(scale)}"
    yield from _turning_against(truth, steps, rows)


def _standing(truth: ReferencePath, steps: Steps) -> Iterator[str]:
    inside = (truth.times_s >= steps.times_s[0]) & (truth.times_s <= steps.times_s[-1])
    extent_m = np.hypot(np.ptp(truth.x_m[inside]), np.ptp(truth.y_m[inside])) if inside.any() else 0.0
    way_m = float(np.abs(steps.distance_m).sum() + np.abs(steps.lateral_m).sum())
    if way_m < STANDS * extent_m:
        yield f"odometry never moves ({way_m:.2g} m) while the truth gets {extent_m:.3g} m about: the right column?"
    elif extent_m < STANDS * way_m and inside.sum() >= FEW and extent_m < STANDS_M < way_m:
        yield f"the truth never moves ({extent_m:.2g} m) while the odometry travels {way_m:.3g} m: is it of this run?"


def _without_gap(truth: ReferencePath, rows: npt.NDArray[np.int64]) -> BoolArray:
    """Whether the truth has no gap between successive ones of its rows, shape (k - 1,)."""
    before = np.searchsorted(long_pauses(truth.times_s, TRUTH_GAP_S), rows)
    return np.asarray(np.diff(before) == 0)


def _copied_odometry(truth: ReferencePath, steps: Steps) -> Iterator[str]:
    x, y = (np.interp(steps.times_s, truth.times_s, column) for column in (truth.x_m, truth.y_m))
    inside = (steps.times_s >= truth.times_s[0]) & (steps.times_s <= truth.times_s[-1])
    inside = inside[:-1] & inside[1:]
    true_way, way = np.hypot(np.diff(x), np.diff(y))[inside], np.abs(steps.distance_m)[inside]
    moved = true_way > 0.1 * np.median(true_way[true_way > 0.0]) if (true_way > 0.0).any() else true_way > 0.0
    if moved.sum() < FEW:
        return
    miss = float(np.sqrt(np.mean((way - true_way)[moved] ** 2)) / np.sqrt(np.mean(true_way[moved] ** 2)))
    if miss < SAME:
        yield (
            f"odometry distance equals the truth (single steps agree within {100.0 * miss:.2g} per cent): it was made "
            "from the truth, and results are better than odometry would give"
        )
    heading = np.interp(steps.times_s, truth.times_s, truth.heading_rad)
    if not np.isfinite(heading).all():
        return
    true_turn, turn = np.diff(heading)[inside], steps.turn_rad[inside]
    size = float(np.sqrt(np.mean(true_turn**2)))
    if size > 0.0 and float(np.sqrt(np.mean((turn - true_turn) ** 2))) < SAME * size:
        yield "odometry turns equal the truth: they were made from it"


def _turning_against(truth: ReferencePath, steps: Steps, rows: npt.NDArray[np.int64]) -> Iterator[str]:
    """Warnings about turns of the odometry, from the heading of the truth, or else from the shape of its path."""
    if not np.isfinite(truth.heading_rad).all():
        size = np.abs(steps.turn_rad)
        on_the_spot = np.hypot(steps.distance_m, steps.lateral_m) < SPOT_M * size  # leaves no shape in positions
        factor = turning_factor(truth, steps) if size[on_the_spot].sum() < FEW_SPOTS * size.sum() else None
        if factor is not None:
            yield from _turns(factor, 1.0)
        return
    # Within a step of the odometry its turn is not known: turns of a few steps are compared.
    rows = rows[first_of_each(truth.times_s[rows], STEPS_APART * float(np.median(np.diff(steps.times_s))))]
    t = truth.times_s[rows]
    seen = _without_gap(truth, rows)
    x, y = np.diff(amount_at(steps, steps.turn_rad, t))[seen], np.diff(truth.heading_rad[rows])[seen]
    if x.size < 2 or float(x @ x) < LEAST_TURNING_RAD2 or y.std() == 0.0:
        return
    # Noise of the odometry makes the slope of y on x too small, that of the truth the slope of x on y.
    scale, likeness = float(x @ y) / float(x @ x), float(np.corrcoef(x, y)[0, 1])
    if likeness < LIKE or _beyond(scale) == _beyond(float(y @ y) / float(x @ y)):
        yield from _turns(scale, likeness)


def _beyond(scale: float) -> int:
    return int(abs(scale - 1.0) > TURN_WARNING and np.sign(scale - 1.0))


def _turns(scale: float, likeness: float) -> Iterator[str]:
    if scale < 0.0 and abs(likeness) > LIKE:
        yield (
            f"odometry turns the other way than the truth ({scale:.3g} times): wheels exchanged, a sign, or a "
            "truth whose y axis has the other direction?"
        )
    elif likeness < LIKE:
        yield f"odometry turns have little to do with the truth (correlation {likeness:.2f})"
    elif abs(scale - 1.0) > TURN_WARNING:
        unit = _unit_slip(scale, (("degrees", np.pi / 180.0),))
        yield f"odometry turns: true turns are {scale:.3g} times them{unit or ' (track of the wheels?)'}"


def _map_of(run: RecordedRun) -> Iterator[str]:
    unknown = [name for name in run.beacon_ids if name not in run.beacon_truth_m]
    if unknown and run.beacon_truth_m:
        yield f"beacons without a surveyed place: {', '.join(unknown)}"
    unread = [name for name in run.beacon_truth_m if name not in run.beacon_ids]
    if unread:
        yield f"surveyed beacons without any reading: {', '.join(unread)}"
