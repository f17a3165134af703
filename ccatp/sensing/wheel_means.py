"""Mean wheel rates of a frame, from the encoder samples that are possible."""

from collections.abc import Sequence
from math import isfinite

from ccatp.config.models import RobotConfig
from ccatp.core import WheelSample


class WheelMeans:
    """Mean wheel rates of a frame (``None`` without samples), and the smoothed yaw rate of the wheels."""

    _SMOOTH_S = 0.05

    __slots__ = ("_limit_rad_s", "_per_base", "left_rad_s", "right_rad_s", "yaw_rad_s")

    def __init__(self, robot: RobotConfig) -> None:
        self._per_base = robot.wheel_radius_m / robot.wheel_base_m
        self._limit_rad_s = largest_rate_rad_s(robot)
        self.right_rad_s: float | None = 0.0
        self.left_rad_s: float | None = 0.0
        self.yaw_rad_s = 0.0

    def take(self, samples: Sequence[WheelSample], dt_s: float) -> None:
        """Take a frame's samples; ``dt_s`` after the last frame."""
        if not samples:
            self.right_rad_s = self.left_rad_s = None
            return
        _, right, left = zip(*samples)  # noqa: B905 - of one length; checking that takes longer
        count = len(right)
        try:
            right_rad_s, left_rad_s = sum(right) / count, sum(left) / count
            least, largest = min(*right, *left), max(*right, *left)
        except TypeError:  # a wheel gave no sample
            self._take_some(right, left)
            return
        limit = self._limit_rad_s
        if not (-limit <= least <= largest <= limit and isfinite(right_rad_s + left_rad_s)):
            self._take_some(right, left)
            return
        self.right_rad_s = right_rad_s
        self.left_rad_s = left_rad_s
        share = dt_s / (self._SMOOTH_S + dt_s)
        self.yaw_rad_s += share * (self._per_base * (right_rad_s - left_rad_s) - self.yaw_rad_s)

    @property
    def mean_yaw_rad_s(self) -> float | None:
        """The yaw rate by the means of the frame, not smoothed; ``None`` where one is not known."""
        right, left = self.right_rad_s, self.left_rad_s
        return None if right is None or left is None else self._per_base * (right - left)

    def _take_some(self, right: Sequence[float | None], left: Sequence[float | None]) -> None:
        self.right_rad_s = self._mean(right)
        self.left_rad_s = self._mean(left)

    def _mean(self, rates: Sequence[float | None]) -> float | None:
        limit = self._limit_rad_s
        usable = [rate for rate in rates if rate is not None and -limit <= rate <= limit]
        return sum(usable) / len(usable) if usable else None


def as_standing(samples: Sequence[WheelSample]) -> list[WheelSample]:
    """Samples of standing wheels, for a held robot whose encoders are not trusted."""
    return [WheelSample(sample.t_s, 0.0, 0.0) for sample in samples]


def largest_rate_rad_s(robot: RobotConfig) -> float:
    """Largest plausible encoder rate, rad/s; it allows for one count too many per sample."""
    return 3.0 * robot.max_wheel_rad_s
