"""The full-state localizer: pose, speeds and sensor errors in one filter, on the curved surface."""

from collections.abc import Sequence
from math import atan2, cos, hypot, inf, sin, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.config.models import Config
from ccatp.core import DeckPose, Fix, FloatArray, PanelPose
from ccatp.estimation.fixes import FixGated
from ccatp.estimation.localizer_base import (
    LONGEST_GAP_S,
    MAX_FRAME_STEP_S,
    Edges,
    EdgeScanner,
    FilterWrap,
    Gravity,
    ImuReadings,
    LocalizerBase,
    SensorTransition,
    WheelReadings,
    unwrapped,
)
from ccatp.estimation.odometry import Preintegrator, WheelAngle
from ccatp.estimation.pose_predictor import PosePredictor
from ccatp.estimation.rest import NoiseFloor, ZeroVelocityDetector
from ccatp.estimation.state_filter import SurveyFilter
from ccatp.estimation.state_model import POSE, POSITION, STATES, V, W
from ccatp.estimation.wheel_coast import CoastedMotion, WheelInput
from ccatp.filters.base import FilterDiverged, Innovation
from ccatp.kinematics import wrap_pi
from ccatp.mirror.layout import Panel
from ccatp.mirror.mirror import Mirror

_CHUNK = 100  # number of samples at rest after which their mean is used
_CONSISTENT = 3  # if this many refused fixes agree with each other, the pose is wrong
_ROUNDING_S = 1e-6
_NOMINAL_FRAME_S = 0.01
_SHORTEST_LEG_M, _LARGEST_DOUBT_RAD = 0.02, 0.5  # for the error of the heading, from the end of a leg
_TRUSTED_GAP_S = 0.03  # after a longer gap the odometry of the leg teaches nothing about slip and sensors
_NOTHING: WheelReadings = (), ()
_NEAR_BORDER = 0.95  # part of a panel's half size beyond which the cell under the robot is looked up


class GapFrame(NamedTuple):
    """The samples of the wheels to use; ``coasted``: in a gap the motion that the set points predict."""

    right: WheelReadings
    left: WheelReadings
    coasted: CoastedMotion | None


class FullStateLocalizer(LocalizerBase):
    """Estimates pose, speeds, sensor errors, slip and creep with one filter, deck frame; see docs/localization.md.

    Frames are collected into blocks, and the filter makes one step per block. Between steps the pose advances by dead
    reckoning. ``pose``: in the frame of the panel under the robot; ``creep``: downhill drift per metre of travel in its
    plane; ``position_sigma_m``: in the worst direction, at the last step of the filter, which in a gap of the encoders
    is that of the newest frame.
    """

    def __init__(self, cfg: Config, mirror: Mirror, start: PanelPose, wrap: FilterWrap = unwrapped) -> None:
        super().__init__(cfg, mirror, STATES, wrap)
        robot = cfg.robot
        self._full = cfg.localizer.full_state
        self._rest_rate_rad_s = self._full.rest_rate_rad_s
        self._update_period_s = self._full.update_period_s - _ROUNDING_S
        self._right = WheelAngle()
        self._left = WheelAngle()
        self._gyro = NoiseFloor(cfg.localizer.gyroscope_sigma_rad_s**2)
        self._accelerometer = NoiseFloor(cfg.localizer.accelerometer_sigma_m_s2**2)
        self._rest = ZeroVelocityDetector(self._full.rest_after_s, self._gyro, self._accelerometer)
        self._rested_s = 0.0
        self._edges = EdgeScanner()
        self._block = Preintegrator()
        self._estimate = SurveyFilter(self._filter, mirror, cfg, self.counts, mirror.deck_pose(start))
        self._running = PosePredictor(robot.wheel_radius_m, robot.wheel_base_m, self._full.jerk_density_m2_s5)
        self._panel = mirror.panel(start.panel)
        self._refused: list[FloatArray] = []
        self._fixed_m: FloatArray | None = None  # position of the last fix that was used
        self._is_relocated = False  # no fix has agreed since the last relocation
        self._creep_on: Panel | None = None
        self._is_new_base = False
        self._half_s = 0.0
        self._frame_s = _NOMINAL_FRAME_S
        self._predict_pose(0.0)
        self._locate()

    # -- the estimate -------------------------------------------------------------------------------------------------

    @property
    def deck_pose(self) -> DeckPose:
        """Estimated pose, deck frame."""
        now = self._running
        return DeckPose(now.x_m, now.y_m, wrap_pi(now.heading_rad))

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance of (x, y, heading), deck frame, shape (3, 3), at the last step of the filter."""
        return self._filter.covariance[POSE, POSE]

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """Mean (n,) and covariance (n, n) of the whole state at the last step of the filter; see ``state_model``."""
        return self._filter.mean, self._filter.covariance

    @property
    def innovation(self) -> Innovation | None:
        """Innovation of the last fix, or None."""
        return self._estimate.innovation

    @property
    def is_resting(self) -> bool:
        """The wheels have stood long enough to be sure that the robot is at rest."""
        return self._rest.is_resting

    def rest(self) -> None:
        """No effect: this localizer detects rest from the wheels."""

    # -- frames -------------------------------------------------------------------------------------------------------

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
        """See ``LocalizerBase``. What is fused, and in which order.

        ::

            encoders: samples? --yes--> turns of the wheels --+--> at rest? --no--> sums of the inertial unit,
                         |                                    |       |             pose by dead reckoning
                         no---> turns by the set points ------+      yes                     |
                                (``_coasted``)                        |       end of block, edge, stop, or gap?
                                                                      |                      |
                                  each 100 samples (``_use_rest``):   |             yes: ``_end_block``
                                    biases by the inertial unit   <---+               1. predict; wheels, inertial unit
                                    heading by gravity                                2. each edge, by the seam there
                                                                                      3. at a stop: zero velocity
                                                                                      4. pose from the filter

        A fix is for a time in the past, and comes between two frames (``fuse_fix``). While the filter is frozen, only
        the turns of the wheels are summed.
        """
        coasted = None
        is_right_sparse, is_left_sparse = self._right.is_sparse(right[0], dt_s), self._left.is_sparse(left[0], dt_s)
        if not (right[0] and left[0]) or self._coast.gap_s or is_right_sparse or is_left_sparse:
            right, left = _NOTHING if is_right_sparse else right, _NOTHING if is_left_sparse else left
            right, left, coasted = self._coasted(dt_s, right, left, set_points)
        if coasted is None:
            right_rad, left_rad = self._right.add(*right, dt_s), self._left.add(*left, dt_s)
            self._coast.follow(dt_s, set_points, right_rad, left_rad)
        else:
            right_rad = self._turn(self._right, right, dt_s, coasted.right_rad)
            left_rad = self._turn(self._left, left, dt_s, coasted.left_rad)
        if self._is_new_base:
            self._is_new_base = False
            # For the filter, the motion in the frame that begins a new time base belongs to the gap before it.
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
                self._right.rest(right[1])
                self._left.rest(left[1])
                self._stand(dt_s, imu, edges, gravity, set_points)
                return
            self._use_rest(self.t_s - dt_s)
            self._estimate.begin_leg()
            rest.moved()
            self._predict_pose(0.0)
        elif rest.still_s and not is_still:
            rest.moved()
        self._frame_s = frame_s
        self._block.add(dt_s, imu, is_turning=bool(right_rad or left_rad))
        self._running.advance(dt_s, right_rad, left_rad, imu[-1][2] if imu else None)
        transitions = self._edges.scan(edges)
        # Wheels without samples do not count as standing.
        is_stop = is_still and self._right.is_fresh and self._left.is_fresh and rest.stood(dt_s)
        if is_stop:
            self._rest_wheels(set_points)
        # In a gap every frame is a step of the filter, so that the covariance is that of the frame.
        if transitions or is_stop or self._block.dt_s >= self._update_period_s or coasted is not None:
            self._end_block(transitions, coasted, is_stop=is_stop)
        self._locate()

    def _stand(self, dt_s: float, imu: ImuReadings, edges: Edges, gravity: Gravity, set_points: WheelInput) -> None:
        """Take a frame at rest."""
        self._rebase()  # at rest the sums contain only noise
        self._rest_wheels(set_points)
        self._rested_s += dt_s
        self._block.stand(imu)
        self._rest.add(imu, gravity)
        if self._rest.count >= _CHUNK:
            self._use_rest(self.t_s)
        self._edges.scan(edges)
        self._locate()

    def _rest_wheels(self, set_points: WheelInput) -> None:
        """Wheels at rest without a set point have no follow error."""
        if set_points is not None and set_points[0] == set_points[1] == 0.0:
            self._coast.stand()

    def _end_block(
        self, transitions: Sequence[SensorTransition], coasted: CoastedMotion | None, *, is_stop: bool
    ) -> None:
        if coasted is None:
            self._coast.learn(self._block.dt_s, *self._running.wheel_rates())
        self._take_block(self.t_s, coasted)
        for transition in transitions:
            self._estimate.cross(transition, self.t_s)
        if is_stop:
            self._estimate.stop((self._right.angle_rad, self._left.angle_rad))
            self._rebase()
        self._predict_pose(self._half_s)

    # -- frames without encoder samples -------------------------------------------------------------------------------

    def _coasted(self, dt_s: float, right: WheelReadings, left: WheelReadings, set_points: WheelInput) -> GapFrame:
        """A frame in a gap, at its end, or of slow encoders."""
        coast, since_s, is_resting = self._coast, self.t_s - dt_s, self._rest.is_resting
        wheels = self._right, self._left
        is_right, is_left = (
            not r[0] and wheel.is_silent(self.t_s) for wheel, r in zip(wheels, (right, left), strict=True)
        )
        coasted = None
        if (is_right or is_left) and dt_s > 0.0 and not self.is_frozen:
            if not coast.gap_s:
                if self._block.dt_s > 0.0:
                    self._take_block(since_s)
                    self._predict_pose(self._half_s)
                variance_rad2 = max(wheel.variance_rad2() for wheel in wheels)
                coast.begin(*self._running.wheel_rates(), variance_rad2, is_resting=is_resting)
            self.coasted = coasted = coast.advance(dt_s, set_points, is_right=is_right, is_left=is_left)
            self.gap_s += dt_s
            if coast.gap_s > _TRUSTED_GAP_S and coast.has_moved:
                self._estimate.distrust_leg()
        if self._right.is_coasting and right[0]:
            right = self._right.end_coasting(since_s, coast.rates[0], *right)
        if self._left.is_coasting and left[0]:
            left = self._left.end_coasting(since_s, coast.rates[1], *left)
        if coasted is None and coast.gap_s:
            coast.end()
        if self._right.has_lost or self._left.has_lost:
            self._right.has_lost = self._left.has_lost = False
            self._rebase()
            if not is_resting:
                self._estimate.resume(sqrt(max(wheel.variance_rad2() for wheel in wheels)))
        return GapFrame(right, left, coasted)

    @staticmethod
    def _turn(wheel: WheelAngle, readings: WheelReadings, dt_s: float, coasted_rad: float) -> float:
        """The turn of a wheel in a frame of a gap, in which the other one may have samples."""
        if readings[0]:
            return wheel.add(*readings, dt_s)
        wheel.coast(coasted_rad)
        return coasted_rad

    def _rebase(self) -> None:
        self._right.rebase()
        self._left.rebase()

    def _take_block(self, t_s: float, coasted: CoastedMotion | None = None) -> None:
        block = self._block.take()
        self._half_s = 0.5 * block.dt_s
        self._estimate.replay_buffer.begin(t_s, block.dt_s)
        variances = self._gyro.variance, self._accelerometer.variance
        self._estimate.move(t_s, block, self._right, self._left, variances, coasted)
        mean = self._filter.mean
        self._check_speeds(float(mean[V]), float(mean[W]))

    def _locate(self) -> None:
        """Update pose, speeds and creep from dead reckoning."""
        now, slope, at = self._running, self._slope, self._panel
        x, y, psi = now.x_m, now.y_m, now.heading_rad
        if abs(x - at.x_m) > _NEAR_BORDER * at.half_x_m or abs(y - at.y_m) > _NEAR_BORDER * at.half_y_m:
            panel = self._mirror.panel_at(x, y)
            if panel is not None:
                self._panel = at = self._mirror.panel(panel)
        # As ``Mirror.panel_pose``, on a surface of this height and slope.
        fx, fy = slope[0], slope[1]
        s2 = 1.0 + fx * fx
        s, norm = sqrt(s2), sqrt(s2 + fy * fy)
        c, d = cos(psi), sin(psi)
        hx, hy = c / s - d * fx * fy / (norm * s), d * s / norm
        (ax, ay, az), (bx, by, bz), _ = at.axes
        ox, oy, oz = at.origin
        hz, dx, dy, dz = fx * hx + fy * hy, x - ox, y - oy, self._estimate.terrain.height_m(x, y) - oz
        heading = atan2(bx * hx + by * hy + bz * hz, ax * hx + ay * hy + az * hz)
        self.pose = PanelPose(at.id, ax * dx + ay * dy + az * dz, bx * dx + by * dy + bz * dz, heading)
        self.speed_m_s = now.v_m_s
        self.rate_rad_s = now.omega_rad_s
        if at is not self._creep_on:  # another panel, or the filter has made a step
            self._creep_on = at
            x, y = now.creep_x, now.creep_y
            self.creep = at.rotate_from_deck((x, y, fx * x + fy * y))[:2]

    def _freeze(self, error: FilterDiverged) -> None:
        super()._freeze(error)
        self._locate()

    def _worst_sigma_m(self) -> float:
        (a, b), (_, d) = self._filter.covariance[POSITION, POSITION].tolist()
        return sqrt(max(0.5 * (a + d) + sqrt(0.25 * (a - d) ** 2 + b * b), 0.0))

    def _predict_pose(self, half_s: float) -> None:
        self.position_sigma_m = self._worst_sigma_m()
        self._creep_on = None
        self._slope = self._estimate.slope()
        self._running.begin(self._filter.mean, self._slope, half_s, self._estimate.turn_creep_share)
        if self._rest.is_resting:
            self._running.stand()
            return
        frame_s = self._frame_s
        # The bounded errors at both ends of a frame, and the sum of the rates' noise in between.
        angle = 2.0 * self._right.variance_rad2() + self._estimate.encoder_walk(self._right) * frame_s
        self._running.trust(angle, self._gyro.variance, frame_s)

    def _use_rest(self, t_s: float) -> None:
        reading, rested_s = self._rest.take(), self._rested_s
        self._rested_s = 0.0
        self._estimate.replay_buffer.begin(t_s, 0.0)
        if reading.samples:
            self._estimate.calibrate(reading, rested_s, (self._gyro.variance, self._accelerometer.variance))
        self._predict_pose(0.0)

    # -- fixes --------------------------------------------------------------------------------------------------------

    def fuse_fix(self, fix: Fix) -> float:
        """Fuse a position of the puck at the time it was taken; returns how far the pose jumped, m.

        Raises ``FixGated``: it contradicts the estimate, and too few others agree with it yet; ``FixRefused``: not
        finite, too old, from the future, or far from the mirror. Both leave the pose unchanged.
        """
        foot = self._foot_of(fix, self._estimate.replay_buffer.oldest_s)
        z, variance = np.array([foot.x_m, foot.y_m]), foot.covariance_m2
        before = self._running.x_m, self._running.y_m
        try:
            if not self.is_frozen:
                self._condition(fix.t_s, z, variance)
        except FilterDiverged as error:
            self._freeze(error)
        if self.is_frozen:
            self._relocate(z, self._estimate.expect(fix.t_s, z)[0], variance, is_lost=True)
            self.is_frozen = False
        self.counts["fixes"] += 1
        self.gap_s = self._coast.gap_s
        self._predict_pose(0.0)
        self._locate()
        now = self._running
        return sqrt((now.x_m - before[0]) ** 2 + (now.y_m - before[1]) ** 2)

    def _condition(self, t_s: float, z: FloatArray, variance: FloatArray) -> None:
        """Update with a position (2,) at ``t_s`` and its covariance (2, 2), unless it contradicts the estimate."""
        if self._block.dt_s > 0.0:
            self._take_block(self.t_s)
        residual, expected = self._estimate.expect(t_s, z)
        if float(residual.dot(np.linalg.solve(expected + variance, residual))) > self._full.fix_gate_nis:
            self._refuse(z, residual, variance)
            return
        self._refused.clear()
        self._fixed_m = z
        self._is_relocated = False
        self.counts["late_fixes"] += self._estimate.fix(t_s, z, variance) > 0

    def _relocate(self, z: FloatArray, residual: FloatArray, variance: FloatArray, *, is_lost: bool) -> None:
        turn_rad = 0.0
        if self._fixed_m is not None:
            # Heading error that alone would have led the robot to ``z`` on the leg since the last fix.
            leg_m, off_m = hypot(*(z - residual - self._fixed_m)), hypot(*residual)
            if leg_m > _SHORTEST_LEG_M:
                turn_rad = min(_LARGEST_DOUBT_RAD, off_m / leg_m)
        self._estimate.relocate(residual, variance, turn_rad, is_lost=is_lost, again=self._is_relocated)
        self._is_relocated = True
        self._fixed_m = z
        self._block.restart()
        self._rebase()

    def _refuse(self, z: FloatArray, residual: FloatArray, variance: FloatArray) -> None:
        """Refuse a fix, or relocate if enough of them agree: a wrong, overconfident estimate would refuse all fixes."""
        refused = [r for r in self._refused if sqrt(float(np.sum((r - residual) ** 2))) <= self._full.consistent_m]
        self._refused = [*refused, residual]
        distance_mm = 1e3 * sqrt(float(residual.dot(residual)))
        self.counts["fixes_gated"] += 1
        if len(self._refused) < _CONSISTENT:
            raise FixGated(f"fix is {distance_mm:.1f} mm from the estimate, sigma {1e3 * self._worst_sigma_m():.2f} mm")
        self._refused.clear()
        self._relocate(z, residual, variance, is_lost=False)
        self.counts["reinitialised"] += 1
        self.notices.append(
            f"{_CONSISTENT} fixes in a row say that the pose is {distance_mm:.1f} mm wrong: it starts again"
        )

    def inflate_covariance(self, way_m: float, turn_rad: float) -> None:
        """Inflate the covariance of the pose by these standard deviations, because its inputs may have been wrong."""
        if self.is_frozen:
            return
        # The motion during a gap of the encoders is covered by the inflation.
        self._right.restart()
        self._left.restart()
        if self._block.dt_s > 0.0:
            self._take_block(self.t_s)
        self._estimate.inflate_covariance(way_m, turn_rad)
        self._predict_pose(self._half_s)
        self._locate()
        self._estimate.replay_buffer.restart()
        self._block.restart()

    # -- time ---------------------------------------------------------------------------------------------------------

    def _resync(self, t_s: float, last_s: float) -> None:
        self._is_new_base = True
        self._right.restart()
        self._left.restart()
        self._edges.restart()
        if last_s > -inf and not self.is_frozen:
            if self._block.dt_s > 0.0:
                self._take_block(last_s)
            # If this is a gap and not a jump of the clock, the robot's time-to-live has limited its motion.
            lost_s = min(max(t_s - last_s, MAX_FRAME_STEP_S), LONGEST_GAP_S)
            self._estimate.inflate_covariance(self._running.v_m_s * lost_s, self._running.omega_rad_s * lost_s)
            self._predict_pose(0.0)
        self._estimate.replay_buffer.restart()
        self._block.restart()
