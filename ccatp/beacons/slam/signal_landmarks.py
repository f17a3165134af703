"""Radios of ``SignalSlam``: rows of their readings, those that wait for a place, the one that moves, shadowing."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import atan2, cos, exp, hypot, log, log10, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.beacons.slam.motion import POSE
from ccatp.beacons.slam.path_loss import PathLoss
from ccatp.beacons.slam.recording import BeaconEstimate, BeaconId, RssiReading
from ccatp.core import FloatArray, wrap_pi
from ccatp.filters.ekf_slam import Columns, EkfSlam, Update, columns_of

PLACE = 2  # x_m, y_m: the first states of a radio
_NEAREST_M = 0.02  # nearer than that neither level nor bearing has a derivative worth the name
_DB_PER_NEPER = 10.0 / log(10.0)

Linearise = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


class RadioModel(NamedTuple):
    """One reading, and where its states stand."""

    reading: RssiReading
    pose: int
    shadow: FloatArray  # derivatives of the level by the shadowing states, which end the radio's block, shape (k,)
    level_variance: float  # of the level, dB^2


class SignalRows(NamedTuple):
    """Rows of an update."""

    columns: Columns
    linearise: Linearise  # state (n,) to residuals (m,) and derivatives (m, k)
    variances: FloatArray  # of the noise, shape (m,)


def rows_of(sights: Sequence[RadioModel], radio: slice, path_loss: PathLoss, bearing_sigma_rad: float) -> SignalRows:
    """The rows of readings of one radio, taken at one pose or several.

    z = P_ref - 10 eta log10(r) + b,  beta = atan2(dy, dx) - heading (Auth and Hovey 2018, eqs 2.3 and 2.9).
    """
    poses = sorted({sight.pose for sight in sights})
    at = {pose: POSE * i for i, pose in enumerate(poses)}
    columns = columns_of(*(range(pose, pose + POSE) for pose in poses), radio)
    variances: list[float] = []
    for sight in sights:
        variances.append(sight.level_variance)
        if sight.reading.bearing_rad is not None:
            variances.append(bearing_sigma_rad**2)
    first = POSE * len(poses)

    def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        values = x.take(columns)
        residuals, H = np.zeros(len(variances)), np.zeros((len(variances), columns.size))
        row = 0
        for sight in sights:
            pose, shadow = at[sight.pose], sight.shadow
            x_m, y_m, heading = values[pose : pose + POSE].tolist()
            dx, dy = (values[first : first + PLACE] - (x_m, y_m)).tolist()
            r = max(hypot(dx, dy), _NEAREST_M)
            q = r * r
            states = values[values.size - shadow.size :]
            expected = path_loss.reference_dbm - 10.0 * path_loss.exponent * log10(r) + float(shadow @ states)
            residuals[row] = sight.reading.rssi_dbm - expected
            slope = _DB_PER_NEPER * path_loss.exponent / q
            H[row, pose : pose + PLACE] = slope * dx, slope * dy
            H[row, first : first + PLACE] = -slope * dx, -slope * dy
            H[row, H.shape[1] - shadow.size :] = shadow
            row += 1
            if sight.reading.bearing_rad is not None:
                residuals[row] = wrap_pi(sight.reading.bearing_rad - (atan2(dy, dx) - heading))
                H[row, pose : pose + POSE] = dy / q, -dx / q, -1.0
                H[row, first : first + PLACE] = -dy / q, dx / q
                row += 1
        return residuals, H

    return SignalRows(columns, linearise, np.array(variances))


_ITERATIONS = 12
_SETTLED_M = 1e-3
_FARTHEST_STEP_M = 1.0  # a radio that would jump further than it is away passes over the place where the model bends


class PoseKey(NamedTuple):
    """Block of a pose that is kept."""

    number: int


class SignalRecord(NamedTuple):
    """A reading that waits."""

    reading: RssiReading
    pose: PoseKey


class SignalPrior(NamedTuple):
    """Of a radio before its first reading: mean and standard deviations of place and shadowing, shape (b,)."""

    mean: FloatArray
    sigmas: FloatArray


class _Share(NamedTuple):
    """What one radio says of the poses, once it is eliminated: y = H c + noise of covariance S."""

    H: FloatArray  # by the poses, shape (m, p)
    y: FloatArray  # shape (m,)
    root: FloatArray  # lower Cholesky factor of S, shape (m, m)
    gain: FloatArray  # of the radio, by y - H c, shape (b, m)
    covariance: FloatArray  # of the radio for known poses, shape (b, b)


# Records, where their poses begin in a state, where the radio stands in it, to the rows of an update.
RowsAt = Callable[[list[SignalRecord], Callable[[PoseKey], int], slice], SignalRows]


class SignalLandmarkInitializer:
    """Waiting readings of radios, and copies of the poses they belong to.

    A level of unknown shadowing gives the range up to a factor; an update that is linearised there is wrong later, when
    bearings from elsewhere have given the range. So the readings of a new radio wait, with copies of the
    poses in the state, until they place it. Meanwhile their most probable places are found beside the filter, by
    Gauss-Newton on poses and radios together with each radio eliminated in turn, and what that says of the rest of the
    state can be had without changing it.
    """

    def __init__(self, engine: EkfSlam) -> None:
        self._engine = engine
        self.records: dict[BeaconId, list[SignalRecord]] = {}
        self._count = 0
        self._keys: list[PoseKey] = []
        self._poses: FloatArray = np.empty(0)
        self._rows: FloatArray | None = None  # of the poses and, last, y; noise of unit variance
        self.guesses: dict[BeaconId, BeaconEstimate] = {}

    def keep_pose(self) -> PoseKey:
        """Copy the vehicle's pose into the state."""
        self._count += 1
        key = PoseKey(self._count)
        self._engine.augment(key, self._engine.mean[:POSE].copy(), columns_of(range(POSE)), np.eye(POSE))
        return key

    def drop(self, beacon: BeaconId) -> None:
        """Forget what waits of a radio, and the poses that nothing else waits for."""
        self.records.pop(beacon, None)
        self.guesses.pop(beacon, None)
        self._rows = None
        used = {record.pose for records in self.records.values() for record in records}
        for block in self._engine.blocks:
            if isinstance(block, PoseKey) and block not in used:
                self._engine.remove(block)

    def solve(self, priors: Mapping[BeaconId, SignalPrior], rows_at: RowsAt) -> None:
        """Find the most probable places of the radios from all that waits of them."""
        engine = self._engine
        records = [record for beacon in priors for record in self.records[beacon]]
        self._keys = sorted({record.pose for record in records})
        columns = columns_of(*(engine.block(key) for key in self._keys))
        c, P = engine.mean.take(columns), engine.covariance[np.ix_(columns, columns)]
        place = {key: POSE * i for i, key in enumerate(self._keys)}
        rows = {
            beacon: rows_at(self.records[beacon], place.__getitem__, slice(c.size, c.size + prior.mean.size))
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
        self._poses, self._rows = poses, stack
        if stack.shape[0] > stack.shape[1]:
            self._rows = np.asarray(np.linalg.qr(stack, mode="r"), dtype=np.float64)
        for beacon, share in shares.items():
            carried = share.gain @ share.H
            spread = share.covariance + carried @ covariance @ carried.T
            self.guesses[beacon] = BeaconEstimate(means[beacon], 0.5 * (spread + spread.T))

    def linearisation(self, beacon: BeaconId) -> FloatArray:
        """The whole state, the poses that are kept where the guesses have them, and a radio of the state likewise.

        Raises BlockError: the radio is not in the state.
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


def _eliminated(rows: SignalRows, poses: FloatArray, mean: FloatArray, prior: SignalPrior) -> _Share:
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
    means: dict[BeaconId, FloatArray], shares: Mapping[BeaconId, _Share], priors: Mapping[BeaconId, SignalPrior],
    poses: FloatArray,
) -> float:  # fmt: skip
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


def _conditioned(c: FloatArray, P: FloatArray, stack: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses and their covariance after y = H c + noise of unit variance."""
    H, y = stack[:, :-1], stack[:, -1]
    cross = P @ H.T
    gain = np.linalg.solve(H @ cross + np.eye(len(y)), cross.T).T
    return np.asarray(c + gain @ (y - H @ c)), np.asarray(P - gain @ cross.T)


_TYPICAL = 0.4  # mean distance of two places in a square over its diagonal: 0.521 / sqrt(2)
_STATES = 4  # x_m, y_m, and the velocity


@dataclass(frozen=True, slots=True)
class MovingRadio:
    """A point whose velocity is a stationary process: v has the spread s by axis and forgets it over a time T.

    Over t, with a = exp(-t / T): v <- a v, p <- p + T (1 - a) v, and

        var(v) += s^2 (1 - a^2),  cov(p, v) += s^2 T (1 - a)^2,  var(p) += s^2 T (2 t - T (1 - a) (3 - a))

    (Singer 1970 with the velocity in place of the acceleration). Shadowing at both ends decorrelates with the ways of
    both: b <- c b with c = exp(-(d_vehicle + d_radio) / L), d_radio = sqrt(2) s t, and var(b) += sigma^2 (1 - c^2).
    """

    beacon: BeaconId
    speed_sigma_m_s: float  # s
    course_time_s: float  # T
    shadowing_sigma_db: float  # sigma; 0: no such state
    shadowing_length_m: float
    room_m: tuple[float, float]  # lengths of its walls; it never leaves the room

    def join(self, engine: EkfSlam, bearing_rad: float) -> None:
        """Begin in the direction of a first bearing, anywhere in the room; the reading itself is to follow.

        In polar coordinates about the vehicle: the direction is spread over the circle, and the distance as between
        two places in the room, by a factor of two about 0.4 of its diagonal.
        """
        direction, log_range = float(engine.mean[2]) + bearing_rad, log(_TYPICAL * hypot(*self.room_m))
        behind = [self.speed_sigma_m_s] * 2
        if self.shadowing_sigma_db > 0.0:
            behind.append(self.shadowing_sigma_db)
        spread = np.array([pi, log(2.0), *behind])
        mean = np.zeros(spread.size)
        mean[:PLACE] = direction, log_range
        none: Columns = np.empty(0, dtype=np.intp)
        engine.augment(self.beacon, mean, none, np.zeros((mean.size, 0)), np.eye(mean.size), np.diag(spread**2))
        self._to_plane(engine)

    def update(
        self, engine: EkfSlam, reading: RssiReading, path_loss: PathLoss, bearing_sigma_rad: float,
        gates: Sequence[float],
    ) -> Update:  # fmt: skip
        """Condition on a reading, in polar coordinates about the vehicle.

        There level and bearing are linear: z = P_ref - (10 eta / ln 10) ln r + b, beta = direction - heading. In the
        plane a level has another slope at each estimate, and many levels with one unknown b would seem to give the
        range (modified polar coordinates, Aidala and Hammel 1983).
        """
        self._to_polar(engine)
        block = engine.block(self.beacon)
        slope = 10.0 * path_loss.exponent / log(10.0)
        columns = columns_of((2,), block)
        x = engine.mean.take(columns)
        H = np.zeros((1 if reading.bearing_rad is None else 2, columns.size))
        H[0, 2], H[0, 1 + _STATES :] = -slope, 1.0  # the shadowing state, if there is one
        residual = np.array([reading.rssi_dbm - path_loss.reference_dbm - float(H[0] @ x)])
        variances = [path_loss.sigma_db**2]
        if reading.bearing_rad is not None:
            H[1, 0], H[1, 1] = -1.0, 1.0
            residual = np.append(residual, wrap_pi(reading.bearing_rad - float(x[1] - x[0])))
            variances.append(bearing_sigma_rad**2)
        found = engine.update(columns, H, residual, np.array(variances), gates[len(variances) - 1])
        self._to_plane(engine)
        return found

    def _to_polar(self, engine: EkfSlam) -> None:
        start = engine.block(self.beacon).start
        dx, dy = (engine.mean[start : start + PLACE] - engine.mean[:PLACE]).tolist()
        r = max(hypot(dx, dy), _NEAREST_M)
        J = np.array(((-dy, dx), (dx, dy))) / (r * r)
        _transformed(engine, start, J, -J, (atan2(dy, dx), log(r)))

    def _to_plane(self, engine: EkfSlam) -> None:
        start = engine.block(self.beacon).start
        direction, log_range = engine.mean[start : start + PLACE].tolist()
        dx, dy = exp(log_range) * cos(direction), exp(log_range) * sin(direction)
        x, y = engine.mean[:PLACE].tolist()
        _transformed(engine, start, np.array(((-dy, dx), (dx, dy))), np.eye(PLACE), (x + dx, y + dy))

    def predict(self, engine: EkfSlam, interval_s: float, travel_m: float) -> None:
        """Carry the radio's block on over an interval in which the vehicle travelled so far."""
        block = engine.block(self.beacon)
        s2, T = self.speed_sigma_m_s**2, self.course_time_s
        a = exp(-interval_s / T)
        size = block.stop - block.start
        F, Q = np.eye(size), np.zeros((size, size))
        for p, v in ((0, 2), (1, 3)):
            F[p, v], F[v, v] = T * (1.0 - a), a
            Q[v, v] = s2 * (1.0 - a * a)
            Q[p, v] = Q[v, p] = s2 * T * (1.0 - a) ** 2
            Q[p, p] = s2 * T * (2.0 * interval_s - T * (1.0 - a) * (3.0 - a))
        if size > _STATES:
            way_m = travel_m + sqrt(2.0) * self.speed_sigma_m_s * interval_s
            c = exp(-way_m / self.shadowing_length_m)
            F[_STATES, _STATES] = c
            Q[_STATES, _STATES] = self.shadowing_sigma_db**2 * (1.0 - c * c)
        P, x = engine.covariance, engine.mean
        x[block] = F @ x[block]
        P[block] = F @ P[block]
        P[:, block] = P[:, block] @ F.T
        P[block, block] += Q


def _transformed(
    engine: EkfSlam, start: int, by_place: FloatArray, by_vehicle: FloatArray, place: tuple[float, float]
) -> None:
    P, rows = engine.covariance, slice(start, start + PLACE)
    P[rows] = by_place @ P[rows] + by_vehicle @ P[:PLACE]
    P[:, rows] = P[:, rows] @ by_place.T + P[:, :PLACE] @ by_vehicle.T
    engine.mean[rows] = place


class ShadowingMap:
    """Kriging of a Gaussian field with covariance sigma^2 exp(-d / L) (Gudmundson 1991) from its values at grid points.

    The field at a place is k^T C^-1 f + rest, with f the values at the points, C their covariance, k the covariances
    between place and points; the rest has the variance sigma^2 - k^T C^-1 k and counts as white. The states are w =
    R^-1 f with C = R R^T, so that a prior of them is the identity, and the row of a place is k^T R^-T. ``spacing_m``:
    between grid points; the outermost lie on the walls. ``sigma_db``: sigma.
    """

    def __init__(self, size_m: tuple[float, float], spacing_m: float, sigma_db: float, length_m: float) -> None:
        axes = [np.linspace(0.0, size, max(2, round(size / spacing_m) + 1)) for size in size_m]
        grid = np.meshgrid(*axes, indexing="ij")
        self._points = np.column_stack([axis.ravel() for axis in grid])
        self._variance = sigma_db**2
        self._length_m = length_m
        offsets = self._points[:, None] - self._points[None, :]
        root = np.linalg.cholesky(self._covariance(np.hypot(offsets[..., 0], offsets[..., 1])))
        self._inverse_root: FloatArray = np.linalg.solve(root, np.eye(len(root)))

    @property
    def size(self) -> int:
        """How many states it takes."""
        return len(self._points)

    def row(self, x_m: float, y_m: float) -> tuple[FloatArray, float]:
        """Derivatives of the field at a place by the states, shape (size,), and the variance of the rest, dB^2."""
        distances = np.hypot(self._points[:, 0] - x_m, self._points[:, 1] - y_m)
        row = self._inverse_root @ self._covariance(distances)
        return row, max(self._variance - float(row @ row), 0.0)

    def _covariance(self, distance_m: FloatArray) -> FloatArray:
        return np.asarray(self._variance * np.exp(-distance_m / self._length_m))
