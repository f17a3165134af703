"""The localizer of thesis chapter 2: a filter of four states (eqs 2.4 to 2.12), and the integrated position."""

from collections.abc import Sequence
from functools import lru_cache
from math import hypot, inf, sqrt

import numpy as np

from ccatp.config.models import Config, LocalizerConfig, RobotConfig
from ccatp.core import DeckPose, Fix, FloatArray, PanelId, PanelPose, Twist
from ccatp.estimation.localizer_base import (
    MAX_FRAME_STEP_S,
    Edges,
    FilterWrap,
    Gravity,
    ImuReadings,
    LocalizerBase,
    SensorTransition,
    WheelReadings,
    unwrapped,
)
from ccatp.estimation.odometry import Odometer, arc_step
from ccatp.estimation.seams import CrossingDetector, HeadingFix, HeadingGate
from ccatp.estimation.wheel_coast import WheelInput
from ccatp.filters.base import FilterDiverged, Innovation
from ccatp.kinematics import difference, rotate, wheel_rates, wrap_pi
from ccatp.mirror.mirror import Mirror
from ccatp.rest import WHEEL_STANDS_RAD_S

V, A, THETA, OMEGA = range(4)
"""Order of the state q of thesis eq. 2.1: speed m/s, acceleration m/s^2, heading rad, rate rad/s.

The thesis prints m^2/s as the unit of the acceleration; m/s^2 is meant.
"""
STATES = 4
Stack = tuple[FloatArray, FloatArray, FloatArray]
"""z = H q + noise with independent rows: z (m,), H (m, 4), variances R (m,)."""


class MeasurementBuilder:
    """Builds z, H, R of a frame; rows: right wheel, left wheel, acceleration, rate, each with the oldest first.

    The full model (thesis eq. 2.12) is::

        a_x     = a
        omega_R = (v + omega L / 2) / r
        omega_L = (v - omega L / 2) / r
        omega_z = omega

    Eq. 2.3 and 2.4 print theta_z with a row that picks theta; a gyroscope measures a rate, so omega_z of 2.12 holds.

    A sample at t_i belongs to the state q(t_i), not to q(t) at the frame's time t. Within a frame acceleration and rate
    are assumed constant, so q(t_i) = F(t_i - t) q(t) with F of eq. 2.11, and a row h becomes h F(t_i - t). This is an
    approximation: all process noise of the interval enters at its beginning. ``cfg`` has standard deviations of single
    samples (thesis eq. 2.17 calls sigma a variance; its table 2.1 lists standard deviations).
    """

    def __init__(self, robot: RobotConfig, cfg: LocalizerConfig) -> None:
        self._per_radius = 1.0 / robot.wheel_radius_m
        self._turn = 0.5 * robot.wheel_base_m / robot.wheel_radius_m
        self._var_ax = cfg.accelerometer_sigma_m_s2**2
        self._var_wz = cfg.gyroscope_sigma_rad_s**2
        self._bias_wz = cfg.gyroscope_bias_rad_s
        self._var_wheel = cfg.encoder_sigma_rad_s**2
        self._of_size = lru_cache(maxsize=256)(self._build)

    def stack(self, t_s: float, imu: ImuReadings, right: WheelReadings, left: WheelReadings) -> Stack:
        """z, H, R of a frame with any number of samples. The arrays are work space, valid until the next call."""
        wheels, n = len(right[0]) + len(left[0]), len(imu)
        stack = z, H, _ = self._of_size(len(right[0]), len(left[0]), n)
        for i, (t, rate) in enumerate(zip((*right[0], *left[0]), (*right[1], *left[1]), strict=True)):
            H[i, A] = (t - t_s) * self._per_radius
            z[i] = rate
        for i, (_, ax, wz) in enumerate(imu, wheels):
            z[i] = ax
            z[i + n] = wz - self._bias_wz
        return stack

    def _build(self, right: int, left: int, imu: int) -> Stack:
        wheels = right + left
        H, R = np.zeros((wheels + 2 * imu, STATES)), np.empty(wheels + 2 * imu)
        H[:wheels, V] = self._per_radius
        H[:right, OMEGA] = self._turn
        H[right:wheels, OMEGA] = -self._turn
        H[wheels : wheels + imu, A] = 1.0
        H[wheels + imu :, OMEGA] = 1.0
        R[:wheels], R[wheels : wheels + imu], R[wheels + imu :] = self._var_wheel, self._var_ax, self._var_wz
        return np.zeros(R.size), H, R


class ConstantAcceleration:
    """The process model: F of thesis eq. 2.11 and its noise, white jerk and white angular acceleration.

    The noise of an interval enters as one impulse at its beginning, so that within the interval acceleration and rate
    are constant, as ``MeasurementBuilder`` takes them: an impulse of variance q dt in the rate of change, carried by F
    to the end, gives q dt [[dt^2, dt], [dt, 1]] for (v, a) and for (theta, omega). The heading then moves by omega dt
    with the rate measured *during* the interval, the midpoint rule. Noise spread over the interval
    (q [[dt^3/3, dt^2/2], [dt^2/2, dt]]) would contradict those rows: the heading would lag by half a frame in a turn,
    and its variance would grow by q dt^3/12 per frame however well the rate is measured. The thesis gives no Q; the
    densities are in (m/s^3)^2 s and (rad/s^2)^2 s.
    """

    def __init__(self, cfg: LocalizerConfig) -> None:
        four = cfg.four_state
        self._jerk = four.jerk_density_m2_s5
        self._alpha = four.angular_acceleration_density_rad2_s3
        self._F = np.eye(STATES)
        self._Q = np.zeros((STATES, STATES))

    def over(self, dt_s: float) -> tuple[FloatArray, FloatArray]:
        """F and Q (4, 4) over dt_s; work space, valid until the next call."""
        F, Q = self._F, self._Q
        F[V, A] = F[THETA, OMEGA] = dt_s
        for i, density in ((V, self._jerk), (THETA, self._alpha)):
            impulse = density * dt_s
            Q[i + 1, i + 1] = impulse
            Q[i, i + 1] = Q[i + 1, i] = impulse * dt_s
            Q[i, i] = impulse * dt_s * dt_s
        return F, Q


_LOST = 1.5  # number of pauses between two frames with samples beyond which samples are missing
_NEAR_BORDER = 0.95  # part of a panel's half size beyond which the cell under the robot is looked up
_SELECT_HEADING = np.eye(STATES)[THETA : THETA + 1]


class PositionSigma:
    """Standard deviation of the position in any one direction.

    Slip and heading error are constant from one fix to the next, so their contributions grow with the travel s, not
    with its square root: sigma^2 = fix^2 + (slip_fraction s)^2 + (integral of sigma_theta ds)^2.
    """

    def __init__(self, sigma_m: float, slip_fraction: float) -> None:
        self._slip_fraction = slip_fraction
        self._known_m2 = sigma_m**2
        self._along_m = self._across_m = 0.0

    @property
    def sigma_m(self) -> float:
        """The standard deviation, m."""
        return sqrt(self._known_m2 + self._along_m**2 + self._across_m**2)

    def travel(self, distance_m: float, heading_sigma_rad: float) -> None:
        """Add a travel of ``distance_m`` >= 0, with standard deviation ``heading_sigma_rad`` of the heading."""
        self._along_m += self._slip_fraction * distance_m
        self._across_m += heading_sigma_rad * distance_m

    def growth_m2(self, distance_m: float, heading_sigma_rad: float) -> float:
        """Variance that a displacement of ``distance_m`` adds, m^2."""
        return distance_m**2 * (self._slip_fraction**2 + heading_sigma_rad**2)

    def widen(self, sigma_m: float) -> None:
        """Add an independent error of ``sigma_m``."""
        self._known_m2 += sigma_m**2

    def fuse(self, variance_m2: float) -> float:
        """Fuse a measured position of ``variance_m2`` > 0; returns its weight, 0 to 1."""
        prior = self._known_m2 + self._along_m**2 + self._across_m**2
        gain = prior / (prior + variance_m2)
        self._known_m2 = gain * variance_m2
        self._along_m = self._across_m = 0.0
        return gain


class FourStateLocalizer(LocalizerBase):
    """Estimates the pose (x, y, theta)_p (thesis 2.1, fig. 2.5).

    In each frame the filter predicts over the time since the last frame, and is updated with every usable sample at its
    own time (``MeasurementBuilder``). Speed and heading move the position (eq. 2.14). A seam crossed by a pair of edge
    sensors updates the heading. When the robot's origin enters another cell, the pose continues in the frame of that
    panel. Departure: the thesis overwrites the heading at a crossing; here it is a measurement of theta with the
    variance of its timing, so that state and covariance stay consistent.
    """

    def __init__(self, config: Config, mirror: Mirror, start: PanelPose, wrap: FilterWrap = unwrapped) -> None:
        super().__init__(config, mirror, STATES, wrap)
        self.innovation: Innovation | None = None
        self._cfg = cfg = config.localizer
        self._process = ConstantAcceleration(cfg)
        self._builder = MeasurementBuilder(config.robot, cfg)
        self._odometer = Odometer(cfg.history_s)
        self._crossings = CrossingDetector(mirror, config.robot, cfg.four_state)
        self._gate = HeadingGate(cfg.four_state.crossing_gate_sigma)
        self._sigma = PositionSigma(cfg.start_position_sigma_m, cfg.four_state.slip_fraction)
        self._deck: DeckPose | None = None
        self._radius_m = config.robot.wheel_radius_m
        self._base_m = config.robot.wheel_base_m
        self._wheels_s = -inf  # last frame with samples of both wheels
        self._pause_s = inf  # shortest time between two such frames
        self._x_m = start.x_m
        self._y_m = start.y_m
        self._enter(start.panel)
        self._reset_at_rest(start.heading_rad, cfg.start_heading_sigma_rad**2)

    @property
    def pose(self) -> PanelPose:
        """Estimated pose in the frame of the panel under the robot."""
        return PanelPose(self._panel, self._x_m, self._y_m, wrap_pi(float(self._filter.mean[THETA])))

    @property
    def deck_pose(self) -> DeckPose:
        """Estimated pose, deck frame."""
        if self._deck is None:
            self._deck = self._mirror.deck_pose(self.pose)
        return self._deck

    @property
    def speed_m_s(self) -> float:
        """Estimated forward speed."""
        return float(self._filter.mean[V])

    @property
    def rate_rad_s(self) -> float:
        """Estimated angular rate."""
        return float(self._filter.mean[OMEGA])

    @property
    def position_sigma_m(self) -> float:
        """Standard deviation of the position along any direction."""
        return self._sigma.sigma_m

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance of (x, y, heading) along the surface, shape (3, 3); correlations are not known."""
        return np.diag((self.position_sigma_m**2, self.position_sigma_m**2, self.heading_sigma_rad**2))

    @property
    def creep(self) -> tuple[float, float]:
        """Drift per metre of travel; zero in this model."""
        return 0.0, 0.0

    def _use(
        self,
        dt_s: float,
        imu: ImuReadings,
        right: WheelReadings,
        left: WheelReadings,
        edges: Edges,
        gravity: Gravity,
        set_points: WheelInput,
    ) -> None:
        if self.is_frozen:
            return
        if right[0] and left[0]:
            self._follow(dt_s, set_points)
        elif dt_s > 0.0 and self.t_s - self._wheels_s > _LOST * self._pause_s:
            self._coast_on(dt_s, imu, set_points)
            return
        self._advance(dt_s, self._builder.stack(self.t_s, imu, right, left))
        transitions = self._crossings.scan(self.t_s, self.speed_m_s, self.rate_rad_s, edges)
        if transitions:
            self._use_crossings(transitions)

    def _wheel_rates(self) -> tuple[float, float]:
        return wheel_rates(Twist(self.speed_m_s, self.rate_rad_s), self._radius_m, self._base_m)

    def _follow(self, dt_s: float, set_points: WheelInput) -> None:
        """Take what the wheels turned in a frame with samples of both."""
        coast, means = self._coast, self._wheel_means
        if coast.gap_s:
            coast.end()
        if self._wheels_s > -inf:
            self._pause_s = min(self._pause_s, max(self.t_s - self._wheels_s, dt_s))
        self._wheels_s = self.t_s
        coast.follow(dt_s, set_points, dt_s * (means.right_rad_s or 0.0), dt_s * (means.left_rad_s or 0.0))
        coast.learn(dt_s, *self._wheel_rates())

    def _coast_on(self, dt_s: float, imu: ImuReadings, set_points: WheelInput) -> None:
        """Take a frame in a gap of the encoders: the predicted turns are a measurement of both rates."""
        coast = self._coast
        if not coast.gap_s:
            rates = self._wheel_rates()
            is_resting = max(map(abs, rates)) < WHEEL_STANDS_RAD_S
            coast.begin(*rates, (self._cfg.encoder_sigma_rad_s * self._pause_s) ** 2, is_resting=is_resting)
        self.coasted = now = coast.advance(dt_s, set_points)
        self.gap_s += dt_s
        times = (self.t_s,)
        z, H, R = self._builder.stack(self.t_s, imu, (times, (now.right_rad / dt_s,)), (times, (now.left_rad / dt_s,)))
        R = R.copy()
        R[0] += now.right_rad2 / dt_s**2
        R[1] += now.left_rad2 / dt_s**2
        self._advance(dt_s, (z, H, R))
        along_rad2 = now.right_rad2 + now.left_rad2 + 2.0 * now.both_rad2
        self._sigma.widen(0.5 * self._radius_m * sqrt(max(along_rad2, 0.0)))

    def reset_filter(self, mu: FloatArray, sigma: FloatArray) -> None:
        """Re-initialise the state (v, a, theta, omega), theta in the panel frame; thesis: ``resetFilter(mu, Sigma)``.

        Raises ``FilterError``: not a Gaussian of four states.
        """
        self._filter.reset(mu, sigma)
        if self.is_frozen:
            self._crossings.restart()
        self.is_frozen = False
        self._deck = None

    def rest(self) -> None:
        """The robot stands: v, a and omega are zero with the configured sigmas, the heading keeps its variance.

        Their rows and columns of the covariance are reset, too. The thesis resets only the diagonal, which leaves wrong
        correlations. Call it at standstill; while the wheels run down it makes the filter overconfident.
        """
        self._coast.stand()
        if not self.is_frozen:
            mean, covariance = self._filter.mean, self._filter.covariance
            self._reset_at_rest(float(mean[THETA]), float(covariance[THETA, THETA]))

    def fuse_fix(self, fix: Fix) -> float:
        """Fuse a position of the puck (thesis 2.1.3) at the time of its measurement; returns the jump of the pose, m.

        Position and fix are weighted by their variances. Raises ``FixRefused``: not finite, too old, from the future,
        or far from the mirror; the pose is unchanged.
        """
        foot = self._foot_of(fix, self._odometer.oldest_s)
        place = self._mirror.panel_pose(self._panel, DeckPose(foot.x_m, foot.y_m, 0.0))  # the heading plays no part
        # Only the covariance along the surface is used: half of its trace without the part along the normal.
        normal = np.array(self._mirror.rotate_world_from_deck(self._mirror.surface.normal(foot.x_m, foot.y_m)))
        covariance = np.array(fix.covariance_m2).reshape(3, 3)
        variance = 0.5 * float(np.trace(covariance) - normal @ covariance @ normal)
        then, here = self._odometer.at(fix.t_s), self._odometer.place
        # The odometer's frame is rotated relative to the panel's by the difference of the headings.
        turned = float(self._filter.mean[THETA]) - here.heading_rad
        dx, dy = rotate(here.x_m - then.x_m, here.y_m - then.y_m, turned)
        ex, ey = place.x_m + dx - self._x_m, place.y_m + dy - self._y_m
        variance += self._sigma.growth_m2(hypot(dx, dy), self.heading_sigma_rad)
        if self.is_frozen:
            # The cause of the divergence may have changed the heading as well.
            prior = float(self._filter.covariance[THETA, THETA]) + self._cfg.start_heading_sigma_rad**2
            self._reset_at_rest(float(self._filter.mean[THETA]), prior)
            self._sigma.widen(self._cfg.start_position_sigma_m)
        gain = self._sigma.fuse(variance)
        self._x_m = self._x_m + gain * ex
        self._y_m = self._y_m + gain * ey
        self._deck = None
        self.counts["fixes"] += 1
        self.gap_s = self._coast.gap_s
        self._hand_over()
        return gain * hypot(ex, ey)

    def _advance(self, dt_s: float, stack: Stack) -> None:
        before = self._filter.mean, self._filter.covariance
        self._filter.predict(*self._process.over(dt_s))
        innovation = self._filter.update(*stack)
        if innovation.size:
            self.innovation = innovation
        v0, _, theta0, _ = before[0].tolist()
        v1, _, theta1, omega1 = self._filter.mean.tolist()
        try:
            self._check_speeds(v1, omega1)
        except FilterDiverged:
            self._filter.reset(*before)
            raise
        v, turn = 0.5 * (v0 + v1), theta1 - theta0
        dx, dy = arc_step(v, theta0, turn, dt_s)
        self._x_m = self._x_m + dx
        self._y_m = self._y_m + dy
        self._deck = None
        self._odometer.advance(self.t_s, v, turn, dt_s)
        self._sigma.travel(abs(v) * dt_s, self.heading_sigma_rad)
        if abs(self._x_m) > self._near_x_m or abs(self._y_m) > self._near_y_m:
            self._hand_over()

    def _hand_over(self) -> None:
        """Continue in the frame of the panel whose cell contains the robot's origin; the deck pose does not change."""
        deck = self.deck_pose
        panel = self._mirror.panel_at(deck.x_m, deck.y_m)
        if panel is None or panel == self._panel:
            return
        new = self._mirror.panel_pose(panel, deck)
        self._x_m = new.x_m
        self._y_m = new.y_m
        mean = self._filter.mean.copy()
        mean[THETA] += difference(new.heading_rad, float(mean[THETA]))
        self._filter.reset(mean, self._filter.covariance)
        self._enter(panel)

    def _enter(self, panel: PanelId) -> None:
        self._panel = panel
        found = self._mirror.panel(panel)
        self._near_x_m = _NEAR_BORDER * found.half_x_m
        self._near_y_m = _NEAR_BORDER * found.half_y_m

    def _use_crossings(self, transitions: Sequence[SensorTransition]) -> None:
        filter_ = self._filter
        theta = float(filter_.mean[THETA])
        seen = self._crossings.headings(transitions, self._odometer, self.pose, self.deck_pose, self.speed_m_s)
        for innovation, variance in seen:
            heading = theta + innovation
            left_over = HeadingFix(heading - float(filter_.mean[THETA]), variance)
            extra = self._gate.extra_variance(left_over, float(filter_.covariance[THETA, THETA]))
            self.counts["crossings_gated" if extra is None else "crossings_used"] += 1
            if extra is None:
                continue
            if extra:
                covariance = filter_.covariance.copy()
                covariance[THETA, THETA] += extra
                filter_.reset(filter_.mean, covariance)
            filter_.update(np.array([heading]), _SELECT_HEADING, np.array([variance]))
            self._deck = None

    def _reset_at_rest(self, heading_rad: float, variance_rad2: float) -> None:
        cfg = self._cfg
        speed, rate = cfg.reset_speed_sigma_m_s, cfg.reset_rate_sigma_rad_s
        variances = (speed**2, cfg.reset_acceleration_sigma_m_s2**2, variance_rad2, rate**2)
        self.reset_filter(np.array([0.0, 0.0, heading_rad, 0.0]), np.diag(variances))

    def inflate_covariance(self, way_m: float, turn_rad: float) -> None:
        """Inflate the covariance of the pose by these standard deviations, because its inputs may have been wrong."""
        if self.is_frozen:
            return
        self._sigma.widen(way_m)
        wider = np.zeros((STATES, STATES))
        wider[THETA, THETA] = turn_rad * turn_rad
        self._filter.predict(np.eye(STATES), wider)

    def _resync(self, t_s: float, last_s: float) -> None:
        self._odometer.start(t_s)
        if last_s == -inf:
            return
        self._crossings.restart()
        self._wheels_s = -inf
        self._sigma.widen(abs(self.speed_m_s) * MAX_FRAME_STEP_S)
        if not self.is_frozen:
            self._filter.predict(np.eye(STATES), self._process.over(MAX_FRAME_STEP_S)[1])
