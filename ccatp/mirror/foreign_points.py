"""Points that another instrument measured, as measured points of panels: frame, panel of each point, checks, sigmas."""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import permutations, product
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.core import BoolArray, Fix, FloatArray, Measured, PanelId, PointId, Vector3
from ccatp.errors import UsageError
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.mirror_alignment import SurveyResult
from ccatp.mirror.surface import ConvergenceError

Frame = Literal["world", "mirror", "telescope", "own"]
_ON_MIRROR_M = 0.02  # a panel or a target is never further from the surface
_SAME_PLACE_M = 0.003  # repeated readings of a target
_AXIS_SHIFT_M = 0.12  # between the optical frame and that of the azimuth axis, along the elevation axis
_FRAME_RATIO = 10.0  # of residuals of the references without and with a mirrored axis, from which the frame is mirrored
_TWICE = (1.8, 2.2)  # deviations over the target's offset if its sign is wrong
# The middle of all points is never further from the surface: panels differ from it by tenths of a millimetre.
_ON_SURFACE_M = 0.003


class PointsError(UsageError):
    """Points that cannot be those of the mirror; the message says what seems to be wrong."""


class ForeignPoint(NamedTuple):
    """A reading in the world frame, m; ``label`` and ``line`` as in the file."""

    label: str
    line: int
    place_m: Vector3
    covariance_m2: FloatArray


class Fitted(NamedTuple):
    """World from the instrument's frame: rotation, shift, residuals of the references, m, sigma of one coordinate."""

    rotation: FloatArray
    shift_m: FloatArray
    residuals_m: FloatArray
    sigma_m: float
    covariance: FloatArray  # (6, 6) of a small rotation about the references' centre, and of the shift
    centre_m: FloatArray


def world_from(frame: Frame, mirror: Mirror, places_m: FloatArray) -> FloatArray:
    """World coordinates of points (k, 3) of a named frame."""
    if frame == "mirror":
        return np.array([mirror.world_from_mirror((x, y, z)) for x, y, z in places_m.tolist()]).reshape(-1, 3)
    if frame == "telescope":
        # The manufacturer's global frame: x along the elevation axis from the azimuth axis, z up.
        x, y, z = places_m.T
        return np.column_stack([y, x + _AXIS_SHIFT_M, -z])
    return places_m


def fit_frame(own_m: FloatArray, world_m: FloatArray) -> Fitted:
    """The rigid motion of reference points (k, 3) by least squares (Arun 1987); raises ``PointsError``."""
    if len(own_m) < 3:
        raise PointsError(f"{len(own_m)} reference points have the label of a point of the file; it takes three")
    centre, target = own_m.mean(axis=0), world_m.mean(axis=0)
    a, b = own_m - centre, world_m - target
    spread = np.linalg.svd(a, compute_uv=False)
    if spread[1] < 1e-3 * spread[0]:
        raise PointsError("the reference points lie on one line: the turn about it is open; give one beside it")
    u, _, vt = np.linalg.svd(a.T @ b)
    sign = float(np.sign(np.linalg.det(vt.T @ u.T)))
    rotation = vt.T @ np.diag([1.0, 1.0, sign]) @ u.T
    left = b - a @ rotation.T
    rms = float(np.sqrt(np.mean(left**2)))
    if sign < 0.0 and spread[2] > 1e-6 * spread[0]:
        mirrored = b - a @ u @ vt
        if rms > _FRAME_RATIO * max(float(np.sqrt(np.mean(mirrored**2))), 1e-9):
            raise PointsError("the instrument's frame is left-handed: the references fit with one axis turned round")
    dof = 3 * len(own_m) - 6
    sigma = float(np.sqrt(np.sum(left**2) / dof)) if dof > 0 else 0.0
    turned = a @ rotation.T
    design = np.vstack([np.hstack([_cross(one), np.eye(3)]) for one in turned])
    covariance = sigma**2 * np.linalg.inv(design.T @ design)
    return Fitted(rotation, target - rotation @ centre, left, sigma, covariance, target)


def _cross(v: FloatArray) -> FloatArray:
    """Change of a turned vector per rotation vector, (3, 3)."""
    x, y, z = v
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])


def frame_errors(fitted: Fitted, places_m: FloatArray) -> FloatArray:
    """Errors that all points share by the fit of the frame, (k, 3, 6), per error of standard deviation 1."""
    values, axes = np.linalg.eigh(fitted.covariance)
    root = axes * np.sqrt(np.maximum(values, 0.0))
    return np.array([np.hstack([_cross(one), np.eye(3)]) @ root for one in places_m - fitted.centre_m])


_OURS = re.compile(r"(\d{1,2})[/-](\d{1,2})(?:[/-](\w+))?$")
_OBSERVATORY = re.compile(r"(\d)([12])(\d)(\d)(\d)(?:\D.*)?$")


def panel_of_label(label: str, mirror: Mirror) -> PanelId | None:
    """The panel that a label names: ours, ``3/7`` or ``3/7/4``, or the observatory's ``12281``; None without a panel.

    The observatory's digits: telescope, mirror, column, row, number. Raises ``PointsError``: it is of the other mirror.
    """
    if (match := _OURS.match(label)) is not None:
        panel = PanelId(int(match[1]), int(match[2]))
    elif (match := _OBSERVATORY.match(label)) is not None:
        if mirror.name[-2:] in ("m1", "m2") and mirror.name[-1] != match[2]:
            raise PointsError(f"label {label} is of mirror {match[2]}, the mirror is {mirror.name}; give --mirror")
        panel = PanelId(int(match[4]), int(match[3]))
    else:
        return None
    if panel not in mirror.panels:
        raise PointsError(f"label {label}: {mirror.name} has no panel in row {panel.row}, column {panel.col}")
    return panel


class Assigned(NamedTuple):
    """Measured points by panel, the point of each label, and how much repeated readings scatter.

    ``by_position``: readings whose label names no panel.
    """

    measured: tuple[Measured, ...]
    labels: Mapping[PointId, str]
    by_position: int
    repeat_sigma_m: float | None
    claimed_sigma_m: float
    repeats: int


def check_on_mirror(mirror: Mirror, points: Sequence[ForeignPoint], offset_m: float) -> FloatArray:
    """Deck coordinates and heights over the surface (k, 3); raises ``PointsError``, which says what seems wrong."""
    world = np.array([one.place_m for one in points])
    heights = _heights(mirror, world)
    far = ~(np.abs(heights[:, 2]) < _ON_MIRROR_M + abs(offset_m))
    if far.any():
        raise PointsError(_why_far(mirror, points, world, far, offset_m))
    middle = float(np.median(heights[:, 2]))
    if abs(offset_m) > 1e-3 and _TWICE[0] < (offset_m - middle) / offset_m < _TWICE[1]:
        raise PointsError(
            f"the points lie {1e3 * abs(middle):.2f} mm on the other side of the surface: the target's offset of "
            f"{1e3 * offset_m:+.2f} mm seems to have the wrong sign"
        )
    if abs(middle - offset_m) > _ON_SURFACE_M:
        raise PointsError(
            f"the points lie {1e3 * middle:+.2f} mm from the surface, the target's offset is {1e3 * offset_m:+.2f} mm; "
            "give --offset-mm"
        )
    return heights


def _heights(mirror: Mirror, world: FloatArray) -> FloatArray:
    rows = []
    for x, y, z in world.tolist():
        try:
            rows.append(mirror.foot_of_puck((x, y, z), 0.0))
        except ConvergenceError:
            rows.append((np.nan, np.nan, np.inf))
    return np.array(rows)


def _why_far(mirror: Mirror, points: Sequence[ForeignPoint], world: FloatArray, far: BoolArray, offset_m: float) -> str:
    first = points[int(np.argmax(far))]
    where = f"line {first.line} ({first.label or 'no label'}) is not on {mirror.name}"
    for factor, text in ((1e3, "metres"), (25.4, "inches"), (1e-3, "thousandths of the unit given")):
        scaled = np.abs(_heights(mirror, world[far] * factor)[:, 2]) < _ON_MIRROR_M + abs(offset_m)
        if scaled.all():
            if far.all():
                return f"{where}: the file is in {text}; {'convert it to mm' if factor == 25.4 else 'give --unit'}"
            return f"{where}: mixed units, {int(far.sum())} of {len(points)} points are in {text}"
    limit = 0.9 * len(world)
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            if order == (0, 1, 2) and signs == (1.0, 1.0, 1.0):
                continue
            tried = world[:, order] * signs
            if np.sum(np.abs(_heights(mirror, tried)[:, 2]) < _ON_MIRROR_M + abs(offset_m)) >= limit:
                axes = ", ".join(
                    ("-" if sign < 0 else "") + "xyz"[axis] for axis, sign in zip(order, signs, strict=True)
                )
                is_left = np.linalg.det(np.eye(3)[list(order)] * np.array(signs)) < 0
                kind = "a left-handed frame, or swapped axes" if is_left else "turned axes"
                return f"{where}: with ({axes}) in place of (x, y, z) the points lie on it: {kind}"
    off = int(far.sum())
    return f"{where}: {off} of {len(points)} points lie elsewhere; check --mirror, --frame and the unit"


def assign(mirror: Mirror, points: Sequence[ForeignPoint], offset_m: float) -> Assigned:
    """Points as measured points of their panels, by label or position; repeated readings become one point."""
    feet = check_on_mirror(mirror, points, offset_m)
    by_panel: dict[PanelId, list[int]] = defaultdict(list)
    wrong: list[tuple[int, PanelId, PanelId]] = []
    by_position = 0
    for at, (one, (x, y, _)) in enumerate(zip(points, feet.tolist(), strict=True)):
        there = mirror.grid.nearest_panel(x, y)
        named = panel_of_label(one.label, mirror)
        by_position += named is None
        if named is not None and named != there:
            wrong.append((at, named, there))
        by_panel[there if named is None else named].append(at)
    if wrong:
        raise PointsError(_why_elsewhere(points, wrong, len(points)))
    measured, labels = list[Measured](), {}
    squares = claimed = 0.0
    repeats = 0
    for panel, rows in sorted(by_panel.items()):
        targets = _targets(points, rows)
        for number, same in zip(_numbers(points, targets), targets, strict=True):
            places = np.array([points[at].place_m for at in same])
            covariance = np.mean([points[at].covariance_m2 for at in same], axis=0)
            normal = np.array(mirror.rotate_world_from_deck(mirror.panel(panel).axes[2]))
            along = places @ normal
            squares += float(np.sum((along - along.mean()) ** 2))
            claimed += (len(same) - 1) * float(normal @ covariance @ normal)
            repeats += len(same) - 1
            point = PointId(panel.row, panel.col, number)
            x, y, z = places.mean(axis=0).tolist()
            fix = Fix(
                float(points[same[0]].line), (x, y, z), tuple((covariance / len(same)).ravel().tolist()), 0.0, (), 0.0
            )
            measured.append(Measured(point, fix))
            labels[point] = points[same[0]].label
    return Assigned(
        tuple(measured),
        labels,
        by_position,
        repeat_sigma_m=float(np.sqrt(squares / repeats)) if repeats else None,
        claimed_sigma_m=float(np.sqrt(claimed / repeats)) if repeats else 0.0,
        repeats=repeats,
    )


def _why_elsewhere(points: Sequence[ForeignPoint], wrong: Sequence[tuple[int, PanelId, PanelId]], total: int) -> str:
    at, named, there = wrong[0]
    one = points[at]
    what = f"line {one.line}: {one.label} names panel {named.row}/{named.col}, and lies on {there.row}/{there.col}"
    if len(wrong) > 0.3 * total:
        return f"{what}, as {len(wrong)} of {total} points do: a left-handed frame, swapped axes, or row and column"
    others = {points[k].label for k, *_ in wrong}
    return f"{what}: {len(wrong)} points; two panels have the same name ({', '.join(sorted(others)[:3])})"


def _targets(points: Sequence[ForeignPoint], rows: Sequence[int]) -> list[list[int]]:
    """Rows of repeated readings together."""
    groups: list[list[int]] = []
    for at in rows:
        place = np.array(points[at].place_m)
        for group in groups:
            if np.linalg.norm(np.array(points[group[0]].place_m) - place) < _SAME_PLACE_M:
                group.append(at)
                break
        else:
            groups.append([at])
    return groups


def _numbers(points: Sequence[ForeignPoint], targets: Sequence[Sequence[int]]) -> list[int]:
    """The numbers of a panel's targets: those of labels like ``3/7/4``, otherwise in the order of the file."""
    found = dict[int, str]()
    for same in targets:
        match = _OURS.match(points[same[0]].label)
        if match is None or match[3] is None or not match[3].isdecimal():
            return [*range(1, len(targets) + 1)]
        first = points[same[0]]
        if int(match[3]) in found:
            raise PointsError(f"line {first.line}: {first.label} names two points that are far from each other")
        found[int(match[3])] = first.label
    return [*found]


def variance_factor(result: SurveyResult, assigned: Assigned) -> float:
    """Variance that the data show over the claimed one, at least 1: of panels' residuals, and of repeated readings."""
    ratios = [panel.fit.chi2 / float(chdtri(panel.fit.dof, 0.5)) for panel in result.panels if panel.fit.dof > 0]
    by_panels = float(np.median(ratios)) if ratios else 1.0
    by_repeats = 1.0
    if assigned.repeat_sigma_m is not None and assigned.repeats >= 3:
        by_repeats = (assigned.repeat_sigma_m / assigned.claimed_sigma_m) ** 2
    return max(1.0, by_panels, by_repeats)
