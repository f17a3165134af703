"""Pure. How a survey reacts to the danger loop's verdict: holds, retreats from edges, ways home, waiting."""

from ccatp.samples import Corner, EventCode, Severity, Verdict
from ccatp.surveying.journey import Motion
from ccatp.surveying.retreat import Retreat
from ccatp.surveying.standing import Standing
from ccatp.surveying.states import DRIVING, HELD, IDLE, MEASURING, RETURNING, SETTLING, TURNING, Event, State

NEAR_EDGE, ABORTED = EventCode.NEAR_EDGE, EventCode.ABORTED
NONE, SLOW, HOLD, RETURN, FAULT = Severity.NONE, Severity.SLOW, Severity.HOLD, Severity.RETURN, Severity.FAULT
_CORNERS = frozenset(Corner)
# So long after a fix found the robot the danger loop has heard where it is: a pose in five frames, and a verdict.
_HEARD_S = 0.2
EARTHQUAKE = "emergency: earthquake"


def abort(standing: Standing, cause: str) -> str | None:
    """Return to base and end there; why that is refused, or ``None``."""
    if standing.state is State.DONE:
        return "the mission is over"
    is_news = standing.abort_cause is None
    standing.abort_cause = standing.abort_cause or cause
    if standing.bar:
        return None  # home, but not before the robot may move
    # An edge outranks an abort: the retreat and its fix come first.
    if standing.state is State.HELD or (is_news and standing.state is not State.BACKING_OFF and not standing.is_lost):
        standing.go_on()
    return None


class Reactions:
    """Hears the verdict of each frame before anything moves.

    Args:
        standing: what the rooms of the survey share.
    """

    def __init__(self, standing: Standing) -> None:
        """No verdict yet."""
        self._standing = standing
        self._finding = ""
        self._raised: int | None = 0
        self._was_lost = self._has_looked = False

    def know_emergency(self) -> None:
        """Whatever is latched when the first verdict comes was acted on before."""
        self._raised = None

    def react(self, motion: Motion, verdict: Verdict | None) -> None:
        """Do what the verdict demands.

        Args:
            motion: the present frame.
            verdict: in force, ``None`` where there is none fresh enough.
        """
        standing = self._standing
        if verdict is not None and self._raised is None:
            self._raised = verdict.raised
        self._await_news(motion.t_s, verdict)
        if verdict is not None and self._heed_earthquake(verdict):
            return
        if verdict is not None and (verdict.severity is not NONE or standing.severity is not NONE):
            standing.severity = verdict.severity
            if self._obey(verdict):
                return
        if standing.stuck_s is not None and self._waits_at_edge(motion.t_s, verdict):
            return
        if verdict is None or not (verdict.forward and verdict.reverse and verdict.turn):
            self._stay(motion, verdict)
            return
        if verdict.code is NEAR_EDGE:
            self._meet_edge(motion, verdict)
            return
        if verdict.code is ABORTED and self._is_news(verdict):
            abort(standing, verdict.cause)
        is_waiting = standing.state is HELD and (standing.is_held_by_hand or motion.t_s < standing.waits_until_s)
        if standing.state is IDLE or (standing.state is HELD and not is_waiting):
            standing.go_on()

    def _await_news(self, t_s: float, verdict: Verdict | None) -> None:
        """Found at an edge, the robot stands until the danger loop knows where: what it met may have been a seam."""
        standing = self._standing
        if verdict is not None and verdict.severity < HOLD:
            self._has_looked = False
        if self._was_lost and not standing.is_lost and verdict is not None and verdict.code is NEAR_EDGE:
            standing.stands_until_s = t_s + _HEARD_S
        self._was_lost = standing.is_lost

    def _stay(self, motion: Motion, verdict: Verdict | None) -> None:
        """Not every motion is permitted, or there is no verdict."""
        standing = self._standing
        if verdict is None:
            standing.interrupt("no fresh verdict from the danger loop")
        elif verdict.code is NEAR_EDGE:
            self._meet_edge(motion, verdict)
        elif not (standing.is_lost and standing.state in (SETTLING, MEASURING)):
            # A robot that stands to be found needs no permission, and without a pose gets none before it is.
            standing.interrupt(verdict.cause)

    def _is_news(self, verdict: Verdict) -> bool:
        """Whether another emergency was raised since the last look: the level is repeated in each verdict."""
        is_news, self._raised = verdict.raised != self._raised, verdict.raised
        return is_news

    def _heed_earthquake(self, verdict: Verdict) -> bool:
        """Nothing moves while the ground shakes, unless away from an edge; whether that is all for this frame."""
        standing = self._standing
        standing.is_latched, standing.is_shaking = verdict.raised > 0, verdict.is_shaking
        if not verdict.is_shaking:
            standing.bar = ""
            return False
        standing.wants_full_fans = True
        if verdict.code is NEAR_EDGE:
            return False
        self._raised = verdict.raised
        self._stand_fast()
        return verdict.severity is not FAULT  # which an operator has to look after, too

    def _stand_fast(self) -> None:
        """Held, and home when it is over; a pose from before is not to be trusted then."""
        standing = self._standing
        if standing.bar or standing.state is State.DONE:
            return
        standing.bar = EARTHQUAKE
        standing.abort_cause = standing.abort_cause or EARTHQUAKE
        standing.lose()
        standing.hold(EARTHQUAKE, by_hand=standing.state is State.HELD and standing.is_held_by_hand)

    def _obey(self, verdict: Verdict) -> bool:
        """Do what a finding of the monitors demands; whether that is all for this frame."""
        standing, severity = self._standing, verdict.severity
        standing.wants_full_fans |= verdict.full_fans
        is_denied = not (verdict.forward or verdict.reverse or verdict.turn)
        if severity is FAULT:
            if not (standing.state is HELD and standing.is_faulted):
                standing.fault(verdict.cause, is_lost=True)
            return True
        if is_denied and severity is HOLD and verdict.signal in _CORNERS and self._looks(verdict.cause):
            return True
        if is_denied and severity >= HOLD:
            standing.await_recovery(verdict.cause, is_pose_doubted=verdict.signal not in _CORNERS)
            return True
        self._pace(is_slow=severity in (SLOW, RETURN))
        if severity is RETURN and verdict.code is not NEAR_EDGE and verdict.cause != self._finding:
            self._finding = verdict.cause
            abort(standing, verdict.cause)
        return False

    def _looks(self, cause: str) -> bool:
        """A sensor that stays off may be over a seam or the rim where the pose is wrong: one fix, at rest, tells."""
        standing = self._standing
        if standing.state is State.DONE or (standing.state is HELD and standing.is_held_by_hand):
            return False
        if not self._has_looked:
            self._has_looked = True
            standing.await_recovery(cause)
            standing.go_on()
        return standing.is_lost and standing.state in (SETTLING, MEASURING)

    def _pace(self, *, is_slow: bool) -> None:
        """Drive at the reduced speed from now on, or at the usual one from the next leg on."""
        standing = self._standing
        if is_slow is standing.tracker.is_slow:
            return
        standing.tracker.is_slow = is_slow
        if is_slow and standing.state in (DRIVING, TURNING, RETURNING):
            standing.interrupt_travel()

    def _waits_at_edge(self, t_s: float, verdict: Verdict | None) -> bool:
        """After a retreat that led nowhere: whether to go on waiting until no sensor hangs over any more."""
        standing = self._standing
        if standing.state is not HELD or standing.is_held_by_hand or standing.stuck_s is None:
            standing.stuck_s = None
            return False
        if verdict is not None and verdict.code is not NEAR_EDGE:
            standing.stuck_s = None
            return False
        if t_s - standing.stuck_s > standing.cfg.health.hold_limit_s:
            standing.stuck_s = None
            standing.fault(standing.cause)
        return True

    def _meet_edge(self, motion: Motion, verdict: Verdict) -> None:
        standing = self._standing
        if standing.state in (State.BACKING_OFF, State.DONE):
            return
        if standing.ignores_motion:
            standing.go_on()  # where the edge is, is not known before a fix; standing still for it is safe anywhere
        if standing.is_lost and standing.state in (SETTLING, MEASURING):
            return  # it stands, and a rim on the map is a matter of the pose that is being found
        if standing.state is State.HELD and standing.is_held_by_hand:
            return
        if motion.t_s < standing.stands_until_s:
            return
        mission = standing.cfg.mission
        standing.backoffs += 1
        if standing.backoffs > mission.max_backoffs_per_stop:
            standing.backoffs = 0
            standing.fault(
                f"at the edge again after {mission.max_backoffs_per_stop} back-offs: is an edge sensor dirty?"
            )
            return
        # Back at an edge right after a fix of the place: then it is the heading that is wrong.
        standing.doubts_pose |= standing.backoffs > 1
        standing.cause = verdict.cause
        standing.interrupt_parts()
        # An edge that the route did not foresee means that the pose is wrong: it is found again before moving on.
        standing.lose()
        standing.apply(Event.EDGE)
        standing.retreat = Retreat(mission, standing.tracker, verdict, motion.pose, motion.rate_rad_s)
