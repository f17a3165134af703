"""A whole mission in one process: the daemon's own localizer, danger rules, mission and gate against the sim.

What the sockets carry is handed over directly; the order of events is that of lockstep, so that a mission here and a
run of the daemon with the same configuration and seed go through the same states. The laser system is always ready, and
the disk stores every fix at once.
"""

from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import hypot
from typing import Any

import numpy as np

from ccatp.clocks import SteadyTime
from ccatp.conditions import text_of
from ccatp.config.models import Config
from ccatp.core import (
    Cause,
    DeckPose,
    EventCode,
    Fix,
    FloatArray,
    Measured,
    PanelPose,
    PointId,
    Verdict,
    unreliable_points,
)
from ccatp.daemon.loops.mission_runner import STILL, DriveCommand, TimedFrame
from ccatp.daemon.loops.survey_pipeline import SurveyPipeline
from ccatp.danger import DangerMonitor
from ccatp.dataloop import MotorRobot, motor_robot
from ccatp.kinematics import difference
from ccatp.links import multiline
from ccatp.links.robot_codec import set_point_on_wire
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage, TreatmentKind, is_estimate_due
from ccatp.localizer import Localizer
from ccatp.mirror.fix_judgement import FixJudge
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.multilateration import MultilaterationError
from ccatp.mirror.panel_alignment import fit_panels
from ccatp.records.run_reader import Trace, TraceBuilder, trace_of_truth
from ccatp.records.summary import PanelFits, SummaryBuilder
from ccatp.sim.fault_plan import FaultPlan, Injected, InjectedFault
from ccatp.sim.laser import SEED_STREAM, EtalonModel, PuckTruth
from ccatp.sim.robot import Robot
from ccatp.sim.world import TruthRow
from ccatp.survey.behaviours import MissionCommand
from ccatp.survey.composition import SurveyParts, assemble
from ccatp.survey.events import DONE, Fault, FixFailed, FixStored, Mode, PointMissed, SurveyOutcome
from ccatp.survey.fix_gate import ApproachCounter
from ccatp.survey.fix_review import REPEATS, ReviewedFix
from ccatp.survey.route_follower import StateEstimate
from ccatp.survey.state import by_reason
from ccatp.survey.statechart import Mission

# A mission that takes this many times its bound hangs; the robot's own deadlines should have ended it long before.
_ENDLESS = 6.0
_LOST_FRAMES = 500  # without a frame for so long a mission is over
_BATCH = 1000  # frames that go to the summary at a time
_TRUTH_COLUMNS = 11  # of ``TruthRow``


@dataclass(slots=True)
class StopRow:
    """One measurement of a point, before its fix is fused."""

    t_s: float
    point: tuple[int, int, int]
    approach: int  # 1 at the first arrival
    error: tuple[float, float, float]  # true minus estimated pose: x, y (deck, m), heading (rad)
    covariance: FloatArray  # of the estimate of the three, shape (3, 3)
    distance_m: float  # true distance of the puck's foot from the point
    nis: float = float("nan")  # of the fix, two degrees of freedom; NaN where it is not known
    fix_distance_m: float = float("nan")  # the same distance as the fix shows it, after fusing


@dataclass(slots=True)
class SilResult:
    """The result of a mission."""

    summary: dict[str, Any]  # as in ``summary.json``
    stops: list[StopRow]
    corrections: int  # moves after a fix that showed the robot too far from its point
    counts: dict[str, int]
    outcome: str  # of the mission; "faulted": nobody attends to a fault here, "unfinished": it takes far too long
    cause: str
    states_s: dict[str, float]
    track: FloatArray  # rows of t, true x, y, heading, estimated x, y, heading (deck), shape (k, 7)

    @property
    def mission_time_s(self) -> float:
        """Robot time from start to end."""
        return float(self.summary["mission_time_s"])


class SilTrace:
    """Truth and estimate of every frame; both go to the summary at the end."""

    def __init__(self, parts: SurveyParts) -> None:
        self.builder = SummaryBuilder(parts.cfg, parts.mirror, is_sim=True)
        self.builder.set_plan(parts.total_points, parts.lower_bound_s)
        self._mirror = parts.mirror
        self._truth = array("d")
        self.note_truth: Callable[[TruthRow], None] = self._truth.extend  # at the newest frame
        self._estimates = TraceBuilder()

    def note_estimate(self, seq: int, t_s: float, pose: PanelPose) -> None:
        """The estimate after frame ``seq``."""
        self._estimates.add(seq, t_s, *pose.panel, (pose.x_m, pose.y_m, pose.heading_rad))

    def truth_at(self, seq: int) -> Sequence[float]:
        """The truth at a frame, as ``TruthRow``."""
        at = _TRUTH_COLUMNS * (seq - int(self._truth[0]))
        return self._truth[at : at + _TRUTH_COLUMNS]

    def estimates(self) -> Trace:
        """The estimates of all frames."""
        return self._estimates.build(self._mirror)

    def truth(self) -> Trace:
        """The truth of all frames."""
        return trace_of_truth(np.array(self._truth))

    def join(self) -> FloatArray:
        """Give everything to the summary; the rows of ``SilResult.track``."""
        truth = np.array(self._truth).reshape(-1, _TRUTH_COLUMNS)
        seqs, times_s, pose, heights_m, _ = self.estimates()
        estimates = np.column_stack([seqs, times_s, pose, pose[:, :2], heights_m])
        for first in range(0, len(truth), _BATCH):
            batch = truth[first : first + _BATCH]
            self.builder.add_truth(batch)
            begin, end = np.searchsorted(seqs, (batch[0, 0], batch[-1, 0] + 1.0))
            self.builder.add_track(estimates[begin:end])
        _, i, j = np.intersect1d(truth[:, 0], seqs, return_indices=True)
        return np.column_stack([truth[i, 1:5], pose[j]])


class SilLaser:
    """Measures the puck of a simulated robot; ``stops`` keeps the measurements whose fix was fused, in order."""

    def __init__(
        self, cfg: Config, mirror: Mirror, robot: Robot | MotorRobot, faults: tuple[InjectedFault, ...] = ()
    ) -> None:
        self._cfg, self._mirror, self._robot = cfg, mirror, robot
        channels, collimators_m = mirror.channels, mirror.collimators_m
        rng = np.random.default_rng([cfg.run.seed, SEED_STREAM])
        self._etalon = EtalonModel(cfg.sim.etalon, channels, collimators_m, rng)
        self._etalon.faults = tuple(fault for fault in faults if fault.signal == "laser")
        self._judge = FixJudge(cfg.etalon, dict(zip(channels, collimators_m, strict=True)))
        self._approaches = ApproachCounter(cfg.mission.correction_tolerance_m, cfg.mission.max_approaches)
        self._fixes: list[Measured] = []
        self.stops: list[StopRow] = []
        self.lengths_m: dict[int, float] = {}  # of the last measurement, by channel
        self.counts = Counter[str]()  # of fixes, by what the test of their lengths says

    def fix(self, t_s: float, estimate: DeckPose) -> Fix:
        """Measure now, for the frame of time ``t_s`` (raises MultilaterationError: no solution, or past a limit)."""
        robot, channels = self._robot, self._mirror.channels
        puck = PuckTruth(robot.t_s, robot.world.puck_world(), robot.world.moved_m())
        data = multiline.ChannelData(self._etalon.records(channels, puck))
        self.lengths_m, _ = multiline.valid_lengths(data, channels)
        expected_m = self._mirror.puck_world(estimate, self._cfg.robot.puck_height_m)
        try:
            fix = self._judge.fix(t_s, expected_m, self.lengths_m)
        except MultilaterationError:
            self.counts["fixes_refused"] += 1
            raise
        self.counts[f"fixes_{fix.metrology}"] += 1
        self.counts["fixes_with_channels_left_out"] += bool(fix.left_out)
        self.counts["length_warnings"] += len(fix.warnings)
        return fix

    def stop_row(self, t_s: float, point: PointId, truth: Sequence[float], localizer: Localizer) -> StopRow:
        """The state in which a point is measured, before its fix."""
        _, _, true_x_m, true_y_m, true_heading_rad, *_ = truth
        deck = localizer.deck_pose
        x_m, y_m = self._mirror.point_on_deck(point)
        error = true_x_m - deck.x_m, true_y_m - deck.y_m, difference(true_heading_rad, deck.heading_rad)
        covariance, distance_m = localizer.pose_covariance.copy(), hypot(true_x_m - x_m, true_y_m - y_m)
        return StopRow(t_s, (point.row, point.col, point.point), 0, error, covariance, distance_m)

    def is_too_far(self, row: StopRow, point: PointId, fix: Fix, distance_m: float, localizer: Localizer) -> bool:
        """Keep a fix that was fused; whether the point has to be approached again.

        ``row`` is the state before it, ``distance_m`` that of the robot from the point as the fix shows it.
        """
        row.fix_distance_m = distance_m
        if localizer.innovation is not None and localizer.innovation.size == 2:
            row.nis = localizer.innovation.nis
        is_too_far = self._approaches.is_too_far(point, distance_m, localizer.position_sigma_m)
        row.approach = self._approaches.count
        self.stops.append(row)
        if not is_too_far:
            self._fixes.append(Measured(point, fix))
        return is_too_far

    @property
    def measured(self) -> tuple[Measured, ...]:
        """The fixes that count."""
        return tuple(self._fixes)

    def panel_fits(self) -> PanelFits:
        """Of the fixes that count; see ``fit_panels``."""
        return fit_panels(self._mirror, self._fixes, self._cfg.robot.puck_height_m)

    def unreliable_points(self) -> int:
        """Number of points whose fix that counts is unreliable."""
        return unreliable_points(self._fixes)


def rehearse(cfg: Config) -> SilResult:
    """Survey the mirror of a configuration in its world; ``run.seed`` seeds everything. See ``SilRun``."""
    return SilRun(cfg).run()


class NoFrames(RuntimeError):
    """The robot sends no frame any more, which no plan of passing faults causes."""


class SilRun:
    """The processes' parts side by side; a subclass may exchange some before ``run``, or override a frame.

    ``faults``: of the robot and of the laser. A frame that cannot be decoded is passed over, one that is not newer is
    answered with zeros.
    """

    def __init__(self, cfg: Config, faults: FaultPlan | None = None) -> None:
        self.cfg = cfg
        self.parts = parts = assemble(cfg)
        self.mirror = parts.mirror
        self.thrust = parts.thrust
        self.pipeline = SurveyPipeline(cfg, parts, 1.0 / cfg.sim.robot.frame_hz, self)
        self.robot: Robot | MotorRobot = (
            Robot(cfg, self.mirror, np.random.default_rng(cfg.run.seed), faults)
            if cfg.sim.robot.physics == "lag"
            else motor_robot(cfg)
        )
        self.monitor = DangerMonitor(self.mirror, cfg.robot, cfg.danger, cfg.health)
        self.laser = SilLaser(cfg, self.mirror, self.robot, () if faults is None else faults.faults)
        self.trace = SilTrace(parts)
        self.states_s = defaultdict(float, {Mode.IDLE: 0.0})
        self.denied_s: list[float] = []  # when lines that were no frames took the permit away
        self.weak_frames = 0  # on an overhang, in which the fans gave less than their floor
        self._published: EstimateMessage | None = None
        self._verdict: Verdict | None = None
        self._code = EventCode.NORMAL
        self._drive_seq = 0
        self._time = SteadyTime(cfg.health.clock_jump_s)
        self._fans_seq = 0
        self._is_measuring = False

    @property
    def localizer(self) -> Localizer:
        """That of the pipeline."""
        return self.pipeline.localizer

    @property
    def mission(self) -> Mission:
        """That of the pipeline."""
        return self.pipeline.mission

    @property
    def injected(self) -> tuple[Injected, ...]:
        """The effect of each fault of the plan."""
        injector = self.robot.injector
        return () if injector is None else injector.injected

    def run(self) -> SilResult:
        """From the first frame to the end of the mission (raises NoFrames)."""
        robot = self.robot
        robot.join("monitor")
        robot.join("controller")
        frame = self._receive()
        self.begin_drives()
        first_s = self._time.at(frame.seq, frame.t)
        return self._run_from(frame, first_s, first_s - robot.frame_s)

    def _run_from(self, frame: Sensors, first_s: float, last_s: float) -> SilResult:
        """From a frame on, which was received and not served yet.

        Args:
            frame: the frame.
            first_s, last_s: times of the first frame of the mission, and of the one before this.
        """
        robot, t_s = self.robot, last_s
        limit_s = _ENDLESS * self.parts.lower_bound_s + 600.0
        while self.mission.state.mode is not DONE:  # a subclass may exchange it
            is_new = frame.seq > self.monitor.verdict.seq
            t_s = self._time.at(frame.seq, frame.t) if is_new else last_s
            self._serve(frame, t_s - last_s)
            last_s = t_s
            if self.mission.state.is_faulted or t_s - first_s > limit_s:
                break
            robot.advance()
            frame = self._receive()
        return self._result(t_s - first_s)

    def _receive(self) -> Sensors:
        """The newest frame, or the next one that arrives."""
        robot = self.robot
        for _ in range(_LOST_FRAMES):
            self._note_truth()
            if robot.delivered is not None:
                return robot.delivered
            self._receive_garbled()
            robot.advance()
        raise NoFrames(f"no frame arrives any more after {robot.t_s:.2f} s")

    def _receive_garbled(self) -> None:
        """As the danger loop on a line that is not a frame."""
        last = self.monitor.verdict
        if not self.robot.delivered_line or last.seq < 0:
            return
        verdict = self.monitor.garbled(last.seq, last.t_s, self.robot.t_s)
        if verdict is not None:
            self.denied_s.append(self.robot.t_s)
            self._drive_seq += 1  # numbers drives and permits alike here
            self.robot.permit(self._drive_seq, *verdict.permits)

    def _note_truth(self) -> None:
        self.trace.note_truth(self.robot.truth_row())

    # -- a frame, as in daemon.loops.main_loop and daemon.loops.danger_loop -------------------------------------------

    def _serve(self, sensors: Sensors, dt_s: float) -> None:
        robot, t_s = self.robot, sensors.t + self._time.offset_s
        frame = TimedFrame(sensors, b"", t_s, dt_s, False, is_estimate_due(sensors.seq))
        if self.mirror.overhang and robot.fans.thrust < self.cfg.sim.robot.fan_floor:
            self.weak_frames += 1
        if dt_s <= 0.0:
            self.pipeline.estimate(frame)
            self._drive(STILL)
            return
        # Main publishes a pose in five frames; the verdict on a frame waits for the newest that is due before it.
        before, verdict = self._verdict, self.monitor.step(sensors, self._published)
        self._verdict = verdict
        if verdict.code is not self._code:
            self._code = verdict.code
            self.trace.builder.add_verdict_event(sensors.seq, verdict.code)
        self.pipeline.estimate(frame)
        drive = self.pipeline.decide(
            frame, before, 0.0
        )  # the decision in a frame goes by the verdict on the one before
        self.states_s[self.mission.state.mode] += dt_s
        self._publish(frame)
        if self._is_measuring:
            self._is_measuring = False
            self._measure(sensors)
            drive = STILL  # the held frame is answered by zeros
        robot.permit(self._drive_seq + 1, *verdict.permits)
        self._drive(drive)

    def record_treatment(self, sensors: Sensors, kind: TreatmentKind, values: tuple[float, ...] = ()) -> None:
        """Nothing is recorded."""

    def after_requests(self, sensors: Sensors, command: MissionCommand) -> None:
        """Nothing is reported."""

    def report_grip(self) -> None:
        """Nothing is reported."""

    def execute(self, command: MissionCommand, motion: StateEstimate) -> None:
        """Measure at the end of the frame; see ``SurveySink``."""
        self._is_measuring = command.measure
        if command.at_rest:
            self.localizer.rest()
        if command.arrived is not None:
            self.trace.builder.add_arrival(command.arrived, self.robot.delivered_seq)

    def begin_drives(self) -> None:
        """Command the duties of the thrust control."""
        self._fans_seq += 1
        self.robot.command_fans(self._fans_seq, *self.thrust.duty)

    def _drive(self, drive: DriveCommand) -> None:
        self._drive_seq = number = self._drive_seq + 1
        right, left = drive.right_rad_s, drive.left_rad_s
        self.pipeline.sent.add(number, right, left)
        self.robot.drive(number, set_point_on_wire(right), set_point_on_wire(left))

    def _publish(self, frame: TimedFrame) -> None:
        sensors = frame.sensors
        self.trace.note_estimate(sensors.seq, sensors.t, self.localizer.pose)
        if frame.is_estimate_due:
            self._published = self.pipeline.estimate_message(frame)

    # -- a measurement, as in daemon.loops.fix_service ----------------------------------------------------------------

    def _measure(self, frame: Sensors) -> None:
        mission, localizer, laser = self.mission, self.localizer, self.laser
        point, review = mission.state.measuring_point, self.parts.fix_review
        row = None
        if point is not None:
            row = laser.stop_row(frame.t, point, self.trace.truth_at(frame.seq), localizer)
        review.begin()
        try:
            fix = self._fix(frame.t)
            found = self._fuse(fix)
            for _ in range(REPEATS):
                if found.doubt and not found.refusal:
                    fix = self._fix(frame.t)
                    found = self._fuse(fix)
        except MultilaterationError as error:
            expected_m = self.mirror.puck_world(localizer.deck_pose, self.cfg.robot.puck_height_m)
            self._fail(point, str(error), review.refusal_of(laser.lengths_m, expected_m))
            return
        if found.doubt:
            self._fail(point, found.doubt, found.refusal)
            return
        localizer.notices.clear()
        if point is not None and row is not None:
            distance_m = mission.survey.follower.distance_m(mission.state.stop, localizer.pose)
            if laser.is_too_far(row, point, fix, distance_m, localizer):
                mission.handle(PointMissed())
                return
        mission.handle(FixStored(point, self.parts.heading_sigma_rad()))

    def _fail(self, point: PointId | None, why: str, refusal: Cause) -> None:
        """There is no fix; with ``refusal`` the laser system must not be used any more."""
        self.mission.handle(Fault(refusal) if refusal else FixFailed(point, why, self.parts.heading_sigma_rad()))

    def _fix(self, t_s: float) -> Fix:
        """Measure, with the retries of the client (raises MultilaterationError of the last one)."""
        for _ in range(self.cfg.etalon.retries):
            with suppress(MultilaterationError):
                return self.laser.fix(t_s, self.localizer.deck_pose)
        return self.laser.fix(t_s, self.localizer.deck_pose)

    def _fuse(self, fix: Fix) -> ReviewedFix:
        """Review a fix, and fuse it if it is good."""
        localizer = self.localizer
        estimate, is_lost = localizer.deck_pose, self.mission.state.is_lost
        expected_m = self.mirror.puck_world(estimate, self.cfg.robot.puck_height_m)
        return self.parts.fix_review.take(localizer, fix, expected_m, estimate, is_lost=is_lost)

    def _result(self, mission_time_s: float) -> SilResult:
        state, misalignments = self.mission.state, self.robot.world.misalignments
        injected = {panel: (m.piston_m, m.tip_rad, m.tilt_rad) for panel, m in misalignments.items()}
        points, track, builder = state.points, self.trace.join(), self.trace.builder
        is_complete = state.outcome is SurveyOutcome.COMPLETE
        left_out = by_reason(self.mission.survey.left_out(state))
        builder.set_mission(len(points.done), len(points.skipped), mission_time_s, left_out, is_complete=is_complete)
        builder.add_grip(self.thrust.friction, self.thrust.margin)
        builder.set_panels(self.laser.panel_fits(), injected)
        builder.set_unreliable(self.laser.unreliable_points())
        return SilResult(
            summary=builder.build(),
            stops=self.laser.stops,
            corrections=state.corrections,
            counts={**self.localizer.counts, **self.laser.counts},
            outcome=str(state.outcome) or ("faulted" if state.is_faulted else "unfinished"),
            cause=text_of(state.cause),
            states_s={str(state): time_s for state, time_s in self.states_s.items()},
            track=track,
        )
