"""The steps of the full-state filter: motion, rest, legs, seams, fixes; and their replay for late measurements."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import sqrt
from typing import NamedTuple

import numpy as np

from ccatp.config.models import Config
from ccatp.control.thrust import TurnCreep
from ccatp.core import DeckPose, FloatArray, PanelId
from ccatp.estimation import state_model as sm
from ccatp.estimation.fixes import fix_row, relocated
from ccatp.estimation.localizer_base import SensorTransition
from ccatp.estimation.odometry import MIN_VARIANCE_RAD2, PreintegratedMotion, Slope, Terrain, WheelAngle, gravity_on
from ccatp.estimation.rest import ZeroVelocityReading, heading_from_gravity
from ccatp.estimation.seams import SeamLines
from ccatp.estimation.slip_prior import SlipPrior, SlipWander
from ccatp.estimation.wheel_coast import CoastedMotion
from ccatp.filters.base import Filter, Innovation
from ccatp.kinematics import difference
from ccatp.mirror.mirror import Mirror

_STOP_ROWS = np.eye(sm.STATES)[sm.SPEEDS]
_SLIP_BLOCK = np.ix_(sm.SLIPS, sm.SLIPS)
_CALIBRATION_BLOCK = np.ix_(sm.CALIBRATION, sm.CALIBRATION)

Step = Callable[[], object]
LateStep = Callable[[float], None]
"""A step for a measurement older than the state; gets its age relative to the state, s."""
_SAME_TIME_S = 1e-6


class SurveyFilter:
    """The filter of ``STATES`` states with its models.

    ``replay_buffer`` executes each step, and repeats the later ones after a late fix.
    """

    def __init__(self, filter_: Filter, mirror: Mirror, cfg: Config, counts: dict[str, int], start: DeckPose) -> None:
        robot = cfg.robot
        self.innovation: Innovation | None = None
        self._turn_creep = TurnCreep(robot)
        self.turn_creep_share = 1.0  # in the last step
        self._cfg = cfg.localizer
        self._full = cfg.localizer.full_state
        self.replay_buffer = ReplayBuffer(filter_, self._full.rewind_s)
        self._filter = filter_
        self._counts = counts
        self._mirror = mirror
        self.terrain = Terrain(mirror)
        self._motion = sm.SurveyMotion(robot.wheel_radius_m, robot.wheel_base_m)
        self._base_per_radius = 0.5 * robot.wheel_base_m / robot.wheel_radius_m
        self._drift = np.zeros(sm.STATES)
        self._seams = SeamLines(mirror, robot)
        self._legs = SlipPrior(self._full)
        self._tilt_sigma_m = robot.puck_height_m * self._full.panel_tilt_sigma_rad
        self._gravity_deck = mirror.gravity_deck
        filter_.reset(*self._first(start))
        self._keep_calibration()
        self._is_trusted = True  # odometry since the last fix
        self._panel = self._panel_below()

    def _first(self, pose: DeckPose) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance when only the pose is known."""
        cfg, full = self._cfg, self._full
        mean, sigma = np.zeros(sm.STATES), np.zeros(sm.STATES)
        mean[sm.POSE] = pose.x_m, pose.y_m, pose.heading_rad
        mean[sm.BG] = cfg.gyroscope_bias_rad_s
        sigma[sm.POSE] = cfg.start_position_sigma_m, cfg.start_position_sigma_m, cfg.start_heading_sigma_rad
        sigma[sm.SPEEDS] = cfg.reset_speed_sigma_m_s, cfg.reset_acceleration_sigma_m_s2, cfg.reset_rate_sigma_rad_s
        sigma[sm.BG], sigma[sm.KG] = full.gyroscope_bias_sigma_rad_s, full.gyroscope_scale_sigma
        sigma[sm.BA], sigma[sm.KL] = full.accelerometer_bias_sigma_m_s2, full.wheel_base_sigma
        sigma[sm.EDGES], sigma[sm.TILT] = full.edge_sigma_m, self._tilt_sigma_m
        P = np.diag(sigma**2)
        mean[sm.SLIPS], P[_SLIP_BLOCK] = self._legs.first()
        return mean, P

    def slope(self) -> Slope:
        """Slope of the ground at the estimated position."""
        mean = self._filter.mean
        return self.terrain.at(float(mean[sm.X]), float(mean[sm.Y]))

    def _count(self, what: str) -> None:
        self._counts[what] += not self.replay_buffer.is_replaying

    # -- motion -------------------------------------------------------------------------------------------------------

    def move(
        self,
        t_s: float,
        block: PreintegratedMotion,
        right: WheelAngle,
        left: WheelAngle,
        imu_variances: tuple[float, float],
        coasted: CoastedMotion | None = None,
    ) -> None:
        """Frames up to ``t_s``: predict, then update with wheel angles, angular rate and acceleration.

        ``coasted``: the angles of the block are predicted ones. Their errors are a drift of the angles, so that the
        body follows the prediction as far as it is certain.
        """
        dt_s = block.dt_s
        slips = self._legs.wander(block.turning_s) if dt_s > 0.0 else SlipWander(0.0, 0.0, 0.0)
        encoders = self.encoder_walk(right) * dt_s
        readings = []
        # The rate before the angles: after them its variance would be so small that digits are lost.
        if block.rate_rad_s is not None:
            readings.append((sm.W, block.rate_rad_s, imu_variances[0] / block.samples))
        if coasted is not None:
            readings += [(sm.PR, right.angle_rad, MIN_VARIANCE_RAD2), (sm.PL, left.angle_rad, MIN_VARIANCE_RAD2)]
        elif right.is_fresh or left.is_fresh:
            gap_rad = right.take_gap() + left.take_gap()
            variance = max(right.variance_rad2(), left.variance_rad2()) + gap_rad * gap_rad
            for state, (angle_rad, lag_rad2) in ((sm.PR, right.angle_at(t_s)), (sm.PL, left.angle_at(t_s))):
                readings.append((state, angle_rad, variance + lag_rad2))
        if block.acceleration_m_s2 is not None and self._full.use.accelerometer:
            # The set points, and so the acceleration, may jump at any time between two samples.
            jump = self._full.acceleration_jump_m_s2**2
            readings.append((sm.A, block.acceleration_m_s2, imu_variances[1] / block.samples + jump))
        rows = sm.SensorRows(readings) if readings else None

        def step() -> None:
            if dt_s > 0.0:
                self._predict(dt_s, slips, encoders, coasted)
            if rows is not None:
                self._filter.update(rows.z, rows, rows.R)

        self.replay_buffer.do(step)
        panel = self._panel_below()
        if panel != self._panel:
            self._panel = panel
            self.replay_buffer.do(lambda: self._renew(sm.TILT, self._tilt_sigma_m))

    def _panel_below(self) -> PanelId:
        mean = self._filter.mean
        return self._mirror.nearest_panel(float(mean[sm.X]), float(mean[sm.Y]))

    def _predict(
        self, dt_s: float, slips: tuple[float, float, float], encoders: float, coasted: CoastedMotion | None
    ) -> None:
        full, (slip, creep, turn_creep) = self._full, slips
        mean: FloatArray = self._filter.mean
        slope = self.slope()
        gravity = gravity_on(slope, float(mean[sm.PSI]), self._gravity_deck)
        self.turn_creep_share = share = self._turn_creep.share(gravity)
        motion = self._motion.over(dt_s, slope, share)
        jerk, twist = full.jerk_density_m2_s5 * dt_s, full.angular_acceleration_density_rad2_s3 * dt_s
        impulses = np.array((jerk, twist, slip, slip, creep, turn_creep))
        drift = self._drift  # work space; the model does not keep it
        drift[sm.BG] = full.gyroscope_bias_walk_rad_s_sqrt_s**2 * dt_s
        drift[sm.BA] = full.accelerometer_bias_walk_m_s2_sqrt_s**2 * dt_s
        # The creep of a turn is mainly downhill, with a random part in any direction; the loss of a turn varies, too.
        creep, turned_rad = share * float(mean[sm.CT]), abs(float(mean[sm.W])) * dt_s
        drift[sm.X] = drift[sm.Y] = (full.turn_creep_aside * creep) ** 2 * turned_rad
        lost = (self._base_per_radius * full.turn_loss_per_creep) ** 2 * turned_rad
        variance = share * share * float(self._filter.covariance[sm.CT, sm.CT])
        drift[sm.PR] = drift[sm.PL] = encoders + lost * (creep * creep + variance)
        Q = motion.noise(self._filter.mean, impulses, drift)
        if coasted is not None:
            Q[sm.PR, sm.PR] += coasted.right_rad2
            Q[sm.PL, sm.PL] += coasted.left_rad2
            Q[sm.PR, sm.PL] += coasted.both_rad2
            Q[sm.PL, sm.PR] += coasted.both_rad2
        self._filter.predict(motion, Q)

    def resume(self, sigma_rad: float) -> None:
        """Count the wheel angles from zero, because samples were lost: nothing of before measures them any more."""
        self.replay_buffer.do(lambda: self._renew(sm.ANGLES, sigma_rad))

    def distrust_leg(self) -> None:
        """Do not use the odometry from the begin of the leg to the next fix to learn slip, creep and sensor errors."""
        self._is_trusted = False

    def encoder_walk(self, wheel: WheelAngle) -> float:
        """Growth of the variance of the angle per second by white rate noise; none for a counting encoder."""
        found = wheel.noise_rad2_s2
        variance = self._cfg.encoder_sigma_rad_s**2 if found is None else found
        return variance * self._full.encoder_period_s

    # -- rest and legs ------------------------------------------------------------------------------------------------

    def stop(self, angles: tuple[float, float]) -> None:
        """Zero-velocity update: the wheels stand at these angles (rad), which are set to zero."""
        full = self._full
        R = np.square((full.rest_speed_sigma_m_s, full.rest_acceleration_sigma_m_s2, full.rest_turn_sigma_rad_s))
        shift = np.zeros(sm.STATES)
        shift[sm.PR], shift[sm.PL] = -angles[0], -angles[1]
        rebase = sm.Affine(np.eye(sm.STATES), shift)
        if full.use.zero_velocity:
            self.replay_buffer.do(lambda: self._filter.update(np.zeros(3), _STOP_ROWS, R))
        self.replay_buffer.do(lambda: self._filter.predict(rebase, np.zeros((sm.STATES, sm.STATES))))

    def calibrate(self, reading: ZeroVelocityReading, rested_s: float, imu_variances: tuple[float, float]) -> None:
        """Update biases from the inertial unit's means over a rest of ``rested_s``, and the heading from gravity."""
        full, n = self._full, reading.samples
        Q = np.zeros((sm.STATES, sm.STATES))
        Q[sm.BG, sm.BG] = full.gyroscope_bias_walk_rad_s_sqrt_s**2 * rested_s
        Q[sm.BA, sm.BA] = full.accelerometer_bias_walk_m_s2_sqrt_s**2 * rested_s
        self.replay_buffer.do(lambda: self._filter.predict(np.eye(sm.STATES), Q))
        if full.use.rest_biases:
            H = np.zeros((2, sm.STATES))
            # v, a and w are zero since the stop, so that the scale error has no effect.
            H[0, sm.BG] = H[0, sm.W] = H[1, sm.BA] = H[1, sm.A] = 1.0
            z = np.array((reading.rate_rad_s, reading.acceleration_m_s2))
            R = np.array((imu_variances[0] / n, imu_variances[1] / n))
            self.replay_buffer.do(lambda: self._filter.update(z, H, R))
        if reading.gravity_count and full.use.gravity:
            self.replay_buffer.do(lambda: self._update_with_gravity(reading.bearing_rad, reading.gravity_count))

    def _update_with_gravity(self, bearing_rad: float, count: int) -> None:
        mean, full = self._filter.mean, self._full
        slope = self.slope()
        _, _, along = gravity_on(slope, float(mean[sm.PSI]), self._gravity_deck)
        tilt = sqrt(max(1.0 - along * along, 0.0))  # sine of the angle between the surface and the horizontal
        if tilt < full.gravity_least_tilt:
            return
        variance = (full.gravity_sigma_rad / tilt) ** 2 / count + full.gravity_floor_rad**2
        residual = difference(heading_from_gravity(bearing_rad, slope), float(mean[sm.PSI]))
        prior = float(self._filter.covariance[sm.PSI, sm.PSI])
        if residual * residual > full.gravity_gate**2 * (variance + prior):
            self._count("gravity_gated")
            return
        H = np.zeros((1, sm.STATES))
        H[0, sm.PSI] = 1.0
        self._filter.update(np.array([float(mean[sm.PSI]) + residual]), H, np.array([variance]))

    def begin_leg(self) -> None:
        """Predict slip and creep of the next leg from the legs so far."""
        if self._full.use.slip_per_leg:
            F, b, Q = np.eye(sm.STATES), np.zeros(sm.STATES), np.zeros((sm.STATES, sm.STATES))
            F[_SLIP_BLOCK], b[sm.SLIPS], Q[_SLIP_BLOCK] = self._legs.begin(self._filter.mean, self._filter.covariance)
            self.replay_buffer.do(lambda: self._filter.predict(sm.Affine(F, b), Q))
        self.replay_buffer.do(self._keep_calibration)

    def _keep_calibration(self) -> None:
        """Save the calibration at the begin and end of a leg, to restore it if the leg is found to be wrong."""
        mean, P = self._filter.mean, self._filter.covariance
        self._calibration = mean[sm.CALIBRATION], P[_CALIBRATION_BLOCK]

    def _restored(self, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The state with the saved calibration, uncorrelated with the rest, so that a fix corrects only the pose."""
        x, P = mean.copy(), covariance.copy()
        P[sm.CALIBRATION, :] = P[:, sm.CALIBRATION] = 0.0
        x[sm.CALIBRATION], P[_CALIBRATION_BLOCK] = self._calibration
        return x, P

    # -- seams --------------------------------------------------------------------------------------------------------

    def cross(self, transition: SensorTransition, t_s: float) -> None:
        """Update with a transition of an edge sensor; ``t_s``: time of the state."""
        full, filter_ = self._full, self._filter
        edge = self._seams.edge_of(transition, t_s, filter_.mean, self.slope()) if full.use.seams else None
        if edge is None:
            return

        def step() -> None:
            if edge.is_new:
                self._renew(edge.offset, full.edge_sigma_m)
            mean, P = filter_.mean, filter_.covariance
            residual, H, variance = self._seams.line(edge, transition, t_s, mean, self.slope())
            spread = variance + float(H[0].dot(P).dot(H[0]))
            is_used = residual * residual <= full.line_gate**2 * spread
            self._count("crossings_used" if is_used else "crossings_gated")
            if is_used:
                filter_.update(H.dot(mean) + residual, H, np.array([variance]))

        self.replay_buffer.do(step)

    def _renew(self, states: int | slice, sigma: float) -> None:
        """Reset states for another edge or panel: standard deviation ``sigma``, no correlations."""
        kept, variances = np.ones(sm.STATES), np.zeros(sm.STATES)
        kept[states], variances[states] = 0.0, sigma * sigma
        self._filter.predict(np.diag(kept), np.diag(variances))

    # -- fixes --------------------------------------------------------------------------------------------------------

    def fix(self, t_s: float, z: FloatArray, variance: FloatArray) -> int:
        """Update with the robot's origin at ``t_s``, deck frame, m (2,), and its covariance (2, 2); ends the leg.

        Returns the number of later entries that were replayed.
        """
        is_trusted, self._is_trusted = self._is_trusted, True
        if not is_trusted:
            self._legs.forget_leg()

        def step(late_s: float) -> None:
            if not is_trusted:
                self._filter.reset(*self._restored(self._filter.mean, self._filter.covariance))
            mean = self._filter.mean
            residual, H = fix_row(z, mean, self.slope(), late_s)
            innovation = self._filter.update(H.dot(mean) + residual, H, variance)
            if not self.replay_buffer.is_replaying:
                self.innovation = innovation
            self._keep_calibration()

        repeated = self.replay_buffer.take(t_s, step)
        self._legs.end(self._filter.mean, self._filter.covariance)
        return repeated

    def expect(self, t_s: float, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residual of a position (2,) against the estimate at ``t_s``, and the covariance of the estimate (2, 2)."""
        mean, P, late_s = self.replay_buffer.look(t_s)
        residual, H = fix_row(z, mean, self.terrain.at(float(mean[sm.X]), float(mean[sm.Y])), late_s)
        return residual, H.dot(P).dot(H.T)

    def relocate(
        self, residual: FloatArray, variance: FloatArray, turn_rad: float, *, is_lost: bool, again: bool
    ) -> None:
        """Move the estimate by ``residual`` (2,), with covariance ``variance`` (2, 2); see ``relocated``.

        ``turn_rad``: standard deviation added to the heading, at least ``relocated_heading_sigma_rad``. ``again``: no
        fix has agreed since the last relocation, so calibration and slip are reset, too. Raises ``FilterDiverged``: not
        finite.
        """
        mean, P = self._restored(self._filter.mean, self._filter.covariance)
        self._is_trusted = True
        heading_rad2 = max(self._full.relocated_heading_sigma_rad, turn_rad) ** 2
        x, P = relocated(mean, P, residual, variance, self._tilt_sigma_m**2, heading_rad2, is_lost=is_lost)
        self.replay_buffer.restart()
        self._seams.forget()
        self._legs.forget_leg()
        self.innovation = None
        if again:
            self._legs = SlipPrior(self._full)
            first, P_first = self._first(DeckPose(*x[sm.POSE].tolist()))
            place, tilt = sm.POSITION, sm.TILT
            P_first[place, place], P_first[sm.PSI, sm.PSI] = P[place, place], P[sm.PSI, sm.PSI]
            P_first[tilt, place], P_first[place, tilt] = P[tilt, place], P[place, tilt]
            x, P = first, P_first
        self._filter.reset(x, P)
        self._keep_calibration()
        self._panel = self._panel_below()

    def inflate_covariance(self, way_m: float, turn_rad: float) -> None:
        """Inflate the covariance of the pose by an unobserved motion; the next fix then corrects only the pose.

        The leg is not trusted; see ``distrust_leg``.
        """
        self.distrust_leg()
        Q = np.zeros((sm.STATES, sm.STATES))
        Q[sm.X, sm.X] = Q[sm.Y, sm.Y] = way_m * way_m
        Q[sm.PSI, sm.PSI] = turn_rad * turn_rad
        self._filter.predict(np.eye(sm.STATES), Q)


@dataclass(slots=True, eq=False)
class _Entry:
    """The state before some steps, its time after them, and how long the robot may have moved in them."""

    t_s: float
    dt_s: float
    mean: FloatArray
    covariance: FloatArray
    kept_s: float  # begin of the steps
    steps: list[Step] = field(default_factory=list)


class PastState(NamedTuple):
    """A state of the filter, mean (n,) and covariance (n, n), and how much later it is than wanted, s."""

    mean: FloatArray
    covariance: FloatArray
    late_s: float


class ReplayBuffer:
    """Executes the steps of a filter, and rewinds and replays them for late measurements, at most ``reach_s`` back.

    A filter replaces its arrays and never changes them, so a stored state costs only a reference.
    """

    def __init__(self, filter_: Filter, reach_s: float) -> None:
        self._filter = filter_
        self._reach_s = reach_s
        self._entries: list[_Entry] = []
        self.is_replaying = False

    @property
    def oldest_s(self) -> float:
        """The earliest time of a measurement that can be taken: the end of the first entry."""
        return self._entries[0].t_s if self._entries else float("-inf")

    def restart(self) -> None:
        """Drop all entries."""
        self._entries.clear()

    def begin(self, t_s: float, dt_s: float) -> None:
        """Begin the steps that advance the state to ``t_s``; the robot may have moved in the last ``dt_s`` of them."""
        entries, filter_ = self._entries, self._filter
        if dt_s == 0.0 and entries and entries[-1].dt_s == 0.0:
            entries[-1].t_s = t_s  # a standstill, however long, is one entry
            if entries[-1].kept_s < t_s - self._reach_s:
                # Drop the steps of a long standstill to bound the memory; the present state is as good as the one
                # before them.
                del entries[:-2]
                for entry in entries:
                    entry.kept_s = t_s
                    entry.mean = filter_.mean
                    entry.covariance = filter_.covariance
                    entry.steps.clear()
            return
        entries.append(_Entry(t_s, dt_s, filter_.mean, filter_.covariance, t_s))
        # At least two entries: a standstill may be longer than the reach, and its fix belongs to its beginning.
        while len(entries) > 2 and entries[1].t_s < t_s - self._reach_s:
            del entries[0]

    def do(self, step: Step) -> None:
        """Execute a step of the present entry, and store it."""
        if self._entries:
            self._entries[-1].steps.append(step)
        step()

    def look(self, t_s: float) -> PastState:
        """The first state not before ``t_s``."""
        later, late_s = self._since(t_s)
        at = later[0] if later else self._filter
        return PastState(at.mean, at.covariance, late_s)

    def _since(self, t_s: float) -> tuple[list[_Entry], float]:
        """The entries after the first state not before ``t_s``, and the time of motion from ``t_s`` to it, s."""
        entries, k = self._entries, len(self._entries)
        while k and entries[k - 1].t_s >= t_s - _SAME_TIME_S:
            k -= 1
        if k == len(entries):
            return [], 0.0
        home = entries[k]
        return entries[k + 1 :], min(max(home.t_s - t_s, 0.0), home.dt_s)

    def take(self, t_s: float, step: LateStep) -> int:
        """Apply ``step`` to the first state not before ``t_s``, and replay the later entries; returns their number."""
        later, late_s = self._since(t_s)
        filter_ = self._filter
        if later:
            filter_.reset(later[0].mean, later[0].covariance)
        step(late_s)
        if self._entries:
            self._entries[-1 - len(later)].steps.append(lambda: step(late_s))
        self.is_replaying = True
        try:
            for entry in later:
                entry.mean = filter_.mean
                entry.covariance = filter_.covariance
                for again in entry.steps:
                    again()
        finally:
            self.is_replaying = False
        return len(later)
