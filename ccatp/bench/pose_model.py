"""A robot with twelve states, as a nonlinear model for filters that are to be compared."""

from math import cos, sin

import numpy as np

from ccatp.core import FloatArray

X, Y, THETA, V, A, OMEGA, GYRO_BIAS, ACCELEROMETER_BIAS, SCALE_R, SCALE_L, CREEP_X, CREEP_Y = range(12)
"""Order of the state: m, m, rad, m/s, m/s^2, rad/s, rad/s, m/s^2, three relative errors, drift per metre in x and y."""
STATES = 12


class PoseMotion:
    """x' = x + v (cos theta + c_x) dt, y' = y + v (sin theta + c_y) dt, theta' = theta + omega dt, v' = v + a dt.

    Args:
        dt_s: the step.
    """

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s

    def value(self, x: FloatArray) -> FloatArray:
        """f(x), shape (12,)."""
        moved = x.copy()
        step_m = x[V] * self._dt_s
        moved[X] += step_m * (cos(x[THETA]) + x[CREEP_X])
        moved[Y] += step_m * (sin(x[THETA]) + x[CREEP_Y])
        moved[THETA] += x[OMEGA] * self._dt_s
        moved[V] += x[A] * self._dt_s
        return moved

    def jacobian(self, x: FloatArray) -> FloatArray:
        """df/dx, shape (12, 12)."""
        dt, v = self._dt_s, x[V]
        c, s = cos(x[THETA]), sin(x[THETA])
        F = np.eye(STATES)
        F[X, THETA], F[X, V], F[X, CREEP_X] = -v * s * dt, (c + x[CREEP_X]) * dt, v * dt
        F[Y, THETA], F[Y, V], F[Y, CREEP_Y] = v * c * dt, (s + x[CREEP_Y]) * dt, v * dt
        F[THETA, OMEGA] = F[V, A] = dt
        return F

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Value and Jacobian; see ``Transition``."""
        return self.value(x), self.jacobian(x)

    def through(self, X_: FloatArray) -> FloatArray:
        """Apply f to each row, shape (k, 12)."""
        moved = X_.copy()
        step_m = X_[:, V] * self._dt_s
        moved[:, X] += step_m * (np.cos(X_[:, THETA]) + X_[:, CREEP_X])
        moved[:, Y] += step_m * (np.sin(X_[:, THETA]) + X_[:, CREEP_Y])
        moved[:, THETA] += X_[:, OMEGA] * self._dt_s
        moved[:, V] += X_[:, A] * self._dt_s
        return moved


class PoseSight:
    """Any of eight readings: gyroscope, accelerometer, right and left wheel (twice), a seam line, heading.

    omega + b_g;  a + b_a;  (v + omega L/2)(1 + s_R)/r;  (v - omega L/2)(1 + s_L)/r;  x cos beta + y sin beta;  theta

    Args:
        rows: which, by their place in ``sigmas``.
        wheel_radius_m, wheel_base_m: r and L.
        line_rad: beta, direction of the line's normal.
    """

    def __init__(self, rows: tuple[int, ...], wheel_radius_m: float, wheel_base_m: float, line_rad: float) -> None:
        self._rows = list(rows)
        self._per_radius, self._half_m = 1.0 / wheel_radius_m, 0.5 * wheel_base_m
        self._c, self._s = cos(line_rad), sin(line_rad)
        linear = np.zeros((8, STATES))
        linear[0, [OMEGA, GYRO_BIAS]] = linear[1, [A, ACCELEROMETER_BIAS]] = linear[7, THETA] = 1.0
        linear[6, [X, Y]] = self._c, self._s
        self._linear = linear

    def value(self, x: FloatArray) -> FloatArray:
        """h(x), shape (m,)."""
        seen: FloatArray = self.through(x[None, :])[0]
        return seen

    def jacobian(self, x: FloatArray) -> FloatArray:
        """dh/dx, shape (m, 12)."""
        H = self._linear.copy()
        for row, sign, scale in ((2, 1.0, SCALE_R), (3, -1.0, SCALE_L)):
            part = (1.0 + x[scale]) * self._per_radius
            H[row, V] = H[row + 2, V] = part
            H[row, OMEGA] = H[row + 2, OMEGA] = sign * self._half_m * part
            H[row, scale] = H[row + 2, scale] = (x[V] + sign * self._half_m * x[OMEGA]) * self._per_radius
        return H[self._rows]

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Value and Jacobian; see ``Observation``."""
        return self.value(x), self.jacobian(x)

    def through(self, X_: FloatArray) -> FloatArray:
        """Apply h to each row, shape (k, m)."""
        seen = X_ @ self._linear.T
        turn = self._half_m * X_[:, OMEGA]
        seen[:, 2] = seen[:, 4] = (X_[:, V] + turn) * (1.0 + X_[:, SCALE_R]) * self._per_radius
        seen[:, 3] = seen[:, 5] = (X_[:, V] - turn) * (1.0 + X_[:, SCALE_L]) * self._per_radius
        chosen: FloatArray = seen[:, self._rows]
        return chosen
