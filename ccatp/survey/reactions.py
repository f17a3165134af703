"""How a survey reacts to the danger loop's verdict, an unattended fault, and a mirror that contradicts gravity."""

from collections.abc import Sequence
from enum import StrEnum
from math import acos, degrees, pi, radians, sqrt
from statistics import median

from ccatp.config.models import Config
from ccatp.core import Corner, DeckPose, EventCode, Severity, Verdict
from ccatp.mirror.mirror import Mirror
from ccatp.survey.route_follower import StateEstimate
from ccatp.survey.state import (
    DRIVING,
    HELD,
    IDLE,
    MEASURING,
    RETURNING,
    SETTLING,
    TURNING,
    MissionEvent,
    MissionState,
    SurveyState,
)
from ccatp.survey.stops import EdgeRetreat

NEAR_EDGE, ABORTED = EventCode.NEAR_EDGE, EventCode.ABORTED
NONE, SLOW, HOLD, RETURN, FAULT = Severity.NONE, Severity.SLOW, Severity.HOLD, Severity.RETURN, Severity.FAULT
_CORNERS = frozenset(Corner)
# So long after a fix found the robot the danger loop has heard where it is: a pose in five frames, and a verdict.
_NOTICED_S = 0.2
EARTHQUAKE = "emergency: earthquake"


class Failsafe:
    """Takes the verdict of each frame before anything moves."""

    def __init__(self, survey: SurveyState) -> None:
        self._survey = survey
        self._finding = ""
        self._emergency_epoch: int | None = 0
        self._was_lost = self._has_looked = False

    def skip_present_emergency(self) -> None:
        """Whatever is latched when the first verdict comes was acted on before."""
        self._emergency_epoch = None

    def react(self, motion: StateEstimate, verdict: Verdict | None) -> None:
        """Do what the verdict in force demands (``None``: none fresh enough)."""
        survey = self._survey
        if verdict is not None and self._emergency_epoch is None:
            self._emergency_epoch = verdict.raised
        self._wait_for_verdict(motion.t_s, verdict)
        if verdict is not None and self._on_earthquake(verdict):
            return
        if verdict is not None and (verdict.severity is not NONE or survey.severity is not NONE):
            survey.severity = verdict.severity
            if self._apply_severity(verdict):
                return
        if survey.stuck_s is not None and self._waits_at_edge(motion.t_s, verdict):
            return
        if verdict is None or not (verdict.forward and verdict.reverse and verdict.turn):
            self._hold_position(motion, verdict)
            return
        if verdict.code is NEAR_EDGE:
            self._on_edge(motion, verdict)
            return
        if verdict.code is ABORTED and self._is_new_emergency(verdict):
            survey.abort(verdict.cause)
        is_waiting = survey.state is HELD and (survey.awaits_operator or motion.t_s < survey.waits_until_s)
        if survey.state is IDLE or (survey.state is HELD and not is_waiting):
            survey.proceed()

    def _wait_for_verdict(self, t_s: float, verdict: Verdict | None) -> None:
        """Found at an edge, the robot stands until the danger loop knows where: what it met may have been a seam."""
        survey = self._survey
        if verdict is not None and verdict.severity < HOLD:
            self._has_looked = False
        if self._was_lost and not survey.needs_fix and verdict is not None and verdict.code is NEAR_EDGE:
            survey.stands_until_s = t_s + _NOTICED_S
        self._was_lost = survey.needs_fix

    def _hold_position(self, motion: StateEstimate, verdict: Verdict | None) -> None:
        survey = self._survey
        if verdict is None:
            survey.interrupt("no fresh verdict from the danger loop")
        elif verdict.code is NEAR_EDGE:
            self._on_edge(motion, verdict)
        elif not (survey.needs_fix and survey.state in (SETTLING, MEASURING)):
            # A robot that stands to be found needs no permission, and without a pose gets none before it is.
            survey.interrupt(verdict.cause)

    def _is_new_emergency(self, verdict: Verdict) -> bool:
        """Whether another emergency was raised since the last look: the level is repeated in each verdict."""
        is_new, self._emergency_epoch = verdict.raised != self._emergency_epoch, verdict.raised
        return is_new

    def _on_earthquake(self, verdict: Verdict) -> bool:
        """Nothing moves while the ground shakes, unless away from an edge; whether that is all for this frame."""
        survey = self._survey
        survey.is_latched, survey.is_shaking = verdict.raised > 0, verdict.is_shaking
        if not verdict.is_shaking:
            survey.interlock = ""
            return False
        survey.wants_full_fans = True
        if verdict.code is NEAR_EDGE:
            return False
        self._emergency_epoch = verdict.raised
        self._hold_for_earthquake()
        return verdict.severity is not FAULT  # which an operator has to look after, too

    def _hold_for_earthquake(self) -> None:
        """Held, and home when it is over; a pose from before is not to be trusted then."""
        survey = self._survey
        if survey.interlock or survey.state is MissionState.DONE:
            return
        survey.interlock = EARTHQUAKE
        survey.abort_cause = survey.abort_cause or EARTHQUAKE
        survey.invalidate_pose()
        survey.hold(EARTHQUAKE, by_hand=survey.is_held_by_hand)

    def _apply_severity(self, verdict: Verdict) -> bool:
        survey, severity = self._survey, verdict.severity
        survey.wants_full_fans |= verdict.full_fans
        is_denied = not (verdict.forward or verdict.reverse or verdict.turn)
        if severity is FAULT:
            if not (survey.state is HELD and survey.is_faulted):
                survey.fault(verdict.cause, is_lost=True)
            return True
        if is_denied and severity is HOLD and verdict.signal in _CORNERS and self._relocalizes_once(verdict.cause):
            return True
        if is_denied and severity >= HOLD:
            survey.await_recovery(verdict.cause, is_pose_doubted=verdict.signal not in _CORNERS)
            return True
        self._pace(is_slow=severity in (SLOW, RETURN))
        if severity is RETURN and verdict.code is not NEAR_EDGE and verdict.cause != self._finding:
            self._finding = verdict.cause
            survey.abort(verdict.cause)
        return False

    def _relocalizes_once(self, cause: str) -> bool:
        """A sensor that stays off may be over a seam or the rim where the pose is wrong: one fix, at rest, tells."""
        survey = self._survey
        if survey.state is MissionState.DONE or survey.is_held_by_hand:
            return False
        if not self._has_looked:
            self._has_looked = True
            survey.await_recovery(cause)
            survey.proceed()
        return survey.needs_fix and survey.state in (SETTLING, MEASURING)

    def _pace(self, *, is_slow: bool) -> None:
        """Drive at the reduced speed from now on, or at the usual one from the next leg on."""
        survey = self._survey
        if is_slow is survey.tracker.is_slow:
            return
        survey.tracker.is_slow = is_slow
        if is_slow and survey.state in (DRIVING, TURNING, RETURNING):
            survey.interrupt_leg()

    def _waits_at_edge(self, t_s: float, verdict: Verdict | None) -> bool:
        """After a retreat that led nowhere: whether to go on waiting until no sensor hangs over any more."""
        survey = self._survey
        if survey.state is not HELD or survey.awaits_operator or survey.stuck_s is None:
            survey.stuck_s = None
            return False
        if verdict is not None and verdict.code is not NEAR_EDGE:
            survey.stuck_s = None
            return False
        if t_s - survey.stuck_s > survey.cfg.health.hold_limit_s:
            survey.stuck_s = None
            survey.fault(survey.cause)
        return True

    def _on_edge(self, motion: StateEstimate, verdict: Verdict) -> None:
        survey = self._survey
        if survey.state in (MissionState.BACKING_OFF, MissionState.DONE):
            return
        if survey.rejects_odometry:
            survey.proceed()  # where the edge is, is not known before a fix; standing still for it is safe anywhere
        if survey.needs_fix and survey.state in (SETTLING, MEASURING):
            return  # it stands, and a rim on the map is a matter of the pose that is being found
        if survey.is_held_by_hand:
            return
        if motion.t_s < survey.stands_until_s:
            return
        mission = survey.cfg.mission
        survey.backoffs += 1
        if survey.backoffs > mission.max_backoffs_per_stop:
            survey.backoffs = 0
            survey.fault(f"at the edge again after {mission.max_backoffs_per_stop} back-offs: is an edge sensor dirty?")
            return
        # Back at an edge right after a fix of the place: then it is the heading that is wrong.
        survey.inflates_covariance |= survey.backoffs > 1
        survey.cause = verdict.cause
        survey.interrupt_parts()
        # An edge that the route did not foresee means that the pose is wrong: it is found again before moving on.
        survey.invalidate_pose()
        survey.apply(MissionEvent.EDGE)
        survey.retreat = EdgeRetreat(mission, survey.tracker, verdict, motion.pose, motion.rate_rad_s)


_EARLY = 1.05  # from the decision to the first turn of a wheel some charge goes, too


class FaultAction(StrEnum):
    """What the timer asks for."""

    NOTHING = ""
    REMIND = "remind"
    RETURN = "return"


class UnattendedFaultTimer:
    """A reminder while no operator resumes a faulted robot, and home before the battery no longer lasts for it.

    ``falls``: without fans the robot falls off this mirror; only there it is worth moving without an operator.
    """

    def __init__(self, cfg: Config, *, falls: bool) -> None:
        self._alarm_period_s, self._health, self._falls = cfg.mission.alarm_period_s, cfg.health, falls
        self._since_s: float | None = None
        self._remind_at_s = 0.0
        self._has_returned = False

    def held_s(self, t_s: float) -> float:
        """How long the fault lasts."""
        return 0.0 if self._since_s is None else t_s - self._since_s

    def over(self) -> None:
        """There is no fault any more."""
        self._since_s = None

    def watch(self, t_s: float, soc: float, home_s: float | None) -> FaultAction:
        """One frame of a fault; state of charge 0 to 1.

        ``home_s`` is None where the robot does not know where it is.
        """
        if self._since_s is None or t_s < self._since_s:
            self._since_s, self._remind_at_s = t_s, t_s + self._alarm_period_s
        # Once: a return that failed may have failed for the reason of the fault.
        if self._falls and not self._has_returned and home_s is not None and self.is_low(soc, home_s):
            self._has_returned = True
            return FaultAction.RETURN
        if t_s < self._remind_at_s:
            return FaultAction.NOTHING
        self._remind_at_s = t_s + self._alarm_period_s
        return FaultAction.REMIND

    def is_low(self, soc: float, home_s: float) -> bool:
        """Whether the charge above the reserve is less than the way home may take."""
        needed = _EARLY * self._health.battery_margin * home_s / self._health.battery_life_s
        return not soc - self._health.battery_reserve > needed


# A mirror that is more than 5 deg off must never pass. The median of so many readings of 2 deg each is right within 0.4
# deg, one standard deviation; what else may differ (the start pose, the sensor's mounting) is far below the limit.
LIMIT_RAD = radians(3.5)
READINGS = 40
# What has come in after this time has to do, s; none at all: the robot has no such sensor.
PATIENCE_S = 4.0


class MirrorCheck:
    """Before the first motion: does gravity agree with the slope of the configured mirror? The heading plays no part.

    ``contradiction``: why the mirror cannot be this one, or empty; ``warning``: what could not be checked.
    """

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._slopes_rad: list[float] = []
        self._first_s: float | None = None
        self.contradiction = self.warning = ""

    def update(self, t_s: float, gravity: Sequence[float] | None, pose: DeckPose) -> bool:
        """Take a frame and gravity's direction in the robot frame, where it was read.

        True once the check is complete.
        """
        if self._first_s is None:
            self._first_s = t_s
        if gravity is not None:
            self._slopes_rad.append(_slope(gravity[1:]))
        is_over = abs(t_s - self._first_s) >= PATIENCE_S
        if len(self._slopes_rad) < READINGS and not is_over:
            return False
        if not self._slopes_rad:
            self.warning = "the robot tells no gravity: nobody knows whether it stands on the configured mirror"
            return True
        felt_rad, expected_rad = median(self._slopes_rad), _slope(self._mirror.gravity_in_robot(pose))
        if abs(felt_rad - expected_rad) > LIMIT_RAD:
            self.contradiction = (
                f"the robot stands on a slope of {degrees(felt_rad):.1f} deg, {self._mirror.name} has one of "
                f"{degrees(expected_rad):.1f} deg there: is this the right mirror (run.mirror, --mirror)?"
            )
        return True


def _slope(gravity: Sequence[float]) -> float:
    """Angle between the surface and the horizontal, rad; more than a right angle where the surface overhangs."""
    x, y, z = gravity
    return pi - acos(max(-1.0, min(1.0, z / sqrt(x * x + y * y + z * z))))
