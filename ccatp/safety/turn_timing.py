"""Monitor of the times of gyroscope and encoders against each other, by regression over turns."""

from collections import deque
from collections.abc import Sequence
from math import inf, sqrt

from ccatp.conditions import danger as conditions
from ccatp.config.models import HealthConfig
from ccatp.core import ImuSample, WheelSample
from ccatp.safety.monitor import Monitor

_STEP_S = 0.05  # rates are means over such steps: what encoders count in one frame is too coarse for a derivative
_KEEP = 1.0 - _STEP_S / 2.0  # weights fall by 1/e in 2 s: about the last two turns
# Least sum of squares of what is known of the derivative, rad^2/s^4, and least sum of the weights: most of a turn.
_LEAST_KNOWN, _LEAST_STEPS = 10.0, 8.0
_LEAST_RATIO = 0.5
_SIGMAS = 3.0
_LONGEST_WAIT_S = 1.0  # one sensor for the other
_STEPS = 3  # whose middle one has a derivative
# Where the samples are twice as far apart as they may be, the turn between them is not known.
_GYROSCOPE_GAP_S, _ENCODER_GAP_S = (2.0 / conditions.SAMPLE_RATES[name].least_hz for name in ("imu", "enc"))


class _TurnLog:
    """The turn by one sensor since the first of its samples, at the times of the samples."""

    def __init__(self, longest_s: float) -> None:
        self._longest_s = longest_s
        self._rows: deque[tuple[float, float]] = deque()  # time, angle in rad

    def add(self, t_s: float, rate_rad_s: float) -> bool:
        """Add a sample and the mean rate since the one before; ``False`` if it does not follow that closely."""
        if not self._rows:
            self._rows.append((t_s, 0.0))
            return True
        before_s, angle_rad = self._rows[-1]
        if not 0.0 <= t_s - before_s <= self._longest_s:
            return False
        self._rows.append((t_s, angle_rad + rate_rad_s * (t_s - before_s)))
        return True

    def span_s(self) -> float:
        """Time from the oldest sample to the newest."""
        return self._rows[-1][0] - self._rows[0][0] if self._rows else 0.0

    def first_s(self) -> float:
        """Time of the oldest sample, infinite without one."""
        return self._rows[0][0] if self._rows else inf

    def last_s(self) -> float:
        """Time of the newest sample, minus infinity without one."""
        return self._rows[-1][0] if self._rows else -inf

    def take(self, begin_s: float, end_s: float) -> float:
        """The turn between two times within the log; what is older than the second one is dropped."""
        turn_rad = self._angle_at(end_s) - self._angle_at(begin_s)
        while len(self._rows) > 1 and self._rows[1][0] <= end_s:
            self._rows.popleft()
        return turn_rad

    def _angle_at(self, t_s: float) -> float:
        before_s, before = self._rows[0]
        for after_s, after in self._rows:
            if after_s >= t_s:
                return (
                    before + (after - before) * (t_s - before_s) / (after_s - before_s) if after_s > before_s else after
                )
            before_s, before = after_s, after
        return before


class TurnTimingMonitor(Monitor):
    """Finds a gyroscope that shows the turns at another time than the encoders, by the time stamps of both.

    Over turns the rate y by the gyroscope is fitted by least squares with y = b + k (w - d dw/dt), w the rate by the
    wheels. d is the delay of the gyroscope; b absorbs its bias, k slip and errors of scale. Samples that arrive late
    with their right times are not delayed.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        super().__init__()
        self._limit_s = cfg.turn_delay_s
        self.alarm = self.latch(cfg.retry_after_s)
        self.reset()

    def reset(self) -> None:
        """See ``Monitor``."""
        super().reset()
        self.restart()

    def restart(self) -> None:
        """Begin again, because turns or times are not known."""
        self.delay_s: float | None = None  # the newest; None: too little is known
        self._by_gyroscope = _TurnLog(_GYROSCOPE_GAP_S)
        self._by_wheels = _TurnLog(_ENCODER_GAP_S)
        self._wz_rad_s = 0.0
        self._edge_s: float | None = None
        self._rates: deque[tuple[float, float]] = deque(maxlen=_STEPS)  # by gyroscope and wheels, of the last steps
        self._sums = [0.0] * 10  # of 1, w, d, y, ww, wd, dd, yw, yd, yy with d = dw/dt, older steps with less weight

    @property
    def waits_s(self) -> float:
        """How long one sensor has been waiting for the other."""
        return max(self._by_gyroscope.span_s(), self._by_wheels.span_s())

    def step(
        self,
        t_s: float,
        imu: Sequence[ImuSample],
        wheels: Sequence[WheelSample],
        yaw_rad_s: float | None,
    ) -> None:
        """Take the samples of a frame at ``t_s``; ``yaw_rad_s``: mean yaw rate by ``wheels``, ``None`` if not known."""
        if wheels and yaw_rad_s is None:
            self.restart()
            return
        follows = True
        for at_s, _, wz in imu:
            follows &= self._by_gyroscope.add(at_s, 0.5 * (self._wz_rad_s + wz))
            self._wz_rad_s = wz
        if wheels and yaw_rad_s is not None:
            follows &= self._by_wheels.add(wheels[-1][0], yaw_rad_s)
        if follows and self.waits_s <= _LONGEST_WAIT_S:
            self._take_steps(t_s)
        else:
            self.restart()

    def _take_steps(self, t_s: float) -> None:
        gyroscope, encoders = self._by_gyroscope, self._by_wheels
        if self._edge_s is None:
            first_s = max(gyroscope.first_s(), encoders.first_s())
            self._edge_s = first_s if first_s < inf else None
        known_s = min(gyroscope.last_s(), encoders.last_s())
        while self._edge_s is not None and (end_s := self._edge_s + _STEP_S) <= known_s:
            turns = gyroscope.take(self._edge_s, end_s), encoders.take(self._edge_s, end_s)
            self._edge_s = end_s
            self._rates.append((turns[0] / _STEP_S, turns[1] / _STEP_S))
            if len(self._rates) == _STEPS:
                self._fit(t_s)

    def _fit(self, t_s: float) -> None:
        (_, before), (y, w), (_, after) = self._rates
        d = (after - before) / (2.0 * _STEP_S)
        step = (1.0, w, d, y, w * w, w * d, d * d, y * w, y * d, y * y)
        self._sums = sums = [_KEEP * total + one for total, one in zip(self._sums, step, strict=True)]
        n, w, d, y, ww, wd, dd, yw, yd, yy = sums
        ww, wd, dd = ww - w * w / n, wd - w * d / n, dd - d * d / n
        yw, yd, yy = yw - y * w / n, yd - y * d / n, yy - y * y / n
        determinant = ww * dd - wd * wd
        self.delay_s = None
        if n < _LEAST_STEPS or determinant <= _LEAST_KNOWN * ww:
            return
        k, kd = (yw * dd - yd * wd) / determinant, (yw * wd - yd * ww) / determinant
        if k < _LEAST_RATIO:  # the gyroscope shows another motion, which other rules find
            return
        variance = max(yy - k * yw + kd * yd, 0.0) / (n - 3.0)  # of a rate, by the residuals
        self.delay_s = delay_s = kd / k
        if abs(delay_s) > self._limit_s + _SIGMAS * sqrt(variance * ww / determinant) / k:
            side = "later" if delay_s > 0.0 else "earlier"
            ms = f"{1e3 * abs(delay_s):.0f}"
            self.alarm.see(t_s, conditions.TURN_TIMES_DIFFER.found("imu_wz", delay_s, self._limit_s, ms=ms, side=side))
