"""What a survey or a beacon mission left behind, as a report needs it; what it does not hold is empty or None."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.models import Config
from ccatp.core import FloatArray, IntArray, PanelId, PointId, Vector3
from ccatp.filters.metrics import nees
from ccatp.links.beacon_messages import PoseTrack, PoseTruth, pose_errors
from ccatp.links.topics import BeaconArrival, BeaconEllipse, BeaconMapMessage, DangerEvent, FixMessage, MissionStatus
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panel_alignment import Measured
from ccatp.records.state_log import LogLine, StateChange

COMPLETE = "complete"
WITHIN_MM = 10.0  # the thesis's requirement on arrivals


class EstimatedTrack(NamedTuple):
    """Estimated poses after k frames, deck frame.

    Attributes:
        seq: numbers of the frames, shape (k,).
        t_s: robot time, shape (k,).
        place_m: points on the surface, shape (k, 3).
        heading_rad: shape (k,).
        sigma_m: standard deviation of the place along any one direction, shape (k,).
    """

    seq: IntArray
    t_s: FloatArray
    place_m: FloatArray
    heading_rad: FloatArray
    sigma_m: FloatArray


class TrueTrack(NamedTuple):
    """True poses after k frames, as in ``EstimatedTrack``; ``clearance_m`` of the worst edge sensor to the rim."""

    seq: IntArray
    t_s: FloatArray
    place_m: FloatArray
    heading_rad: FloatArray
    clearance_m: FloatArray


class Arrived(NamedTuple):
    """The robot came to rest at a point for the first time, as it took it."""

    point: PointId
    seq: int
    t_s: float
    estimated_error_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSession:
    """One recording; a run that was resumed has several.

    Attributes:
        track, truth: poses; truth is None on a real robot.
        changes: of the mission's state, from the log; empty where the log does not tell them in order.
    """

    name: str
    version: str
    track: EstimatedTrack
    truth: TrueTrack | None
    arrivals: tuple[Arrived, ...]
    fixes: tuple[FixMessage, ...]
    statuses: tuple[MissionStatus, ...]
    verdicts: tuple[DangerEvent, ...]
    changes: tuple[StateChange, ...]

    @property
    def span_s(self) -> float:
        """Robot time from the first frame to the last one."""
        return float(self.track.t_s[-1] - self.track.t_s[0]) if len(self.track.t_s) else 0.0


class PlannedRow(NamedTuple):
    """A point of the mission: planned, measured or skipped; robot time of the latter two."""

    point: PointId
    status: str
    t_s: float | None


class PointOutcome(NamedTuple):
    """How a run ended, in a few words; why, where that is recorded; and whether that is as it should be."""

    text: str
    cause: str
    is_good: bool


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RunFiles:
    """What every run leaves behind, whatever its mission.

    Attributes:
        changed: keys with another value than the shipped one: value of the run, and shipped value.
        summary: ``summary.json``; None where the run did not come to write one.
        missing: what a complete run would hold and this one does not, one line each.
    """

    name: str
    config_text: str
    changed: Mapping[str, tuple[object, object]]
    is_simulation: bool | None
    summary: Mapping[str, Any] | None
    log: tuple[LogLine, ...]
    files: Mapping[str, int]
    missing: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def began(self) -> str:
        """Wall clock of the first line of the log, UTC; empty where it has none."""
        return next((line.wall[:19].replace("T", " ") + " UTC" for line in self.log if line.wall), "")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RunRecord(RunFiles):
    """A survey.

    Attributes:
        points: of the mission database, by row, column and number; None where there is none.
        injected: piston (m), tip and tilt (rad) of the simulated panels.
    """

    cfg: Config
    mirror: Mirror
    sessions: tuple[RecordedSession, ...]
    points: tuple[PlannedRow, ...] | None
    measured: tuple[Measured, ...]
    injected: Mapping[PanelId, Vector3] | None

    @property
    def last_status(self) -> MissionStatus | None:
        """The last status of the mission."""
        said = [status for session in self.sessions for status in session.statuses]
        return said[-1] if said else None

    @property
    def has_truth(self) -> bool:
        """Every recording with frames holds the simulated truth."""
        driven = [session for session in self.sessions if len(session.track.seq)]
        return bool(driven) and all(session.truth is not None for session in driven)


def changed_keys(
    ours: Mapping[str, Any], shipped: Mapping[str, Any], prefix: str = ""
) -> dict[str, tuple[object, object]]:
    """Keys of a configuration whose values differ: ours and the shipped ones; None where there is none."""
    found: dict[str, tuple[object, object]] = {}
    for key in dict.fromkeys((*ours, *shipped)):
        one, other = ours.get(key), shipped.get(key)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            found |= changed_keys(one, other, f"{prefix}{key}.")
        elif one != other:
            found[prefix + key] = (one, other)
    return found


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BeaconRecord(RunFiles):
    """A mission among beacons.

    Attributes:
        truth: in the same frames, NaN where there is none; None on a real robot.
    """

    version: str
    cfg: RadioConfig
    track: PoseTrack
    truth: PoseTruth | None
    maps: tuple[BeaconMapMessage, ...]
    arrivals: tuple[BeaconArrival, ...]
    statuses: tuple[MissionStatus, ...]
    verdicts: tuple[DangerEvent, ...]
    places: Mapping[str, tuple[float, float]]

    @property
    def beacons(self) -> dict[str, BeaconEllipse]:
        """Those that stand, as the newest map has them."""
        return self.standing(self.maps[-1]) if self.maps else {}

    def standing(self, told: BeaconMapMessage) -> dict[str, BeaconEllipse]:
        """The beacons of a map without the radio that is followed."""
        moving = self.cfg.follow.target if self.cfg.follow.is_active else ""
        return {name: ellipse for name, ellipse in told.beacons.items() if name != moving}

    @property
    def settled_s(self) -> float:
        """Robot time from which on the pose counts: a robot whose motes map themselves stands until then."""
        return self.maps[-1].notes.get("map_time_s", 0.0) if self.maps else 0.0


def pose_errors_m(record: BeaconRecord) -> FloatArray | None:
    """Distance of the estimated place from the true one, shape (k,); None where the truth is not known."""
    if record.truth is None:
        return None
    return np.asarray(np.hypot(*(record.track.place_m - record.truth.place_m).T))


def pose_nees(record: BeaconRecord) -> FloatArray | None:
    """e^T P^-1 e of x, y and heading, shape (k,); 3 is expected. None where the truth is not known."""
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
