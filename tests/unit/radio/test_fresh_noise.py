"""What the motion adds to the covariance of the pose between two readings, by numbers and by matrices."""

import numpy as np
import pytest

from ccatp.beacons.slam.range_slam import AddedPoseNoise


def test_it_is_that_of_the_matrices() -> None:
    rng = np.random.default_rng(3)
    ours, N = AddedPoseNoise(), np.zeros((3, 3))
    for _ in range(5):
        F, root = np.eye(4), rng.normal(size=(4, 4))
        F[:2, 2] = rng.normal(size=2)
        Q = root @ root.T
        ours.step(F, Q)
        N = F[:3, :3] @ N @ F[:3, :3].T + Q[:3, :3]
        h = rng.normal(size=3)
        assert ours.seen(*h.tolist()) == pytest.approx(float(h @ N @ h), rel=1e-12)  # rounding alone
    ours.clear()
    assert ours.seen(1.0, 2.0, 3.0) == 0.0
