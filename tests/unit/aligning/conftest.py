"""Surveys without a robot: points of misaligned panels, measured with the laser's noise."""

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from ccatp.config.models import Config
from ccatp.core import DeckPose, Fix, FloatArray, PanelId, PointId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.misalignment import PanelMisalignment, misaligned_puck_world
from ccatp.mirror.multilateration import solve_fix
from ccatp.mirror.panel_alignment import Deviations, Measured
from ccatp.sim.world import draw_misalignments

HEIGHT_M = 0.05
Truth = Mapping[PanelId, PanelMisalignment]
Survey = Callable[[Truth, np.random.Generator], list[Measured]]


def misaligned(cfg: Config, panels: Iterable[PanelId], rng: np.random.Generator) -> dict[PanelId, PanelMisalignment]:
    return draw_misalignments(panels, cfg, rng)


def survey(cfg: Config, mirror: Mirror, truth: Truth, rng: np.random.Generator) -> list[Measured]:
    """Every point of the panels of ``truth``: the puck stands 3 mm beside it, eight lengths have the laser's noise."""
    measured = []
    collimators = dict(zip(mirror.channels, mirror.collimators_m, strict=True))
    for panel, misalignment in truth.items():
        for point in mirror.point_ids(panel):
            dx, dy = rng.normal(scale=3e-3, size=2)
            x, y = mirror.point_on_deck(point)
            pose = DeckPose(x + float(dx), y + float(dy), 0.0)
            puck = misaligned_puck_world(mirror, panel, misalignment, pose, HEIGHT_M)
            lengths = {}
            for channel, collimator in collimators.items():
                length = float(np.linalg.norm(collimator - np.array(puck)))
                lengths[channel] = length + float(rng.normal()) * (1e-6 + 2.5e-7 * length)
            measured.append(Measured(point, solve_fix(cfg.etalon, 1.0, puck, lengths, collimators)))
    return measured


def exact_fix(mirror: Mirror, point: PointId, misalignment: PanelMisalignment, sigma_m: float = 2e-6) -> Measured:
    """A fix without error that claims ``sigma_m`` along every axis."""
    x, y = mirror.point_on_deck(point)
    puck = misaligned_puck_world(mirror, point.panel, misalignment, DeckPose(x, y, 0.0), HEIGHT_M)
    covariance = tuple((np.eye(3) * sigma_m**2).ravel().tolist())
    return Measured(point, Fix(1.0, puck, covariance, 1.0, (1, 2, 3, 4), 0.0))


GRID_M = np.array([(x, y) for y in (-0.25, 0.0, 0.25) for x in (-0.22, 0.0, 0.22)])


def on_grid(values_m: FloatArray, sigma_m: float = 2e-6, places_m: FloatArray = GRID_M) -> Deviations:
    """Deviations at the nine places of a panel."""
    points = tuple(PointId(1, 1, k + 1) for k in range(len(places_m)))
    sigmas = np.full(len(places_m), sigma_m)
    return Deviations(points, places_m, places_m, values_m, sigmas, np.ones(len(places_m)))
