"""Pure. The wheel observer's input: wheel angles out of rate samples, and what kind of encoder gives them."""

from collections.abc import Sequence
from math import inf

from ccatp.localization.measurements import WheelReading

# Nothing but a counter gives exact zeros: this many samples in a row without another value.
_ZEROS_OF_A_COUNTER = 8
_COUNTER_NOISE = 1.0 / 12.0  # variance of a uniform distribution over one count
_MIN_VARIANCE_RAD2 = 1e-14
# A wheel that gave no sample for this long may have done anything meanwhile.
_GAP_S = 0.02


class WheelAngle:
    """The angle of one wheel since ``rebase``, the sum of its rate samples.

    A counting encoder gives the counts of a sampling period over its length: the sum of rate times period is the
    counted angle, exact to a count however long the drive. An analogue one gives a rate with white noise at an instant:
    the trapezoid rule sums it. Which one it is shows at rest, where a counter gives nothing but zeros.
    """

    def __init__(self) -> None:
        self.angle_rad = 0.0
        self.gap_rad = 0.0  # what may be wrong for want of samples; stays until taken
        self._t_s = -inf
        self._rate = 0.0
        self._zeros = 0
        self.is_counter = False
        self.quantum_rad = inf
        self.noise_rad2_s2: float | None = None  # variance of a sample at rest

    def restart(self) -> None:
        """The robot's clock has jumped: the next sample begins a new sum."""
        self._t_s = -inf

    def rebase(self) -> None:
        """Count from here."""
        self.angle_rad = 0.0

    def add(self, readings: Sequence[WheelReading]) -> None:
        """Add the samples of a frame, oldest first."""
        t0, before, angle = self._t_s, self._rate, self.angle_rad
        if t0 == -inf and readings:
            t0, before = readings[0]
        is_counter = self.is_counter or self._is_counting(readings)
        for t, rate in readings:
            dt = t - t0
            if dt > _GAP_S:
                self.gap_rad += abs(rate) * dt
            step = rate * dt if is_counter else 0.5 * (before + rate) * dt
            angle += step
            if is_counter and step and abs(step) < self.quantum_rad:
                self.quantum_rad = abs(step)
            t0, before = t, rate
        self._t_s, self._rate, self.angle_rad = t0, before, angle

    def _is_counting(self, readings: Sequence[WheelReading]) -> bool:
        for _, rate in readings:
            self._zeros = self._zeros + 1 if rate == 0.0 else 0
        if self._zeros >= _ZEROS_OF_A_COUNTER:
            self.is_counter, self.noise_rad2_s2 = True, 0.0
        return self.is_counter

    def rest(self, readings: Sequence[WheelReading]) -> None:
        """Learn from the samples of a wheel that stands."""
        if self.is_counter or not readings:
            return
        squares = sum(rate * rate for _, rate in readings) / len(readings)
        # Some hundred samples are plenty; a slow mean forgets the residue of the last motion.
        old = self.noise_rad2_s2
        self.noise_rad2_s2 = squares if old is None else old + 0.02 * (squares - old)

    def variance_rad2(self) -> float:
        """Variance of the angle's bounded error: that of a count, next to nothing for an analogue encoder."""
        if self.is_counter and self.quantum_rad < inf:
            return self.quantum_rad * self.quantum_rad * _COUNTER_NOISE
        return _MIN_VARIANCE_RAD2
