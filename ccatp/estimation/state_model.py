"""The full-state model: transition of pose, speeds and sensor errors, and the measurements.

The pose is in the deck frame, on the curved surface, so a change of the panel does not affect the state. The wheel
angles are states, because the counts of an encoder measure them with a bounded error. Its rate is much worse: a rate
from counts jumps by 0.5 rad/s per 10 ms.
"""

from collections.abc import Sequence
from math import cos, sin, sqrt

import numpy as np

from ccatp.core import FloatArray
from ccatp.estimation.odometry import Slope


class Affine:
    """x <- F x + b, F (n, n), b (n,), as a model for the nonlinear filters."""

    def __init__(self, F: FloatArray, b: FloatArray) -> None:
        self._F = F
        self._b = b

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Image of x (n,) and the Jacobian (n, n)."""
        return self._F.dot(x) + self._b, self._F

    def through(self, points: FloatArray) -> FloatArray:
        """Images of the rows (k, n)."""
        image: FloatArray = points.dot(self._F.T) + self._b
        return image


X, Y, PSI, V, A, W, BG, KG, BA, SR, SL, KL, C, PR, PL, E0, E1, TX, TY, CT = range(20)
"""Order of the state.

X, Y: robot origin, deck frame, m. PSI: deck heading, rad, not wrapped. V: speed that the wheels give the body over the
last step, m/s. A: its rate of change, m/s^2. W: rate about the normal over the last step, rad/s. BG: gyroscope bias,
rad/s. KG: gyroscope scale error. BA: accelerometer bias, m/s^2. SR, SL: slip of the right and of the left wheel, the
part of its travel that the body does not follow (with the error of the radius). KL: relative error of the wheel base.
C, CT: downhill creep, part of |V|, and of |W|, m/rad, mean over all headings. PR, PL: angle of the right and of the
left wheel since the last rest, rad. E0, E1: displacement from the map of the two edges of the seam crossed last, m. TX,
TY: displacement of the puck by the tilt of the panel under the robot, deck frame, m.
"""
STATES = 20
POSITION, POSE, SPEEDS = slice(X, Y + 1), slice(X, PSI + 1), slice(V, W + 1)
ANGLES, EDGES, TILT = slice(PR, PL + 1), slice(E0, E1 + 1), slice(TX, TY + 1)
SLIPS, CALIBRATION = [SR, SL, C, CT], [BG, KG, BA, SR, SL, KL, C, CT]  # not adjacent
_NOISY = np.array([A, W, SR, SL, C, CT])  # states whose noise enters at the beginning of a step


class SurveyMotion:
    """Transition of the state over one step: thesis eqs 2.11 and 2.14, with the errors as states.

    ::

        v' = v + a dt,   d = v' dt,   turn = w dt
        (x, y)' = (x, y) + d h(psi + turn/2) + (c |d| + share ct |turn|) g
        psi' = psi + turn - fy (fxx dx + fxy dy) / ((1 + fx^2) W)
        phi_R' = phi_R + (d + turn (1 + kl) L/2) / (r (1 - s_R)),   phi_L' likewise with -L/2

    h and g are the deck components of the heading and of the downhill direction in the tangent plane; share is the
    creep of a turn at this heading over its mean. The noise of a step is an impulse at its beginning (see
    ``ConstantAcceleration``), so v', a and w are constant in the step.
    """

    def __init__(self, wheel_radius_m: float, wheel_base_m: float) -> None:
        self._radius_m = wheel_radius_m
        self._half_base_m = 0.5 * wheel_base_m
        self._x = np.zeros(STATES)
        self._F = np.eye(STATES)

    def over(self, dt_s: float, slope: Slope, creep_share: float = 1.0) -> "SurveyMotion":
        """Set the duration of the step, the slope of the ground, and ``share``."""
        self._dt_s = dt_s
        self._slope = slope
        self._share = creep_share
        self._of: FloatArray | None = None
        return self

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The state after the step (n,) and the Jacobian (n, n); work space, valid until the next call."""
        if x is self._of:  # computed already, for the noise
            return self._x, self._F
        self._of = x
        q: list[float] = x.tolist()
        psi, c, ct = q[PSI], q[C], q[CT]
        dt, (fx, fy, fxx, fxy, _, gx, gy) = self._dt_s, self._slope
        v = q[V] + q[A] * dt
        d, turn, share = v * dt, q[W] * dt, self._share
        s2 = 1.0 + fx * fx
        s, norm = sqrt(s2), sqrt(s2 + fy * fy)
        ex, ey = -fx * fy / (norm * s), s / norm
        middle = psi + 0.5 * turn
        cosine, sine = cos(middle), sin(middle)
        hx, hy, lx, ly = cosine / s + sine * ex, sine * ey, cosine * ex - sine / s, cosine * ey
        way, angle = abs(d), share * abs(turn)
        down = c * way + ct * angle
        dx, dy = d * hx + down * gx, d * hy + down * gy
        k1, k2 = fy * fxx / (s2 * norm), fy * fxy / (s2 * norm)
        grip_r, grip_l = 1.0 - q[SR], 1.0 - q[SL]  # parts of a wheel's travel that the body follows
        per_r, per_l = 1.0 / (self._radius_m * grip_r), 1.0 / (self._radius_m * grip_l)
        half = self._half_base_m
        side = turn * (1.0 + q[KL]) * half
        right, left = d + side, d - side
        after = self._x
        after[:] = x
        after[X], after[Y] = q[X] + dx, q[Y] + dy
        after[PSI] = psi + turn - k1 * dx - k2 * dy
        after[V] = v
        after[PR], after[PL] = q[PR] + right * per_r, q[PL] + left * per_l
        sign, turn_down = c if d >= 0.0 else -c, dt * share * (ct if turn >= 0.0 else -ct)
        xv, yv = dt * (hx + sign * gx), dt * (hy + sign * gy)
        x_psi, y_psi, x_c, y_c, x_ct, y_ct = d * lx, d * ly, way * gx, way * gy, angle * gx, angle * gy
        xw, yw = 0.5 * dt * x_psi + turn_down * gx, 0.5 * dt * y_psi + turn_down * gy
        psi_v, turn_dt = -k1 * xv - k2 * yv, dt * (1.0 + q[KL]) * half
        F = self._F  # its other entries are those of the identity
        F[X, PSI], F[X, V], F[X, A], F[X, W], F[X, C], F[X, CT] = x_psi, xv, dt * xv, xw, x_c, x_ct
        F[Y, PSI], F[Y, V], F[Y, A], F[Y, W], F[Y, C], F[Y, CT] = y_psi, yv, dt * yv, yw, y_c, y_ct
        F[PSI, PSI] = 1.0 - k1 * x_psi - k2 * y_psi
        F[PSI, V], F[PSI, A], F[PSI, W] = psi_v, dt * psi_v, dt - k1 * xw - k2 * yw
        F[PSI, C], F[PSI, CT] = -k1 * x_c - k2 * y_c, -k1 * x_ct - k2 * y_ct
        F[V, A] = dt
        F[PR, V], F[PR, A], F[PR, W] = dt * per_r, dt * dt * per_r, turn_dt * per_r
        F[PL, V], F[PL, A], F[PL, W] = dt * per_l, dt * dt * per_l, -turn_dt * per_l
        F[PR, SR], F[PR, KL] = right * per_r / grip_r, turn * half * per_r
        F[PL, SL], F[PL, KL] = left * per_l / grip_l, -turn * half * per_l
        return after, F

    def through(self, points: FloatArray) -> FloatArray:
        """The states (k, n) after the step, row by row."""
        dt, (fx, fy, fxx, fxy, _, gx, gy) = self._dt_s, self._slope
        q = points.T
        v = q[V] + q[A] * dt
        d, turn = v * dt, q[W] * dt
        s2 = 1.0 + fx * fx
        s, norm = sqrt(s2), sqrt(s2 + fy * fy)
        middle = q[PSI] + 0.5 * turn
        cosine, sine = np.cos(middle), np.sin(middle)
        way = q[C] * np.abs(d) + self._share * q[CT] * np.abs(turn)
        dx = d * (cosine / s - sine * (fx * fy / (norm * s))) + way * gx
        dy = d * (sine * (s / norm)) + way * gy
        side = turn * (1.0 + q[KL]) * self._half_base_m
        after = points.copy()
        after[:, X], after[:, Y] = q[X] + dx, q[Y] + dy
        after[:, PSI] = q[PSI] + turn - fy * (fxx * dx + fxy * dy) / (s2 * norm)
        after[:, V] = v
        after[:, PR] = q[PR] + (d + side) / (self._radius_m * (1.0 - q[SR]))
        after[:, PL] = q[PL] + (d - side) / (self._radius_m * (1.0 - q[SL]))
        return after

    def noise(self, x: FloatArray, impulses: FloatArray, drift: FloatArray) -> FloatArray:
        """Covariance (n, n) of a step's noise from the state x (n,) before it.

        ``impulses`` (6,): variances of the impulses on A, W, SR, SL, C, CT at its beginning; ``drift`` (n,): those
        at its end.
        """
        G = self.at(x)[1].take(_NOISY, axis=1)
        G *= np.sqrt(impulses)
        Q: FloatArray = G.dot(G.T)
        Q.reshape(-1)[:: STATES + 1] += drift
        return Q


_SENSORS = np.eye(STATES)  # Jacobian of a reading of each state; `SensorRows.at` adds the gyroscope's scale error
_SENSORS[W, BG] = _SENSORS[A, BA] = 1.0


class SensorRows:
    """Measurements of a frame: wheel angles, angular rate, acceleration; each may be missing.

    ::

        counts_R = phi_R,   counts_L = phi_L,   omega_z = (1 + kg) w + bg,   a_x = a + ba

    A reading is (index of its state, value, variance); that of W comes first, that of A last. ``z`` and ``R``
    (variances) have shape (m,).
    """

    def __init__(self, readings: Sequence[tuple[int, float, float]]) -> None:
        states, z, R = zip(*readings, strict=True)
        self._rows = states
        self.z = np.array(z)
        self.R = np.array(R)

    def at(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Expected measurements (m,) and the Jacobian (m, n)."""
        rows = self._rows
        H: FloatArray = _SENSORS.take(rows, axis=0)
        h: FloatArray = x.take(rows)
        if rows[0] == W:
            w = float(x[W])
            scale = 1.0 + float(x[KG])
            H[0, W], H[0, KG] = scale, w
            h[0] = scale * w + float(x[BG])
        if rows[-1] == A:
            h[-1] += x[BA]
        return h, H

    def through(self, points: FloatArray) -> FloatArray:
        """Expected measurements (k, m) of the states (k, n)."""
        rows = self._rows
        h: FloatArray = points[:, list(rows)]
        if rows[0] == W:
            h[:, 0] = (1.0 + points[:, KG]) * points[:, W] + points[:, BG]
        if rows[-1] == A:
            h[:, -1] += points[:, BA]
        return h
