"""Pure. Following a moving target at a safe distance: approach, hold, back off, and what to do when it is lost."""

from enum import StrEnum
from math import hypot
from typing import NamedTuple

from ccatp.config.radio_models import FollowConfig
from ccatp.control.waypoint_steering import HALT, Aim, Drive, Driver, PlanarPose, Point, aim_at

_NEAREST_M = 0.02  # nearer than that a direction means nothing


class FollowState(StrEnum):
    """What a follower is doing."""

    LOST = "lost"  # not heard for too long, or never: stands
    APPROACHING = "approaching"
    HOLDING = "holding"  # within the band round the safe distance: stands
    BACKING = "backing"  # too near


class TargetSight(NamedTuple):
    """What is believed of the target.

    Attributes:
        position_m: where it is.
        sigma_m: standard deviation of its distance.
        unheard_s: since it was last heard.
        velocity_m_s: how it moves.
    """

    position_m: Point
    sigma_m: float
    unheard_s: float
    velocity_m_s: Point = (0.0, 0.0)


class Follower:
    """Keeps a safe distance from a point that moves.

    The distance to keep grows by the uncertainty of the target along the line of sight, so a robot that knows little
    stays away, and by what the target will have come nearer in a moment. It is a limit from below: a target that is
    nearer is backed off from until it is a band farther; one that is farther than two bands beyond is approached until
    it is one band beyond; in between the robot stands. So noise does not switch its state.

    Attributes:
        state: what it is doing.

    Args:
        cfg: distances and time-out.
        driver: what turns an aim into set points.
    """

    def __init__(self, cfg: FollowConfig, driver: Driver) -> None:
        self._cfg = cfg
        self._driver = driver
        self.state = FollowState.LOST
        self._sight: Aim | None = None

    def aim(self, pose: PlanarPose, target: TargetSight | None) -> Aim | None:
        """What is left to go, and decides what to do; None while nothing is to be approached.

        Args:
            pose: x m, y m, heading rad.
            target: what is believed of it; None before it was first heard.
        """
        self._sight = None
        if target is None or target.unheard_s > self._cfg.lost_after_s:
            self.state = FollowState.LOST
            return None
        self._sight = aim_at(pose, target.position_m)
        cfg = self._cfg
        closing_m = cfg.foresight_s * _closing_m_s(pose, target)
        # at most as much again: who stays away from what he does not know learns nothing of it
        margin_m = min(cfg.margin_sigmas * target.sigma_m, cfg.safe_distance_m)
        left_m = self._sight.distance_m - cfg.safe_distance_m - margin_m - closing_m
        self.state = self._next_state(left_m)
        if self.state is not FollowState.APPROACHING:
            return None
        return Aim(max(left_m - cfg.band_m, 0.0), self._sight.error_rad)

    def stay(self) -> Drive:
        """Set points while nothing is to be approached: back off, turn to the target, or stand."""
        self._driver.reset()
        if self._sight is None:
            return HALT
        if self.state is FollowState.BACKING:
            return self._driver.away(self._cfg.back_speed_m_s, self._sight.error_rad)
        return self._driver.face(self._sight.error_rad)

    def _next_state(self, left_m: float) -> FollowState:
        band_m = self._cfg.band_m
        if left_m > 2.0 * band_m or (left_m > band_m and self.state is FollowState.APPROACHING):
            return FollowState.APPROACHING
        if left_m < 0.0 or (left_m < band_m and self.state is FollowState.BACKING):
            return FollowState.BACKING
        return FollowState.HOLDING


def _closing_m_s(pose: PlanarPose, target: TargetSight) -> float:
    """How fast the target comes nearer by its own motion; 0 if it goes away."""
    dx_m, dy_m = pose[0] - target.position_m[0], pose[1] - target.position_m[1]
    vx, vy = target.velocity_m_s
    return max(0.0, (vx * dx_m + vy * dy_m) / max(hypot(dx_m, dy_m), _NEAREST_M))
