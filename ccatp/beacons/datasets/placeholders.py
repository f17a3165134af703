"""What stands in a recording in place of a measurement: values that mean "nothing", poses of zero, wild steps."""

import numpy as np

from ccatp.beacons.datasets.tables import Table, instant, plural
from ccatp.beacons.estimation.recording import BoolArray
from ccatp.core import FloatArray

# Values that units write without an answer, and end values of 16 bits in mm and cm.
KNOWN = {
    "range": (65.535, 655.35, 65535.0, 99.99, 999.0, 999.9, 999.99, 9999.0, 9999.99),
    "rssi": (-128.0, -127.0, -120.0, -100.0, 0.0, 100.0, 127.0),
}
NOTHING = {"range": (0.0, -1.0)}  # never a measurement
LIMITS = {"range": (1e6, "m"), "bearing": (1e4, "rad"), "rssi": (1e3, "dBm")}
WHAT = {"range": "range", "bearing": "bearing", "rssi": "signal strength"}
LEAST_OTHERS = 10  # other values, from which the usual ones are known
APART = 0.25  # of the span of the other values, beyond which an end value stands apart
LEAST_APART = {"range": 1.0, "rssi": 5.0}
OFTEN = 3  # equal values that stand apart and are no known placeholder
OFTEN_AT_END, TIMES_OTHERS = 6, 3.0  # equal end values that do not stand apart, and how much more often than any other
FROZEN = 12  # equal readings of one beacon in a row while the vehicle moves
FROZEN_M = 1.0
FROZEN_STEPS = 10.0  # and so many steps in which the values come: across its direction a vehicle hardly changes a range

READINGS_A_VALUE = 5  # that readings in steps repeat at least, in the mean
LEAST_VALUES = 50  # readings from which their steps are known
OFF_STEP = 0.02  # of a step: written with few digits

FASTER = 10.0  # times the usual rate of the run
USUAL = 90.0  # percentile of the rates in motion
MOVING = 1e-3  # m/s or rad/s
# Column of the odometry, name, unit, smallest step and rate that can be wild.
MOTIONS = ((1, "forward", "m", 0.2, 1.0), (2, "to turn", "rad", 0.5, 3.0), (3, "to the left", "m", 0.2, 1.0))
MOST_WILD = 0.02  # share of the rows; more are the run's own

ZERO_M = 0.5  # distance of the neighbours, from which a position of zero is none
ZERO_STEPS = 20.0  # the same, in usual steps of the reference
SPIKE = 5.0  # times the distance of the neighbours


def measured(kind: str, table: Table, warnings: list[str]) -> Table:
    """The readings of one kind without values that were not measured.

    ``table``: time, beacon, value, and further columns.
    """
    values = table.values[:, 2]
    most, unit = LIMITS[kind]
    beyond = ~(np.abs(values) <= most)
    if beyond.any():
        first = int(np.argmax(beyond))
        line = f"beyond {most:g} {unit}, the first {values[first]:.3g} {unit} at {instant(table.values[first, 0])}"
        warnings.append(f"{plural(int(beyond.sum()), WHAT[kind])} {line}, not used")
        table = table.where(~beyond)
    for value in placeholder_values(kind, table.values[:, 1], table.values[:, 2]):
        is_it = table.values[:, 2] == value
        first = int(np.argmax(is_it))
        warnings.append(
            f"{plural(int(is_it.sum()), WHAT[kind])} of {value:.6g} {unit}, the first at "
            f"{instant(table.values[first, 0])} ({table.file.name}:{int(table.lines[first])}), not used: "
            "a placeholder, not a measurement"
        )
        table = table.where(~is_it)
    return table


def placeholder_values(kind: str, beacons: FloatArray, values: FloatArray) -> list[float]:
    """Values that stand for no measurement. ``beacons``: number of the beacon of each value, shape (n,)."""
    found = [value for value in NOTHING.get(kind, ()) if (values == value).any()]
    if kind not in KNOWN:
        return found
    ends = (np.min, np.max)
    left = ~np.isin(values, found)
    for end in (*ends, *ends):  # two at either end
        if left.sum() < LEAST_OTHERS:
            break
        value = float(end(values[left]))
        if _is_placeholder(kind, value, beacons[left], values[left]):
            found.append(value)
            left &= values != value
    return found


def _is_placeholder(kind: str, value: float, beacons: FloatArray, values: FloatArray) -> bool:
    is_it = values == value
    others, count = values[~is_it], int(is_it.sum())
    if others.size < LEAST_OTHERS:
        return False
    span = float(np.ptp(np.percentile(others, (5.0, 95.0))))
    apart = float(np.abs(others - value).min())
    if apart > max(APART * span, LEAST_APART[kind]) and (value in KNOWN[kind] or count >= OFTEN):
        return True
    if count < OFTEN_AT_END or (np.unique(beacons).size > 1 and np.unique(beacons[is_it]).size == 1):
        return False
    return count > TIMES_OTHERS * float(np.unique(others, return_counts=True)[1].max())


def step_of(values: FloatArray) -> float:
    """The step in which values (n,) come, as of ranges in whole metres; 0: they come in none, or there are too few."""
    if values.size < LEAST_VALUES:
        return 0.0
    unique = np.unique(values)
    if not 1 < unique.size <= values.size / READINGS_A_VALUE:
        return 0.0
    gaps = np.diff(unique)
    steps = np.round(gaps / gaps.min())
    step = float(np.median(gaps / steps))
    return step if bool((np.abs(gaps / step - steps) < OFF_STEP).all()) else 0.0


def frozen(
    kind: str, table: Table, way_m: FloatArray, names: tuple[str, ...], step: float, warnings: list[str]
) -> Table:
    """The readings without those that repeat the one before again and again while the vehicle moves.

    ``way_m``: travelled until each reading, shape (n,). ``step``: in which ranges come, m; 0 for other kinds.
    """
    least_m = FROZEN_M + FROZEN_STEPS * step
    stale = np.zeros(len(table.values), dtype=bool)
    pairs, pair = np.unique(table.values[:, [1, *range(3, table.values.shape[1])]], axis=0, return_inverse=True)
    for k, (beacon, *_) in enumerate(pairs.tolist()):  # of beacon and radio
        rows = np.flatnonzero(pair.ravel() == k)
        edges = np.flatnonzero(np.diff(table.values[rows, 2]) != 0.0) + 1
        for first, stop in zip([0, *edges.tolist()], [*edges.tolist(), rows.size], strict=True):
            run = rows[first:stop]
            if run.size >= FROZEN and way_m[run[-1]] - way_m[run[0]] > least_m:
                stale[run[1:]] = True
                begin_s, value = table.values[run[0], [0, 2]].tolist()
                warnings.append(
                    f"{table.file.name}:{int(table.lines[run[1]])}: {WHAT[kind]} of beacon {names[int(beacon)]} "
                    f"repeats {value:.6g} {run.size} times from {instant(begin_s)} on, while the vehicle travels "
                    f"{way_m[run[-1]] - way_m[run[0]]:.3g} m: used once"
                )
    return table.where(~stale) if stale.any() else table


def without_wild_steps(odometry: Table, warnings: list[str]) -> Table:
    """The odometry, shape (n, 4), with steps far beyond the run's own as unknown motions."""
    if len(odometry.values) < LEAST_OTHERS:
        return odometry
    interval_s = np.diff(odometry.values[:, 0])
    interval_s = np.maximum(interval_s, np.median(interval_s))
    wild = np.zeros(len(odometry.values), dtype=bool)
    for column, what, unit, least, least_rate in MOTIONS:
        step = np.abs(odometry.values[1:, column])
        rate = step / interval_s
        moving = rate[rate > MOVING]
        if moving.size < LEAST_OTHERS:
            continue
        most = max(FASTER * float(np.percentile(moving, USUAL)), least_rate)
        beyond = (rate > most) & (step > least) & ~wild[1:]
        if not 0 < beyond.sum() <= max(MOST_WILD * len(beyond), 1):
            continue
        first = int(np.argmax(beyond)) + 1
        warnings.append(
            f"{odometry.file.name}:{int(odometry.lines[first])}: {plural(int(beyond.sum()), 'step')} of the odometry "
            f"{what} beyond what the run does otherwise (at most {most:.3g} {unit}/s is taken), the first of "
            f"{odometry.values[first, column]:.3g} {unit} at {instant(odometry.values[first, 0])}: taken as a gap"
        )
        wild[1:] |= beyond
    if not wild.any():
        return odometry
    values = odometry.values.copy()
    values[wild, 1:] = np.nan
    return odometry._replace(values=values)


def true_positions(truth: Table, what: str, warnings: list[str]) -> Table:
    """Rows of time, x and y without positions of zero far from their neighbours, and without single jumps.

    ``truth``: in order of time.
    """
    if len(truth.values) < LEAST_OTHERS:
        return truth
    at = truth.values[:, 1:3]
    is_zero = (at == 0.0).all(axis=1)
    if is_zero.any() and not is_zero.all():
        rest = np.flatnonzero(~is_zero)
        usual_m = float(np.median(np.hypot(*np.diff(at[rest], axis=0).T))) if rest.size > 1 else 0.0
        after = rest[np.searchsorted(rest, np.flatnonzero(is_zero)).clip(0, rest.size - 1)]
        before = rest[(np.searchsorted(rest, np.flatnonzero(is_zero)) - 1).clip(0)]
        near_m = np.minimum(np.hypot(*at[after].T), np.hypot(*at[before].T))
        is_zero[is_zero] = near_m > max(ZERO_M, ZERO_STEPS * usual_m)
        if is_zero.any():
            warnings.append(
                truth.note(is_zero, f"of {what} at zero (the first here, at {_first_s(truth, is_zero)}), not used")
            )
            truth = truth.where(~is_zero)
            at = truth.values[:, 1:3]
    if len(at) < LEAST_OTHERS:
        return truth
    step_m = np.hypot(*np.diff(at, axis=0).T)
    across_m = np.hypot(*(at[2:] - at[:-2]).T)
    jump = np.zeros(len(at), dtype=bool)
    jump[1:-1] = np.minimum(step_m[:-1], step_m[1:]) > SPIKE * (across_m + np.median(step_m)) + ZERO_M
    # The first and the last have one neighbour: they are compared with what the vehicle travels in that time.
    interval_s = np.maximum(np.diff(truth.values[:, 0]), 1e-9)
    fast_m_s = float(np.percentile(step_m / interval_s, USUAL))
    for end in (0, -1):
        jump[end] = step_m[end] > SPIKE * fast_m_s * interval_s[end] + ZERO_M
    if jump.any():
        warnings.append(
            truth.note(
                jump, f"of {what} that jump away from the others (the first here, at {_first_s(truth, jump)}), not used"
            )
        )
        truth = truth.where(~jump)
    return truth


def _first_s(table: Table, rows: BoolArray) -> str:
    return instant(table.values[int(np.argmax(rows)), 0])
