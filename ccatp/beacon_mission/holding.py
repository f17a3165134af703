"""Pure. When a mission among beacons stands, and why: commands of an operator, verdicts of the danger loop, faults."""

from ccatp.beacon_mission.states import DONE, HELD, IDLE, State
from ccatp.samples import EventCode, Severity, Verdict
from ccatp.surveying.states import Outcome

# Nothing moves while the ground shakes.
EARTHQUAKE = "emergency: earthquake"


class Holding:
    """State and causes of the mission.

    Attributes:
        state: where it stands.
        outcome: how it ended.
        cause: why it is held or returns.
        abort_cause: why it was given up, or empty.
        is_faulted: something is wrong, and an operator has to look after it.
    """

    def __init__(self) -> None:
        """Idle."""
        self.state: State = IDLE
        self.outcome = Outcome.NONE
        self.cause = self.abort_cause = ""
        self.is_faulted = False
        self._is_by_hand = False
        self._bar = ""
        self._raised = 0
        self._severity = Severity.NONE

    @property
    def is_paused(self) -> bool:
        """Held until somebody resumes, or says that an earthquake is over."""
        return self.state is HELD and (self._is_by_hand or bool(self._bar))

    # -- commands: each returns why it was refused, or None -------------------------------------------------------

    def pause(self, cause: str) -> str | None:
        """Hold until ``resume``."""
        if self.state is DONE:
            return "the mission is over"
        self._hold(cause, by_hand=True)
        return None

    def resume(self) -> str | None:
        """Go on after a hold; what holds the robot must be gone."""
        if self.state is not HELD:
            return f"the mission is not held but {self.state}"
        if self._bar:
            return f"{self._bar}: nothing moves until that is cleared"
        if self._severity >= Severity.HOLD:
            return f"the cause persists: {self.cause}"
        self._go_on()
        return None

    def abort(self, cause: str) -> str | None:
        """Return to where the robot started, and end there."""
        if self.state is DONE:
            return "the mission is over"
        self.abort_cause = self.abort_cause or cause
        if not self._bar:
            self._go_on()
            self.cause = self.abort_cause
        return None

    def stop(self) -> str | None:
        """Hold the wheels and end here."""
        if self.state is DONE:
            return "the mission is over"
        self.finish(Outcome.STOPPED)
        return None

    def fault(self, cause: str) -> None:
        """Hold until an operator resumes, because something is wrong."""
        if self.state is not DONE and not self.is_faulted:
            self._hold(cause, by_hand=True)
            self.is_faulted = True

    def interrupt(self, cause: str) -> bool:
        """Hold until frames and verdicts are fresh again; returns whether that was news."""
        if self.state in (IDLE, HELD, DONE):
            return False
        self._hold(cause, by_hand=False)
        return True

    def finish(self, outcome: Outcome) -> None:
        """The mission is over."""
        self.state, self.outcome = DONE, outcome

    # -- verdicts -------------------------------------------------------------------------------------------------

    def react(self, verdict: Verdict | None) -> bool:
        """Do what a verdict demands; whether the robot may go about its business."""
        if self.state is DONE:
            return False
        if verdict is None:
            self.interrupt("no fresh verdict from the danger loop")
            return False
        self._severity = verdict.severity
        if verdict.is_shaking:
            self._raised = verdict.raised
            self._stand_fast()
        else:
            self._bar = ""
        if verdict.severity is Severity.FAULT:
            self.fault(verdict.cause)
            return False
        if verdict.is_shaking:
            return False
        if not (verdict.forward or verdict.reverse or verdict.turn):
            if not self.interrupt(verdict.cause) and self.state is HELD and not self._is_by_hand:
                self.cause = verdict.cause
            return False
        if verdict.code is EventCode.ABORTED and verdict.raised != self._raised:
            self._raised = verdict.raised  # the level is repeated; what counts is that it is new
            self.abort(verdict.cause)
        if self.state is IDLE or (self.state is HELD and not self._is_by_hand):
            self._go_on()
        return self.state is not HELD

    def _stand_fast(self) -> None:
        if self._bar:
            return
        self._bar = EARTHQUAKE
        self.abort_cause = self.abort_cause or EARTHQUAKE
        self._hold(EARTHQUAKE, by_hand=self.state is HELD and self._is_by_hand)

    def _hold(self, cause: str, *, by_hand: bool) -> None:
        self.state, self.cause, self._is_by_hand = HELD, cause, by_hand

    def _go_on(self) -> None:
        """What is next is found in the next frame."""
        self.state, self.cause = IDLE, self.abort_cause
        self._is_by_hand = self.is_faulted = False
