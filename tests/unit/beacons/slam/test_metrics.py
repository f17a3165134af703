"""Root mean squares and consistency against what can be worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ccatp.beacons.slam.evaluation import judge, truth_at
from ccatp.beacons.slam.recording import BeaconFix, EstimatedPath, ReferencePath
from ccatp.filters.metrics import RigidMotion, aligned_rms_m, best_motion, consistency, nees
from tests.unit.beacons.datasets.sets import BEACONS, recorded, world


def test_squares_of_gaussian_errors_lie_in_the_band_and_others_do_not() -> None:
    rng = np.random.default_rng(4)
    P = np.array(((2.0, 0.3), (0.3, 0.5)))
    errors = rng.multivariate_normal((0.0, 0.0), P, size=500)
    squares = nees(errors, np.broadcast_to(P, (500, 2, 2)))
    honest = consistency(squares, np.full(500, 2.0))
    assert honest is not None
    assert honest.low < honest.mean < honest.high
    assert (honest.low, honest.high) == pytest.approx((0.914, 1.090), abs=0.002)  # tables of chi-squared, 1000 degrees
    proud = consistency(squares * 1.5, np.full(500, 2.0))
    assert proud is not None
    assert proud.mean > proud.high
    assert consistency(np.empty(0), np.empty(0)) is None


def test_truth_is_unknown_outside_and_in_its_gaps() -> None:
    t = np.array([0.0, 0.4, 2.0, 2.4, 2.8])
    found = truth_at(ReferencePath(t, t, -t, 2.0 * t), np.array([-0.1, 0.2, 1.0, 2.2, 2.9]))
    assert np.isnan(found[[0, 2, 4]]).all()
    assert found[[1, 3]] == pytest.approx(np.array([(0.2, -0.2, 0.4), (2.2, -2.2, 4.4)]))
    slow = np.array([0.0, 1.0, 2.0, 3.0, 9.0])  # a reference of a hertz is no gap
    assert np.isfinite(truth_at(ReferencePath(slow, slow, slow, slow), np.array([0.5, 5.0]))[:, 0]).tolist() == [
        True,
        False,
    ]


AWAY = RigidMotion(np.array(((np.cos(1.0), -np.sin(1.0)), (np.sin(1.0), np.cos(1.0)))), np.array((5.0, -3.0)))


def track_of(turned: RigidMotion, *, beacons: bool = True) -> EstimatedPath:
    """The truth of a simulated run, moved rigidly, with a beacon 0.3 m off."""
    w = world(seconds=20.0)
    places = turned.moved(np.array(list(BEACONS.values())) + np.array([[0.3, 0.0], [0, 0], [0, 0], [0, 0]]))
    poses = np.column_stack([turned.moved(w.poses[:, :2]), w.poses[:, 2] + turned.angle_rad])
    return EstimatedPath(
        times_s=w.times_s,
        poses=poses,
        covariances=np.broadcast_to(np.eye(3), (len(poses), 3, 3)),
        beacons={n: BeaconFix(x, y, np.eye(2)) for n, (x, y) in zip(BEACONS, places.tolist(), strict=True)}
        if beacons
        else {},
        calibration={},
        refused=0,
        updates=0,
        warnings=(),
    )


def test_a_track_is_judged_after_one_rigid_alignment() -> None:
    judged = judge(track_of(AWAY), recorded(world(seconds=20.0)))
    assert judged.trajectory_rmse_m == pytest.approx(0.0, abs=1e-9)
    assert judged.heading_rmse_rad == pytest.approx(0.0, abs=1e-9)
    assert judged.beacon_rmse_m == pytest.approx(0.15)  # sqrt(0.3^2 / 4)
    assert judged.beacon_errors_m == pytest.approx({"6": 0.3, "7": 0.0, "8": 0.0, "9": 0.0}, abs=1e-9)
    assert judged.nees is not None
    assert judged.nees.mean > 1.0  # the poses as they are, not aligned
    assert judged.nis is None


def test_without_a_true_path_the_beacons_are_aligned_themselves() -> None:
    run = replace(recorded(world(seconds=20.0)), truth=None)
    judged = judge(track_of(AWAY), run)
    assert judged.trajectory_rmse_m is None
    assert judged.heading_rmse_rad is None
    assert judged.nees is None
    assert judged.beacon_rmse_m is not None
    assert 0.0 < judged.beacon_rmse_m < 0.15
    two = {name: BEACONS[name] for name in ("6", "7")}
    assert judge(track_of(AWAY), replace(run, beacon_truth_m=two)).beacon_rmse_m is None
    none = judge(track_of(RigidMotion(np.eye(2), np.zeros(2)), beacons=False), run)
    assert none.beacon_rmse_m is None


RNG = np.random.default_rng(3)


def test_a_mirror_image_is_another_map_unless_told() -> None:
    points = RNG.normal(size=(8, 2))
    mirrored = points * (1.0, -1.0)
    assert aligned_rms_m(mirrored, points) > 0.3
    assert np.linalg.det(best_motion(mirrored, points).rotation) == pytest.approx(1.0)
    assert aligned_rms_m(mirrored, points, mirrors=True) == pytest.approx(0.0, abs=1e-12)


def test_covariances_turn_with_the_points() -> None:
    rng = np.random.default_rng(3)
    points = rng.multivariate_normal((0.0, 0.0), ((4.0, 1.0), (1.0, 0.5)), size=200)
    motion = RigidMotion(Rotation.from_euler("z", 0.7).as_matrix()[:2, :2], np.array((1.0, 2.0)))
    assert motion.angle_rad == pytest.approx(0.7)
    assert motion.turned(np.cov(points.T)) == pytest.approx(np.cov(motion.moved(points).T))
    maps = rng.normal(size=(40, 3, 2))  # of three points each
    together = np.cov(np.array([motion.moved(one).ravel() for one in maps]).T)
    assert motion.turned_map(np.cov(maps.reshape(40, 6).T)) == pytest.approx(together)


def test_a_single_point_fixes_no_turn() -> None:
    found = best_motion(np.array([[1.0, 2.0]]), np.array([[4.0, 1.0]]))
    assert found.rotation == pytest.approx(np.eye(2))
    assert found.translation_m == pytest.approx([3.0, -1.0])
