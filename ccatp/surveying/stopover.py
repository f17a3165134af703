"""Pure. Standing at a stop: coming to rest, then the time that the laser system needs, then the measurement."""

from ccatp.config.models import ControlConfig
from ccatp.samples import PointId
from ccatp.surveying.journey import Motion
from ccatp.surveying.settling import TIME_EPSILON_S, Stillness

# Wheels stop within half a second: a robot that is not at rest after this long creeps, or its sensors say so.
SETTLE_LIMIT_S = 10.0


class Stopover:
    """From the end of a leg to the request for a measurement.

    Args:
        control: when the robot is at rest.
        measuring_time_s: it stands for this long before the lengths are read.

    Attributes:
        request: number of the measurement that was asked for last.
        is_asked: it has been asked for at this stop.
    """

    def __init__(self, control: ControlConfig, measuring_time_s: float) -> None:
        """Nothing asked yet."""
        self._stillness = Stillness(control)
        self._measuring_time_s = measuring_time_s
        self._rest_by_s: float | None = None
        self._measure_at_s = 0.0
        self._arrived_at: PointId | None = None
        self._is_anew = False
        self.request = 0
        self.is_asked = False

    def interrupt(self) -> None:
        """The robot moves, or may have moved: the stop begins anew."""
        self.is_asked = self._is_anew = False
        self._stillness.reset()
        self._rest_by_s = None

    def is_quiet(self, motion: Motion) -> bool:
        """Take the speeds of a frame; whether the robot has been at rest for the settling time."""
        return self._stillness.is_rest(motion.t_s, motion.dt_s, motion.speed_m_s, motion.rate_rad_s)

    def has_settled(self, motion: Motion) -> bool:
        """One frame of coming to rest; whether that is over, and the measuring time begins."""
        if self._rest_by_s is None:
            self._rest_by_s = motion.t_s + SETTLE_LIMIT_S
        if not self.is_quiet(motion):
            return False
        self._begin(motion.t_s)
        return True

    def _begin(self, t_s: float) -> None:
        """The measuring time begins, and with it the time until which the robot has to stand still."""
        self._measure_at_s = t_s + self._measuring_time_s - TIME_EPSILON_S
        self._rest_by_s = t_s + SETTLE_LIMIT_S

    def is_restless(self, t_s: float) -> bool:
        """Whether coming to rest, or standing still for a measurement, takes far longer than it should."""
        return self._rest_by_s is not None and t_s > self._rest_by_s

    def arrival_at(self, point: PointId | None) -> PointId | None:
        """The point, where the robot has come to rest there for the first time."""
        if point is None or point == self._arrived_at:
            return None
        self._arrived_at = point
        return point

    def repeat(self) -> None:
        """The measurement failed: it is asked for once more, after another measuring time."""
        self.is_asked, self._is_anew = False, True

    def is_due(self, motion: Motion) -> bool:
        """Take a frame of the measuring time; whether to ask for the measurement now. True once at each stop.

        A robot that moves once more after all spoils the measurement, and one that is under way as well: the time
        begins anew, and what was asked for is not wanted any more.
        """
        t_s = motion.t_s
        if self._is_anew:
            self._is_anew = False
            self._begin(t_s)
        if not self.is_quiet(motion):
            if self.is_asked:
                self.is_asked = False
                self._begin(t_s)
            self._measure_at_s = t_s + self._measuring_time_s - TIME_EPSILON_S
        if self.is_asked or t_s < self._measure_at_s:
            return False
        self._rest_by_s = None
        self.is_asked = True
        self.request += 1
        return True
