"""Monitor of the wheels' grip."""

from collections.abc import Sequence

from ccatp.conditions import MonitorFinding
from ccatp.conditions import danger as conditions
from ccatp.config.models import HealthConfig, RobotConfig
from ccatp.core import GravitySample, ImuSample
from ccatp.rest import LOADED_WHEEL_STANDS_RAD_S
from ccatp.safety.monitor import Monitor
from ccatp.sensing.wheel_means import WheelMeans
from ccatp.slide_rule import SlideRule

_GRAVITY_TIME_S = 0.2  # time constant of the average of the noisy gravity samples
_HOLDS = 1.05  # full thrust over the least; below this the robot may slide anywhere
_REPORTED_CONTACTS = 20.0  # a slide of 1.2 s has up to 19


class GripMonitor(Monitor):
    """Finds loss of grip (the body moves downhill faster than its wheels) and too little grip (by the creep of turns).

    Loss of grip: the forward acceleration less its bias at rest is compared with the change of the wheels' speed, and
    the gyroscope with the wheels' turn; or the robot reports it. ``finding``: about the margin that main measures;
    ``noise``: about an accelerometer of single differences.
    """

    def __init__(self, cfg: HealthConfig, robot: RobotConfig) -> None:
        super().__init__()
        self._slide_m_s = cfg.grip_slide_m_s
        self._turn_rad = cfg.grip_turn_rad
        self._radius_m = robot.wheel_radius_m
        self._per_base = robot.wheel_radius_m / robot.wheel_base_m
        self._least_margin = robot.thrust_margin
        self.alarm = self.latch(cfg.retry_after_s)
        self.reset()

    def reset(self) -> None:
        """See ``Monitor``."""
        super().reset()
        self._rule = SlideRule(self._slide_m_s, self._turn_rad)
        self.finding = None
        self.noise: MonitorFinding | None = None
        self._ahead = 0.0
        self._bias_m_s2 = 0.0
        self._speed_m_s = 0.0
        self._rested = 0

    def findings(self, t_s: float) -> list[MonitorFinding]:
        """See ``Monitor``."""
        found = super().findings(t_s)
        if self.noise is not None:
            found.append(self.noise)
        return found

    def take_margin(self, margin: float) -> None:
        """Take main's margin: full thrust over the least that holds the robot everywhere; 0: not measured."""
        is_short, is_held = 0.0 < margin < 0.999 * self._least_margin, margin >= _HOLDS
        condition = conditions.GRIP_LITTLE if is_held else conditions.GRIP_TOO_LITTLE
        least = self._least_margin if is_held else _HOLDS
        self.finding = condition.found("grip", margin, least) if is_short else None

    def step(
        self,
        t_s: float,
        dt_s: float,
        imu: Sequence[ImuSample],
        means: WheelMeans,
        gravity: GravitySample | None,
        bias_rad_s: float,
    ) -> bool:
        """Take a frame; returns whether the robot slides. ``bias_rad_s``: of the gyroscope."""
        rule = self._rule
        if gravity is not None:
            self._ahead += 0.05 / (_GRAVITY_TIME_S + 0.05) * (gravity[1] - self._ahead)
        right, left = means.right_rad_s, means.left_rad_s
        if not imu or right is None or left is None:
            return False
        _, ax, wz = imu[-1]
        speed_m_s, before_m_s = 0.5 * self._radius_m * (right + left), self._speed_m_s
        self._speed_m_s = speed_m_s
        change_m_s = speed_m_s - before_m_s
        is_sound = rule.is_possible(ax) and abs(change_m_s) < rule.WHEEL_JUMP_M_S
        stands_rad_s = LOADED_WHEEL_STANDS_RAD_S
        is_still = -stands_rad_s < right < stands_rad_s and -stands_rad_s < left < stands_rad_s
        if is_still and self._rested < rule.BIAS_SAMPLES and is_sound:
            self._rested += 1
            self._bias_m_s2 += (ax - self._bias_m_s2) / self._rested
        if not is_sound or self._rested < rule.BIAS_SAMPLES or not 0.0 < dt_s < rule.MEMORY_S:
            rule.reset()
            return False
        # The link carries only the forward component of the acceleration.
        side = 1.0 if self._ahead >= rule.LEAST_SLOPE else -1.0 if self._ahead <= -rule.LEAST_SLOPE else 0.0
        turned_rad = (wz - bias_rad_s - self._per_base * (right - left)) * dt_s
        slid_m_s = rule.step(dt_s, (ax - self._bias_m_s2) * dt_s - change_m_s, 0.0, turned_rad, (side, 0.0))
        self._judge_noise()
        return slid_m_s > 0.0 and self.report(t_s, slid_m_s)

    def _judge_noise(self) -> None:
        contacts = self._rule.contacts
        if contacts < SlideRule.CONTACTS:
            self.noise = None
        elif contacts > _REPORTED_CONTACTS:
            self.noise = conditions.ACCELEROMETER_DIFFERENCES.found("accelerometer", contacts, _REPORTED_CONTACTS)

    def report(self, t_s: float, slid_m_s: float) -> bool:
        """Report that the robot slides downhill at ``slid_m_s``, by this rule or by the robot's own."""
        self.alarm.see(t_s, conditions.GRIP_LOST.found("grip", slid_m_s, self._rule.limit_m_s))
        return True
