"""The full-state localizer: pose, speeds and the sensors' own errors in one filter, on the curved surface."""

from collections.abc import Sequence
from math import atan2, cos, hypot, isfinite, sin, sqrt

import numpy as np

from ccatp.config.models import LocalizerConfig, RobotConfig
from ccatp.core import DeckPose, EdgeSample, Fix, FloatArray, GravitySample, ImuSample, PanelId, PanelPose, wrap_pi
from ccatp.estimation.fixes import FixGated, check_fix, deck_foot
from ccatp.estimation.localizer_base import LONGEST_GAP_S, MAX_FRAME_STEP_S, LocalizerBase, WheelReadings
from ccatp.estimation.odometry import PosePredictor, Preintegrator, WheelAngle
from ccatp.estimation.rest import NoiseFloor, ZeroVelocityDetector
from ccatp.estimation.seams import EdgeScanner
from ccatp.estimation.state_filter import SurveyFilter
from ccatp.estimation.state_model import PSI, Slope, W
from ccatp.filters.base import Filter, FilterDiverged, Innovation
from ccatp.mirror.layout import Panel
from ccatp.mirror.mirror import Mirror

_IMPOSSIBLE = 2.0  # an estimate of this many times the wheels' largest rate is no estimate
_CHUNK = 100  # samples at rest after which their mean is used, however long the rest
_CONSISTENT = 3  # this many refused fixes that agree with each other are right, and the pose is wrong
_ROUNDING_S = 1e-6
_NOMINAL_FRAME_S = 0.01
_SHORTEST_LEG_M, _LARGEST_DOUBT_RAD = 0.02, 0.5  # of a heading, from where a leg ended instead
_NEAR_BORDER = 0.95  # part of a panel's half size beyond which the cell under the robot is looked up


class PanelFrame:
    """The panel under the robot, and poses in its frame."""

    def __init__(self, mirror: Mirror, panel: PanelId) -> None:
        self._mirror = mirror
        self.at = mirror.panel(panel)

    def locate(self, deck: tuple[float, float, float], height_m: float, slope: Slope) -> PanelPose:
        """A deck pose (x, y, heading) on a surface of this height and slope, as ``Mirror.panel_pose``."""
        x, y, psi = deck
        at = self.at
        if abs(x - at.x_m) > _NEAR_BORDER * at.half_x_m or abs(y - at.y_m) > _NEAR_BORDER * at.half_y_m:
            panel = self._mirror.panel_at(x, y)
            if panel is not None:
                self.at = at = self._mirror.panel(panel)
        fx, fy = slope[0], slope[1]
        s2 = 1.0 + fx * fx
        s, norm = sqrt(s2), sqrt(s2 + fy * fy)
        c, d = cos(psi), sin(psi)
        hx, hy = c / s - d * fx * fy / (norm * s), d * s / norm
        (ax, ay, az), (bx, by, bz), _ = at.axes
        ox, oy, oz = at.origin
        hz, dx, dy, dz = fx * hx + fy * hy, x - ox, y - oy, height_m - oz
        heading = atan2(bx * hx + by * hy + bz * hz, ax * hx + ay * hy + az * hz)
        return PanelPose(at.id, ax * dx + ay * dy + az * dz, bx * dx + by * dy + bz * dz, heading)


class FullStateLocalizer(LocalizerBase):
    """Estimates pose, speeds, sensor errors, slip and creep with one filter of ``STATES`` states, deck frame.

    Frames are gathered into blocks; the filter takes a block in one step, and dead reckoning carries the pose from
    frame to frame in between. A transition of an edge sensor ends a block and is a line at a panel's edge; a fix of the
    puck is a position. Both correct the whole state through its covariance, so two fixes in a row give the heading. At
    true rest the speeds are zero and the inertial unit shows its biases. When the robot drives off, slip and creep are
    drawn from what the legs so far showed.

    Attributes:
        pose: estimated pose, in the frame of the panel under the robot.
        speed_m_s, rate_rad_s: estimated forward speed and angular rate.
        creep: estimated downhill drift per metre of travel, in the plane of ``pose``.
        position_sigma_m: standard deviation of the position along its worst direction, at the last step of the filter.
        fix_deviation_m: height of the last fix above the ideal surface.
    """

    def __init__(
        self, filter_: Filter, mirror: Mirror, robot: RobotConfig, cfg: LocalizerConfig, start: PanelPose
    ) -> None:
        super().__init__(cfg.history_s)
        self.fix_deviation_m = 0.0
        self._filter, self._mirror, self._full = filter_, mirror, cfg.full_state
        self._rest_rate_rad_s = cfg.full_state.rest_rate_rad_s
        self._update_period_s = cfg.full_state.update_period_s - _ROUNDING_S
        self._puck_height_m = robot.puck_height_m
        self._v_limit_m_s = _IMPOSSIBLE * robot.wheel_radius_m * robot.max_wheel_rad_s
        self._omega_limit_rad_s = 2.0 * self._v_limit_m_s / robot.wheel_base_m
        self._right, self._left = WheelAngle(), WheelAngle()
        self._gyro = NoiseFloor(cfg.gyroscope_sigma_rad_s**2)
        self._accelerometer = NoiseFloor(cfg.accelerometer_sigma_m_s2**2)
        self._rest = ZeroVelocityDetector(self._full.rest_after_s, self._gyro, self._accelerometer)
        self._rested_s = 0.0
        self._edges = EdgeScanner()
        self._block = Preintegrator()
        self._estimate = SurveyFilter(filter_, mirror, robot, cfg, self.counts, mirror.deck_pose(start))
        self._running = PosePredictor(robot.wheel_radius_m, robot.wheel_base_m, self._full.jerk_density_m2_s5)
        self._panel = PanelFrame(mirror, start.panel)
        self._refused: list[FloatArray] = []
        self._fixed_m: FloatArray | None = None  # where the last fix that counted was
        self._is_relocated = False  # no fix has agreed since it began again
        self._is_new_base = False
        self._half_s = 0.0
        self._creep_on: Panel | None = None
        self._frame_s = _NOMINAL_FRAME_S
        self._predict_pose(0.0)
        self._locate()

    # -- what it knows ------------------------------------------------------------------------------------------------

    @property
    def deck_pose(self) -> DeckPose:
        """Estimated pose, deck frame."""
        now = self._running
        return DeckPose(now.x_m, now.y_m, wrap_pi(now.heading_rad))

    @property
    def heading_sigma_rad(self) -> float:
        """Standard deviation of the heading, at the last step of the filter."""
        return sqrt(max(float(self._filter.covariance[PSI, PSI]), 0.0))

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance of (x, y, heading), deck frame, shape (3, 3), at the last step of the filter."""
        return self._filter.covariance[:3, :3]

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """Mean (n,) and covariance (n, n) of the whole state at the last step of the filter; see ``state_model``."""
        return self._filter.mean, self._filter.covariance

    @property
    def innovation(self) -> Innovation | None:
        """Of the last fix, or None."""
        return self._estimate.innovation

    @property
    def is_resting(self) -> bool:
        """The wheels have stood long enough to be sure."""
        return self._rest.is_resting

    def rest(self) -> None:
        """The mission takes the robot to be at rest; the wheels themselves say here when it really is."""

    # -- frames -------------------------------------------------------------------------------------------------------

    def _use(
        self,
        t_s: float,
        dt_s: float,
        imu: Sequence[ImuSample],
        right: WheelReadings,
        left: WheelReadings,
        edges: Sequence[EdgeSample],
        gravity: GravitySample | None,
    ) -> None:
        right_rad, left_rad = self._right.add(*right, dt_s), self._left.add(*left, dt_s)
        if self._is_new_base:
            self._is_new_base = False
            # What the wheels did in the frame that begins a new time base lies in the gap before it, for the filter.
            self._right.angle_rad -= right_rad
            self._left.angle_rad -= left_rad
            right_rad = left_rad = 0.0
        if self.is_frozen:
            return
        rest, frame_s = self._rest, dt_s or _NOMINAL_FRAME_S
        limit = self._rest_rate_rad_s * frame_s
        is_still = -limit <= right_rad <= limit and -limit <= left_rad <= limit
        if rest.is_resting:
            if is_still:
                self._hold_position(t_s, dt_s, imu, right[1], left[1], gravity)
                self._edges.scan(edges)
                self._locate()
                return
            self._use_rest(t_s - dt_s)
            self._estimate.begin_leg()
            rest.moved()
            self._predict_pose(0.0)
        elif rest.still_s and not is_still:
            rest.moved()
        self._frame_s = frame_s
        block = self._block
        block.add(dt_s, imu, is_turning=bool(right_rad or left_rad))
        self._running.advance(dt_s, right_rad, left_rad, imu[-1][2] if imu else None)
        transitions = self._edges.scan(edges)
        # Wheels that say nothing do not stand for that reason.
        is_stop = is_still and self._right.is_fresh and self._left.is_fresh and rest.stood(dt_s)
        if transitions or is_stop or block.dt_s >= self._update_period_s:
            self._take_block(t_s)
            for transition in transitions:
                self._estimate.cross(transition, t_s)
            if is_stop:
                self._estimate.stop((self._right.angle_rad, self._left.angle_rad))
                self._rebase()
            self._predict_pose(self._half_s)
        self._locate()

    def _hold_position(
        self,
        t_s: float,
        dt_s: float,
        imu: Sequence[ImuSample],
        right_rad_s: Sequence[float],
        left_rad_s: Sequence[float],
        gravity: GravitySample | None,
    ) -> None:
        self._right.rest(right_rad_s)
        self._left.rest(left_rad_s)
        self._rebase()  # what adds up meanwhile is noise
        self._rested_s += dt_s
        self._block.stand(imu)
        self._rest.add(imu, gravity)
        if self._rest.count >= _CHUNK:
            self._use_rest(t_s)

    def _rebase(self) -> None:
        self._right.rebase()
        self._left.rebase()

    def _take_block(self, t_s: float) -> None:
        block = self._block.take()
        self._half_s = 0.5 * block.dt_s
        self._estimate.begin(t_s, block.dt_s)
        self._estimate.move(block, self._right, self._left, (self._gyro.variance, self._accelerometer.variance))
        _, _, _, v, _, w = self._filter.mean[: W + 1].tolist()
        if abs(v) > self._v_limit_m_s or abs(w) > self._omega_limit_rad_s:
            raise FilterDiverged(f"{v:.3g} m/s and {w:.3g} rad/s are more than the wheels can do")

    def _locate(self) -> None:
        """Take over where dead reckoning has led."""
        now, slope, panel = self._running, self._slope, self._panel
        x, y = now.x_m, now.y_m
        self.pose = panel.locate((x, y, now.heading_rad), self._estimate.terrain.height_m(x, y), slope)
        self.speed_m_s, self.rate_rad_s = now.v_m_s, now.omega_rad_s
        if panel.at is not self._creep_on:  # or the filter has taken a step
            self._creep_on = panel.at
            x, y = now.creep_x, now.creep_y
            self.creep = panel.at.rotate_from_deck((x, y, slope[0] * x + slope[1] * y))[:2]

    def _freeze(self, error: FilterDiverged) -> None:
        super()._freeze(error)
        self._locate()

    def _worst_sigma_m(self) -> float:
        (a, b), (_, d) = self._filter.covariance[:2, :2].tolist()
        return sqrt(max(0.5 * (a + d) + sqrt(0.25 * (a - d) ** 2 + b * b), 0.0))

    def _predict_pose(self, half_s: float) -> None:
        self.position_sigma_m, self._creep_on = self._worst_sigma_m(), None
        self._slope = self._estimate.slope()
        self._running.begin(self._filter.mean, self._slope, half_s)
        if self._rest.is_resting:
            self._running.stand()
            return
        frame_s = self._frame_s
        # The bounded errors at both ends of a frame, and what the noise of the rates adds up to in between.
        angle = 2.0 * self._right.variance_rad2() + self._estimate.encoder_walk(self._right) * frame_s
        self._running.trust(angle, self._gyro.variance, frame_s)

    def _use_rest(self, t_s: float) -> None:
        rested_s, self._rested_s = self._rested_s, 0.0
        reading = self._rest.take()
        self._estimate.begin(t_s, 0.0)
        if reading.samples:
            variances = self._gyro.variance, self._accelerometer.variance
            self._estimate.calibrate(reading, rested_s, variances)
        self._predict_pose(0.0)

    # -- fixes --------------------------------------------------------------------------------------------------------

    def fuse_fix(self, fix: Fix) -> float:
        """Fuse a position of the puck at the time it was taken; returns how far the pose jumped, m.

        Raises ``FixGated``: it contradicts the estimate, and not often enough yet to be used all the same;
        ``FixRefused``: not finite, too old, from the future, or far from the mirror. The pose is unchanged by both.
        """
        estimate, t_s = self._estimate, self.t_s
        check_fix(fix, estimate.journal.oldest_s, t_s + MAX_FRAME_STEP_S)
        foot = deck_foot(self._mirror, fix, self._puck_height_m)
        z, variance = np.array([foot.x_m, foot.y_m]), foot.covariance_m2
        before = self._running.x_m, self._running.y_m
        try:
            if not self.is_frozen:
                self._condition(fix.t_s, z, variance)
        except FilterDiverged as error:
            self._freeze(error)
        if self.is_frozen:
            self._relocate(fix.t_s, z, variance, is_lost=True)
            self.is_frozen = False
        self.counts["fixes"] += 1
        self.fix_deviation_m = foot.deviation_m
        self._predict_pose(0.0)
        self._locate()
        now = self._running
        return sqrt((now.x_m - before[0]) ** 2 + (now.y_m - before[1]) ** 2)

    def _condition(self, t_s: float, z: FloatArray, variance: FloatArray) -> None:
        """Update with a position (2,) of time ``t_s`` and its covariance (2, 2), if it does not contradict."""
        estimate = self._estimate
        if self._block.dt_s > 0.0:
            self._take_block(self.t_s)
        if estimate.is_gated(t_s, z, variance):
            self._refuse(t_s, z, variance)
            return
        self._refused.clear()
        self._fixed_m, self._is_relocated = z, False
        self.counts["late_fixes"] += estimate.fix(t_s, z, variance) > 0
        estimate.end_leg()

    def _relocate(self, t_s: float, z: FloatArray, variance: FloatArray, *, is_lost: bool) -> None:
        turn_rad = self._turn_to(z, self._estimate.fix_residual(t_s, z))
        self._estimate.relocate(t_s, z, variance, is_lost=is_lost, turn_rad=turn_rad, again=self._is_relocated)
        self._is_relocated = True
        self._fixed_m = z
        self._block.restart()
        self._rebase()

    def _turn_to(self, z: FloatArray, residual: FloatArray) -> float:
        """How wrong the heading has been, if that alone led the robot to ``z`` on the leg since the last fix."""
        if self._fixed_m is None:
            return 0.0
        leg_m, off_m = hypot(*(z - residual - self._fixed_m)), hypot(*residual)
        return min(_LARGEST_DOUBT_RAD, off_m / leg_m) if leg_m > _SHORTEST_LEG_M else 0.0

    def _refuse(self, t_s: float, z: FloatArray, variance: FloatArray) -> None:
        """Lock-out recovery: an estimate that is sure of itself and wrong would refuse every true fix from now on."""
        residual = self._estimate.fix_residual(t_s, z)
        refused = [r for r in self._refused if sqrt(float(np.sum((r - residual) ** 2))) <= self._full.consistent_m]
        self._refused = [*refused, residual]
        distance_mm = 1e3 * sqrt(float(residual.dot(residual)))
        self.counts["fixes_gated"] += 1
        if len(self._refused) < _CONSISTENT:
            raise FixGated(f"fix is {distance_mm:.1f} mm from the estimate, sigma {1e3 * self._worst_sigma_m():.2f} mm")
        self._refused.clear()
        self._relocate(t_s, z, variance, is_lost=False)
        self.counts["reinitialised"] += 1
        self.notices.append(
            f"{_CONSISTENT} fixes in a row say that the pose is {distance_mm:.1f} mm wrong: it begins anew"
        )

    def inflate_covariance(self, way_m: float, turn_rad: float) -> None:
        """The pose may be wrong by this much, because what it was made of was: the pose stays, its certainty goes."""
        if self.is_frozen:
            return
        # What the wheels may have done while nobody listened is part of the doubt.
        self._right.restart()
        self._left.restart()
        if self._block.dt_s > 0.0:
            self._take_block(self.t_s)
        self._estimate.inflate_covariance(way_m, turn_rad)
        self._predict_pose(self._half_s)
        self._locate()
        self._estimate.journal.restart()
        self._block.restart()

    # -- time ---------------------------------------------------------------------------------------------------------

    def _resync(self, t_s: float, last_s: float) -> None:
        """Go on in a new time base: the pose does not step, what may have happened meanwhile goes to the covariance."""
        self._is_new_base = True
        self._right.restart()
        self._left.restart()
        if not isfinite(last_s):
            self._estimate.journal.restart()
            return
        self.counts["resyncs"] += 1
        self._intake.restart()
        self._edges.restart()
        if not self.is_frozen:
            if self._block.dt_s > 0.0:
                self._take_block(last_s)
            # A gap without frames, if it is one and no jump of the clock, ends with the robot's own time-to-live.
            lost_s = min(max(t_s - last_s, MAX_FRAME_STEP_S), LONGEST_GAP_S)
            self._estimate.inflate_covariance(self._running.v_m_s * lost_s, self._running.omega_rad_s * lost_s)
            self._predict_pose(0.0)
        self._estimate.journal.restart()
        self._block.restart()
