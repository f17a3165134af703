"""Pure. An edge sensor over a panel's edge: what it says of the robot."""

from collections.abc import Callable
from functools import partial
from math import hypot

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.config.models import FullStateConfig
from ccatp.core import DeckPose, FloatArray, PanelId, PanelPose
from ccatp.estimation.seams import Edge, SeamLines, SensorTransition
from ccatp.estimation.state_model import E0, E1, PSI, STATES, A, Slope, Terrain, V, W, X, Y
from ccatp.mirror.mirror import Mirror
from tests.unit.estimation.drive import Rate, Robot, build, config, errors_of, mirror, run, trapeze

SENSORS = config().robot.edge_sensors_m
HERE = PanelId(4, 4)
INTERVAL_S = 1e-3
# Nothing that is expected of a seam lies further than this from it: half of what separates the two edges of a gap.
NEAR_M = 0.005


def edges_of(k: int) -> tuple[float, float]:
    """Where the map has the two edges of the seam between HERE and its neighbour along axis k."""
    m = mirror()
    here, there = m.panel(HERE), m.panel(PanelId(HERE.row + k, HERE.col + 1 - k))
    return (
        (here.x_m + here.half_x_m, there.x_m - there.half_x_m)
        if k == 0
        else (
            here.y_m + here.half_y_m,
            there.y_m - there.half_y_m,
        )
    )


class Meeting:
    """A robot of which one sensor stands over an edge at t = 0, and its state ``late_s`` after that.

    Args:
        k: axis across the seam.
        is_up: it drives towards larger coordinates.
        is_on: the sensor comes to the panel behind the gap; else it leaves the one before it.
        corner: of the sensor.
        psi: heading against the direction across.
    """

    def __init__(self, k: int, is_up: bool, is_on: bool, corner: int, psi: float, v: float, w: float, late_s: float):
        self.k, self.late_s = k, late_s
        edges = edges_of(k)
        self.edge_m = edges[1] if is_up is is_on else edges[0]
        psi += (0.5 * np.pi if k else 0.0) + (0.0 if is_up is (v > 0.0) else np.pi)
        panel = mirror().panel(HERE)
        x, y = panel.x_m, panel.y_m
        for _ in range(3):  # the axes change with the place
            sx, sy = mirror().body_offset(DeckPose(x, y, psi), *SENSORS[corner])
            x, y = (x + self.edge_m - sx, y) if k == 0 else (x, y + self.edge_m - sy)
        self.truth = DeckPose(x, y, psi)
        self.transition = SensorTransition(0.0, INTERVAL_S, corner, is_on)
        hx, hy, _, _ = mirror().body_axes(DeckPose(x, y, psi + 0.5 * w * late_s))
        self.state = np.zeros(STATES)
        self.state[[X, Y, PSI, V, W]] = x + v * late_s * hx, y + v * late_s * hy, psi + w * late_s, v, w

    def slope(self) -> Slope:
        return Terrain(mirror()).at(float(self.state[X]), float(self.state[Y]))

    def meet(self, seams: SeamLines, state: FloatArray | None = None) -> Edge | None:
        return seams.meet(self.transition, self.late_s, self.state if state is None else state, self.slope())


@pytest.fixture
def seams(mirror: Mirror) -> SeamLines:
    return SeamLines(mirror, config().robot)


@st.composite
def meetings(draw: st.DrawFn) -> Meeting:
    return Meeting(
        draw(st.integers(0, 1)),
        draw(st.booleans()),
        draw(st.booleans()),
        draw(st.integers(0, 3)),
        draw(st.floats(-0.5, 0.5)),
        draw(st.sampled_from([-0.1, 0.03, 0.1])),
        draw(st.floats(-0.15, 0.15)),  # so that the sensor's travel across is that of the robot
        draw(st.floats(0.0, 0.01)),
    )


@settings(max_examples=100, deadline=None)
@given(meetings())
def test_the_truth_has_no_residual(meeting: Meeting) -> None:
    seams = SeamLines(mirror(), config().robot)
    edge = meeting.meet(seams)
    assert edge is not None
    assert (edge.k, edge.is_new) == (meeting.k, True)
    assert edge.position_m == pytest.approx(meeting.edge_m, abs=1e-12)
    assert edge.offset == (E1 if meeting.transition.is_on else E0)
    line = seams.line(edge, meeting.transition, meeting.late_s, meeting.state, meeting.slope())
    # The way since the transition bends by v w late^2/2 = 8e-7 m, and the slopes change by f'' v late = 1.6e-5: of a
    # lever of 0.13 m and slopes of 0.05 that is 1e-7 m.
    assert abs(line.residual_m) < 1e-6


@settings(max_examples=100, deadline=None)
@given(meetings(), st.floats(-0.2, 0.2), st.floats(-3e-4, 3e-4))
def test_its_row_is_the_derivative(meeting: Meeting, a: float, offset: float) -> None:
    seams, step = SeamLines(mirror(), config().robot), 1e-6
    x = meeting.state.copy()
    x[[A, E0, E1]] = a, offset, offset
    edge = meeting.meet(seams)
    assert edge is not None

    def residual(state: FloatArray) -> float:
        return seams.line(edge, meeting.transition, meeting.late_s, state, meeting.slope()).residual_m

    line = seams.line(edge, meeting.transition, meeting.late_s, x, meeting.slope())
    numeric = [(residual(x - step * row) - residual(x + step * row)) / (2.0 * step) for row in np.eye(STATES)]
    # Rounding of metres over the step; that V depends on A bends by late^3 = 1e-6 and less.
    np.testing.assert_allclose(line.H[0], numeric, atol=2e-9)


def test_the_variance_is_that_of_the_timing_and_of_the_sensor(seams: SeamLines) -> None:
    for v, interval_s in ((0.1, 1e-3), (0.1, 4e-3), (0.03, 1e-3)):
        meeting = Meeting(0, True, True, 0, 0.0, v, 0.0, 0.0)
        transition = meeting.transition._replace(interval_s=interval_s)
        edge = meeting.meet(seams)
        assert edge is not None
        line = seams.line(edge, transition, 0.0, meeting.state, meeting.slope())
        assert line.variance_m2 == pytest.approx((v * interval_s) ** 2 / 12.0 + 1e-10, rel=0.01)  # the slope: 0.1 %


def test_the_sensors_share_the_edge_and_its_offset(seams: SeamLines) -> None:
    first = Meeting(0, True, False, 0, 0.0, 0.1, 0.0, 0.0).meet(seams)
    for corner in (1, 2, 3):
        again = Meeting(0, True, False, corner, 0.0, 0.1, 0.0, 0.0).meet(seams)
        assert first is not None
        assert again == first._replace(is_new=False)


def test_the_two_edges_of_a_gap_have_an_offset_each(seams: SeamLines) -> None:
    left = Meeting(0, True, False, 0, 0.0, 0.1, 0.0, 0.0).meet(seams)
    reached = Meeting(0, True, True, 0, 0.0, 0.1, 0.0, 0.0).meet(seams)
    again = Meeting(0, True, False, 2, 0.0, 0.1, 0.0, 0.0).meet(seams)
    assert left is not None
    assert reached is not None
    assert again is not None
    assert (left.offset, reached.offset, again.is_new) == (E0, E1, False)
    assert reached.position_m - left.position_m == pytest.approx(edges_of(0)[1] - edges_of(0)[0])


def test_another_seam_or_a_pose_found_anew_begins_with_an_unknown_offset(seams: SeamLines) -> None:
    other = Meeting(1, True, False, 0, 0.0, 0.1, 0.0, 0.0)
    changes: tuple[Callable[[], object], ...] = (partial(other.meet, seams), seams.forget)
    for change in changes:
        Meeting(0, True, False, 0, 0.0, 0.1, 0.0, 0.0).meet(seams)
        change()
        edge = Meeting(0, True, False, 0, 0.0, 0.1, 0.0, 0.0).meet(seams)
        assert edge is not None
        assert edge.is_new


def test_a_transition_far_from_every_seam_is_none(seams: SeamLines, mirror: Mirror) -> None:
    meeting = Meeting(0, True, False, 0, 0.0, 0.1, 0.0, 0.0)
    reach_m = 0.05 * 2.0 * mirror.panel(HERE).half_x_m
    for off_m, is_met in ((0.99 * reach_m - NEAR_M, True), (1.01 * reach_m + NEAR_M, False)):
        state = meeting.state.copy()
        state[X] -= off_m
        assert (meeting.meet(seams, state) is not None) is is_met


# -- in the localizer -------------------------------------------------------------------------------------------------


def before_a_seam(k: int, is_up: bool) -> PanelPose:
    """In front of the seam, across it."""
    way = -0.2 if is_up else 0.2
    here = HERE if is_up else PanelId(HERE.row + k, HERE.col + 1 - k)
    near = mirror().panel(here).half_x_m + way if is_up else -mirror().panel(here).half_x_m + way
    heading = (0.5 * np.pi if k else 0.0) + (0.0 if is_up else np.pi)
    return PanelPose(here, *((near, 0.1) if k == 0 else (0.1, near)), heading)


def across_it(sign: float = 1.0) -> Rate:
    """Far enough for all four sensors, and not to a stop."""
    return trapeze(0.4, 9.0, 0.1 * sign, 0.2)


@pytest.mark.parametrize("k", [0, 1])
@pytest.mark.parametrize("is_up", [True, False])
@pytest.mark.parametrize("forward", [1.0, -1.0])
def test_a_seam_places_the_robot(k: int, is_up: bool, forward: float, full: FullStateConfig) -> None:
    """The robot stands 2 mm from where the localizer thinks, and is turned by 10 mrad; it crosses a seam."""
    start = before_a_seam(k, is_up)
    turned = start.heading_rad + (0.0 if forward > 0.0 else np.pi)
    robot = Robot(PanelPose(start.panel, start.x_m + 0.002, start.y_m + 0.002, turned + 0.01), across_it(forward))
    robot.has_edges = True
    found = build(start=PanelPose(start.panel, start.x_m, start.y_m, turned), line_gate=10.0)
    run(found, robot.frames(4.2))
    assert found.counts["crossings_used"] == 8
    assert found.counts["crossings_gated"] == 0
    pose = robot.pose
    across = found.deck_pose.x_m - pose.x_m if k == 0 else found.deck_pose.y_m - pose.y_m
    # Two edges, each within edge_sigma of the map; here they are where the map has them.
    assert abs(across) < 2e-4
    along = hypot(found.deck_pose.x_m - pose.x_m, found.deck_pose.y_m - pose.y_m)
    assert along > 1e-3  # what a seam does not show
    # 50 um of travel in a sample's interval over the sensors' distance of 0.18 m, and eight of them.
    assert abs(errors_of(found, pose)[1]) < 5e-4
    P = found.state[1]
    assert P[X + k, X + k] < full.edge_sigma_m**2
    assert P[Y - k, Y - k] > 1e-6


def test_what_the_map_does_not_know_goes_to_the_offsets() -> None:
    """The edges lie 0.4 mm from the map: the pose is off by that, but the heading is not."""
    robot = Robot(before_a_seam(0, True), across_it(), has_edges=True, shift_m=(4e-4, 0.0))
    found = build(
        start=before_a_seam(0, True),
        start_position_sigma_m=1e-5,
        start_heading_sigma_rad=0.02,
        slip_sigma=1e-5,
        slip_mean=0.0,
        slip_scatter_max=1e-5,
    )
    run(found, robot.frames(4.2))
    mean, _ = found.state
    assert found.counts["crossings_used"] == 8
    for offset in (E0, E1):
        # What remains is the way's own error: 10 um of the start, 1e-5 of slip on 0.2 m, 30 um of the timing.
        assert mean[offset] == pytest.approx(4e-4, abs=1e-4)
    assert abs(errors_of(found, robot.pose)[1]) < 5e-4


def test_an_edge_far_from_where_it_is_expected_is_gated() -> None:
    start = before_a_seam(0, True)
    off = PanelPose(start.panel, start.x_m + 0.02, start.y_m, start.heading_rad)
    robot, found = Robot(off, across_it(), has_edges=True), build(start=start, slip_sigma=1e-3, slip_scatter_max=1e-3)
    run(found, robot.frames(4.2))
    # Ten sigmas of the start's 2 mm; nothing on the way makes it less certain.
    assert found.counts["crossings_used"] == 0
    assert found.counts["crossings_gated"] == 8
    assert errors_of(found, robot.pose)[0] == pytest.approx(0.02, abs=0.006)  # 1.5 % of slip are expected on 0.35 m
