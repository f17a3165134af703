"""Motion models: Jacobians against differences, noise that adds up, calibration, rest."""

from collections.abc import Callable, Container
from dataclasses import replace
from math import pi, radians
from time import perf_counter

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.config.models import ScanConfig
from ccatp.beacons.estimation.causal import filter_run
from ccatp.beacons.estimation.evaluation import judge
from ccatp.beacons.estimation.motion import Increment, resting
from ccatp.beacons.estimation.recording import EstimatedPath, Readings, RecordedRun
from ccatp.beacons.estimation.signal_slam import ReflectorScan
from ccatp.core import FloatArray
from ccatp.kinematics import wrap_pi
from tests.support.slam_settings import odometry, settings
from tests.unit.beacons.datasets.sets import recorded, world

CALIBRATED = settings(
    **odometry(0.05, 0.03, 0.01, 0.05, 0.002, 0.02), priors__turn_bias_rad_s=0.02, priors__turn_scale=0.1,
    priors__distance_scale=0.1, priors__distance_per_rad=0.1, filter__turn_bias_walk_rad_s_sqrt_s=1e-4,
    filter__rest_speed_m_s=0.03, filter__rest_turn_rad_s=0.03,
)  # fmt: skip


def jacobian(of: Callable[[FloatArray], FloatArray], x: FloatArray, step: float = 1e-6) -> FloatArray:
    return np.stack([(of(x + step * e) - of(x - step * e)) / (2.0 * step) for e in np.eye(x.size)], axis=1)


@pytest.mark.parametrize("turn_rad", [0.0, 1e-4, 0.7, -2.0])
@pytest.mark.parametrize(("distance_m", "lateral_m"), [(0.8, 0.0), (0.8, 0.2), (-0.3, 0.0)])
def test_jacobian_of_the_differential_drive(turn_rad: float, distance_m: float, lateral_m: float) -> None:
    drive, step = CALIBRATED.drive, Increment(1.0, 0.5, distance_m, turn_rad, lateral_m)
    x = np.array((1.0, -2.0, 2.5, 0.01, 0.05, -0.04, 0.07))
    F = drive.step(x, step).F.copy()
    assert pytest.approx(jacobian(lambda y: drive.step(y, step).mean, x), abs=1e-8) == F


def test_an_arc_ends_where_a_circle_does() -> None:
    drive = settings(**odometry(0.1, 0.0, 0.0, 0.1, 0.0, 0.0)).drive
    end = drive.step(np.zeros(3), Increment(1.0, 1.0, pi, pi)).mean  # half a circle of radius 1
    assert end == pytest.approx((0.0, 2.0, pi), abs=1e-12)


def test_noise_of_a_way_does_not_depend_on_how_often_it_is_reported() -> None:
    drive = settings(**odometry(0.05, 0.0, 0.02, 0.0, 0.01, 0.0)).drive

    def reported(steps: int) -> FloatArray:
        x, P = np.zeros(3), np.zeros((3, 3))
        for _ in range(steps):
            x, F, Q = drive.step(x, Increment(0.0, 4.0 / steps, 2.0 / steps, 0.0))
            P = F @ P @ F.T + Q
        return P

    assert reported(400) == pytest.approx(reported(40), rel=1e-2, abs=1e-9)  # midpoint and limit differ by 1 / steps^2
    assert reported(40)[0, 0] == pytest.approx(0.05**2 * 2.0)
    assert reported(40)[2, 2] == pytest.approx(0.02**2 * 2.0 + 0.01**2 * 4.0)


def test_a_turn_at_rest_is_the_bias_and_turns_nothing() -> None:
    drive = CALIBRATED.drive
    x = np.array((1.0, 2.0, 0.3, 0.0, 0.0, 0.0, 0.0))
    still = Increment(0.1, 0.1, 0.0, -7e-4)
    assert drive.step(x, still).mean == pytest.approx(x)
    assert drive.at_rest(still) == pytest.approx((3, -7e-3, 0.002**2 / 0.1))
    slow = Increment(0.2, 0.1, 0.01, -7e-4)
    assert drive.step(x, slow).mean[0] > x[0]
    assert drive.at_rest(slow) is None


def test_steps_between_the_ticks_of_an_encoder_are_no_rest() -> None:
    """0.1 m/s at 200 Hz, in ticks of a millimetre, then two seconds of rest: filter and smoother see the same."""
    drive, how = CALIBRATED.drive, CALIBRATED.how
    t: FloatArray = 0.005 * np.arange(801, dtype=np.float64)
    distance_m = np.diff(1e-3 * np.floor(np.minimum(0.1 * t, 0.2) / 1e-3 + 1e-9))
    turn_rad = np.full(800, 1e-5)
    found = resting(t, distance_m, turn_rad, (how.rest_speed_m_s, how.rest_turn_rad_s))
    x, seen = np.array((1.0, 2.0, 0.3, 0.0, 0.0, 0.0, 0.0)), list[bool]()
    for end_s, way_m, turned_rad in zip(t[1:].tolist(), distance_m.tolist(), turn_rad.tolist(), strict=True):
        step = Increment(end_s, 0.005, way_m, turned_rad)
        drive.step(x, step)
        seen.append(drive.at_rest(step) is not None)
    assert not found[20:400].any()
    assert found[440:].all()
    assert found.tolist() == seen


def track_of(run: RecordedRun) -> EstimatedPath:
    cfg = load_recordings_config(None, {})
    return filter_run(run, cfg.csv, cfg.filter, perf_counter)


def test_sound_data_raise_no_doubt_and_parts_are_timed() -> None:
    run = recorded(world())
    track = track_of(run)
    assert track.warnings == ()
    assert len(track.predict_s) == len(track.times_s) - 1
    assert len(track.update_s) == len(run.readings.times_s)
    joined = 4 * 2  # each beacon's first reading is no update of it
    assert len(track.scalar_s) == 2 * len(run.readings.times_s) - joined
    assert 0.0 < np.median(track.scalar_s) < np.median(track.update_s)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_names_that_are_misread_now_and_then_do_not_cost_the_map(seed: int) -> None:
    """The worst time for it is the first sight of a beacon: here the first four are all taken for others."""
    run = recorded(world(seed, 120.0))
    beacon, rng = run.readings.beacon.copy(), np.random.default_rng(seed)
    misread = rng.uniform(size=beacon.size) < 0.05
    misread[:4] = True
    beacon[misread] = (beacon[misread] + rng.integers(1, 4, int(misread.sum()))) % 4
    misnamed = replace(run, readings=run.readings._replace(beacon=beacon))
    found = judge(track_of(misnamed), misnamed)
    assert found.trajectory_rmse_m is not None
    assert found.trajectory_rmse_m < 0.1
    assert found.beacon_rmse_m is not None
    assert found.beacon_rmse_m < 0.15


def test_bearings_of_times_of_their_own_are_used_once_their_beacon_is_placed() -> None:
    run = recorded(world(3, 120.0, range_sigma_m=0.3))
    r = run.readings
    nothing = np.full(len(r.times_s), np.nan)
    both = Readings(
        np.concatenate([r.times_s, r.times_s + 0.01]), np.tile(r.beacon, 2), np.concatenate([r.range_m, nothing]),
        np.concatenate([nothing, r.bearing_rad]), np.tile(nothing, 2),
    )  # fmt: skip
    apart = replace(run, readings=both.where(np.argsort(both.times_s, kind="stable")))
    ranges = replace(run, readings=r._replace(bearing_rad=nothing))
    track, without = track_of(apart), track_of(ranges)
    assert track.updates > 1.3 * without.updates
    assert np.median(track.covariances[:, 2, 2]) < 0.5 * np.median(without.covariances[:, 2, 2])
    found = judge(track, apart)
    assert found.trajectory_rmse_m is not None
    assert found.trajectory_rmse_m < 0.2
    assert any("bearings had no range or strength of the same time and came before" in w for w in track.warnings)


def test_a_beacon_with_bearings_only_is_reported_as_such() -> None:
    run = recorded(world(3, 20.0))
    blind = run.readings._replace(range_m=np.full(len(run.readings.times_s), np.nan))
    reported = track_of(replace(run, readings=blind)).warnings
    assert "beacons 6, 7, 8, 9 could not be placed: only bearings were received, no range" in reported


def test_beacons_that_are_exchanged_on_the_way_are_reported() -> None:
    run = recorded(world(seconds=120.0))
    swap = np.where(run.readings.times_s > 60.0, np.array([1, 0, 2, 3])[run.readings.beacon], run.readings.beacon)
    reported = track_of(replace(run, readings=run.readings._replace(beacon=swap))).warnings
    for name in ("6", "7"):
        assert any(w.startswith(f"beacon {name} was placed again at ") and "exchanged" in w for w in reported)


SCAN = ReflectorScan(ScanConfig(readings=40, bearing_sigma_rad=radians(18.0), loss_tolerance=0.5))
STEP = radians(9.0)


Packet = tuple[str, float, float]


def turn(levels: dict[int, float], lost: Container[int] = (), name: str = "b") -> list[Packet]:
    return [(name, wrap_pi(k * STEP), levels.get(k, -70.0)) for k in range(40) if k not in lost]


@pytest.mark.parametrize(
    ("packets", "bearing_steps", "level_dbm"),
    [
        (turn({7: -40.0, 8: -45.0, 30: -41.0}), 7.0, (-40.0 - 45.0 - 70.0) / 3.0),  # of the strongest
        (turn({7: -40.0, 6: -42.0, 8: -44.0}), 7.0, -42.0),  # the level is the mean next to the bearing
        (turn({7: -40.0, 8: -40.0}), 7.5, -40.0),  # neighbours that tie give their middle
        (turn({20: -40.0, 21: -40.0, 19: -40.0}), 20.0, -40.0),  # across the cut, too
        (turn({0: -40.0, 20: -40.0}), None, -40.0),  # ties that lie apart give a level alone
        (turn({0: -40.0, 12: -40.0}), None, -40.0),
        (turn({7: -40.0}, lost=set(range(20, 39))), 7.0, -60.0),  # lost packets are borne up to the tolerance
        (turn({7: -40.0}, lost=set(range(10, 31))), None, -40.0),
    ],
)
def test_bearing_and_level_of_a_scan(packets: list[Packet], bearing_steps: float | None, level_dbm: float) -> None:
    (found,) = SCAN.results(0.0, packets)
    assert (found.bearing_rad is None) == (bearing_steps is None)
    assert wrap_pi((found.bearing_rad or 0.0) - STEP * (bearing_steps or 0.0)) == pytest.approx(0.0, abs=1e-9)
    assert found.rssi_dbm == pytest.approx(level_dbm)
    assert SCAN.sigma_rad**2 == pytest.approx(radians(18.0) ** 2 + STEP**2 / 12.0)


def test_radios_are_kept_apart_by_their_identifier() -> None:
    both = [*turn({3: -40.0}), *turn({9: -50.0}, name="c")]
    assert [(r.beacon, r.rssi_dbm > -65.0) for r in SCAN.results(0.0, both)] == [("b", True), ("c", True)]
    assert SCAN.results(0.0, []) == []
