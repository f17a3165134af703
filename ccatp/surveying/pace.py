"""Pure. The leg tracker at two paces: the usual one, and the reduced one while something is not quite right."""

from ccatp.config.models import ControlConfig, HealthConfig, LimitsConfig
from ccatp.control.tracker import NO_CREEP, LegTracker


class PacedTracker(LegTracker):
    """A leg tracker that plans with the reduced limits while ``is_slow``; a change counts from the next leg or turn.

    Args:
        control: tolerances and gains.
        limits: the usual limits.
        health: the reduced speeds.
        wheel_lag_s: time constant of the wheel servo.

    Attributes:
        is_slow: plan the next motion at the reduced pace.
    """

    def __init__(self, control: ControlConfig, limits: LimitsConfig, health: HealthConfig, wheel_lag_s: float) -> None:
        """At the usual pace."""
        slow = limits.model_copy(
            update={
                "v_max_m_s": min(limits.v_max_m_s, health.slow_speed_m_s),
                "omega_max_rad_s": min(limits.omega_max_rad_s, health.slow_rate_rad_s),
            }
        )
        self._paces = LegTracker(control, limits, wheel_lag_s), LegTracker(control, slow, wheel_lag_s)
        super().__init__(control, limits, wheel_lag_s)
        self.is_slow = self._was_slow = False

    def begin(
        self,
        pose: tuple[float, float, float],
        target: tuple[float, float],
        reverse: bool,
        creep: tuple[float, float] = NO_CREEP,
    ) -> None:
        """Start a leg; see ``LegTracker.begin``."""
        self._change_pace()
        super().begin(pose, target, reverse, creep)

    def begin_turn(self, angle_rad: float) -> None:
        """Start a turn in place; see ``LegTracker.begin_turn``."""
        self._change_pace()
        super().begin_turn(angle_rad)

    def _change_pace(self) -> None:
        """Take over the axes of the other tracker: they hold the limits."""
        if self.is_slow is self._was_slow:
            return
        self._was_slow = self.is_slow
        other = self._paces[self.is_slow]
        self._along, self._forward, self._angular = other._along, other._forward, other._angular
        self._steering, self._line, self._omega_max = other._steering, other._line, other._omega_max
