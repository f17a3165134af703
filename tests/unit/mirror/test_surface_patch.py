"""Pure. The surface carried on around a place, against the surface itself."""

from math import cos, sin

import numpy as np
import pytest

from ccatp.mirror.mirror import Mirror
from ccatp.mirror.surface import Jet, Surface, SurfacePatch

REACH_M = 5e-3
# Height in m, slopes, second derivatives in 1/m, as the class says.
ERRORS = (1e-12, 2e-10, 2e-10, 5e-8, 5e-8, 5e-8)


class Counted(Surface):
    """Counts its evaluations."""

    def __init__(self, surface: Surface) -> None:
        super().__init__(surface._coefficients)
        self.count = 0

    def jet(self, x: float, y: float) -> Jet:
        self.count += 1
        return super().jet(x, y)


def check(patch: SurfacePatch, surface: Surface, x: float, y: float) -> None:
    for found, exact, error in zip(patch.jet(x, y), surface.jet(x, y), ERRORS, strict=True):
        assert found == pytest.approx(exact, rel=0.0, abs=error)


def test_everywhere_within_reach_of_an_expansion(mirror: Mirror) -> None:
    rng = np.random.default_rng(2)
    for _ in range(200):
        patch = SurfacePatch(mirror.surface, REACH_M)
        x, y = rng.uniform(-2.5, 2.5, 2).tolist()
        assert patch.jet(x, y) == mirror.surface.jet(x, y)
        dx, dy = (REACH_M * rng.uniform(-1.0, 1.0, 2)).tolist()
        check(patch, mirror.surface, x + dx, y + dy)


@pytest.mark.parametrize("heading", [0.0, 0.6, 2.1, -1.3])
@pytest.mark.parametrize("step_m", [1e-4, 1e-3, 4e-3, 2e-2])
def test_along_a_way_of_steps_of_any_size(mirror: Mirror, heading: float, step_m: float) -> None:
    patch = SurfacePatch(mirror.surface, REACH_M)
    for k in range(400):
        # There, and back over the same ground.
        way_m = step_m * (k if k < 250 else 500 - k)
        check(patch, mirror.surface, 0.3 + way_m * cos(heading) * 0.4, -0.2 + way_m * sin(heading) * 0.4)


def test_an_expansion_lasts_for_its_reach_ahead_and_behind(m1: Mirror) -> None:
    surface = Counted(m1.surface)
    patch = SurfacePatch(surface, REACH_M)
    for k in range(1001):
        patch.jet(0.001 * k, 0.5)
    # One at the start, then one per 8 to 9 mm: 5 mm beyond its middle, three quarters of the last way before it.
    assert 110 <= surface.count <= 126


def test_a_jump_begins_anew(m1: Mirror) -> None:
    patch = SurfacePatch(m1.surface, REACH_M)
    for place in ((0.0, 0.0), (1.0, -1.0), (1.0 + 1.29 * REACH_M, -1.0), (-2.0, 2.0)):
        check(patch, m1.surface, *place)
