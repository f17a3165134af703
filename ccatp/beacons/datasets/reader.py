"""One door to all formats of recorded radio data: which one it is, and what looks wrong in it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ccatp.beacons.datasets.checks import suspicions
from ccatp.beacons.datasets.events_csv import is_events_csv, read_events_csv
from ccatp.beacons.datasets.labyrinth import is_labyrinth, read_labyrinth
from ccatp.beacons.datasets.mrclam import ROBOT_FILE, read_mrclam, robots_in
from ccatp.beacons.datasets.plaza import is_plaza, read_plaza
from ccatp.beacons.datasets.tables import RadioDataError, bounded, content_lines, plural, read_text
from ccatp.beacons.slam.recording import RecordedRun

LEAST_TRUTH = 2  # rows: one fits any path
FORMATS: Sequence[str] = ("plaza", "mrclam", "labyrinth", "csv")


def read_run(path: Path, data_format: str | None, robot: int | None) -> RecordedRun:
    """Read and check a recorded run.

    Args:
        data_format: one of ``FORMATS``; found out from the files if ``None``.

    Raises:
        RadioDataError: it cannot be read, or is not what it claims to be.
    """
    if not path.exists():
        raise RadioDataError(path, "no such file or folder")
    data_format = data_format or found_format(path)
    if robot is not None and data_format != "mrclam":
        raise RadioDataError(path, f"a {data_format} set has one vehicle: leave out --robot")
    with np.errstate(all="ignore"):  # numbers that overflow are refused below
        run = _with_reference(bounded(_read(path, data_format, robot), path))
    return replace(run, warnings=(*run.warnings, *suspicions(run)))


def _read(path: Path, data_format: str, robot: int | None) -> RecordedRun:
    if data_format == "mrclam":
        return read_mrclam(path, robot)
    if data_format == "plaza":
        return read_plaza(path)
    if data_format == "labyrinth":
        return read_labyrinth(path)
    if path.is_dir():
        raise RadioDataError(path, "is a folder: name the CSV file in it")
    return read_events_csv(path)


def _with_reference(run: RecordedRun) -> RecordedRun:
    if run.truth is None or len(run.truth.times_s) >= LEAST_TRUTH:
        return run
    rows = plural(len(run.truth.times_s), "row")
    told = (
        f"no reference trajectory: the truth has {rows}, good for the first pose alone; errors of the path stay unknown"
    )
    return replace(run, truth=None, warnings=(*run.warnings, told))


def robots_of(path: Path, data_format: str | None = None) -> list[int | None]:
    """The robots of a set: numbers if it has several, ``[None]`` for the only one.

    Args:
        data_format: one of ``FORMATS``; found out from the files if ``None``.

    Raises:
        RadioDataError: there is no such set.
    """
    if not path.exists():
        raise RadioDataError(path, "no such file or folder")
    return [*robots_in(path)] if path.is_dir() and (data_format or found_format(path)) == "mrclam" else [None]


def found_format(path: Path) -> str:
    """Which format a file or folder has, by its names and its first line.

    Raises:
        RadioDataError: none that is known.
    """
    found = _format_of_folder(path) if path.is_dir() else _format_of_file(path)
    if found is None:
        raise RadioDataError(path, f"none of the formats {', '.join(FORMATS)}; if it is one, name it with --format")
    return found


def _format_of_file(file: Path) -> str | None:
    if is_plaza(file):
        return "plaza"
    if ROBOT_FILE.search(file.name):
        return "mrclam"
    text = read_text(file)
    if not content_lines(text):
        raise RadioDataError(file, "is empty: no line but comments; give a recording")
    return "labyrinth" if is_labyrinth(text) else "csv" if is_events_csv(text) else None


def _format_of_folder(folder: Path) -> str | None:
    if robots_in(folder):
        return "mrclam"
    files = [file for file in sorted(folder.iterdir()) if file.is_file()]
    if any(is_plaza(file) for file in files):
        return "plaza"
    texts = [file for file in files if ".txt" in file.suffixes]
    return "labyrinth" if any(is_labyrinth(read_text(file)) for file in texts) else None
