"""Edge. Reads the run directory of a mission among beacons for a report; whatever is missing or damaged is told."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ccatp.config.radio_loader import load_radio_config
from ccatp.config.radio_models import RadioConfig
from ccatp.reporting.beacon_record import BeaconRecord
from ccatp.reporting.record import FloatArray, changed_keys
from ccatp.run_files.recorder import iter_messages, read_metadata, recordings
from ccatp.run_files.report_reader import LOG, SUMMARY, files_of, read_summary
from ccatp.run_files.run_reader import CONFIG, TELEMETRY
from ccatp.run_files.state_log import read_log
from ccatp.run_files.writing import damage_text
from ccatp.wire.beacon_rows import TRACK_COLUMNS, TRUTH_COLUMNS, pose_track, pose_truth, table, truth_in
from ccatp.wire.topics import (
    BadMessage,
    BeaconArrival,
    BeaconMap,
    BeaconPlaces,
    BeaconTrack,
    BeaconTruth,
    DangerEvent,
    MissionStatus,
    unpack,
)

READ = frozenset(
    ("beacon_track", "beacon_truth", "beacon_map", "beacon_arrival", "beacon_places", "mission", "danger_event")
)


def read_beacon_record(run_dir: Path) -> BeaconRecord:
    """Everything that a report tells of a mission among beacons.

    Args:
        run_dir: a directory with the configuration of such a mission.

    Raises:
        ConfigError: its configuration cannot be used.
    """
    cfg = load_radio_config(run_dir / CONFIG)
    missing: list[str] = []
    warnings: list[str] = []
    log = list(read_log(run_dir / LOG, warnings))
    if not log:
        missing.append(f"{LOG}: what the processes said")
    found = _Collected()
    paths = recordings(run_dir / TELEMETRY)
    if not paths:
        missing.append(f"{TELEMETRY}: path, map and readings over time")
    for path in paths:
        found.read(path, warnings)
    if found.is_simulation and paths and not found.truth:
        missing.append("the simulated truth: errors are not known")
    track = _ordered(found.track, TRACK_COLUMNS)
    return BeaconRecord(
        name=run_dir.resolve().name,
        version=found.version,
        cfg=cfg,
        config_text=(run_dir / CONFIG).read_text(encoding="utf-8", errors="replace"),
        changed=_changed(cfg),
        is_simulation=found.is_simulation,
        summary=read_summary(run_dir / SUMMARY, missing, warnings),
        track=pose_track(track),
        truth=truth_in(pose_truth(_ordered(found.truth, TRUTH_COLUMNS)), track[:, 0]) if found.truth else None,
        maps=tuple(found.maps),
        arrivals=tuple(found.arrivals),
        statuses=tuple(found.statuses),
        verdicts=tuple(found.verdicts),
        places=found.places,
        log=tuple(line.shown for line in log if line.shown is not None),
        files=files_of(run_dir),
        missing=tuple(missing),
        warnings=tuple(warnings),
    )


class _Collected:
    """What the recordings hold, sorted by kind."""

    def __init__(self) -> None:
        self.version = "unknown"
        self.is_simulation: bool | None = None
        self.track: list[FloatArray] = []
        self.truth: list[FloatArray] = []
        self.maps: list[BeaconMap] = []
        self.arrivals: list[BeaconArrival] = []
        self.statuses: list[MissionStatus] = []
        self.verdicts: list[DangerEvent] = []
        self.places: dict[str, tuple[float, float]] = {}

    def read(self, path: Path, warnings: list[str]) -> None:
        """One recording, up to its end or its first damage."""
        damages, lost = list[str](), list[str]()
        try:
            metadata = read_metadata(path)
            self.version = metadata.get("ccatp", self.version)
            told = {"true": True, "false": False}.get(metadata.get("simulation", ""))
            self.is_simulation = self.is_simulation if told is None else told
            for topic, _, payload in iter_messages(path, damages.append):
                if topic not in READ:
                    continue
                try:
                    self._take(unpack(topic.encode() + b" " + payload)[2])
                except (BadMessage, ValueError) as error:
                    lost.append(str(error))
        except OSError as error:
            warnings.append(f"{path.name}: cannot be read: {error.strerror or error}")
        warnings += [damage_text(path, text) for text in damages]
        if lost:
            warnings.append(f"{path.name}: {len(lost)} messages cannot be read and are left out: {lost[0]}")

    def _take(self, message: object) -> None:
        if isinstance(message, BeaconTrack):
            self.track.append(table(message.rows, TRACK_COLUMNS))
        elif isinstance(message, BeaconTruth):
            self.truth.append(table(message.rows, TRUTH_COLUMNS))
        elif isinstance(message, BeaconPlaces):
            self.places = message.places
        elif isinstance(message, BeaconMap):
            self.maps.append(message)
        elif isinstance(message, BeaconArrival):
            self.arrivals.append(message)
        elif isinstance(message, MissionStatus):
            self.statuses.append(message)
        elif isinstance(message, DangerEvent):
            self.verdicts.append(message)


def _ordered(batches: Sequence[FloatArray], columns: int) -> FloatArray:
    """One table, the frames growing: a frame that was told twice counts once."""
    rows = np.concatenate(batches) if batches else np.empty((0, columns))
    rows = rows[np.isfinite(rows[:, :5]).all(axis=1)]
    _, first = np.unique(rows[:, 0], return_index=True)
    return np.asarray(rows[first])


def _changed(cfg: RadioConfig) -> dict[str, tuple[object, object]]:
    """Keys other than as shipped with the same system."""
    shipped = load_radio_config(None, {"system": cfg.system})
    return changed_keys(cfg.model_dump(mode="json"), shipped.model_dump(mode="json"))
