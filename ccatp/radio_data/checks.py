"""Pure. What looks wrong in a recorded run, a line each: for the reader's eyes, nothing of it reaches an estimator."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from ccatp.radio.recording import Readings, RecordedRun, Steps, Truth
from ccatp.radio_data.cleaning import GAP_S, long_pauses, plural
from ccatp.radio_data.truth import chords, guessed_between, turn_at, turning_factor, way_at

FloatArray = npt.NDArray[np.float64]
MANY_SIGMA = 1.4826  # of a Gaussian, over its median absolute deviation
TRUTH_GAP_S = 1.0
SAME = 0.01  # odometry is the truth itself if single steps agree to that part of their size
SCALE_WARNING = 0.03
OFFSET_WARNING_M = 0.1
TURN_WARNING = 0.05
LIKE = 0.3
LEAST_TURNING_RAD2 = 0.1
DEGREES = 180.0 / np.pi
FASTEST_TURN_RAD_S = 10.0  # faster turning is a unit's fault
FASTEST_M_S = 50.0
STRANGER_M = 1.0  # readings of a beacon are strange if half of them miss its place by that,
STRANGER_RATIO = 5.0  # and by that many times what the others miss
FEW = 20


def suspicions(run: RecordedRun) -> list[str]:
    """Everything that looks wrong, the most basic first."""
    found = [*_gaps(run), *_units(run), *_signs(run.readings)]
    if run.truth is not None:
        found += [*_odometry_against(run.truth, run.steps), *_readings_against(run, run.truth)]
    found += _map_of(run)
    return found


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
                f"{what}: {plural(long.size, 'gap')}, the longest of {pauses[worst]:.1f} s at {times_s[worst]:.3f} s "
                f"(usual interval {float(np.median(pauses[pauses > 0.0])):.3f} s){guessed}"
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


def _signs(readings: Readings) -> Iterator[str]:
    negative = int((readings.range_m < 0.0).sum())
    if negative:
        yield f"{plural(negative, 'range')} below zero"
    positive = int((readings.rssi_dbm > 0.0).sum())
    if positive:
        yield f"{plural(positive, 'signal strength')} above 0 dBm: is the sign missing?"


def _odometry_against(truth: Truth, steps: Steps) -> Iterator[str]:
    rows = chords(truth, steps)
    if rows.size < FEW:
        return
    yield from _copied_odometry(truth, steps)
    t = truth.times_s[rows]
    way = np.diff(way_at(steps, t))
    true_way = np.hypot(np.diff(truth.x_m[rows]), np.diff(truth.y_m[rows]))
    half_turn = np.minimum(0.5 * np.abs(np.diff(turn_at(steps, t))), 1.0)
    chord = np.abs(way) * np.sinc(half_turn / np.pi)  # of the arc
    told = ~guessed_between(steps, t)
    true_way, chord = true_way[told], chord[told]
    if chord.sum() > 0.0:
        scale = float(true_way.sum() / chord.sum())
        if abs(scale - 1.0) > SCALE_WARNING:
            unit = _unit_slip(scale, (("millimetres", 1e-3), ("centimetres", 1e-2), ("feet", 0.3048)))
            yield f"odometry distance: true ways are {scale:.3g} times it{unit}"
    yield from _turning_against(truth, steps, rows)


def _copied_odometry(truth: Truth, steps: Steps) -> Iterator[str]:
    """Odometry that was made from the truth: single steps agree better than any wheel could tell."""
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


def _turning_against(truth: Truth, steps: Steps, rows: npt.NDArray[np.int64]) -> Iterator[str]:
    """Turns by the truth's heading over those of the odometry; by the shape of the path if the truth has none."""
    if not np.isfinite(truth.heading_rad).all():
        factor = turning_factor(truth, steps)
        if factor is not None:
            yield from _turns(factor, 1.0)
        return
    t = truth.times_s[rows]
    x, y = np.diff(turn_at(steps, t)), np.diff(truth.heading_rad[rows])
    if float(x @ x) < LEAST_TURNING_RAD2 or y.std() == 0.0:
        return
    yield from _turns(float(x @ y) / float(x @ x), float(np.corrcoef(x, y)[0, 1]))


def _turns(scale: float, likeness: float) -> Iterator[str]:
    if scale < 0.0 and abs(likeness) > LIKE:
        yield f"odometry turns the other way than the truth ({scale:.3g} times): wheels exchanged, or a sign?"
    elif likeness < LIKE:
        yield f"odometry turns have little to do with the truth (correlation {likeness:.2f})"
    elif abs(scale - 1.0) > TURN_WARNING:
        unit = _unit_slip(scale, (("degrees", 1.0 / DEGREES),))
        yield f"odometry turns: true turns are {scale:.3g} times them{unit or ' (track of the wheels?)'}"


def _unit_slip(scale: float, units: tuple[tuple[str, float], ...]) -> str:
    near = [name for name, factor in units if abs(scale / factor - 1.0) < 0.15]
    return f": are they in {near[0]}?" if near else ""


def _readings_against(run: RecordedRun, truth: Truth) -> Iterator[str]:
    placed = np.array([run.beacon_truth_m.get(name, (np.nan, np.nan)) for name in run.beacon_ids]).reshape(-1, 2)
    r = run.readings
    t = r.times_s
    inside = (t >= truth.times_s[0]) & (t <= truth.times_s[-1]) & np.isfinite(r.range_m)
    inside &= np.isfinite(placed[r.beacon, 0])
    if inside.sum() < FEW:
        return
    pose = np.column_stack([np.interp(t[inside], truth.times_s, column) for column in (truth.x_m, truth.y_m)])
    beacon, read = r.beacon[inside], r.range_m[inside]
    true = np.hypot(*(placed[beacon] - pose).T)
    yield from _unlike(run.beacon_ids, placed, pose, beacon, read)
    scale, offset = _robust_line(true, read)
    unit = _unit_slip(1.0 / scale if scale else 0.0, (("millimetres", 1e-3), ("centimetres", 1e-2), ("feet", 0.3048)))
    if unit:
        yield f"ranges read {scale:.4g} times the truth{unit}"
    elif abs(scale - 1.0) > SCALE_WARNING:
        yield f"ranges read {100.0 * (scale - 1.0):+.1f} per cent and {offset:+.2f} m off (fit to the truth)"
    elif abs(offset) > OFFSET_WARNING_M:
        yield f"ranges read {offset:+.2f} m off (fit to the truth)"
    bearing = r.bearing_rad[inside]
    if np.isfinite(truth.heading_rad).all() and np.isfinite(bearing).sum() >= FEW:
        heading = np.interp(t[inside], truth.times_s, truth.heading_rad)
        to = placed[beacon] - pose
        off = bearing - np.arctan2(to[:, 1], to[:, 0]) + heading
        mean = np.mean(np.exp(1j * off[np.isfinite(off)]))
        if abs(mean) > 0.5 and abs(np.angle(mean)) > 0.05:
            yield f"bearings read {float(np.angle(mean)):+.3f} rad off (against the truth)"


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


def _unlike(
    names: tuple[str, ...], placed: FloatArray, pose: FloatArray, beacon: npt.NDArray[np.int64], read: FloatArray
) -> Iterator[str]:
    """Beacons whose readings do not fit their surveyed place, and whose place they do fit."""
    count = len(names)
    miss = np.full((count, count), np.nan)  # of the readings of one, at the place of another
    for k in range(count):
        rows = beacon == k
        if rows.sum() < FEW:
            continue
        for other in np.flatnonzero(np.isfinite(placed[:, 0])).tolist():
            miss[k, other] = np.median(np.abs(read[rows] - np.hypot(*(placed[other] - pose[rows]).T)))
    own = np.diag(miss)
    if not np.isfinite(own).any():
        return
    usual = float(np.nanquantile(own, 0.25))  # most may be wrong
    strange = [k for k in range(count) if own[k] > max(STRANGER_M, STRANGER_RATIO * usual)]
    fits = {k: int(np.nanargmin(miss[k])) for k in strange if np.nanmin(miss[k]) < 0.3 * own[k]}
    for k in strange:
        if k in fits and fits.get(fits[k]) == k:
            if k < fits[k]:
                yield f"beacons {names[k]} and {names[fits[k]]} look exchanged: each one's ranges fit the other's place"
        elif k in fits:
            yield f"ranges of beacon {names[k]} fit the place of {names[fits[k]]}, not its own (by {own[k]:.1f} m)"
        else:
            yield f"ranges of beacon {names[k]} miss its surveyed place by {own[k]:.1f} m (half of them)"


def _map_of(run: RecordedRun) -> Iterator[str]:
    unknown = [name for name in run.beacon_ids if name not in run.beacon_truth_m]
    if unknown and run.beacon_truth_m:
        yield f"beacons without a surveyed place: {', '.join(unknown)}"
    unheard = [name for name in run.beacon_truth_m if name not in run.beacon_ids]
    if unheard:
        yield f"surveyed beacons that were never heard: {', '.join(unheard)}"
