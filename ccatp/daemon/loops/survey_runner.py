"""The survey of a mirror in the main-loop process: localizer, mission, gate, laser system, fans, store."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ccatp.conditions import text_of
from ccatp.conditions.mission import UNATTENDED_FAULT
from ccatp.config.models import Config
from ccatp.control.gate import FanGate
from ccatp.core import Cause, Verdict
from ccatp.daemon.loops.checkpoint_writer import CheckpointWriter
from ccatp.daemon.loops.checkpoints import build_parts
from ccatp.daemon.loops.fix_service import FixRequest, FixService
from ccatp.daemon.loops.gate_log import GateLog
from ccatp.daemon.loops.mission_runner import EXIT_STATUS, STILL, DriveCommand, MissionHost, MissionRunner, TimedFrame
from ccatp.daemon.loops.survey_pipeline import SurveyPipeline
from ccatp.daemon.supervision.process import ProcessArgs
from ccatp.errors import DaemonUnreachableError, ExitStatus
from ccatp.etalon_client import EtalonClient, EtalonError
from ccatp.links.bus import Telemetry
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.topics import (
    ArrivalMessage,
    DisplayState,
    MissionStatus,
    Rest,
    TrackMessage,
    Treatment,
    TreatmentKind,
)
from ccatp.records.store import MissionStore
from ccatp.sensing.sample_times import possible_gravity
from ccatp.survey.behaviours import MissionCommand
from ccatp.survey.budget import home_time_s
from ccatp.survey.checks import FaultAction, MirrorCheck, UnattendedFaultTimer
from ccatp.survey.composition import SurveyParts
from ccatp.survey.events import Fault, Interrupted, Mode, SurveyOutcome, TrackingGap
from ccatp.survey.forecast import forecast_time
from ccatp.survey.route_follower import StateEstimate
from ccatp.survey.state import by_reason
from ccatp.survey.statechart import Mission


def state_text(state: Mode, cause: str) -> str:
    """Text about a hold, or about the state after it; the end of a run says itself why it ended."""
    if state is Mode.DONE:
        return f"{state}"
    if state in (Mode.HELD, Mode.BACKING_OFF, Mode.RETURNING):
        return f"{state}: {cause}" if cause else f"{state}"
    return f"resumed: {state}, after: {cause}" if cause else f"resumed: {state}"


GIVEN_UP = "no calibration drive, because the robot was held elsewhere: slip and heading are learned on the way"


class SurveyRunner(MissionRunner):
    """A survey in the main-loop process."""

    mission: Mission

    def __init__(
        self, cfg: Config, args: ProcessArgs, host: MissionHost, parts: SurveyParts, store: MissionStore
    ) -> None:
        self._pipeline = SurveyPipeline(cfg, parts, 1.0 / cfg.sim.robot.frame_hz, self)
        telemetry = Telemetry(host.publisher, host.log, "track", TrackMessage)
        super().__init__(parts.mission, telemetry, self._pipeline.sent.add)
        self._cfg = cfg
        self._host = host
        self._clock = host.clock
        self._clock.before_s = parts.mission.state.budget.before_s
        self._store = store
        self._parts = parts
        self._localizer = parts.localizer
        self._gate_log = GateLog(parts.gate, self.telemetry.notify_operator)
        self._fan_gate = FanGate(0.0)
        self._fans_seq = 0
        self._etalon = EtalonClient(cfg.etalon, parts.mirror.channels, parts.mirror.collimators_m, self._on_retry)
        self._fix_service = FixService(self._etalon, parts, store, telemetry=self.telemetry, host=host)
        self._checkpoint = CheckpointWriter(args.run_dir, parts.localizer, self.mission, not args.is_realtime)
        self._fault_timer = UnattendedFaultTimer(cfg, falls=parts.mirror.overhang)
        self._mirror_check: MirrorCheck | None = MirrorCheck(parts.mirror)
        self._state = Mode.IDLE
        # Planned before the first frame: other orders take a second.
        self._too_long = "" if parts.start else forecast_time(parts.cfg, parts.mirror, parts.route).warning

    @property
    def is_busy(self) -> bool:
        return self._fix_service.is_busy

    @property
    def causes(self) -> list[Cause]:
        own = self._fix_service.wait_cause, self._fix_service.metrology_cause
        return [*super().causes, *(cause for cause in own if cause)]

    @property
    def wait_cause(self) -> Cause:
        return self._fix_service.wait_cause

    @property
    def is_at_rest(self) -> bool:
        control = self._cfg.control
        return (
            abs(self._localizer.speed_m_s) <= control.settle_speed_m_s
            and abs(self._localizer.rate_rad_s) <= control.settle_rate_rad_s
        )

    def status(self) -> MissionStatus:
        state, survey = self.mission.state, self.mission.survey
        point, cause = state.measuring_point, state.cause or self._fix_service.wait_cause
        if state.is_paused:
            point = state.next_point
        return MissionStatus(
            seq=self._clock.seq,
            t_s=self._clock.t_s,
            state=str(state.mode),
            cause=text_of(cause),
            condition=cause.condition,
            done=len(state.points.done),
            skipped=len(state.points.skipped),
            total=self._parts.total_points,
            point=f"{point.row}-{point.col}-{point.point}" if point is not None else "",
            eta_s=round(state.eta_s, 3),
            error_mm=1e3 * self._fix_service.arrival_error_m,
            outcome=str(state.outcome),
            lower_bound_s=self._parts.lower_bound_s,
            left_out=by_reason(survey.left_out(state)),
            friction=round(self._parts.thrust.friction, 3),
            grip=round(self._parts.thrust.margin, 3),
        )

    def display_state(self) -> DisplayState:
        """Deck pose, and the filter's last update."""
        localizer, telemetry = self._localizer, self.telemetry
        pose, covariance, innovation = localizer.deck_pose, localizer.pose_covariance, localizer.innovation
        return DisplayState(
            seq=telemetry.seq,
            t_s=telemetry.t_s,
            x_m=pose.x_m,
            y_m=pose.y_m,
            heading_rad=pose.heading_rad,
            covariance_m2=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
            heading_sigma_rad=localizer.heading_sigma_rad,
            nis=innovation.nis if innovation is not None else 0.0,
            size=innovation.size if innovation is not None else 0,
            line=telemetry.newest_line,
        )

    # -- beside the frames ----------------------------------------------------------------------------------------

    async def connect(self) -> None:
        """Connect to the laser system; raises ``DaemonUnreachableError`` if it does not answer."""
        try:
            await self._etalon.connect()
        except EtalonError as error:
            raise DaemonUnreachableError(str(error)) from error

    def _on_retry(self, error: EtalonError, tries_left: int) -> None:
        self.telemetry.log.warning("etalon_retry", error=str(error), tries_left=tries_left)

    async def run(self) -> None:
        await self._fix_service.run()

    async def close(self) -> None:
        self._checkpoint.close()
        await self._etalon.close()

    def check_robot(self, hello: Hello) -> None:
        self._parts.check_robot(hello)

    def begin_session(self, hello: Hello) -> None:
        self._pipeline.sent.begin_session(1.0 / hello.frame_hz, hello.ttl_s)
        self._checkpoint.boot = hello.boot
        # The robot's own floor applies where the mirror overhangs.
        self._fan_gate = FanGate(hello.robot.fan_floor if self._parts.mirror.overhang else 0.0)
        if self._too_long:
            self.telemetry.notify_operator("warning", self._too_long)
            self._too_long = ""

    def begin_drives(self) -> None:
        duty = self._parts.thrust.duty
        refusal = self._fan_gate.refusal(*duty)
        if refusal is None:
            self._fans_seq += 1
            self._host.send_fans(self._fans_seq, duty)
        else:
            self.telemetry.notify_operator("error", text_of(refusal))
            self.mission.handle(Fault(refusal))

    def on_tracking_gap(self) -> None:
        self.mission.handle(TrackingGap())

    def save_checkpoint(self) -> None:
        self._checkpoint.write(self._clock.seq, self._clock.t_s, self._clock.elapsed_s)

    def log_statistics(self) -> None:
        """Log the numbers of refusals of the gates, by reason."""
        self.telemetry.log.info("gate_statistics", denied=self._gate_log.counts, fans_refused=self._fan_gate.refused)

    # -- the frame ------------------------------------------------------------------------------------------------

    def estimate(self, frame: TimedFrame) -> None:
        self._pipeline.estimate(frame)

    def record_treatment(self, sensors: Sensors, kind: TreatmentKind, values: tuple[float, ...] = ()) -> None:
        self.telemetry.send("treatment", Treatment(seq=sensors.seq, t_s=sensors.t, kind=kind, values=values))

    def decide(self, frame: TimedFrame, verdict: Verdict | None, lag_s: float) -> DriveCommand:
        if self._mirror_check is not None and not self._is_on_mirror(self._mirror_check, frame.sensors):
            return self.hold(frame)
        drive = self._pipeline.decide(frame, verdict, lag_s)
        if self._parts.gate.denial is not None:
            self._gate_log.update(frame.t_s)
        return drive

    def report_grip(self) -> None:
        thrust = self._parts.thrust
        text = f"grip: friction {thrust.friction:.2f}, {thrust.margin:.2f} times the thrust that turns need"
        self.telemetry.notify_operator("info", text)

    def hold(self, frame: TimedFrame) -> DriveCommand:
        self._pipeline.hold(frame)
        return STILL

    def _is_on_mirror(self, check: MirrorCheck, sensors: Sensors) -> bool:
        """Whether the robot may move: gravity shows that it stands on the configured mirror.

        In lockstep the mission begins at once, and ends if gravity contradicts: a simulation cannot do harm, and a run
        does not depend on this check.
        """
        gravity = possible_gravity(sensors.t, sensors.gravity)
        if check.update(sensors.t, gravity, self._localizer.deck_pose):
            self._mirror_check = None
            if check.warning:
                self.telemetry.notify_operator("warning", check.warning)
        if check.contradiction:
            self.telemetry.notify_operator("error", check.contradiction)
            self._host.finish(ExitStatus.USAGE)
            return False
        return self._mirror_check is None or self._host.is_lockstep

    def after_requests(self, sensors: Sensors, command: MissionCommand) -> None:
        state = self.mission.state
        if command.skips_calibration:
            self.telemetry.notify_operator("warning", GIVEN_UP)
        if state.is_faulted:
            self._check_unattended_fault(sensors)

    def _check_unattended_fault(self, sensors: Sensors) -> None:
        """Remind operators periodically, and return to base before the battery is too low for that."""
        mission, timer, pose = self.mission, self._fault_timer, self._localizer.deck_pose
        is_localized = not (mission.state.is_lost or self._localizer.is_frozen)
        home_s = home_time_s(self._parts.mirror, self._cfg.limits, pose.x_m, pose.y_m) if is_localized else None
        action = timer.watch(self._clock.t_s, sensors.soc, home_s)
        if action is FaultAction.REMIND:
            held_s = timer.held_s(self._clock.t_s)
            self.telemetry.notify_operator(
                "error", f"held for {held_s:.0f} s, waiting for an operator: {text_of(mission.state.cause)}"
            )
        elif action is FaultAction.RETURN:
            mission.handle(Interrupted(UNATTENDED_FAULT.cause(charge=sensors.soc)))

    def execute(self, command: MissionCommand, motion: StateEstimate) -> None:
        mission, seq = self.mission, self._clock.seq
        if command.at_rest:
            self._localizer.rest()
            self.telemetry.send("rest", Rest(seq=seq, t_s=motion.t_s))
        if command.arrived is not None:
            error_m = mission.survey.follower.distance_m(mission.state.stop, motion.pose)
            number, point = seq + self.telemetry.frames_before, (*command.arrived,)
            arrival = ArrivalMessage(seq=number, t_s=motion.t_s, point=point, error_mm=1e3 * error_m)
            self.telemetry.send("arrival", arrival)
            self._store.record_arrival(command.arrived, motion.t_s, error_m)
        if command.measure:
            pose = self._localizer.deck_pose
            expected = self._parts.mirror.puck_world(pose, self._cfg.robot.puck_height_m)
            # For the localizer, the time of a fix is by the robot's own clock.
            t_s = motion.t_s - self._clock.offset_s
            self._fix_service.begin(
                FixRequest(mission.state.request, t_s, mission.state.measuring_point, expected, estimate=pose)
            )

    def publish(self, frame: TimedFrame) -> None:
        seq, t_s, telemetry, localizer = frame.sensors.seq, frame.sensors.t, self.telemetry, self._localizer
        pose, sigma_m = localizer.pose, localizer.position_sigma_m
        if frame.is_estimate_due:
            telemetry.send("estimate", self._pipeline.estimate_message(frame))
        row = seq + telemetry.frames_before, t_s, *pose.panel, pose.x_m, pose.y_m, pose.heading_rad, sigma_m
        telemetry.add_frame(seq, t_s, frame.raw, row)
        if self._checkpoint.is_due(seq):
            self._checkpoint.write(seq, t_s, self._clock.elapsed_s)
        if self.mission.state.mode is not self._state:
            self.publish_state()

    def publish_state(self) -> None:
        state, telemetry, before = self.mission.state, self.telemetry, self._state
        mode = state.mode
        if mode is before:
            return
        self._state = mode
        self.since_s = self._clock.t_s
        if not state.is_faulted:
            self._fault_timer.over()
        telemetry.log.debug("state_changed", seq=self._clock.seq, before=before, after=mode, cause=text_of(state.cause))
        if mode in (Mode.HELD, Mode.BACKING_OFF) or before is Mode.HELD:
            is_resumed = mode not in (Mode.HELD, Mode.BACKING_OFF, Mode.RETURNING)
            telemetry.notify_operator("info" if is_resumed else "warning", state_text(mode, text_of(state.cause)))
        if mode is Mode.RETURNING and before is not Mode.BACKING_OFF:
            telemetry.notify_operator("warning", f"returning to base: {text_of(state.cause)}")
        if mode is Mode.DONE:
            self._host.finish(EXIT_STATUS[state.outcome])
        elif state.is_faulted and self._host.is_lockstep:
            # No operator can react while simulated time runs at many times the wall clock.
            self._host.finish(EXIT_STATUS[SurveyOutcome.STOPPED])


@contextmanager
def open_survey(cfg: Config, args: ProcessArgs) -> Iterator[Callable[[MissionHost], SurveyRunner]]:
    """Open the parts and the database of a survey, new or taken over; yields a factory of the mission."""
    parts, store = build_parts(cfg, args)
    with store:
        yield lambda host: SurveyRunner(cfg, args, host, parts, store=store)
