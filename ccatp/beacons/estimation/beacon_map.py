"""Beacons as blocks of the filter's state, wandering errors, learned noise levels, and the transport of the heading."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import exp

import numpy as np
from scipy.linalg.blas import daxpy

from ccatp.beacons.estimation.recording import BeaconId, Radio
from ccatp.beacons.filters.ekf_slam import Columns, EkfSlam, columns_of
from ccatp.core import FloatArray


class NoiseLevel:
    """A factor f on the variance r of a noise, estimated recursively by maximum likelihood (Fisher scoring).

    An innovation of variance S, of which the share a = f r / S is this noise, has the log-likelihood -(ln S + nu^2 / S)
    / 2: its derivative by ln f is a (nis - 1) / 2, its Fisher information a^2 / 2. So J <- J + a^2, ln f <- ln f + a
    (nis - 1) / J. ``prior``: initial J, the weight of the initial value as a number of innovations. ``memory``: largest
    J, so that old innovations fade; 0: the factor stays one. ``least``: smallest factor.
    """

    def __init__(self, prior: float, memory: float, least: float) -> None:
        self.factor, self._least = 1.0, least
        self._information, self._memory = prior, memory

    def learn(self, nis: float, share: float) -> None:
        """Update the factor by an innovation: its normalised square, and the share of this noise in its variance."""
        if self._memory <= 0.0:
            return
        information = self._information + share * share
        self._information = information = min(self._memory, information)
        change = share * (nis - 1.0) / information
        if not -LARGEST < change < LARGEST:
            change = LARGEST if change > 0.0 else -LARGEST
        factor = self.factor * exp(change)
        if not self._least <= factor <= FURTHEST:
            factor = self._least if factor < self._least else FURTHEST
        self.factor = factor


LARGEST = 0.3  # largest change of the factor's logarithm by one innovation
# Largest factor, and one over the least one: a sensor with ten times the configured sigma cannot be trusted.
FURTHEST = 100.0


class AddedPoseNoise:
    """Pose covariance N that the motion noise has added since the last reading: N <- F N F^T + Q, N symmetric.

    F is the identity except for the derivatives by the heading. N is kept as six numbers, because NumPy takes longer
    for so small an array.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Set N to zero, after a reading."""
        self._xx = self._xy = self._xt = self._yy = self._yt = self._tt = 0.0

    def step(self, F: FloatArray, Q: FloatArray) -> None:
        """Propagate N by a prediction with Jacobian and noise of the vehicle's states, both (v, v), the pose first."""
        f, g, tt = F.item(0, 2), F.item(1, 2), self._tt
        xt, yt = self._xt + f * tt, self._yt + g * tt
        self._xx += f * (self._xt + xt) + Q.item(0, 0)
        self._xy += g * self._xt + f * yt + Q.item(0, 1)
        self._yy += g * (self._yt + yt) + Q.item(1, 1)
        self._xt, self._yt, self._tt = xt + Q.item(0, 2), yt + Q.item(1, 2), tt + Q.item(2, 2)

    def seen(self, hx: float, hy: float, ht: float) -> float:
        """H N H^T of a measurement row with these derivatives by the pose."""
        across = hx * (hx * self._xx + 2.0 * (hy * self._xy + ht * self._xt))
        return across + hy * (hy * self._yy + 2.0 * ht * self._yt) + ht * ht * self._tt


@dataclass(frozen=True, slots=True)
class GaussMarkovBias:
    """An error of a beacon's readings that persists while the vehicle rests: multipath, shadowing, a tilted camera.

    An independent Gauss-Markov process for each beacon: correlation exp(-distance / length_m - time / time_s).
    """

    share: float  # share of the noise variance; the rest is white
    length_m: float  # correlation length along the vehicle's path
    time_s: float  # correlation time


@dataclass(frozen=True, slots=True)
class LearnedNoise:
    """Noise of a beacon's ranges: factor on the configured variance, and the part of it that lasts."""

    variance: float
    bias: GaussMarkovBias


_NONE = np.empty(0, dtype=np.intp)
WANDER = "wander"  # first part of the name of a block that holds a wandering error


@dataclass(slots=True)
class RadioErrors:
    """Errors of a beacon's readings by one radio.

    ``way_m``, ``time_s``: distance travelled and time of the wandering error's last update.
    """

    columns: Columns  # the columns shared by all beacons, then the beacon and its wandering error, shape (k,)
    wander: int = -1  # column of the wandering error; -1: none
    way_m: float = 0.0
    time_s: float = 0.0
    fresh: float = 1.0  # variance of the new part of the wandering error, in sigmas squared
    noise: LearnedNoise | None = None  # of the ranges; None: that of the settings, with the level of all beacons


@dataclass(slots=True)
class MapEntry:
    """A beacon on the map."""

    size: int
    columns: Columns = field(default_factory=lambda: _NONE)  # shared by all beacons, then the beacon, shape (k,)
    radios: dict[Radio | None, RadioErrors] = field(default_factory=dict)
    refused: int = 0  # readings refused in a row
    on_trial: int = 0  # number of readings that must still agree with the first one; 0: the trial is over
    walked_s: float = 0.0  # time to which the place of a beacon that moves was predicted
    used_s: float = 0.0  # time of the last reading that was used

    def heard_by(self, radio: Radio | None) -> RadioErrors:
        """The errors of the readings of a radio."""
        if radio not in self.radios:
            self.radios[radio] = RadioErrors(self.columns)
        return self.radios[radio]


class BeaconMap(dict[BeaconId, MapEntry]):
    """The beacons' blocks of an ``EkfSlam``; ``shared``: columns on which the readings of all beacons depend."""

    def __init__(self, engine: EkfSlam, shared: Sequence[int]) -> None:
        super().__init__()
        self._engine, self._shared = engine, shared

    def join(self, beacon: BeaconId, mean: FloatArray, covariance: FloatArray) -> MapEntry:
        """Add a beacon that is not correlated with the rest of the state: mean (b,), covariance (b, b)."""
        self._append(beacon, mean, covariance)
        self[beacon] = MapEntry(mean.size)
        self.renumber()
        return self[beacon]

    def leave(self, beacon: BeaconId) -> None:
        """Remove a beacon. Raises BlockError: it is not on the map."""
        wanders = [(WANDER, beacon, radio) for radio, heard in self[beacon].radios.items() if heard.wander >= 0]
        self._engine.remove(beacon, *wanders)
        del self[beacon]
        self.renumber()

    def renumber(self) -> None:
        """Update the columns of all entries, after a block was added or removed."""
        engine = self._engine
        for beacon, entry in self.items():
            place = engine.block(beacon)
            entry.columns = columns_of(self._shared, place)
            for radio, heard in entry.radios.items():
                heard.columns = entry.columns
                if (WANDER, beacon, radio) in engine:
                    wander = engine.block((WANDER, beacon, radio))
                    heard.wander, heard.columns = wander.start, columns_of(self._shared, place, wander)

    def wander_to(
        self, beacon: BeaconId, radio: Radio | None, model: GaussMarkovBias, way_m: float, time_s: float
    ) -> None:
        """Predict the wandering error of a beacon's readings by a radio, in sigmas.

        w <- phi w, variance <- phi^2 variance + 1 - phi^2.
        """
        heard = self[beacon].heard_by(radio)
        if heard.wander < 0:
            self._append((WANDER, beacon, radio), np.zeros(1), np.eye(1))
            self.renumber()
        else:
            phi = exp(-(way_m - heard.way_m) / model.length_m - max(time_s - heard.time_s, 0.0) / model.time_s)
            heard.fresh = 1.0 - phi * phi
            self._engine.relax(heard.wander, phi, heard.fresh)
        heard.way_m, heard.time_s = way_m, time_s

    def walk_to(self, beacon: BeaconId, walk_m2_s: float, time_s: float) -> None:
        """Predict the place of a beacon that moves: a random walk whose variance grows by ``walk_m2_s``."""
        entry, place = self[beacon], self._engine.block(beacon).start
        added = walk_m2_s * max(time_s - entry.walked_s, 0.0)
        for column in (place, place + 1):
            self._engine.relax(column, 1.0, added)
        entry.walked_s = max(time_s, entry.walked_s)

    def _append(self, block: object, mean: FloatArray, covariance: FloatArray) -> None:
        b = mean.size
        self._engine.augment(block, mean, _NONE, np.zeros((b, 0)), np.eye(b), covariance)


HEADING = 2


class HeadingTransport:
    """After a correction, P <- M P M^T with M = I + d e^T, e the heading and d = J (new - old) of every place.

    A rotation of vehicle and map about any point changes no reading, so the rotation of the whole map is not
    observable. In the state it is the direction (J p of each place p, 1 of the heading), J a quarter turn. Derivatives
    are taken at the estimate, so this direction changes with each correction; with an unchanged P the filter would gain
    false information about the rotation. The covariance of errors that rotate with the heading does not have to change
    (invariant EKF: Barrau and Bonnabel 2015; Zhang et al. 2017). P is that covariance, expressed for errors of x and y.
    """

    def __init__(self, engine: EkfSlam) -> None:
        self._engine = engine
        self._seen: FloatArray | None = None
        self._partner = np.empty(0, dtype=np.intp)
        self._sign = np.empty(0)

    def follow(self, before: FloatArray) -> None:
        """Transform P after a correction.

        ``before``: mean before the correction, shape (n,), or shorter if blocks were added since; it is overwritten. If
        the state has become shorter since, nothing is done.
        """
        engine = self._engine
        mean, P, heading = engine.mean, engine.covariance, engine.covariance[HEADING]
        if P is not self._seen:
            self._look(P)
        if before.size > mean.size:
            return
        if before.size < mean.size:
            before = np.concatenate((before, mean[before.size :]))
        daxpy(mean, before, mean.size, -1.0)
        d = before[self._partner]
        d *= self._sign
        # With w = P e + d e^T P e / 2, d w^T + w d^T as a difference of squares: P stays symmetric exactly.
        half = 0.5 * heading.item(HEADING)
        more, less = heading.copy(), heading.copy()
        daxpy(d, more, d.size, half + 1.0)
        daxpy(d, less, d.size, half - 1.0)
        engine.add_square(0.5, more)
        engine.add_square(-0.5, less)

    def _look(self, P: FloatArray) -> None:
        engine = self._engine
        self._seen = P
        # All blocks but those of wandering errors begin with x_m and y_m.
        places = [block for block in engine.blocks if not (isinstance(block, tuple) and block[0] == WANDER)]
        x = np.array([0, *(engine.block(block).start for block in places)])
        self._partner, self._sign = np.zeros(engine.size, dtype=np.intp), np.zeros(engine.size)
        self._partner[x], self._sign[x] = x + 1, 1.0  # because ``before`` holds old - new
        self._partner[x + 1], self._sign[x + 1] = x, -1.0
