"""Pure. Static radios that are not on the map yet: their readings wait, with the poses they were taken at."""

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import Columns, EkfSlam, columns_of
from ccatp.radio.motion import POSE
from ccatp.radio.readings import BeaconId, RssiReading
from ccatp.radio.signal_rows import Rows

_ITERATIONS = 12
_SETTLED_M = 1e-3
_FARTHEST_STEP_M = 1.0  # a radio that would jump further than it is away passes over the place where the model bends


class PoseKey(NamedTuple):
    """Block of a pose that is kept."""

    number: int


class Record(NamedTuple):
    """A reading that waits."""

    reading: RssiReading
    pose: PoseKey


class Prior(NamedTuple):
    """Of a radio before its first reading: mean and standard deviations of place and shadowing, shape (b,)."""

    mean: FloatArray
    sigmas: FloatArray


class Guess(NamedTuple):
    """What the waiting readings say of a radio: mean (b,) and covariance (b, b)."""

    mean: FloatArray
    covariance: FloatArray


class _Share(NamedTuple):
    """What one radio says of the poses, once it is eliminated: y = H c + noise of covariance S.

    Attributes:
        H: by the poses, shape (m, p).
        y: shape (m,).
        root: lower Cholesky factor of S, shape (m, m).
        gain: of the radio, by y - H c, shape (b, m).
        covariance: of the radio for known poses, shape (b, b).
    """

    H: FloatArray
    y: FloatArray
    root: FloatArray
    gain: FloatArray
    covariance: FloatArray


RowsAt = Callable[[list[Record], Callable[[PoseKey], int], slice], Rows]
"""Records, where their poses begin in a state, where the radio stands in it, to the rows of an update."""


class Newcomers:
    """Waiting readings of radios, and copies of the poses they belong to.

    A level of which the shadowing is unknown tells the range to a factor; an update that is linearised there is wrong
    later, when bearings from elsewhere have told the range. So the readings of a new radio wait, with copies of the
    poses in the state, until they place it. Meanwhile their most probable places are found beside the filter, by
    Gauss-Newton on poses and radios together with each radio eliminated in turn, and what that says of the rest of the
    state can be had without changing it.

    Attributes:
        guesses: the radios that wait, by name.

    Args:
        engine: the filter that holds the poses.
    """

    def __init__(self, engine: EkfSlam) -> None:
        self._engine = engine
        self._records: dict[BeaconId, list[Record]] = {}
        self._count = 0
        self._keys: list[PoseKey] = []
        self._poses: FloatArray = np.empty(0)
        self._rows: FloatArray | None = None  # of the poses and, last, y; noise of unit variance
        self.guesses: dict[BeaconId, Guess] = {}

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
        self._engine.augment(key, self._engine.mean[:POSE].copy(), columns_of(range(POSE)), np.eye(POSE))
        return key

    def add(self, reading: RssiReading, pose: PoseKey) -> None:
        """A reading begins to wait."""
        self._records.setdefault(reading.beacon, []).append(Record(reading, pose))

    def drop(self, beacon: BeaconId) -> None:
        """Forget what waits of a radio, and the poses that nothing else waits for."""
        self._records.pop(beacon, None)
        self.guesses.pop(beacon, None)
        self._rows = None
        used = {record.pose for records in self._records.values() for record in records}
        for block in self._engine.blocks:
            if isinstance(block, PoseKey) and block not in used:
                self._engine.remove(block)

    def solve(self, priors: Mapping[BeaconId, Prior], rows_at: RowsAt) -> None:
        """Find the most probable places of the radios from all that waits of them.

        Args:
            priors: of the radios to place.
            rows_at: makes the rows of an update.
        """
        engine = self._engine
        records = [record for beacon in priors for record in self._records[beacon]]
        self._keys = sorted({record.pose for record in records})
        columns = columns_of(*(engine.block(key) for key in self._keys))
        c, P = engine.mean.take(columns), engine.covariance[np.ix_(columns, columns)]
        place = {key: POSE * i for i, key in enumerate(self._keys)}
        rows = {
            beacon: rows_at(self._records[beacon], place.__getitem__, slice(c.size, c.size + prior.mean.size))
            for beacon, prior in priors.items()
        }
        means = {b: self.guesses[b].mean if b in self.guesses else prior.mean for b, prior in priors.items()}
        poses = c
        for _ in range(_ITERATIONS - 1):
            shares = {b: _eliminated(rows[b], poses, means[b], prior) for b, prior in priors.items()}
            poses, _ = _conditioned(c, P, _stacked(shares.values()))
            if _advance(means, shares, priors, poses) < _SETTLED_M:
                break
        shares = {b: _eliminated(rows[b], poses, means[b], prior) for b, prior in priors.items()}
        stack = _stacked(shares.values())
        poses, covariance = _conditioned(c, P, stack)
        _advance(means, shares, priors, poses)
        self._poses, self._rows = poses, _compressed(stack)
        for beacon, share in shares.items():
            carried = share.gain @ share.H
            spread = share.covariance + carried @ covariance @ carried.T
            self.guesses[beacon] = Guess(means[beacon], 0.5 * (spread + spread.T))

    def linearisation(self, beacon: BeaconId) -> FloatArray:
        """The whole state, the poses that are kept where the guesses have them, and a radio of the state likewise.

        Raises:
            BlockError: the radio is not in the state.
        """
        x = self._engine.mean.copy()
        for i, key in enumerate(self._keys):
            x[self._engine.block(key)] = self._poses[POSE * i : POSE * (i + 1)]
        x[self._engine.block(beacon)] = self.guesses[beacon].mean
        return x

    def conditioned(self, columns: Columns) -> tuple[FloatArray, FloatArray]:
        """Mean (k,) and covariance (k, k) of some states, given all that waits; the filter does not change."""
        engine = self._engine
        x, P = engine.mean.take(columns), engine.covariance[np.ix_(columns, columns)]
        if self._rows is None:
            return x, P
        poses = columns_of(*(engine.block(key) for key in self._keys))
        H, y = self._rows[:, :-1], self._rows[:, -1]
        cross = engine.covariance[np.ix_(columns, poses)] @ H.T
        S = H @ engine.covariance[np.ix_(poses, poses)] @ H.T + np.eye(len(y))
        gain = np.linalg.solve(S, cross.T).T
        P = P - gain @ cross.T
        return x + gain @ (y - H @ engine.mean.take(poses)), 0.5 * (P + P.T)


def _eliminated(rows: Rows, poses: FloatArray, mean: FloatArray, prior: Prior) -> _Share:
    """The rows of one radio, linearised at poses and a place, with the radio taken out by its prior."""
    p = poses.size
    x = np.concatenate([poses, mean])
    residual, sparse = rows.linearise(x)
    full = np.zeros((residual.size, x.size))
    full[:, rows.columns] = sparse
    H, G = full[:, :p], full[:, p:]
    variances = prior.sigmas**2
    S = (G * variances) @ G.T + np.diag(rows.variances)
    root = np.linalg.cholesky(S)
    gain = np.linalg.solve(S, G * variances).T
    y = residual + H @ poses + G @ (mean - prior.mean)
    covariance = np.diag(variances) - gain @ (G * variances)
    return _Share(H, y, np.asarray(root), np.asarray(gain), covariance)


def _advance(
    means: dict[BeaconId, FloatArray], shares: Mapping[BeaconId, _Share], priors: Mapping[BeaconId, Prior],
    poses: FloatArray,
) -> float:  # fmt: skip
    """Move the radios to where they are most probable for the poses; the longest of their ways, m."""
    farthest_m = 0.0
    for beacon, share in shares.items():
        step = priors[beacon].mean + share.gain @ (share.y - share.H @ poses) - means[beacon]
        way_m = float(np.hypot(step[0], step[1]))
        means[beacon] = means[beacon] + step * min(1.0, _FARTHEST_STEP_M / max(way_m, 1e-9))
        farthest_m = max(farthest_m, way_m)
    return farthest_m


def _stacked(shares: Iterable[_Share]) -> FloatArray:
    """H and, last, y of all radios with noise of unit variance, shape (m, p + 1)."""
    parts = [np.linalg.solve(share.root, np.column_stack([share.H, share.y])) for share in shares]
    return np.asarray(np.vstack(parts), dtype=np.float64)


def _compressed(stack: FloatArray) -> FloatArray:
    """No more rows than columns that say the same."""
    if stack.shape[0] <= stack.shape[1]:
        return stack
    return np.asarray(np.linalg.qr(stack, mode="r"), dtype=np.float64)


def _conditioned(c: FloatArray, P: FloatArray, stack: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses and their covariance after y = H c + noise of unit variance."""
    H, y = stack[:, :-1], stack[:, -1]
    cross = P @ H.T
    gain = np.linalg.solve(H @ cross + np.eye(len(y)), cross.T).T
    return np.asarray(c + gain @ (y - H @ c)), np.asarray(P - gain @ cross.T)
