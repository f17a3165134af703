"""Alignment: exact motions come back, mirrors only where they are allowed, modes are rigid."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ccatp.filters.metrics import RigidMotion, aligned_rms_m, best_motion, rigid_modes, rms_m

RNG = np.random.default_rng(3)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_motion_comes_back(dimension: int) -> None:
    points = RNG.normal(size=(7, dimension))
    turn = Rotation.from_rotvec([0.0, 0.0, 1.1] if dimension == 2 else [0.3, -0.5, 1.1]).as_matrix()
    turn, shift = turn[:dimension, :dimension], np.arange(1.0, dimension + 1.0)
    found = best_motion(points, points @ turn.T + shift)
    assert found.rotation == pytest.approx(turn)
    assert found.translation_m == pytest.approx(shift)


def test_a_mirror_image_is_another_map_unless_told() -> None:
    points = RNG.normal(size=(8, 2))
    mirrored = points * (1.0, -1.0)
    assert aligned_rms_m(mirrored, points) > 0.3
    assert np.linalg.det(best_motion(mirrored, points).rotation) == pytest.approx(1.0)
    assert aligned_rms_m(mirrored, points, mirrors=True) == pytest.approx(0.0, abs=1e-12)


def test_no_other_motion_is_better() -> None:
    source, target = RNG.normal(size=(9, 2)), RNG.normal(size=(9, 2))
    best = rms_m(best_motion(source, target).moved(source), target)
    for angle in np.linspace(0.0, 2.0 * np.pi, 90):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        turned = (source - source.mean(axis=0)) @ turn.T + target.mean(axis=0)
        assert rms_m(turned, target) >= best - 1e-12


def test_alignment_is_that_of_scipy_and_neither_scales_nor_reflects() -> None:
    rng = np.random.default_rng(2)
    p = rng.normal(size=(40, 2))
    q = 1.5 * p * (1.0, -1.0) + rng.normal(scale=0.3, size=(40, 2))  # scaled, mirrored, noisy
    found = best_motion(p, q)
    planar = [np.column_stack([x - x.mean(axis=0), np.zeros(40)]) for x in (p, q)]
    angles = np.linspace(-np.pi, np.pi, 20001)
    misfits = [((Rotation.from_euler("z", a).apply(planar[0]) - planar[1]) ** 2).sum() for a in angles]
    assert found.angle_rad == pytest.approx(angles[int(np.argmin(misfits))], abs=4e-4)
    moved = found.moved(p)
    assert np.ptp(moved, axis=0) != pytest.approx(np.ptp(q, axis=0), rel=0.1)
    assert moved.mean(axis=0) == pytest.approx(q.mean(axis=0))


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


def test_weights_move_the_fit_to_the_heavy_points() -> None:
    source, target = RNG.normal(size=(5, 2)), RNG.normal(size=(5, 2))
    weights = np.array([1e9, 1.0, 1.0, 1.0, 1.0])
    moved = best_motion(source, target, weights=weights).moved(source)
    assert moved[0] == pytest.approx(target[0], abs=1e-6)


@pytest.mark.parametrize(("dimension", "count"), [(2, 3), (3, 6)])
def test_modes_keep_all_distances(dimension: int, count: int) -> None:
    points = RNG.normal(size=(6, dimension))
    modes = rigid_modes(points)
    assert modes.shape == (6 * dimension, count)
    assert modes.T @ modes == pytest.approx(np.eye(count), abs=1e-12)
    for mode in modes.T:
        rates = mode.reshape(6, dimension)
        ways, speeds = points[:, None] - points[None], rates[:, None] - rates[None]
        assert np.abs(np.einsum("ijk,ijk->ij", ways, speeds)).max() < 1e-12
