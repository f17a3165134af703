"""Pure but for reading the shipped mirrors. Round trips between world, mirror, deck, panel and robot frames."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccatp.core import DeckPose, PanelId, PanelPose, Vector3
from ccatp.kinematics import difference
from ccatp.mirror.mirror import Mirror
from tests.support.scenario import mirror_of

TOLERANCE = 1e-9  # m and rad: a thousandth of the laser's micrometre


mirrors = st.sampled_from(("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")).map(mirror_of)
coordinates = st.floats(-3.5, 3.5)
points = st.tuples(st.floats(-10.0, 10.0), st.floats(-10.0, 10.0), st.floats(-10.0, 10.0))
headings = st.floats(-3.2, 3.2)
deck_poses = st.builds(DeckPose, coordinates, coordinates, headings)


@st.composite
def mirror_and_panel(draw: st.DrawFn) -> tuple[Mirror, PanelId]:
    mirror = draw(mirrors)
    return mirror, draw(st.sampled_from(sorted(mirror.panels)))


@given(mirrors, points)
def test_world_mirror_deck(mirror: Mirror, p: Vector3) -> None:
    assert mirror.world_from_mirror(mirror.mirror_from_world(p)) == pytest.approx(p, abs=TOLERANCE)
    assert mirror.mirror_from_deck(mirror.deck_from_mirror(p)) == p
    assert mirror.world_from_deck(mirror.deck_from_world(p)) == pytest.approx(p, abs=TOLERANCE)
    through = mirror.deck_from_mirror(mirror.mirror_from_world(p))
    assert mirror.deck_from_world(p) == pytest.approx(through, abs=TOLERANCE)


@given(mirrors, points, points)
def test_vectors_turn_like_differences_of_points(mirror: Mirror, p: Vector3, q: Vector3) -> None:
    v = (q[0] - p[0], q[1] - p[1], q[2] - p[2])
    a, b = mirror.world_from_deck(p), mirror.world_from_deck(q)
    turned = mirror.rotate_world_from_deck(v)
    assert turned == pytest.approx((b[0] - a[0], b[1] - a[1], b[2] - a[2]), abs=TOLERANCE)
    assert mirror.rotate_deck_from_world(turned) == pytest.approx(v, abs=TOLERANCE)


@given(mirror_and_panel(), points)
def test_deck_panel(where: tuple[Mirror, PanelId], p: Vector3) -> None:
    mirror, pid = where
    panel = mirror.panels[pid]
    assert panel.to_deck(panel.from_deck(p)) == pytest.approx(p, abs=TOLERANCE)
    assert panel.from_deck(panel.origin) == (0.0, 0.0, 0.0)


@given(mirrors, deck_poses, points)
def test_deck_robot(mirror: Mirror, pose: DeckPose, p: Vector3) -> None:
    offset = np.subtract(mirror.deck_from_robot(pose, p), mirror.surface_point(pose.x_m, pose.y_m))
    assert np.array(mirror.robot_axes(pose)) @ offset == pytest.approx(p, abs=TOLERANCE)
    assert mirror.deck_from_robot(pose, (0.0, 0.0, 0.0)) == mirror.surface_point(pose.x_m, pose.y_m)


@given(mirror_and_panel(), st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), headings)
def test_panel_pose_to_deck_and_back(where: tuple[Mirror, PanelId], x: float, y: float, heading: float) -> None:
    mirror, pid = where
    back = mirror.panel_pose(pid, mirror.deck_pose(PanelPose(pid, x, y, heading)))
    assert back.panel == pid
    assert (back.x_m, back.y_m) == pytest.approx((x, y), abs=TOLERANCE)
    assert difference(back.heading_rad, heading) == pytest.approx(0.0, abs=TOLERANCE)


@given(mirror_and_panel(), deck_poses)
def test_deck_pose_to_any_panel_and_back(where: tuple[Mirror, PanelId], pose: DeckPose) -> None:
    # Any panel's frame will do, not only that of the panel under the robot.
    mirror, pid = where
    back = mirror.deck_pose(mirror.panel_pose(pid, pose))
    assert (back.x_m, back.y_m) == pytest.approx((pose.x_m, pose.y_m), abs=TOLERANCE)
    assert difference(back.heading_rad, pose.heading_rad) == pytest.approx(0.0, abs=TOLERANCE)


@given(mirrors, deck_poses, st.floats(0.0, 0.5))
def test_puck_and_its_foot(mirror: Mirror, pose: DeckPose, height: float) -> None:
    x, y, deviation = mirror.foot_of_puck(mirror.puck_world(pose, height), height)
    assert (x, y) == pytest.approx((pose.x_m, pose.y_m), abs=1e-10)  # the promise of foot_of_puck
    assert deviation == pytest.approx(0.0, abs=1e-10)


@given(mirrors, deck_poses, st.floats(-0.001, 0.001))
def test_deviation_is_measured_along_the_normal(mirror: Mirror, pose: DeckPose, deviation: float) -> None:
    x, y, found = mirror.foot_of_puck(mirror.puck_world(pose, 0.05 + deviation), 0.05)
    assert (x, y) == pytest.approx((pose.x_m, pose.y_m), abs=1e-10)
    assert found == pytest.approx(deviation, abs=1e-10)


@given(mirrors, coordinates, coordinates, coordinates, coordinates)
def test_rim_distance_never_changes_faster_than_the_way(
    mirror: Mirror, x0: float, y0: float, x1: float, y1: float
) -> None:
    change = mirror.rim.signed_distance_m(x1, y1) - mirror.rim.signed_distance_m(x0, y0)
    assert abs(change) <= ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5 + TOLERANCE
    ends = min(mirror.rim.signed_distance_m(x0, y0), mirror.rim.signed_distance_m(x1, y1))
    assert mirror.rim.segment_clearance_m(x0, y0, x1, y1) <= ends + TOLERANCE


@given(mirrors, coordinates, coordinates)
def test_material_lies_in_its_cell_and_within_the_rim(mirror: Mirror, x: float, y: float) -> None:
    if mirror.is_on_panel(x, y):
        panel = mirror.panel_at(x, y)
        assert panel is not None
        assert mirror.nearest_panel(x, y) == panel
        assert mirror.rim.signed_distance_m(x, y) >= 0.0
    if mirror.rim.signed_distance_m(x, y) > 0.0:
        assert mirror.panel_at(x, y) is not None
