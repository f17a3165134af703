"""The result of ``ccatp radio slam --out DIR`` as files: path, map, readings with innovations, factor graph."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ccatp.beacons.config.models import RecordingConfig
from ccatp.beacons.datasets.pyfg import pyfg_lines
from ccatp.beacons.datasets.sheets import write_beacons
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.estimation.evaluation import truth_at
from ccatp.beacons.estimation.recording import EstimatedPath, RecordedRun
from ccatp.beacons.estimation.track_review import range_residuals
from ccatp.core import FloatArray

PATH = ("time_s", "x_m", "y_m", "heading_rad", "xx_m2", "xy_m2", "xh_m_rad", "yy_m2", "yh_m_rad", "hh_rad2")
READINGS = (
    "time_s", "beacon", "tag", "range_m", "bearing_rad", "rssi_dbm", "residual_m", "nis", "nis_size", "is_used",
)  # fmt: skip
MOVING = ("time_s", "beacon", "x_m", "y_m", "xx_m2", "xy_m2", "yy_m2")
FRAME = "of the first pose: that of the truth, or the origin"


def write_slam(folder: Path, run: RecordedRun, track: EstimatedPath, assumed: RecordingConfig) -> None:
    """Write ``path.csv``, ``map.toml`` with the joint covariance, ``readings.csv`` and, for one radio, ``graph.pyfg``.

    A path of a fixed-lag smoother is in ``path_delayed.csv``, too; ``moving.csv`` has beacons that moved, if any.
    Raises RadioDataError: they cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / "path.csv", PATH, _path_rows(track.times_s, track.poses, track.covariances))
        if (late := track.delayed) is not None:
            _write(folder / "path_delayed.csv", PATH, _path_rows(late.times_s, late.poses, late.covariances))
        _write(folder / "readings.csv", READINGS, _reading_rows(run, track, assumed.radio.camera_field_rad))
        if track.tracks:
            _write(folder / "moving.csv", MOVING, _track_rows(track))
        if not run.tags:  # the format has no places of radios on the vehicle
            times_s = run.steps.times_s
            true = np.full((len(times_s), 3), np.nan) if run.truth is None else truth_at(run.truth, times_s)
            graph = "\n".join(pyfg_lines(run, assumed, true)) + "\n"
            (folder / "graph.pyfg").write_text(graph, encoding="utf-8")
    except OSError as error:
        raise RadioDataError(error.filename or folder, f"cannot be written: {error.strerror or error}") from error
    places_m = np.array([fix[:2] for fix in track.beacons.values()], dtype=np.float64).reshape(-1, 2)
    write_beacons(folder / "map.toml", list(track.beacons), places_m, track.map_covariance, FRAME)


def _write(file: Path, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(head)
        writer.writerows(rows)


def _path_rows(times_s: FloatArray, poses: FloatArray, covariances: FloatArray) -> list[list[float]]:
    upper = covariances[:, *np.triu_indices(3)]
    rows: list[list[float]] = np.column_stack([times_s, poses, upper]).tolist()
    return rows


def _track_rows(track: EstimatedPath) -> Iterable[list[object]]:
    for name, (times_s, places_m, covariances_m2) in track.tracks.items():
        for time_s, place_m, P in zip(times_s.tolist(), places_m.tolist(), covariances_m2, strict=True):
            yield [time_s, name, *place_m, *P[np.triu_indices(2)].tolist()]


def _reading_rows(run: RecordedRun, track: EstimatedPath, camera_field_rad: float) -> Iterable[list[object]]:
    """Residuals are those of the final path and map; innovations are those before each update. Empty: there is none."""
    residuals = range_residuals(run, track, camera_field_rad)
    found = {(one.time_s, one.beacon, one.tag): one for one in track.innovations}
    r = run.readings
    columns = (r.times_s, r.beacon, r.range_m, r.bearing_rad, r.rssi_dbm, residuals)
    for row, (time_s, beacon, *values) in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
        name, tag = run.beacon_ids[beacon], "" if r.tag is None else run.tags[int(r.tag[row])].name
        one = found.get((time_s, name, tag))
        numbers = ["" if np.isnan(value) else value for value in values]
        yield [time_s, name, tag, *numbers, *(("", "", "") if one is None else (one.nis, one.size, int(one.is_used)))]
