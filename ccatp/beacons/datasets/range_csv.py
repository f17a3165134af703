"""Reads ranges between motes, and known places of motes, from CSV files.

Writes and reads a map of beacons as TOML: what navigation takes over from self-mapping.
"""

import csv
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.beacons.cricket.measured_map import MeasuredRanges
from ccatp.beacons.cricket.range_network import MappingError, MoteRange
from ccatp.config.messages import format_toml
from ccatp.core import FloatArray

PLAIN = ("first", "second", "range_m")
SESSION = ("session", "pos", "deg", "anchor", "tag", "mean_m")
PLACES = ("name", "x_m", "y_m")
COMMENT = "#"
LONGEST_M = 1e6
SHORTEST_M = 1e-3  # no two motes are nearer
FINEST_M = 1e-6  # no range is better


class RangeFileError(MappingError):
    """A file of ranges or places that cannot be used: file, line, what is wrong."""


def read_ranges(path: Path, sigma_m: float) -> MeasuredRanges:
    """Ranges of a CSV file with a header; lines that begin with # are comments.

    Two forms are read. ``first,second,range_m`` with ``sigma_m`` where ranges differ in quality: one range a line.
    ``session,pos,deg,anchor,tag,n,mean_m,...``: a trolley with tags among anchors, one line for the mean range of an
    anchor to a tag while the trolley stood at a position with a heading; tags of one standstill move together.

    Raises:
        RangeFileError: it cannot be read, or a line is no range.
    """
    header, rows = _table(path)
    if set(SESSION) <= set(header):
        return _session(path, rows, sigma_m)
    if not set(PLAIN) <= set(header):
        raise RangeFileError(
            f"{path}:1: columns {','.join(header)}; wanted {','.join(PLAIN)}[,sigma_m], or {','.join(SESSION)}"
        )
    readings = []
    for line, row in rows:
        own = row.get("sigma_m") or ""
        sigma = _number(path, line, "sigma_m", own) if own.strip() else sigma_m
        first, second = (_name(path, line, key, row[key]) for key in PLAIN[:2])
        readings.append(
            _checked(path, line, MoteRange(first, second, _number(path, line, "range_m", row["range_m"]), sigma))
        )
    if not readings:
        raise RangeFileError(f"{path}: has no ranges, only a header")
    return MeasuredRanges(tuple(readings), {}, {})


def read_places(path: Path) -> dict[str, tuple[float, ...]]:
    """Places of motes by name: CSV with ``name,x_m,y_m`` and, in space, ``z_m``.

    Raises:
        RangeFileError: it cannot be read, or a line is no place.
    """
    header, rows = _table(path)
    if not set(PLACES) <= set(header):
        raise RangeFileError(f"{path}:1: columns {','.join(header)}; wanted {','.join(PLACES)}[,z_m]")
    if not rows:
        raise RangeFileError(f"{path}: has no places, only a header")
    axes = [axis for axis in ("x_m", "y_m", "z_m") if axis in header]
    return {
        _name(path, line, "name", row["name"]): tuple(_coordinate(path, line, axis, row[axis]) for axis in axes)
        for line, row in rows
    }


def _session(path: Path, rows: Iterable[tuple[int, Mapping[str, str]]], sigma_m: float) -> MeasuredRanges:
    readings, groups, tags = [], dict[str, dict[str, None]](), dict[str, str]()
    for line, row in rows:
        pose = f"{row['pos']}/{row['deg']}"
        tag = f"{pose}/tag{row['tag']}"
        range_m = _number(path, line, "mean_m", row["mean_m"])
        readings.append(_checked(path, line, MoteRange(f"anchor{row['anchor']}", tag, range_m, sigma_m)))
        groups.setdefault(pose, {})[tag] = None
        tags[tag] = f"tag{row['tag']}"
    if not readings:
        raise RangeFileError(f"{path}: has no ranges, only a header")
    return MeasuredRanges(tuple(readings), {pose: tuple(motes) for pose, motes in groups.items()}, tags)


def _table(path: Path) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(_without_comments(file))
            rows = [(reader.line_num, row) for row in reader if len(row) > 1 or "".join(row).strip()]
    except OSError as error:
        raise RangeFileError(
            f"{path}: {(error.strerror or str(error)).lower()}; name a CSV file that exists"
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise RangeFileError(f"{path}: is no CSV text: {error}") from error
    if not rows:
        raise RangeFileError(f"{path}: is empty; give a header and a line for each")
    header = [name.strip() for name in rows[0][1]]
    padding = [""] * len(header)
    return header, [(line, dict(zip(header, row + padding, strict=False))) for line, row in rows[1:]]


def _without_comments(lines: Iterable[str]) -> Iterator[str]:
    """The lines, empty in place of comments, so that their numbers stay."""
    for line in lines:
        yield "\n" if line.lstrip().startswith(COMMENT) else line


def _number(path: Path, line: int, key: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise RangeFileError(f"{path}:{line}: {key} = {text!r} is no number") from None


def _coordinate(path: Path, line: int, key: str, text: str) -> float:
    if not abs(value_m := _number(path, line, key, text)) <= LONGEST_M:
        raise RangeFileError(f"{path}:{line}: {key} = {value_m:g} is no place within {LONGEST_M:g} m")
    return value_m


def _name(path: Path, line: int, key: str, text: str) -> str:
    if not (name := text.strip()):
        raise RangeFileError(f"{path}:{line}: {key} is empty; every mote needs a name")
    return name


def _checked(path: Path, line: int, reading: MoteRange) -> MoteRange:
    if not SHORTEST_M <= reading.range_m <= LONGEST_M:
        is_far = reading.range_m > LONGEST_M
        what = f"is more than the {LONGEST_M:g} m that beacons reach" if is_far else "is no distance"
        raise RangeFileError(f"{path}:{line}: range of {reading.range_m:g} m {what}; in metres, between two places")
    if not FINEST_M <= reading.sigma_m <= LONGEST_M:
        raise RangeFileError(f"{path}:{line}: sigma of {reading.sigma_m:g} m, must be {FINEST_M:g} to {LONGEST_M:g} m")
    if reading.first == reading.second:
        raise RangeFileError(f"{path}:{line}: from {reading.first} to itself; leave it out")
    return reading


_HEAD = "# Beacons, mapped by ccatp radio map: m, and the covariance of all coordinates in their order, m^2.\n\n"


class BeaconFileError(MappingError):
    """A file of beacons that cannot be written or read."""


class BeaconPositions(NamedTuple):
    """Beacons with what is uncertain about them."""

    names: tuple[str, ...]
    positions_m: FloatArray  # shape (n, d)
    covariance_m2: FloatArray  # of all coordinates, shape (n d, n d)
    frame: str


def write_beacons(
    path: Path, names: Sequence[str], positions_m: FloatArray, covariance_m2: FloatArray, frame: str
) -> None:
    """Write a map.

    Args:
        positions_m: shape (n, d).
        covariance_m2: shape (n d, n d).

    Raises:
        BeaconFileError: the file cannot be written.
    """
    d = positions_m.shape[1]
    beacons = {}
    for row, name in enumerate(names):
        block = covariance_m2[row * d : (row + 1) * d, row * d : (row + 1) * d]
        beacons[name] = {
            "position_m": positions_m[row].tolist(),
            "sigma_m": np.sqrt(np.maximum(block.diagonal(), 0.0)).tolist(),
        }
    tree = {"frame": frame, "dimension": d, "beacons": beacons, "joint": {"covariance_m2": covariance_m2.tolist()}}
    try:
        path.write_text(_HEAD + format_toml(tree), encoding="utf-8")
    except OSError as error:
        raise BeaconFileError(f"{path}: cannot be written: {error.strerror or error}") from error


def read_beacons(path: Path) -> BeaconPositions:
    """Read a map that ``write_beacons`` wrote.

    Raises:
        BeaconFileError: it cannot be read, or it is no such map.
    """
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BeaconFileError(f"{path}: cannot be read as a map of beacons: {error}") from error
    try:
        names = tuple(tree["beacons"])
        positions = np.array([tree["beacons"][name]["position_m"] for name in names], dtype=np.float64)
        covariance = np.array(tree["joint"]["covariance_m2"], dtype=np.float64)
        frame = str(tree["frame"])
    except (KeyError, TypeError, ValueError) as error:
        raise BeaconFileError(f"{path}: is no map of beacons: {error}") from error
    if positions.ndim != 2 or covariance.shape != (positions.size, positions.size):
        raise BeaconFileError(f"{path}: covariance of shape {covariance.shape} for {positions.size} coordinates")
    return BeaconPositions(names, positions, covariance, frame)
