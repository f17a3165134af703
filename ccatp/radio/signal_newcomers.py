"""Pure. Static radios that are not on the map yet: their readings wait, with the poses they were taken at."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import Columns, EkfSlam, columns_of
from ccatp.radio.motion import POSE
from ccatp.radio.readings import BeaconId, RssiReading
from ccatp.radio.signal_rows import PLACE, Rows

_ITERATIONS = 20
_SETTLED_M = 1e-3


class PoseKey(NamedTuple):
    """Block of a pose that is kept."""

    number: int


class Record(NamedTuple):
    """A reading that waits."""

    reading: RssiReading
    pose: PoseKey


class Guess(NamedTuple):
    """What the waiting readings say of a radio.

    Attributes:
        mean: place and shadowing states, shape (b,).
        covariance: shape (b, b).
        poses: where the kept poses stand in the state, shape (p,).
        poses_mean: what the readings make of them, shape (p,).
    """

    mean: FloatArray
    covariance: FloatArray
    poses: Columns
    poses_mean: FloatArray


RowsAt = Callable[[list[Record], Callable[[PoseKey], int], slice], Rows]
"""Records, where their poses begin in a state, where the radio stands in it, to the rows of an update."""


class Newcomers:
    """Waiting readings of radios, and copies of the poses they belong to.

    A level of which the shadowing is unknown tells the range to a factor; an update that is linearised there is wrong
    later, when bearings from elsewhere have told the range. So the readings of a new radio wait, with copies of the
    poses in the state, and are used together when they place it.

    Args:
        engine: the filter that holds the poses.
    """

    def __init__(self, engine: EkfSlam) -> None:
        self._engine = engine
        self._records: dict[BeaconId, list[Record]] = {}
        self._count = 0

    @property
    def names(self) -> list[BeaconId]:
        """Radios that wait."""
        return list(self._records)

    def records(self, beacon: BeaconId) -> list[Record]:
        """What waits of a radio."""
        return self._records.get(beacon, [])

    def keep_pose(self) -> PoseKey:
        """Copy the vehicle's pose into the state."""
        self._count += 1
        key = PoseKey(self._count)
        columns = columns_of(range(POSE))
        self._engine.augment(key, self._engine.mean[:POSE].copy(), columns, np.eye(POSE))
        return key

    def add(self, reading: RssiReading, pose: PoseKey) -> None:
        """A reading begins to wait."""
        self._records.setdefault(reading.beacon, []).append(Record(reading, pose))

    def drop(self, beacon: BeaconId) -> None:
        """Forget what waits of a radio, and the poses that nothing else waits for."""
        self._records.pop(beacon, None)
        used = {record.pose for records in self._records.values() for record in records}
        for block in self._engine.blocks:
            if isinstance(block, PoseKey) and block not in used:
                self._engine.remove(block)

    def guess(self, beacon: BeaconId, start: FloatArray, spread: FloatArray, rows_at: RowsAt) -> Guess:
        """Most probable place from all that waits, beside the filter, which does not change.

        Gauss-Newton on the poses (with their prior out of the filter) and the radio (with a prior of its own).

        Args:
            beacon: which radio.
            start: mean of its prior, shape (b,).
            spread: standard deviations of its prior, shape (b,).
            rows_at: makes the rows.
        """
        records = self._records[beacon]
        keys = list(dict.fromkeys(record.pose for record in records))
        columns = columns_of(*(self._engine.block(key) for key in keys))
        size = columns.size + start.size
        prior = np.concatenate([self._engine.mean.take(columns), start])
        P = np.zeros((size, size))
        P[: columns.size, : columns.size] = self._engine.covariance[np.ix_(columns, columns)]
        P[range(columns.size, size), range(columns.size, size)] = spread**2
        place = {key: POSE * i for i, key in enumerate(keys)}
        rows = rows_at(records, place.__getitem__, slice(columns.size, size))
        x = prior
        for _ in range(_ITERATIONS):
            residual, sparse = rows.linearise(x)
            H = np.zeros((residual.size, size))
            H[:, rows.columns] = sparse
            cross = P @ H.T
            S = H @ cross + np.diag(rows.variances)
            new = prior + cross @ np.linalg.solve(S, residual + H @ (x - prior))
            step = new - x
            # A radio that would jump further than it is away passes over the place where the model bends.
            moved_m = float(np.hypot(*step[columns.size : columns.size + PLACE]))
            x = x + step * min(1.0, 1.0 / max(moved_m, 1e-9))
            if moved_m < _SETTLED_M:
                break
        posterior = P - cross @ np.linalg.solve(S, cross.T)
        radio = slice(columns.size, size)
        own = posterior[radio, radio]
        return Guess(x[radio], 0.5 * (own + own.T), columns, x[: columns.size])
