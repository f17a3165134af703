"""The gates for the commands to wheels and fans; they deny by default.

A verdict that names an edge sensor bars that direction, whatever its permits are. A survey moves only under a normal
verdict.
"""

from enum import Enum, StrEnum
from math import isfinite

from ccatp.conditions.mission import FANS_REFUSED
from ccatp.config.models import LimitsConfig, RobotConfig
from ccatp.core import Cause, EventCode, Twist, Verdict
from ccatp.kinematics import wheel_rates

HELD = Twist(0.0, 0.0)
# Part of the limits: room for the feedback, and for the feed-forward of the wheel lag, which adds T a to the speed.
HEADROOM = 1.25
# Longest time between frames for which the step of the set point grows.
MAX_STEP_S = 0.1
_NORMAL, _NEAR_EDGE, _ABORTED = EventCode


class Purpose(Enum):
    """Purpose of a motion."""

    STAND = "stand"
    SURVEY = "survey"
    RETREAT = "retreat"
    HOMEWARD = "homeward"


_STAND, _SURVEY, _RETREAT = Purpose.STAND, Purpose.SURVEY, Purpose.RETREAT


class Denial(StrEnum):
    """Why a drive was set to zero."""

    NOT_FINITE = "the set point is not finite"
    STATE = "the mission's state allows no motion"
    NO_TIME = "no time has passed since the last drive"
    OLD_FRAME = "the sensors frame is too old"
    NO_VERDICT = "there is no verdict"
    OLD_VERDICT = "the verdict is too old"
    EDGE = "it leads towards a declared edge"
    AT_EDGE = "the survey waits while an edge is declared"
    ABORTED = "the survey waits while an emergency is latched"
    NOT_PERMITTED = "the verdict does not permit the direction"


class DriveGate:
    """Converts a wanted twist into wheel rates that are finite, limited and permitted, or into zero.

    The feed-forward may step the set point by the acceleration limit times ``robot.wheel_lag_s``, the time constant T
    of the wheel servo. A frame or verdict older than its timeout denies the motion. ``denied`` counts each reason;
    ``denial`` is that of the last call, None if the drive was passed or zero was wanted.
    """

    def __init__(self, limits: LimitsConfig, robot: RobotConfig, verdict_timeout_s: float) -> None:
        wheel_lag_s = robot.wheel_lag_s
        self._v_max = HEADROOM * limits.v_max_m_s
        self._omega_max = HEADROOM * limits.omega_max_rad_s
        self._v_step = 2.0 * HEADROOM * limits.a_max_m_s2 * wheel_lag_s
        self._omega_step = 2.0 * HEADROOM * limits.alpha_max_rad_s2 * wheel_lag_s
        self._a = HEADROOM * limits.a_max_m_s2
        self._alpha = HEADROOM * limits.alpha_max_rad_s2
        self._radius = robot.wheel_radius_m
        self._base = robot.wheel_base_m
        self._max_wheel = robot.max_wheel_rad_s
        self._verdict_timeout_s = verdict_timeout_s
        self._frame_timeout_s = robot.sensors_timeout_s
        self._last = HELD
        self.denied = dict.fromkeys(Denial, 0)
        self.denial: Denial | None = None

    def pass_through(
        self, wanted: Twist, verdict: Verdict | None, dt_s: float, t_s: float, age_s: float, purpose: Purpose
    ) -> tuple[float, float]:
        """Permitted wheel rates (right, left), rad/s, for a frame at robot time ``t_s`` with age ``age_s``."""
        v, omega = wanted.v_m_s, wanted.omega_rad_s
        if v == 0.0 and omega == 0.0:
            self._last = HELD
            self.denial = None
            return 0.0, 0.0
        self.denial = denial = self._judge(v, omega, verdict, dt_s, t_s, age_s, purpose)
        if denial is not None:
            self.denied[denial] += 1
            self._last = HELD
            return 0.0, 0.0
        dt_s, last = min(dt_s, MAX_STEP_S), self._last
        v_step, omega_step = self._v_step + self._a * dt_s, self._omega_step + self._alpha * dt_s
        # Away from zero a rate changes by at most a step, towards zero without limit.
        if v > 0.0:
            v = min(v, max(last.v_m_s, 0.0) + v_step, self._v_max)
        else:
            v = max(v, min(last.v_m_s, 0.0) - v_step, -self._v_max)
        if omega > 0.0:
            omega = min(omega, max(last.omega_rad_s, 0.0) + omega_step, self._omega_max)
        else:
            omega = max(omega, min(last.omega_rad_s, 0.0) - omega_step, -self._omega_max)
        self._last = allowed = Twist(v, omega)
        right, left = wheel_rates(allowed, self._radius, self._base)
        if abs(right) > self._max_wheel or abs(left) > self._max_wheel:
            scale = self._max_wheel / max(abs(right), abs(left))
            right, left = right * scale, left * scale
        return right, left

    def _judge(
        self, v: float, omega: float, verdict: Verdict | None, dt_s: float, t_s: float, age_s: float, purpose: Purpose
    ) -> Denial | None:
        """Why the motion is denied, or None. The comparisons are written such that NaN is denied."""
        if not (isfinite(v) and isfinite(omega)):
            return Denial.NOT_FINITE
        if purpose is _STAND:
            return Denial.STATE
        if not dt_s > 0.0:
            return Denial.NO_TIME
        if not age_s <= self._frame_timeout_s:
            return Denial.OLD_FRAME
        if verdict is None:
            return Denial.NO_VERDICT
        if not abs(t_s - verdict.t_s) <= self._verdict_timeout_s:
            return Denial.OLD_VERDICT
        return _judge_direction(v, omega, verdict, purpose)


def _judge_direction(v: float, omega: float, verdict: Verdict, purpose: Purpose) -> Denial | None:
    if purpose is not _RETREAT and verdict.code is not _NORMAL:
        if verdict.code is _NEAR_EDGE:
            return Denial.AT_EDGE
        if purpose is _SURVEY:
            return Denial.ABORTED
    front_left, front_right, rear_left, rear_right = verdict.off
    if (v > 0.0 and (front_left or front_right)) or (v < 0.0 and (rear_left or rear_right)):
        return Denial.EDGE
    forward, reverse, turn = v <= 0.0 or verdict.forward, v >= 0.0 or verdict.reverse, omega == 0.0 or verdict.turn
    return None if forward and reverse and turn else Denial.NOT_PERMITTED


class FanGate:
    """Refuses duties that are not between 0 and 1, or below ``floor``, the least duty where the mirror overhangs."""

    def __init__(self, floor: float) -> None:
        self._floor = floor
        self.refused = 0

    def refusal(self, left: float, right: float) -> Cause | None:
        """Why these duties must not be sent, or None. After a refusal the robot keeps its last duties."""
        for name, duty in (("left", left), ("right", right)):
            if not isfinite(duty) or not 0.0 <= duty <= 1.0:
                why = f"duty {duty:g} of the {name} fan is not between 0 and 1"
            elif duty < self._floor:
                why = f"duty {duty:g} of the {name} fan is below the floor of {self._floor:g}"
            else:
                continue
            self.refused += 1
            return FANS_REFUSED.cause(why=why)
        return None
