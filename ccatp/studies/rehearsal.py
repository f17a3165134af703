"""Pure. A whole mission in one process: the daemon's own localizer, danger rules, mission and gate against the sim.

What the sockets carry is handed over directly; the order of events is that of lockstep, so that a rehearsal and a run
of the daemon with the same configuration and seed go through the same states.
"""

from collections import deque
from dataclasses import dataclass, field
from math import hypot
from typing import Any

import numpy as np

from ccatp.assembly import Parts, assemble
from ccatp.config.models import Config
from ccatp.control.kinematics import twist_of
from ccatp.control.prediction import CommandPredictor
from ccatp.danger import DangerMonitor
from ccatp.localization.fixes import FixGated, FixRefused
from ccatp.localizer import Localizer
from ccatp.mirror.alignment import fit_panel
from ccatp.mirror.batches import deck_poses
from ccatp.mirror.errors import PanelFitError
from ccatp.radio.multilateration import MultilaterationError
from ccatp.radio.puck_fix import solve_fix
from ccatp.samples import EventCode, Fix, PanelId, PanelPose, PointId
from ccatp.sim.etalon import SEED_STREAM, EtalonModel, PuckTruth
from ccatp.sim.robot import Robot
from ccatp.sim.world import TruthRow
from ccatp.summary import RunFacts, SummaryBuilder, puck_targets
from ccatp.surveying.approaches import Approaches
from ccatp.surveying.journey import Motion
from ccatp.surveying.states import Outcome, State
from ccatp.wire import multiline
from ccatp.wire.robot import Sensors
from ccatp.wire.topics import Estimate, is_estimate_due, last_estimate_before

_BATCH = 1000  # frames that go to the summary at a time
_MIN_FIXES = 3
# A mission that takes this many times its bound hangs; the robot's own deadlines should have ended it long before.
_ENDLESS = 6.0


@dataclass(slots=True)
class StopRow:
    """One measurement of a point, before its fix is fused.

    Attributes:
        t_s: robot time.
        point: row, column, number.
        approach: 1 at the first arrival.
        error: true minus estimated pose: x, y (deck, m), heading (rad).
        covariance: of the estimate of the three, shape (3, 3).
        distance_m: true distance of the puck's foot from the point.
        nis: normalised innovation squared of the fix (two degrees of freedom), NaN where it is not known.
        fix_distance_m: the same distance as the fix shows it, after fusing.
    """

    t_s: float
    point: tuple[int, int, int]
    approach: int
    error: tuple[float, float, float]
    covariance: np.ndarray[Any, np.dtype[np.float64]]
    distance_m: float
    nis: float = float("nan")
    fix_distance_m: float = float("nan")


@dataclass(slots=True)
class Rehearsal:
    """What came of it.

    Attributes:
        summary: as in ``summary.json``.
        stops: measurements in the order they were taken.
        corrections: moves after a fix that showed the robot too far from its point.
        counts: the localizer's.
        outcome, cause: how the mission ended.
        states_s: time spent in each state of the mission.
        track: rows of t, true x, y, heading, estimated x, y, heading (deck), shape (k, 7), where it was asked for.
    """

    summary: dict[str, Any]
    stops: list[StopRow]
    corrections: int
    counts: dict[str, int]
    outcome: str
    cause: str
    states_s: dict[str, float]
    track: np.ndarray[Any, np.dtype[np.float64]] | None = None
    notices: list[str] = field(default_factory=list)

    @property
    def mission_time_s(self) -> float:
        """Robot time from start to end."""
        return float(self.summary["mission_time_s"])

    @property
    def wall_s(self) -> float:
        """Wall time, where the caller measured it; 0 otherwise."""
        return float(self.summary["wall"]["time_s"] or 0.0)


def rehearse(cfg: Config, *, with_track: bool = False) -> Rehearsal:
    """Survey the mirror of a configuration in its world.

    Args:
        cfg: the configuration; ``run.seed`` seeds everything.
        with_track: keep true and estimated pose of every frame.
    """
    return _Rehearsing(cfg, with_track).run()


class _Rehearsing:
    """The processes' parts side by side."""

    def __init__(self, cfg: Config, with_track: bool) -> None:
        self.cfg, self.with_track = cfg, with_track
        parts: Parts = assemble(cfg)
        self.parts, self.mirror = parts, parts.mirror
        self.localizer: Localizer = parts.localizer
        self.mission, self.gate = parts.mission, parts.gate
        self.robot = Robot(cfg, self.mirror, np.random.default_rng(cfg.run.seed))
        self.monitor = DangerMonitor(self.mirror, cfg.robot, cfg.danger)
        self.predictor = CommandPredictor(cfg.robot.wheel_lag_s, self.robot.frame_s)
        channels, collimators = self.mirror.channels, self.mirror.collimators_m
        rng = np.random.default_rng([cfg.run.seed, SEED_STREAM])
        self.etalon = EtalonModel(cfg.sim.etalon, channels, collimators, rng)
        self.collimators = dict(zip(channels, collimators, strict=True))
        mission = cfg.mission
        self.approaches = Approaches(mission.correction_tolerance_m, mission.max_approaches)
        targets = puck_targets(self.mirror, parts.points, cfg.robot.puck_height_m)
        facts = RunFacts(
            mirror=cfg.mirror.name,
            world=cfg.world.name,
            filter=cfg.run.filter,
            seed=cfg.run.seed,
            total_points=parts.total_points,
            lower_bound_s=parts.lower_bound_s,
            budget_s=cfg.run.budget_s,
            puck_height_m=cfg.robot.puck_height_m,
            has_truth=True,
        )
        self.builder = SummaryBuilder(facts, targets, self.mirror.surface.normal)
        self.truth: list[TruthRow] = []
        self.estimates: list[tuple[int, float, PanelPose]] = []
        self.recent: deque[TruthRow] = deque(maxlen=64)
        self.tracks: list[np.ndarray[Any, np.dtype[np.float64]]] = []
        self.stops: list[StopRow] = []
        self.fixes: dict[PanelId, list[Fix]] = {}
        self.published: deque[Estimate] = deque(maxlen=4)
        self.states_s: dict[str, float] = {}
        self.notices: list[str] = []
        self.code = EventCode.NORMAL
        self.drive_seq = 0

    def run(self) -> Rehearsal:
        robot, mission = self.robot, self.mission
        robot.join_monitor()
        robot.join_controller()
        robot.command_fans(1, *self.cfg.robot.fan_duty)
        self._note_truth()
        while robot.delivered is None:
            robot.advance()
            self._note_truth()
        first_s = t_s = robot.delivered.t
        last_s = first_s - robot.frame_s
        limit_s = _ENDLESS * self.parts.lower_bound_s + 600.0
        while mission.state is not State.DONE:
            frame = robot.delivered
            t_s = frame.t
            self._serve(frame, t_s - last_s)
            last_s = t_s
            if mission.is_faulted or t_s - first_s > limit_s:
                break
            robot.advance()
            self._note_truth()
        return self._result(t_s - first_s)

    def _note_truth(self) -> None:
        row = self.robot.world.truth_row(self.robot.seq, self.robot.t_s)
        self.truth.append(row)
        self.recent.append(row)

    # -- a frame, as in processes.main_loop and processes.danger_loop -------------------------------------------------

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        localizer, mission, robot = self.localizer, self.mission, self.robot
        seq, t_s = frame.seq, frame.t
        verdict = self.monitor.step(frame, self._estimate_for(seq))
        if verdict.code is not self.code:
            self.code = verdict.code
            self.builder.add_verdict_event(seq, verdict.code)
        localizer.step(t_s, frame.imu, frame.enc, frame.edge, frame.gravity)
        if localizer.hold_requested:
            mission.fault(localizer.hold_cause, is_lost=localizer.is_frozen)
            localizer.clear_hold()
        pose, v, omega = localizer.pose, localizer.speed_m_s, localizer.rate_rad_s
        creep, echo = localizer.creep, frame.cmd
        ahead = self.predictor.ahead(
            (pose.x_m, pose.y_m, pose.heading_rad), v, omega, echo.seq, echo.age, echo.held, creep
        )
        motion = Motion(t_s, dt_s, pose, self.mirror.deck_pose, v, omega, creep, ahead)
        order = mission.step(motion, verdict)
        right, left = self.gate.pass_through(order.twist, verdict, dt_s)
        if order.at_rest:
            localizer.rest()
            if order.arrived is not None:
                self.builder.add_arrival(order.arrived, seq)
        state = mission.state
        self._publish(seq, t_s, pose, state)
        if order.measure:
            self._measure(frame)
            right = left = 0.0  # the held frame is answered by zeros
        self.states_s[state] = self.states_s.get(state, 0.0) + dt_s
        self.drive_seq += 1
        twist = twist_of(right, left, self.cfg.robot.wheel_radius_m, self.cfg.robot.wheel_base_m)
        self.predictor.sent(self.drive_seq, twist.v_m_s, twist.omega_rad_s)
        robot.permit(self.drive_seq, verdict.forward, verdict.reverse, verdict.turn)
        robot.drive(self.drive_seq, right, left)

    def _estimate_for(self, seq: int) -> Estimate | None:
        wanted = last_estimate_before(seq)
        for estimate in reversed(self.published):
            if estimate.seq <= wanted:
                return estimate
        return None

    def _publish(self, seq: int, t_s: float, pose: PanelPose, state: State) -> None:
        self.estimates.append((seq, t_s, pose))
        if len(self.estimates) >= _BATCH:
            self._flush()
        if is_estimate_due(seq):
            deck, sigma = self.localizer.deck_pose, self.localizer.position_sigma_m
            self.published.append(
                Estimate(
                    seq=seq,
                    t_s=t_s,
                    x_m=deck.x_m,
                    y_m=deck.y_m,
                    heading_rad=deck.heading_rad,
                    sigma_m=sigma,
                    state=state,
                )
            )

    # -- a measurement, as in processes.measuring ---------------------------------------------------------------------

    def _measure(self, frame: Sensors) -> None:
        mission, localizer = self.mission, self.localizer
        point = mission.measuring_point
        row = self._stop_row(frame, point) if point is not None else None
        try:
            fix = self._fix(frame.t)
            self._fuse(fix)
        except (MultilaterationError, FixRefused) as error:
            mission.not_fixed(point, str(error))
            return
        self.notices += localizer.notices
        localizer.notices.clear()
        if point is not None and row is not None:
            distance_m = mission.survey.distance_m(localizer.pose)
            row.fix_distance_m = distance_m
            if localizer.innovation is not None and localizer.innovation.size == 2:
                row.nis = localizer.innovation.nis
            is_too_far = self.approaches.is_too_far(point, distance_m)
            row.approach = self.approaches.count
            self.stops.append(row)
            if is_too_far:
                mission.again()
                return
            self.fixes.setdefault(point.panel, []).append(fix)
        mission.fixed(point)

    def _fuse(self, fix: Fix) -> None:
        """A fix that contradicts the estimate is measured again until it is accepted or refused for good."""
        while True:
            try:
                self.localizer.fuse_fix(fix)
            except FixGated:
                continue
            return

    def _fix(self, t_s: float) -> Fix:
        robot, channels = self.robot, self.mirror.channels
        puck = PuckTruth(robot.t_s, robot.world.puck_world(), robot.world.moved_m())
        data = multiline.ChannelData(self.etalon.records(channels, puck))
        lengths_m, _ = multiline.valid_lengths(data, channels)
        expected_m = self.mirror.puck_world(self.localizer.deck_pose, self.cfg.robot.puck_height_m)
        return solve_fix(self.cfg.etalon, t_s, expected_m, lengths_m, self.collimators)

    def _stop_row(self, frame: Sensors, point: PointId) -> StopRow:
        truth = next(row for row in self.recent if row[0] == frame.seq)
        deck = self.localizer.deck_pose
        turn = float(np.remainder(truth[4] - deck.heading_rad + np.pi, 2.0 * np.pi) - np.pi)
        x, y = self.mirror.point_on_deck(point)
        return StopRow(
            t_s=frame.t,
            point=(point.row, point.col, point.point),
            approach=0,
            error=(truth[2] - deck.x_m, truth[3] - deck.y_m, turn),
            covariance=self.localizer.pose_covariance.copy(),
            distance_m=hypot(truth[2] - x, truth[3] - y),
        )

    # -- the result ---------------------------------------------------------------------------------------------------

    def _flush(self) -> None:
        estimates, self.estimates = self.estimates, []
        truth, self.truth = self.truth, []
        if truth:
            self.builder.add_truth(truth)
        if estimates:
            x, y, heading, z = deck_poses(self.mirror, [pose for _, _, pose in estimates]).T
            seq, t_s = np.array([row[:2] for row in estimates]).T
            rows = np.column_stack([seq, t_s, x, y, heading, x, y, z])
            self.builder.add_track(rows)
            if self.with_track:
                self._keep(truth, rows)

    def _keep(self, truth: list[TruthRow], rows: np.ndarray[Any, np.dtype[np.float64]]) -> None:
        true = np.array([row[:5] for row in truth])
        _, i, j = np.intersect1d(true[:, 0], rows[:, 0], return_indices=True)
        self.tracks.append(np.column_stack([true[i, 1:5], rows[j, 2:5]]))

    def _result(self, mission_time_s: float) -> Rehearsal:
        self._flush()
        mission, builder = self.mission, self.builder
        builder.set_mission(len(mission.done), len(mission.skipped), mission_time_s)
        builder.set_panels(
            self._fits(),
            {panel: (m.piston_m, m.tip_rad, m.tilt_rad) for panel, m in self.robot.world.misalignments.items()},
        )
        is_over = mission.state is State.DONE
        return Rehearsal(
            summary=builder.build(),
            stops=self.stops,
            corrections=mission.corrections,
            counts=dict(self.localizer.counts),
            outcome=str(mission.outcome if is_over else Outcome.STOPPED),
            cause=mission.cause,
            states_s={str(state): time_s for state, time_s in self.states_s.items()},
            track=np.concatenate(self.tracks) if self.tracks else None,
            notices=self.notices,
        )

    def _fits(self) -> dict[PanelId, tuple[float, float, float]]:
        fits = {}
        for panel, fixes in sorted(self.fixes.items()):
            if len(fixes) < _MIN_FIXES:
                continue
            points = np.array([fix.position_m for fix in fixes])
            covariances = np.array([fix.covariance_m2 for fix in fixes]).reshape(-1, 3, 3)
            try:
                fit = fit_panel(self.mirror, panel, points, covariances, self.cfg.robot.puck_height_m)
            except PanelFitError:
                continue
            fits[panel] = fit.piston_m, fit.tip_rad, fit.tilt_rad
        return fits
