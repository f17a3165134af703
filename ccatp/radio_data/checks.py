"""Pure. What looks wrong in a recorded run, a line each: for the reader's eyes, nothing of it reaches an estimator."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from ccatp.radio.recording import Readings, RecordedRun, Steps, Truth
from ccatp.radio_data.checks_of_readings import FEW, SCALE_WARNING, readings_against, unit_slip
from ccatp.radio_data.cleaning import GAP_S, long_pauses, plural
from ccatp.radio_data.truth import chords, guessed_between, turn_at, turning_factor, way_at

TRUTH_GAP_S = 1.0
SAME = 0.01  # odometry is the truth itself if single steps agree to that part of their size
TURN_WARNING = 0.05
STANDS = 0.01  # of what the other moves
STANDS_M = 0.2
LIKE = 0.3
LEAST_TURNING_RAD2 = 0.1
DEGREES = 180.0 / np.pi
FASTEST_TURN_RAD_S = 10.0  # faster turning is a unit's fault
FASTEST_M_S = 50.0


def suspicions(run: RecordedRun) -> list[str]:
    """Everything that looks wrong, the most basic first."""
    found = [*_gaps(run), *_units(run), *_signs(run.readings)]
    if run.truth is not None:
        against = list(_standing(run.truth, run.steps)) or list(_odometry_against(run.truth, run.steps))
        found += against
        if not any(line.startswith("the truth never moves") for line in against):
            found += readings_against(run, run.truth)
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
            unit = unit_slip(scale, (("millimetres", 1e-3), ("centimetres", 1e-2), ("feet", 0.3048)))
            yield f"odometry distance: true ways are {scale:.3g} times it{unit}"
    yield from _turning_against(truth, steps, rows)


def _standing(truth: Truth, steps: Steps) -> Iterator[str]:
    """One of the two drives, the other never moves."""
    inside = (truth.times_s >= steps.times_s[0]) & (truth.times_s <= steps.times_s[-1])
    extent_m = np.hypot(np.ptp(truth.x_m[inside]), np.ptp(truth.y_m[inside])) if inside.any() else 0.0
    way_m = float(np.abs(steps.distance_m).sum() + np.abs(steps.lateral_m).sum())
    if way_m < STANDS * extent_m:
        yield f"odometry never moves ({way_m:.2g} m) while the truth gets {extent_m:.3g} m about: the right column?"
    elif extent_m < STANDS * way_m and inside.sum() >= FEW and extent_m < STANDS_M < way_m:
        yield f"the truth never moves ({extent_m:.2g} m) while the odometry travels {way_m:.3g} m: is it of this run?"


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
        unit = unit_slip(scale, (("degrees", 1.0 / DEGREES),))
        yield f"odometry turns: true turns are {scale:.3g} times them{unit or ' (track of the wheels?)'}"


def _map_of(run: RecordedRun) -> Iterator[str]:
    unknown = [name for name in run.beacon_ids if name not in run.beacon_truth_m]
    if unknown and run.beacon_truth_m:
        yield f"beacons without a surveyed place: {', '.join(unknown)}"
    unheard = [name for name in run.beacon_truth_m if name not in run.beacon_ids]
    if unheard:
        yield f"surveyed beacons that were never heard: {', '.join(unheard)}"
