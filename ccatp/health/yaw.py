"""Pure. The gyroscope against the wheels: a bias that jumped, a wrong sign or scale, or wheels that slip."""

from ccatp.config.models import HealthConfig, RobotConfig
from ccatp.health.findings import Alarm, Finding
from ccatp.health.imu_gate import ImuGate
from ccatp.health.look import Moved
from ccatp.samples import Severity

_BIAS_TIME_S = 0.5
_LARGEST_BIAS_RAD_S = 0.35


class GyroscopeBias:
    """What the gyroscope shows at rest, from samples whose size is bounded: garbage must not move it far.

    Attributes:
        rad_s: the bias.
    """

    def __init__(self) -> None:
        """Unbiased."""
        self.rad_s = 0.0

    def stand(self, wz_rad_s: float, dt_s: float) -> None:
        """Take a sample at rest."""
        bounded = min(max(wz_rad_s, -_LARGEST_BIAS_RAD_S), _LARGEST_BIAS_RAD_S)
        self.rad_s += dt_s / (_BIAS_TIME_S + dt_s) * (bounded - self.rad_s)


class YawMonitor:
    """Compares the turn of the gyroscope with that of the wheels while the robot moves.

    Args:
        cfg: limits.
        robot: wheels.

    Attributes:
        alarm: what was found.
    """

    def __init__(self, cfg: HealthConfig, robot: RobotConfig) -> None:
        """Nothing found."""
        self._cfg, self._base_m = cfg, robot.wheel_base_m
        self.alarm = Alarm(cfg.retry_after_s)

    def reset(self) -> None:
        """Forget."""
        self.alarm.reset()

    def step(self, t_s: float, moved: Moved) -> None:
        """Judge a frame; ``moved`` is the change of the sums over ``yaw_time_s``, while the unit was believed."""
        cfg = self._cfg
        by_wheels = (moved.right_m - moved.left_m) / self._base_m
        by_gyroscope = moved.turned_rad
        difference = by_gyroscope - by_wheels
        limit = cfg.yaw_limit_rad + cfg.yaw_share * max(abs(by_wheels), abs(by_gyroscope))
        if not -limit <= difference <= limit:
            cause = "gyroscope and wheels disagree about the turn: a wheel slips, or the gyroscope is off"
            self.alarm.see(t_s, Finding(Severity.HOLD, cause, "imu_wz", difference, limit))


def imu_finding(gate: ImuGate) -> Finding | None:
    """What the gate has against the inertial unit: it is left out, and the robot goes slowly by its wheels."""
    if not gate.cause:
        return None
    return Finding(Severity.SLOW, f"{gate.cause}: left out", "imu", gate.value, gate.limit)
