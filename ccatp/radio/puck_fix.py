"""Pure. From valid lengths to the fix of the puck."""

from collections.abc import Mapping

import numpy as np

from ccatp.config.models import EtalonConfig
from ccatp.radio.multilateration import FloatArray, check_solution, multilaterate
from ccatp.samples import Fix, Vector3


def solve_fix(
    cfg: EtalonConfig,
    t_s: float,
    expected_m: Vector3,
    lengths_m: Mapping[int, float],
    collimators_m: Mapping[int, FloatArray],
) -> Fix:
    """Multilaterate the puck, each length with sigma = length_sigma_m + length_sigma_per_m * length, and check it.

    Args:
        cfg: sigmas, and the limits of residual, dilution of precision and distance.
        t_s: robot time for which the lengths hold.
        expected_m: where the puck should be, world frame, shape (3,).
        lengths_m: length by channel, at least four.
        collimators_m: collimator by channel, world frame, shape (3,).

    Raises:
        MultilaterationError: no solution, or one past a limit.
    """
    ranges_m = np.array(tuple(lengths_m.values()))
    sigmas_m = cfg.length_sigma_m + cfg.length_sigma_per_m * ranges_m
    anchors_m = np.array([collimators_m[channel] for channel in lengths_m]).reshape(-1, 3)  # none is too few, too
    solution = multilaterate(anchors_m, ranges_m, sigmas_m, expected_m)
    check_solution(
        solution,
        expected_m,
        max_residual_m=cfg.max_residual_m,
        max_dop=cfg.max_dop,
        max_distance_m=cfg.max_distance_m,
    )
    x, y, z = solution.position_m.tolist()
    return Fix(
        t_s=t_s,
        position_m=(x, y, z),
        covariance_m2=tuple(solution.covariance_m2.ravel().tolist()),
        dop=solution.dop,
        channels=tuple(lengths_m),
        residual_rms_m=solution.residual_rms_m,
    )
