"""Targets of a laser tracker on three panels of a mirror, as lines of a file, and whether their alignment is right."""

from typing import Any

import numpy as np

from ccatp.core import DeckPose, FloatArray, PanelId
from ccatp.mirror.misalignment import PanelMisalignment, misaligned_puck_world
from tests.support.scenario import world_of

M1 = world_of().mirror
PANELS = (PanelId(4, 5), PanelId(5, 4), PanelId(5, 8))
LIES = PanelMisalignment(120e-6, -80e-6, 50e-6)
OFFSET_M = 0.01905  # of a ball of 1.5 inches
SIGMA_UM = 15.0


def places(per_side: int = 3, noise_um: float = SIGMA_UM, offset_m: float = OFFSET_M, seed: int = 4) -> FloatArray:
    """World coordinates of targets on the panels, mm, on a grid of ``per_side`` squared."""
    rng, found = np.random.default_rng(seed), []
    for panel in PANELS:
        body = M1.panel(panel)
        for y in np.linspace(-0.3, 0.3, per_side) + body.y_m:
            for x in np.linspace(-0.28, 0.28, per_side) + body.x_m:
                found.append(misaligned_puck_world(M1, panel, LIES, DeckPose(float(x), float(y), 0.0), offset_m))
    return 1e3 * np.array(found) + 1e-3 * noise_um * rng.normal(size=(len(found), 3))


def labels(per_side: int = 3) -> list[str]:
    return [f"{panel.row}/{panel.col}/{k + 1}" for panel in PANELS for k in range(per_side**2)]


def rows(places_mm: FloatArray, names: list[str]) -> list[str]:
    return [f"{name},{x:.4f},{y:.4f},{z:.4f}" for name, (x, y, z) in zip(names, places_mm.tolist(), strict=True)]


def is_recovered(found: Any, sigmas: float = 5.0) -> bool:
    truth = np.array([LIES.piston_m, LIES.tip_rad, LIES.tilt_rad]) * 1e6
    for panel in found["panels"]:
        values = np.array([panel["piston_um"], panel["tip_urad"], panel["tilt_urad"]])
        if np.max(np.abs(values - truth) / panel["sigma"]) > sigmas:
            return False
    return len(found["panels"]) == len(PANELS)
