"""What is done to the full-state filter: steps of the motion, rests, legs, seams, fixes; and done again."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from math import sqrt

import numpy as np

from ccatp.config.models import LocalizerConfig, RobotConfig
from ccatp.core import DeckPose, FloatArray, PanelId, difference
from ccatp.estimation.fixes import fix_row, relocated
from ccatp.estimation.odometry import PreintegratedMotion, WheelAngle
from ccatp.estimation.rest import ZeroVelocityReading, heading_from_gravity
from ccatp.estimation.seams import Edge, SeamLines, SensorTransition
from ccatp.estimation.slip_prior import Redraw, SlipPrior
from ccatp.estimation.state_model import (
    BA,
    BG,
    E0,
    E1,
    KG,
    KL,
    PL,
    PR,
    PSI,
    SL,
    SR,
    STATES,
    TX,
    TY,
    A,
    Affine,
    C,
    SensorRows,
    Slope,
    SurveyMotion,
    Terrain,
    V,
    W,
    X,
    Y,
)
from ccatp.filters.base import Filter, Innovation
from ccatp.mirror.mirror import Mirror

_STOP_ROWS = np.eye(STATES)[[V, A, W]]
_DRAWN = [SR, SL, C]
_WHERE_DRAWN = np.ix_(_DRAWN, _DRAWN)

Step = Callable[[], object]
LateStep = Callable[[float], None]
"""A step that belongs to a moment before the state's: gets by how much, s."""
_SAME_TIME_S = 1e-6


class SurveyFilter:
    """The filter of ``STATES`` states, the model and the journal of steps for the replay after a late fix (``_do``)."""

    def __init__(
        self,
        filter_: Filter,
        mirror: Mirror,
        robot: RobotConfig,
        cfg: LocalizerConfig,
        counts: dict[str, int],
        start: DeckPose,
    ) -> None:
        self.innovation: Innovation | None = None
        self.journal = ReplayBuffer(cfg.full_state.rewind_s)
        self._filter, self._counts = filter_, counts
        self._is_again = False
        self._cfg, self._full = cfg, cfg.full_state
        self._mirror, self.terrain = mirror, Terrain(mirror)
        self._motion = SurveyMotion(robot.wheel_radius_m, robot.wheel_base_m)
        self._rows = SensorRows()
        self._drift = np.zeros(STATES)
        self._seams = SeamLines(mirror, robot)
        self._legs = SlipPrior(self._full)
        self._tilt_sigma_m = robot.puck_height_m * cfg.full_state.panel_tilt_sigma_rad
        self._gravity_deck = mirror.rotate_deck_from_world((0.0, 0.0, 1.0))
        self._filter.reset(*self._first(start))
        self._panel = self._panel_below()

    def _first(self, pose: DeckPose) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of who knows a pose and nothing else."""
        cfg, full = self._cfg, self._full
        mean, sigma = np.zeros(STATES), np.zeros(STATES)
        mean[[X, Y, PSI]] = pose.x_m, pose.y_m, pose.heading_rad
        mean[BG] = cfg.gyroscope_bias_rad_s
        sigma[[X, Y]] = cfg.start_position_sigma_m
        sigma[PSI] = cfg.start_heading_sigma_rad
        sigma[[V, A, W]] = cfg.reset_speed_sigma_m_s, cfg.reset_acceleration_sigma_m_s2, cfg.reset_rate_sigma_rad_s
        sigma[BG], sigma[KG] = full.gyroscope_bias_sigma_rad_s, full.gyroscope_scale_sigma
        sigma[BA], sigma[KL] = full.accelerometer_bias_sigma_m_s2, full.wheel_base_sigma
        sigma[[E0, E1]], sigma[[TX, TY]] = full.edge_sigma_m, self._tilt_sigma_m
        P = np.diag(sigma**2)
        mean[_DRAWN], P[_WHERE_DRAWN] = self._legs.first()
        return mean, P

    def slope(self) -> Slope:
        """The ground under the estimated position."""
        mean = self._filter.mean
        return self.terrain.at(float(mean[X]), float(mean[Y]))

    def _count(self, what: str) -> None:
        self._counts[what] += not self._is_again

    def begin(self, t_s: float, dt_s: float) -> None:
        """Steps follow that bring the state to ``t_s``; the robot may have moved in the last ``dt_s`` of it."""
        self.journal.begin(t_s, dt_s, self._filter)

    def _do(self, step: Step) -> None:
        self.journal.add(step)
        step()

    # -- motion -------------------------------------------------------------------------------------------------------

    def move(
        self, block: PreintegratedMotion, right: WheelAngle, left: WheelAngle, imu_variances: tuple[float, float]
    ) -> None:
        """A block of frames.

        Predict, then update with wheel angles, angular rate and acceleration, where they were read.
        """
        dt_s = block.dt_s
        slip, creep = self._legs.wander(block.turning_s) if dt_s > 0.0 else (0.0, 0.0)
        encoders = self.encoder_walk(right) * dt_s
        counts = rate = acceleration = None
        if right.is_fresh or left.is_fresh:
            gap_rad = right.take_gap() + left.take_gap()
            variance = max(right.variance_rad2(), left.variance_rad2()) + gap_rad * gap_rad
            counts = right.angle_rad, left.angle_rad, variance
        if block.rate_rad_s is not None:
            rate = block.rate_rad_s, imu_variances[0] / block.samples
        if block.acceleration_m_s2 is not None and self._full.use.accelerometer:
            # Set points jump, and the acceleration with them, anywhere between two samples.
            jump = self._full.acceleration_jump_m_s2**2
            acceleration = block.acceleration_m_s2, imu_variances[1] / block.samples + jump

        def step() -> None:
            if dt_s > 0.0:
                self._predict(dt_s, slip, creep, encoders)
            rows = self._rows.take(counts, rate, acceleration)
            if rows.z.size:
                self._filter.update(rows.z, rows, rows.R)

        self._do(step)
        self._enter()

    def _enter(self) -> None:
        panel = self._panel_below()
        if panel != self._panel:
            self._panel = panel
            self._do(lambda: self._renew([TX, TY], self._tilt_sigma_m))

    def _panel_below(self) -> PanelId:
        mean = self._filter.mean
        return self._mirror.nearest_panel(float(mean[X]), float(mean[Y]))

    def _predict(self, dt_s: float, slip: float, creep: float, encoders: float) -> None:
        full, mean = self._full, self._filter.mean
        motion = self._motion.over(dt_s, self.terrain.at(float(mean[X]), float(mean[Y])))
        jerk, twist = full.jerk_density_m2_s5 * dt_s, full.angular_acceleration_density_rad2_s3 * dt_s
        impulses = np.array((jerk, twist, slip, slip, creep))
        drift = self._drift  # work space, of which the model keeps nothing
        drift[BG] = full.gyroscope_bias_walk_rad_s_sqrt_s**2 * dt_s
        drift[BA] = full.accelerometer_bias_walk_m_s2_sqrt_s**2 * dt_s
        drift[PR] = drift[PL] = encoders
        self._filter.predict(motion, motion.noise(mean, impulses, drift))

    def encoder_walk(self, wheel: WheelAngle) -> float:
        """Growth of the summed angle's error per second: white rate noise, none where a counter counts."""
        found = wheel.noise_rad2_s2
        variance = self._cfg.encoder_sigma_rad_s**2 if found is None else found
        return variance * self._full.encoder_period_s

    # -- rest and legs ------------------------------------------------------------------------------------------------

    def stop(self, angles: tuple[float, float]) -> None:
        """The wheels stand, at these angles (rad): no speed, no acceleration, no rate; they count from here."""
        full = self._full
        sigma = full.rest_speed_sigma_m_s, full.rest_acceleration_sigma_m_s2, full.rest_turn_sigma_rad_s
        R = np.square(sigma)
        shift = np.zeros(STATES)
        shift[PR], shift[PL] = -angles[0], -angles[1]
        if full.use.zero_velocity:
            self._do(lambda: self._filter.update(np.zeros(3), _STOP_ROWS, R))
        self._do(lambda: self._filter.predict(Affine.shift(shift), np.zeros((STATES, STATES))))

    def calibrate(self, reading: ZeroVelocityReading, rested_s: float, imu_variances: tuple[float, float]) -> None:
        """Biases from the inertial unit's means over a rest of ``rested_s``, heading from gravity."""
        full, n = self._full, reading.samples
        Q = np.zeros((STATES, STATES))
        Q[BG, BG] = full.gyroscope_bias_walk_rad_s_sqrt_s**2 * rested_s
        Q[BA, BA] = full.accelerometer_bias_walk_m_s2_sqrt_s**2 * rested_s
        self._do(lambda: self._filter.predict(np.eye(STATES), Q))
        if full.use.rest_biases:
            H = np.zeros((2, STATES))
            # v, a and w stay what the stop made of them; the scale error acts on a rate of zero.
            H[0, BG] = H[0, W] = H[1, BA] = H[1, A] = 1.0
            z = np.array((reading.rate_rad_s, reading.acceleration_m_s2))
            R = np.array((imu_variances[0] / n, imu_variances[1] / n))
            self._do(lambda: self._filter.update(z, H, R))
        if reading.gravity_count and full.use.gravity:
            self._do(lambda: self._feel_gravity(reading.bearing_rad, reading.gravity_count))

    def _feel_gravity(self, bearing_rad: float, count: int) -> None:
        mean, full = self._filter.mean, self._full
        slope = self.slope()
        tilt = self._tilt(slope.fx, slope.fy)
        if tilt < full.gravity_least_tilt:
            return
        variance = (full.gravity_sigma_rad / tilt) ** 2 / count + full.gravity_floor_rad**2
        residual = difference(heading_from_gravity(bearing_rad, slope), float(mean[PSI]))
        prior = float(self._filter.covariance[PSI, PSI])
        if residual * residual > full.gravity_gate**2 * (variance + prior):
            self._count("gravity_gated")
            return
        H = np.zeros((1, STATES))
        H[0, PSI] = 1.0
        self._filter.update(np.array([float(mean[PSI]) + residual]), H, np.array([variance]))

    def _tilt(self, fx: float, fy: float) -> float:
        """Sine of the angle between the surface and the horizontal."""
        gx, gy, gz = self._gravity_deck
        along = (gz - fx * gx - fy * gy) / sqrt(1.0 + fx * fx + fy * fy)
        return sqrt(max(1.0 - along * along, 0.0))

    def begin_leg(self) -> None:
        """Slip and creep of the coming leg, from the legs so far."""
        if self._full.use.slip_per_leg:
            redraw = self._legs.begin(self._filter.mean, self._filter.covariance)
            self._do(lambda: self._redraw(redraw))

    def _redraw(self, redraw: Redraw) -> None:
        F, Q, offset = np.eye(STATES), np.zeros((STATES, STATES)), np.zeros(STATES)
        F[_WHERE_DRAWN], Q[_WHERE_DRAWN] = redraw.F, redraw.Q
        offset[_DRAWN] = redraw.mean - redraw.F.dot(redraw.found)
        self._filter.predict(Affine(F, offset), Q)

    def end_leg(self) -> None:
        """A fix has been fused at the leg's end."""
        self._legs.end(self._filter.mean, self._filter.covariance)

    # -- seams --------------------------------------------------------------------------------------------------------

    def cross(self, transition: SensorTransition, t_s: float) -> None:
        """An edge sensor has changed its value; the state belongs to ``t_s``."""
        if not self._full.use.seams:
            return
        edge = self._seams.meet(transition, t_s, self._filter.mean, self.slope())
        if edge is not None:
            self._do(lambda: self._use_line(edge, transition, t_s))

    def _use_line(self, edge: Edge, transition: SensorTransition, t_s: float) -> None:
        if edge.is_new:
            self._renew([edge.offset], self._full.edge_sigma_m)
        mean, P = self._filter.mean, self._filter.covariance
        residual, H, variance = self._seams.line(edge, transition, t_s, mean, self.slope())
        spread = variance + float(H[0].dot(P).dot(H[0]))
        is_used = residual * residual <= self._full.line_gate**2 * spread
        self._count("crossings_used" if is_used else "crossings_gated")
        if is_used:
            self._filter.update(H.dot(mean) + residual, H, np.array([variance]))

    def _renew(self, states: list[int], sigma: float) -> None:
        """States are given to other edges or panels: nothing known of them, nothing correlated."""
        F, Q = np.eye(STATES), np.zeros((STATES, STATES))
        F[states, states] = 0.0
        Q[states, states] = sigma * sigma
        self._filter.predict(F, Q)

    # -- fixes --------------------------------------------------------------------------------------------------------

    def fix(self, t_s: float, z: FloatArray, variance: FloatArray) -> int:
        """The robot's origin at ``t_s``, deck, m (2,), and its covariance (2, 2).

        Returns how many steps were repeated after it.
        """
        found: list[Innovation] = []

        def step(late_s: float) -> None:
            innovation = self._use_fix(z, variance, late_s)
            if not found:
                found.append(innovation)

        self._is_again = True
        try:
            count = self.journal.take(t_s, step, self._filter)
        finally:
            self._is_again = False
        self.innovation = found[0]
        return count

    def _use_fix(self, z: FloatArray, variance: FloatArray, late_s: float) -> Innovation:
        mean = self._filter.mean
        residual, H = self._fix_row(z, mean, late_s)
        return self._filter.update(H.dot(mean) + residual, H, variance)

    def _fix_row(self, z: FloatArray, mean: FloatArray, late_s: float) -> tuple[FloatArray, FloatArray]:
        return fix_row(z, mean, self.terrain.at(float(mean[X]), float(mean[Y])), late_s)

    def fix_residual(self, t_s: float, z: FloatArray) -> FloatArray:
        """How far a position (2,) lies from what the filter held for true at ``t_s``."""
        mean, _, late_s = self.journal.look(t_s, self._filter)
        return self._fix_row(z, mean, late_s)[0]

    def is_gated(self, t_s: float, z: FloatArray, variance: FloatArray) -> bool:
        """Whether a position contradicts the estimate of its own time."""
        mean, P, late_s = self.journal.look(t_s, self._filter)
        residual, H = self._fix_row(z, mean, late_s)
        S = H.dot(P).dot(H.T) + variance
        return float(residual.dot(np.linalg.solve(S, residual))) > self._full.fix_gate_nis

    def relocate(
        self,
        t_s: float,
        z: FloatArray,
        variance: FloatArray,
        *,
        is_lost: bool,
        turn_rad: float = 0.0,
        again: bool = False,
    ) -> None:
        """Begin again from a position (2,) measured at ``t_s``, and its covariance (2, 2); see ``relocated``.

        The heading is doubted by ``turn_rad``, and never by less than a set angle. ``again``: what was learned of the
        sensors and of slip since the last time was misleading, and is forgotten, too. Raises ``FilterDiverged``: not
        finite.
        """
        residual = self.fix_residual(t_s, z)
        mean, P = self._filter.mean, self._filter.covariance
        heading_rad2 = max(self._full.relocated_heading_sigma_rad, turn_rad) ** 2
        x, P = relocated(mean, P, residual, variance, self._tilt_sigma_m**2, heading_rad2, is_lost=is_lost)
        self.journal.restart()
        self._seams.forget()
        self._legs.forget_leg()
        self.innovation = None
        if again:
            self._legs = SlipPrior(self._full)
            first, P_first = self._first(DeckPose(float(x[X]), float(x[Y]), float(x[PSI])))
            P_first[:2, :2], P_first[PSI, PSI] = P[:2, :2], P[PSI, PSI]
            for i in (TX, TY):
                P_first[i, :2] = P_first[:2, i] = P[i, :2]
            x, P = first, P_first
        self._filter.reset(x, P)
        self._panel = self._panel_below()

    def inflate_covariance(self, way_m: float, turn_rad: float) -> None:
        """The robot may have gone this far, and turned, without anyone looking."""
        Q = np.zeros((STATES, STATES))
        Q[X, X] = Q[Y, Y] = way_m * way_m
        Q[PSI, PSI] = turn_rad * turn_rad
        self._filter.predict(np.eye(STATES), Q)


@dataclass(slots=True, eq=False)
class _Entry:
    """The state before some steps, the time to which they bring it, and how long the robot may have moved in them."""

    t_s: float
    dt_s: float
    mean: FloatArray
    covariance: FloatArray
    kept_s: float  # the steps are those since then
    steps: list[Step] = field(default_factory=list)


class ReplayBuffer:
    """Rewind and replay of late measurements, at most ``reach_s`` back.

    A filter replaces its arrays and never changes them, so keeping a state costs a reference.
    """

    def __init__(self, reach_s: float) -> None:
        self._reach_s = reach_s
        self._entries: deque[_Entry] = deque()

    @property
    def oldest_s(self) -> float:
        """The earliest time at which a measurement can still be taken: from the end of the first entry on."""
        return self._entries[0].t_s if self._entries else float("-inf")

    def restart(self) -> None:
        """The robot's clock has jumped."""
        self._entries.clear()

    def begin(self, t_s: float, dt_s: float, filter_: Filter) -> None:
        """Steps follow that bring the state to ``t_s``; the robot may have moved during the last ``dt_s`` of it."""
        entries = self._entries
        if dt_s == 0.0 and entries and entries[-1].dt_s == 0.0:
            entries[-1].t_s = t_s  # a standstill, however long, is one entry
            if entries[-1].kept_s < t_s - self._reach_s:
                # Forget how the state of a long standstill came about: nothing grows however long the robot stands,
                # and the present state is as good as the one before the steps.
                while len(entries) > 2:
                    entries.popleft()
                for entry in entries:
                    entry.kept_s, entry.mean, entry.covariance = t_s, filter_.mean, filter_.covariance
                    entry.steps.clear()
            return
        entries.append(_Entry(t_s, dt_s, filter_.mean, filter_.covariance, t_s))
        # Two entries at least: a standstill may outlast the reach, and its beginning is where its fix belongs.
        while len(entries) > 2 and entries[1].t_s < t_s - self._reach_s:
            entries.popleft()

    def add(self, step: Step) -> None:
        """Keep a step of the present entry."""
        if self._entries:
            self._entries[-1].steps.append(step)

    def look(self, t_s: float, filter_: Filter) -> tuple[FloatArray, FloatArray, float]:
        """The first state not before ``t_s``: its mean, its covariance, and by how much it is later, s."""
        count, late_s = self._home(t_s)
        if count > 1:
            later = self._entries[1 - count]
            return later.mean, later.covariance, late_s
        return filter_.mean, filter_.covariance, late_s

    def _home(self, t_s: float) -> tuple[int, float]:
        """How many entries are not before ``t_s``, and how much motion lies between it and the end of the first."""
        entries, count = self._entries, 0
        while count < len(entries) and entries[-1 - count].t_s >= t_s - _SAME_TIME_S:
            count += 1
        if not count:
            return 0, 0.0
        home = entries[-count]
        return count, min(max(home.t_s - t_s, 0.0), home.dt_s)

    def take(self, t_s: float, step: LateStep, filter_: Filter) -> int:
        """Do ``step`` to the first state not before ``t_s`` and everything later again.

        Returns the number of repeated entries.
        """
        entries = self._entries
        count, late_s = self._home(t_s)
        later = [entries[k] for k in range(len(entries) - count + 1, len(entries))] if count else []
        if later:
            filter_.reset(later[0].mean, later[0].covariance)
        step(late_s)
        if entries:
            entries[-max(count, 1)].steps.append(lambda: step(late_s))
        for entry in later:
            entry.mean, entry.covariance = filter_.mean, filter_.covariance
            for again in entry.steps:
                again()
        return len(later)
