"""Pure. Nobody resumes a faulted robot: a reminder every minute, and home before the battery no longer lasts for it."""

from enum import StrEnum

from ccatp.config.models import Config

_EARLY = 1.05  # from the decision to the first turn of a wheel some charge goes, too


class Call(StrEnum):
    """What the vigil asks for."""

    NOTHING = ""
    REMIND = "remind"
    RETURN = "return"


class Vigil:
    """Watches over a fault.

    Args:
        cfg: period of the alarm; life, reserve and margin of the battery.
        falls: without fans the robot falls off this mirror: only there it is worth moving without an operator.
    """

    def __init__(self, cfg: Config, *, falls: bool) -> None:
        """No fault."""
        self._alarm_period_s, self._health, self._falls = cfg.mission.alarm_period_s, cfg.health, falls
        self._since_s: float | None = None
        self._remind_at_s = 0.0
        self._has_returned = False

    def held_s(self, t_s: float) -> float:
        """How long the fault lasts."""
        return 0.0 if self._since_s is None else t_s - self._since_s

    def over(self) -> None:
        """There is no fault any more."""
        self._since_s = None

    def watch(self, t_s: float, soc: float, home_s: float | None) -> Call:
        """One frame of a fault.

        Args:
            t_s: robot time.
            soc: state of charge, 0 to 1.
            home_s: time of the way home; ``None`` where the robot does not know where it is.
        """
        if self._since_s is None or t_s < self._since_s:
            self._since_s, self._remind_at_s = t_s, t_s + self._alarm_period_s
        # Once: a return that failed may have failed for the reason of the fault.
        if self._falls and not self._has_returned and home_s is not None and self.is_low(soc, home_s):
            self._has_returned = True
            return Call.RETURN
        if t_s < self._remind_at_s:
            return Call.NOTHING
        self._remind_at_s = t_s + self._alarm_period_s
        return Call.REMIND

    def is_low(self, soc: float, home_s: float) -> bool:
        """Whether the charge above the reserve is less than the way home may take."""
        needed = _EARLY * self._health.battery_margin * home_s / self._health.battery_life_s
        return not soc - self._health.battery_reserve > needed
