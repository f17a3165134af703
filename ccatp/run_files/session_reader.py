"""Edge. One recording of a run, as a report needs it: poses, truth, arrivals, fixes and what main said of the mission.

The raw samples of the sensors, nine tenths of a recording, are not looked at.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ccatp.mirror.batches import deck_rows
from ccatp.mirror.errors import MirrorError
from ccatp.mirror.mirror import Mirror
from ccatp.reporting.record import Arrived, FloatArray, Session, Track, Truth
from ccatp.run_files.recorder import iter_messages, read_metadata
from ccatp.run_files.state_log import StateChange
from ccatp.run_files.writing import damage_text
from ccatp.samples import PointId
from ccatp.wire.topics import Arrival, BadMessage, DangerEvent, FixMessage, Message, MissionStatus, unpack
from ccatp.wire.topics import Track as TrackMessage
from ccatp.wire.topics import Truth as TruthMessage

READ = frozenset(("track", "truth", "arrival", "fix", "mission", "danger_event"))
_TRACK_COLUMNS, _TRUTH_COLUMNS = 8, 11


class _Collected:
    """What a recording holds, sorted by kind."""

    def __init__(self) -> None:
        self.track: list[FloatArray] = []
        self.truth: list[FloatArray] = []
        self.arrivals: list[Arrived] = []
        self.fixes: list[FixMessage] = []
        self.statuses: list[MissionStatus] = []
        self.verdicts: list[DangerEvent] = []

    def take(self, message: object) -> None:
        """Put one message where it belongs."""
        if isinstance(message, TrackMessage):
            self.track.append(np.array(message.rows, dtype=np.float64).reshape(-1, _TRACK_COLUMNS))
        elif isinstance(message, TruthMessage):
            self.truth.append(np.array(message.rows, dtype=np.float64).reshape(-1, _TRUTH_COLUMNS))
        elif isinstance(message, Arrival):
            self.arrivals.append(Arrived(PointId(*message.point), message.seq, message.t_s, message.error_mm))
        elif isinstance(message, FixMessage):
            self.fixes.append(message)
        elif isinstance(message, MissionStatus):
            self.statuses.append(message)
        elif isinstance(message, DangerEvent):
            self.verdicts.append(message)


def read_session(path: Path, mirror: Mirror, changes: Sequence[StateChange], warnings: list[str]) -> Session:
    """Read a recording up to its end or its first damage.

    Args:
        path: the file.
        mirror: to bring panel frames together.
        changes: of the mission's state in this session, from the log.
        warnings: takes a line for each damage.

    Raises:
        OSError: it cannot be read at all.
    """
    found, damages, lost = _Collected(), list[str](), list[str]()
    metadata = read_metadata(path)
    for topic, _, payload in iter_messages(path, damages.append):
        if topic not in READ:
            continue
        try:
            message: Message | object = unpack(topic.encode() + b" " + payload)[2]
            found.take(message)
        except (BadMessage, ValueError) as error:
            lost.append(str(error))
    warnings += [damage_text(path, damage) for damage in damages]
    if lost:
        warnings.append(f"{path.name}: {len(lost)} messages cannot be read and are left out: {lost[0]}")
    return Session(
        name=path.name,
        version=metadata.get("ccatp", "unknown"),
        track=_track(found.track, mirror, path.name, warnings),
        truth=_truth(found.truth),
        arrivals=tuple(found.arrivals),
        fixes=tuple(found.fixes),
        statuses=tuple(found.statuses),
        verdicts=tuple(found.verdicts),
        changes=tuple(changes),
    )


def _track(batches: Sequence[FloatArray], mirror: Mirror, name: str, warnings: list[str]) -> Track:
    rows = _ordered(batches, _TRACK_COLUMNS)
    try:
        deck = deck_rows(mirror, rows[:, 2:4].astype(np.int64), rows[:, 4:7])
    except MirrorError as error:
        warnings.append(f"{name}: its estimates are not of this mirror and are left out: {error}")
        rows, deck = rows[:0], np.empty((0, 4))
    return Track(rows[:, 0].astype(np.int64), rows[:, 1], deck[:, [0, 1, 3]], deck[:, 2], rows[:, 7])


def _truth(batches: Sequence[FloatArray]) -> Truth | None:
    if not batches:
        return None
    rows = _ordered(batches, _TRUTH_COLUMNS)
    return Truth(rows[:, 0].astype(np.int64), rows[:, 1], rows[:, 5:8], rows[:, 4], rows[:, 8])


def _ordered(batches: Sequence[FloatArray], columns: int) -> FloatArray:
    """One table, the frames growing: a frame that was told twice counts once."""
    rows = np.concatenate(batches) if batches else np.empty((0, columns))
    rows = rows[np.isfinite(rows).all(axis=1)]
    _, first = np.unique(rows[:, 0], return_index=True)
    return np.asarray(rows[first])
