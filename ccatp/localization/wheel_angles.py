"""Pure. The wheel observer's input: wheel angles out of rate samples, and what kind of encoder gives them."""

from collections.abc import Sequence
from math import inf

# Nothing but a counter gives exact zeros: this many samples in a row without another value.
_ZEROS_OF_A_COUNTER = 8
_COUNTER_NOISE = 1.0 / 12.0  # variance of a uniform distribution over one count
_MIN_VARIANCE_RAD2 = 1e-14
# A wheel that gave no sample for this long may have done anything meanwhile.
_GAP_S = 0.02
_LOST = 1.5  # periods between two samples of a counter beyond which one is missing
_LATELY_S = 0.05


class WheelAngle:
    """The angle of one wheel since ``rebase``, the sum of its rate samples.

    A counting encoder gives the counts of a sampling period over its length: the sum of rate times period is the
    counted angle, exact to a count however long the drive. An analogue one gives a rate with white noise at an instant:
    the trapezoid rule sums it. Which one it is shows at rest, where a counter gives nothing but zeros.

    Attributes:
        angle_rad: since the last rebase.
        is_fresh: the last frame brought samples.
        is_counter: it is a counting encoder.
        quantum_rad: its smallest step seen.
        noise_rad2_s2: variance of a rate sample at rest; None as long as it has not been seen at rest.
    """

    __slots__ = (
        "_gap_rad",
        "_mean_rate",
        "_period_s",
        "_rate",
        "_t_s",
        "_zeros",
        "angle_rad",
        "is_counter",
        "is_fresh",
        "noise_rad2_s2",
        "quantum_rad",
    )

    def __init__(self) -> None:
        self.angle_rad = 0.0
        self.is_fresh = False
        self._gap_rad = 0.0
        self._mean_rate = 0.0
        self._period_s = inf
        self._t_s = -inf
        self._rate = 0.0
        self._zeros = 0
        self.is_counter = False
        self.quantum_rad = inf
        self.noise_rad2_s2: float | None = None

    def restart(self) -> None:
        """The robot's clock has jumped: the next sample begins a new sum."""
        self._t_s = -inf

    def rebase(self) -> None:
        """Count from here."""
        self.angle_rad = 0.0

    def add(self, times_s: Sequence[float], rates_rad_s: Sequence[float]) -> float:
        """Add a frame's samples, oldest first; returns by how much the wheel has turned, rad."""
        self.is_fresh = bool(times_s)
        if not times_s:
            return 0.0
        t0, before = self._t_s, self._rate
        if t0 == -inf:
            t0, before = times_s[0], rates_rad_s[0]
        if self.is_counter or self._is_counting(rates_rad_s):
            turned = self._counted(t0, times_s, rates_rad_s)
        else:
            turned = 0.0
            for t, rate in zip(times_s, rates_rad_s, strict=True):
                dt = t - t0
                if dt > _GAP_S:
                    self._gap_rad += abs(rate) * dt
                turned += (before + rate) * dt
                t0, before = t, rate
            turned *= 0.5
        self._t_s, self._rate = times_s[-1], rates_rad_s[-1]
        self.angle_rad += turned
        return turned

    def _counted(self, t0: float, times_s: Sequence[float], rates_rad_s: Sequence[float]) -> float:
        turned, least, period, start = 0.0, self.quantum_rad, self._period_s, t0
        for t, rate in zip(times_s, rates_rad_s, strict=True):
            dt = t - t0
            if dt > _LOST * period:
                # A rate tells of its own period only; what the wheel did before it is taken from what it did lately.
                lost_s = dt - period
                turned += self._mean_rate * lost_s
                self._gap_rad += abs(self._mean_rate) * lost_s + (least if least < inf else 0.0)
                dt = period
            elif 0.0 < dt < period:
                period = dt
            if rate:
                step = rate * dt
                turned += step
                if -least < step < least and step:
                    least = abs(step)
            t0 = t
        self.quantum_rad, self._period_s = least, period
        elapsed = t0 - start
        if elapsed > 0.0:
            self._mean_rate += (turned - self._mean_rate * elapsed) / (elapsed + _LATELY_S)
        return turned

    def _is_counting(self, rates_rad_s: Sequence[float]) -> bool:
        for rate in rates_rad_s:
            self._zeros = self._zeros + 1 if rate == 0.0 else 0
        if self._zeros >= _ZEROS_OF_A_COUNTER:
            self.is_counter, self.noise_rad2_s2 = True, 0.0
        return self.is_counter

    def take_gap(self) -> float:
        """What may be wrong with the angle for want of samples, rad; told once."""
        gap_rad, self._gap_rad = self._gap_rad, 0.0
        return gap_rad

    def rest(self, rates_rad_s: Sequence[float]) -> None:
        """Learn from the samples of a wheel that stands."""
        if self.is_counter or not rates_rad_s:
            return
        squares = sum(rate * rate for rate in rates_rad_s) / len(rates_rad_s)
        # Some hundred samples are plenty; a slow mean forgets the residue of the last motion.
        old = self.noise_rad2_s2
        self.noise_rad2_s2 = squares if old is None else old + 0.02 * (squares - old)

    def variance_rad2(self) -> float:
        """Variance of the angle's bounded error: that of a count, next to nothing for an analogue encoder."""
        if self.is_counter and self.quantum_rad < inf:
            return self.quantum_rad * self.quantum_rad * _COUNTER_NOISE
        return _MIN_VARIANCE_RAD2
