"""Pure. A frame as the monitors look at it: how far wheels and gyroscope say that the robot moved, and since when."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from ccatp.config.models import RobotConfig
from ccatp.samples import WheelSample


class Moved(NamedTuple):
    """Running sums since the start, at one time.

    Attributes:
        t_s: the time.
        right_m, left_m: travel of the wheels' rims.
        turned_rad: what the gyroscope has turned by, as far as it could be believed.
    """

    t_s: float
    right_m: float
    left_m: float
    turned_rad: float


class Window:
    """The change of running sums over a time.

    Args:
        span_s: that time.
    """

    __slots__ = ("_kept", "_span_s")

    def __init__(self, span_s: float) -> None:
        """Empty."""
        self._span_s = span_s - 1e-6
        self._kept: deque[Moved] = deque()

    def reset(self) -> None:
        """Empty again."""
        self._kept.clear()

    def push(self, now: Moved) -> Moved | None:
        """Take the newest sums; the change over the span (``t_s`` is its length), ``None`` while it is shorter."""
        kept, since_s = self._kept, now[0] - self._span_s
        kept.append(now)
        while len(kept) > 1 and kept[1][0] <= since_s:
            kept.popleft()
        t_s, right_m, left_m, turned_rad = kept[0]
        if t_s > since_s:
            return None
        return Moved(now[0] - t_s, now[1] - right_m, now[2] - left_m, now[3] - turned_rad)


class WheelMeans:
    """The mean rates of the wheels over a frame, and the yaw rate that they mean, smoothed.

    Args:
        robot: wheels.

    Attributes:
        right_rad_s, left_rad_s: means over the last frame; ``None`` for a wheel that gave no sample.
        yaw_rad_s: smoothed over some frames, because a count of an encoder is a jump of its rate.
    """

    _SMOOTH_S = 0.05

    __slots__ = ("_limit_rad_s", "_per_base", "left_rad_s", "right_rad_s", "yaw_rad_s")

    def __init__(self, robot: RobotConfig) -> None:
        """Standing still."""
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
        _, right, left = zip(*samples, strict=True)
        count = len(right)
        try:
            right_rad_s, left_rad_s = sum(right) / count, sum(left) / count
        except TypeError:  # a wheel gave no sample
            self._take_some(right, left)
            return
        limit = self._limit_rad_s
        if not (-limit <= right_rad_s <= limit and -limit <= left_rad_s <= limit):
            self._take_some(right, left)
            return
        self.right_rad_s, self.left_rad_s = right_rad_s, left_rad_s
        share = dt_s / (self._SMOOTH_S + dt_s)
        self.yaw_rad_s += share * (self._per_base * (right_rad_s - left_rad_s) - self.yaw_rad_s)

    def _take_some(self, right: Sequence[float | None], left: Sequence[float | None]) -> None:
        self.right_rad_s, self.left_rad_s = self._mean(right), self._mean(left)

    def _mean(self, rates: Sequence[float | None]) -> float | None:
        limit = self._limit_rad_s
        usable = [rate for rate in rates if rate is not None and -limit <= rate <= limit]
        return sum(usable) / len(usable) if usable else None


def as_standing(samples: Sequence[WheelSample]) -> list[WheelSample]:
    """What the encoders would say of wheels that stand: for a robot that is held and whose encoders are in doubt."""
    return [WheelSample(sample.t_s, 0.0, 0.0) for sample in samples]


def largest_rate_rad_s(robot: RobotConfig) -> float:
    """No wheel turns faster, rad/s: an encoder that says so is wrong. A count more per sample is no contradiction."""
    return 3.0 * robot.max_wheel_rad_s
