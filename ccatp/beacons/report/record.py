"""Data of a recorded mission among beacons for its report, their reader, and the errors against the truth."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import dist, sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.beacons.config.load import load_radio_config
from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.links.messages import (
    TRACK_COLUMNS,
    TRUTH_COLUMNS,
    PoseTrack,
    PoseTruth,
    pose_errors,
    pose_track,
    pose_truth,
    truth_in,
    worst_sigma_m,
)
from ccatp.beacons.links.topics import BeaconArrival, BeaconEllipse, BeaconMapMessage
from ccatp.beacons.records.summary import beacon_errors, sigmas_off
from ccatp.core import FloatArray
from ccatp.filters.metrics import nees
from ccatp.links.topics import MissionStatus
from ccatp.records.run_reader import CONFIG
from ccatp.report.record import RunFiles, RunFolder, changed_keys, joined

_COLUMNS = {"beacon_track": TRACK_COLUMNS, "beacon_truth": TRUTH_COLUMNS}
BEACON_TOPICS_READ = frozenset((*_COLUMNS, "beacon_map", "beacon_arrival", "beacon_places", "mission"))


def standing_beacons(cfg: RadioConfig, message: BeaconMapMessage) -> dict[str, BeaconEllipse]:
    """The beacons of a map, without the followed radio."""
    moving = cfg.follow.target if cfg.follow.is_active else ""
    return {name: ellipse for name, ellipse in message.beacons.items() if name != moving}


def expected_rms_m(beacons: Mapping[str, BeaconEllipse]) -> float | None:
    """Root mean square position error of the beacons by the filter, sqrt(mean(xx + yy)), m; None without beacons."""
    if not beacons:
        return None
    total = sum(xx + yy for _, _, xx, _, yy in beacons.values())
    return sqrt(max(total, 0.0) / len(beacons))


def true_rms_m(beacons: Mapping[str, BeaconEllipse], places: Mapping[str, tuple[float, float]]) -> float | None:
    """Root mean square distance of the beacons from their true places, m; None if no true place is known."""
    squares = [
        (x - places[name][0]) ** 2 + (y - places[name][1]) ** 2
        for name, (x, y, *_) in beacons.items()
        if name in places
    ]
    return sqrt(sum(squares) / len(squares)) if squares else None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BeaconRecord(RunFiles):
    """A mission among beacons. The truth has the frames of the track: NaN where it is missing, None on a real robot."""

    version: str
    cfg: RadioConfig
    track: PoseTrack
    truth: PoseTruth | None
    maps: tuple[BeaconMapMessage, ...]
    arrivals: tuple[BeaconArrival, ...]
    statuses: tuple[MissionStatus, ...]
    places: Mapping[str, tuple[float, float]]

    @property
    def beacons(self) -> dict[str, BeaconEllipse]:
        """The stationary beacons of the newest map."""
        return standing_beacons(self.cfg, self.maps[-1]) if self.maps else {}

    @property
    def settled_s(self) -> float:
        """Robot time after which the pose is evaluated: a robot whose motes map themselves stands until then."""
        return self.maps[-1].notes.get("map_time_s", 0.0) if self.maps else 0.0


def read_beacon_record(run_dir: Path) -> BeaconRecord:
    """Read the data for the report of a mission among beacons; ConfigError: its configuration cannot be used."""
    cfg = load_radio_config(run_dir / CONFIG)
    shipped = load_radio_config(None, {"system": cfg.system})
    folder = RunFolder(run_dir, "log of the processes")
    recorded = folder.recordings(BEACON_TOPICS_READ, _COLUMNS, "path, map and readings over time")
    parts = [part for part in recorded if part is not None]
    found = {topic: [one for part in parts for one in part.messages[topic]] for topic in BEACON_TOPICS_READ}
    if folder.is_simulation and not found["beacon_truth"]:
        folder.missing.append("the simulated truth: errors are not known")
    track, truth = (joined(found[topic], count, needed=5) for topic, count in _COLUMNS.items())
    return BeaconRecord(
        cfg=cfg,
        version=parts[-1].version if parts else "unknown",
        changed=changed_keys(cfg.model_dump(mode="json"), shipped.model_dump(mode="json")),
        track=pose_track(track),
        truth=truth_in(pose_truth(truth), track[:, 0]) if found["beacon_truth"] else None,
        maps=tuple(found["beacon_map"]),
        arrivals=tuple(found["beacon_arrival"]),
        statuses=tuple(found["mission"]),
        places=found["beacon_places"][-1].places if found["beacon_places"] else {},
        **folder.fields(),
    )


def pose_errors_m(record: BeaconRecord) -> FloatArray | None:
    """Distance of the estimated place from the true one, shape (k,); None if the truth is not known."""
    if record.truth is None:
        return None
    return np.asarray(np.hypot(*(record.track.place_m - record.truth.place_m).T))


def pose_nees(record: BeaconRecord) -> FloatArray | None:
    """NEES e^T P^-1 e of x, y and heading, shape (k,), with the expectation 3; None if the truth is not known."""
    if record.truth is None:
        return None
    return nees(pose_errors(record.track, record.truth), record.track.covariance)


class Reading(NamedTuple):
    """NIS of the readings between two maps, their degrees of freedom, and the robot time of the later one."""

    t_s: float
    nis: float
    size: int


def readings_of(record: BeaconRecord) -> list[Reading]:
    """NIS of the readings from map to map."""
    pairs = zip(record.maps, record.maps[1:], strict=False)
    found = [Reading(later.t_s, later.nis_sum - one.nis_sum, later.nis_size - one.nis_size) for one, later in pairs]
    return [reading for reading in found if reading.size > 0]


class WaypointRow(NamedTuple):
    """A waypoint that was reached; None if the truth is not known."""

    number: int  # over all laps, from 1
    lap: int  # from 1
    waypoint: int  # from 1
    t_s: float
    place_m: tuple[float, float]
    sigma_m: float
    estimate_off_m: float
    true_off_m: float | None  # distance of the true place from the waypoint
    error_m: float | None  # distance of the estimated place from the true one
    sigmas: float | None  # the same in standard deviations, root(e^T P^-1 e)


def waypoint_rows(record: BeaconRecord) -> list[WaypointRow]:
    """The waypoints in the order in which they were reached."""
    index = {int(seq): row for row, seq in enumerate(record.track.seq.tolist())}
    rows = []
    for number, arrival in enumerate(record.arrivals, start=1):
        x, y, *ellipse = arrival.estimate
        true_off_m = error_m = sigmas = None
        if record.truth is not None and arrival.seq in index:
            true = record.truth.place_m[index[arrival.seq]]
            if np.isfinite(true).all():
                true_off_m, error_m = dist(true, arrival.place), dist(true, (x, y))
                sigmas = sigmas_off(arrival.estimate, true)
        off_m = dist((x, y), arrival.place)
        where = (number, arrival.lap + 1, arrival.waypoint + 1, arrival.t_s, arrival.place)
        rows.append(WaypointRow(*where, worst_sigma_m(*ellipse), off_m, true_off_m, error_m, sigmas))
    return rows


class BeaconRow(NamedTuple):
    """A beacon on the last map: place, standard deviation in its worst direction, true error, NEES (2 is expected)."""

    name: str
    place_m: tuple[float, float]
    sigma_m: float
    error_m: float | None
    nees: float | None


def beacon_rows(record: BeaconRecord) -> list[BeaconRow]:
    """The stationary beacons, by name."""
    judged = beacon_errors(record.beacons, record.places)
    return [
        BeaconRow(name, (x, y), worst_sigma_m(*ellipse), *judged.get(name, (None, None)))
        for name, (x, y, *ellipse) in sorted(record.beacons.items())
    ]
