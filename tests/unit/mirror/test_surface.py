"""Pure. The surface against the data files' reference values and against numerical differences."""

from collections.abc import Iterator
from math import cos, hypot, inf, nan, sin

import numpy as np
import pytest
from numpy.typing import NDArray

from ccatp.config.models import SurfaceConfig
from ccatp.core import PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.rim import NearOutline
from ccatp.mirror.surface import ConvergenceError, Jet, MirrorError, Surface, SurfacePatch, build_surface
from tests.support.scenario import transport_rad

# (x, y, z) in mm in the mirror frame, evaluated from the published coefficient matrix by other means.
CHECK_POINTS = {
    1: [
        (0.0, 0.0, 0.0),
        (1000.0, -2000.0, -33.770855713),
        (-1500.0, 2500.0, -55.976479163),
        (2684.8, 35.0, -56.618463928),
    ],
    2: [
        (0.0, 0.0, 0.0),
        (1000.0, -2000.0, 57.524196479),
        (-1500.0, 2500.0, 108.400719860),
        (2684.8, 35.0, 94.395715843),
    ],
}
PLACES = [(0.0, 0.0), (1.3, -2.1), (-2.7, 0.4), (0.02, 3.1), (-1.9, -2.8)]
STEP_M = 1e-4


def test_check_points_in_the_mirror_frame(mirror: Mirror) -> None:
    for x, y, z in CHECK_POINTS[1 if mirror.drive_side < 0 else 2]:
        deck_x, deck_y, _ = mirror.deck_from_mirror((x * 1e-3, y * 1e-3, 0.0))
        found = mirror.mirror_from_deck(mirror.surface_point(deck_x, deck_y))
        assert found == pytest.approx((x * 1e-3, y * 1e-3, z * 1e-3), abs=1e-9)  # 1 nm: the references' last digit


@pytest.mark.parametrize(("x", "y"), PLACES)
def test_gradient_and_hessian_against_central_differences(mirror: Mirror, x: float, y: float) -> None:
    f, h = mirror.surface.height_m, STEP_M
    fx = (f(x + h, y) - f(x - h, y)) / (2 * h)
    fy = (f(x, y + h) - f(x, y - h)) / (2 * h)
    fxx = (f(x + h, y) - 2 * f(x, y) + f(x - h, y)) / h**2
    fyy = (f(x, y + h) - 2 * f(x, y) + f(x, y - h)) / h**2
    fxy = (f(x + h, y + h) - f(x + h, y - h) - f(x - h, y + h) + f(x - h, y - h)) / (4 * h**2)
    # Rounding of f (1e-17) over h and over h^2, and h^2 times the third derivative: 1e-10 and 1e-7.
    assert mirror.surface.gradient(x, y) == pytest.approx((fx, fy), abs=1e-9)
    assert mirror.surface.jet(x, y)[:3] == pytest.approx((f(x, y), *mirror.surface.gradient(x, y)), abs=1e-15)
    assert mirror.surface.jet(x, y)[3:] == pytest.approx((fxx, fxy, fyy), abs=1e-7)


@pytest.mark.parametrize(("x", "y"), PLACES)
def test_third_derivatives_against_differences_of_the_second(mirror: Mirror, x: float, y: float) -> None:
    jet, h = mirror.surface.jet, 1e-3
    along_x = np.subtract(jet(x + h, y), jet(x - h, y))[3:] / (2 * h)
    along_y = np.subtract(jet(x, y + h), jet(x, y - h))[3:] / (2 * h)
    # h^2 / 6 times fifth derivatives below 1e-2 is 2e-9; rounding of the second derivatives (1e-17) over h is less.
    assert mirror.surface.third(x, y) == pytest.approx((*along_x[:2], along_x[2], along_y[2]), abs=1e-8)
    assert along_y[0] == pytest.approx(along_x[1], abs=1e-8)


@pytest.mark.parametrize("heading", [0.0, 0.7, 2.4, -1.3])
@pytest.mark.parametrize(("x", "y"), PLACES[1:])
def test_transported_heading_turns_along_the_normal_only(mirror: Mirror, x: float, y: float, heading: float) -> None:
    # A geodesic's tangent changes along the surface normal and not within the tangent plane.
    step = 1e-3
    axes = np.array(mirror.surface.axes(x, y))
    before = np.cos(heading) * axes[0] + np.sin(heading) * axes[1]
    dx, dy = step * before[0], step * before[1]
    turned = heading + transport_rad(mirror, x, y, dx, dy)
    after_axes = np.array(mirror.surface.axes(x + dx, y + dy))
    after = np.cos(turned) * after_axes[0] + np.sin(turned) * after_axes[1]
    sideways = (after - before) @ np.cross(axes[2], before)
    # Second order in the step (curvature 0.03/m): 1e-9. Without the transport it is 1e-6 at these places.
    assert sideways == pytest.approx(0.0, abs=3e-9)


def test_polynomial_with_odd_powers_keeps_its_sense_in_the_deck_frame() -> None:
    cfg = SurfaceConfig(normalisation_radius_mm=2000.0, terms=((1, 0, 10.0), (2, 1, 4.0), (3, 0, 2.0)))
    up, down = build_surface(cfg, 1), build_surface(cfg, -1)
    x, y = 0.6, -0.9
    u, v = x / 2.0, y / 2.0
    assert up.height_m(x, y) == pytest.approx(1e-3 * (10 * u + 4 * u * u * v + 2 * u**3), abs=1e-15)
    assert down.height_m(x, y) == pytest.approx(-up.height_m(-x, y), abs=1e-15)


def test_drop_meets_the_surface_on_the_line(mirror: Mirror) -> None:
    start, direction = (1.0, -1.5, 0.3), (0.05, -0.1, 0.99)
    p = mirror.surface.drop(start, direction)
    assert p[2] == pytest.approx(mirror.surface.height_m(p[0], p[1]), abs=1e-15)
    assert np.cross(np.subtract(p, start), direction) == pytest.approx(np.zeros(3), abs=1e-12)
    with pytest.raises(ConvergenceError, match="no surface point on the line"):
        mirror.surface.drop((0.0, 0.0, nan), (0.0, 0.0, 1.0))


def test_coefficients_need_two_indices() -> None:
    with pytest.raises(ValueError, match=r"need shape \(i, j\), got \(3,\)"):
        Surface(np.zeros(3))


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


@pytest.mark.parametrize(
    ("heading", "step_m", "least", "most"),
    # One at the start, then one per 8 to 9 mm: 5 mm beyond its middle, three quarters of the last way before it.
    [(0.0, 1e-3, 110, 126), (0.6, 1e-4, 1, 20), (2.1, 4e-3, 330, 501), (-1.3, 2e-2, 1001, 1001)],
)
def test_an_expansion_lasts_for_its_reach(m1: Mirror, heading: float, step_m: float, least: int, most: int) -> None:
    surface = Counted(m1.surface)
    patch = SurfacePatch(surface, REACH_M)
    for k in range(1001):
        way_m = step_m * (k if step_m < 4e-3 else k % 100)  # the long steps go back after a while
        x, y = 0.3 + way_m * cos(heading), -0.2 + way_m * sin(heading)
        for found, exact, error in zip(patch.jet(x, y), m1.surface.jet(x, y), ERRORS, strict=True):
            assert found == pytest.approx(exact, rel=0.0, abs=error)
    assert least <= surface.count <= most


SPACING_M = 0.004
Rectangle = tuple[float, float, float, float]


def rectangles(mirror: Mirror) -> Iterator[Rectangle]:
    """Panels, the seams between two panels, and the crossings between four: (low x, low y, high x, high y)."""
    panels = mirror.panels
    for pid, p in panels.items():
        right, up = panels.get(PanelId(pid.row, pid.col + 1)), panels.get(PanelId(pid.row + 1, pid.col))
        diagonal = panels.get(PanelId(pid.row + 1, pid.col + 1))
        x0, x1, y0, y1 = p.x_m - p.half_x_m, p.x_m + p.half_x_m, p.y_m - p.half_y_m, p.y_m + p.half_y_m
        yield x0, y0, x1, y1
        if right:
            yield x1, y0, right.x_m - right.half_x_m, y1
        if up:
            yield x0, y1, x1, up.y_m - up.half_y_m
        if right and up and diagonal:
            yield x1, y1, right.x_m - right.half_x_m, up.y_m - up.half_y_m


def covered(boxes: NDArray[np.float64], xs: NDArray[np.float64], ys: NDArray[np.float64]) -> NDArray[np.bool_]:
    inside = np.zeros(xs.shape, dtype=bool)
    for x0, y0, x1, y1 in boxes:
        inside |= (x0 - 1e-12 <= xs) & (xs <= x1 + 1e-12) & (y0 - 1e-12 <= ys) & (ys <= y1 + 1e-12)
    return inside


def boundary(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Samples of the outline: samples of all rectangles' edges that have uncovered ground beside them."""
    samples = []
    for x0, y0, x1, y1 in boxes:
        nx, ny = int((x1 - x0) / SPACING_M) + 2, int((y1 - y0) / SPACING_M) + 2
        xs, ys = np.linspace(x0, x1, nx), np.linspace(y0, y1, ny)
        samples += [np.column_stack([xs, np.full(nx, y)]) for y in (y0, y1)]
        samples += [np.column_stack([np.full(ny, x), ys]) for x in (x0, x1)]
    points = np.concatenate(samples)
    x, y = points.T
    e = 1e-7
    surrounded = covered(boxes, x + e, y + e) & covered(boxes, x - e, y + e)
    surrounded &= covered(boxes, x + e, y - e) & covered(boxes, x - e, y - e)
    return points[~surrounded]


def test_signed_distance_against_sampled_outline(mirror: Mirror) -> None:
    boxes = np.array(list(rectangles(mirror)))
    outline = boundary(boxes)
    rng = np.random.default_rng(7)
    places = rng.uniform(-4.5, 4.5, (300, 2))
    inside = covered(boxes, places[:, 0], places[:, 1])
    assert 50 < inside.sum() < 250
    for (x, y), on_mirror in zip(places, inside, strict=True):
        sampled = float(np.hypot(outline[:, 0] - x, outline[:, 1] - y).min())
        found = mirror.rim.signed_distance_m(float(x), float(y))
        assert (found > 0.0) == on_mirror
        # The nearest sample is at most half a spacing along the outline from the nearest point.
        assert abs(found) <= sampled + 1e-9
        assert sampled <= hypot(found, SPACING_M / 2) + 1e-9


def test_clearance_of_segments_against_samples(mirror: Mirror) -> None:
    rng = np.random.default_rng(3)
    samples = np.linspace(0.0, 1.0, 4001)
    beyond = 0
    for _ in range(150):
        x0, y0 = rng.uniform(-3.2, 3.2, 2)
        dx, dy = rng.uniform(-2.0, 2.0, 2)
        x1, y1 = x0 + dx, y0 + dy
        found = mirror.rim.segment_clearance_m(x0, y0, x1, y1)
        along = mirror.rim.signed_distances_m(x0 + samples * (x1 - x0), y0 + samples * (y1 - y0))
        step = hypot(x1 - x0, y1 - y0) / 4000
        # A signed distance changes by at most the way travelled, so the least lies within half a sample step.
        assert float(along.min()) - step / 2 - 1e-9 <= found <= float(along.min()) + 1e-9
        beyond += found < 0.0
    assert 20 < beyond < 140


def test_a_segment_that_is_not_finite_is_refused(m1: Mirror) -> None:
    with pytest.raises(MirrorError, match="is not finite"):
        m1.rim.segment_clearance_m(0.0, 0.0, nan, 1.0)


def test_ways_along_and_over_the_rim(mirror: Mirror) -> None:
    rng = np.random.default_rng(6)
    near = NearOutline(mirror.rim)
    beyond = 0
    for _ in range(40):
        x, y = rng.uniform(-3.0, 3.0, 2).tolist()  # a jump
        dx, dy = (rng.uniform(-1.0, 1.0, 2) * 0.02).tolist()
        for k in range(100):
            found = near.signed_distance_m(x + k * dx, y + k * dy)
            assert found == mirror.rim.signed_distance_m(x + k * dx, y + k * dy)
            beyond += found < 0.0
    assert 400 < beyond < 3600


@pytest.mark.parametrize(("x", "y"), [(nan, 0.0), (0.0, nan), (nan, nan)])
def test_a_place_that_is_no_number_is_beyond_and_leaves_no_trace(m1: Mirror, x: float, y: float) -> None:
    assert m1.rim.signed_distance_m(x, y) == -inf
    near = NearOutline(m1.rim)
    assert near.signed_distance_m(x, y) == -inf
    assert near.signed_distance_m(0.1, 0.2) == m1.rim.signed_distance_m(0.1, 0.2)
