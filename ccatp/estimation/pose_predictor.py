"""The pose between two steps of the full-state filter."""

from math import cos, sin, sqrt

from ccatp.core import FloatArray
from ccatp.estimation.odometry import Slope
from ccatp.estimation.state_model import BG, CT, KG, KL, PSI, SL, SR, A, C, V, W, X, Y


class PosePredictor:
    """Current deck pose and speeds: the filter's last step, advanced by dead reckoning with ``SurveyMotion``.

    The speed comes from an observer of fixed gain: it is predicted with the filter's acceleration and corrected with
    the wheels' travel, by its resolution. The rate is the mean of wheels and gyroscope, weighted by their noise.
    """

    def __init__(self, wheel_radius_m: float, wheel_base_m: float, jerk_density_m2_s5: float) -> None:
        self._radius_m = wheel_radius_m
        self._base_m = wheel_base_m
        self._jerk_density_m2_s5 = jerk_density_m2_s5
        self._noise = (0.0, 0.0, 0.0)
        self._speed_gain = self._gyro_share = 0.0
        self.x_m = self.y_m = self.heading_rad = self.v_m_s = self.omega_rad_s = 0.0
        self.creep_x = self.creep_y = self._turn_creep_x = self._turn_creep_y = 0.0

    def begin(self, mean: FloatArray, slope: Slope, half_s: float, turn_creep_share: float = 1.0) -> None:
        """Begin after a step of the filter of length 2 ``half_s``, whose mean speed belongs to the middle."""
        q: list[float] = mean.tolist()
        self.x_m = q[X]
        self.y_m = q[Y]
        self.heading_rad = q[PSI]
        self._a = q[A]
        self._bias = q[BG]
        self.v_m_s = q[V] + q[A] * half_s
        self.omega_rad_s = q[W]
        self._per_scale = 1.0 / (1.0 + q[KG])
        self._right_m = self._radius_m * (1.0 - q[SR])
        self._left_m = self._radius_m * (1.0 - q[SL])
        self._per_base = 1.0 / (self._base_m * (1.0 + q[KL]))
        fx, fy, fxx, fxy, _, gx, gy = slope
        s2 = 1.0 + fx * fx
        s = sqrt(s2)
        norm = sqrt(s2 + fy * fy)
        self._along = 1.0 / s
        self._ex = -fx * fy / (norm * s)
        self._ey = s / norm
        self._k1 = fy * fxx / (s2 * norm)
        self._k2 = fy * fxy / (s2 * norm)
        self.creep_x = q[C] * gx
        self.creep_y = q[C] * gy
        turn_creep = q[CT] * turn_creep_share
        self._turn_creep_x = turn_creep * gx
        self._turn_creep_y = turn_creep * gy

    def trust(self, angle_variance_rad2: float, rate_variance_rad2_s2: float, dt_s: float) -> None:
        """Set the noise of one wheel's travel in a frame of ``dt_s``, and of a gyroscope sample."""
        noise = angle_variance_rad2, rate_variance_rad2_s2, dt_s
        if noise == self._noise:
            return
        self._noise = noise
        radius_dt2 = (self._radius_m / dt_s) ** 2
        process, variance = self._jerk_density_m2_s5 * dt_s**3, 0.5 * radius_dt2 * angle_variance_rad2
        # Steady state of the scalar Kalman filter.
        prior = 0.5 * (process + sqrt(process * (process + 4.0 * variance)))
        self._speed_gain = prior / (prior + variance)
        turning = 2.0 * radius_dt2 * angle_variance_rad2 / self._base_m**2
        self._gyro_share = turning / (turning + rate_variance_rad2_s2)

    def wheel_rates(self) -> tuple[float, float]:
        """Rates of the right and of the left wheel, rad/s."""
        side = 0.5 * self.omega_rad_s / self._per_base
        return (self.v_m_s + side) / self._right_m, (self.v_m_s - side) / self._left_m

    def stand(self) -> None:
        """Set all speeds to zero: the robot is at rest."""
        self.v_m_s = self.omega_rad_s = self._a = 0.0

    def advance(self, dt_s: float, right_rad: float, left_rad: float, rate_rad_s: float | None) -> None:
        """Advance by a frame of ``dt_s``: turns of the wheels, and the last gyroscope sample or None."""
        right, left = right_rad * self._right_m, left_rad * self._left_m
        d, turn = 0.5 * (right + left), (right - left) * self._per_base
        middle = self.heading_rad + 0.5 * turn
        cosine, sine = cos(middle), sin(middle)
        way, angle = d if d >= 0.0 else -d, turn if turn >= 0.0 else -turn
        dx = d * (cosine * self._along + sine * self._ex) + way * self.creep_x + angle * self._turn_creep_x
        dy = d * sine * self._ey + way * self.creep_y + angle * self._turn_creep_y
        self.x_m += dx
        self.y_m += dy
        self.heading_rad += turn - self._k1 * dx - self._k2 * dy
        speed = self.v_m_s + self._a * dt_s
        self.v_m_s = speed + self._speed_gain * (d / dt_s - speed) if dt_s else speed
        rate = turn / dt_s if dt_s else self.omega_rad_s
        if rate_rad_s is not None:
            rate += self._gyro_share * ((rate_rad_s - self._bias) * self._per_scale - rate)
        self.omega_rad_s = rate
