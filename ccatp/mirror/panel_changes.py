"""What has changed between two surveys of a mirror, panel by panel, and what the whole mirror has in common.

Two surveys in frames of their own differ by a motion of the whole mirror, by another offset of the targets, and by
another scale. None of them is a change of a panel: they are fitted to all panels together and taken out.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, null_space
from scipy.special import chdtr, chdtrc, chdtri

from ccatp.core import BoolArray, FloatArray, PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.mirror_alignment import BAND
from ccatp.mirror.panel_alignment import PanelResult
from ccatp.mirror.panel_modes import adjustable, fit_modes, rigid, surface_under

_MODES = 3
FALSE_ALARM = 0.01  # probability that noise alone makes any panel of the mirror look moved
_SAME_TARGET_M = 0.02  # the robot comes within a centimetre of a point; targets are further from each other
_FEW = 3  # panels whose points do not show how well a point repeats
_NOTHING_M = 1e-9  # no instrument repeats so
_SURE = 1e-3  # probability by noise from which the standard deviations of the points are not those of their changes
_CELL_M = 0.25  # of a panel, at whose corners a motion of the whole mirror is taken
_LEAST_MODE = 1e-3  # part of the largest motion of panels that a motion of the mirror of the same size makes
_REDUNDANCY = 4  # least number of values of the panels for each motion of the mirror: 11 panels for 8 of them
_USUAL = float(chdtri(_MODES, 1e-4))  # chi-square of a panel that has changed as planned, or not at all
_OTHER_FACTOR = 0.1  # from 0 and 1, from which a multiple of the plan is another explanation
_PASSES = 30


class PointRepeat(NamedTuple):
    """How the points of two surveys repeat about their panels, without what adjusters can do to a panel.

    ``sigma_m``: standard deviation of a point. ``variance``: of the differences over the claimed one, 1 if noise may
    make it. ``other_surface``: panels whose points differ by more. ``is_same``: the points of both are equal.
    """

    sigma_m: float | None
    variance: float
    other_surface: tuple[PanelId, ...]
    is_same: bool


class CommonMotion(NamedTuple):
    """Motion that all panels have in common along their normals, m: mean and rms over the panels.

    ``panels``: from which it was computed, as they have changed as planned besides, or not at all.
    """

    mean_m: float
    rms_m: float
    panels: int


class PanelChange(NamedTuple):
    """Change of one panel: values of the later survey minus those of the earlier one, without the common motion."""

    panel: PanelId
    values: FloatArray  # piston (m), tip, tilt (rad), shape (3,)
    covariance: FloatArray
    own_covariance: FloatArray  # without errors that panels share, and without that of the common motion
    variance: float  # of the points over the claimed one, as they repeat
    common: FloatArray  # part of the common motion that was taken out
    chi2: float  # of the hypothesis of no change, three degrees of freedom
    has_moved: bool  # the change is not explained by noise, see ``FALSE_ALARM``

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the values."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


class Changes(NamedTuple):
    """All panels that both surveys determined, chi^2 of the hypothesis of no change, and its interval under noise.

    ``motion``: of the whole mirror; None if none was computed.
    """

    panels: tuple[PanelChange, ...]
    chi2: float
    dof: int
    low: float
    high: float
    repeat: PointRepeat
    motion: CommonMotion | None

    @property
    def agree(self) -> bool:
        """Whether the surveys differ by no more than noise."""
        return self.chi2 <= self.high and not any(panel.has_moved for panel in self.panels)


def panel_changes(
    mirror: Mirror,
    pairs: Sequence[tuple[PanelResult, PanelResult]],
    *,
    planned: FloatArray,
    errors: tuple[slice, slice] = (slice(None), slice(None)),
    has_one_frame: bool = True,
) -> Changes | None:
    """Compare the panels of two surveys of one mirror; None without panels. Another puck looks like a move of all.

    ``planned`` (n, 3): change of each panel that the earlier survey asks for, 0 if none. ``errors``: those of the
    errors common to the panels of a survey that differ between the surveys. Without ``has_one_frame`` the motion of the
    whole mirror is taken out, if there are panels enough to tell it from theirs.
    """
    if not pairs:
        return None
    one, other = ([pair[k] for pair in pairs] for k in (0, 1))
    repeat = point_repeat(pairs)
    variances = [_variance(repeat, a, b) for a, b in pairs]
    own = [
        variance * (a.fit.own_covariance + b.fit.own_covariance)
        for variance, (a, b) in zip(variances, pairs, strict=True)
    ]
    shared = [
        np.vstack([panel.fit.common[:, part] for panel in panels])
        for panels, part in zip((one, other), errors, strict=True)
    ]
    covariance = np.asarray(block_diag(*own) + sum(each @ each.T for each in shared))
    raw = np.array([b.fit.values - a.fit.values for a, b in pairs])
    found = None if has_one_frame else _common_motion(mirror, [a.panel for a, _ in pairs], raw, planned, np.array(own))
    values, of_values, free = raw, covariance, np.eye(raw.size)
    motion = None
    if found is not None:
        values = raw - found.values
        left = np.eye(raw.size) - found.operator
        of_values, free = left @ covariance @ left.T, null_space(found.modes.T)
        pistons = found.values[:, 0]
        motion = CommonMotion(float(pistons.mean()), float(np.sqrt(np.mean(pistons**2))), int(found.is_usual.sum()))
    changes = []
    for number, (before, _) in enumerate(pairs):
        part = slice(_MODES * number, _MODES * (number + 1))
        value, square = values[number], of_values[part, part]
        chi2 = float(value @ np.linalg.solve(square, value))
        has_moved = float(chdtrc(_MODES, chi2)) < FALSE_ALARM / len(pairs)
        common = raw[number] - value
        changes.append(
            PanelChange(before.panel, value, square, own[number], variances[number], common, chi2, has_moved)
        )
    every = free.T @ raw.ravel()
    dof = len(every)
    low, high = (float(chdtri(dof, at)) for at in (0.5 + 0.5 * BAND, 0.5 - 0.5 * BAND))
    chi2 = float(every @ np.linalg.solve(free.T @ covariance @ free, every))
    return Changes(tuple(changes), chi2, dof, low, high, repeat, motion)


def _variance(repeat: PointRepeat, before: PanelResult, after: PanelResult) -> float:
    """Variance of the points of a panel over the claimed one; smaller only if both fits are to the same points.

    The roughness of a panel is then the same in both.
    """
    count = len(_same_targets(before, after)[0])
    is_of_same = count == before.is_kept.sum() == after.is_kept.sum()
    return repeat.variance if is_of_same else max(repeat.variance, 1.0)


def point_repeat(pairs: Sequence[tuple[PanelResult, PanelResult]]) -> PointRepeat:
    """How the points of two surveys repeat; points of the same number need not be the same, those of a place are."""
    found = dict[PanelId, tuple[float, float, int]]()  # sum of squares, m^2; chi-square; degrees of freedom
    for before, after in pairs:
        a, b = before.deviations, after.deviations
        rows = _same_targets(before, after)
        differences = b.values_m[rows[1]] - a.values_m[rows[0]]
        sigmas = np.hypot(a.sigmas_m[rows[0]], b.sigmas_m[rows[1]])
        fit = fit_modes(a.lever[rows[0], None] * adjustable(a.places_m[rows[0]]), differences, sigmas)
        if fit is not None and fit.dof > 0:
            found[before.panel] = float(np.sum(fit.residuals_m**2)), fit.chi2, fit.dof
    if not found:
        return PointRepeat(None, 1.0, (), is_same=False)
    squares, chi2, dof = np.array([*found.values()]).T
    if (same_m := float(np.sqrt(squares.sum() / dof.sum() / 2.0))) < _NOTHING_M:
        return PointRepeat(same_m, 1.0, (), is_same=True)
    variance = float(np.median(chi2 / chdtri(dof, 0.5))) if len(found) >= _FEW else 1.0
    is_other = _is_other(chi2 / variance, dof)
    if len(found) >= _FEW:
        left, count = float(chi2[~is_other].sum()), float(dof[~is_other].sum())
        is_by_noise = min(float(chdtr(count, left)), float(chdtrc(count, left))) >= _SURE
        variance = 1.0 if is_by_noise else left / count
        is_other = _is_other(chi2 / variance, dof)
    kept = ~is_other if not is_other.all() else np.ones_like(is_other)
    sigma_m = float(np.sqrt(squares[kept].sum() / dof[kept].sum() / 2.0))
    others = tuple(panel for panel, other in zip(found, is_other.tolist(), strict=True) if other)
    return PointRepeat(sigma_m, variance, others, is_same=False)


def _is_other(chi2: FloatArray, dof: FloatArray) -> BoolArray:
    return np.asarray(chdtrc(dof, chi2) < FALSE_ALARM / len(chi2))


def _same_targets(before: PanelResult, after: PanelResult) -> tuple[list[int], list[int]]:
    """Rows of the points of both surveys at the same places, without outliers; numbers need not be those of targets."""
    rows = list[int](), list[int]()
    places = after.deviations.places_m
    for at, place in enumerate(before.deviations.places_m):
        away = np.linalg.norm(places - place, axis=1)
        nearest = int(np.argmin(away))
        is_kept = bool(before.is_kept[at]) and bool(after.is_kept[nearest])
        if is_kept and away[nearest] < _SAME_TARGET_M and nearest not in rows[1]:
            rows[0].append(at)
            rows[1].append(nearest)
    return rows


class _Common(NamedTuple):
    """Common motion (n, 3) of the panels, linear in their changes by ``operator`` (3n, 3n); ``modes`` (3n, k)."""

    values: FloatArray
    operator: FloatArray
    modes: FloatArray
    is_usual: BoolArray


def _common_motion(
    mirror: Mirror, panels: Sequence[PanelId], changes: FloatArray, planned: FloatArray, own: FloatArray
) -> _Common | None:
    """The motion with which most panels have changed as planned, or not at all; None if it is not more than half.

    Least squares over these panels (least trimmed squares: Rousseeuw 1984, with its steps of concentration), from
    starts by least absolute values. A panel that was moved otherwise has no part in it, unless most were moved by the
    same multiple of the plan, as if all turns had the wrong sign.
    """
    modes = _mirror_modes(mirror, panels)
    count = modes.shape[1]
    if changes.size < _REDUNDANCY * count:
        return None
    roots = np.linalg.inv(np.linalg.cholesky(own))
    design = roots @ modes.reshape(len(panels), _MODES, count)
    change, plan = (np.einsum("nij,nj->ni", roots, one) for one in (changes, planned))
    targets = np.array([change - plan, change])
    if planned.any():
        factor = _least_absolute(np.dstack([design, plan[:, :, None]]), change)[-1]
        if abs(factor - 1.0) > _OTHER_FACTOR < abs(factor):
            targets = np.array([*targets, change - factor * plan])
    best = None
    for start in targets:
        motion, is_usual = _least_absolute(design, start), np.zeros(len(panels), dtype=bool)
        chi2 = np.full(len(panels), np.inf)
        for _ in range(_PASSES):
            each = np.sum((targets - design @ motion) ** 2, axis=2)
            which, chi2 = np.argmin(each, axis=0), each.min(axis=0)
            was_usual, is_usual = is_usual, chi2 < _USUAL
            if np.array_equal(was_usual, is_usual) or 2 * is_usual.sum() <= len(panels):
                break
            chosen = targets[which, np.arange(len(panels))]
            motion = _least_squares(design[is_usual], chosen[is_usual])
        cost = float(np.minimum(chi2, _USUAL).sum())
        if 2 * is_usual.sum() > len(panels) and (best is None or cost < best[0]):
            best = cost, motion, is_usual
    if best is None:
        return None
    _, motion, is_usual = best
    used = design * is_usual[:, None, None]
    inverse = np.linalg.pinv(np.einsum("nik,nil->kl", used, used))
    operator = modes @ inverse @ np.einsum("nik,nij->knj", used, roots).reshape(count, -1)
    return _Common((modes @ motion).reshape(-1, _MODES), operator, modes, is_usual)


def _least_absolute(design: FloatArray, target: FloatArray) -> FloatArray:
    """Least sum of the distances of panels (n, 3, k) from targets (n, 3), by weights (Weiszfeld 1937)."""
    weights, found = np.ones(len(design)), np.zeros(design.shape[2])
    for _ in range(_PASSES):
        found = _least_squares(design * weights[:, None, None], target * weights[:, None])
        weights = 1.0 / np.sqrt(np.maximum(np.linalg.norm(target - design @ found, axis=1), 1.0))
    return found


def _least_squares(design: FloatArray, target: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(design.reshape(-1, design.shape[2]), target.ravel(), rcond=None)[0])


def _mirror_modes(mirror: Mirror, panels: Sequence[PanelId]) -> FloatArray:
    """Piston, tip and tilt of the panels per motion of the mirror, (3n, k), without those that move no panel.

    An offset along the normals, a shift, a turn, and an expansion of the figure.
    """
    places = _CELL_M * np.array([(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    rows = []
    centre = np.mean([mirror.world_from_deck(mirror.panel(panel).origin) for panel in panels], axis=0)
    for panel in panels:
        body = mirror.panel(panel)
        deck, normals = surface_under(mirror, panel, places.tolist())
        world = np.array([mirror.rotate_world_from_deck((x, y, z)) for x, y, z in normals.tolist()])
        away = np.array([mirror.world_from_deck(mirror.surface.point(x, y)) for x, y in deck.tolist()]) - centre
        lever = normals @ np.array(body.axes[2])
        moved = np.column_stack([np.ones(len(away)), world, np.cross(away, world), np.sum(away * world, axis=1)])
        rows.append(np.linalg.lstsq(lever[:, None] * rigid(places), moved, rcond=None)[0])
    modes = np.array(rows)
    # Slopes as displacements of the corners, so that all have one unit.
    unit = np.tile([1.0, _CELL_M, _CELL_M], len(panels))[:, None]
    axes, sizes, _ = np.linalg.svd(unit * modes.reshape(-1, modes.shape[2]), full_matrices=False)
    return np.asarray(axes[:, sizes > _LEAST_MODE * sizes[0]] / unit)
