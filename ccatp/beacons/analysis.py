"""A mission among beacons for analysis, and an estimate of a recording in one call."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.analysis.run import Run, shared_fields
from ccatp.analysis.samples import KINDS, Row, SampleKind
from ccatp.analysis.table import Table, table_of_rows
from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.datasets.reader import read_run
from ccatp.beacons.estimation.evaluation import TrackEvaluation, judge
from ccatp.beacons.estimation.recording import EstimatedPath, RecordedRun
from ccatp.beacons.links.messages import BeaconFrame, RadioSample, SteerSample, decode_beacon_frame
from ccatp.beacons.report.record import BeaconRecord, beacon_rows, read_beacon_record, waypoint_rows
from ccatp.beacons.studies.recordings import FILTERS, estimate
from ccatp.core import FloatArray
from ccatp.records.run_reader import RecordedFrame

_TRACK = {
    "frame": "number of the frame, which grows also where the robot restarts",
    "t_s": "mission time",
    "x_m": "estimated position, frame of the start",
    "y_m": "estimated position, frame of the start",
    "heading_rad": "estimated heading",
    "sigma_m": "standard deviation of the position in its worst direction",
    "reckoned_x_m": "position by dead reckoning alone",
    "reckoned_y_m": "position by dead reckoning alone",
    "true_x_m": "simulated position; NaN on a real robot",
    "true_y_m": "simulated position; NaN on a real robot",
    "true_heading_rad": "simulated heading; NaN on a real robot",
}
_BEACONS = ("name", "x_m", "y_m", "sigma_m", "error_m", "nees")
_ARRIVALS = (
    "number", "lap", "waypoint", "t_s", "x_m", "y_m", "sigma_m", "estimate_off_m", "true_off_m", "error_m",
)  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class BeaconRun(Run):
    """A mission among beacons, in the frame of its start."""

    record: BeaconRecord

    @cached_property
    def beacons(self) -> Table:
        """The stationary beacons of the newest map; ``nees`` of a position (2 is expected), NaN without a truth."""
        return table_of_rows(_BEACONS, ((one.name, *one.place_m, *one[2:]) for one in beacon_rows(self.record)))

    @cached_property
    def arrivals(self) -> Table:
        """The waypoints in the order in which they were reached."""
        rows = ((*one[:4], *one.place_m, *one[5:9]) for one in waypoint_rows(self.record))
        return table_of_rows(_ARRIVALS, rows)

    def track(self) -> Table:
        """Estimated and true pose of each frame."""
        track, truth = self.record.track, self.record.truth
        true = np.full((len(track.seq), 3), np.nan)
        if truth is not None:
            true = np.column_stack([truth.place_m, truth.heading_rad])
        columns = (track.seq.astype(np.int64), track.t_s, *track.place_m.T, track.heading_rad, track.sigma_m)
        return Table(dict(zip(_TRACK, (*columns, *track.reckoned_m.T, *true.T), strict=True)), _TRACK)


def open_beacons(run_dir: Path) -> BeaconRun:
    """The mission of a run directory; errors as ``ccatp.open_run``."""
    record = read_beacon_record(run_dir)
    statuses = [(status.t_s, status) for status in record.statuses]
    return BeaconRun(config=record.cfg, record=record, sample_kinds=SAMPLES, **shared_fields(run_dir, record, statuses))


# -- samples ----------------------------------------------------------------------------------------------------------


def _extras(frame: RecordedFrame) -> BeaconFrame:
    return decode_beacon_frame(frame.line)


def _distances(frame: RecordedFrame) -> Iterator[Row]:
    return ((frame.sensors.t, at, distance_m) for at, distance_m in enumerate(_extras(frame).distances))


def _scan(frame: RecordedFrame) -> Iterator[Row]:
    scan = _extras(frame).scan
    if scan is None:
        return
    for beacon, levels in scan.levels.items():
        for at, level_dbm in enumerate(levels):
            yield scan.t, beacon, at * scan.step, level_dbm


def _motes(frame: RecordedFrame) -> Iterator[Row]:
    for burst in _extras(frame).motes:
        for pulse, delay_s in enumerate(burst.delays_s):
            yield burst.t_s, burst.sender, burst.listener, burst.temperature_c, pulse, delay_s


SAMPLES: Mapping[str, SampleKind] = {
    **KINDS,
    "steer": SampleKind(SteerSample._fields, lambda frame: _extras(frame).steer),
    "radio": SampleKind(RadioSample._fields, lambda frame: _extras(frame).radio, ("beacon",)),
    "scan": SampleKind(("t_s", "beacon", "direction_rad", "rssi_dbm"), _scan, ("beacon",)),
    "distances": SampleKind(("t_s", "sensor", "distance_m"), _distances),
    "motes": SampleKind(
        ("t_s", "sender", "listener", "temperature_c", "pulse", "delay_s"), _motes, ("sender", "listener")
    ),
}


# -- estimates of recordings ------------------------------------------------------------------------------------------


class Slam(NamedTuple):
    """A recording, the estimate of its path and map, and its errors against the truth of the recording."""

    recording: RecordedRun
    path: EstimatedPath
    errors: TrackEvaluation

    @property
    def track(self) -> Table:
        """Estimated poses, and the covariance of the position."""
        poses, P = self.path.poses, self.path.covariances
        values: tuple[FloatArray, ...] = (self.path.times_s, *poses.T, P[:, 0, 0], P[:, 0, 1], P[:, 1, 1])
        names = ("t_s", "x_m", "y_m", "heading_rad", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2")
        return Table(dict(zip(names, values, strict=True)))

    @property
    def beacons(self) -> Table:
        """The map: position of each beacon, and its error after the alignment; NaN where it was not surveyed."""
        rows = (
            (name, one.x_m, one.y_m, self.errors.beacon_errors_m.get(name)) for name, one in self.path.beacons.items()
        )
        return table_of_rows(("name", "x_m", "y_m", "error_m"), rows)


def slam(
    recording: str | PathLike[str] | RecordedRun,
    *,
    filter_name: str = "fixed-lag",
    data_format: str | None = None,
    robot: int | None = None,
    settings: Mapping[str, object] | None = None,
) -> Slam:
    """Map the beacons of a recording and find the vehicle's path, as ``ccatp radio slam``.

    ``settings``: dotted keys of the configuration of recordings. Raises RadioDataError: the recording cannot be read;
    EstimateError: the data do not determine an estimate; ConfigError: a setting cannot be used.
    """
    if filter_name not in FILTERS:
        raise ValueError(f"no estimator {filter_name!r}; there are {', '.join(FILTERS)}")
    assumed = load_recordings_config(None, settings)
    run = recording if isinstance(recording, RecordedRun) else read_run(Path(recording), data_format, robot)
    path = estimate(run, assumed, filter_name)
    return Slam(run, path, judge(path, run))
