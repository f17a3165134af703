"""What the robot does at the mirror's edge: back off, turn away, stand still for a fix (thesis 3.4.1)."""

from enum import StrEnum
from math import copysign, hypot

from ccatp.config.models import MissionConfig
from ccatp.control.tracker import LegPhase, LegTracker
from ccatp.core import EventCode, PanelPose, Twist, Verdict, difference
from ccatp.safety.edge_detector import Cause
from ccatp.survey.route_follower import StateEstimate

STILL = Twist(0.0, 0.0)
# A turn that met the rim is undone by at most this; more would sweep the next corner.
UNTURN_LIMIT_RAD = 0.8
# 60 mm at 0.05 m/s and a turn take three seconds: after this long a wheel is blocked, or nothing is permitted.
TIME_LIMIT_S = 15.0


class RetreatStep(StrEnum):
    """What the retreat is at."""

    BACK = "back"
    UNTURN = "unturn"
    TURN_AWAY = "turn away"
    OVER = "over"
    STUCK = "stuck"


class EdgeRetreat:
    """One back-off along the track just driven, then a turn away from the side that hung over.

    A robot that met the edge backwards faces away from it, and does not turn.
    """

    def __init__(
        self, cfg: MissionConfig, tracker: LegTracker, verdict: Verdict, pose: PanelPose, rate_rad_s: float
    ) -> None:
        self._cfg, self._tracker = cfg, tracker
        self._last = pose
        self._time_s = 0.0
        self._travel_m = self._turned_rad = 0.0
        self._away_rad: float | None = None
        self._has_turned_away = False
        front_left, front_right, rear_left, rear_right = verdict.off
        front, rear = front_left or front_right, rear_left or rear_right
        left, right = front_left or rear_left, front_right or rear_right
        # Turning is to the side that stands on the mirror; where both or none do, to the left.
        self._away = -cfg.turn_away_rad if left and not right else cfg.turn_away_rad
        self._direction = -1.0 if front else 1.0
        self._after_back = RetreatStep.TURN_AWAY if front else RetreatStep.OVER
        self._unturn = -copysign(1.0, rate_rad_s)
        if verdict.turn and not (front and rear):
            self.step_at = RetreatStep.UNTURN
        elif front != rear:
            self.step_at = RetreatStep.BACK
        else:
            self.step_at = RetreatStep.STUCK

    def step(self, motion: StateEstimate, verdict: Verdict) -> Twist:
        """The twist until the next frame; ``step_at`` tells what it is at."""
        pose = motion.pose
        if pose.panel == self._last.panel:
            self._travel_m += hypot(pose.x_m - self._last.x_m, pose.y_m - self._last.y_m)
            self._turned_rad += abs(difference(pose.heading_rad, self._last.heading_rad))
        self._last = pose
        self._time_s += motion.dt_s
        if self._time_s > TIME_LIMIT_S and self.step_at is not RetreatStep.OVER:
            self.step_at = RetreatStep.STUCK
        if not (verdict.forward or verdict.reverse or verdict.turn):
            return STILL  # data are missing, which passes by itself
        is_clear = verdict.code is not EventCode.NEAR_EDGE
        if self.step_at is RetreatStep.BACK:
            return self._back(is_clear, verdict)
        if self.step_at is RetreatStep.UNTURN:
            return self._undo_turn(is_clear, verdict)
        if self.step_at is RetreatStep.TURN_AWAY:
            return self._turn_away(motion, is_clear, verdict)
        return STILL

    def _back(self, is_clear: bool, verdict: Verdict) -> Twist:
        if self._travel_m >= self._cfg.backoff_m or (is_clear and self._travel_m >= 0.5 * self._cfg.backoff_m):
            self.step_at = self._after_back if is_clear else RetreatStep.STUCK
            return STILL
        if not (verdict.reverse if self._direction < 0.0 else verdict.forward):
            self.step_at = RetreatStep.STUCK
            return STILL
        return Twist(self._direction * self._cfg.backoff_speed_m_s, 0.0)

    def _undo_turn(self, is_clear: bool, verdict: Verdict) -> Twist:
        if is_clear:
            self.step_at = RetreatStep.OVER
            return STILL
        if self._turned_rad >= UNTURN_LIMIT_RAD or not verdict.turn:
            self.step_at = RetreatStep.OVER if self._has_turned_away else RetreatStep.BACK
            return STILL
        return Twist(0.0, self._unturn * self._cfg.turn_away_rad)

    def _turn_away(self, motion: StateEstimate, is_clear: bool, verdict: Verdict) -> Twist:
        if not is_clear:
            # The turn sweeps a corner off the panels. Off the rim, back; off what may be a seam, the fix tells.
            self._has_turned_away = True
            self._unturn, self._turned_rad = -copysign(1.0, self._away), 0.0
            self.step_at = RetreatStep.UNTURN if verdict.cause.startswith(Cause.RIM) else RetreatStep.OVER
            return STILL
        if self._away_rad is None:
            self._away_rad = motion.pose.heading_rad + self._away
            self._tracker.begin_turn(self._away)
        state = motion.steered
        remaining = difference(self._away_rad, state.pose[2])
        twist = self._tracker.step_turn(remaining, motion.dt_s, state.omega_rad_s)
        if self._tracker.phase is LegPhase.DONE:
            self.step_at = RetreatStep.OVER
        return twist
