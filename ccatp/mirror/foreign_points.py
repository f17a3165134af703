"""Points that another instrument measured, as measured points of panels: frame, panel of each point, checks, sigmas."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from itertools import permutations, product
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtri, fdtrc

from ccatp.core import BoolArray, Fix, FloatArray, Measured, PanelId, PointId, Vector3
from ccatp.errors import UsageError
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.mirror_alignment import SurveyResult
from ccatp.mirror.point_file import OBSERVATORY_NAME, OUR_NAME
from ccatp.mirror.surface import ConvergenceError

Frame = Literal["world", "mirror", "telescope", "own"]
_ON_MIRROR_M = 0.02  # a panel or a target is never further from the surface
_SAME_PLACE_M = 0.003  # repeated readings of a target
_REPEATS = 3  # least number of repeated readings that show a scatter
_LEAST_MODE = 1e-3  # part of the largest mode from which a common one counts
_AXIS_SHIFT_M = 0.12  # between the optical frame and that of the azimuth axis, along the elevation axis
_FEW = 2  # points that may lie elsewhere, if the frame is right
_NAMED = 5  # points that a message names
_FRAME_RATIO = 10.0  # of residuals of the references without and with a mirrored axis, from which the frame is mirrored
_MOST_RESIDUAL_M = 1e-3  # rms in a coordinate of references that an instrument measures to hundredths of a millimetre
_TWICE = (1.8, 2.2)  # deviations over the target's offset if its sign is wrong
# The middle of all points is never further from the surface: panels differ from it by tenths of a millimetre.
_ON_SURFACE_M = 0.003
# Panels are off by tenths of a millimetre; heights of target nests differ by millimetres.
_OFF_HEIGHT_M = 0.001


class PointsError(UsageError):
    """Points that cannot be those of the mirror; the message says what seems to be wrong."""


class ForeignPoint(NamedTuple):
    """A reading in the world frame, m; ``label`` and ``line`` as in the file."""

    label: str
    line: int
    place_m: Vector3
    covariance_m2: FloatArray


class Fitted(NamedTuple):
    """World from the instrument's frame: rotation, shift, m; residuals of the references, m, with their labels.

    ``sigma_m``: of one coordinate, by the residuals.
    """

    rotation: FloatArray
    shift_m: FloatArray
    residuals_m: FloatArray
    labels: tuple[str, ...]
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


def fit_frame(own_m: FloatArray, world_m: FloatArray, labels: Sequence[str]) -> Fitted:
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
    if rms > _MOST_RESIDUAL_M:
        worst = int(np.argmax(np.linalg.norm(left, axis=1)))
        raise PointsError(
            f"the references do not fit the points of the file: residuals of {1e3 * rms:.3g} mm rms in a coordinate, "
            f"the largest at {labels[worst]}; check labels and units of both files"
        )
    dof = 3 * len(own_m) - 6
    sigma = float(np.sqrt(np.sum(left**2) / dof)) if dof > 0 else 0.0
    turned = a @ rotation.T
    design = np.vstack([np.hstack([_cross(one), np.eye(3)]) for one in turned])
    covariance = sigma**2 * np.linalg.inv(design.T @ design)
    return Fitted(rotation, target - rotation @ centre, left, tuple(labels), sigma, covariance, target)


def _cross(v: FloatArray) -> FloatArray:
    """Change of a turned vector per rotation vector, (3, 3)."""
    x, y, z = v
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])


def frame_errors(fitted: Fitted, places_m: FloatArray) -> FloatArray:
    """Errors that all points share by the fit of the frame, (k, 3, 6), per error of standard deviation 1."""
    values, axes = np.linalg.eigh(fitted.covariance)
    root = axes * np.sqrt(np.maximum(values, 0.0))
    return np.array([np.hstack([_cross(one), np.eye(3)]) @ root for one in places_m - fitted.centre_m])


def panel_of_label(label: str, mirror: Mirror, *, row_first: bool = False) -> PanelId | None:
    """The panel that a label names: ours, ``3/7`` or ``3/7/4``, or the observatory's ``12281``; None without a panel.

    The observatory's digits: telescope (also as ``01-01``), mirror, column, row, number; row before column with
    ``row_first``. Raises ``PointsError``: it is of the other mirror.
    """
    if (match := OUR_NAME.match(label)) is not None:
        panel = PanelId(int(match[1]), int(match[2]))
    elif (match := OBSERVATORY_NAME.match(label)) is not None:
        if mirror.name[-2:] in ("m1", "m2") and mirror.name[-1] != match[1]:
            raise PointsError(f"label {label} is of mirror {match[1]}, the mirror is {mirror.name}; give --mirror")
        first, second = int(match[2]), int(match[3])
        panel = PanelId(first, second) if row_first else PanelId(second, first)
    else:
        return None
    if panel not in mirror.panels:
        raise PointsError(
            f"label {label}: {mirror.name} has no panel in row {panel.row}, column {panel.col}; "
            "leave out labels that name none"
        )
    return panel


class Repeats(NamedTuple):
    """Repeated readings of targets, along the normal, m.

    ``readings``: beyond the first of each target. ``sigma_m``: of one reading, ``claimed_m``: as claimed. ``shift_m``:
    standard deviation that the first, second, ... readings of a panel share, 0 if noise may make it.
    """

    readings: int
    sigma_m: float
    claimed_m: float
    shift_m: float

    @property
    def excess(self) -> float:
        """Their variance over the claimed one, at least 1; 1 with few of them."""
        return max(1.0, (self.sigma_m / self.claimed_m) ** 2) if self.readings >= _REPEATS else 1.0


class OffHeight(NamedTuple):
    """Points of panels that lie ``off_m`` above the height that the target's offset gives, as by another nest.

    ``points``: those of panels of which others lie as they should; ``panels``: with all their points.
    """

    off_m: float
    panels: tuple[PanelId, ...]
    points: tuple[PointId, ...]


class Assigned(NamedTuple):
    """Measured points by panel, the label of each, and repeated readings; their mean is the point.

    ``by_position``: readings whose label names no panel. ``copies``: copies of others to the last digit,
    which count once. ``row_first``: names of the observatory have the row first.
    ``shifts`` (3, 1) of each point: the error of the mean that all points share by shifts between readings.
    ``off_height``: points too high or too low by millimetres, together if by the same. ``contradictions``: points whose
    readings contradict each other, with their range along the normal, m; each of these readings is measured on its own.
    ``readings``: of which a measured point is the mean.
    """

    measured: tuple[Measured, ...]
    labels: Mapping[PointId, str]
    by_position: int
    copies: int
    row_first: bool
    repeats: Repeats | None
    shifts: Mapping[PointId, FloatArray]
    off_height: tuple[OffHeight, ...]
    contradictions: Mapping[PointId, float]
    readings: Mapping[PointId, int]


class _Target(NamedTuple):
    """A target with its readings: rows of the file, places (k, 3), mean covariance of one, normal of the panel."""

    point: PointId
    rows: Sequence[int]
    places_m: FloatArray
    covariance_m2: FloatArray
    normal: FloatArray

    @property
    def along_m(self) -> FloatArray:
        """Readings along the normal without their mean, (k,)."""
        along = self.places_m @ self.normal
        return np.asarray(along - along.mean())

    @property
    def claimed_m2(self) -> float:
        """Claimed variance of a reading along the normal."""
        return float(self.normal @ self.covariance_m2 @ self.normal)


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
    off = int(far.sum())
    limit = 0.9 * len(world)
    if 2 * off < len(points) and off <= max(_FEW, len(points) - limit):
        # The others lie on the mirror: the frame is right.
        names = ", ".join(one.label or f"line {one.line}" for one, is_off in zip(points, far, strict=True) if is_off)
        which = names if off <= _NAMED else "the first of them"
        return (
            f"{where}: {off} of {len(points)} points lie{'s' if off == 1 else ''} elsewhere ({which}); correct these "
            "lines, or put # before them"
        )
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
    return f"{where}: {off} of {len(points)} points lie elsewhere; check --mirror, --frame and the unit"


def assign(mirror: Mirror, points: Sequence[ForeignPoint], offset_m: float, false_alarm: float) -> Assigned:
    """Points as measured points of their panels, by label or position; readings that agree become one point."""
    feet = check_on_mirror(mirror, points, offset_m)
    there = [mirror.grid.nearest_panel(x, y) for x, y, _ in feet.tolist()]
    named, row_first = _named(mirror, points, there)
    by_panel: dict[PanelId, list[int]] = defaultdict(list)
    for at, panel in enumerate(there):
        by_panel[panel].append(at)
    targets, copies = list[_Target](), 0
    for panel, rows in sorted(by_panel.items()):
        own = {points[at].place_m: at for at in reversed(rows)}
        copies += len(rows) - len(own)
        normal = np.array(mirror.rotate_world_from_deck(mirror.panel(panel).axes[2]))
        groups = _targets(points, sorted(own.values()))
        for number, same in zip(_numbers(points, groups), groups, strict=True):
            places = np.array([points[at].place_m for at in same])
            covariance = np.mean([points[at].covariance_m2 for at in same], axis=0)
            targets.append(_Target(PointId(panel.row, panel.col, number), same, places, covariance, normal))
    contradictions = _contradictions(targets, false_alarm)
    repeats = _repeats([one for one in targets if one.point not in contradictions], false_alarm)
    shift_m = 0.0 if repeats is None else repeats.shift_m
    measured, shifts, readings = list[Measured](), dict[PointId, FloatArray](), dict[PointId, int]()
    for one in targets:
        parts = [[k] for k in range(len(one.rows))] if one.point in contradictions else [[*range(len(one.rows))]]
        readings[one.point] = len(parts[0])
        for part in parts:
            x, y, z = one.places_m[part].mean(axis=0).tolist()
            covariance = tuple((one.covariance_m2 / len(part)).ravel().tolist())
            fix = Fix(float(points[one.rows[part[0]]].line), (x, y, z), covariance, 0.0, (), 0.0)
            measured.append(Measured(one.point, fix))
        if shift_m:
            shifts[one.point] = shift_m / np.sqrt(len(parts[0])) * one.normal[:, None]
    return Assigned(
        tuple(measured),
        {one.point: points[one.rows[0]].label for one in targets},
        by_position=sum(panel is None for panel in named),
        copies=copies,
        row_first=row_first,
        repeats=repeats,
        shifts=shifts,
        off_height=_off_height({one.point: float(np.mean(feet[one.rows, 2])) - offset_m for one in targets}),
        contradictions=contradictions,
        readings=readings,
    )


def _off_height(above_m: Mapping[PointId, float]) -> tuple[OffHeight, ...]:
    """Points that are too high or too low, in groups of about the same height."""
    off = sorted((value, point) for point, value in above_m.items() if abs(value) > _OFF_HEIGHT_M)
    groups = list[list[tuple[float, PointId]]]()
    for value, point in off:
        if groups and value - groups[-1][-1][0] < _OFF_HEIGHT_M and value * groups[-1][-1][0] > 0.0:
            groups[-1].append((value, point))
        else:
            groups.append([(value, point)])
    sizes = Counter(point.panel for point in above_m)
    found = []
    for group in groups:
        points = sorted(point for _, point in group)
        own = Counter(point.panel for point in points)
        panels = tuple(panel for panel in own if own[panel] == sizes[panel])
        others = tuple(point for point in points if point.panel not in panels)
        found.append(OffHeight(float(np.median([value for value, _ in group])), panels, others))
    return tuple(found)


def _named(
    mirror: Mirror, points: Sequence[ForeignPoint], there: Sequence[PanelId]
) -> tuple[list[PanelId | None], bool]:
    """The panels that the labels name, and whether the observatory's names have the row first.

    Both orders are in use, and the places tell which one it is. Raises ``PointsError``: a label names another panel
    than the one on which its point lies.
    """
    problems = list[PointsError]()
    for row_first in (False, True):
        try:
            named = [panel_of_label(one.label, mirror, row_first=row_first) for one in points]
        except PointsError as error:
            problems.append(error)
            continue
        wrong = [
            (at, panel, other)
            for at, (panel, other) in enumerate(zip(named, there, strict=True))
            if panel not in (None, other)
        ]
        if not wrong:
            return named, row_first
        problems.append(PointsError(_why_elsewhere(points, wrong, len(points))))
    raise problems[0]


def _of_panels(targets: Sequence[_Target]) -> list[list[_Target]]:
    """Targets with the same number of repeated readings on a panel together."""
    found = defaultdict[tuple[PanelId, int], list[_Target]](list)
    for one in targets:
        if len(one.rows) > 1:
            found[one.point.panel, len(one.rows)].append(one)
    return [*found.values()]


def _contradictions(targets: Sequence[_Target], false_alarm: float) -> dict[PointId, float]:
    """Targets whose readings differ by more than noise makes them, with the range along the normal, m.

    Shifts of all readings of a panel from one to the next are none. If most targets are repeated, their median says
    how much readings scatter. If few are, they may have been repeated because they seemed wrong, and do not say it.
    """
    left = dict[PointId, FloatArray]()
    for some in _of_panels(targets):
        table = np.array([one.along_m for one in some])
        if len(table) >= _REPEATS:
            table -= np.median(table, axis=0)
        left |= {one.point: row for one, row in zip(some, table, strict=True)}
    repeated = [one for one in targets if one.point in left]
    variance = 1.0
    if len(repeated) >= max(_REPEATS, len(targets) / 2):
        squares = np.array([np.sum((left[one.point] - left[one.point].mean()) ** 2) for one in repeated])
        usual = np.array([one.claimed_m2 * chdtri(len(one.rows) - 1, 0.5) for one in repeated])
        variance = max(1.0, float(np.median(squares / usual)))
    pairs = sum(len(one.rows) - 1 for one in repeated)
    limit = variance * float(chdtri(1, false_alarm / max(pairs, 1)))
    return {
        one.point: float(np.ptp(one.along_m))
        for one in repeated
        if np.ptp(left[one.point]) ** 2 > 2.0 * limit * one.claimed_m2
    }


def _repeats(targets: Sequence[_Target], false_alarm: float) -> Repeats | None:
    """Analysis of variance of the repeated readings of each panel's targets, m, by target and order of reading.

    A night or an instrument that differs from the other shifts all its readings alike: their mean is not better by
    the number of the points. None without repeated readings.
    """
    claimed = [one.claimed_m2 for one in targets for _ in one.rows[1:]]
    if not claimed:
        return None
    own = np.zeros(2)  # sum of squares, degrees of freedom
    shifts, sizes = np.zeros(2), list[int]()
    for some in _of_panels(targets):
        table = np.array([one.along_m for one in some])
        count, means = table.shape[1], table.mean(axis=0)
        own += float(np.sum((table - means) ** 2)), (count - 1) * (len(table) - 1)
        shifts += len(table) * float(means @ means), count - 1
        sizes += [len(table)] * (count - 1)
    total, dof = own + shifts
    if own[1] > 0 and own[0] > 0.0:
        variances = own[0] / own[1], shifts[0] / shifts[1]
        if float(fdtrc(shifts[1], own[1], variances[1] / variances[0])) < false_alarm:
            shift_m = float(np.sqrt((variances[1] - variances[0]) / np.mean(sizes)))
            return Repeats(len(claimed), float(np.sqrt(variances[0])), float(np.sqrt(np.mean(claimed))), shift_m)
    return Repeats(len(claimed), float(np.sqrt(total / dof)), float(np.sqrt(np.mean(claimed))), 0.0)


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
        match = OUR_NAME.match(points[same[0]].label)
        if match is None or match[3] is None or not match[3].isdecimal():
            return [*range(1, len(targets) + 1)]
        first = points[same[0]]
        if int(match[3]) in found:
            raise PointsError(f"line {first.line}: {first.label} names two points that are far from each other")
        found[int(match[3])] = first.label
    return [*found]


class CommonFigure(NamedTuple):
    """What all panels have in common: a shift, a turn, an expansion of the figure, or an offset along the normal, m.

    ``mean_m``: mean of the pistons; ``common_m`` and ``own_m``: rms of what they have in common, and of the rest.
    """

    mean_m: float
    common_m: float
    own_m: float


def common_figure(mirror: Mirror, result: SurveyResult, false_alarm: float) -> CommonFigure | None:
    """What the panels have in common, by their pistons; None if panels that lie anyhow may have it.

    An error of the frame, of the scale, or of the target's offset moves all panels so. A few panels have only a mean.
    """
    pistons = np.array([panel.fit.values[0] for panel in result.panels])
    bodies = [mirror.panel(panel.panel) for panel in result.panels]
    normals = np.array([mirror.rotate_world_from_deck(body.axes[2]) for body in bodies]).reshape(-1, 3)
    places = np.array([mirror.world_from_deck(body.origin) for body in bodies]).reshape(-1, 3)
    ones = np.ones((len(pistons), 1))
    expansion = np.sum(places * normals, axis=1)[:, None]
    modes = np.hstack([ones, normals, np.cross(places, normals), expansion])
    for some in (modes, ones):
        axes, sizes, _ = np.linalg.svd(some, full_matrices=False)
        axes = axes[:, sizes > _LEAST_MODE * sizes.max(initial=0.0)]
        rest = len(pistons) - axes.shape[1]
        if rest < max(axes.shape[1], 1):
            continue
        common = axes @ (axes.T @ pistons)
        squares = float(common @ common), float(np.sum((pistons - common) ** 2))
        ratio = squares[0] / axes.shape[1] / max(squares[1] / rest, 1e-18)
        if float(fdtrc(axes.shape[1], rest, ratio)) < false_alarm:
            return CommonFigure(float(pistons.mean()), *(float(np.sqrt(one / len(pistons))) for one in squares))
    return None
