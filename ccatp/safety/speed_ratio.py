"""Monitor of the ratio between the speed of a wheel and its set point, by regression over a window."""

from collections import deque
from math import exp
from typing import NamedTuple

from ccatp.conditions import danger as conditions
from ccatp.config.models import HealthConfig, RobotConfig
from ccatp.safety.monitor import Monitor

_SIDES = ("right", "left")
# Error of the modelled speed, m/s, beside a wrong ratio; and of its delay, s: link, and the servo's time constant.
_SPEED_SIGMA_M_S, _DELAY_SIGMA_S = 0.008, 0.05
_LEAST_COVER = 0.3  # least part of an interval with encoder samples
_LONGEST_S = 0.12  # a longer interval between two set points has an unknown one in between
_FULL = 0.9  # part of the window that must be known
_LEAST_SHARE = 0.25  # a slower wheel, relative to what is expected, is about to stand
_NOTHING = (0.0, 0.0)


class _Interval(NamedTuple):
    """An interval between two estimates of main; speeds (right, left) at the wheels' rims, m/s."""

    t_s: float
    length_s: float
    measured: tuple[float, float]
    expected: tuple[float, float]
    growth: tuple[float, float]  # of the expected speed since the interval before


class SpeedRatioMonitor(Monitor):
    """Finds wheels that turn at a wrong multiple of their set points.

    The expected speed m is the set point u behind a first-order servo. Over a window with enough travel the measured
    speed is fitted by least squares with y = k m - d dm/dt: d absorbs errors of servo and link delay, and has a prior;
    k is the ratio. While the robot holds its wheels, or commands are late, nothing is fitted.
    """

    def __init__(self, cfg: HealthConfig, robot: RobotConfig) -> None:
        super().__init__()
        self._cfg = cfg
        self._radius_m = robot.wheel_radius_m
        self._lag_s = robot.wheel_lag_s
        self._max_wheel_rad_s = robot.max_wheel_rad_s
        self.alarm = self.latch(cfg.retry_after_s)
        self._window: deque[_Interval] = deque()
        self.reset()

    def reset(self) -> None:
        """See ``Monitor``."""
        super().reset()
        self.largest_rad_s = self._max_wheel_rad_s  # the robot clamps to this, and keeps the ratio of the wheels
        self.restart()

    def restart(self) -> None:
        """Begin a new window, because the wheels did not follow the set points known here."""
        self._window.clear()
        self.ratios: tuple[float | None, float | None] = (None, None)  # (right, left); None: too little travel
        self._speeds: tuple[float, float] | None = None  # expected at the end of the last interval
        self._mean = _NOTHING
        self._t_s: float | None = None
        self._clear()

    def _clear(self) -> None:
        self._covered_s = self._right_m = self._left_m = 0.0

    def add(self, dt_s: float, right_rad_s: float | None, left_rad_s: float | None) -> None:
        """Take the mean rates of a frame; ``None``: it has no samples of that wheel."""
        if right_rad_s is not None and left_rad_s is not None:
            travel_m = self._radius_m * dt_s
            self._covered_s += dt_s
            self._right_m += right_rad_s * travel_m
            self._left_m += left_rad_s * travel_m

    def take(self, t_s: float, commanded: tuple[float, float, float, float]) -> None:
        """Take the span (rad/s) of the drives up to ``t_s``: lowest and highest, right, then left wheel."""
        before_s, self._t_s = self._t_s, t_s
        right_low, right_high, left_low, left_high = commanded
        right, left = 0.5 * (right_low + right_high), 0.5 * (left_low + left_high)
        fastest = max(abs(right), abs(left), self.largest_rad_s)
        scale_m = self._radius_m * self.largest_rad_s / fastest
        set_points = scale_m * right, scale_m * left
        speeds, covered_s, travelled = self._speeds, self._covered_s, (self._right_m, self._left_m)
        self._clear()
        length_s = 0.0 if before_s is None else t_s - before_s
        if speeds is None or not 0.0 < length_s <= _LONGEST_S or covered_s < _LEAST_COVER * length_s:
            self._window.clear()
            self.ratios = None, None
            self._speeds = self._mean = set_points
            return
        keep = exp(-length_s / self._lag_s) if self._lag_s > 0.0 else 0.0
        share = self._lag_s * (1.0 - keep) / length_s
        ends = [(u + (v - u) * share, u + (v - u) * keep) for u, v in zip(set_points, speeds, strict=True)]
        mean, before = (ends[0][0], ends[1][0]), self._mean
        self._speeds = (ends[0][1], ends[1][1])
        self._mean = mean
        measured = travelled[0] / covered_s, travelled[1] / covered_s
        growth = mean[0] - before[0], mean[1] - before[1]
        window, since_s = self._window, t_s - self._cfg.ratio_time_s
        window.append(_Interval(t_s, length_s, measured, mean, growth))
        while window[0].t_s - window[0].length_s < since_s - 1e-6:
            window.popleft()
        is_full = sum(one.length_s for one in window) >= _FULL * self._cfg.ratio_time_s
        self.ratios = (self._ratio(0), self._ratio(1)) if is_full else (None, None)
        self._judge(t_s)

    def _ratio(self, side: int) -> float | None:
        """The ratio k of a wheel over the window; ``None`` if the set points moved it too little, or it stands now.

        A wheel that stands is found, with its reason, by ``WheelMonitor``.
        """
        newest = self._window[-1]
        if abs(newest.measured[side]) < _LEAST_SHARE * abs(newest.expected[side]):
            return None
        travel_m = mm = md = dd = my = dy = 0.0
        for _, length_s, measured, expected, growth in self._window:
            m, y, step = expected[side], measured[side], growth[side]
            travel_m += abs(m) * length_s
            mm += m * m * length_s
            md += m * step
            dd += step * step / length_s
            my += m * y * length_s
            dy += step * y
        if travel_m < self._cfg.ratio_travel_m:
            return None
        # The prior of the delay counts like one interval of the mean length.
        dd += (_SPEED_SIGMA_M_S / _DELAY_SIGMA_S) ** 2 * self._cfg.ratio_time_s / len(self._window)
        return (my * dd - dy * md) / (mm * dd - md * md)

    def _judge(self, t_s: float) -> None:
        share = self._cfg.ratio_share
        off = [(abs(k - 1.0), k, side) for k, side in zip(self.ratios, _SIDES, strict=True) if k is not None]
        if off and max(off)[0] > share:
            _, ratio, side = max(off)
            finding = conditions.WHEEL_SPEED_WRONG.found(f"{side}_wheel", ratio, 1.0, side=side, ratio=f"{ratio:.2f}")
            self.alarm.see(t_s, finding)
