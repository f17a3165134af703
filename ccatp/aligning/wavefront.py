"""Pure. Half-wavefront error of a mirror, before and after its adjusters are moved.

A surface that is off by d along its normal changes the path of a ray that meets it at the angle of incidence i by
``2 d cos(i)``, to first order in d; half of it, ``d cos(i)``, is the half-wavefront error. For a paraboloid in axial
light this is Ruze's effective tolerance (J. Ruze, Antenna tolerance theory - a review, Proc. IEEE 54 (1966) 633), as
cos(i) = 1 / sqrt(1 + (r/2f)^2) there. The root mean square is taken over the beam: a panel counts with its area times
cos(i).

For one panel, with the fitted coefficients c, their covariance C, and G the panel's mean of the products of the modes,

    before^2 = cos(i)^2 (c^T G c + u)        after^2 = cos(i)^2 (tr(C G) + u)

where u is the mean square of the residuals beyond what the uncertainty of the points explains (shape that the moves
cannot take away), and tr(C G) what the uncertain moves leave. Noise makes the u of a panel without shape negative as
often as positive, so the mean over the mirror is taken first, and cut off at zero then.
"""

from collections.abc import Iterable
from math import sqrt
from typing import NamedTuple

import numpy as np

from ccatp.aligning.modes import FloatArray, ModeFit
from ccatp.config.models import LightConfig
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panels import Panel
from ccatp.samples import PanelId


class PanelWavefront(NamedTuple):
    """One panel's part.

    Attributes:
        weight_m2: its area across the beam.
        fitted_m2: mean square of its half-wavefront error, as fitted.
        uncertain_m2: the same of what uncertain moves leave of it.
        unexplained_m2: u, as half-wavefront error; may be negative by chance.
        noise_m2: mean square of its points' uncertainty, as half-wavefront error.
        mean_m: mean of the half-wavefront error before.
    """

    weight_m2: float
    fitted_m2: float
    uncertain_m2: float
    unexplained_m2: float
    noise_m2: float
    mean_m: float


class MirrorWavefront(NamedTuple):
    """Root mean squares over all panels that could be fitted, m.

    Attributes:
        before_m: against the ideal surface.
        before_level_m: the same without its mean over the beam, a path that all light shares.
        after_m: predicted, once the adjusters have been moved.
        noise_m: of a single point: what a survey after the moves shows is this and ``after_m``, added in squares.
    """

    before_m: float
    before_level_m: float
    after_m: float
    noise_m: float


def cos_incidence(mirror: Mirror, panel: PanelId, light: LightConfig | None) -> float:
    """Cosine of the angle between a panel's normal and the light at its centre; 1 where the light is unknown."""
    if light is None:
        return 1.0
    body = mirror.panel(panel)
    # From the panel to where the rays meet, times the vergence: for parallel light the direction itself.
    direction = np.array(light.direction_world)
    direction /= np.linalg.norm(direction)
    offset = np.array(mirror.world_from_deck(body.origin)) - mirror.world_from_mirror((0.0, 0.0, 0.0))
    direction -= light.vergence_1_m * offset
    normal = np.array(mirror.rotate_world_from_deck(body.axes[2]))
    return float(abs(direction @ normal) / np.linalg.norm(direction))


def half_size_m(panel: Panel) -> tuple[float, float]:
    """Half a panel's size along its own x and y: its deck size over the cosines of the slopes."""
    return panel.half_x_m / panel.axes[0][0], panel.half_y_m / panel.axes[1][1]


def panel_wavefront(panel: Panel, cos_i: float, fit: ModeFit, gram: FloatArray, sigmas_m: FloatArray) -> PanelWavefront:
    """Half-wavefront error of one panel.

    Args:
        panel: the panel.
        cos_i: cosine of the angle of incidence.
        fit: its displacement in the modes that the adjusters take away.
        gram: mean of the products of these modes over the panel.
        sigmas_m: of the points that were fitted.
    """
    half_x, half_y = half_size_m(panel)
    square = cos_i * cos_i
    return PanelWavefront(
        weight_m2=4.0 * half_x * half_y * cos_i,
        fitted_m2=square * float(fit.values @ gram @ fit.values),
        uncertain_m2=square * float(np.trace(fit.covariance @ gram)),
        unexplained_m2=square * fit.unexplained_m2,
        noise_m2=square * float(np.mean(sigmas_m**2)),
        # The first mode is 1, so the first row of the products holds the means of the modes.
        mean_m=cos_i * float(gram[0] @ fit.values),
    )


def mirror_wavefront(panels: Iterable[PanelWavefront]) -> MirrorWavefront | None:
    """Root mean square over panels, weighted by their areas across the beam; None without any."""
    table = np.array(list(panels), dtype=np.float64).reshape(-1, len(PanelWavefront._fields))
    if not len(table):
        return None
    weights = table[:, 0] / table[:, 0].sum()
    fitted, uncertain, unexplained, noise, mean = (float(value) for value in weights @ table[:, 1:])
    left = max(unexplained, 0.0)
    level = max(fitted - mean * mean, 0.0) + left
    return MirrorWavefront(sqrt(fitted + left), sqrt(level), sqrt(uncertain + left), sqrt(noise))
