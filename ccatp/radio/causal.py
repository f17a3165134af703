"""Pure. ``BeaconSlam`` over a recorded run: what is known at each instant from readings up to it."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.radio.motion import Increment
from ccatp.radio.readings import RangeBearingReading, RangeReading, Reading, RssiReading
from ccatp.radio.recording import RecordedRun, Steps
from ccatp.radio.slam import BeaconSlam
from ccatp.radio.slam_settings import SlamSettings
from ccatp.radio.track import BeaconFix, Calibrated, Track

FINEST_S = 0.1
"""Steps of odometry shorter than that are put together."""


def filter_run(
    run: RecordedRun, settings: SlamSettings, first_sigmas: tuple[float, float], clock_s: Callable[[], float]
) -> Track:
    """Run the filter over a recording; nothing of the truth is used but the first pose.

    Args:
        run: odometry, readings, first pose.
        settings: of the filter.
        first_sigmas: of the first position, m, and the first heading, rad.
        clock_s: tells wall time, s.
    """
    position, heading = first_sigmas
    slam = BeaconSlam(settings, run.first_pose, np.diag((position**2, position**2, heading**2)))
    heard = list(_readings(run))
    times = np.union1d(_spaced(run.steps.times_s), run.readings.times_s)
    increments = _increments(run.steps, times)
    poses, covariances = np.empty((len(times), 3)), np.empty((len(times), 3, 3))
    nis: list[float] = []
    sizes: list[int] = []
    took: list[float] = []
    predict_s: list[float] = []
    scalar_s: list[float] = []
    refused = updates = next_reading = 0
    for k, time_s in enumerate(times.tolist()):
        begin_s = clock_s()
        if k:
            slam.predict(increments[k - 1])
        predicted_s = clock_s()
        predict_s.append(predicted_s - begin_s)
        now = []
        while next_reading < len(heard) and heard[next_reading].time_s <= time_s:
            now.append(heard[next_reading])
            next_reading += 1
        if now:
            learned = slam.observe(now)
            end_s = clock_s()
            took += [(end_s - begin_s) / len(now)] * len(now)
            if len(learned) == len(now):  # nothing that waits or joins: updates alone
                scalars = sum(one.size for one in learned)
                scalar_s += [(end_s - predicted_s) / scalars] * scalars
            for one in learned:
                refused += not one.accepted
                if one.accepted:
                    nis.append(one.nis)
                    sizes.append(one.size)
            updates += len(learned)
        poses[k], covariances[k] = slam.pose, slam.pose_covariance
    return Track(
        times_s=times,
        poses=poses,
        covariances=covariances,
        beacons={
            str(b): BeaconFix(float(e.mean[0]), float(e.mean[1]), e.covariance[:2, :2]) for b, e in slam.beacons.items()
        },
        calibration={name: Calibrated(*found) for name, found in slam.calibration.items()},
        nis=np.array(nis),
        nis_sizes=np.array(sizes, dtype=np.float64),
        refused=refused,
        update_s=np.array(took),
        predict_s=np.array(predict_s[1:]),
        scalar_s=np.array(scalar_s),
        updates=updates - refused,
        warnings=tuple(
            f"beacon {name} could not be placed: its readings leave two places or none"
            for name in run.beacon_ids
            if name not in slam.beacons
        ),
    )


def _spaced(times_s: FloatArray) -> FloatArray:
    """The first time, the last, and between them the first of each span of ``FINEST_S``."""
    _, first = np.unique(np.floor((times_s - times_s[0]) / FINEST_S), return_index=True)
    return np.union1d(times_s[first], times_s[-1:])


def _increments(steps: Steps, times_s: FloatArray) -> list[Increment]:
    """Odometry between the times, steps cut where readings fall."""

    def shares(amounts: FloatArray) -> list[float]:
        total = np.concatenate([[0.0], np.cumsum(amounts)])
        shared: list[float] = np.diff(np.interp(times_s, steps.times_s, total)).tolist()
        return shared

    columns = (times_s[1:].tolist(), np.diff(times_s).tolist())
    amounts = (shares(steps.distance_m), shares(steps.turn_rad), shares(steps.lateral_m))
    return [Increment(*row) for row in zip(*columns, *amounts, strict=True)]


def _readings(run: RecordedRun) -> Iterator[Reading]:
    """In order of time; a range goes before a signal strength of the same moment."""
    r = run.readings
    for time_s, beacon, range_m, bearing_rad, rssi_dbm in zip(*(column.tolist() for column in r), strict=True):
        name = run.beacon_ids[beacon]
        bearing = None if math.isnan(bearing_rad) else bearing_rad
        if not math.isnan(range_m):
            if bearing is None:
                yield RangeReading(time_s, name, range_m)
            else:
                yield RangeBearingReading(time_s, name, range_m, bearing)
        elif not math.isnan(rssi_dbm):
            yield RssiReading(time_s, name, rssi_dbm, bearing)
