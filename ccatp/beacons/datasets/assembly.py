"""From the recording of any format to a run for the estimators: the one path that every reader goes through."""

from collections import Counter
from dataclasses import replace

import numpy as np

from ccatp.beacons.datasets.checks import suspicions
from ccatp.beacons.datasets.events import EVENTS, MOTIONS, READING_KINDS, Recording
from ccatp.beacons.datasets.ordering import in_seconds, ordered
from ccatp.beacons.datasets.placeholders import frozen, measured, step_of, true_positions, without_wild_steps
from ccatp.beacons.datasets.tables import RadioDataError, Table, instant, long_pauses, needed_of, plural, within
from ccatp.beacons.datasets.tags import from_the_vehicle, radios_of
from ccatp.beacons.datasets.trajectory import (
    BEFORE_S,
    at_antenna,
    bridged,
    checked_heading,
    heading_as_written,
    motions_between,
    pose_of_truth,
    way_at,
)
from ccatp.beacons.estimation.recording import Known, KnownMap, Radio, Readings, RecordedRun, ReferencePath, Steps
from ccatp.core import FloatArray
from ccatp.errors import listed

NOTHING = Known()
LEAST_STEPS = 2
MOST_ONCE = 20  # beacons that were received once, if they are most of the readings
LEAST_TRUTH = 2  # rows; a single position fits any path
LARGEST = {1: (1e3, "a step forward", "m"), 2: (1e4, "a turn", "rad"), 3: (1e3, "a step to the left", "m")}
FARTHEST_M = 1e8  # of coordinates; those of maps reach 1e7
EARLY_SHARE = 0.1  # of the run; a first part of it that is shorter than the gap behind it is not used
LATE_TRUTH_S, LATE_SHARE = 1.0, 0.5  # the run begins with the truth if that begins later, but within this share
STILL_M, STILL_RAD = 0.1, 0.05  # unless the vehicle stands until then


def checked_run(
    recording: Recording, *, turns_heading: bool = True, known: Known = NOTHING, tag: str = ""
) -> RecordedRun:
    """The run of a recording, ordered, without what cannot be, with a warning of each kind that was left out.

    ``turns_heading``: whether a heading of the truth that is turned against its course is corrected, or only reported.
    ``known``: what the estimators may use. ``tag``: the only radio of the vehicle whose readings are used; by default
    all whose place is known. Raises RadioDataError: there is no odometry or no reading of a beacon, or none of a beacon
    on the map.
    """
    with np.errstate(all="ignore"):  # numbers that overflow are left out below
        return _checked(recording, turns_heading, known, tag)


def _checked(recording: Recording, turns_heading: bool, known: Known, tag: str) -> RecordedRun:
    warnings = list(recording.warnings)
    _check_complete(recording)
    recording = from_the_vehicle(recording, warnings)
    file, names = recording.file, recording.names
    radios = radios_of(recording, tag, warnings)
    tables = dict(recording.tables) | radios.tables
    surveyed, *_ = (tables.pop(kind, None) for kind in ("beacon", "antenna", "tag"))
    tables = {kind: in_seconds(_usable(kind, table, warnings), warnings) for kind, table in tables.items()}
    tables = ordered({kind: table for kind, table in tables.items() if len(table.values)}, warnings)
    truth_rows = true_positions(tables["truth"], "truth", warnings) if "truth" in tables else None
    odometry = without_wild_steps(_motions(recording, tables, warnings), warnings)
    odometry = _with_truth(_known_part(odometry, warnings), truth_rows, warnings)
    _check_steps(odometry)
    steps = bridged(Steps(odometry.values[:, 0], *(odometry.values[1:, column] for column in (1, 2, 3))))
    readings, beacon_ids, range_step_m = _readings(recording, tables, steps, warnings)
    readings = _without_lone_levels(readings, beacon_ids, warnings)
    if unheard := [name for name in known.moving if name not in beacon_ids]:
        raise RadioDataError(
            file, f"has no reading of beacon {unheard[0]}, which is to move; there are {listed(beacon_ids)}"
        )
    truth = _truth(truth_rows, steps, warnings, turns_heading)
    first_pose = known.first_pose or pose_of_truth(truth, steps, warnings)
    if truth is not None and len(truth.times_s) < LEAST_TRUTH:
        warnings.append(
            f"no reference trajectory: the truth has {plural(len(truth.times_s), 'row')}, good for the first pose "
            "alone; errors of the path stay unknown"
        )
        truth = None
    places_m, heights_m = _survey(surveyed, names, warnings)
    known_map = None
    if known.map is not None:
        heights_m |= _heights(known.map)
        known_map = _of_beacons(known.map, beacon_ids, known.moving, recording, warnings)
    places = list(radios.tags_m.values()) or [radios.antenna_m]
    z_m = np.array([heights_m.get(beacon, np.nan) for beacon in beacon_ids])
    above_m = np.array([np.nan_to_num(z_m - up_m) for *_, up_m in places])
    readings = _in_the_plane(readings, above_m, warnings)
    if not len(readings.times_s):
        raise RadioDataError(file, f"none of its readings can be used{_because(warnings)}")
    ahead_m, left_m, _ = radios.antenna_m
    tags = tuple(Radio(name, *place[:2]) for name, place in radios.tags_m.items())
    if tags:
        readings = readings._replace(arm_m=np.array([tag[1:] for tag in tags])[readings.tag])
        if truth is not None and not np.isfinite(truth.heading_rad).all():
            warnings.append(
                "the truth has no headings: its positions are taken as those of the vehicle's origin, not of a tag"
            )
    else:
        readings = readings._replace(tag=None)
    if ahead_m or left_m:
        steps, truth, first_pose = at_antenna(
            steps, truth, first_pose, (ahead_m, left_m), warnings, is_given=known.first_pose is not None
        )
    run = RecordedRun(
        recording.name, recording.kind, steps, readings, beacon_ids, places_m, truth, first_pose, (),
        (ahead_m, left_m), known_map, tags, known.moving,
        tuple(name for name, one_m in zip(beacon_ids, z_m.tolist(), strict=True) if np.isfinite(one_m)),
        range_step_m,
    )  # fmt: skip
    # A row with two readings gives the same warning of each.
    return replace(run, warnings=tuple(dict.fromkeys((*warnings, *suspicions(run)))))


def _usable(kind: str, table: Table, warnings: list[str]) -> Table:
    if kind in {"odom", "speed"}:  # a pose that is not known says nothing, the next one has its motion
        return table.with_unknown_ways(warnings).finite(warnings, 1)
    return table.finite(warnings, needed_of(EVENTS[kind]))


def _check_complete(recording: Recording) -> None:
    file, tables = recording.file, recording.tables
    if not any(kind in tables for kind in MOTIONS):
        raise RadioDataError(file, f"no event odom ({', '.join(EVENTS['odom'])}), speed or pose")
    if not any(kind in tables for kind in READING_KINDS):
        raise RadioDataError(file, f"no readings of beacons: no event {', '.join(READING_KINDS)}")


def _motions(recording: Recording, tables: dict[str, Table], warnings: list[str]) -> Table:
    """Rows of time and of the motion since the row before, shape (n, 4); those of the first row mean nothing."""
    if "odom" in tables:
        odometry = tables["odom"]
    elif "speed" in tables:  # a speed holds until the next row
        file, values, lines = tables["speed"]
        moves = values[:-1, 1:] * np.diff(values[:, 0])[:, None]
        odometry = Table(file, np.column_stack([values[:, 0], np.vstack([np.zeros((1, 3)), moves])]), lines)
    elif "pose" in tables:
        odometry = motions_between(true_positions(tables["pose"], "odometry", warnings))
    else:
        raise RadioDataError(recording.file, "no row of the odometry has a time")
    if len(odometry.values) <= LEAST_STEPS:
        raise RadioDataError(odometry.file, f"{plural(len(odometry.values), 'row')} of odometry: too few for a run")
    return odometry


def _known_part(odometry: Table, warnings: list[str]) -> Table:
    """The odometry from where to where its motion is known.

    Before the first motion that was measured there is none from which to guess an unknown one; a short first part
    before a longer gap is left out with it.
    """
    t = odometry.values[:, 0]
    unknown = np.asarray(np.isnan(odometry.values[1:, 1:]).any(axis=1))
    unknown[long_pauses(t)] = True
    known = np.flatnonzero(~unknown)
    if not known.size:
        raise RadioDataError(odometry.file, "no motion of the odometry is known")
    first, last = int(known[0]), int(known[-1]) + 1
    for row in (np.flatnonzero(np.diff(known) > 1) + 1).tolist():  # the first known step after each gap
        gap_begin_s, gap_end_s = t[known[row - 1] + 1], t[known[row]]
        early_s = min(max(gap_end_s - gap_begin_s, BEFORE_S), EARLY_SHARE * (t[last] - t[first]))
        if gap_begin_s - t[first] >= early_s:
            break
        first = int(known[row])
    for what, row in (("begins", first), ("ends", last)):
        if row not in {0, len(t) - 1}:
            warnings.append(
                f"{odometry.file.name}:{int(odometry.lines[row])}: the run {what} here, at {instant(t[row])}: the "
                f"motion {'before' if what == 'begins' else 'after'} is not known"
            )
    return _part(odometry, first, last)


def _with_truth(odometry: Table, truth: Table | None, warnings: list[str]) -> Table:
    """The odometry from the first row of the truth on, if the vehicle moves before: its first pose is not known."""
    t, last = odometry.values[:, 0], len(odometry.values) - 1
    if truth is None or not LATE_TRUTH_S < truth.values[0, 0] - t[0] < LATE_SHARE * (t[-1] - t[0]):
        return odometry
    begin = int(np.searchsorted(t, truth.values[0, 0]))
    before = odometry.values[1 : begin + 1, 1:]
    if np.nansum(np.hypot(before[:, 0], before[:, 2])) < STILL_M and np.nansum(np.abs(before[:, 1])) < STILL_RAD:
        return odometry
    warnings.append(
        f"the truth begins {truth.values[0, 0] - t[0]:.6g} s after the odometry, while the vehicle moves: the run "
        f"begins with it, at {instant(t[begin])}"
    )
    return _part(odometry, begin, last)


def _part(odometry: Table, first: int, last: int) -> Table:
    if last - first < LEAST_STEPS:
        raise RadioDataError(odometry.file, "too little of the odometry is known for a run")
    return Table(odometry.file, odometry.values[first : last + 1], odometry.lines[first : last + 1])


def _check_steps(odometry: Table) -> None:
    """Raises RadioDataError: a step that no vehicle makes, of a run with more of them."""
    for column, (most, what, unit) in LARGEST.items():
        values = odometry.values[1:, column]
        beyond = np.abs(values) > most
        if beyond.any():
            at = int(np.argmax(beyond))
            raise RadioDataError(
                odometry.file,
                f"odometry: {what} of {values[at]:.3g} {unit} at {instant(odometry.values[at + 1, 0])} cannot be; at "
                f"most {most:g} is taken",
                int(odometry.lines[at + 1]),
            )


def _readings(
    recording: Recording, tables: dict[str, Table], steps: Steps, warnings: list[str]
) -> tuple[Readings, tuple[str, ...], float]:
    """Readings with range, bearing and strength of one beacon at one time in one row.

    Then the names of the beacons, and the step in which ranges come, m; 0: none.
    """
    merged: dict[tuple[float, float, float], list[float]] = {}
    extra: list[tuple[float, float, float, list[float]]] = []
    spans, range_step_m = [], 0.0
    for place, kind in enumerate(READING_KINDS):
        if kind not in tables:
            continue
        table = measured(kind, tables[kind], warnings)
        spans += table.values[:, 0].tolist()
        table = table.where(within(table.values[:, 0], steps.times_s, kind, warnings))
        step = step_of(table.values[:, 2]) if kind == "range" else 0.0
        range_step_m = max(step, range_step_m)
        table = frozen(kind, table, way_at(steps, table.values[:, 0]), recording.names, step, warnings)
        for t, who, value, by in table.values.tolist():
            row = merged.setdefault((t, who, by), [np.nan] * len(READING_KINDS))
            if np.isnan(row[place]):
                row[place] = value
            else:  # a second value of this kind at the same time
                extra.append((t, who, by, [value if k == place else np.nan for k in range(len(READING_KINDS))]))
    if not merged:
        raise RadioDataError(recording.file, _no_readings(spans, steps, warnings))
    rows = sorted([(*key, row) for key, row in merged.items()] + extra, key=lambda item: item[0])
    _check_names(recording, [int(who) for _, who, *_ in rows])
    beacons, index = np.unique([int(who) for _, who, *_ in rows], return_inverse=True)
    data = np.array([row for *_, row in rows]).reshape(-1, len(READING_KINDS))
    times_s, tag = np.array([(t, by) for t, _, by, _ in rows]).T.copy()
    range_m, bearing_rad, rssi_dbm = data.T.copy()
    readings = Readings(times_s, index.astype(np.int64), range_m, bearing_rad, rssi_dbm, tag.astype(np.int64))
    return readings, tuple(recording.names[int(who)] for who in beacons), range_step_m


def _without_lone_levels(readings: Readings, names: tuple[str, ...], warnings: list[str]) -> Readings:
    """Without levels of a beacon that has ranges at other times: an estimate has one measure of distance a beacon."""
    ranged = np.isfinite(readings.range_m)
    lone = np.isin(readings.beacon, np.unique(readings.beacon[ranged])) & ~ranged & np.isfinite(readings.rssi_dbm)
    if not lone.any():
        return readings
    whose = listed([names[k] for k in np.unique(readings.beacon[lone]).tolist()])
    warnings.append(f"{plural(int(lone.sum()), 'signal strength')} of {whose} not used: their beacons have ranges, too")
    readings = readings._replace(rssi_dbm=np.where(lone, np.nan, readings.rssi_dbm))
    return readings.where(~lone | np.isfinite(readings.bearing_rad))


def _check_names(recording: Recording, beacons: list[int]) -> None:
    """Raises RadioDataError: the readings are of so many beacons that their names are something else."""
    once = [who for who, count in Counter(beacons).items() if count == 1]
    if len(once) > max(MOST_ONCE, 0.5 * len(beacons)):
        raise RadioDataError(
            recording.file,
            f"{len(once)} of {len(beacons)} readings are the only one of their beacon "
            f"({listed([recording.names[who] for who in once], 4)}): is the name of the beacon a number of the row?",
        )


def _because(warnings: list[str]) -> str:
    return f" ({'; '.join(warnings[-3:])})" if warnings else ""


def _no_readings(times_s: list[float], steps: Steps, warnings: list[str]) -> str:
    if not times_s:
        return f"none of its readings can be used{_because(warnings)}"
    return (
        f"no readings of beacons within the time of the odometry, {instant(steps.times_s[0])} to "
        f"{instant(steps.times_s[-1])}: theirs are {instant(min(times_s))} to {instant(max(times_s))}; "
        "are both in s, and of one clock?"
    )


def _truth(reference: Table | None, steps: Steps, warnings: list[str], turns_heading: bool) -> ReferencePath | None:
    """The trajectory from rows of time, x, y and heading; without headings if one is missing."""
    if reference is None:
        return None
    far = np.asarray(~(np.abs(reference.values[:, 1:3]) <= FARTHEST_M).all(axis=1))
    if far.any():
        warnings.append(reference.note(far, f"of truth beyond {FARTHEST_M:g} m (the first here), not used"))
        reference = reference.where(~far)
    if not len(reference.values):
        return None
    t, x, y, heading = reference.values.T
    known = np.isfinite(heading)
    if known.any() and not known.all():
        warnings.append(reference.note(~known, "of truth without heading (the first here): no heading is used"))
    truth = ReferencePath(t, x, y, heading if known.all() else np.full(len(t), np.nan))
    heading = heading_as_written(truth, steps, warnings, turns=turns_heading)
    return checked_heading(truth._replace(heading_rad=heading), steps, warnings, turns=turns_heading)


def _survey(
    surveyed: Table | None, names: tuple[str, ...], warnings: list[str]
) -> tuple[dict[str, tuple[float, float]], dict[str, float]]:
    """Surveyed positions and heights by name. Raises RadioDataError: one beacon has two positions."""
    places_m: dict[str, tuple[float, float]] = {}
    heights_m: dict[str, float] = {}
    if surveyed is None:
        return places_m, heights_m
    for line, (index, x_m, y_m, z_m) in zip(surveyed.lines.tolist(), surveyed.values.tolist(), strict=True):
        name = names[int(index)]
        if not (abs(x_m) <= FARTHEST_M and abs(y_m) <= FARTHEST_M):
            warnings.append(f"surveyed place of {name}: is no place within {FARTHEST_M:g} m, not used")
            continue
        if places_m.setdefault(name, (x_m, y_m)) != (x_m, y_m):
            raise RadioDataError(surveyed.file, f"beacon {name} was surveyed at another place before", line)
        heights_m[name] = z_m
    return places_m, heights_m


def _heights(known_map: KnownMap) -> dict[str, float]:
    heights = zip(known_map.names, known_map.heights_m.tolist(), strict=True)
    return {name: height_m for name, height_m in heights if np.isfinite(height_m)}


def _of_beacons(
    known_map: KnownMap, beacon_ids: tuple[str, ...], moving: tuple[str, ...], recording: Recording,
    warnings: list[str],
) -> KnownMap:  # fmt: skip
    """The part of the map that has the beacons of the readings, but for those that move."""
    here = known_map.of([name for name in beacon_ids if name not in moving])
    if not here.names:
        raise RadioDataError(
            recording.file,
            f"the map has none of its beacons: it has {listed(known_map.names)}, the readings are of "
            f"{listed(beacon_ids)}",
        )
    if others := [name for name in beacon_ids if name not in here.names]:
        warnings.append(f"beacons that the known map lacks are mapped: {listed(others)}")
    return here


def _in_the_plane(readings: Readings, above_m: FloatArray, warnings: list[str]) -> Readings:
    """Ranges projected to the plane. ``above_m``: height of each beacon above each radio, shape (t, b)."""
    height_m = above_m[readings.tag, readings.beacon]
    squares = readings.range_m**2 - height_m**2
    if (short := (squares < 0.0) & (readings.range_m > 0.0)).any():
        warnings.append(
            f"{plural(int(short.sum()), 'range')} shorter than the beacon is above the antenna, not used, the first at "
            f"{instant(readings.times_s[int(np.argmax(short))])}"
        )
        readings = readings.where(~short)
        squares, height_m = squares[~short], height_m[~short]
    level_m = np.where(height_m == 0.0, readings.range_m, np.sqrt(np.maximum(squares, 0.0)))
    return readings._replace(range_m=level_m)
