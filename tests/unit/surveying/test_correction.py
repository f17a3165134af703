"""Correction moves: the least motion, and none over the rim."""

from math import cos, hypot, pi, sin

import pytest

from ccatp.config.models import Config
from ccatp.core import DeckPose, PanelId, PanelPose, Stop, StopKind
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.survey.route_follower import Corrector, LegAim, plan_aim

POSE = (0.1, 0.2, 0.5)


@pytest.fixture(scope="module")
def mirror(config: Config) -> Mirror:
    return build_mirror(config.mirror)


@pytest.fixture
def corrector(config: Config, mirror: Mirror) -> Corrector:
    return Corrector(mirror, config.robot, config.mission)


def seen(ahead_m: float, left_m: float) -> tuple[float, float]:
    x, y, heading = POSE
    c, s = cos(heading), sin(heading)
    return x + c * ahead_m - s * left_m, y + s * ahead_m + c * left_m


@pytest.mark.parametrize("ahead_m", [0.02, -0.02])
@pytest.mark.parametrize("left_m", [0.0069, -0.0069])
def test_what_lies_nearly_along_the_heading_is_driven_to_without_a_turn(ahead_m: float, left_m: float) -> None:
    aim = plan_aim(POSE, seen(ahead_m, left_m), 0.010, 0.7)
    assert aim == pytest.approx(LegAim(*seen(ahead_m, 0.0), ahead_m < 0.0, 0.0))


@pytest.mark.parametrize(
    ("ahead_m", "left_m", "reverse", "turn_rad"),
    [
        (0.01, 0.01, False, pi / 4),
        (0.01, -0.01, False, -pi / 4),
        (-0.01, 0.01, True, -pi / 4),
        (-0.01, -0.01, True, pi / 4),
    ],
)
def test_else_the_robot_turns_by_the_smaller_angle(
    ahead_m: float, left_m: float, reverse: bool, turn_rad: float
) -> None:
    target = seen(ahead_m, left_m)
    aim = plan_aim(POSE, target, 0.010, 0.7)
    assert aim == pytest.approx(LegAim(*target, reverse, turn_rad))
    sign = -1.0 if aim.reverse else 1.0
    heading, distance = POSE[2] + aim.turn_rad, hypot(ahead_m, left_m)
    # Driven that far that way the robot is there.
    assert POSE[0] + sign * distance * cos(heading) == pytest.approx(target[0])
    assert POSE[1] + sign * distance * sin(heading) == pytest.approx(target[1])


def test_beyond_its_reach_there_is_no_correction(corrector: Corrector, config: Config) -> None:
    pose = PanelPose(PanelId(5, 5), 0.0, 0.0, 0.0)
    reach = config.mission.correction_reach_m
    assert corrector.aim(pose, (0.99 * reach, 0.0)) is not None
    assert corrector.aim(pose, (1.01 * reach, 0.0)) is None


def at_the_rim(mirror: Mirror, depth_m: float) -> PanelPose:
    """On the last panel of the middle row, ``depth_m`` from the rim at its right, heading along it."""
    y = mirror.deck_pose(PanelPose(PanelId(5, 5), 0.0, 0.0, 0.0)).y_m
    x = max(float(vx) for vx, _ in mirror.rim.vertices) - depth_m
    col = max(panel.col for panel in mirror.panels if panel.row == 5)
    return mirror.panel_pose(PanelId(5, col), DeckPose(x, y, pi / 2))


def test_no_sensor_may_pass_the_rim_on_the_way(corrector: Corrector, mirror: Mirror) -> None:
    # Sensors 0.09 m beside the robot stand 15 mm inside the rim; turning they reach out to 0.127 m.
    pose = at_the_rim(mirror, 0.105)
    along = (pose.x_m, pose.y_m + 0.03)
    assert corrector.aim(pose, along) is not None
    for depth_m, is_safe in ((0.105, False), (0.2, True)):
        pose = at_the_rim(mirror, depth_m)  # it would have to turn
        assert (corrector.aim(pose, (pose.x_m - 0.03, pose.y_m + 0.001)) is not None) is is_safe


def test_no_correction_ends_with_a_sensor_beyond_the_rim(corrector: Corrector, mirror: Mirror) -> None:
    outward = at_the_rim(mirror, 0.105)
    facing = PanelPose(outward.panel, outward.x_m, outward.y_m, outward.heading_rad - pi / 2)
    assert corrector.aim(facing, (facing.x_m + 0.004, facing.y_m)) is not None
    assert corrector.aim(facing, (facing.x_m + 0.012, facing.y_m)) is None


def test_after_a_correction_a_turn_at_the_rim_is_looked_at(corrector: Corrector, mirror: Mirror) -> None:
    for depth_m, is_safe in ((0.105, False), (0.2, True)):
        pose = mirror.deck_pose(at_the_rim(mirror, depth_m))
        assert corrector.can_go_on(pose, Stop(pose.x_m, pose.y_m + 0.2, StopKind.MEASURE))
        assert corrector.can_go_on(pose, Stop(pose.x_m - 0.2, pose.y_m, StopKind.MEASURE)) is is_safe
        assert corrector.can_go_on(pose, Stop(pose.x_m, pose.y_m - 0.2, StopKind.MEASURE, reverse=True))
