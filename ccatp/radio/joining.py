"""Pure. Beacons whose direction nobody hears: readings wait, with the places they were taken at, until they say where."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import cos, hypot, pi, sin
from typing import NamedTuple

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import BlockId, EkfSlam
from ccatp.radio.readings import Reading, RssiReading
from ccatp.radio.sightings import Row
from ccatp.radio.slam_settings import SlamSettings

Rows = Callable[[Reading, list[float], list[float], list[float]], list[Row]]

MOST = 24
LEAST = 5
STARTS = 16
MARGIN = 14.0
TIGHT = 0.15


class Record(NamedTuple):
    reading: Reading
    place: BlockId


class Candidate(NamedTuple):
    mean: FloatArray
    covariance: FloatArray
    cost: float


@dataclass(slots=True)
class Waiting:
    """Readings of a beacon that is not on the map yet."""

    records: list[Record] = field(default_factory=list)
    spacing_m: float = 0.0
    candidates: list[Candidate] = field(default_factory=list)
    count: int = 0

    def take(self, engine: EkfSlam, reading: Reading, range_m: float) -> None:
        x, y = engine.mean[:2].tolist()
        if not self.records:
            self.spacing_m = 0.01 * range_m
        else:
            bx, by = engine.mean[engine.block(self.records[-1].place)].tolist()
            if hypot(x - bx, y - by) < self.spacing_m:
                return
        place = ("place", reading.beacon, self.count)
        self.count += 1
        engine.augment(place, engine.mean[:2].copy(), np.array((0, 1)), np.eye(2))
        self.records.append(Record(reading, place))
        if len(self.records) > MOST:
            self.spacing_m *= 2.0
            for record in self.records[1::2]:
                engine.remove(record.place)
            self.records = self.records[::2]

    def solve(
        self, engine: EkfSlam, rows: Rows, calibration: slice, settings: SlamSettings
    ) -> tuple[FloatArray, FloatArray] | None:
        if len(self.records) < LEAST:
            return None
        z = np.array(
            [r.reading.rssi_dbm if isinstance(r.reading, RssiReading) else r.reading.range_m for r in self.records]
        )
        places = np.array([engine.mean[engine.block(r.place)] for r in self.records])
        columns = np.concatenate([np.r_[engine.block(r.place)] for r in self.records] + [np.r_[calibration]]).astype(
            np.intp
        )
        P = engine.covariance[np.ix_(columns, columns)]
        cal = engine.mean[calibration].tolist()
        m, c = z.size, len(cal)
        first = self.records[-1].reading
        distance = _distance(settings, first)
        found: list[Candidate] = []
        for k in range(STARTS):
            angle = 2.0 * pi * k / STARTS
            mean, spread = widened(
                settings, places[-1, 0] + distance * cos(angle), places[-1, 1] + distance * sin(angle), distance, first
            )
            prior = mean.copy()
            Wp = np.linalg.inv(spread)
            b = mean.copy()
            cost = np.inf
            for _ in range(12):
                H, G, e = np.zeros((m, columns.size)), np.zeros((m, b.size)), np.zeros(m)
                R = np.zeros(m)
                for i, record in enumerate(self.records):
                    row = rows(record.reading, [*places[i].tolist(), 0.0], cal, b.tolist())[0]
                    e[i] = z[i] - row.expected
                    H[i, 2 * i : 2 * i + 2] = row.pose[:2]
                    H[i, columns.size - c :] = row.calibration
                    G[i] = row.beacon
                    R[i] = row.variance
                S = H @ P @ H.T + np.diag(R)
                WG = np.linalg.solve(S, G)
                A = G.T @ WG + Wp
                step = np.linalg.solve(A, WG.T @ e + Wp @ (prior - b))
                size = hypot(step[0], step[1])
                if size > 0.5 * distance:
                    step *= 0.5 * distance / size
                b = b + step
                if size < 1e-4 * distance:
                    break
            cost = float(e @ np.linalg.solve(S, e))
            if not np.isfinite(cost):
                continue
            if all(hypot(*(b[:2] - o.mean[:2])) > 0.02 * distance for o in found):
                found.append(Candidate(b, np.linalg.inv(A), cost))
        found.sort(key=lambda f: f.cost)
        self.candidates = found[:2]
        if not found:
            return None
        best = found[0]
        sigma = float(np.sqrt(np.linalg.eigvalsh(best.covariance[:2, :2])[-1]))
        if sigma > TIGHT * hypot(*(best.mean[:2] - places[-1])):
            return None
        if len(found) > 1 and found[1].cost - best.cost < MARGIN:
            return None
        return widened(settings, best.mean[0], best.mean[1], distance, first)


def _distance(s: SlamSettings, reading: Reading) -> float:
    if isinstance(reading, RssiReading):
        assert s.rssi is not None
        return float(10.0 ** ((s.rssi.reference_dbm - reading.rssi_dbm) / (10.0 * s.rssi.exponent)))
    return max(reading.range_m, 0.0)


def widened(
    settings: SlamSettings, x_m: float, y_m: float, range_m: float, reading: Reading
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of a beacon about which nothing but its readings is known."""
    mean, sigma = [x_m, y_m], [100.0 * (range_m + 0.1)] * 2
    if isinstance(reading, RssiReading) and settings.rssi is not None:
        if settings.rssi.reference_sigma_db > 0.0:
            mean.append(settings.rssi.reference_dbm)
            sigma.append(settings.rssi.reference_sigma_db)
        if settings.rssi.exponent_sigma > 0.0:
            mean.append(settings.rssi.exponent)
            sigma.append(settings.rssi.exponent_sigma)
    return np.array(mean), np.diag(np.square(sigma))
