"""The recordings of the studies, shipped or in a folder of one's own: their runs, and parts of runs."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.beacons.datasets.assembly import checked_run
from ccatp.beacons.datasets.events import Recording, name_of
from ccatp.beacons.datasets.formats import robots_in
from ccatp.beacons.datasets.reader import found_format, read_run
from ccatp.beacons.datasets.tables import RadioDataError, Table
from ccatp.beacons.datasets.trajectory import pose_of_truth
from ccatp.beacons.estimation.recording import RecordedRun, ReferencePath
from ccatp.core import FloatArray
from ccatp.studies.campaign import CampaignError


class RecordedSet(NamedTuple):
    """Path of a set in the folder of recordings, its robots, and for a bag the file of topics beside it."""

    path: str
    robots: tuple[int | None, ...] = (None,)
    topics: str = ""


RECORDINGS = (".csv", ".txt", ".tsv", ".mat", ".pyfg", ".bag", ".db3", ".mcap")  # last parts of their names
SHIPPED = {
    "Plaza2": RecordedSet("plaza/Plaza2_.mat"),
    "MRCLAM 7": RecordedSet("mrclam/set7", (1, 2, 3, 4, 5)),
    "Labyrinth": RecordedSet("uwb_labyrinth/labyrinth_0_600s.txt.gz"),
    "MRCLAM 3": RecordedSet("mrclam/set3", (3, 5)),
    "UWB Jackal": RecordedSet("uwb_jackal/jackal_complex_tag_p.csv.gz"),
}


class Found(NamedTuple):
    """Sets of a folder by name, and a line for each file or folder in it that looks like one and cannot be read."""

    sets: Mapping[str, RecordedSet]
    left_out: tuple[str, ...] = ()


@cache
def found_in(folder: str) -> Found:
    """The sets of ``SHIPPED`` that the folder holds, or else every recording in it that can be read.

    The folder may also be one set, or a file. A bag needs its topics in NAME.toml beside it. Raises CampaignError: no
    folder is given, or it holds no recording.
    """
    if not folder:
        raise CampaignError("where the recordings are is not known; give --data DIR")
    where = Path(folder)
    if shipped := {name: one for name, one in SHIPPED.items() if (where / one.path).exists()}:
        return Found(shipped)
    reason, left_out = "", list[str]()
    try:
        return Found({name_of(where.resolve()): _own_set(where, where)})
    except (RadioDataError, OSError) as error:
        reason = str(error)
    found: dict[str, RecordedSet] = {}
    for path in sorted(where.iterdir()) if where.is_dir() else ():
        try:
            one = _own_set(where, path)
        except (RadioDataError, OSError) as error:
            if path.is_dir() or {*RECORDINGS} & {*path.suffixes}:
                line = str(error)  # it may be of a file beside it
                left_out.append(line if line.startswith(str(path)) else f"{path}: {line}")
            continue
        found[path.name if name_of(path) in found else name_of(path)] = one
    if not found:
        raise CampaignError(f"--data {folder}: holds no recording ({'; '.join(left_out[:1]) or reason})")
    return Found(found, tuple(f"not used: {line}" for line in left_out))


def sets_in(folder: str) -> Mapping[str, RecordedSet]:
    """Sets by name; see ``found_in``."""
    return found_in(folder).sets


def _own_set(where: Path, path: Path) -> RecordedSet:
    """The set of a file or folder. Raises RadioDataError: it cannot be read."""
    form = found_format(path)
    robots = tuple(robots_in(path if path.is_dir() else path.parent)) if form == "mrclam" else (None,)
    topics = path.with_name(f"{name_of(path)}.toml") if form == "bag" else None
    if topics is not None and not topics.is_file():
        raise RadioDataError(path, f"is a bag: name its topics in {topics.name} beside it").with_page()
    one = RecordedSet(str(path.relative_to(where)), robots, str(topics) if topics else "")
    for robot in robots:
        _read(str(path), robot, one.topics)
    return one


@cache
def _read(path: str, robot: int | None, topics: str) -> RecordedRun:
    return read_run(Path(path), None, robot, Path(topics) if topics else None)


def recorded_run(folder: str, name: str, robot: int | None) -> RecordedRun:
    """One run of a set. Raises CampaignError: no folder is given. Raises RadioDataError: the set does not exist."""
    one = sets_in(folder)[name]
    return _read(str(Path(folder) / one.path), robot, one.topics)


@cache
def recorded_window(folder: str, name: str, robot: int | None, begin_s: float, length_s: float) -> RecordedRun:
    """A part of a run, times in s from the beginning of the run; its first pose is from the truth, if there is one.

    The checks of the reader do not use the truth.
    """
    run = recorded_run(folder, name, robot)
    tables, truth = events_of(run, begin_s, begin_s + length_s)
    return read_again(run, tables, truth)


def events_of(run: RecordedRun, begin_s: float, end_s: float) -> tuple[dict[str, Table], ReferencePath | None]:
    """The recorded events of a part of a run, as tables of our CSV format, and the truth of that part."""
    start_s = run.steps.times_s[0]

    def table(*columns: FloatArray) -> Table:
        values = np.column_stack(columns)
        inside = (values[:, 0] >= start_s + begin_s) & (values[:, 0] <= start_s + end_s)
        return Table(Path(run.name), values[inside], np.flatnonzero(inside) + 1)

    steps, readings, known = run.steps, run.readings, np.isfinite
    moves = (np.concatenate([[0.0], column]) for column in (steps.distance_m, steps.turn_rad, steps.lateral_m))
    tables = {"odom": table(steps.times_s, *moves)}
    tag = np.full(len(readings.times_s), np.nan) if readings.tag is None else readings.tag.astype(np.float64)
    for kind, column in zip(("range", "bearing", "rssi"), readings[2:5], strict=True):
        there = known(column)
        if there.any():
            tables[kind] = table(
                readings.times_s[there], readings.beacon[there].astype(float), column[there], tag[there]
            )
    truth = None if run.truth is None else ReferencePath(*table(*run.truth).values.T)
    return tables, truth


def read_again(run: RecordedRun, tables: Mapping[str, Table], truth: ReferencePath | None) -> RecordedRun:
    """A run from tables of events, as read and checked by the reader without the truth, which is added afterwards."""
    tags = tuple(tag.name for tag in run.tags)
    if tags:  # ranges are in the plane already
        places = np.array([(k, tag.ahead_m, tag.left_m, 0.0) for k, tag in enumerate(run.tags)])
        tables = {**tables, "tag": Table(Path(run.name), places, np.arange(1, len(places) + 1))}
    again = checked_run(Recording(Path(run.name), run.name, run.kind, tables, run.beacon_ids, tags=tags))
    pose = pose_of_truth(truth, again.steps, [])
    return replace(again, first_pose=pose, truth=truth, beacon_truth_m=run.beacon_truth_m)
