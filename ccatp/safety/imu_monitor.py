"""Monitor of the inertial unit, and the turn of the robot by its gyroscope."""

from collections.abc import Sequence

from ccatp.conditions import MonitorFinding
from ccatp.conditions import danger as conditions
from ccatp.config.models import HealthConfig
from ccatp.core import ImuSample
from ccatp.rest import WHEEL_STANDS_RAD_S
from ccatp.safety.monitor import Monitor
from ccatp.sensing.imu_gate import ImuGate
from ccatp.sensing.wheel_means import WheelMeans

# The gyroscope's bias, averaged at rest. Readings are bounded, so that garbage cannot move it far.
_BIAS_TIME_S = 0.5
_LARGEST_BIAS_RAD_S = 0.35


class ImuMonitor(Monitor):
    """Leaves out impossible readings. ``bias_rad_s``: of the gyroscope, which a reset keeps."""

    def __init__(self, cfg: HealthConfig) -> None:
        super().__init__()
        self._gate = ImuGate(cfg)
        self.bias_rad_s = 0.0
        self.reset()

    def reset(self) -> None:
        """See ``Monitor``."""
        super().reset()
        self._gate.reset()

    @property
    def is_left_out(self) -> bool:
        """Whether the readings are not used."""
        return bool(self._gate.cause)

    def step(self, dt_s: float, imu: Sequence[ImuSample], means: WheelMeans, age_s: float) -> float:
        """The turn in a frame, rad: 0 while the wheels stand, by them without a usable reading.

        ``age_s``: of the newest sample, at the frame.
        """
        right, left = means.right_rad_s, means.left_rad_s
        usable = self._gate.admit(imu, means.yaw_rad_s, age_s - dt_s) if imu else imu
        if right is None or left is None:
            return 0.0
        if not usable:
            return means.yaw_rad_s * dt_s
        wz = usable[-1][2]
        if -WHEEL_STANDS_RAD_S < right < WHEEL_STANDS_RAD_S and -WHEEL_STANDS_RAD_S < left < WHEEL_STANDS_RAD_S:
            bounded = min(max(wz, -_LARGEST_BIAS_RAD_S), _LARGEST_BIAS_RAD_S)
            self.bias_rad_s += dt_s / (_BIAS_TIME_S + dt_s) * (bounded - self.bias_rad_s)
            return 0.0
        return (wz - self.bias_rad_s) * dt_s

    def findings(self, t_s: float) -> list[MonitorFinding]:
        """See ``Monitor``; and that the readings are left out."""
        found, gate = super().findings(t_s), self._gate
        if gate.cause:
            found.append(conditions.IMU_LEFT_OUT.found("imu", gate.value, gate.limit, what=gate.cause))
        return found
