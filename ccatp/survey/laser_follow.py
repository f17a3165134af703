"""Whether the laser follows the robot: its fixes against encoders and gyroscope, from standstill to standstill.

Lengths of one place, with new noise each time, agree with each other at every standstill. A robot that does not move
though its wheels turn looks alike; the gyroscope tells the two apart.
"""

from collections.abc import Sequence
from math import cos, dist, hypot, sin, sqrt

from ccatp.config.models import Config
from ccatp.core import Fix, Vector3

_MOVED_M = 0.020  # by the wheels between two standstills; many sigma of their odometry
_TURNED_RAD = 0.1  # by the gyroscope; many sigma of its drift within minutes
_SAME_SIGMAS = 6.0
_CERTAIN = 2  # standstills after the first one
_LONGEST_STEP_S = 0.1  # a longer gap between samples adds no motion

Rows = Sequence[Sequence[float | None]]


class LaserFollow:
    """Compares the fixes of successive standstills with the motion between them.

    ``standstills``: number of those whose fixes agree, the first included.
    """

    def __init__(self, cfg: Config) -> None:
        self._radius_m = cfg.robot.wheel_radius_m
        self._bias_rad_s = cfg.localizer.gyroscope_bias_rad_s
        self._repeat_m = cfg.etalon.repeat_m
        self._imu_s: float | None = None
        self._enc_s: float | None = None
        self._heading_rad = self._turned_rad = 0.0
        self._x_m = self._y_m = 0.0
        self._place_m: Vector3 | None = None
        self._sigma_m = 0.0
        self._count = 0
        self._is_begun = self._has_turned = False

    @property
    def standstills(self) -> int:
        """Standstills with the same fix."""
        return self._count + 1

    @property
    def is_certain(self) -> bool:
        """Encoders and gyroscope contradict the fixes of several standstills."""
        return self._count >= _CERTAIN and self._has_turned

    def add(self, imu: Rows, enc: Rows) -> None:
        """Add the samples of a frame: (t, ax, wz) and (t, right, left), in s, m/s^2, rad/s."""
        for row in imu:
            t_s, rate = row[0], row[2]
            if t_s is None or rate is None:
                continue
            if self._imu_s is not None and 0.0 < t_s - self._imu_s <= _LONGEST_STEP_S:
                turn = (rate - self._bias_rad_s) * (t_s - self._imu_s)
                self._heading_rad += turn
                self._turned_rad += turn
            self._imu_s = t_s
        for row in enc:
            t_s, right, left = row[0], row[1], row[2]
            if t_s is None or right is None or left is None:
                continue
            if self._enc_s is not None and 0.0 < t_s - self._enc_s <= _LONGEST_STEP_S:
                way_m = 0.5 * self._radius_m * (right + left) * (t_s - self._enc_s)
                self._x_m += way_m * cos(self._heading_rad)
                self._y_m += way_m * sin(self._heading_rad)
            self._enc_s = t_s

    def begin(self) -> None:
        """Begin a new standstill."""
        self._is_begun = True

    def doubt(self, fix: Fix) -> str:
        """Why a fix is not used, or empty; call for each fix of a standstill."""
        place_m = self._place_m
        sigma_m = sqrt(max(fix.covariance_m2[0] + fix.covariance_m2[4] + fix.covariance_m2[8], 0.0))
        moved_m = hypot(self._x_m, self._y_m)
        if place_m is None or not self._is_same(fix, sigma_m, place_m):
            self._start(fix, sigma_m)
            return ""
        if moved_m <= _MOVED_M and not self._count:
            return ""
        if self._is_begun and moved_m > _MOVED_M:
            self._count += 1
            self._has_turned = self._has_turned or abs(self._turned_rad) > _TURNED_RAD
            self._x_m = self._y_m = self._turned_rad = 0.0
        self._is_begun = False
        if self._count >= _CERTAIN and not self._has_turned:
            # The wheels may turn on the spot: the agreement of the fixes decides.
            return ""
        way_mm = 1e3 * max(moved_m, _MOVED_M)
        return f"it is where the robot stood before, and the wheels moved by {way_mm:.0f} mm since"

    def _is_same(self, fix: Fix, sigma_m: float, place_m: Vector3) -> bool:
        limit_m = min(self._repeat_m, 0.5 * _MOVED_M) + _SAME_SIGMAS * hypot(sigma_m, self._sigma_m)
        return dist(fix.position_m, place_m) <= min(limit_m, 0.5 * _MOVED_M)

    def _start(self, fix: Fix, sigma_m: float) -> None:
        self._place_m, self._sigma_m = fix.position_m, sigma_m
        self._x_m = self._y_m = self._turned_rad = 0.0
        self._count, self._has_turned, self._is_begun = 0, False, False
