"""Pure. An edge sensor over a panel's edge: what it says of the robot."""

from collections.abc import Callable
from functools import partial
from math import hypot, sqrt
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.config.models import FullStateConfig
from ccatp.core import DeckPose, FloatArray, PanelId, PanelPose
from ccatp.estimation.localizer_base import SensorTransition
from ccatp.estimation.odometry import Slope, Terrain
from ccatp.estimation.seams import Edge, SeamLines
from ccatp.estimation.slip_prior import SlipPopulation, SlipPrior
from ccatp.estimation.state_model import CT, E0, E1, PSI, SL, SR, STATES, A, C, V, W, X, Y
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
        else (here.y_m + here.half_y_m, there.y_m - there.half_y_m)
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
        return seams.edge_of(self.transition, self.late_s, self.state if state is None else state, self.slope())


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
    assert abs(line[0]) < 1e-6


@settings(max_examples=100, deadline=None)
@given(meetings(), st.floats(-0.2, 0.2), st.floats(-3e-4, 3e-4))
def test_its_row_is_the_derivative(meeting: Meeting, a: float, offset: float) -> None:
    seams, step = SeamLines(mirror(), config().robot), 1e-6
    x = meeting.state.copy()
    x[[A, E0, E1]] = a, offset, offset
    edge = meeting.meet(seams)
    assert edge is not None

    def residual(state: FloatArray) -> float:
        return seams.line(edge, meeting.transition, meeting.late_s, state, meeting.slope())[0]

    line = seams.line(edge, meeting.transition, meeting.late_s, x, meeting.slope())
    numeric = [(residual(x - step * row) - residual(x + step * row)) / (2.0 * step) for row in np.eye(STATES)]
    # Rounding of metres over the step; that V depends on A bends by late^3 = 1e-6 and less.
    np.testing.assert_allclose(line[1][0], numeric, atol=2e-9)


def test_the_variance_is_that_of_the_timing_and_of_the_sensor(seams: SeamLines) -> None:
    for v, interval_s in ((0.1, 1e-3), (0.1, 4e-3), (0.03, 1e-3)):
        meeting = Meeting(0, True, True, 0, 0.0, v, 0.0, 0.0)
        transition = meeting.transition._replace(interval_s=interval_s)
        edge = meeting.meet(seams)
        assert edge is not None
        line = seams.line(edge, transition, 0.0, meeting.state, meeting.slope())
        assert line[2] == pytest.approx((v * interval_s) ** 2 / 12.0 + 1e-10, rel=0.01)  # the slope: 0.1 %


def test_the_two_edges_of_a_gap_have_an_offset_each(seams: SeamLines) -> None:
    left = Meeting(0, True, False, 0, 0.0, 0.1, 0.0, 0.0).meet(seams)
    reached = Meeting(0, True, True, 0, 0.0, 0.1, 0.0, 0.0).meet(seams)
    again = Meeting(0, True, False, 2, 0.0, 0.1, 0.0, 0.0).meet(seams)
    assert left is not None
    assert reached is not None
    assert again is not None
    assert (left.offset, reached.offset, again.is_new) == (E0, E1, False)
    assert reached.position_m - left.position_m == pytest.approx(edges_of(0)[1] - edges_of(0)[0])


def test_another_seam_or_a_relocation_starts_with_an_unknown_offset(seams: SeamLines) -> None:
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


@pytest.mark.parametrize(
    ("k", "is_up", "forward"), [(0, True, 1.0), (0, False, -1.0), (1, False, 1.0), (1, True, -1.0)]
)
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


def test_errors_of_the_map_go_to_the_offsets() -> None:
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


DRAWN = [SR, SL, C, CT]


def population() -> SlipPopulation:
    return SlipPopulation([(0.015, 0.015)], 0.02)


def taught(scatter: float, legs: int, seed: int, sigma: float = 5e-4, mean: float = 0.03) -> SlipPopulation:
    """After legs whose parameter is drawn from N(mean, scatter^2) and measured with ``sigma``."""
    rng, found = np.random.default_rng(seed), population()
    for _ in range(legs):
        found.learn([(mean + scatter * float(rng.normal()) + sigma * float(rng.normal()), sigma**2)])
    return found


def test_legs_that_all_slip_alike_shrink_the_scatter() -> None:
    scatters = [sqrt(taught(0.0, legs, 1).scatter) for legs in (0, 3, 10, 40)]
    assert scatters == sorted(scatters, reverse=True)
    assert scatters[-1] < 5e-4 / 2.0  # less than what a single leg can show
    found = taught(0.0, 40, 1)
    assert found.means[0] == pytest.approx(0.03, abs=4.0 * 5e-4 / sqrt(40))
    assert sqrt(found.mean_variances[0]) < 2.0 * 5e-4 / sqrt(40)


@pytest.mark.parametrize("scatter", [0.002, 0.012])
def test_legs_that_differ_show_by_how_much(scatter: float) -> None:
    found = [taught(scatter, 60, seed) for seed in range(20)]
    learned = np.array([sqrt(f.scatter) for f in found])
    # Sixty samples give a standard deviation within 1/sqrt(120) = 9 %; the prior pulls by half of that.
    assert learned.mean() == pytest.approx(scatter, rel=0.08)
    assert learned.std() < 0.15 * scatter
    off = np.array([(f.means[0] - 0.03) / sqrt(f.mean_variances[0]) for f in found])
    assert float((off**2).mean()) == pytest.approx(1.0, abs=4.0 * sqrt(2.0 / 20))


# -- the book ---------------------------------------------------------------------------------------------------------

TO_PARAMETERS = np.eye(4)
TO_PARAMETERS[:2, :2] = [[0.5, 0.5], [1.0, -1.0]]


def state(mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A filter's state that holds this of (right slip, left slip, creep, creep of turns)."""
    x, P = np.zeros(STATES), np.eye(STATES)
    x[DRAWN], P[np.ix_(DRAWN, DRAWN)] = mean, covariance
    return x, P


def test_the_first_leg_is_what_was_expected(full: FullStateConfig) -> None:
    book = SlipPrior(full)
    mean, P = book.first()
    assert mean == pytest.approx([full.slip_mean, full.slip_mean, 0.0, 0.0], abs=1e-15)
    means = TO_PARAMETERS.dot(P).dot(TO_PARAMETERS.T)
    slip, creep = book.scatter
    expected = (
        full.slip_sigma**2 + slip**2,
        full.slip_difference_sigma**2 + 4.0 * slip**2,  # of a difference against that of a mean
        full.creep_sigma**2 * (1.0 + full.creep_scatter_share**2),
        full.turn_creep_sigma_m_rad**2 * (1.0 + full.turn_creep_scatter_share**2),
    )
    np.testing.assert_allclose(means, np.diag(expected), rtol=1e-12, atol=1e-18)
    assert creep == pytest.approx(full.creep_scatter_share * full.creep_sigma)


class Told(NamedTuple):
    """A parameter of the next leg, given what was seen of the legs before: by Bayes, without a recursion."""

    mean: float
    variance: float
    correlation: float  # covariance of the next leg's parameter with that of the last


def by_bayes(mean: float, sigma: float, scatter: float, seen: list[float], noise: float) -> Told:
    """(m, s_1 ... s_k) with s_i = m + d_i; each but the last is measured as ``seen`` with the variance ``noise``."""
    k = len(seen)
    T = np.eye(k + 2)
    T[1:, 0] = 1.0
    P = T @ np.diag([sigma**2] + [scatter] * (k + 1)) @ T.T
    H = np.eye(k + 2)[1:-1]
    K = np.linalg.solve(H @ P @ H.T + noise * np.eye(k), H @ P).T
    x = mean + K @ (np.array(seen) - mean)
    P = P - K @ H @ P
    return Told(float(x[-1]), float(P[-1, -1]), float(P[-1, -2]))


def update(x: FloatArray, P: FloatArray, row: FloatArray, z: float, noise: float) -> tuple[FloatArray, FloatArray]:
    K = P @ row / (row @ P @ row + noise)
    return x + K * (z - row @ x), P - np.outer(K, row @ P)


def test_the_prior_of_the_next_leg_is_that_of_bayes(full: FullStateConfig) -> None:
    """Over four legs; creep, which scatters by a share of itself, only while that has not been learned."""
    book = SlipPrior(full)
    x, P = state(*book.first())
    scatters = [value**2 for value in (book.scatter[0], 2.0 * book.scatter[0], book.scatter[1])]
    priors = ((full.slip_mean, full.slip_sigma), (0.0, full.slip_difference_sigma), (0.0, full.creep_sigma))
    seen: list[list[float]] = [[], [], []]
    noises = (1e-6, 4e-6, 9e-6)
    for leg, values in enumerate([(0.031, -0.004, 0.012), (0.022, 0.003, 0.02), (0.04, 0.0, 0.01), (0.03, 0.01, 0.0)]):
        for k, (z, noise) in enumerate(zip(values, noises, strict=True)):
            row = np.zeros(STATES)
            row[DRAWN] = TO_PARAMETERS[k]
            x, P = update(x, P, row, z, noise)
            seen[k].append(z)
        F, b, Q = book.begin(x, P)  # no fix has ended the leg: the scatter of the slip is as before
        posterior = P[np.ix_(DRAWN, DRAWN)]
        mean, covariance = F @ x[DRAWN] + b, F @ posterior @ F.T + Q
        found = TO_PARAMETERS @ covariance @ TO_PARAMETERS.T
        across = TO_PARAMETERS @ F @ posterior @ TO_PARAMETERS.T  # of the next leg's with the last one's
        for k in range(3 if leg == 0 else 2):
            reported = by_bayes(*priors[k], scatters[k], seen[k], noises[k])
            assert TO_PARAMETERS[k] @ mean == pytest.approx(reported.mean, rel=1e-9)  # rounding
            assert across[k, k] == pytest.approx(reported.correlation, rel=1e-9)
            assert found[k, k] == pytest.approx(reported.variance, rel=1e-9)
        x[DRAWN], P[np.ix_(DRAWN, DRAWN)] = mean, covariance


def drive(book: SlipPrior, slips: list[tuple[float, float]], noise: float) -> None:
    """Legs of these slips (right, left), each seen with the variance ``noise`` and ended by a fix."""
    rng = np.random.default_rng(3)
    x, P = state(*book.first())
    for k, (right, left) in enumerate(slips):
        if k:
            F, b, Q = np.eye(STATES), np.zeros(STATES), np.zeros((STATES, STATES))
            F[np.ix_(DRAWN, DRAWN)], b[DRAWN], Q[np.ix_(DRAWN, DRAWN)] = book.begin(x, P)
            x, P = F @ x + b, F @ P @ F.T + Q
        for state_, slip in ((SR, right), (SL, left)):
            x, P = update(x, P, np.eye(STATES)[state_], slip + sqrt(noise) * float(rng.normal()), noise)
        book.end(x, P)


@pytest.mark.parametrize("half_width", [0.02])
def test_a_floor_on_which_every_leg_slips_differently(full: FullStateConfig, half_width: float) -> None:
    book, rng = SlipPrior(full), np.random.default_rng(4)
    drive(book, [tuple(rng.uniform(0.03 - half_width, 0.03 + half_width, 2).tolist()) for _ in range(150)], 1e-7)
    # A uniform distribution's sigma is its half width over sqrt(3), the mean of two wheels has 1/sqrt(2) of that. Of
    # the last 100 legs, which are remembered, 7 %.
    assert book.scatter[0] == pytest.approx(half_width / sqrt(6.0), rel=0.2)


def test_only_a_leg_that_was_ended_by_a_fix_teaches_its_scatter(full: FullStateConfig) -> None:
    for is_told, is_learned in ((True, False), (False, True)):
        book = SlipPrior(full)
        before = book._slip_scatter.scatter
        x, P = state(*book.first())
        x, P = update(x, P, np.eye(STATES)[SR], 0.05, 1e-8)
        if is_told:
            book.forget_leg()
        book.end(x, P)
        assert (book._slip_scatter.scatter != before) is is_learned
        once = book._slip_scatter.scatter
        book.end(x, P)  # a second fix of the same leg
        assert book._slip_scatter.scatter == once
