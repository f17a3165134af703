"""Pure. The full-state localizer: pose, speeds and the sensors' own errors in one filter, on the curved surface."""

from collections import Counter
from collections.abc import Callable, Sequence
from math import atan2, cos, isfinite, sin, sqrt

import numpy as np

from ccatp.angles import difference, wrap_pi
from ccatp.config.models import LocalizerConfig, RobotConfig
from ccatp.filters.base import Filter, FilterDiverged, FloatArray, Innovation
from ccatp.localization.crossing import Transition
from ccatp.localization.fixes import FixGated, check_fix, deck_foot
from ccatp.localization.intake import BACKWARD_LIMIT, MAX_FRAME_STEP_S, FrameClock, FrameKind, SampleIntake
from ccatp.localization.journal import Journal
from ccatp.localization.legs import LegBook, Redraw
from ccatp.localization.measurements import WheelReading
from ccatp.localization.noise_floor import NoiseFloor
from ccatp.localization.rest import RestWatch, heading_from_gravity
from ccatp.localization.seam_lines import Edge, SeamLines
from ccatp.localization.survey_model import (
    BA,
    BG,
    E0,
    KG,
    KL,
    PL,
    PR,
    PSI,
    SL,
    SR,
    STATES,
    A,
    C,
    SensorRows,
    SurveyMotion,
    V,
    W,
    X,
    Y,
)
from ccatp.localization.terrain import Terrain
from ccatp.localization.wheel_angles import WheelAngle
from ccatp.mirror.mirror import Mirror
from ccatp.samples import DeckPose, EdgeSample, Fix, GravitySample, ImuSample, PanelId, PanelPose, WheelSample

_NEAR_BORDER = 0.95  # part of a panel's half size beyond which the cell under the robot is looked up
_IMPOSSIBLE = 2.0  # an estimate of this many times the wheels' largest rate is no estimate
_CHUNK = 100  # samples at rest after which their mean is used, however long the rest
_CONSISTENT = 3  # this many refused fixes that agree with each other are right, and the pose is wrong
_POSITION_ROWS = np.eye(STATES)[[X, Y]]
_STOP_ROWS = np.eye(STATES)[[V, A, W]]
_DRAWN = [SR, SL, C]

Step = Callable[[], None]


class FullStateLocalizer:
    """Estimates pose, speeds, sensor errors, slip and creep with one filter (``survey_model``), deck frame.

    Each frame: predict, then update with wheel angles, angular rate and acceleration. A transition of an edge sensor
    is a line at a panel's edge, a fix of the puck a position: both correct the whole state through its covariance, so
    two fixes in a row give the heading. At true rest the speeds are zero and the inertial unit shows its biases. When
    the robot drives off, slip and creep are drawn from what the legs so far showed (``LegBook``).

    Args:
        filter_: an extended or unscented filter of ``STATES`` states; re-initialised here.
        mirror: the mirror's geometry.
        robot: wheel and sensor geometry.
        cfg: noise model.
        start: pose at the first frame, at rest.

    Attributes:
        counts: what was refused or used, by name.
        innovation: of the last fix, or None.
        hold_cause: why the mission should hold, or empty; stays until ``clear_hold``.
        is_frozen: the filter has diverged; the pose stands still until the next fix.
        fix_deviation_m: how far the last fix was above the ideal surface.
        notices: what an operator should read; whoever reads them empties the list.
    """

    def __init__(
        self, filter_: Filter, mirror: Mirror, robot: RobotConfig, cfg: LocalizerConfig, start: PanelPose
    ) -> None:
        self.counts: dict[str, int] = Counter()
        self.innovation: Innovation | None = None
        self.hold_cause = ""
        self.fix_deviation_m = 0.0
        self.is_frozen = False
        self.notices: list[str] = []
        self._filter, self._mirror, self._cfg, self._full = filter_, mirror, cfg, cfg.full_state
        self._puck_height_m = robot.puck_height_m
        self._v_limit_m_s = _IMPOSSIBLE * robot.wheel_radius_m * robot.max_wheel_rad_s
        self._omega_limit_rad_s = 2.0 * self._v_limit_m_s / robot.wheel_base_m
        self._motion = SurveyMotion(robot.wheel_radius_m, robot.wheel_base_m)
        self._rows = SensorRows()
        self._terrain = Terrain(mirror)
        self._clock = FrameClock()
        self._intake = SampleIntake(cfg.history_s, self.counts)
        self._right, self._left = WheelAngle(), WheelAngle()
        self._gyro = NoiseFloor(cfg.gyroscope_sigma_rad_s**2)
        self._accelerometer = NoiseFloor(cfg.accelerometer_sigma_m_s2**2)
        self._rest = RestWatch(self._full.rest_after_s, self._gyro, self._accelerometer)
        self._seams = SeamLines(mirror, robot)
        self._legs = LegBook(self._full)
        self._journal = Journal(self._full.rewind_s)
        self._refused: list[FloatArray] = []
        self._gravity_deck = mirror.rotate_deck_from_world((0.0, 0.0, 1.0))
        self._last_imu: tuple[float, float] | None = None
        self._rested_s = 0.0
        self._panel: PanelId = start.panel
        self._enter(start.panel)
        self._start(mirror.deck_pose(start))

    def _start(self, pose: DeckPose) -> None:
        cfg, full = self._cfg, self._full
        mean = np.zeros(STATES)
        mean[[X, Y, PSI]] = pose.x_m, pose.y_m, pose.heading_rad
        sigma = np.zeros(STATES)
        sigma[[X, Y]] = cfg.start_position_sigma_m
        sigma[PSI] = cfg.start_heading_sigma_rad
        sigma[[V, A, W]] = cfg.reset_speed_sigma_m_s, cfg.reset_acceleration_sigma_m_s2, cfg.reset_rate_sigma_rad_s
        sigma[BG], sigma[KG] = full.gyroscope_bias_sigma_rad_s, full.gyroscope_scale_sigma
        sigma[BA], sigma[KL] = full.accelerometer_bias_sigma_m_s2, full.wheel_base_sigma
        sigma[[E0, E0 + 1]] = full.edge_sigma_m
        P = np.diag(sigma**2)
        mean[_DRAWN], P[np.ix_(_DRAWN, _DRAWN)] = self._legs.first()
        self._filter.reset(mean, P)

    # -- what it knows ------------------------------------------------------------------------------------------------

    @property
    def deck_pose(self) -> DeckPose:
        """Estimated pose, deck frame."""
        x, y, heading = self._filter.mean[:3].tolist()
        return DeckPose(x, y, wrap_pi(heading))

    @property
    def pose(self) -> PanelPose:
        """The same in the frame of the panel under the robot."""
        x, y, psi = self._filter.mean[:3].tolist()
        slope = self._terrain.at(x, y)
        ox, oy, oz = self._origin
        (ax, ay, az), (bx, by, bz) = self._panel_axes
        px, py, pz = x - ox, y - oy, self._terrain.height_m(x, y) - oz
        fx, fy = slope[0], slope[1]
        s2 = 1.0 + fx * fx
        s, norm = sqrt(s2), sqrt(s2 + fy * fy)
        c, d = cos(psi), sin(psi)
        hx, hy = c / s - d * fx * fy / (norm * s), d * s / norm
        hz = fx * hx + fy * hy
        heading = atan2(bx * hx + by * hy + bz * hz, ax * hx + ay * hy + az * hz)
        return PanelPose(self._panel, ax * px + ay * py + az * pz, bx * px + by * py + bz * pz, heading)

    @property
    def t_s(self) -> float:
        """Robot time to which the pose belongs: that of the last frame used; -inf before the first."""
        return self._clock.t_s

    @property
    def speed_m_s(self) -> float:
        """Estimated forward speed."""
        return float(self._filter.mean[V])

    @property
    def rate_rad_s(self) -> float:
        """Estimated angular rate."""
        return float(self._filter.mean[W])

    @property
    def position_sigma_m(self) -> float:
        """Standard deviation of the position along its worst direction."""
        (a, b), (_, d) = self._filter.covariance[:2, :2].tolist()
        return sqrt(max(0.5 * (a + d) + sqrt(0.25 * (a - d) ** 2 + b * b), 0.0))

    @property
    def heading_sigma_rad(self) -> float:
        """Standard deviation of the heading."""
        return sqrt(max(float(self._filter.covariance[PSI, PSI]), 0.0))

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance of (x, y, heading), deck frame, shape (3, 3)."""
        return self._filter.covariance[:3, :3]

    @property
    def creep(self) -> tuple[float, float]:
        """Estimated downhill drift per metre of travel, in the plane of ``pose``."""
        x, y = self._filter.mean[:2].tolist()
        fx, fy, _, _, _, gx, gy = self._terrain.at(x, y)
        gz = fx * gx + fy * gy
        (ax, ay, az), (bx, by, bz) = self._panel_axes
        c = float(self._filter.mean[C])
        return c * (ax * gx + ay * gy + az * gz), c * (bx * gx + by * gy + bz * gz)

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """Mean (n,) and covariance (n, n) of the whole state; see ``survey_model``."""
        return self._filter.mean, self._filter.covariance

    @property
    def is_resting(self) -> bool:
        """The wheels have stood long enough to be sure."""
        return self._rest.is_resting

    @property
    def hold_requested(self) -> bool:
        """Whether the mission should hold."""
        return bool(self.hold_cause)

    def clear_hold(self) -> None:
        """Forget the cause for a hold; one that persists comes back."""
        self.hold_cause = ""

    def rest(self) -> None:
        """The mission takes the robot to be at rest; the wheels themselves say here when it really is."""

    # -- frames -------------------------------------------------------------------------------------------------------

    def step(
        self,
        t_s: float,
        imu: Sequence[ImuSample],
        encoders: Sequence[WheelSample],
        edges: Sequence[EdgeSample],
        gravity: GravitySample | None = None,
    ) -> None:
        """Take one sensors frame.

        Any number of samples of each kind, each with its own time, oldest first. Unusable ones are dropped and counted;
        a frame that is not newer than the last one changes nothing.

        Args:
            t_s: the frame's time, robot clock, s; the pose belongs to it afterwards.
            imu: samples of the inertial unit since the last frame.
            encoders: samples of the wheel encoders since the last frame.
            edges: samples of the edge sensors since the last frame.
            gravity: direction of gravity in the robot frame, where it was read.
        """
        last_s, kind = self._clock.t_s, self._clock.admit(t_s)
        dt_s = t_s - last_s if kind is FrameKind.NEXT else 0.0
        if kind is FrameKind.RESYNC:
            self._resync(is_first=not isfinite(last_s))
        elif kind is not FrameKind.NEXT:
            self.counts[f"{kind.value}_frames"] += 1
            if self._clock.stale_run >= BACKWARD_LIMIT:
                self._ask_to_hold("time stamps of the frames run backward")
            return
        usable = self._intake.imu(t_s, imu) if imu else imu
        self._take_wheels(t_s, encoders)
        if self._intake.backward_source:
            self._ask_to_hold(f"time stamps of the {self._intake.backward_source} run backward")
            self._intake.backward_source = ""
        if self.is_frozen:
            return
        try:
            self._advance(t_s, dt_s, usable, edges, gravity)
        except FilterDiverged as error:
            self.is_frozen = True
            self.counts["diverged"] += 1
            self._ask_to_hold(f"filter: {error}")

    def _take_wheels(self, t_s: float, encoders: Sequence[WheelSample]) -> None:
        before = self._right.angle_rad, self._left.angle_rad
        right: Sequence[WheelReading]
        left: Sequence[WheelReading]
        if self._intake.are_clean(t_s, encoders):
            right = [(t, rate) for t, rate, _ in encoders]  # type: ignore[misc]  # clean: no None
            left = [(t, rate) for t, _, rate in encoders]  # type: ignore[misc]
        else:
            right, left = self._intake.wheels(t_s, encoders)
        self._right.add(right)
        self._left.add(left)
        self._has_counts = bool(right or left)
        self._turned_rad = max(abs(self._right.angle_rad - before[0]), abs(self._left.angle_rad - before[1]))
        self._readings = right, left

    def _advance(
        self,
        t_s: float,
        dt_s: float,
        imu: Sequence[ImuSample],
        edges: Sequence[EdgeSample],
        gravity: GravitySample | None,
    ) -> None:
        rest = self._rest
        is_still = self._turned_rad <= self._full.rest_rate_rad_s * max(dt_s, 1e-3)
        if rest.is_resting and is_still:
            for wheel, readings in zip((self._right, self._left), self._readings, strict=True):
                wheel.rest(readings)
                wheel.rebase()  # what adds up meanwhile is noise
            self._rested_s += dt_s
            self._last_imu = (imu[-1][1], imu[-1][2]) if imu else None
            rest.add(imu, gravity)
            if rest.count >= _CHUNK:
                self._journal.begin(t_s, self._filter)
                self._use_rest()
            if edges:
                self._seams.scan(edges)
            return
        self._journal.begin(t_s, self._filter)
        if rest.is_resting:
            self._use_rest()
            self._begin_leg()
        if not is_still:
            rest.moved()
        self._move(dt_s, imu)
        for transition in self._seams.scan(edges):
            self._cross(transition, t_s)
        if is_still and rest.stood(dt_s):
            self._come_to_rest()
        self._check()

    def _do(self, step: Step) -> None:
        """Do something to the filter, and keep it for the replay after a late fix."""
        self._journal.add(step)
        step()

    def _move(self, dt_s: float, imu: Sequence[ImuSample]) -> None:
        if dt_s > 0.0:
            scatter = self._legs.wander_variance(dt_s) if self._turned_rad else (0.0, 0.0)
            self._do(lambda: self._predict(dt_s, scatter))
        counts = None
        if self._has_counts:
            gap = self._right.gap_rad + self._left.gap_rad
            self._right.gap_rad = self._left.gap_rad = 0.0
            variance = max(self._right.variance_rad2(), self._left.variance_rad2()) + gap * gap
            counts = self._right.angle_rad, self._left.angle_rad, variance
        rate = acceleration = None
        if imu:
            _, ax, wz = imu[-1]
            if self._last_imu is not None:
                # V and W are means over a step. The mean rate is that of the samples at its ends; the difference of two
                # mean speeds is the acceleration at the instant between the two steps.
                before_ax, before_wz = self._last_imu
                rate = 0.5 * (before_wz + wz), self._gyro.variance
                # Set points jump, and the acceleration with them, anywhere between two samples.
                acceleration = before_ax, self._accelerometer.variance + self._full.acceleration_jump_m_s2**2
            self._last_imu = ax, wz
        else:
            self._last_imu = None
        self._do(lambda: self._sense(counts, rate, acceleration))

    def _predict(self, dt_s: float, scatter: tuple[float, float]) -> None:
        full, mean = self._full, self._filter.mean
        motion = self._motion.over(dt_s, self._terrain.at(float(mean[X]), float(mean[Y])))
        slip, creep = scatter
        impulses = np.array(
            (full.jerk_density_m2_s5 * dt_s, full.angular_acceleration_density_rad2_s3 * dt_s, slip, slip, creep)
        )
        drift = np.zeros(STATES)
        drift[BG] = full.gyroscope_bias_walk_rad_s_sqrt_s**2 * dt_s
        drift[BA] = full.accelerometer_bias_walk_m_s2_sqrt_s**2 * dt_s
        drift[PR] = drift[PL] = self._encoder_walk(dt_s)
        self._filter.predict(motion, motion.noise(mean, impulses, drift))

    def _encoder_walk(self, dt_s: float) -> float:
        """Growth of the summed angle's error: white rate noise, none where a counter counts."""
        found = self._right.noise_rad2_s2
        variance = self._cfg.encoder_sigma_rad_s**2 if found is None else found
        return variance * self._full.encoder_period_s * dt_s

    def _sense(
        self,
        counts: tuple[float, float, float] | None,
        rate: tuple[float, float] | None,
        acceleration: tuple[float, float] | None,
    ) -> None:
        rows = self._rows.take(counts, rate, acceleration)
        if rows.z.size:
            self._filter.update(rows.z, rows, rows.R)

    def _check(self) -> None:
        _, _, _, v, _, w = self._filter.mean[:6].tolist()
        if abs(v) > self._v_limit_m_s or abs(w) > self._omega_limit_rad_s:
            raise FilterDiverged(f"{v:.3g} m/s and {w:.3g} rad/s are more than the wheels can do")
        self._hand_over()

    # -- rest and legs ------------------------------------------------------------------------------------------------

    def _come_to_rest(self) -> None:
        angles = self._right.angle_rad, self._left.angle_rad
        self._right.rebase()
        self._left.rebase()
        self._do(lambda: self._stop(angles))

    def _stop(self, angles: tuple[float, float]) -> None:
        """The wheels stand: no speed, no acceleration, no rate; their angles count from here."""
        full = self._full
        sigma = full.rest_speed_sigma_m_s, full.rest_acceleration_sigma_m_s2, full.rest_turn_sigma_rad_s
        self._filter.update(np.zeros(3), _STOP_ROWS, np.square(sigma))
        x = self._filter.mean.copy()
        x[PR] -= angles[0]
        x[PL] -= angles[1]
        self._filter.reset(x, self._filter.covariance)

    def _use_rest(self) -> None:
        """Biases from the inertial unit's means at rest, heading from gravity."""
        rested_s, self._rested_s = self._rested_s, 0.0
        reading = self._rest.take()
        if not reading.samples:
            return
        variances = self._gyro.variance / reading.samples, self._accelerometer.variance / reading.samples
        full = self._full
        walk = (
            full.gyroscope_bias_walk_rad_s_sqrt_s**2 * rested_s,
            full.accelerometer_bias_walk_m_s2_sqrt_s**2 * rested_s,
        )
        self._do(lambda: self._calibrate((reading.rate_rad_s, reading.acceleration_m_s2), variances, walk))
        if reading.gravity_count:
            bearing, count = reading.bearing_rad, reading.gravity_count
            self._do(lambda: self._feel_gravity(bearing, count))

    def _calibrate(self, means: tuple[float, float], variances: tuple[float, float], walk: tuple[float, float]) -> None:
        Q = np.zeros((STATES, STATES))
        Q[BG, BG], Q[BA, BA] = walk
        filter_ = self._filter
        filter_.predict(np.eye(STATES), Q)
        H = np.zeros((2, STATES))
        # v, a and w stay what the stop made of them; the scale error acts on a rate of zero.
        H[0, BG] = H[0, W] = H[1, BA] = H[1, A] = 1.0
        filter_.update(np.array(means), H, np.array(variances))

    def _feel_gravity(self, bearing_rad: float, count: int) -> None:
        mean, full = self._filter.mean, self._full
        slope = self._terrain.at(float(mean[X]), float(mean[Y]))
        tilt = self._mirror_tilt(slope.fx, slope.fy)
        if tilt < full.gravity_least_tilt:
            return
        variance = (full.gravity_sigma_rad / tilt) ** 2 / count + full.gravity_floor_rad**2
        residual = difference(heading_from_gravity(bearing_rad, slope), float(mean[PSI]))
        prior = float(self._filter.covariance[PSI, PSI])
        if residual * residual > full.gravity_gate**2 * (variance + prior):
            self.counts["gravity_gated"] += 1
            return
        H = np.zeros((1, STATES))
        H[0, PSI] = 1.0
        self._filter.update(np.array([float(mean[PSI]) + residual]), H, np.array([variance]))

    def _mirror_tilt(self, fx: float, fy: float) -> float:
        """Sine of the angle between the surface and the horizontal."""
        gx, gy, gz = self._gravity_deck
        norm = sqrt(1.0 + fx * fx + fy * fy)
        along = (gz - fx * gx - fy * gy) / norm
        return sqrt(max(1.0 - along * along, 0.0))

    def _begin_leg(self) -> None:
        """Slip and creep of the coming leg, from the legs so far."""
        redraw = self._legs.begin(self._filter.mean, self._filter.covariance)
        self._do(lambda: self._redraw(redraw))

    def _redraw(self, redraw: Redraw) -> None:
        F, Q = np.eye(STATES), np.zeros((STATES, STATES))
        where = np.ix_(_DRAWN, _DRAWN)
        F[where], Q[where] = redraw.F, redraw.Q
        self._filter.predict(F, Q)
        x = self._filter.mean.copy()
        x[_DRAWN] = redraw.mean
        self._filter.reset(x, self._filter.covariance)

    # -- seams --------------------------------------------------------------------------------------------------------

    def _cross(self, transition: Transition, t_s: float) -> None:
        mean = self._filter.mean
        slope = self._terrain.at(float(mean[X]), float(mean[Y]))
        edge = self._seams.meet(transition, t_s, mean, slope)
        if edge is not None:
            self._do(lambda: self._use_line(edge, transition, t_s))

    def _use_line(self, edge: Edge, transition: Transition, t_s: float) -> None:
        if edge.is_new:
            self._renew_offset(edge.offset)
        mean, P = self._filter.mean, self._filter.covariance
        slope = self._terrain.at(float(mean[X]), float(mean[Y]))
        residual, H, variance = self._seams.line(edge, transition, t_s, mean, slope)
        spread = variance + float(H[0].dot(P).dot(H[0]))
        is_used = residual * residual <= self._full.line_gate**2 * spread
        self.counts["crossings_used" if is_used else "crossings_gated"] += 1
        if is_used:
            self._filter.update(H.dot(mean) + residual, H, np.array([variance]))

    def _renew_offset(self, state: int) -> None:
        x, P = self._filter.mean.copy(), self._filter.covariance.copy()
        x[state] = 0.0
        P[state, :] = 0.0
        P[:, state] = 0.0
        P[state, state] = self._full.edge_sigma_m**2
        self._filter.reset(x, P)

    # -- fixes --------------------------------------------------------------------------------------------------------

    def fuse_fix(self, fix: Fix) -> float:
        """Fuse a multilaterated position of the puck at its own time; everything later is done again.

        Args:
            fix: position and covariance of the puck, world frame.

        Returns:
            How far the pose jumped, m.

        Raises:
            FixGated: it contradicts the estimate, and not yet often enough to be right all the same.
            FixRefused: not finite, too old, from the future, or far from the mirror. The pose is unchanged by both.
        """
        check_fix(fix, self._journal.oldest_s, self._clock.t_s + MAX_FRAME_STEP_S)
        foot = deck_foot(self._mirror, fix, self._puck_height_m)
        variance = foot.covariance_m2 + np.eye(2) * self._full.fix_extra_sigma_m**2
        z = np.array([foot.x_m, foot.y_m])
        before = self.deck_pose
        if self.is_frozen:
            self._relocate(z, variance)
            self.is_frozen = False
        elif self._is_gated(z, variance):
            return self._refuse(z, variance, before)
        self._refused.clear()
        late = self._journal.take(fix.t_s, lambda: self._use_fix(z, variance), self._filter)
        self.counts["late_fixes"] += late > 0
        self.counts["fixes"] += 1
        self.fix_deviation_m = foot.deviation_m
        self._legs.end(self._filter.mean, self._filter.covariance)
        self._hand_over()
        return self._jump_m(before)

    def _use_fix(self, z: FloatArray, variance: FloatArray) -> None:
        self.innovation = self._filter.update(z, _POSITION_ROWS, variance)

    def _is_gated(self, z: FloatArray, variance: FloatArray) -> bool:
        residual = z - self._filter.mean[:2]
        S = self._filter.covariance[:2, :2] + variance
        return float(residual.dot(np.linalg.solve(S, residual))) > self._full.fix_gate_nis

    def _refuse(self, z: FloatArray, variance: FloatArray, before: DeckPose) -> float:
        """Lock-out recovery: an estimate that is sure of itself and wrong would refuse every true fix from now on."""
        residual = z - self._filter.mean[:2]
        refused = [r for r in self._refused if sqrt(float(np.sum((r - residual) ** 2))) <= self._full.consistent_m]
        self._refused = [*refused, residual]
        distance_mm = 1e3 * sqrt(float(residual.dot(residual)))
        self.counts["fixes_gated"] += 1
        if len(self._refused) < _CONSISTENT:
            raise FixGated(f"fix is {distance_mm:.1f} mm from the estimate, sigma {1e3 * self.position_sigma_m:.2f} mm")
        self._refused.clear()
        self._relocate(z, variance)
        self.counts["reinitialised"] += 1
        self.notices.append(
            f"{_CONSISTENT} fixes in a row say that the pose is {distance_mm:.1f} mm wrong: it begins anew"
        )
        return self._jump_m(before)

    def _relocate(self, z: FloatArray, variance: FloatArray) -> None:
        """Begin anew at a measured position; the heading keeps its value and loses its certainty."""
        x, P = self._filter.mean.copy(), self._filter.covariance.copy()
        if not (np.isfinite(x).all() and np.isfinite(P).all()):
            raise FilterDiverged("the state is not finite")
        heading_variance = float(P[PSI, PSI]) + self._full.relocated_heading_sigma_rad**2
        pose = [X, Y, PSI]
        P[pose, :] = 0.0
        P[:, pose] = 0.0
        P[:2, :2], P[PSI, PSI] = variance, heading_variance
        x[X], x[Y] = z
        x[[V, A, W]] = 0.0
        self._journal.restart()
        self._seams.forget()
        self._legs.forget_leg()
        self._filter.reset(x, P)

    def _jump_m(self, before: DeckPose) -> float:
        after = self.deck_pose
        return sqrt((after.x_m - before.x_m) ** 2 + (after.y_m - before.y_m) ** 2)

    # -- frames of reference, and time --------------------------------------------------------------------------------

    def _hand_over(self) -> None:
        x, y = self._filter.mean[:2].tolist()
        if abs(x - self._centre[0]) > self._near_x_m or abs(y - self._centre[1]) > self._near_y_m:
            panel = self._mirror.panel_at(x, y)
            if panel is not None and panel != self._panel:
                self._enter(panel)

    def _enter(self, panel: PanelId) -> None:
        found = self._mirror.panel(panel)
        self._panel = panel
        self._origin, self._panel_axes = found.origin, found.axes[:2]
        self._centre = found.x_m, found.y_m
        self._near_x_m, self._near_y_m = _NEAR_BORDER * found.half_x_m, _NEAR_BORDER * found.half_y_m

    def _resync(self, is_first: bool) -> None:
        """Go on in a new time base: the pose does not step, what may have happened meanwhile goes to the covariance."""
        self._right.restart()
        self._left.restart()
        self._journal.restart()
        self._last_imu = None
        if is_first:
            return
        self.counts["resyncs"] += 1
        self._intake.restart()
        self._seams.restart()
        if not self.is_frozen:
            Q = np.zeros((STATES, STATES))
            way = abs(self.speed_m_s) * MAX_FRAME_STEP_S
            turn = abs(self.rate_rad_s) * MAX_FRAME_STEP_S
            Q[X, X] = Q[Y, Y] = way * way
            Q[PSI, PSI] = turn * turn
            self._filter.predict(np.eye(STATES), Q)

    def _ask_to_hold(self, cause: str) -> None:
        self.hold_cause = self.hold_cause or cause
