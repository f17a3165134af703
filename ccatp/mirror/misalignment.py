"""Misalignment of panels: the model, the puck on a misaligned panel, and the fit from measured positions.

A panel is a rigid body, displaced along its own normal by ``D(x_p, y_p) = piston + tilt x_p + tip y_p`` with (x_p, y_p)
the panel coordinates of the surface point. Angles are small (100 urad), so the sideways motion of second order is
left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from ccatp.core import DeckPose, Fix, FloatArray, PanelId, Vector3
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.surface import PanelFitError

_PARAMETERS = 3
# Of one row of points the tolerance of their arrivals, 10 mm, would make a plane: one with tilts of some 0.1 rad.
_MIN_SPREAD_M = 0.02


@dataclass(frozen=True, slots=True)
class PanelMisalignment:
    """Rigid misalignment of a panel against the ideal surface, in the panel frame.

    ``piston_m`` > 0 towards the robot; ``tip_rad`` and ``tilt_rad``: slope of the displacement along y and along x.
    """

    piston_m: float
    tip_rad: float
    tilt_rad: float

    def displacement_m(self, x_p: float, y_p: float) -> float:
        """Displacement along the panel's normal at the panel coordinates (x_p, y_p), m."""
        return self.piston_m + self.tilt_rad * x_p + self.tip_rad * y_p


@dataclass(frozen=True, slots=True)
class PanelFit:
    """Measured misalignment; ``sigma``: standard deviations of piston (m), tip and tilt (rad)."""

    piston_m: float
    tip_rad: float
    tilt_rad: float
    sigma: Vector3
    chi2: float
    dof: int


def misaligned_puck_world(
    mirror: Mirror, panel: PanelId, misalignment: PanelMisalignment, p: DeckPose, height_m: float
) -> Vector3:
    """World position of the puck's centre while the robot stands on a misaligned panel, ``p`` before the displacement.

    The surface point moves by D along the panel's normal z, and the surface normal n on which the puck stands turns
    with the panel: ``n' = n - (tilt x + tip y)`` of the panel's axes, to first order. Raises ``UnknownPanelError``.
    """
    body = mirror.panel(panel)
    point = mirror.surface.point(p.x_m, p.y_m)
    x_p, y_p, _ = body.from_deck(point)
    d = misalignment.displacement_m(x_p, y_p)
    nx, ny, nz = body.rotate_from_deck(mirror.surface.normal(p.x_m, p.y_m))
    # The rotation vector of the panel is (tip, -tilt, 0); its cross product with n is the change of the normal.
    tip, tilt = misalignment.tip_rad, misalignment.tilt_rad
    mx, my, mz = nx - tilt * nz, ny - tip * nz, nz + tip * ny + tilt * nx
    scale = height_m / sqrt(mx * mx + my * my + mz * mz)
    ox, oy, oz = body.rotate_to_deck((scale * mx, scale * my, scale * mz + d))
    return mirror.world_from_deck((point[0] + ox, point[1] + oy, point[2] + oz))


def fit_panels(
    mirror: Mirror, fixes: Mapping[PanelId, Sequence[Fix]], puck_height_m: float
) -> dict[PanelId, tuple[float, float, float]]:
    """Piston (m), tip and tilt (rad) of every panel with enough fixes that span it."""
    fits = {}
    for panel, own in sorted(fixes.items()):
        if len(own) < _PARAMETERS:
            continue
        points = np.array([fix.position_m for fix in own])
        covariances = np.array([fix.covariance_m2 for fix in own]).reshape(-1, 3, 3)
        try:
            fit = fit_panel(mirror, panel, points, covariances, puck_height_m)
        except PanelFitError:
            continue  # fixes on one line: a survey that ended early
        fits[panel] = (fit.piston_m, fit.tip_rad, fit.tilt_rad)
    return fits


def panel_deviations(mirror: Mirror, panel: PanelId, points_world: FloatArray, puck_height_m: float) -> FloatArray:
    """Rows (x_p, y_p, deviation along the local normal), m, shape (k, 3), of puck centres in the world frame (k, 3).

    Raises ``UnknownPanelError``, and ``ConvergenceError`` far from the mirror.
    """
    body, rows = mirror.panel(panel), []
    for world_x, world_y, world_z in points_world.tolist():
        x, y, deviation = mirror.foot_of_puck((world_x, world_y, world_z), puck_height_m)
        rows.append((*body.from_deck(mirror.surface.point(x, y))[:2], deviation))
    return np.array(rows).reshape(-1, 3)


def fit_panel(
    mirror: Mirror, panel: PanelId, points_world: FloatArray, covariances: FloatArray, puck_height_m: float
) -> PanelFit:
    """Weighted least squares of piston, tip and tilt from puck positions (k, 3), world frame, k >= 3, on one panel.

    Solves ``d_k = (piston + tilt x_k + tip y_k) (n_k . z) + e_k`` with ``var(e_k) = n_k^T C_k n_k``: only the error
    along the local normal n_k counts, because sideways errors move along the surface. Points are independent.

    Raises ``PanelFitError`` with fewer than three points, points on one line to within 20 mm (rms) or a covariance (k,
    3, 3) that is not positive; ``UnknownPanelError``; ``ConvergenceError`` far from the mirror.
    """
    points = np.asarray(points_world, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < _PARAMETERS:
        raise PanelFitError(f"panel {tuple(panel)}: fit needs points of shape (k >= 3, 3), got {points.shape}")
    if np.shape(covariances) != (len(points), 3, 3):
        raise PanelFitError(f"panel {tuple(panel)}: {len(points)} points, covariances of shape {np.shape(covariances)}")
    body = mirror.panel(panel)
    rows = panel_deviations(mirror, panel, points, puck_height_m)
    normals = np.array([mirror.surface.normal(*body.to_deck((x, y, 0.0))[:2]) for x, y, _ in rows])
    world = np.array([mirror.rotate_world_from_deck((n[0], n[1], n[2])) for n in normals])
    variances = np.einsum("ki,kij,kj->k", world, np.asarray(covariances, dtype=np.float64), world)
    if not (np.isfinite(variances).all() and (variances > 0.0).all()):
        raise PanelFitError(f"panel {tuple(panel)}: variance along the normal is not positive: {variances.min()} m^2")
    centred = rows[:, :2] - rows[:, :2].mean(axis=0)
    spread_m = float(np.linalg.svd(centred, compute_uv=False)[-1]) / sqrt(len(rows))
    if not spread_m >= _MIN_SPREAD_M:
        raise PanelFitError(
            f"panel {tuple(panel)}: {len(rows)} points do not span the panel: they lie on one line to within "
            f"{1e3 * spread_m:.1f} mm, and {1e3 * _MIN_SPREAD_M:g} are the least"
        )
    lever = normals @ np.array(body.axes[2])
    design = lever[:, None] * np.column_stack([np.ones(len(rows)), rows[:, 1], rows[:, 0]])
    sigmas = np.sqrt(variances)
    whitened, target = design / sigmas[:, None], rows[:, 2] / sigmas
    q, r = np.linalg.qr(whitened)
    piston, tip, tilt = solution = np.linalg.solve(r, q.T @ target)
    sigma = np.linalg.norm(np.linalg.solve(r, np.eye(_PARAMETERS)), axis=1)
    residual = target - whitened @ solution
    of_each = float(sigma[0]), float(sigma[1]), float(sigma[2])
    chi2, dof = float(residual @ residual), len(design) - _PARAMETERS
    return PanelFit(float(piston), float(tip), float(tilt), of_each, chi2, dof)
