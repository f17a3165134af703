"""Pure. What becomes of a survey by the measurement that it asked for: a point done, skipped, approached again."""

from ccatp.samples import PointId, StopKind
from ccatp.surveying.standing import Standing
from ccatp.surveying.states import MEASURING, SETTLING, Event


class FixResults:
    """Takes the outcome of each measurement.

    Args:
        standing: what the rooms of the survey share.
        has_budget: the time left is reviewed after each point.
    """

    def __init__(self, standing: Standing, *, has_budget: bool) -> None:
        """Nothing measured yet."""
        self._standing, self._has_budget = standing, has_budget
        self._failures = 0

    def fixed(self, point: PointId | None) -> None:
        """The measurement that was asked for is taken, fused and stored."""
        standing = self._standing
        self._failures = 0
        if point is None and not standing.is_lost:
            self._leave_pointless()
            return
        if point is None and standing.aligner.wants_leg:
            standing.interrupt_parts()
            standing.apply(Event.GO_ON)
            return
        if point is None:
            # Found again, the robot stands where the route never led.
            # Unless it never left the start.
            standing.is_lost, standing.is_off_route, standing.is_at_start = False, not standing.is_at_start, False
        self._leave_stop(point, standing.done)

    def again(self) -> None:
        """The fix shows the robot too far from its point, which has to be approached anew from where it really is."""
        standing = self._standing
        if not standing.is_awaiting_fix:
            standing.is_off_route = True
            return
        standing.go_on()
        standing.missed.miss()

    def not_fixed(self, point: PointId | None, cause: str) -> None:
        """The measurement failed for good: the point is skipped; several in a row hold the robot."""
        standing = self._standing
        if point is None and not standing.is_lost:
            self._leave_pointless()  # the survey can do without
            return
        limit = standing.cfg.mission.failed_points_before_hold
        self._failures += 1
        if point is None:
            if self._failures < limit:
                standing.stopover.repeat()  # it may not have stood quite still, and cannot do without
                return
            self._failures = 0
            standing.fault(f"the robot cannot be found again: {cause}")
            return
        standing.leftovers.failed(point, cause)
        if self._failures < limit:
            self._leave_stop(point, standing.skipped)
            return
        self._failures = 0
        standing.fault(f"{limit} measurements in a row failed: {cause}")
        self._leave_stop(point, standing.skipped)

    def _leave_pointless(self) -> None:
        standing = self._standing
        stop = standing.survey.current
        if standing.is_awaiting_fix and stop is not None and stop.kind in (StopKind.CALIBRATE, StopKind.VIA):
            standing.survey.advance()
            self._doubt_heading()
            standing.go_on()

    def _doubt_heading(self) -> None:
        """Where the fix showed that the pose was wrong, the heading is found before the robot drives on."""
        standing = self._standing
        if standing.aligner.is_needed and not standing.is_at_start:
            standing.aligner.doubt()
            standing.is_lost = True

    def _leave_stop(self, point: PointId | None, record: list[PointId]) -> None:
        standing = self._standing
        goes_on = standing.is_awaiting_fix
        stop = standing.survey.current
        # A pause may come while the fix is being committed, and a new way to the point: it counts all the same.
        is_here = stop is not None and stop.point == point
        if point is not None and (is_here or point not in record):
            if point in standing.skipped:
                standing.skipped.remove(point)
            record.append(point)
            if record is standing.done:
                standing.leftovers.measured(point)
            standing.is_review_due = self._has_budget
            standing.backoffs = 0
            if is_here:
                standing.survey.advance()
            standing.is_off_route |= not is_here  # the way that was planned leads to it once more
            self._doubt_heading()
            # So it does where the robot was pushed meanwhile and waits to be measured anew: there is no need any more.
            goes_on |= standing.state in (SETTLING, MEASURING)
        if goes_on:
            standing.go_on()
