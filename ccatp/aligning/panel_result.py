"""Pure. The alignment of one panel, from its deviations."""

from dataclasses import dataclass
from typing import NamedTuple

from scipy.special import chdtrc

from ccatp.aligning.deviations import Deviations
from ccatp.aligning.modes import BoolArray, FloatArray, ModeFit, Modes, adjustable, fit_modes, gram, quadratic, rigid
from ccatp.aligning.moves import Moves, adjuster_moves, adjuster_places
from ccatp.aligning.outliers import Explanation
from ccatp.aligning.wavefront import PanelWavefront, half_size_m, panel_wavefront
from ccatp.mirror.mirror import Mirror
from ccatp.samples import PanelId, PointId

SHAPE = slice(3, 6)


class Shape(NamedTuple):
    """Curvatures of the displacement, D_xx, D_xy, D_yy.

    Attributes:
        values_1_m, sigma_1_m: curvatures and standard deviations, shape (3,).
        gain: chi-square of the rigid fit minus that of the fit with curvatures.
        probability: that noise alone gains as much.
        chi2, dof: of the fit with curvatures.
        is_significant: the panel is bent beyond what noise explains.
    """

    values_1_m: FloatArray
    sigma_1_m: FloatArray
    gain: float
    probability: float
    chi2: float
    dof: int
    is_significant: bool


class Plan(NamedTuple):
    """Moves of the adjusters and what they make of the panel's half-wavefront error."""

    moves: Moves
    wavefront: PanelWavefront


@dataclass(frozen=True, slots=True, eq=False)
class PanelResult:
    """How a panel lies.

    Piston, tip and tilt are those of the rigid fit, also where the panel is bent: they are what the adjusters can take
    away without bending the panel, and half as uncertain as beside three curvatures.

    Attributes:
        panel: which.
        deviations: of all its measured points.
        is_kept: points that count, shape (k,); the others are outliers.
        cos_i: cosine of the angle of incidence.
        fit: piston (m), tip, tilt (rad).
        shape: curvatures; None with fewer points than it takes.
        adjusters: their names, in the order of the moves.
        rigid: moves on a plane.
        bending: moves that take twist and bowl away, too; None with fewer points than it takes.
    """

    panel: PanelId
    deviations: Deviations
    is_kept: BoolArray
    cos_i: float
    fit: ModeFit
    shape: Shape | None
    adjusters: tuple[str, ...]
    rigid: Plan
    bending: Plan | None

    @property
    def outliers(self) -> tuple[PointId, ...]:
        """Points that were left out."""
        return tuple(p for p, kept in zip(self.deviations.points, self.is_kept, strict=True) if not kept)

    @property
    def probability(self) -> float:
        """That the points' uncertainty alone gives what the chosen model leaves, or more."""
        found = self.shape if self.shape is not None and self.shape.is_significant else self.fit
        return float(chdtrc(found.dof, found.chi2)) if found.dof > 0 else 1.0

    @property
    def model_dof(self) -> int:
        """Degrees of freedom that the chosen model leaves."""
        return self.shape.dof if self.shape is not None and self.shape.is_significant else self.fit.dof


def panel_result(
    mirror: Mirror, panel: PanelId, deviations: Deviations, explanation: Explanation, cos_i: float
) -> PanelResult | None:
    """Fit a panel; None where its points do not determine piston, tip and tilt.

    Args:
        mirror: the mirror.
        panel: the panel.
        deviations: its measured points.
        explanation: which of them count.
        cos_i: cosine of the angle of incidence.
    """
    kept = explanation.is_kept
    places, lever = deviations.places_m[kept], deviations.lever[kept, None]
    values, sigmas = deviations.values_m[kept], deviations.sigmas_m[kept]
    fit = fit_modes(lever * rigid(places), values, sigmas)
    if fit is None:
        return None
    body = mirror.panel(panel)
    names, adjusters = adjuster_places(mirror, panel)

    def plan(found: ModeFit, modes: Modes) -> Plan:
        wavefront = panel_wavefront(body, cos_i, found, gram(modes, half_size_m(body)), sigmas)
        return Plan(adjuster_moves(found, modes, adjusters), wavefront)

    bent = fit_modes(lever * adjustable(places), values, sigmas)
    full = fit_modes(lever * quadratic(places), values, sigmas)
    return PanelResult(
        panel=panel,
        deviations=deviations,
        is_kept=kept,
        cos_i=cos_i,
        fit=fit,
        shape=None if full is None else _shape(fit, full, is_significant=explanation.has_shape),
        adjusters=names,
        rigid=plan(fit, rigid),
        bending=None if bent is None else plan(bent, adjustable),
    )


def _shape(fit: ModeFit, full: ModeFit, *, is_significant: bool) -> Shape:
    gain = fit.chi2 - full.chi2
    chance = float(chdtrc(3, max(gain, 0.0)))
    return Shape(full.values[SHAPE], full.sigma[SHAPE], gain, chance, full.chi2, full.dof, is_significant)
