"""Monitors of what the robot reports of itself: fans, battery, faults."""

from collections.abc import Sequence

from ccatp.conditions import MonitorFinding
from ccatp.conditions import danger as conditions
from ccatp.config.models import HealthConfig
from ccatp.safety.escalation import FindingLatch, Since
from ccatp.safety.monitor import Monitor

# A fan command is in force at the latest two link delays after it was sent.
_FIRST_COMMAND_S = 1.0


REPORTED = {
    "imu": conditions.IMU_REPORTED,
    "encoder_left": conditions.ENCODER_REPORTED,
    "encoder_right": conditions.ENCODER_REPORTED,
    "edge": conditions.EDGE_REPORTED,
    "stall": conditions.STALL_REPORTED,
}


FANS = ("fan_left", "fan_right")
BATTERY_LOW = "battery_low"
_SIDES = ("left", "right")


class FanMonitor(Monitor):
    """Compares the echo of the fans' duties with the commanded ``duty`` (left, right), where the mirror overhangs.

    The echo is only a set point. Thrust and rotation are not on the link, so the robot itself has to report a fan that
    fails (``fan_left``, ``fan_right``).
    """

    def __init__(self, cfg: HealthConfig, duty: tuple[float, float], overhang: bool) -> None:
        super().__init__()
        self._cfg = cfg
        self._overhang = overhang
        self._enough = cfg.fan_early_share * duty[0], cfg.fan_early_share * duty[1]
        self._least = cfg.fan_share * duty[0], cfg.fan_share * duty[1]
        self.alarm = self.latch(cfg.retry_after_s)
        self.reset()

    def reset(self) -> None:
        """See ``Monitor``."""
        super().reset()
        self._low = Since()
        self._weak = Since()
        self._first_s: float | None = None
        self._was_right = False
        self._sound: tuple[float, float] | None = None  # the newest duties, if they are high enough

    def step(self, t_s: float, fans: tuple[float, float], faults: Sequence[str]) -> None:
        """Judge a frame."""
        if fans == self._sound and not faults:
            return
        left, right = self._least
        is_weak = False
        is_low = fans[0] < left or fans[1] < right
        self._was_right = self._was_right or not is_low
        if self._first_s is None:
            self._first_s = t_s
        is_due = self._was_right or t_s - self._first_s > _FIRST_COMMAND_S
        lasts_s = self._low.lasts(t_s, is_low and is_due)
        if lasts_s >= self._cfg.fan_time_s - 1e-6 and self._overhang:
            k = 0 if fans[0] / left < fans[1] / right else 1
            self.alarm.see(t_s, conditions.FAN_TOO_LITTLE.found(FANS[k], fans[k], self._least[k], side=_SIDES[k]))
        elif self._overhang:
            is_weak = fans[0] < self._enough[0] or fans[1] < self._enough[1]
            if self._weak.lasts(t_s, is_weak and is_due) >= self._cfg.fan_time_s - 1e-6:
                k = 0 if fans[0] - self._enough[0] < fans[1] - self._enough[1] else 1
                finding = conditions.FAN_WEAK.found(FANS[k], fans[k], self._enough[k], side=_SIDES[k])
                self.alarm.see(t_s, finding)
        for name in faults:
            if name in FANS:
                reported = conditions.FAN_REPORTED if self._overhang else conditions.FAN_REPORTED_ON_THE_FLAT
                self.alarm.see(t_s, reported.found(name, 1.0, 0.0, side=name[4:]))
        self._sound = None if is_low or is_weak else fans


class BatteryMonitor(Monitor):
    """Checks that the charge is enough for the way home. A finding stays, because the battery does not recharge."""

    def __init__(self, cfg: HealthConfig) -> None:
        super().__init__()
        self._cfg = cfg
        self.finding = None
        self.reset()

    def reset(self) -> None:
        """Begin the durations again; the finding stays."""
        super().reset()
        self._low = Since()
        self._reported = Since()

    def step(self, t_s: float, soc: float, is_reported: bool, home_m: float) -> None:
        """Judge a frame; ``soc`` from 0 to 1, ``home_m``: length of the way home."""
        cfg = self._cfg
        least = cfg.battery_reserve
        least += cfg.battery_margin * home_m / cfg.slow_speed_m_s / cfg.battery_life_s
        if self._low.lasts(t_s, soc < least) >= cfg.battery_time_s:
            self.finding = conditions.BATTERY_LOW.found("soc", soc, least)
        if self._reported.lasts(t_s, is_reported) >= cfg.battery_time_s:
            self.finding = conditions.BATTERY_REPORTED.found("battery_low", soc, least)


class ReportMonitor(Monitor):
    """The faults that the robot reports, except those that other monitors judge."""

    def __init__(self, cfg: HealthConfig) -> None:
        super().__init__()
        self._cfg = cfg
        self.reset()

    def reset(self) -> None:
        """See ``Monitor``."""
        super().reset()
        self._reported: dict[str, FindingLatch] = {}

    def step(self, t_s: float, faults: Sequence[str]) -> None:
        """Take the faults of a frame."""
        for name in faults:
            if name in FANS or name == BATTERY_LOW:
                continue
            latch = self._reported.setdefault(name, FindingLatch(self._cfg.retry_after_s))
            condition = REPORTED.get(name, conditions.UNKNOWN_REPORTED)
            latch.see(t_s, condition.found(name, 1.0, 0.0, side=name.removeprefix("encoder_")))

    def findings(self, t_s: float) -> list[MonitorFinding]:
        """See ``Monitor``. A fault that has ended is dropped, because its name may be any text."""
        found = super().findings(t_s)
        for name, latch in list(self._reported.items()):
            if (finding := latch.settle(t_s)) is None:
                del self._reported[name]
            else:
                found.append(finding)
        return found
