"""The alignment of a whole mirror from its fixes, and its comparison with the simulated misalignment."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.special import betainc, chdtrc, chdtri

from ccatp.config.models import AlignConfig, Config
from ccatp.core import UNRELIABLE, FloatArray, Measured, PanelId, PointId, Vector3
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.network_points import CalibratedSurveys, calibrate_surveys
from ccatp.mirror.panel_alignment import (
    MirrorWavefront,
    PanelResult,
    all_points,
    cos_incidence,
    mirror_wavefront,
    panel_result,
)
from ccatp.mirror.panel_explanations import Explanation, Prices, prices
from ccatp.mirror.panel_modes import Deviations, deviations_of
from ccatp.mirror.surface import ConvergenceError

ENOUGH = 3  # points of a plane
_NAMED = 12  # largest number of unreliable points that are named
_FEW = 3  # panels, of which most may have outliers
_MOST_EXPLANATIONS = 4  # that a warning names
_MOST_PASSES = 5  # of the fit of all panels with larger sigmas


class Undetermined(NamedTuple):
    """A panel whose fixes do not determine its alignment; ``why``: end of its line in the report."""

    panel: PanelId
    points: int
    why: str


@dataclass(frozen=True, slots=True, eq=False)
class SurveyResult:
    """Alignment of the panels of a mirror, sorted by row and column.

    ``wavefront``: with rigid moves (None without a fitted panel); ``wavefront_bent``: with moves that bend the panels
    (None if a panel has too few points for them); ``price``: of outliers and shapes. ``sigma_factor``: by which the
    sigmas of all points are multiplied, as they scatter about the panels by more than they are uncertain.
    """

    panels: tuple[PanelResult, ...]
    undetermined: tuple[Undetermined, ...]
    wavefront: MirrorWavefront | None
    wavefront_bent: MirrorWavefront | None
    price: Prices
    sigma_factor: float
    warnings: tuple[str, ...]


class AlignedSurvey(NamedTuple):
    """Alignment of a survey, and the network by which its fixes were computed again; None without lengths."""

    result: SurveyResult
    network: CalibratedSurveys | None


def align_survey(
    cfg: Config,
    mirror: Mirror,
    measured: Sequence[Measured],
    planned: Iterable[PanelId],
    earlier: Sequence[Sequence[Measured]] = (),
) -> AlignedSurvey:
    """Adjust the laser network to all lengths and fit the panels.

    ``earlier``: surveys of the same night before this one, in the order of measuring.
    """
    network = calibrate_surveys(mirror, cfg.etalon, cfg.align, [*earlier, measured])
    common = None
    if network is not None:
        own = network.surveys[-1]
        measured, common = own.measured, own.common.of_point
    result = survey_result(mirror, cfg.align, cfg.robot.puck_height_m, measured, planned, common)
    return AlignedSurvey(result, network)


def survey_result(
    mirror: Mirror,
    cfg: AlignConfig,
    puck_height_m: float,
    measured: Iterable[Measured],
    planned: Iterable[PanelId],
    common: Mapping[PointId, FloatArray] | None = None,
    readings: Mapping[PointId, int] | None = None,
) -> SurveyResult:
    """Fit every panel; a ``planned`` panel without enough fixes is listed as undetermined.

    ``common``: errors of the points that panels share, as of ``network_points.CommonErrors``. ``readings``: of which a
    fix is the mean.
    """
    warnings: list[str] = []
    by_panel: dict[PanelId, list[Measured]] = {panel: [] for panel in sorted(set(planned))}
    for one in measured:
        by_panel.setdefault(one.point.panel, []).append(one)
    usable: dict[PanelId, Deviations] = {}
    undetermined = []
    for panel, some in by_panel.items():
        deviations, why = _deviations(mirror, cfg, puck_height_m, panel, some, common, readings)
        if deviations is None:
            undetermined.append(Undetermined(panel, len(some), why))
        else:
            usable[panel] = deviations
    light = cfg.light.get(mirror.name)
    if light is None:
        warnings.append(f"no light is configured for {mirror.name} (align.light): its angle of incidence is taken as 0")
    warnings += _unreliable(by_panel.values())
    price = prices(cfg.false_alarm, sum(len(found.points) for found in usable.values()), len(usable))
    cosines = {panel: cos_incidence(mirror, panel, light) for panel in usable}

    def fitted(variance: float) -> dict[PanelId, PanelResult | None]:
        return {
            panel: panel_result(mirror, panel, found.scaled(sqrt(variance)), price, cosines[panel])
            for panel, found in usable.items()
        }

    variance, results = 1.0, fitted(1.0)
    for _ in range(_MOST_PASSES):
        # With larger sigmas fewer points are outliers, and the scatter of the others is larger.
        more = excess_variance([result for result in results.values() if result is not None], cfg.false_alarm)
        if more == 1.0:
            break
        variance *= more
        results = fitted(variance)
    panels = [result for result in results.values() if result is not None]
    undetermined += [
        Undetermined(panel, len(usable[panel].points), "its points lie on one line")
        for panel, result in results.items()
        if result is None
    ]
    if variance > 1.0:
        warnings.append(
            f"the points scatter about the panels {sqrt(variance):.2f} times as much as they are uncertain: their "
            "standard deviations are multiplied by it"
        )
    warnings += [line for panel in panels for line in _remarks(panel)]
    bent = [panel.bending.wavefront for panel in panels if panel.bending is not None]
    return SurveyResult(
        panels=tuple(panels),
        undetermined=tuple(sorted(undetermined)),
        wavefront=mirror_wavefront([panel.rigid.wavefront for panel in panels]),
        wavefront_bent=mirror_wavefront(bent) if len(bent) == len(panels) else None,
        price=price,
        sigma_factor=sqrt(variance),
        warnings=tuple(warnings),
    )


def excess_variance(panels: Sequence[PanelResult], false_alarm: float) -> float:
    """Variance of the points about the panels over the stated one, by the median panel; 1 if noise may make it.

    If most panels have outliers, their points are none: all are counted.
    """
    are_outliers_rare = len(panels) < _FEW or 2 * sum(bool(panel.outliers) for panel in panels) <= len(panels)
    models = [panel.model if are_outliers_rare else all_points(panel.deviations) for panel in panels]
    found = [(one.chi2, one.dof) for one in models if one is not None and one.dof > 0]
    if not found:
        return 1.0
    chi2, dof = np.array(found).T
    half = len(found) // 2 + 1
    chance = float(np.sort(chdtrc(dof, chi2))[half - 1])
    # The probability that so many of the panels have such a chance, or a smaller one, is a binomial one.
    if float(betainc(half, len(found) - half + 1, chance)) >= false_alarm:
        return 1.0
    return max(1.0, float(np.median(chi2 / chdtri(dof, 0.5))))


def _deviations(
    mirror: Mirror,
    cfg: AlignConfig,
    puck_height_m: float,
    panel: PanelId,
    measured: Sequence[Measured],
    common: Mapping[PointId, FloatArray] | None,
    readings: Mapping[PointId, int] | None,
) -> tuple[Deviations | None, str]:
    """Deviations that can be fitted, or None and the reason."""
    reliable = [one for one in measured if one.fix.metrology != UNRELIABLE]
    if len(reliable) < ENOUGH <= len(measured):
        return (
            None,
            f"the lengths of {len(measured) - len(reliable)} of its {len(measured)} points contradict each other",
        )
    measured = reliable
    if len(measured) < ENOUGH:
        return None, f"{len(measured)} of {ENOUGH} points that it takes"
    try:
        found = deviations_of(mirror, panel, measured, puck_height_m, cfg.point_floor_m, common, readings)
    except ConvergenceError as error:
        return None, f"a fix is far from the mirror: {error}"
    if not (found.sigmas_m > 0.0).all():
        return None, "a fix claims to be exact: its covariance is not positive"
    return found, ""


def _unreliable(by_panel: Iterable[Sequence[Measured]]) -> list[str]:
    """Points whose lengths contradict each other: they are no measurements, and their errors may be common to all."""
    points = [one.point for some in by_panel for one in some if one.fix.metrology == UNRELIABLE]
    if not points:
        return []
    names = ", ".join(f"{row}/{col}/{number}" for row, col, number in points[:_NAMED])
    more = f" and {len(points) - _NAMED} more" if len(points) > _NAMED else ""
    return [f"not used, their lengths contradict each other: {names}{more}; check the laser, measure them again"]


def _remarks(result: PanelResult) -> list[str]:
    where = f"panel {result.panel.row}/{result.panel.col}"
    lines = []
    if result.alternatives:
        every = [_explained(result, one) for one in (result.explained, *result.alternatives)]
        left = len(every) - _MOST_EXPLANATIONS
        *others, last = [*every[:_MOST_EXPLANATIONS], f"{left} others"] if left > 1 else every
        where_again = "/".join(map(str, result.deciding or ()))
        lines.append(
            f"{where}: its points do not decide between {', '.join(others)} and {last}; its moves are uncertain by the "
            f"difference; measure {where_again} again, which decides"
        )
    elif result.outliers:
        kept = {point for point, used in zip(result.deviations.points, result.is_kept, strict=True) if used}
        names = [
            f"{result.panel.row}/{result.panel.col}/{name}"
            for name, used in zip(result.deviations.names, result.is_kept, strict=True)
            if not used
        ]
        again = "; measure them again" if set(result.outliers) - kept else ""
        lines.append(f"{where}: not used, because they are outliers: {', '.join(names)}{again}")
    if result.sigma_factor > 1.0:
        lines.append(
            f"{where}: its points contradict each other by more than they are uncertain (chance "
            f"{result.probability:.1g} with {result.model.dof} degrees of freedom); its standard deviations are "
            f"multiplied by {result.sigma_factor:.1f}"
        )
    return lines


def joint_covariance(panels: Sequence[PanelResult], errors: slice = slice(None)) -> FloatArray:
    """Covariance of piston, tip and tilt of all panels, (3 panels, 3 panels); of ``errors`` among the common ones."""
    common = np.vstack([panel.fit.common[:, errors] for panel in panels])
    return np.asarray(block_diag(*(panel.fit.own_covariance for panel in panels)) + common @ common.T)


def _explained(result: PanelResult, one: Explanation) -> str:
    """An explanation in words: which points are wrong, and whether the panel is bent."""
    names = result.deviations.names
    wrong = " and ".join(name for name, kept in zip(names, one.is_kept, strict=True) if not kept)
    parts = ["a bent panel"] if one.has_shape else []
    return " with ".join([*parts, *([f"wrong points {wrong}"] if wrong else [])])


BAND = 0.99


class Comparison(NamedTuple):
    """Fitted minus simulated misalignment over all panels that could be fitted; tip and tilt together.

    ``chi2``: ``e^T C^-1 e`` with the three differences of all panels e and their covariance C. ``low`` and ``high``:
    its 99 % interval if the covariances are right.
    """

    panels: int
    piston_rms_m: float
    tilt_rms_rad: float
    chi2: float
    dof: int
    low: float
    high: float

    @property
    def agrees(self) -> bool:
        """Whether the chi-square lies in its interval."""
        return self.low <= self.chi2 <= self.high


def compare(panels: Sequence[PanelResult], injected: Mapping[PanelId, Vector3]) -> Comparison | None:
    """Compare with the simulated misalignment; None if no panel has both."""
    known = [panel for panel in panels if panel.panel in injected]
    if not known:
        return None
    errors = np.array([panel.fit.values - np.array(injected[panel.panel]) for panel in known])
    flat, dof = errors.ravel(), errors.size
    chi2 = float(flat @ np.linalg.solve(joint_covariance(known), flat))
    return Comparison(
        panels=len(known),
        piston_rms_m=float(np.sqrt(np.mean(errors[:, 0] ** 2))),
        tilt_rms_rad=float(np.sqrt(np.mean(errors[:, 1:] ** 2))),
        chi2=chi2,
        dof=dof,
        low=float(chdtri(dof, 0.5 + 0.5 * BAND)),
        high=float(chdtri(dof, 0.5 - 0.5 * BAND)),
    )
