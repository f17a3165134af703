"""Pure. Poses, puck, seam normals and gravity on the shipped mirrors."""

from collections.abc import Callable
from math import cos, hypot, inf, nan, pi, sin, sqrt

import numpy as np
import pytest

from ccatp.config.models import PanelsConfig
from ccatp.core import DeckPose, PanelId, PanelPose, PointId
from ccatp.kinematics import bearing, difference
from ccatp.mirror.layout import PanelGrid
from ccatp.mirror.mirror import Mirror, deck_rows
from ccatp.mirror.misalignment import PanelMisalignment, misaligned_puck_world
from ccatp.mirror.panel_modes import deviations_of
from ccatp.mirror.surface import ConvergenceError, UnknownPanelError
from tests.unit.mirror.test_panel_alignment import exact_fix

POSE = DeckPose(1.1, -1.7, 0.6)
LEVEL = PanelMisalignment(0.0, 0.0, 0.0)


def test_world_places_the_mirrors_as_in_the_optical_design(m1: Mirror, m2: Mirror) -> None:
    # Data files: rows of R are the mirror's axes in the world; origins at (0, 0, 3.6) m and (0, -4.8, 0) m.
    assert m1.world_from_mirror((0.0, 0.0, 0.0)) == pytest.approx((0.0, 0.0, 3.6), abs=1e-12)
    assert m2.world_from_mirror((0.0, 0.0, 0.0)) == pytest.approx((0.0, -4.8, 0.0), abs=1e-12)
    y1 = m1.rotate_world_from_deck((0.0, 1.0, 0.0))
    assert y1 == pytest.approx((0.0, 0.894427190999916, -0.447213595499958), abs=1e-12)
    z2 = m2.rotate_world_from_deck((0.0, 0.0, 1.0))
    assert z2 == pytest.approx((0.0, 0.948683298050514, 0.316227766016838), abs=1e-12)


def test_shipped_base_stands_beside_the_first_point_and_looks_at_it(mirror: Mirror) -> None:
    base = mirror.base_panel_pose
    first = min(mirror.panels)
    assert base.panel == first
    # Table 3.1: odd row and odd column is order 1 from the lower left, odd row and even column order 4 from upper left.
    number = 1 if first.col % 2 else 7
    x, y = mirror.point_on_deck(PointId(*first, number))
    pose = mirror.panel_pose(first, DeckPose(x, y, 0.0))
    dx, dy = pose.x_m - base.x_m, pose.y_m - base.y_m
    assert hypot(dx, dy) == pytest.approx(0.10, abs=0.002)  # sqrt(2) times 70 mm is 99 mm
    assert difference(bearing(dx, dy), base.heading_rad) == pytest.approx(0.0, abs=1e-9)
    assert mirror.rim.signed_distance_m(mirror.base_pose.x_m, mirror.base_pose.y_m) > 0.15


def test_panel_heading_is_the_projection_on_the_panel_plane(mirror: Mirror) -> None:
    panel = mirror.panels[PanelId(3, 4)]
    pose = mirror.deck_pose(PanelPose(panel.id, 0.21, -0.24, 2.2))
    x, y, _ = panel.rotate_from_deck(mirror.robot_axes(pose)[0])
    assert (x / hypot(x, y), y / hypot(x, y)) == pytest.approx((cos(2.2), sin(2.2)), abs=1e-12)


def test_puck_stands_on_the_normal(mirror: Mirror) -> None:
    foot = np.array(mirror.world_from_deck(mirror.surface_point(POSE.x_m, POSE.y_m)))
    puck = np.array(mirror.puck_world(POSE, 0.05))
    assert np.linalg.norm(puck - foot) == pytest.approx(0.05, abs=1e-12)
    offset = np.subtract(
        mirror.deck_from_world(mirror.puck_world(POSE, 0.05)), mirror.surface_point(POSE.x_m, POSE.y_m)
    )
    assert np.array(mirror.robot_axes(POSE)) @ offset == pytest.approx((0.0, 0.0, 0.05), abs=1e-12)


def test_foot_of_a_puck_that_is_too_high(mirror: Mirror) -> None:
    x, y, deviation = mirror.foot_of_puck(mirror.puck_world(POSE, 0.0507), 0.05)
    assert (x, y) == pytest.approx((POSE.x_m, POSE.y_m), abs=1e-10)
    assert deviation == pytest.approx(0.0007, abs=1e-10)
    with pytest.raises(ConvergenceError, match="no foot on the surface"):
        mirror.foot_of_puck((float("nan"), 0.0, 0.0), 0.05)


@pytest.mark.parametrize("row", [2, 8])
def test_seam_normal_is_square_to_the_seam_seen_from_the_panel(mirror: Mirror, row: int) -> None:
    panel = mirror.panels[PanelId(row, 3)]
    x, y = panel.x_m + panel.half_x_m, panel.y_m + 0.2
    before, after = (panel.from_deck(mirror.surface_point(x, y + d)) for d in (-1e-5, 1e-5))
    along = bearing(after[0] - before[0], after[1] - before[1])
    angle = mirror.seam_normal_angle(panel.id, "x", x, y)
    assert difference(along, angle) == pytest.approx(pi / 2, abs=1e-9)  # rounding 1e-16 over 2e-5 m


def test_gravity_at_the_apex(m1: Mirror, m2: Mirror) -> None:
    # M1's row axis is horizontal and the apex inclined by atan(1/2); M2 overhangs by atan(1/3).
    assert m1.gravity_in_robot(DeckPose(0.0, 0.0, 0.0)) == pytest.approx((0.0, -1 / sqrt(5), -2 / sqrt(5)), abs=1e-12)
    assert m2.gravity_in_robot(DeckPose(0.0, 0.0, 0.0)) == pytest.approx((0.0, -3 / sqrt(10), 1 / sqrt(10)), abs=1e-12)


@pytest.mark.parametrize(
    "call",
    [
        lambda m, nowhere: m.panel_pose(nowhere, POSE),
        lambda m, nowhere: m.deck_pose(PanelPose(nowhere, 0.0, 0.0, 0.0)),
        lambda m, nowhere: m.seam_normal_angle(nowhere, "x", 0.0, 0.0),
        lambda m, nowhere: m.adjusters_on_deck(nowhere),
        lambda m, nowhere: misaligned_puck_world(m, nowhere, LEVEL, POSE, 0.05),
        lambda m, nowhere: deviations_of(m, nowhere, [exact_fix(m, PointId(1, 2, 1), LEVEL)], 0.05, 0.0),
    ],
)
def test_panels_that_do_not_exist_are_refused(m1: Mirror, call: Callable[[Mirror, PanelId], object]) -> None:
    with pytest.raises(UnknownPanelError, match="fyst-m1 has no panel in row 9, column 9"):
        call(m1, PanelId(9, 9))


def test_many_poses_are_as_one_by_one(mirror: Mirror) -> None:
    rng = np.random.default_rng(3)
    poses = [
        PanelPose(panel, rng.uniform(-0.36, 0.36), rng.uniform(-0.38, 0.38), rng.uniform(-3.0, 3.0))
        for panel in mirror.panels
        for _ in range(3)
    ]
    places = np.array([(pose.x_m, pose.y_m, pose.heading_rad) for pose in poses])
    rows = deck_rows(mirror, [pose.panel for pose in poses], places)
    for row, pose in zip(rows, poses, strict=True):
        one = mirror.deck_pose(pose)
        expected = (one.x_m, one.y_m, one.heading_rad, mirror.surface.height_m(one.x_m, one.y_m))
        assert row.tolist() == pytest.approx(expected, abs=1e-12)  # two orders of the same sums


PANELS = {"fyst-m1": 77, "fyst-m2": 69, "thesis-m1": 87, "thesis-m2": 78}
POINTS = {"fyst-m1": 693, "fyst-m2": 621, "thesis-m1": 783, "thesis-m2": 702}
MAX_DOP = 3.0


def test_counts(mirror: Mirror) -> None:
    points = {mirror.point_on_deck(pid) for panel in mirror.panels for pid in mirror.point_ids(panel)}
    assert len(mirror.panels) == PANELS[mirror.name]
    assert len(points) == POINTS[mirror.name]
    assert mirror.overhang == mirror.name.endswith("m2")


def test_collimators_see_every_corner_of_every_panel_well(mirror: Mirror) -> None:
    assert mirror.channels == (1, 2, 3, 4, 5, 6, 7, 8)
    assert mirror.collimators_m.shape == (8, 3)
    for panel in mirror.panels.values():
        for sx in (-1, 0, 1):
            for sy in (-1, 0, 1):
                place = DeckPose(panel.x_m + sx * panel.half_x_m, panel.y_m + sy * panel.half_y_m, 0.0)
                rays = np.array(mirror.puck_world(place, 0.05)) - mirror.collimators_m
                normal = np.array(mirror.rotate_world_from_deck(mirror.surface.normal(place.x_m, place.y_m)))
                assert (rays @ normal < 0.0).all()  # on the drive side: the mirror does not hide the puck
                jacobian = rays / np.linalg.norm(rays, axis=1)[:, None]
                dop = float(np.sqrt(np.trace(np.linalg.inv(jacobian.T @ jacobian))))
                assert dop < MAX_DOP


def test_m1_columns_run_against_the_mirror_frames_x(m1: Mirror) -> None:
    # Data file: x = -(c - 5) pitch_x, y = (r - 5) pitch_y + y_offset, mirror frame, mm.
    x, y, _ = m1.mirror_from_deck(m1.panels[PanelId(2, 9)].origin)
    assert (x, y) == pytest.approx((-4 * 0.6712022, -3 * 0.7512022 + 0.035), abs=1e-12)


def test_outline_of_the_telescope_as_built(m1: Mirror, m2: Mirror) -> None:
    # Data files, outer corners with half a gap; mm.
    for mirror, x, low, high in ((m1, 3020.41, -3345.409, 3415.409), (m2, 3155.454, -3201.435, 3199.457)):
        half_gap = mirror.gap_m / 2
        corner = mirror.rim.vertices.max(axis=0), mirror.rim.vertices.min(axis=0)
        # 0.02 mm: the pitch fitted to the corners exceeds size + gap by up to 0.012 mm and leaves 0.008 mm
        assert corner[0] == pytest.approx((x * 1e-3 - half_gap, high * 1e-3 - half_gap), abs=2e-5)
        assert corner[1] == pytest.approx((-x * 1e-3 + half_gap, low * 1e-3 + half_gap), abs=2e-5)


@pytest.mark.parametrize(("x", "y"), [(nan, 0.0), (0.0, nan), (inf, 0.0), (0.0, -inf)])
def test_a_place_that_is_no_number_is_off_the_mirror(m1: Mirror, x: float, y: float) -> None:
    assert m1.panel_at(x, y) is None
    assert not m1.is_on_panel(x, y)


def test_nearest_panel_against_a_search_over_all_cells(mirror: Mirror) -> None:
    pitch_x = mirror.panels[PanelId(5, 5)].x_m - mirror.panels[PanelId(5, 4)].x_m
    pitch_y = mirror.panels[PanelId(5, 5)].y_m - mirror.panels[PanelId(4, 5)].y_m
    for i in range(-20, 21):
        for j in range(-20, 21):
            x, y = i * 0.231 + 0.0123, j * 0.217 + 0.0071
            distances = {
                pid: hypot(max(abs(x - p.x_m) - pitch_x / 2, 0.0), max(abs(y - p.y_m) - pitch_y / 2, 0.0))
                for pid, p in mirror.panels.items()
            }
            assert distances[mirror.nearest_panel(x, y)] == pytest.approx(min(distances.values()), abs=1e-12)


def test_seams_of_every_panel_have_a_panel_on_both_sides(mirror: Mirror) -> None:
    for panel in mirror.panels.values():
        for dx, dy in ((0.33, 0.1), (-0.33, 0.1), (0.1, 0.345), (0.1, -0.345)):
            seam = mirror.nearest_seam(panel.x_m + dx, panel.y_m + dy)
            assert seam is not None
            upright = seam.axis == "x"
            for side, material in ((-0.02, True), (0.0, False), (0.02, True)):
                across = seam.position_m + side
                assert mirror.is_on_panel(*((across, panel.y_m) if upright else (panel.x_m, across))) is material


def test_a_single_panel_has_no_seam() -> None:
    sizes = {"size_x_mm": 600.0, "size_y_mm": 700.0, "pitch_x_mm": 610.0, "pitch_y_mm": 710.0, "gap_mm": 10.0}
    points = {"points_x_mm": (-200.0, 0.0, 200.0), "points_y_mm": (-200.0, 0.0, 200.0), "adjusters_mm": {}}
    one = {"count": 1, "cols": 1, "panels_per_row": (1,), "y_offset_mm": 0.0}
    cfg = PanelsConfig.model_validate(one | sizes | points)
    assert PanelGrid(cfg).nearest_seam(0.1, 0.1) is None


def test_points_are_numbered_row_by_row_from_the_lower_left(m1: Mirror) -> None:
    panel = m1.panels[PanelId(5, 5)]
    offsets = [(x, y) for y in (-0.25, 0.0, 0.25) for x in (-0.22, 0.0, 0.22)]
    for pid, (dx, dy) in zip(m1.point_ids(PanelId(5, 5)), offsets, strict=True):
        x, y = m1.point_on_deck(pid)
        p = panel.from_deck(m1.surface_point(x, y))
        assert p[:2] == pytest.approx((dx, dy), abs=1e-12)
        assert (x - panel.x_m, y - panel.y_m) == pytest.approx((dx, dy), abs=1e-3)  # the projection shortens < 1 mm


@pytest.mark.parametrize("number", [0, 10, -1])
def test_a_point_number_outside_1_to_9_is_refused(m1: Mirror, number: int) -> None:
    with pytest.raises(UnknownPanelError, match=rf"measurement point {number} of panel \(5, 5\)"):
        m1.point_on_deck(PointId(5, 5, number))


# Vertical adjusters in the manufacturer's tables for the LAT (same optics), mm: (x, y, z) with x along the elevation
# axis, y lateral, z up when the telescope points to the zenith, that is (world y, world x, minus world z).
ADJUSTERS = {
    "m1": {
        (1, 2, "V1"): (-2920.42798, 1793.69318, -4959.00984),
        (1, 2, "V2"): (-2925.8778, 2233.50269, -4947.06837),
        (1, 2, "V3"): (-2465.40503, 1793.7044, -4751.74223),
        (1, 2, "V4"): (-2470.97692, 2233.50669, -4739.53595),
        (1, 2, "V5"): (-2695.39928, 2013.62203, -4849.93818),
        (5, 9, "V1"): (-222.00148, -2904.61893, -3636.75778),
        (8, 9, "V1"): (1782.95468, -2904.63204, -2607.78414),
        (8, 9, "V4"): (2232.30707, -2464.97005, -2387.80513),
    },
    "m2": {
        (3, 9, "V1"): (-5186.59846, 3024.21827, -1634.39547),
        (3, 9, "V2"): (-5217.79178, 2585.40112, -1625.08607),
        (3, 9, "V3"): (-5043.59815, 3024.21747, -1155.25829),
        (3, 9, "V4"): (-5074.80026, 2585.40109, -1145.94694),
        (1, 7, "V1"): (-5644.62565, 1622.27753, -2980.66127),
        (5, 5, "V5"): (-4800.31624, 0.0, -0.94875),
        (8, 2, "V1"): (-4117.55321, -1883.98543, 1758.14214),
        (8, 2, "V4"): (-3909.31092, -2323.28367, 2213.45357),
    },
}


# The tables turn each panel's frame by up to 2.4 mrad about its normal against ours and shift it by up to 0.12 mm.
@pytest.mark.parametrize(("name", "tolerance_m"), [("m1", 0.4e-3), ("m2", 1.0e-3)])
def test_adjusters_stand_where_the_manufacturer_put_them(
    name: str, tolerance_m: float, request: pytest.FixtureRequest
) -> None:
    mirror: Mirror = request.getfixturevalue(name)
    for (row, col, key), (along, lateral, up) in ADJUSTERS[name].items():
        x, y, z = mirror.deck_from_world((lateral * 1e-3, along * 1e-3, -up * 1e-3))
        assert z == pytest.approx(mirror.surface.height_m(x, y), abs=4e-8)  # data file: on the surface to 4e-5 mm
        found = mirror.adjusters_on_deck(PanelId(row, col))
        assert sorted(found) == ["V1", "V2", "V3", "V4", "V5"]
        assert found[key] == pytest.approx((x, y), abs=tolerance_m)
