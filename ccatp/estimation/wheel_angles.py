"""The wheel observer's input: wheel angles out of rate samples, and what kind of encoder gives them."""

from collections.abc import Sequence
from math import inf

# Nothing but a counter gives exact zeros: this many samples in a row without another value.
_ZEROS_OF_A_COUNTER = 8
_COUNTER_NOISE = 1.0 / 12.0  # variance of a uniform distribution over one count
_MIN_VARIANCE_RAD2 = 1e-10  # a third of a micrometre of travel: less would cost the filter digits and tell it nothing
# A wheel that gave no sample for this long may have done anything meanwhile.
_GAP_S = 0.02
_LOST = 1.5  # periods between two samples of a counter beyond which one is missing
_LATELY_S = 0.05
_EVEN = 0.05  # of a period: what a frame's periods may be longer than the shortest, all together
_ENOUGH = 200  # frames, or with a counter counts, after which the period and a count are known


class WheelAngle:
    """The angle of one wheel since ``rebase``, the sum of its rate samples.

    A counting encoder gives the counts of a sampling period over its length: the sum of rate times period is the
    counted angle, exact to a count however long the drive. An analogue one gives a rate with white noise at an instant:
    the trapezoid rule sums it. Which one it is shows at rest, where a counter gives nothing but zeros.
    ``noise_rad2_s2``: variance of a rate sample at rest, None until it was seen at rest.
    """

    __slots__ = (
        "_gap_rad",
        "_mean_rate",
        "_period_s",
        "_rate",
        "_seen",
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
        self._seen = 0
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
        if self._t_s == -inf:
            self._t_s, self._rate = times_s[0], rates_rad_s[0]
        is_counter = self.is_counter or self._is_counting(rates_rad_s)
        elapsed_s = times_s[-1] - self._t_s
        if self._is_known and elapsed_s < (len(times_s) + _EVEN) * self._period_s:
            # None is missing, and the periods are as even as the clock: their sum says it all.
            total = sum(rates_rad_s)
            turned = elapsed_s / len(times_s) * (total if is_counter else total + 0.5 * (self._rate - rates_rad_s[-1]))
        else:
            turned = self._counted(times_s, rates_rad_s) if is_counter else self._integrated(times_s, rates_rad_s)
        if elapsed_s > 0.0:
            self._mean_rate += (turned - self._mean_rate * elapsed_s) / (elapsed_s + _LATELY_S)
        self._t_s, self._rate = times_s[-1], rates_rad_s[-1]
        self.angle_rad += turned
        return turned

    @property
    def _is_known(self) -> bool:
        """The period has been seen often enough, and with a counter what a count is."""
        return self._seen >= _ENOUGH

    def _integrated(self, times_s: Sequence[float], rates_rad_s: Sequence[float]) -> float:
        turned, t0, before = 0.0, self._t_s, self._rate
        for t, rate in zip(times_s, rates_rad_s, strict=True):
            dt = t - t0
            if dt > _GAP_S:
                self._gap_rad += abs(rate) * dt
            if 0.0 < dt < self._period_s:
                self._period_s = dt
            turned += (before + rate) * dt
            t0, before = t, rate
        self._seen += 1
        return 0.5 * turned

    def _counted(self, times_s: Sequence[float], rates_rad_s: Sequence[float]) -> float:
        turned, t0, least, period = 0.0, self._t_s, self.quantum_rad, self._period_s
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
                self._seen += 1
                if -least < step < least and step:
                    least = abs(step)
            t0 = t
        self.quantum_rad, self._period_s = least, period
        return turned

    def _is_counting(self, rates_rad_s: Sequence[float]) -> bool:
        for rate in rates_rad_s:
            self._zeros = self._zeros + 1 if rate == 0.0 else 0
        if self._zeros >= _ZEROS_OF_A_COUNTER:
            self.is_counter, self.noise_rad2_s2 = True, 0.0
            self._seen = 0
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
