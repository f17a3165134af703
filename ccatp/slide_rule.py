"""The rule that detects loss of grip, for the danger loop and the on-board program.

An accelerometer with means over the time between two samples has a noise that cancels in the sum of its samples. The
noise of single differences does not: each contact looks like a jump in speed, and several look like a slide. Two
properties distinguish them from a slide: a slide consists of many samples, and no body slides uphill.
"""

from ccatp.core import Vector2

_LEAST_SHARE = 0.3  # least part of the limit of the slide, because a difference in turning alone is no slide
_LARGEST_M_S2 = 10.0  # gravity cannot cause a larger acceleration
_CONTACT_M_S2 = 2.0  # a single larger difference that its neighbours do not take back is a contact
_FORGOTTEN_S = 20.0  # legs and turns, which differ in noise, alternate within this time
# Largest value downhill that noise reaches, over the largest one uphill within about _FORGOTTEN_S: five sigma over two
# and a half, if the values are normally distributed.
_NOISE_FACTOR = 2.0
_AFTER_SLIDE_S = 1.0  # a body that comes to rest after a slide is slower than its wheels were: no noise


class ContactCounter:
    """Counts the contacts in one component of the difference between body and wheels. ``count``: of about 20 s."""

    def __init__(self) -> None:
        self._before_m_s = self._last_m_s = self.count = 0.0

    def take(self, dt_s: float, step_m_s: float) -> None:
        """Take the difference in speed within ``dt_s``."""
        before_m_s, last_m_s = self._before_m_s, self._last_m_s
        self._before_m_s = last_m_s
        self._last_m_s = step_m_s
        self.count *= _FORGOTTEN_S / (_FORGOTTEN_S + dt_s)
        # A slide has neighbouring samples of similar size. In means over the time between two samples, a jump in speed
        # and its end cancel in neighbouring samples.
        size_m_s, sign = abs(last_m_s), 1.0 if last_m_s > 0.0 else -1.0
        neighbours = sign * before_m_s, sign * step_m_s
        is_single = max(neighbours) < 0.5 * size_m_s
        if is_single and size_m_s + min(0.0, *neighbours) > _CONTACT_M_S2 * dt_s:
            self.count += 1.0


class SlideRule:
    """Detects loss of grip: the body moves downhill faster than its wheels.

    The differences between body and wheels in speed and in angle are summed with a memory of 60 ms, and compared with
    the limits ``slide_m_s`` and ``turn_rad``. The larger the difference in angle, the smaller this limit.

    After ``CONTACTS`` contacts the accelerometer is treated as one of single differences: no sample counts more than
    2 m/s^2, and noise may raise the limit, ``limit_m_s``. No body slides uphill, so the sum uphill is noise.
    """

    MEMORY_S = 0.06
    LEAST_SLOPE = 0.15  # least component of the unit gravity along the surface with which the robot can slide
    WHEEL_JUMP_M_S = 0.03  # larger than any change in 10 ms of the speed of a wheel with load
    CONTACTS = 5.0  # within about 20 s; on flat tyres means over 10 ms show at most 6, single differences 48 and more
    BIAS_SAMPLES = 50  # accelerometer samples at rest whose mean is its bias

    def __init__(self, slide_m_s: float, turn_rad: float) -> None:
        self.slide_m_s = slide_m_s
        self._turn_rad = turn_rad
        self._ahead_m_s = self._left_m_s = self._turned_rad = 0.0
        self._since_slide_s = _AFTER_SLIDE_S
        self._ahead = ContactCounter()
        self._left = ContactCounter()
        self._noise_m_s = 0.0  # that noise may reach downhill

    @property
    def contacts(self) -> float:
        """Contacts of about the last 20 s."""
        return max(self._ahead.count, self._left.count)

    @property
    def shows_contacts(self) -> bool:
        """Whether the accelerometer is treated as one of single differences."""
        return self.contacts > self.CONTACTS

    @property
    def limit_m_s(self) -> float:
        """The present limit of the slide."""
        return max(self.slide_m_s, self._noise_m_s) if self.shows_contacts else self.slide_m_s

    def is_possible(self, acceleration_m_s2: float) -> bool:
        """Whether gravity, or a contact in a single difference, can cause an acceleration."""
        return abs(acceleration_m_s2) < _LARGEST_M_S2 or self.shows_contacts

    def reset(self) -> None:
        """Drop the sums of the last 60 ms; the noise is kept."""
        self._ahead_m_s = self._left_m_s = self._turned_rad = 0.0

    def step(self, dt_s: float, ahead_m_s: float, left_m_s: float, turned_rad: float, downhill: Vector2) -> float:
        """Take the differences, body minus wheels, within ``dt_s``; returns the slide downhill, m/s, 0 without one.

        ``downhill``: unit vector, robot frame; zeros without a slope.
        """
        self._since_slide_s += dt_s
        self._ahead.take(dt_s, ahead_m_s)
        self._left.take(dt_s, left_m_s)
        if self.shows_contacts:
            most_m_s = _CONTACT_M_S2 * dt_s
            ahead_m_s = min(max(ahead_m_s, -most_m_s), most_m_s)
            left_m_s = min(max(left_m_s, -most_m_s), most_m_s)
        keep = self.MEMORY_S / (self.MEMORY_S + dt_s)
        self._ahead_m_s = keep * (self._ahead_m_s + ahead_m_s)
        self._left_m_s = keep * (self._left_m_s + left_m_s)
        self._turned_rad = keep * (self._turned_rad + turned_rad)
        downhill_m_s = self._ahead_m_s * downhill[0] + self._left_m_s * downhill[1]
        self._noise_m_s *= _FORGOTTEN_S / (_FORGOTTEN_S + dt_s)
        if self._since_slide_s > _AFTER_SLIDE_S:
            self._noise_m_s = max(self._noise_m_s, -_NOISE_FACTOR * downhill_m_s)
        share = downhill_m_s / self.limit_m_s
        if share < _LEAST_SHARE or share + abs(self._turned_rad) / self._turn_rad < 1.0:
            return 0.0
        self._since_slide_s = 0.0
        return downhill_m_s
