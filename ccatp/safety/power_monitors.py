"""Fans and battery, as far as the robot's echo shows them, and the faults that it reports itself."""

from collections.abc import Sequence

from ccatp.config.models import HealthConfig
from ccatp.core import Severity
from ccatp.safety.escalation import FindingLatch, MonitorFinding, Since

# A fan command is in force two delays of the link after it was sent, at the latest.
_FIRST_COMMAND_S = 1.0
# The way home goes along rows and columns of panels.
_DETOUR = 1.6
_OWN = {
    "imu": (Severity.SLOW, "the robot reports a fault of its inertial unit"),
    "encoder_left": (Severity.HOLD, "the robot reports a fault of its left encoder"),
    "encoder_right": (Severity.HOLD, "the robot reports a fault of its right encoder"),
    "edge": (Severity.HOLD, "the robot reports a fault of its edge sensors"),
    "stall": (Severity.HOLD, "the robot reports that a wheel is blocked"),
}
_FANS = ("fan_left", "fan_right")


class FanMonitor:
    """The echo of the fans' duties against the commanded ``duty`` (left, right), where the robot hangs on them.

    The echo is a set point. Thrust and rotation are on no wire: a fan that fails without its controller's notice is
    for the robot to report (``fan_left``, ``fan_right``).
    """

    def __init__(self, cfg: HealthConfig, duty: tuple[float, float], overhang: bool) -> None:
        self._cfg, self._overhang = cfg, overhang
        self._enough = cfg.fan_early_share * duty[0], cfg.fan_early_share * duty[1]
        self._least = cfg.fan_share * duty[0], cfg.fan_share * duty[1]
        self.alarm = FindingLatch(cfg.retry_after_s)
        self.reset()

    def reset(self) -> None:
        """The robot has booted: its fans wait for their command."""
        self.alarm.reset()
        self._low, self._weak, self._first_s = Since(), Since(), None
        self._was_right = False

    _first_s: float | None

    def step(self, t_s: float, fans: tuple[float, float], faults: Sequence[str]) -> None:
        """Judge a frame."""
        left, right = self._least
        is_low = fans[0] < left or fans[1] < right
        self._was_right = self._was_right or not is_low
        if self._first_s is None:
            self._first_s = t_s
        is_due = self._was_right or t_s - self._first_s > _FIRST_COMMAND_S
        lasts_s = self._low.lasts(t_s, is_low and is_due)
        if lasts_s >= self._cfg.fan_time_s - 1e-6 and self._overhang:
            k = 0 if fans[0] / left < fans[1] / right else 1
            cause = f"the {('left', 'right')[k]} fan gives too little"
            self._see(t_s, cause, _FANS[k], fans[k], self._least[k])
        elif self._overhang:
            is_weak = fans[0] < self._enough[0] or fans[1] < self._enough[1]
            if self._weak.lasts(t_s, is_weak and is_due) >= self._cfg.fan_time_s - 1e-6:
                k = 0 if fans[0] - self._enough[0] < fans[1] - self._enough[1] else 1
                cause = f"the {('left', 'right')[k]} fan gets weak"
                finding = MonitorFinding(Severity.RETURN, cause, _FANS[k], fans[k], self._enough[k], full_fans=True)
                self.alarm.see(t_s, finding)
        for name in faults:
            if name in _FANS:
                self._see(t_s, f"the robot reports a fault of its {name[4:]} fan", name, 1.0, 0.0)
        self.alarm.settle(t_s)

    def _see(self, t_s: float, cause: str, signal: str, value: float, limit: float) -> None:
        severity = Severity.FAULT if self._overhang else Severity.INFORM
        self.alarm.see(t_s, MonitorFinding(severity, cause, signal, value, limit, full_fans=self._overhang))


class BatteryMonitor:
    """Whether the charge still is enough for the way home.

    A finding stays, because a battery does not charge on the way.
    """

    def __init__(self, cfg: HealthConfig) -> None:
        self._cfg = cfg
        self.finding: MonitorFinding | None = None
        self.reset()

    def reset(self) -> None:
        """The clock began anew."""
        self._low, self._told = Since(), Since()

    def step(self, t_s: float, soc: float, is_told: bool, home_m: float) -> None:
        """Judge a frame; ``soc`` from 0 to 1."""
        cfg = self._cfg
        least = cfg.battery_reserve
        least += cfg.battery_margin * _DETOUR * home_m / cfg.slow_speed_m_s / cfg.battery_life_s
        if self._low.lasts(t_s, soc < least) >= cfg.battery_time_s:
            self.finding = MonitorFinding(
                Severity.RETURN, "the battery has to last for the way home", "soc", soc, least
            )
        if self._told.lasts(t_s, is_told) >= cfg.battery_time_s:
            self.finding = MonitorFinding(Severity.RETURN, "the robot reports a low battery", "battery_low", soc, least)


class OwnFaults:
    """Faults that the robot reports of itself, but those of fans and battery."""

    def __init__(self, cfg: HealthConfig) -> None:
        self._clear_s = cfg.retry_after_s
        self.alarms: dict[str, FindingLatch] = {}

    def reset(self) -> None:
        """Forget."""
        self.alarms.clear()

    def step(self, t_s: float, faults: Sequence[str]) -> None:
        """Take the names of a frame; unknown ones are told."""
        for name in faults:
            if name in _FANS or name == "battery_low":
                continue
            severity, cause = _OWN.get(name, (Severity.INFORM, "the robot reports a fault that is not known here"))
            self.alarms.setdefault(name, FindingLatch(self._clear_s)).see(
                t_s, MonitorFinding(severity, cause, name, 1.0, 0.0)
            )
        for name, alarm in list(self.alarms.items()):
            alarm.settle(t_s)
            if alarm.finding is None:
                del self.alarms[name]
