"""The posterior Cramér-Rao bound of the position at the stops of a mission, computed from the ground truth.

No estimator can have a smaller mean square error than the inverse of the Bayesian information. For a Markov process the
recursion of Tichavský, Muravchik and Nehorai (1998) gives this information for each step. With Gaussian noises it is
the recursion of an extended Kalman filter with Jacobians at the true state and covariances of the true world. The
measurements are those of the robot: wheel angles, angular rate, crossings of seams, fixes, and that the robot is at
rest while its wheels are. No value comes from an estimator's configuration.

Approximations:

* uniform distributions (slip of a leg, counts) are replaced by Gaussians of the same variance;
* the true path replaces the expectation over paths: one run represents all runs with the same route;
* the jitter of the position and the transport of the heading by the curvature are not in the Jacobians (1e-3 of their
  terms);
* gravity is left out: with 2 degrees of noise on these slopes it gives less information about the heading than one pair
  of fixes;
* the accelerometer is left out by default: it measures the slip while the speed changes, so an estimator that uses it
  can have a smaller error than the bound without it;
* only the last ``_SLOTS`` panel edges and tilts are kept in the state; one that is met again later counts as unknown.
"""

from array import array
from collections import OrderedDict, defaultdict
from collections.abc import Hashable
from math import exp, pi, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.config.models import Config, WorldConfig
from ccatp.core import Fix, FloatArray, PanelId, PointId
from ccatp.estimation.fixes import deck_foot
from ccatp.estimation.localizer_base import EdgeScanner, SensorTransition
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import Mirror
from ccatp.sim.plant import LEG_PAUSE_S, LEVEL_SLOPE
from ccatp.studies.sil_run import SilRun
from ccatp.survey.fix_review import ReviewedFix

# -- the record: true path, seams, fixes -------------------------------------------------------------------------------


(
    WAY_T, WAY_X, WAY_Y, WAY_HX, WAY_HY, WAY_LX, WAY_LY, WAY_FX, WAY_FY, WAY_RIGHT, WAY_LEFT, WAY_RIGHT_SCALE,
    WAY_LEFT_SCALE, WAY_ORDERED,
) = range(14)  # fmt: skip
"""Columns of the true way.

T: time, s. X, Y: robot origin, deck frame, m. HX, HY, LX, LY: deck components of the robot's x and y axes. FX, FY:
slopes of the surface. RIGHT, LEFT: wheel angles since boot, rad. RIGHT_SCALE, LEFT_SCALE: travel of the body over
travel of the nominal wheel in the frame that ends here. ORDERED: 1 where a set point of that frame was not zero.
"""
WAY_COLUMNS = 14


class SeamPass(NamedTuple):
    """A change of an edge sensor's value at a panel's edge."""

    frame: int  # index of the row that ends the frame of the change
    corner: int
    interval_s: float
    axis: int  # deck axis across the edge: 0 or 1
    edge: tuple[int, PanelId, bool]  # axis, panel, and whether it is the panel's edge on the high side


class StopFix(NamedTuple):
    """A fix at rest."""

    frame: int
    point: PointId | None  # None if the fix was not for a point
    panel: PanelId
    covariance_m2: FloatArray  # of the puck's foot (x, y), deck frame, from the lengths alone, shape (2, 2)
    error_m: tuple[float, float]  # true minus estimated position before the fix (x, y)


class TrueRecord(NamedTuple):
    """Ground truth of one mission; ``way``: a row per frame since boot, columns ``WAY_...``, shape (k, 14)."""

    way: FloatArray
    passes: tuple[SeamPass, ...]
    fixes: tuple[StopFix, ...]
    base_m: float


class RecordedSilRun(SilRun):
    """A mission with a record of the ground truth; it uses the same random numbers as without."""

    def __init__(self, cfg: Config) -> None:
        super().__init__(cfg)
        self._way = array("d")
        self._scanner = EdgeScanner()
        self._transitions: list[SensorTransition] = []
        self._fixes: list[StopFix] = []

    def record(self) -> TrueRecord:
        """The record so far."""
        way = np.frombuffer(self._way, dtype=np.float64).reshape(-1, WAY_COLUMNS).copy()
        return TrueRecord(way, self._passes(way), tuple(self._fixes), self.robot.world.wheels.base_m)

    def _passes(self, way: FloatArray) -> tuple[SeamPass, ...]:
        """Edges of the transitions, found on the true path, whose first row is at t = 0; without those at the rim."""
        mirror = self.mirror
        found = []
        for transition in self._transitions:
            at = transition.t_s / self.robot.frame_s
            frame = min(int(np.ceil(at - 1e-9)), len(way) - 1)
            part = at - (frame - 1)
            row = way[frame - 1] + part * (way[frame] - way[frame - 1])
            ahead, left = self.cfg.robot.edge_sensors_m[transition.corner]
            x_m = float(row[WAY_X] + ahead * row[WAY_HX] + left * row[WAY_LX])
            y_m = float(row[WAY_Y] + ahead * row[WAY_HY] + left * row[WAY_LY])
            seam = mirror.nearest_seam(x_m, y_m)
            if seam is None:
                continue
            panel = mirror.panels[mirror.nearest_panel(x_m, y_m)]
            axis, beyond_m = (0, x_m - panel.x_m) if seam.axis == "x" else (1, y_m - panel.y_m)
            edge = axis, panel.id, beyond_m > 0.0
            found.append(SeamPass(frame, transition.corner, transition.interval_s, axis, edge))
        return tuple(found)

    def _note_truth(self) -> None:
        super()._note_truth()
        p = self.robot.world.plant
        right_set, _, left_set, _ = p.servo
        self._way.extend(
            (
                self.robot.t_s, p.x_m, p.y_m, p.hx, p.hy, p.lx, p.ly, p.fx, p.fy, p.right_angle_rad, p.left_angle_rad,
                p.right_scale, p.left_scale, float(right_set != 0.0 or left_set != 0.0),
            )
        )  # fmt: skip

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        self._transitions += self._scanner.scan(frame.edge)
        super()._serve(frame, dt_s)

    def _fuse(self, fix: Fix) -> ReviewedFix:
        plant, deck = self.robot.world.plant, self.localizer.deck_pose
        panel = self.mirror.nearest_panel(plant.x_m, plant.y_m)
        covariance = deck_foot(self.mirror, fix, self.cfg.robot.puck_height_m).covariance_m2
        error_m = plant.x_m - deck.x_m, plant.y_m - deck.y_m
        row = len(self._way) // WAY_COLUMNS - 1
        found = super()._fuse(fix)
        if not found.doubt:
            self._fixes.append(StopFix(row, self.mission.state.measuring_point, panel, covariance, error_m))
        return found


# -- the bound ---------------------------------------------------------------------------------------------------------

(X, Y, PSI, BG, KG, BA, SR, SL, UR, UL, RR, RL, KL, C, ER, ER0, EL, EL0, J, J0, JA, JA0) = range(22)
"""Order of the state.

X, Y, PSI: pose. BG, KG, BA: gyroscope bias and scale, accelerometer bias. SR, SL: slip drawn for the leg. UR, UL: slip
that wanders. RR, RL, KL: errors of the radii and of the base. C: wandering part of the creep. ER, EL: error of the
measured wheel angle, ER0, EL0: a frame before. J, JA: jitter of the heading (rad) and of the speed's change (m/s^2),
J0, JA0: a frame before.
"""
_OWN = 22
_SLOTS = 12  # for the edges of the seams around one panel, and the tilts of two panels
_STATES = _OWN + _SLOTS
_UNIFORM = 1.0 / 12.0  # variance of a uniform distribution over one interval
_STILL_M = 1e-7  # largest travel of a wheel in a frame at rest


def bounds_of(cfg: Config, mirror: Mirror, record: TrueRecord, *, with_accelerometer: bool = False) -> list[FloatArray]:
    """Bound of the covariance of (x, y) before each fix of a run, m^2, each of shape (2, 2)."""
    return _Recursion(cfg, mirror, record, with_accelerometer).run()


class _Recursion:
    def __init__(self, cfg: Config, mirror: Mirror, record: TrueRecord, with_accelerometer: bool) -> None:
        world = cfg.world
        self._cfg, self._world, self._record, self._with_accelerometer = cfg, world, record, with_accelerometer
        self._radius_m, self._base_m = cfg.robot.wheel_radius_m, record.base_m
        self._frame_s = 1.0 / cfg.sim.robot.frame_hz
        rows = record.way
        self._right_m, self._left_m = (
            np.concatenate([np.zeros(1), np.diff(rows[:, angle])]) * self._radius_m * rows[:, scale]
            for angle, scale in ((WAY_RIGHT, WAY_RIGHT_SCALE), (WAY_LEFT, WAY_LEFT_SCALE))
        )
        self._turn_rad = (self._right_m - self._left_m) / record.base_m
        self._downhill = _downhill_of(mirror, record.way)
        self._jitter_m = world.vibration_speed_m_s * self._frame_s / sqrt(2.0)
        self._jitter_rad = world.vibration_rate_rad_s * self._frame_s / sqrt(2.0)
        self._nuisance: OrderedDict[Hashable, int] = OrderedDict()
        self._shift, self._fresh = _shift_of(world, cfg.sim.robot.encoder_hz, self._frame_s)
        self._P = _start_of(world)
        self._F = np.eye(_STATES)
        self._ordered_s = -np.inf

    def run(self) -> list[FloatArray]:
        record = self._record
        passes: defaultdict[int, list[SeamPass]] = defaultdict(list)
        fixes: defaultdict[int, list[StopFix]] = defaultdict(list)
        for one in record.passes:
            passes[one.frame].append(one)
        for fix in record.fixes:
            fixes[fix.frame].append(fix)
        still = (np.abs(self._right_m) < _STILL_M) & (np.abs(self._left_m) < _STILL_M)
        resting = 0
        found: list[FloatArray] = []
        for k in range(1, len(record.way)):
            resting += bool(still[k])
            if resting and (k in fixes or not still[k]):
                self._rest(resting)
                resting = 0
            if not still[k]:
                self._redraw_if_ordered(k)
                self._advance(k)
            for one in passes.get(k, ()):
                self._cross(one)
            for fix in fixes.get(k, ()):
                found.append(self._P[:2, :2].copy())
                self._fix(fix)
        return found

    # -- motion -------------------------------------------------------------------------------------------------------

    def _redraw_if_ordered(self, k: int) -> None:
        """Renew the slips at the beginning of a leg."""
        row = self._record.way[k]
        if not row[WAY_ORDERED]:
            return
        begun_s = float(row[WAY_T]) - self._frame_s
        if begun_s - self._ordered_s >= LEG_PAUSE_S - 1e-6:
            variance = (self._world.slip_max - self._world.slip_min) ** 2 * _UNIFORM
            self._renew(SR, variance)
            self._renew(SL, variance)
        self._ordered_s = float(row[WAY_T])

    def _advance(self, k: int) -> None:
        """One frame in which the wheels turn, with the measurements of the inertial unit at its end."""
        self._P = self._shift.dot(self._P).dot(self._shift.T)
        self._P.flat[:: _STATES + 1] += self._fresh
        right, left, turn = float(self._right_m[k]), float(self._left_m[k]), float(self._turn_rad[k])
        forward = 0.5 * (right + left)
        base_m, dt_s, radius_m = self._base_m, self._frame_s, self._radius_m
        _, _, _, hx, hy, lx, ly, *_ = self._record.way[k].tolist()
        gx, gy = self._downhill[k]
        per_right = _per_parameter(right, radius_m, float(self._record.way[k, WAY_RIGHT_SCALE]))
        per_left = _per_parameter(left, radius_m, float(self._record.way[k, WAY_LEFT_SCALE]))
        # Derivatives of forward travel and turn by the parameters of each wheel, and of the turn by the base.
        ahead, swing = np.zeros(_STATES), np.zeros(_STATES)
        for states, per, sign in ((_RIGHT_STATES, per_right, 1.0), (_LEFT_STATES, per_left, -1.0)):
            ahead[states] = 0.5 * per
            swing[states] = sign / base_m * per
        swing[KL] = -turn
        creep = self._world.creep_fraction if forward >= 0.0 else -self._world.creep_fraction
        F = self._F
        F[:3] = 0.0
        F[X, X] = F[Y, Y] = F[PSI, PSI] = 1.0
        F[X] += (hx + creep * gx) * ahead + 0.5 * forward * lx * swing
        F[Y] += (hy + creep * gy) * ahead + 0.5 * forward * ly * swing
        F[PSI] += swing
        F[X, PSI] += forward * lx
        F[Y, PSI] += forward * ly
        F[X, C], F[Y, C] = abs(forward) * gx, abs(forward) * gy
        rate = swing / dt_s
        rate[BG], rate[KG] = 1.0, turn / dt_s
        rate[J], rate[J0] = 1.0 / dt_s, -1.0 / dt_s
        rows, variances = [rate], [self._world.gyroscope_sigma_rad_s**2]
        if self._with_accelerometer:
            period_s = float(self._record.way[1, WAY_T] - self._record.way[0, WAY_T])
            push = np.zeros(_STATES)
            for states, change_m in (
                ([SR, UR, RR], right - float(self._right_m[k - 1])),
                ([SL, UL, RL], left - float(self._left_m[k - 1])),
            ):
                half = 0.5 * (change_m / period_s**2)
                push[states] = -half, -half, half
            push[BA], push[JA], push[JA0] = 1.0, 1.0, -1.0
            rows.append(push)
            variances.append(self._world.accelerometer_sigma_m_s2**2)
        # The rate's row depends on the parameters only, which the motion does not change, so it may be used after it.
        self._P = F.dot(self._P).dot(F.T)
        for row, variance in zip(rows, variances, strict=True):
            self._update(row, variance)

    def _rest(self, frames: int) -> None:
        """All frames of a rest together: the varying errors change, and the inertial unit measures its biases."""
        P, world, rest_s = self._P, self._world, frames * self._frame_s
        for state, sigma, time_s in _wanderers(world):
            keep = exp(-rest_s / time_s)
            P[state, :] *= keep
            P[:, state] *= keep
            P[state, state] += sigma * sigma * (1.0 - keep * keep)
        P[BG, BG] += world.gyroscope_bias_walk_rad_s_sqrt_s**2 * rest_s
        P[BA, BA] += world.accelerometer_bias_walk_m_s2_sqrt_s**2 * rest_s
        # A mean of differences of jitter: only the first and the last remain.
        rate = np.zeros(_STATES)
        rate[BG] = 1.0
        jitter = 2.0 * (self._jitter_rad / rest_s) ** 2
        self._update(rate, world.gyroscope_sigma_rad_s**2 / frames + jitter)
        if self._with_accelerometer:
            push = np.zeros(_STATES)
            push[BA] = 1.0
            self._update(push, world.accelerometer_sigma_m_s2**2 / frames + (_push_sigma(world) / frames) ** 2 * 2.0)

    # -- measurements -------------------------------------------------------------------------------------------------

    def _cross(self, one: SeamPass) -> None:
        ahead, left = self._cfg.robot.edge_sensors_m[one.corner]
        row = self._record.way[one.frame]
        hx, hy, lx, ly = row[WAY_HX : WAY_LY + 1].tolist()
        turned = ahead * (lx, ly)[one.axis] - left * (hx, hy)[one.axis]
        moved_m = row[[WAY_X, WAY_Y]] - self._record.way[one.frame - 1][[WAY_X, WAY_Y]]
        speed_m_s = (float(moved_m[one.axis]) + float(self._turn_rad[one.frame]) * turned) / self._frame_s
        H = np.zeros(_STATES)
        H[X + one.axis], H[PSI] = 1.0, turned
        H[self._slot(one.edge, self._world.panel_edge_sigma_m**2)] = -1.0
        jitter = (self._jitter_rad * turned) ** 2 + (self._jitter_m * (hx, hy)[one.axis]) ** 2
        self._update(H, (speed_m_s * one.interval_s) ** 2 * _UNIFORM + jitter)

    def _fix(self, fix: StopFix) -> None:
        """Update by the position of the puck's foot, with errors by the tilt of the panel and the puck's height."""
        tilt = (self._cfg.robot.puck_height_m * self._cfg.sim.truth.tilt_sigma_rad) ** 2
        H = np.zeros((2, _STATES))
        H[0, X] = H[1, Y] = 1.0
        H[0, self._slot(("tip", fix.panel), tilt)] = 1.0
        H[1, self._slot(("tilt", fix.panel), tilt)] = 1.0
        P = self._P
        gain = np.linalg.solve(H.dot(P).dot(H.T) + fix.covariance_m2, H.dot(P)).T
        keep = np.eye(_STATES) - gain.dot(H)
        self._P = keep.dot(P).dot(keep.T) + gain.dot(fix.covariance_m2).dot(gain.T)

    def _update(self, row: FloatArray, variance: float) -> None:
        P = self._P
        PH = P.dot(row)
        P -= np.outer(PH / (float(row.dot(PH)) + variance), PH)

    def _slot(self, key: Hashable, variance: float) -> int:
        """State index of an edge or a tilt; a new one replaces the least recently used one."""
        known = self._nuisance
        if key in known:
            known.move_to_end(key)
            return known[key]
        state = _OWN + len(known) if len(known) < _SLOTS else known.popitem(last=False)[1]
        known[key] = state
        self._renew(state, variance)
        return state

    def _renew(self, state: int, variance: float) -> None:
        self._P[state, :] = 0.0
        self._P[:, state] = 0.0
        self._P[state, state] = variance


_RIGHT_STATES = [SR, UR, RR, ER, ER0]
_LEFT_STATES = [SL, UL, RL, EL, EL0]


def _per_parameter(travel_m: float, radius_m: float, scale: float) -> FloatArray:
    """Derivatives of a wheel's travel by its slips, its radius error, and the errors of its two angles, shape (5,)."""
    nominal_m, m_per_rad = travel_m / scale, radius_m * scale
    return np.array((-nominal_m, -nominal_m, travel_m, -m_per_rad, m_per_rad))


def _downhill_of(mirror: Mirror, rows: FloatArray) -> FloatArray:
    """Deck components of the unit vector downhill at each row, shape (k, 2)."""
    gx, gy, gz = mirror.gravity_deck
    fx, fy = rows[:, WAY_FX], rows[:, WAY_FY]
    along = (gz - fx * gx - fy * gy) / (1.0 + fx * fx + fy * fy)
    tangent = np.column_stack([gx + along * fx, gy + along * fy, gz - along])
    slope = np.sqrt(np.sum(tangent**2, axis=1))
    unit: FloatArray = np.where(slope > LEVEL_SLOPE, 1.0 / np.maximum(slope, LEVEL_SLOPE), 0.0)[:, None] * tangent
    return unit[:, :2]


def _push_sigma(world: WorldConfig) -> float:
    return world.vibration_acceleration_m_s2 / sqrt(2.0)


def _count_variance(world: WorldConfig) -> float:
    """Variance of an angle quantised by one count, rad^2."""
    return (2.0 * pi / world.encoder_counts_per_rev) ** 2 * _UNIFORM


def _wanderers(world: WorldConfig) -> tuple[tuple[int, float, float], ...]:
    """State, stationary sigma and correlation time of each Gauss-Markov process."""
    creep = world.creep_fraction * world.creep_walk_fraction
    return (
        (UR, world.slip_walk_sigma, world.slip_walk_time_s),
        (UL, world.slip_walk_sigma, world.slip_walk_time_s),
        (C, creep, world.creep_walk_time_s),
    )


def _shift_of(world: WorldConfig, encoder_hz: float, frame_s: float) -> tuple[FloatArray, FloatArray]:
    """Transition of the parameters over a frame, (n, n), and the diagonal of its noise, (n,)."""
    S, fresh = np.eye(_STATES), np.zeros(_STATES)
    for state, sigma, time_s in _wanderers(world):
        keep = exp(-frame_s / time_s)
        S[state, state], fresh[state] = keep, sigma * sigma * (1.0 - keep * keep)
    fresh[BG] = world.gyroscope_bias_walk_rad_s_sqrt_s**2 * frame_s
    fresh[BA] = world.accelerometer_bias_walk_m_s2_sqrt_s**2 * frame_s
    counts = world.encoder_counts_per_rev
    # The error of a counted angle is part of a count, independent of the past; errors of integrated rates add up.
    for state, before in ((ER, ER0), (EL, EL0)):
        S[state, state] = S[before, before] = 0.0
        S[before, state] = 1.0 if counts else 0.0
        fresh[state] = _count_variance(world) if counts else world.encoder_sigma_rad_s**2 * frame_s / encoder_hz
    for state, before, sigma in (
        (J, J0, world.vibration_rate_rad_s * frame_s / sqrt(2.0)),
        (JA, JA0, _push_sigma(world)),
    ):
        S[state, state] = S[before, before] = 0.0
        S[before, state] = 1.0
        fresh[state] = sigma * sigma
    return S, fresh


def _start_of(world: WorldConfig) -> FloatArray:
    sigmas = np.zeros(_STATES)
    sigmas[[X, Y]], sigmas[PSI] = world.start_position_sigma_m, world.start_heading_sigma_rad
    sigmas[BG], sigmas[KG] = world.gyroscope_bias_sigma_rad_s, world.gyroscope_scale_sigma
    sigmas[BA] = world.accelerometer_bias_sigma_m_s2
    sigmas[[RR, RL]], sigmas[KL] = world.wheel_radius_sigma, world.wheel_base_sigma
    if world.encoder_counts_per_rev:
        sigmas[[ER, EL]] = sqrt(_count_variance(world))
    for state, sigma, _ in _wanderers(world):
        sigmas[state] = sigma
    return np.diag(sigmas**2)
