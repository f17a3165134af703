"""Pure. The rim against an independent computation from the panels' rectangles."""

from collections.abc import Iterator
from math import hypot, inf, nan

import numpy as np
import pytest
from numpy.typing import NDArray

from ccatp.core import PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.rim import NearOutline, Rim
from ccatp.mirror.surface import MirrorError

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


def test_exact_distances_at_a_step(m1: Mirror) -> None:
    # Row 1 ends at x = 3.5 pitches less half a gap; row 2's own lower edge is the level of the step.
    left, level = -(3 * 0.6712022 + 0.335), -3 * 0.7512022 + 0.035 - 0.375
    sd = m1.rim.signed_distance_m
    assert sd(left, level) == pytest.approx(0.0, abs=1e-12)
    assert sd(left + 0.03, level + 0.04) == pytest.approx(0.05, abs=1e-12)  # inward from the notch's corner
    assert sd(left - 0.03, level - 0.04) == pytest.approx(-0.03, abs=1e-12)
    assert sd(left - 0.2, level + 0.01) == pytest.approx(0.01, abs=1e-12)
    outer = -(4 * 0.6712022 + 0.335)
    assert sd(outer - 0.03, level - 0.04) == pytest.approx(-0.05, abs=1e-12)  # outward from a convex corner


def test_seams_and_crossings_are_filled(mirror: Mirror) -> None:
    p = mirror.panels[PanelId(5, 5)]
    x, y = p.x_m + p.half_x_m + mirror.gap_m / 2, p.y_m + p.half_y_m + mirror.gap_m / 2
    for place in ((x, p.y_m), (p.x_m, y), (x, y)):
        assert not mirror.is_on_panel(*place)
        assert mirror.rim.signed_distance_m(*place) > 1.0


def test_no_half_gap_outside(mirror: Mirror) -> None:
    for p in mirror.panels.values():
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            if PanelId(p.id.row + dy, p.id.col + dx) not in mirror.panels:
                x, y = p.x_m + dx * p.half_x_m, p.y_m + dy * p.half_y_m
                assert mirror.rim.signed_distance_m(x, y) == pytest.approx(0.0, abs=1e-12)


def test_arrays_agree_with_scalars(mirror: Mirror) -> None:
    places = np.random.default_rng(1).uniform(-4.5, 4.5, (500, 2))
    scalar = [mirror.rim.signed_distance_m(float(x), float(y)) for x, y in places]
    assert mirror.rim.signed_distances_m(places[:, 0], places[:, 1]) == pytest.approx(scalar, abs=1e-15)
    grid = mirror.rim.signed_distances_m(np.linspace(-4, 4, 5)[:, None], np.linspace(-4, 4, 7)[None, :])
    assert grid.shape == (5, 7)
    assert grid[0, 3] == mirror.rim.signed_distance_m(-4.0, 0.0)


def test_vertices_run_counter_clockwise_around_the_panels(mirror: Mirror) -> None:
    x, y = mirror.rim.vertices.T
    area = 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
    boxes = np.array(list(rectangles(mirror)))
    covered_area = float(((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])).sum())
    assert area == pytest.approx(covered_area, abs=1e-9)
    steps = np.roll(mirror.rim.vertices, -1, axis=0) - mirror.rim.vertices
    assert ((steps == 0.0).sum(axis=1) == 1).all()  # rectilinear, no corner twice


@pytest.mark.parametrize(("x", "y"), [(nan, 0.0), (0.0, nan), (nan, nan)])
def test_a_place_that_is_no_number_is_beyond_the_rim(mirror: Mirror, x: float, y: float) -> None:
    assert mirror.rim.signed_distance_m(x, y) == -inf


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


def test_clearance_along_and_across_the_rim(m1: Mirror) -> None:
    edge = 4 * 0.6712022 + 0.335
    clearance = m1.rim.segment_clearance_m
    assert clearance(edge - 0.1, -1.0, edge - 0.1, 1.0) == pytest.approx(0.1, abs=1e-9)
    assert clearance(edge + 0.1, -1.0, edge + 0.1, 1.0) == pytest.approx(-0.1, abs=1e-9)
    assert clearance(0.0, 0.0, edge + 0.3, 0.0) == pytest.approx(-0.3, abs=1e-9)
    assert clearance(0.5, 0.5, 0.5, 0.5) == pytest.approx(m1.rim.signed_distance_m(0.5, 0.5), abs=1e-9)


def test_a_straight_leg_across_a_notch_leaves_the_mirror(m1: Mirror) -> None:
    # Both ends lie 0.05 m inside; the corner of the notch lies between them and the line cuts the missing cell.
    x, y = -(3 * 0.6712022 + 0.335), -3 * 0.7512022 + 0.035 - 0.375
    clearance = m1.rim.segment_clearance_m(x + 0.05, y - 0.4, x - 0.4, y + 0.05)
    assert clearance < -0.1


def test_clearance_far_beyond_the_mirror_ends(m1: Mirror) -> None:
    assert m1.rim.segment_clearance_m(-1e7, 5.0, 1e7, 3.0) == pytest.approx(-1e7, rel=1e-6)


def test_a_segment_that_is_not_finite_is_refused(m1: Mirror) -> None:
    with pytest.raises(MirrorError, match="is not finite"):
        m1.rim.segment_clearance_m(0.0, 0.0, nan, 1.0)


def test_a_waist_is_respected() -> None:
    # Wide, narrow, wide: a shape no shipped mirror has, but that the layout allows.
    rim = Rim([(2.0, 0.0, 1.0), (1.0, 1.0, 2.0), (2.0, 2.0, 3.0)])
    assert rim.signed_distance_m(1.5, 1.5) == pytest.approx(-0.5)
    assert rim.signed_distance_m(0.0, 1.5) == pytest.approx(1.0)
    assert rim.signed_distance_m(1.6, 0.4) == pytest.approx(0.4)
    assert rim.segment_clearance_m(1.5, 0.5, 1.5, 2.5) == pytest.approx(-0.5, abs=1e-9)


def test_a_part_decides_within_its_disc_as_the_whole(mirror: Mirror) -> None:
    rng = np.random.default_rng(5)
    for _ in range(300):
        x, y = rng.uniform(-4.5, 4.5, 2).tolist()
        radius_m = float(rng.uniform(0.01, 0.8))
        part = mirror.rim.part(x, y, radius_m)
        for _ in range(10):
            dx, dy = (rng.uniform(-1.0, 1.0, 2) * radius_m).tolist()
            if hypot(dx, dy) <= radius_m:
                assert part.signed_distance_m(x + dx, y + dy) == mirror.rim.signed_distance_m(x + dx, y + dy)


def test_a_part_has_few_edges(mirror: Mirror) -> None:
    panel = min(mirror.panels.values(), key=lambda p: p.y_m)
    near = mirror.rim.part(panel.x_m, panel.y_m - panel.half_y_m + 0.1, 0.1)
    assert len(near._upright) + len(near._level) <= 3


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


def test_a_waist() -> None:
    rim = Rim([(2.0, 0.0, 1.0), (1.0, 1.0, 2.0), (2.0, 2.0, 3.0)])
    near = NearOutline(rim)
    for x in np.linspace(-2.5, 2.5, 41).tolist():
        for y in np.linspace(-0.5, 3.5, 81).tolist():
            assert near.signed_distance_m(x, y) == rim.signed_distance_m(x, y)


@pytest.mark.parametrize(("x", "y"), [(nan, 0.0), (0.0, nan), (nan, nan)])
def test_a_place_that_is_no_number_is_beyond_and_leaves_no_trace(m1: Mirror, x: float, y: float) -> None:
    near = NearOutline(m1.rim)
    assert near.signed_distance_m(x, y) == -inf
    assert near.signed_distance_m(0.1, 0.2) == m1.rim.signed_distance_m(0.1, 0.2)
