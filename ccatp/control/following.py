"""Pure. Following a moving target at a safe distance: approach, hold, back off, and what to do when it is lost."""

from enum import StrEnum
from typing import NamedTuple

from ccatp.config.radio_models import FollowConfig
from ccatp.control.waypoint_steering import HALT, Aim, Drive, Driver, PlanarPose, Point, aim_at


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
    """

    position_m: Point
    sigma_m: float
    unheard_s: float


class Follower:
    """Keeps a safe distance from a point that moves.

    The distance to keep grows by the uncertainty of the target along the line of sight (one standard deviation), so a
    robot that knows little stays away. The target is approached until it is that near; held while the distance is
    within the band; a target that comes nearer than the band is backed off from. Between band and hold a state is
    kept, so that noise does not switch it.

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
        left_m = self._sight.distance_m - self._cfg.safe_distance_m - target.sigma_m
        self.state = self._next_state(left_m)
        return Aim(max(left_m, 0.0), self._sight.error_rad) if self.state is FollowState.APPROACHING else None

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
        if left_m > band_m or (left_m > 0.0 and self.state is FollowState.APPROACHING):
            return FollowState.APPROACHING
        if left_m < -band_m or (left_m < 0.0 and self.state is FollowState.BACKING):
            return FollowState.BACKING
        return FollowState.HOLDING
