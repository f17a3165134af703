"""Pure. Poses, puck, seam normals and gravity on the shipped mirrors."""

from collections.abc import Callable
from math import cos, hypot, pi, sin, sqrt
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from ccatp.config.models import MirrorConfig
from ccatp.core import DeckPose, PanelId, PanelPose, PointId, bearing, difference
from ccatp.mirror.mirror import Mirror, build_mirror, deck_poses
from ccatp.mirror.surface import ConvergenceError, LayoutError, UnknownPanelError

POSE = DeckPose(1.1, -1.7, 0.6)


def test_world_places_the_mirrors_as_in_the_optical_design(m1: Mirror, m2: Mirror) -> None:
    # Data files: rows of R are the mirror's axes in the world; origins at (0, 0, 3.6) m and (0, -4.8, 0) m.
    assert m1.world_from_mirror((0.0, 0.0, 0.0)) == pytest.approx((0.0, 0.0, 3.6), abs=1e-12)
    assert m2.world_from_mirror((0.0, 0.0, 0.0)) == pytest.approx((0.0, -4.8, 0.0), abs=1e-12)
    y1 = m1.rotate_world_from_deck((0.0, 1.0, 0.0))
    assert y1 == pytest.approx((0.0, 0.894427190999916, -0.447213595499958), abs=1e-12)
    z2 = m2.rotate_world_from_deck((0.0, 0.0, 1.0))
    assert z2 == pytest.approx((0.0, 0.948683298050514, 0.316227766016838), abs=1e-12)


def test_the_two_mirrors_face_each_other(m1: Mirror, m2: Mirror) -> None:
    a, b = np.array(m1.world_from_deck((0.0, 0.0, 0.0))), np.array(m2.world_from_deck((0.0, 0.0, 0.0)))
    assert np.dot(m1.rotate_world_from_deck((0.0, 0.0, 1.0)), b - a) > 0.0
    assert np.dot(m2.rotate_world_from_deck((0.0, 0.0, 1.0)), a - b) > 0.0


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


def test_sensors_at_the_base_stand_on_the_panel(mirror: Mirror) -> None:
    for ox, oy in ((0.09, 0.09), (0.09, -0.09), (-0.09, 0.09), (-0.09, -0.09)):
        assert mirror.is_on_panel(*mirror.body_offset(mirror.base_pose, ox, oy))


def test_body_offset_is_the_projection_of_the_robot_frame(mirror: Mirror) -> None:
    x, y, _ = mirror.deck_from_robot(POSE, (0.09, -0.04, 0.0))
    assert mirror.body_offset(POSE, 0.09, -0.04) == pytest.approx((x, y), abs=1e-15)
    hx, hy, lx, ly = mirror.body_axes(POSE)
    h, left, _ = mirror.robot_axes(POSE)
    assert (hx, hy, lx, ly) == pytest.approx((*h[:2], *left[:2]), abs=1e-15)


def test_left_is_left(mirror: Mirror) -> None:
    h, left, n = np.array(mirror.robot_axes(POSE))
    assert np.cross(n, h) == pytest.approx(left, abs=1e-15)
    assert h[2] != 0.0
    assert np.dot(h, mirror.surface.normal(POSE.x_m, POSE.y_m)) == pytest.approx(0.0, abs=1e-15)


def test_heading_of_zero_follows_the_rows(mirror: Mirror) -> None:
    hx, hy, _, _ = mirror.body_axes(DeckPose(1.1, -1.7, 0.0))
    assert hy == 0.0
    assert hx > 0.99


def test_panel_heading_is_the_projection_on_the_panel_plane(mirror: Mirror) -> None:
    panel = mirror.panels[PanelId(3, 4)]
    pose = mirror.deck_pose(PanelPose(panel.id, 0.21, -0.24, 2.2))
    x, y, _ = panel.rotate_from_deck(mirror.robot_axes(pose)[0])
    assert (x / hypot(x, y), y / hypot(x, y)) == pytest.approx((cos(2.2), sin(2.2)), abs=1e-12)


def test_puck_stands_on_the_normal(mirror: Mirror) -> None:
    foot = np.array(mirror.world_from_deck(mirror.surface_point(POSE.x_m, POSE.y_m)))
    puck = np.array(mirror.puck_world(POSE, 0.05))
    assert np.linalg.norm(puck - foot) == pytest.approx(0.05, abs=1e-12)
    robot = mirror.robot_from_deck(POSE, mirror.deck_from_world(mirror.puck_world(POSE, 0.05)))
    assert robot == pytest.approx((0.0, 0.0, 0.05), abs=1e-12)


def test_puck_height_moves_the_puck_sideways_on_a_slope(m1: Mirror) -> None:
    # The height counts: at 5.8 deg of slope 100 mm of height are 10 mm sideways.
    steep = DeckPose(3.0, 0.0, 0.0)
    x, y, _ = m1.deck_from_world(m1.puck_world(steep, 0.1))
    slope = hypot(*m1.surface.gradient(3.0, 0.0))
    assert hypot(x - 3.0, y) == pytest.approx(0.1 * slope / sqrt(1 + slope**2), abs=1e-12)
    assert hypot(x - 3.0, y) > 0.004


def test_foot_of_a_puck_that_is_too_high(mirror: Mirror) -> None:
    x, y, deviation = mirror.foot_of_puck(mirror.puck_world(POSE, 0.0507), 0.05)
    assert (x, y) == pytest.approx((POSE.x_m, POSE.y_m), abs=1e-10)
    assert deviation == pytest.approx(0.0007, abs=1e-10)


def test_a_puck_nowhere_is_refused(mirror: Mirror) -> None:
    with pytest.raises(ConvergenceError, match="no foot on the surface"):
        mirror.foot_of_puck((float("nan"), 0.0, 0.0), 0.05)


def test_seam_normals_point_along_the_growing_coordinate(mirror: Mirror) -> None:
    panel = mirror.panels[PanelId(4, 4)]
    right = mirror.seam_normal_angle(panel.id, "x", panel.x_m + panel.half_x_m, panel.y_m + 0.1)
    up = mirror.seam_normal_angle(panel.id, "y", panel.x_m + 0.1, panel.y_m + panel.half_y_m)
    # The slope of 0.02 turns seams within their panel by some 0.1 mrad.
    assert (right, up) == pytest.approx((0.0, pi / 2), abs=2e-3)
    assert right != 0.0
    assert up != pi / 2


@pytest.mark.parametrize("row", [2, 8])
def test_seam_normal_is_square_to_the_seam_seen_from_the_panel(mirror: Mirror, row: int) -> None:
    panel = mirror.panels[PanelId(row, 3)]
    x, y = panel.x_m + panel.half_x_m, panel.y_m + 0.2
    before, after = (panel.from_deck(mirror.surface_point(x, y + d)) for d in (-1e-5, 1e-5))
    along = bearing(after[0] - before[0], after[1] - before[1])
    angle = mirror.seam_normal_angle(panel.id, "x", x, y)
    assert difference(along, angle) == pytest.approx(pi / 2, abs=1e-9)  # rounding 1e-16 over 2e-5 m


def test_gravity_pulls_down_on_m1_and_off_the_mirror_on_m2(mirror: Mirror) -> None:
    for heading in (0.0, 1.0, 2.0, -2.5):
        g = mirror.gravity_in_robot(DeckPose(0.4, 0.7, heading))
        assert hypot(*g) == pytest.approx(1.0, abs=1e-12)
        assert (g[2] > 0.0) == mirror.overhang
        axes = np.array([mirror.rotate_world_from_deck(a) for a in mirror.robot_axes(DeckPose(0.4, 0.7, heading))])
        assert g == pytest.approx(tuple(axes[:, 2]), abs=1e-12)


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
    rows = deck_poses(mirror, poses)
    for row, pose in zip(rows, poses, strict=True):
        one = mirror.deck_pose(pose)
        expected = (one.x_m, one.y_m, one.heading_rad, mirror.surface.height_m(one.x_m, one.y_m))
        assert row.tolist() == pytest.approx(expected, abs=1e-12)  # two orders of the same sums


def test_none_is_an_empty_table(mirror: Mirror) -> None:
    assert deck_poses(mirror, []).shape == (0, 4)


Raw = dict[str, Any]
PANELS = {"fyst-m1": 77, "fyst-m2": 69, "thesis-m1": 87, "thesis-m2": 78}
POINTS = {"fyst-m1": 693, "fyst-m2": 621, "thesis-m1": 783, "thesis-m2": 702}
MAX_DOP = 3.0


def test_counts(mirror: Mirror) -> None:
    points = {mirror.point_on_deck(pid) for panel in mirror.panels for pid in mirror.point_ids(panel)}
    assert len(mirror.panels) == PANELS[mirror.name]
    assert len(points) == POINTS[mirror.name]
    assert mirror.overhang == mirror.name.endswith("m2")


def test_longest_leg_between_panels_of_the_thesis(mirror: Mirror) -> None:
    # The thesis's largest leg is 0.744 m: panel to panel between equal points, along a column.
    ys = sorted({round(p.y_m, 9) for p in mirror.panels.values()})
    if mirror.name.startswith("thesis"):
        assert np.diff(ys) == pytest.approx(0.744, abs=1e-9)


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


def _set(section: str, key: str, value: object) -> Callable[[Raw], None]:
    def change(raw: Raw) -> None:
        raw[section][key] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("panels", "count", 78), "panels_per_row adds up to 77 panels, count says 78"),
        (_set("panels", "panels_per_row", [8, 9, 9, 9, 9, 9, 9, 9, 6]), "row 1 with 8 panels cannot be centred on 9"),
        (_set("panels", "panels_per_row", [11, 9, 9, 9, 9, 9, 9, 9, 3]), "row 1 with 11 panels cannot be centred on 9"),
        (_set("panels", "pitch_x_mm", 680.0), r"pitch_x_mm 680.0 is not size 670.0 \+ gap 1.2"),
        (_set("panels", "size_y_mm", 700.0), r"pitch_y_mm 751.2022 is not size 700.0 \+ gap 1.2"),
        (_set("panels", "points_x_mm", [-220.0, 0.0, 340.0]), r"points_x_mm \(-220.0, 0.0, 340.0\) must ascend"),
        (_set("panels", "points_y_mm", [250.0, 0.0, -250.0]), r"points_y_mm \(250.0, 0.0, -250.0\) must ascend"),
        (_set("base", "col", 1), "base: there is no panel in row 1, column 1"),
        (_set("base", "y_mm", -376.0), r"base: \(-150.0, -376.0\) mm is not on panel \(1, 2\)"),
        (_set("collimators", "channels", [1, 2, 3, 4]), "4 channels, 8 positions"),
        (_set("collimators", "channels", [1, 2, 3, 4, 5, 6, 7, 7]), "are not distinct"),
    ],
)
def test_contradictions_are_refused(raw: Raw, change: Callable[[Raw], None], message: str) -> None:
    change(raw)
    with pytest.raises(LayoutError, match=message):
        build_mirror(MirrorConfig.model_validate(raw))


def test_fewer_than_four_collimators_are_refused(raw: Raw) -> None:
    raw["collimators"] = {"channels": [1, 2, 3], "positions_world_mm": raw["collimators"]["positions_world_mm"][:3]}
    with pytest.raises(LayoutError, match="3 channels; a position needs at least 4"):
        build_mirror(MirrorConfig.model_validate(raw))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("panels", "size_x_mm", -670.0), "size_x_mm"),
        (_set("panels", "size_x", 670.0), "size_x"),
        (_set("frame", "reflecting_side_sign", 0), "reflecting_side_sign"),
        (_set("surface", "normalisation_radius_mm", float("nan")), "normalisation_radius_mm"),
        (_set("collimators", "channels", [0, 2, 3, 4, 5, 6, 7, 8]), "channels"),
    ],
)
def test_malformed_files_name_the_key(raw: Raw, change: Callable[[Raw], None], message: str) -> None:
    change(raw)
    with pytest.raises(ValidationError, match=message):
        MirrorConfig.model_validate(raw)


def test_every_file_names_its_sources_and_what_nobody_confirmed(raw: Raw) -> None:
    cfg = MirrorConfig.model_validate(raw)
    assert len(cfg.provenance) >= 3
    assert any("collimators" in line for line in cfg.unverified)
    assert any("base" in line for line in cfg.unverified)
