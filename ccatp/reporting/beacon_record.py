"""Pure. What a mission among beacons left behind, as a report needs it. Whatever it does not hold is empty or None."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ccatp.config.radio_models import RadioConfig
from ccatp.radio.metrics import nees
from ccatp.reporting.record import FloatArray, RunFiles
from ccatp.wire.beacon_rows import PoseTrack, PoseTruth, pose_errors
from ccatp.wire.topics import BeaconArrival, BeaconEllipse, BeaconMap, DangerEvent, MissionStatus


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BeaconRecord(RunFiles):
    """A mission among beacons.

    Attributes:
        version: of the program that recorded it.
        cfg: configuration.
        track: estimates of all frames.
        truth: in the same frames, NaN where there is none; None on a real robot.
        maps, arrivals, statuses, verdicts: messages in the order of recording.
        places: where the beacons really are.
    """

    version: str
    cfg: RadioConfig
    track: PoseTrack
    truth: PoseTruth | None
    maps: tuple[BeaconMap, ...]
    arrivals: tuple[BeaconArrival, ...]
    statuses: tuple[MissionStatus, ...]
    verdicts: tuple[DangerEvent, ...]
    places: Mapping[str, tuple[float, float]]

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


def pose_errors_m(record: BeaconRecord) -> FloatArray | None:
    """Distance of the estimated place from the true one, shape (k,); None where nobody knows the truth."""
    if record.truth is None:
        return None
    return np.asarray(np.hypot(*(record.track.place_m - record.truth.place_m).T))


def pose_nees(record: BeaconRecord) -> FloatArray | None:
    """e^T P^-1 e of x, y and heading, shape (k,); 3 is expected. None where nobody knows the truth."""
    if record.truth is None:
        return None
    return nees(pose_errors(record.track, record.truth), record.track.covariance)


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
