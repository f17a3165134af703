"""Pure. Panel cells, seams, measurement points and adjusters of the shipped mirrors."""

from math import hypot, inf, nan

import pytest

from ccatp.config.models import PanelsConfig
from ccatp.core import PanelId, PointId
from ccatp.mirror.layout import PanelGrid
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.surface import UnknownPanelError


def test_m1_columns_run_against_the_mirror_frames_x(m1: Mirror) -> None:
    # Data file: x = -(c - 5) pitch_x, y = (r - 5) pitch_y + y_offset, mirror frame, mm.
    x, y, _ = m1.mirror_from_deck(m1.panels[PanelId(2, 9)].origin)
    assert (x, y) == pytest.approx((-4 * 0.6712022, -3 * 0.7512022 + 0.035), abs=1e-12)


def test_m2_columns_run_with_the_mirror_frames_x(m2: Mirror) -> None:
    x, y, _ = m2.mirror_from_deck(m2.panels[PanelId(3, 9)].origin)
    assert (x, y) == pytest.approx((4 * 0.7012116, -2 * 0.7112101 - 0.000996), abs=1e-12)


def test_outline_of_the_telescope_as_built(m1: Mirror, m2: Mirror) -> None:
    # Data files, outer corners with half a gap; mm.
    for mirror, x, low, high in ((m1, 3020.41, -3345.409, 3415.409), (m2, 3155.454, -3201.435, 3199.457)):
        half_gap = mirror.gap_m / 2
        corner = mirror.rim.vertices.max(axis=0), mirror.rim.vertices.min(axis=0)
        # 0.02 mm: the pitch fitted to the corners exceeds size + gap by up to 0.012 mm and leaves 0.008 mm
        assert corner[0] == pytest.approx((x * 1e-3 - half_gap, high * 1e-3 - half_gap), abs=2e-5)
        assert corner[1] == pytest.approx((-x * 1e-3 + half_gap, low * 1e-3 + half_gap), abs=2e-5)


def test_row_widths_are_centred(m1: Mirror) -> None:
    assert [p.col for p in m1.panels if p.row == 1] == [2, 3, 4, 5, 6, 7, 8]
    assert [p.col for p in m1.panels if p.row == 2] == [1, 2, 3, 4, 5, 6, 7, 8, 9]


def test_panels_are_ordered_by_rows_then_columns(mirror: Mirror) -> None:
    assert list(mirror.panels) == sorted(mirror.panels)


def test_cell_and_material_at_the_corners_of_every_panel(mirror: Mirror) -> None:
    for pid, panel in mirror.panels.items():
        for sx in (-1, 1):
            for sy in (-1, 1):
                x, y = panel.x_m + sx * panel.half_x_m, panel.y_m + sy * panel.half_y_m
                assert mirror.is_on_panel(x - sx * 1e-6, y - sy * 1e-6)
                assert not mirror.is_on_panel(x + sx * 1e-6, y - sy * 1e-6)
                assert not mirror.is_on_panel(x - sx * 1e-6, y + sy * 1e-6)
                assert mirror.panel_at(x + sx * 1e-6, y + sy * 1e-6) == pid  # the half gap belongs to the cell


def test_outside_every_cell(m1: Mirror) -> None:
    for x, y in ((-3.03, 0.0), (3.03, 0.0), (0.0, -3.36), (0.0, 3.43), (-2.7, -3.0), (2.7, 3.1), (90.0, -90.0)):
        assert m1.panel_at(x, y) is None
        assert not m1.is_on_panel(x, y)


@pytest.mark.parametrize(("x", "y"), [(nan, 0.0), (0.0, nan), (inf, 0.0), (0.0, -inf)])
def test_a_place_that_is_no_number_is_off_the_mirror(m1: Mirror, x: float, y: float) -> None:
    assert m1.panel_at(x, y) is None
    assert not m1.is_on_panel(x, y)


def test_nearest_panel(m1: Mirror) -> None:
    assert m1.nearest_panel(0.0, 0.0) == PanelId(5, 5)
    assert m1.nearest_panel(0.0, -9.0) == PanelId(1, 5)
    assert m1.nearest_panel(9.0, 9.0) == PanelId(9, 8)  # 8.68 m, against 8.71 m from (8, 9)
    assert m1.nearest_panel(-2.4, -3.2) == PanelId(1, 2)  # 0.05 m beside row 1, 0.6 m below row 2
    assert m1.nearest_panel(-2.9, -2.7) == PanelId(2, 1)


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


def test_nearest_seam_left_and_right_of_it(m1: Mirror) -> None:
    half = 0.6712022 / 2
    seam = m1.nearest_seam(half - 0.02, 0.1)
    assert seam is not None
    assert seam.axis == "x"
    assert seam.position_m == pytest.approx(half, abs=1e-12)
    assert seam.distance_m == pytest.approx(-0.02, abs=1e-12)
    seam = m1.nearest_seam(half + 0.01, 0.1)
    assert seam is not None
    assert seam.distance_m == pytest.approx(0.01, abs=1e-12)


def test_nearest_seam_between_rows(m1: Mirror) -> None:
    seam = m1.nearest_seam(0.1, 0.035 + 0.7512022 / 2 + 0.005)
    assert seam is not None
    assert seam.axis == "y"
    assert seam.position_m == pytest.approx(0.035 + 0.7512022 / 2, abs=1e-12)
    assert seam.distance_m == pytest.approx(0.005, abs=1e-12)


def test_the_rim_is_no_seam(m1: Mirror) -> None:
    # Panel (2, 1) has neighbours to the right and above only; below and to the left is the rim.
    panel = m1.panels[PanelId(2, 1)]
    seam = m1.nearest_seam(panel.x_m - 0.33, panel.y_m - 0.37)
    assert seam is not None
    assert seam.axis == "x"
    assert seam.distance_m == pytest.approx(-0.33 - 0.6712022 / 2, abs=1e-12)


def test_seams_of_every_panel_have_a_panel_on_both_sides(mirror: Mirror) -> None:
    for panel in mirror.panels.values():
        for dx, dy in ((0.33, 0.1), (-0.33, 0.1), (0.1, 0.345), (0.1, -0.345)):
            seam = mirror.nearest_seam(panel.x_m + dx, panel.y_m + dy)
            assert seam is not None
            upright = seam.axis == "x"
            for side, material in ((-0.02, True), (0.0, False), (0.02, True)):
                across = seam.position_m + side
                assert mirror.is_on_panel(*((across, panel.y_m) if upright else (panel.x_m, across))) is material


def test_a_single_panel_has_no_seam(m1: Mirror) -> None:
    cfg = PanelsConfig(
        count=1,
        cols=1,
        panels_per_row=(1,),
        size_x_mm=600.0,
        size_y_mm=700.0,
        pitch_x_mm=610.0,
        pitch_y_mm=710.0,
        gap_mm=10.0,
        y_offset_mm=0.0,
        points_x_mm=(-200.0, 0.0, 200.0),
        points_y_mm=(-200.0, 0.0, 200.0),
        adjusters_mm={},
    )
    assert PanelGrid(cfg).nearest_seam(0.1, 0.1) is None


def test_points_are_numbered_row_by_row_from_the_lower_left(m1: Mirror) -> None:
    panel = m1.panels[PanelId(5, 5)]
    offsets = [(x, y) for y in (-0.25, 0.0, 0.25) for x in (-0.22, 0.0, 0.22)]
    for pid, (dx, dy) in zip(m1.point_ids(PanelId(5, 5)), offsets, strict=True):
        x, y = m1.point_on_deck(pid)
        p = panel.from_deck(m1.surface_point(x, y))
        assert p[:2] == pytest.approx((dx, dy), abs=1e-12)
        assert (x - panel.x_m, y - panel.y_m) == pytest.approx((dx, dy), abs=1e-3)  # the projection shortens < 1 mm


def test_every_measurement_point_lies_on_its_panel_well_inside_the_rim(mirror: Mirror) -> None:
    for panel in mirror.panels:
        for pid in mirror.point_ids(panel):
            x, y = mirror.point_on_deck(pid)
            assert mirror.panel_at(x, y) == panel
            assert mirror.is_on_panel(x, y)
            assert mirror.rim.signed_distance_m(x, y) > 0.1


@pytest.mark.parametrize("number", [0, 10, -1])
def test_a_point_number_outside_1_to_9_is_refused(m1: Mirror, number: int) -> None:
    with pytest.raises(UnknownPanelError, match=rf"measurement point {number} of panel \(5, 5\)"):
        m1.point_on_deck(PointId(5, 5, number))


def test_a_panel_that_does_not_exist_is_refused(m1: Mirror) -> None:
    with pytest.raises(UnknownPanelError, match="fyst-m1 has no panel in row 1, column 1"):
        m1.point_on_deck(PointId(1, 1, 5))


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


# Data files: tangent-plane offsets differ from their x-y projection by at most 0.4 mm (M1) and 1.4 mm (M2). The
# rotation between the tables' panel frames and ours adds 0.1 mm.
@pytest.mark.parametrize(("name", "limit_m"), [("m1", 0.5e-3), ("m2", 1.6e-3)])
def test_adjusters_lie_in_the_tangent_plane(name: str, limit_m: float, request: pytest.FixtureRequest) -> None:
    mirror: Mirror = request.getfixturevalue(name)
    worst = 0.0
    for pid, panel in mirror.panels.items():
        found = mirror.adjusters_on_deck(pid)
        for key, sx, sy in (("V1", 1, -1), ("V2", -1, -1), ("V3", 1, 1), ("V4", -1, 1), ("V5", 0, 0)):
            # V1 stands on the side of increasing columns on both mirrors, though their tables differ in the sign of x.
            x, y = found[key]
            x_p, y_p, _ = panel.from_deck(mirror.surface_point(x, y))
            assert (x_p, y_p) == pytest.approx((sx * 0.22, sy * 0.25), abs=1e-9)
            worst = max(worst, abs(x - panel.x_m - sx * 0.22), abs(y - panel.y_m - sy * 0.25))
    assert 0.6 * limit_m < worst <= limit_m
