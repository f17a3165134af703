"""Poses on arrays against the scalar transforms."""

import numpy as np
import pytest

from ccatp.core import PanelPose
from ccatp.mirror.mirror import Mirror, deck_poses


def test_many_poses_are_as_one_by_one(mirror: Mirror) -> None:
    rng = np.random.default_rng(3)
    poses = [
        PanelPose(panel, rng.uniform(-0.36, 0.36), rng.uniform(-0.38, 0.38), rng.uniform(-3.0, 3.0))
        for panel in mirror.panels
        for _ in range(3)
    ]
    rows = deck_poses(mirror, poses)
    for row, pose in zip(rows, poses, strict=True):
        one = mirror.deck_pose(pose)
        expected = (one.x_m, one.y_m, one.heading_rad, mirror.surface.height_m(one.x_m, one.y_m))
        assert row.tolist() == pytest.approx(expected, abs=1e-12)  # two orders of the same sums


def test_none_is_an_empty_table(mirror: Mirror) -> None:
    assert deck_poses(mirror, []).shape == (0, 4)
