"""The retreat from an edge, where its last turn sweeps another sensor over the rim."""

from collections.abc import Callable
from math import cos, sin

import pytest

from ccatp.config.loader import load_config
from ccatp.control.tracker import LegTracker
from ccatp.hazards.edge_episode import Cause
from ccatp.samples import DeckPose, EventCode, PanelId, PanelPose, Verdict
from ccatp.surveying.journey import Motion
from ccatp.surveying.retreat import Retreat, Step

CFG = load_config()
FRAME_S = 0.01
PANEL = PanelId(1, 1)
# Two rims that meet: what lies at x < 0 or y < 0 is beyond them.
CORNER_M = CFG.robot.edge_sensors_m


def sensors(pose: tuple[float, float, float]) -> list[tuple[float, float]]:
    x, y, heading = pose
    c, s = cos(heading), sin(heading)
    return [(x + c * ox - s * oy, y + s * ox + c * oy) for ox, oy in CORNER_M]


def off_at(pose: tuple[float, float, float]) -> tuple[bool, bool, bool, bool]:
    a, b, c, d = (x < 0.0 or y < 0.0 for x, y in sensors(pose))
    return a, b, c, d


def verdict_at(pose: tuple[float, float, float], *, may_turn: bool, cause: Cause = Cause.RIM) -> Verdict:
    off = off_at(pose)
    code = EventCode.NEAR_EDGE if any(off) else EventCode.NORMAL
    front, rear = off[0] or off[1], off[2] or off[3]
    return Verdict(0, 0.0, code, cause, "", 0.0, 0.0, not front, not rear, may_turn or not any(off), off)


def deck_of(pose: PanelPose) -> DeckPose:
    return DeckPose(pose.x_m, pose.y_m, pose.heading_rad)


def retreated(
    pose: tuple[float, float, float],
    may_turn: Callable[[Step], bool],
    blames: tuple[bool, bool, bool, bool] = (False, False, False, False),
    cause: Cause = Cause.RIM,
) -> tuple[Step, tuple[float, float, float], list[Step]]:
    """Where a retreat ends that begins with the sensors that are off there, or ``blames``; wheels follow at once."""
    tracker = LegTracker(CFG.control, CFG.limits, 0.0)
    first = verdict_at(pose, may_turn=False)
    if any(blames):
        first = Verdict(0, 0.0, EventCode.NEAR_EDGE, "", "", 0.0, 0.0, not any(blames[:2]), True, False, blames)
    retreat = Retreat(CFG.mission, tracker, first, PanelPose(PANEL, *pose), 0.0)
    seen, rate_rad_s = [retreat.step_at], 0.0
    for k in range(1500):
        if retreat.step_at in (Step.OVER, Step.STUCK):
            break
        here = PanelPose(PANEL, *pose)
        motion = Motion(k * FRAME_S, FRAME_S, here, deck_of, 0.0, rate_rad_s)
        twist = retreat.step(motion, verdict_at(pose, may_turn=may_turn(retreat.step_at), cause=cause))
        rate_rad_s = twist.omega_rad_s
        x, y, heading = pose
        heading += twist.omega_rad_s * FRAME_S
        pose = x + twist.v_m_s * FRAME_S * cos(heading), y + twist.v_m_s * FRAME_S * sin(heading), heading
        if retreat.step_at is not seen[-1]:
            seen.append(retreat.step_at)
    return retreat.step_at, pose, seen


@pytest.mark.parametrize("turns", ["always", "never"])
@pytest.mark.parametrize("heading_rad", [0.0, 0.05, -0.05])
@pytest.mark.parametrize("y_m", [1.0, 0.3])
def test_it_ends_with_all_sensors_on(y_m: float, heading_rad: float, turns: str) -> None:
    # The rear is over one rim. Once it is back, the turn away from there sweeps a rear corner over it again.
    pose = (0.088, y_m, heading_rad)
    assert any(off_at(pose)[2:])
    assert not any(off_at(pose)[:2])
    step, end, seen = retreated(pose, lambda _: turns == "always")
    assert seen[:2] == [Step.BACK, Step.TURN_AWAY]
    assert seen[2:] == [Step.UNTURN if turns == "always" else Step.BACK, Step.OVER]
    assert step is Step.OVER
    assert not any(off_at(end))


def test_in_a_corner_it_stays_with_what_it_has_gained() -> None:
    # The turn leaves it in front of the other rim: there is no way on without a turn back, which is not permitted.
    step, end, seen = retreated((0.088, 0.1, 0.05), lambda _: False)
    assert (step, seen) == (Step.OVER, [Step.BACK, Step.TURN_AWAY, Step.BACK, Step.OVER])
    assert end[0] > 0.088
    assert end[1] > 0.05


def test_what_may_be_a_seam_is_not_driven_along() -> None:
    step, _, seen = retreated((0.088, 1.0, 0.0), lambda _: False, cause=Cause.NO_MAP)
    assert (step, seen) == (Step.OVER, [Step.BACK, Step.TURN_AWAY, Step.OVER])


def test_where_there_is_room_it_turns_away() -> None:
    step, end, seen = retreated((1.0, 1.0, 0.0), lambda _: True, blames=(True, False, False, False))
    assert (step, seen) == (Step.OVER, [Step.BACK, Step.TURN_AWAY, Step.OVER])
    assert end[0] == pytest.approx(1.0 - 0.5 * CFG.mission.backoff_m, abs=2e-3)
    assert end[2] == pytest.approx(-CFG.mission.turn_away_rad, abs=0.05)
