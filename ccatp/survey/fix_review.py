"""What becomes of a fix: the checks by the estimate and by the robot's motion, then the localizer. Pure."""

from collections.abc import Mapping
from typing import NamedTuple

from ccatp.conditions import text_of
from ccatp.conditions.mission import LASER_NOT_FOLLOWING
from ccatp.core import NO_CAUSE, Cause, DeckPose, Fix, Vector3
from ccatp.estimation.fixes import FixRefused
from ccatp.localizer import Localizer
from ccatp.survey.fix_gate import FixGate
from ccatp.survey.laser_follow import LaserFollow, Rows

# Number of repeated measurements of a doubtful fix.
REPEATS = 2


class ReviewedFix(NamedTuple):
    """What became of a fix.

    ``doubt``: why it is not used, or empty. ``refusal``: why this mission must not use this laser system. ``jump_m``:
    by how much it moved the estimate. ``is_set_aside``: the localizer did not get it.
    """

    doubt: str = ""
    refusal: Cause = NO_CAUSE
    jump_m: float = 0.0
    is_set_aside: bool = False


class FixReview:
    """Judges each fix of a mission, and gives the good ones to the localizer."""

    def __init__(self, gate: FixGate, follow: LaserFollow) -> None:
        self._gate, self._follow = gate, follow

    def add(self, imu: Rows, enc: Rows) -> None:
        """Take the samples of a frame; see ``LaserFollow.add``."""
        self._follow.add(imu, enc)

    def begin(self) -> None:
        """Begin a new standstill."""
        self._gate.begin()
        self._follow.begin()

    def take(
        self, localizer: Localizer, fix: Fix, expected_m: Vector3, estimate: DeckPose, *, is_lost: bool
    ) -> ReviewedFix:
        """Fuse a fix unless it is doubted. ``expected_m``: of the puck, world frame, by the ``estimate``."""
        finding = self._gate.review(fix, expected_m, estimate, localizer.pose_covariance, is_lost=is_lost)
        stuck, refusal = self._follow.doubt(fix), finding.refusal
        if stuck and not refusal and self._follow.is_certain:
            refusal = LASER_NOT_FOLLOWING.cause(count=self._follow.standstills)
        doubt = finding.doubt or text_of(finding.refusal) or stuck
        if doubt:
            return ReviewedFix(doubt, refusal, is_set_aside=True)
        try:
            return ReviewedFix(jump_m=localizer.fuse_fix(fix))
        except FixRefused as error:
            return ReviewedFix(str(error))

    def refusal_of(self, lengths_m: Mapping[int, float], expected_m: Vector3) -> Cause:
        """Why the laser system is refused when lengths gave no position; see ``FixGate.refusal_of``."""
        return self._gate.refusal_of(lengths_m, expected_m)
