"""Position from ranges to known anchors by damped Gauss-Newton, with covariance and DOP; fix of the puck."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ccatp.config.models import EtalonConfig
from ccatp.core import Fix, FloatArray, Vector3

_RANK_TOLERANCE = 1e-6  # smallest over largest singular value of H, below which the position is not determined
_COPLANAR_TOLERANCE = 1e-9  # likewise of the anchors about their centroid, below which they lie in a plane (2-D: line)
_FIRST_DAMPING = 1e-6  # part of the mean diagonal of H^T W H; small, but the system stays solvable if H loses rank


class MultilaterationError(ValueError):
    """The ranges give no valid position. The message has the reason with numbers."""


@dataclass(frozen=True, slots=True)
class RangeSolution:
    """A multilaterated position (d,), m, in the frame of the anchors.

    Covariance (H^T W H)^-1 (d, d); ``dop``: sqrt(trace((H^T H)^-1)), dimensionless; residuals measured minus computed
    (m,); ``chi_squared`` has m - d degrees of freedom.
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    dop: float
    residuals_m: FloatArray
    chi_squared: float
    iterations: int


def multilaterate(
    anchors_m: ArrayLike,
    ranges_m: ArrayLike,
    sigmas_m: ArrayLike,
    expected_m: ArrayLike,
    *,
    max_iterations: int = 100,
    tolerance_m: float = 1e-9,
) -> RangeSolution:
    """Weighted least squares position from ranges (m,) to anchors (m, d), d = 2 or 3; see docs/mathematics.md.

    Damped Gauss-Newton, starting at ``expected_m``: the damping falls tenfold after a step that reduces the sum of
    squares, and rises tenfold otherwise (Levenberg 1944). For anchors in one plane (in two dimensions: on one line)
    there are two solutions, mirror images of each other; the one on the side of the expected position is returned.

    Raises ``ValueError`` (shapes, numbers that are not finite, sigmas that are not positive) and
    ``MultilaterationError``: too few ranges, a degenerate geometry, no convergence.
    """
    given = (np.asarray(values, dtype=np.float64) for values in (anchors_m, ranges_m, sigmas_m, expected_m))
    anchors, ranges, sigmas, start = given
    _check(anchors, ranges, sigmas, start)
    position, iterations = _iterate(anchors, ranges, sigmas, start, max_iterations, tolerance_m)
    position = _on_side_of(start, position, anchors)
    distances, directions = _geometry(anchors, position)
    singular = np.linalg.svd(directions, compute_uv=False)
    if singular[-1] <= _RANK_TOLERANCE * singular[0]:
        at = ", ".join(f"{value:.4f}" for value in position)
        raise MultilaterationError(
            f"{len(ranges)} anchors leave a direction undetermined at ({at}) m "
            f"(singular values {singular[0]:.3g} to {singular[-1]:.3g}); they lie on a line, or in a plane with it"
        )
    weighted = directions / sigmas[:, None]
    covariance = np.linalg.solve(weighted.T @ weighted, np.eye(len(position)))
    residuals = ranges - distances
    return RangeSolution(
        position_m=position,
        covariance_m2=0.5 * (covariance + covariance.T),
        dop=float(np.sqrt(np.sum(singular**-2.0))),
        residuals_m=residuals,
        chi_squared=float(np.sum((residuals / sigmas) ** 2)),
        iterations=iterations,
    )


def _check(anchors: FloatArray, ranges: FloatArray, sigmas: FloatArray, expected: FloatArray) -> None:
    dimension = expected.size
    if expected.shape not in ((2,), (3,)):
        raise ValueError(f"expected position of shape {expected.shape}, not (2,) or (3,)")
    if anchors.shape != (ranges.size, dimension) or ranges.ndim != 1 or sigmas.shape != ranges.shape:
        raise ValueError(
            f"anchors {anchors.shape}, ranges {ranges.shape}, sigmas {sigmas.shape} do not fit dimension {dimension}"
        )
    if not all(bool(np.isfinite(values).all()) for values in (anchors, ranges, sigmas, expected)):
        raise ValueError("anchors, ranges, sigmas or expected position not finite")
    if bool((sigmas <= 0.0).any()):
        raise ValueError(f"sigma of {float(sigmas.min())} m, must be positive")
    if ranges.size < dimension + 1:
        raise MultilaterationError(f"{ranges.size} ranges, at least {dimension + 1} needed in {dimension} dimensions")


def _geometry(anchors: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (m,) and unit vectors (m, d) from the anchors to the position: the Jacobian H."""
    offsets = position - anchors
    distances = np.sqrt(np.einsum("ij,ij->i", offsets, offsets))
    # At an anchor the direction is undefined; a zero row leaves this range out of the step.
    return distances, offsets / np.maximum(distances, 1e-12)[:, None]


def _iterate(
    anchors: FloatArray,
    ranges: FloatArray,
    sigmas: FloatArray,
    position: FloatArray,
    max_iterations: int,
    tolerance_m: float,
) -> tuple[FloatArray, int]:
    distances, directions = _geometry(anchors, position)
    residuals = (ranges - distances) / sigmas
    cost = float(residuals @ residuals)
    damping = _FIRST_DAMPING
    step_m = float("inf")
    identity = np.eye(position.size)
    for iteration in range(1, max_iterations + 1):
        weighted = directions / sigmas[:, None]
        normal = weighted.T @ weighted
        scale = float(np.trace(normal)) / position.size
        step = np.linalg.solve(normal + damping * scale * identity, weighted.T @ residuals)
        step_m = float(np.sqrt(step @ step))
        trial = position + step
        trial_distances, trial_directions = _geometry(anchors, trial)
        trial_residuals = (ranges - trial_distances) / sigmas
        trial_cost = float(trial_residuals @ trial_residuals)
        if trial_cost <= cost:
            position, directions, residuals, cost = trial, trial_directions, trial_residuals, trial_cost
            damping = max(damping * 0.1, 1e-15)
        else:
            damping *= 10.0
        if step_m <= tolerance_m:
            return position, iteration
    raise MultilaterationError(
        f"no rest after {max_iterations} iterations: last step {step_m:.3g} m, limit {tolerance_m:.3g} m"
    )


def _on_side_of(start: FloatArray, position: FloatArray, anchors: FloatArray) -> FloatArray:
    """The position or, if the anchors lie in a plane, its mirror image on the side of ``start``."""
    centroid = anchors.mean(axis=0)
    _, singular, axes = np.linalg.svd(anchors - centroid)
    if singular[-1] > _COPLANAR_TOLERANCE * singular[0]:
        return position
    normal: FloatArray = axes[-1]
    height = float((position - centroid) @ normal)
    if height * float((start - centroid) @ normal) < 0.0:
        return position - 2.0 * height * normal
    return position


def solve_fix(
    cfg: EtalonConfig,
    t_s: float,
    expected_m: Vector3,
    lengths_m: Mapping[int, float],
    collimators_m: Mapping[int, FloatArray],
) -> Fix:
    """Multilaterate the puck, each length with sigma = length_sigma_m + length_sigma_per_m * length. World frame.

    Raises ``MultilaterationError``: no solution, or one that exceeds a configured limit.
    """
    ranges_m = np.array(tuple(lengths_m.values()))
    sigmas_m = cfg.length_sigma_m + cfg.length_sigma_per_m * ranges_m
    anchors_m = np.array([collimators_m[channel] for channel in lengths_m]).reshape(-1, 3)  # also without any
    solution = multilaterate(anchors_m, ranges_m, sigmas_m, expected_m)
    residual_m = float(np.max(np.abs(solution.residuals_m)))
    if not residual_m <= cfg.max_residual_m:
        limit_mm = cfg.max_residual_m * 1e3
        raise MultilaterationError(f"largest residual {residual_m * 1e3:.4g} mm exceeds {limit_mm:.4g} mm")
    if not solution.dop <= cfg.max_dop:
        raise MultilaterationError(f"dilution of precision {solution.dop:.4g} exceeds {cfg.max_dop:.4g}")
    distance_m, limit_m = float(np.linalg.norm(solution.position_m - np.array(expected_m))), cfg.max_distance_m
    if not distance_m <= limit_m:
        raise MultilaterationError(f"position {distance_m:.4g} m from the expected one exceeds {limit_m:.4g} m")
    x, y, z = solution.position_m.tolist()
    return Fix(
        t_s=t_s,
        position_m=(x, y, z),
        covariance_m2=tuple(solution.covariance_m2.ravel().tolist()),
        dop=solution.dop,
        channels=tuple(lengths_m),
        residual_rms_m=float(np.sqrt(np.mean(solution.residuals_m**2))),
    )
