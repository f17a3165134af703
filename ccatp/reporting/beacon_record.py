"""Pure. What a mission among beacons left behind, as a report needs it. Whatever it does not hold is empty or None."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ccatp.config.radio_models import RadioConfig
from ccatp.reporting.record import FloatArray, LogLine
from ccatp.wire.topics import BeaconArrival, BeaconEllipse, BeaconMap, DangerEvent, MissionStatus

TRACK_COLUMNS, TRUTH_COLUMNS = 13, 8


class PoseTrack(NamedTuple):
    """Estimates of k frames, in the frame of the room.

    Attributes:
        seq, t_s: frames and robot time, shape (k,).
        place_m: x, y, shape (k, 2).
        heading_rad: shape (k,).
        covariance: of x, y, heading, shape (k, 3, 3).
        reckoned_m: where dead reckoning alone would see the robot, shape (k, 2).
    """

    seq: FloatArray
    t_s: FloatArray
    place_m: FloatArray
    heading_rad: FloatArray
    covariance: FloatArray
    reckoned_m: FloatArray

    @property
    def sigma_m(self) -> FloatArray:
        """Standard deviation of the place in its worst direction, shape (k,)."""
        return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(self.covariance[:, :2, :2])[:, -1], 0.0)))


class PoseTruth(NamedTuple):
    """The simulated truth in the same frames.

    Attributes:
        place_m: x, y, shape (k, 2); NaN where a frame has none.
        heading_rad: shape (k,).
        target_m: the radio that moves, shape (k, 2).
        clearance_m: of the body to the nearest obstacle, shape (k,).
    """

    place_m: FloatArray
    heading_rad: FloatArray
    target_m: FloatArray
    clearance_m: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class BeaconRecord:
    """A mission among beacons.

    Attributes:
        name: how the reader called it: its directory.
        version: of the program that recorded it.
        cfg, config_text: configuration, and its file.
        changed: keys with another value than the shipped one: value of the run, and shipped value.
        is_simulation: None where there is no recording to tell.
        summary: ``summary.json``; None where the run did not come to write one.
        track: estimates of all frames.
        truth: in the same frames; None on a real robot.
        maps, arrivals, statuses, verdicts: messages in the order of recording.
        places: where the beacons really are.
        log: what the processes said, without what they said for debugging.
        files: names and sizes in bytes.
        missing: what a complete run would hold and this one does not, one line each.
        warnings: what is damaged, one line each.
    """

    name: str
    version: str
    cfg: RadioConfig
    config_text: str
    changed: Mapping[str, tuple[object, object]]
    is_simulation: bool | None
    summary: Mapping[str, Any] | None
    track: PoseTrack
    truth: PoseTruth | None
    maps: tuple[BeaconMap, ...]
    arrivals: tuple[BeaconArrival, ...]
    statuses: tuple[MissionStatus, ...]
    verdicts: tuple[DangerEvent, ...]
    places: Mapping[str, tuple[float, float]]
    log: tuple[LogLine, ...]
    files: Mapping[str, int]
    missing: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def beacons(self) -> dict[str, BeaconEllipse]:
        """Those that stand, as the newest map has them."""
        return self.standing(self.maps[-1]) if self.maps else {}

    def standing(self, told: BeaconMap) -> dict[str, BeaconEllipse]:
        """The beacons of a map without the radio that is followed."""
        moving = self.cfg.follow.target if self.cfg.follow.is_active else ""
        return {name: ellipse for name, ellipse in told.beacons.items() if name != moving}

    @property
    def settled_s(self) -> float:
        """Robot time from which on the pose counts: a robot whose motes map themselves stands until then."""
        return self.maps[-1].notes.get("map_time_s", 0.0) if self.maps else 0.0


def pose_track(rows: FloatArray) -> PoseTrack:
    """Rows of the topic ``beacon_track``, shape (k, 13)."""
    P = rows[:, [5, 6, 8, 6, 7, 9, 8, 9, 10]].reshape(-1, 3, 3)
    return PoseTrack(rows[:, 0], rows[:, 1], rows[:, 2:4], rows[:, 4], P, rows[:, 11:13])


def pose_truth(rows: FloatArray, seq: FloatArray) -> PoseTruth:
    """Rows of the topic ``beacon_truth``, shape (j, 8), at the frames of an estimate, shape (k,)."""
    found = np.full((len(seq), TRUTH_COLUMNS), np.nan)
    _, here, there = np.intersect1d(seq, rows[:, 0], return_indices=True)
    found[here] = rows[there]
    return PoseTruth(found[:, 2:4], found[:, 4], found[:, 5:7], found[:, 7])


def pose_errors_m(record: BeaconRecord) -> FloatArray | None:
    """Distance of the estimated place from the true one, shape (k,); None where nobody knows the truth."""
    if record.truth is None:
        return None
    return np.asarray(np.hypot(*(record.track.place_m - record.truth.place_m).T))


def pose_nees(record: BeaconRecord) -> FloatArray | None:
    """e^T P^-1 e of x, y and heading, shape (k,); 3 is expected. None where nobody knows the truth."""
    if record.truth is None:
        return None
    turn = record.track.heading_rad - record.truth.heading_rad
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    errors = np.column_stack([record.track.place_m - record.truth.place_m, turn])
    return np.asarray(
        np.einsum("ni,ni->n", errors, np.linalg.solve(record.track.covariance, errors[:, :, None])[..., 0])
    )


class Reading(NamedTuple):
    """NIS of the readings between two maps, their degrees of freedom, and the robot time of the later one."""

    t_s: float
    nis: float
    size: int


def readings_of(record: BeaconRecord) -> list[Reading]:
    """How the readings agreed with what was expected of them, from map to map."""
    found = []
    for before, after in zip(record.maps, record.maps[1:], strict=False):
        size = after.nis_size - before.nis_size
        if size > 0:
            found.append(Reading(after.t_s, after.nis_sum - before.nis_sum, size))
    return found


class WaypointRow(NamedTuple):
    """A waypoint that was reached.

    Attributes:
        number: over all laps, from 1.
        lap, waypoint: from 1.
        t_s: robot time.
        place_m: where it is.
        sigma_m: of the estimated place, worst direction.
        estimate_off_m: distance of the estimated place from the waypoint.
        true_off_m: of the true place; None without a truth.
        error_m: distance of the estimated place from the true one.
        sigmas: the same in standard deviations, root(e^T P^-1 e).
    """

    number: int
    lap: int
    waypoint: int
    t_s: float
    place_m: tuple[float, float]
    sigma_m: float
    estimate_off_m: float
    true_off_m: float | None
    error_m: float | None
    sigmas: float | None


def waypoint_rows(record: BeaconRecord) -> list[WaypointRow]:
    """The waypoints in the order in which they were reached."""
    index = {int(seq): row for row, seq in enumerate(record.track.seq.tolist())}
    rows = []
    for number, arrival in enumerate(record.arrivals, start=1):
        x, y, xx, xy, yy = arrival.estimate
        P = np.array(((xx, xy), (xy, yy)))
        true = None
        if record.truth is not None and arrival.seq in index:
            true = record.truth.place_m[index[arrival.seq]]
            true = true if np.isfinite(true).all() else None
        off = None if true is None else np.array((x, y)) - true
        rows.append(
            WaypointRow(
                number=number,
                lap=arrival.lap + 1,
                waypoint=arrival.waypoint + 1,
                t_s=arrival.t_s,
                place_m=arrival.place,
                sigma_m=float(np.sqrt(max(np.linalg.eigvalsh(P)[-1], 0.0))),
                estimate_off_m=float(np.hypot(x - arrival.place[0], y - arrival.place[1])),
                true_off_m=None if true is None else float(np.hypot(*(true - arrival.place))),
                error_m=None if off is None else float(np.hypot(*off)),
                sigmas=None if off is None else float(np.sqrt(off @ np.linalg.solve(P, off))),
            )
        )
    return rows


class BeaconRow(NamedTuple):
    """A beacon on the last map: place, standard deviation in its worst direction, true error, NEES (2 is expected)."""

    name: str
    place_m: tuple[float, float]
    sigma_m: float
    error_m: float | None
    nees: float | None


def beacon_rows(record: BeaconRecord) -> list[BeaconRow]:
    """The beacons that stand, by name."""
    rows = []
    for name, (x, y, xx, xy, yy) in sorted(record.beacons.items()):
        P = np.array(((xx, xy), (xy, yy)))
        off = None if name not in record.places else np.subtract((x, y), record.places[name])
        sigma_m = float(np.sqrt(max(np.linalg.eigvalsh(P)[-1], 0.0)))
        nees = None if off is None else float(off @ np.linalg.pinv(P) @ off)
        rows.append(BeaconRow(name, (x, y), sigma_m, None if off is None else float(np.hypot(*off)), nees))
    return rows
