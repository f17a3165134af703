"""Pure. Where a robot among beacons believes to be: what its mission asks of whatever estimates that."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from ccatp.beacon_mission.senses import Senses
from ccatp.control.following import TargetSight
from ccatp.filters.base import FloatArray

Ellipse = tuple[float, float, float, float, float]


class Belief(NamedTuple):
    """What is believed now.

    Attributes:
        pose: x m, y m, heading rad (continuous).
        covariance: of these, shape (3, 3).
    """

    pose: tuple[float, float, float]
    covariance: FloatArray

    @property
    def ellipse(self) -> Ellipse:
        """x, y and their covariance xx, xy, yy."""
        P = self.covariance
        return self.pose[0], self.pose[1], float(P[0, 0]), float(P[0, 1]), float(P[1, 1])

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position in its worst direction."""
        xx, xy, yy = self.ellipse[2:]
        middle, spread = 0.5 * (xx + yy), (0.25 * (xx - yy) ** 2 + xy * xy) ** 0.5
        return float(max(middle + spread, 0.0) ** 0.5)


class Score(NamedTuple):
    """How the readings agree with what was expected of them, all so far.

    Attributes:
        nis_sum: sum of the normalised innovations squared.
        nis_size: sum of their degrees of freedom.
        refused: readings that the gate refused; not in the sums.
    """

    nis_sum: float
    nis_size: int
    refused: int


class Navigator(Protocol):
    """Estimates pose and beacons."""

    @property
    def is_mapping(self) -> bool:
        """It needs the robot to stand: there is no map yet to drive by."""

    @property
    def belief(self) -> Belief:
        """Of the robot."""

    @property
    def reckoned_m(self) -> tuple[float, float]:
        """Where dead reckoning alone would see it."""

    @property
    def beacons(self) -> Mapping[str, Ellipse]:
        """The map."""

    @property
    def score(self) -> Score:
        """Consistency so far."""

    @property
    def notes(self) -> Mapping[str, float]:
        """What there is to say of the map."""

    def target(self, t_s: float) -> TargetSight | None:
        """What is believed of the radio that is followed, at a time; ``None`` before it was heard."""

    def take(self, senses: Senses) -> None:
        """Take the readings of a frame.

        Raises:
            CcatpError: they make no map, and never will.
        """


def ellipse_of(mean: FloatArray, covariance: FloatArray) -> Ellipse:
    """x, y and their covariance of a place, shapes (2+,) and (2+, 2+)."""
    return (
        float(mean[0]),
        float(mean[1]),
        float(covariance[0, 0]),
        float(covariance[0, 1]),
        float(covariance[1, 1]),
    )
