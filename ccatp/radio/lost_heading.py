"""Pure. After a gap in the odometry the heading may be anything: several are followed until the beacons tell which."""

from collections.abc import Sequence
from copy import deepcopy
from math import inf, pi, sqrt

from ccatp.radio.motion import Increment
from ccatp.radio.readings import Reading
from ccatp.radio.slam import BeaconSlam, Learned
from ccatp.radio.transport import HEADING

HEADINGS = 8
"""Followed at once; within an eighth of a circle the filter finds its way."""
LOST_RAD = pi / HEADINGS
"""Standard deviation of a heading beyond which it is looked for."""
WORSE = 30.0
"""Twice the log-likelihood by which one falls behind the best and is given up: more than two outliers make."""
LONGEST = 400
"""Readings after which the best is taken."""
OUTLIER = 25.0
"""What a reading may count at most against one of them."""


class LostHeading:
    """One ``BeaconSlam``, or several that differ by their heading.

    A Gaussian whose heading is spread over the circle is split into ``HEADINGS`` narrow ones; each reading that all of
    them take is held against each (a Gaussian sum: Alspach and Sorenson 1972).

    Args:
        slam: the filter before anything was lost.

    Attributes:
        best: the filter that the readings fit best so far.
    """

    def __init__(self, slam: BeaconSlam) -> None:
        self.best = slam
        self._others: list[BeaconSlam] = []
        self._scores = [0.0]
        self._taken, self._is_guessed = 0, False

    def predict(self, odometry: Increment) -> None:
        """Carry all of them on; behind a gap the heading is split."""
        for slam in (self.best, *self._others):
            slam.predict(odometry)
        was_guessed, self._is_guessed = self._is_guessed, odometry.guess_rad2 > 0.0
        if was_guessed and not self._is_guessed and self.best.pose_covariance[HEADING, HEADING] > LOST_RAD**2:
            self._split()

    def observe(self, readings: Sequence[Reading]) -> list[Learned]:
        """Take readings; what they did to the best."""
        learned = self.best.observe(readings)
        if self._others:
            self._weigh([learned, *(slam.observe(readings) for slam in self._others)])
        return learned

    def _split(self) -> None:
        for beacon in list(self.best.waiting):  # what was heard of it before the gap belongs to another frame
            self.best.remove(beacon)
        if not self.best.beacons:
            return
        step_rad = 2.0 * pi / HEADINGS
        slams = [self.best, *(deepcopy(self.best) for _ in range(HEADINGS - 1))]
        self._scores = [
            slam.told_heading(((k + HEADINGS // 2) % HEADINGS - HEADINGS // 2) * step_rad, step_rad / sqrt(12.0))
            for k, slam in enumerate(slams)
        ]
        self._others, self._taken = slams[1:], 0

    def _weigh(self, learned: Sequence[list[Learned]]) -> None:
        """Readings that not all have taken, because a beacon is not on every map, say nothing."""
        for each in learned:
            each.sort(key=lambda one: str(one.beacon))
        if len({tuple(one.beacon for one in each) for each in learned}) > 1:
            return
        slams = [self.best, *self._others]
        self._scores = [
            score + sum(one.surprise - max(one.nis - OUTLIER, 0.0) for one in each)
            for score, each in zip(self._scores, learned, strict=True)
        ]
        self._taken += len(learned[0])
        limit = min(self._scores) + (WORSE if self._taken < LONGEST else 0.0)
        kept = sorted((s, k) for k, s in enumerate(self._scores) if s <= limit and s < inf)
        self._scores = [score for score, _ in kept]
        self.best, *self._others = (slams[k] for _, k in kept)
