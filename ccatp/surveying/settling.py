"""Pure. Standing still: when the speeds that the localizer gives mean that the robot is at rest."""

from ccatp.config.models import ControlConfig

# Sums of frame periods are not exact: half a nanosecond must not cost a frame.
TIME_EPSILON_S = 5e-10


class Stillness:
    """At rest: both speeds, or both of their running means, have been below the limits for the settling time.

    Fans shake the body with a mean of zero; wheels that run down, or that creep, move the mean as well.

    Args:
        cfg: limits and times.
    """

    __slots__ = ("_cfg", "_mean_rate_rad_s", "_mean_speed_m_s", "_since_s")

    def __init__(self, cfg: ControlConfig) -> None:
        """Not known to rest."""
        self._cfg = cfg
        self.reset()

    def reset(self) -> None:
        """The robot moves, or may have moved."""
        self._since_s: float | None = None
        self._mean_speed_m_s: float | None = None
        self._mean_rate_rad_s = 0.0

    def is_rest(self, t_s: float, dt_s: float, speed_m_s: float, rate_rad_s: float) -> bool:
        """Take the speeds of a frame; whether the robot is at rest.

        Args:
            t_s: time of the frame.
            dt_s: time since the one before.
            speed_m_s, rate_rad_s: the estimate.
        """
        cfg = self._cfg
        if self._mean_speed_m_s is None:
            self._mean_speed_m_s, self._mean_rate_rad_s = speed_m_s, rate_rad_s
        share = dt_s / (cfg.settle_mean_time_s + dt_s)
        self._mean_speed_m_s += share * (speed_m_s - self._mean_speed_m_s)
        self._mean_rate_rad_s += share * (rate_rad_s - self._mean_rate_rad_s)
        is_slow = self._is_slow(speed_m_s, rate_rad_s) or self._is_slow(self._mean_speed_m_s, self._mean_rate_rad_s)
        if not is_slow:
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = t_s
        return t_s - self._since_s >= cfg.settle_time_s - TIME_EPSILON_S

    def _is_slow(self, speed_m_s: float, rate_rad_s: float) -> bool:
        return abs(speed_m_s) <= self._cfg.settle_speed_m_s and abs(rate_rad_s) <= self._cfg.settle_rate_rad_s
