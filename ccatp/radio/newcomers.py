"""Pure. Beacons that are heard and are not on the map yet: how they get there."""

from math import cos, sin

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import EkfSlam, columns_of
from ccatp.radio.beacon_map import BeaconMap
from ccatp.radio.dead_reckoning import Carried, DeadReckoning
from ccatp.radio.joining import Clone, Prior, Waiting
from ccatp.radio.motion import POSE
from ccatp.radio.noise_level import NoiseLevel
from ccatp.radio.readings import BeaconId, Reading
from ccatp.radio.settling import LINEARISATIONS, derivatives, pose_columns, settle_by_places, wrapped
from ccatp.radio.sightings import Row, Sensors, bearing_of, kind_of, strength_of

FLAT = 100.0
"""Standard deviation of a beacon's place before its readings, relative to its distance: they alone place it."""
TRIAL = 2
"""Readings that must agree with the one that a beacon joined by: a misread name would put it anywhere."""


class Newcomers:
    """With a bearing a beacon joins at once, where range and bearing say; without one its readings wait.

    One that joined at once is on trial: if one of its next ``TRIAL`` readings is refused, it begins anew with that one.

    Args:
        engine: the state.
        sensors: what readings should be.
        beacons: the map.
        clock: where the vehicle was at a reading.
        levels: learned noise, by kind of reading.
        shared: the calibration's place in the state.
        delay: column of the odometry's delay; -1: none.

    Attributes:
        waiting: beacons that were heard, with what was, and the candidates for their places.
    """

    def __init__(
        self,
        engine: EkfSlam,
        sensors: Sensors,
        beacons: BeaconMap,
        clock: DeadReckoning,
        levels: dict[str, NoiseLevel],
        shared: slice,
        delay: int,
    ) -> None:
        self._engine, self._sensors, self._map, self._clock = engine, sensors, beacons, clock
        self._levels, self._shared, self._delay = levels, shared, delay
        self._ranges = len(sensors.names)
        self.waiting: dict[BeaconId, Waiting] = {}

    def forget(self, beacon: BeaconId) -> bool:
        """Forget what waits of a beacon; False if nothing does."""
        waiting = self.waiting.pop(beacon, None)
        if waiting is None:
            return False
        waiting.drop(self._engine)
        self._map.renumber()
        return True

    def carried(self, x: FloatArray, reading: Reading) -> Carried:
        """The pose of a state x (n,) at a reading's time."""
        delay_s = float(x[self._delay]) if self._delay >= 0 else 0.0
        return self._clock.at(x[:POSE].tolist(), reading.time_s, delay_s)

    def meet(self, reading: Reading) -> None:
        """A reading of a beacon that is not on the map."""
        bearing = bearing_of(reading)
        reach_m = self._sensors.distance_m(reading)
        if bearing is not None:
            pose = self.carried(self._engine.mean, reading).pose
            way = pose[2] + bearing
            entry = self._map.join(
                reading.beacon,
                *self._prior(reading, reach_m, pose[0] + reach_m * cos(way), pose[1] + reach_m * sin(way)),
            )
            entry.on_trial = TRIAL
            self._settle(reading)
            return
        waiting = self.waiting.setdefault(reading.beacon, Waiting(reading.beacon))
        is_kept = waiting.take(self._engine, reading, self._clone(reading), reach_m)
        if is_kept and waiting.is_ready:
            waiting.look(
                self._engine, self._row_of, self._shared, lambda x, y: self._prior(reading, reach_m, x, y), reach_m
            )
            self._join_waiting(reading, waiting, reach_m)
        self._map.renumber()

    def _join_waiting(self, reading: Reading, waiting: Waiting, reach_m: float) -> None:
        found = waiting.found(self._engine)
        if found is None:
            return
        prior = self._prior(reading, reach_m, *found.mean[:2].tolist())
        prior.mean[:2] = found.mean[:2]
        self._map.join(reading.beacon, *prior)
        block = self._engine.block(reading.beacon)
        settle_by_places(self._engine, waiting.records, self._row_of, self._shared, block, found.variances)
        waiting.drop(self._engine)
        del self.waiting[reading.beacon]

    def _settle(self, reading: Reading) -> None:
        """Condition a beacon that has just joined at range and bearing on them."""
        block = self._engine.block(reading.beacon)
        columns = pose_columns(self._shared, block)

        def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            at = self.carried(x, reading)
            beacon = x[block].tolist()
            rows = (
                self._row_of(reading, at.pose, x[self._shared].tolist(), beacon),
                self._sensors.bearing(at.pose, beacon),
            )
            z = (strength_of(reading), bearing_of(reading) or 0.0)
            residual = [wrapped(z[k], rows[k].expected, is_angle=k == 1) for k in range(2)]
            H = [[*derivatives(row, at, delayed=self._delay >= 0), *row.beacon] for row in rows]
            return np.array(residual), np.array(H)

        pose = self.carried(self._engine.mean, reading).pose
        x = self._engine.mean
        row = self._row_of(reading, pose, x[self._shared].tolist(), x[block].tolist())
        bearing = self._sensors.bearing(pose, x[block].tolist())
        R = np.array((row.variance, bearing.variance * self._levels["bearing"].factor))
        self._engine.update_iterated(columns, linearise, R, LINEARISATIONS)

    def _row_of(self, reading: Reading, pose: list[float], calibration: list[float], beacon: list[float]) -> Row:
        """What a reading should be, with the noise as it was learned."""
        row = self._sensors.row(reading, pose, calibration[: self._ranges], beacon)
        level = self._levels[kind_of(reading)]
        return row._replace(variance=row.variance * level.factor)

    def _prior(self, reading: Reading, reach_m: float, x_m: float, y_m: float) -> Prior:
        extra = self._sensors.extra_prior(reading)
        sigmas = (FLAT * reach_m, FLAT * reach_m, *(sigma for _, sigma in extra))
        return Prior(np.array((x_m, y_m, *(mean for mean, _ in extra))), np.diag(np.square(sigmas)))

    def _clone(self, reading: Reading) -> Clone:
        """The vehicle's place when a reading was taken."""
        at = self.carried(self._engine.mean, reading)
        (x_heading, y_heading), by = at.by_heading(), at.by_delay()
        columns, J = [0, 1, 2], [[1.0, 0.0, x_heading], [0.0, 1.0, y_heading]]
        if self._delay >= 0:
            columns.append(self._delay)
            J[0].append(by[0])
            J[1].append(by[1])
        return Clone(np.array(at.pose[:2]), columns_of(columns), np.array(J))
