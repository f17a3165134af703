"""The retreat from an edge, where its last turn sweeps another sensor off, and where it needs no turn."""

from math import cos, pi, sin

import pytest

from ccatp.config.load import load_config
from ccatp.control.tracker import LegTracker
from ccatp.core import DeckPose, EventCode, PanelId, PanelPose, Verdict
from ccatp.safety.edge_detector import Cause
from ccatp.survey.retreat import EdgeRetreat, RetreatStep
from ccatp.survey.route_follower import StateEstimate

CFG = load_config()
FRAME_S = 0.01
PANEL = PanelId(1, 1)
Pose = tuple[float, float, float]
Four = tuple[bool, bool, bool, bool]


def off_at(pose: Pose) -> Four:
    """Beyond two rims that meet: what lies at x < 0 or y < 0."""
    x, y, heading = pose
    c, s = cos(heading), sin(heading)
    a, b, rear_a, rear_b = (
        x + c * ox - s * oy < 0.0 or y + s * ox + c * oy < 0.0 for ox, oy in CFG.robot.edge_sensors_m
    )
    return a, b, rear_a, rear_b


def verdict_of(off: Four, *, may_turn: bool, cause: Cause = Cause.RIM) -> Verdict:
    code = EventCode.NEAR_EDGE if any(off) else EventCode.NORMAL
    is_free = not any(off)
    forward, reverse = not (off[0] or off[1]), not (off[2] or off[3])
    return Verdict(0, 0.0, code, cause, "", 0.0, 0.0, forward, reverse, may_turn or is_free, off)


def deck_of(pose: PanelPose) -> DeckPose:
    return DeckPose(pose.x_m, pose.y_m, pose.heading_rad)


def retreated(
    pose: Pose, *, may_turn: bool, blames: Four | None = None, cause: Cause = Cause.RIM
) -> tuple[Pose, list[RetreatStep]]:
    """Where a retreat ends that begins with the sensors that are off there, or ``blames``; wheels follow at once."""
    tracker = LegTracker(CFG.control, CFG.limits, 0.0)
    first = verdict_of(blames or off_at(pose), may_turn=False)
    retreat = EdgeRetreat(CFG.mission, tracker, first, PanelPose(PANEL, *pose), 0.0)
    seen, rate_rad_s = [retreat.step_at], 0.0
    for k in range(1500):
        if retreat.step_at in (RetreatStep.OVER, RetreatStep.STUCK):
            break
        motion = StateEstimate(k * FRAME_S, FRAME_S, PanelPose(PANEL, *pose), deck_of, 0.0, rate_rad_s)
        twist = retreat.step(motion, verdict_of(off_at(pose), may_turn=may_turn, cause=cause))
        rate_rad_s = twist.omega_rad_s
        x, y, heading = pose
        heading += twist.omega_rad_s * FRAME_S
        pose = x + twist.v_m_s * FRAME_S * cos(heading), y + twist.v_m_s * FRAME_S * sin(heading), heading
        if retreat.step_at is not seen[-1]:
            seen.append(retreat.step_at)
    return pose, seen


@pytest.mark.parametrize("heading_rad", [0.0, 0.05, -0.05])
@pytest.mark.parametrize("y_m", [1.0, 0.3])
def test_one_that_met_the_edge_backwards_drives_off_it_and_does_not_turn(y_m: float, heading_rad: float) -> None:
    start = (0.088, y_m, heading_rad)
    assert any(off_at(start)[2:])
    end, seen = retreated(start, may_turn=True)
    assert seen == [RetreatStep.BACK, RetreatStep.OVER]
    assert end[0] >= start[0] + 0.5 * CFG.mission.backoff_m * cos(heading_rad) - 1e-3
    assert end[2] == pytest.approx(heading_rad, abs=1e-3)
    assert not any(off_at(end))


def test_a_turn_away_that_sweeps_a_corner_over_the_rim_is_undone() -> None:
    # It looks along one rim; turned away to the right, to the side of that rim, its right rear comes over it.
    start = (1.0, 0.1, 0.0)
    front_left = (True, False, False, False)
    end, seen = retreated(start, may_turn=True, blames=front_left)
    assert seen == [RetreatStep.BACK, RetreatStep.TURN_AWAY, RetreatStep.UNTURN, RetreatStep.OVER]
    assert not any(off_at(end))
    turned = -end[2]
    assert 0.0 < turned < CFG.mission.turn_away_rad


def test_one_that_may_not_be_undone_ends_with_what_is_gained() -> None:
    start = (1.0, 0.1, 0.0)
    end, seen = retreated(start, may_turn=False, blames=(True, False, False, False))
    assert seen == [RetreatStep.BACK, RetreatStep.TURN_AWAY, RetreatStep.UNTURN, RetreatStep.OVER]
    assert start[0] - end[0] == pytest.approx(0.5 * CFG.mission.backoff_m, abs=2e-3)


@pytest.mark.parametrize("cause", [Cause.NO_MAP, Cause.SEAM])
def test_off_what_may_be_a_seam_it_stands(cause: Cause) -> None:
    _, seen = retreated((1.0, 0.1, 0.0), may_turn=True, blames=(True, False, False, False), cause=cause)
    assert seen == [RetreatStep.BACK, RetreatStep.TURN_AWAY, RetreatStep.OVER]


@pytest.mark.parametrize(("off", "sense"), [((True, False, False, False), -1.0), ((False, True, False, False), 1.0)])
def test_where_there_is_room_it_turns_to_the_side_that_stands(off: Four, sense: float) -> None:
    end, seen = retreated((1.0, 1.0, 0.5 * pi), may_turn=True, blames=off)
    assert seen == [RetreatStep.BACK, RetreatStep.TURN_AWAY, RetreatStep.OVER]
    assert end[1] == pytest.approx(1.0 - 0.5 * CFG.mission.backoff_m, abs=2e-3)
    assert end[2] - 0.5 * pi == pytest.approx(sense * CFG.mission.turn_away_rad, abs=0.05)
