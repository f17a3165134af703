"""The survey of a mirror in the main-loop process: localizer, mission, gate, laser system, fans, store."""

from collections.abc import Iterator
from contextlib import contextmanager

from ccatp.config.models import Config
from ccatp.control.motion_checks import as_standing
from ccatp.core import Verdict
from ccatp.daemon.checkpoints import CheckpointWriter, build_parts
from ccatp.daemon.fix_service import FixRequest, FixService
from ccatp.daemon.frame_service import FanController, GateLog
from ccatp.daemon.mission_runner import (
    STILL,
    DriveCommand,
    RunnerConfig,
    RunnerContext,
    RunnerFactory,
    TimedFrame,
)
from ccatp.daemon.process import ProcessArgs
from ccatp.daemon.robot_session import CommandHistory
from ccatp.daemon.telemetry import SurveyTelemetry, TelemetryPublisher
from ccatp.errors import DaemonUnreachableError, ExitStatus
from ccatp.etalon_client import EtalonClient, EtalonError
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.topics import MissionStatus, is_estimate_due
from ccatp.records.store import MissionStore
from ccatp.survey.behaviours import home_time_s
from ccatp.survey.composition import SurveyParts
from ccatp.survey.fix_gate import FixGate
from ccatp.survey.reactions import MirrorCheck, ReminderCall, UnattendedFaultTimer
from ccatp.survey.route_follower import StateEstimate
from ccatp.survey.state import MissionState, SurveyOutcome, by_reason
from ccatp.survey.stops import HOLD_POSITION, MissionCommand


class SurveyWatch:
    """Tells states, reminds of faults, and sends a robot home that nobody comes for."""

    def __init__(self, cfg: Config, parts: SurveyParts, telemetry: TelemetryPublisher) -> None:
        """Nothing to look after."""
        self._limits, self._base = cfg.limits, parts.mirror.base_pose
        self._mission, self._localizer, self._telemetry = parts.mission, parts.localizer, telemetry
        self._fault_timer = UnattendedFaultTimer(cfg, falls=parts.mirror.overhang)

    def check_unattended_fault(self, sensors: Sensors) -> None:
        """A fault that nobody looks after: an alarm now and then, and home before the battery is too low for it."""
        mission, timer, pose = self._mission, self._fault_timer, self._localizer.deck_pose
        knows_place = not (mission.is_lost or self._localizer.is_frozen)
        home_s = home_time_s(self._base, self._limits, pose.x_m, pose.y_m) if knows_place else None
        call = timer.watch(sensors.t, sensors.soc, home_s)
        if call is ReminderCall.REMIND:
            held_s = timer.held_s(sensors.t)
            self._telemetry.notify_operator(
                "error", f"held for {held_s:.0f} s, waiting for an operator: {mission.cause}"
            )
        elif call is ReminderCall.RETURN:
            mission.abort(f"unattended fault: the battery ({sensors.soc:.0%}) lasts for little more than the way home")

    def publish_state_change(self, before: MissionState, seq: int) -> None:
        """The mission's state is another one than before, in frame ``seq``."""
        mission, telemetry = self._mission, self._telemetry
        if not mission.is_faulted:
            self._fault_timer.over()
        telemetry.log.debug("state_changed", seq=seq, before=before, after=mission.state, cause=mission.cause)
        if mission.state in (MissionState.HELD, MissionState.BACKING_OFF) or before is MissionState.HELD:
            telemetry.notify_operator("warning", state_text(mission.state, mission.cause))
        if mission.state is MissionState.RETURNING and before is not MissionState.BACKING_OFF:
            telemetry.notify_operator("warning", f"returning to base: {mission.cause}")


def state_text(state: MissionState, cause: str) -> str:
    """What is said of the state in which a mission is held, or of the one after that."""
    if cause:
        return f"{state}: {cause}"
    return (
        f"{state}"
        if state in (MissionState.HELD, MissionState.BACKING_OFF, MissionState.DONE)
        else f"going on: {state}"
    )


GIVEN_UP = "the calibration drive is left out, as the robot was held elsewhere: slip and heading are learned on the way"
EXIT_STATUS = {
    SurveyOutcome.COMPLETE: ExitStatus.COMPLETE,
    SurveyOutcome.AT_BASE: ExitStatus.ABORTED,
    SurveyOutcome.STOPPED: ExitStatus.HELD,
    SurveyOutcome.NONE: ExitStatus.INTERRUPTED,
}


class SurveyRunner:
    """A survey as the main-loop process hosts it."""

    def __init__(self, cfg: Config, context: RunnerContext, parts: SurveyParts, store: MissionStore) -> None:
        self._cfg, self._context, self._parts, self._store = cfg, context, parts, store
        self._mirror, self._localizer, self._gate = parts.mirror, parts.localizer, parts.gate
        self._mission = mission = parts.mission
        self._session, self._clock = context.session, context.clock
        self._clock.resume_at(parts.elapsed_s)
        self._telemetry = telemetry = SurveyTelemetry(context.publisher, context.log)
        self._gate_log = GateLog(self._gate, telemetry.notify_operator)
        self._fans = FanController(
            cfg.robot.fan_duty, self._session, mission, telemetry, has_floor=bool(parts.mirror.overhang)
        )
        self._commands = CommandHistory(cfg.robot, cfg.sim.robot.frame_hz)
        self._session.on_drive = self._commands.add
        self._etalon = EtalonClient(cfg.etalon, parts.mirror.channels, parts.mirror.collimators_m, self._on_retry)
        self._fix_service = FixService(
            cfg.mission,
            self._etalon,
            FixGate(parts.mirror, cfg),
            parts.localizer,
            mission,
            store,
            telemetry,
            context.answer,
            # lockstep time stands still meanwhile
            lambda: 0.0 if self._session.is_lockstep else cfg.etalon.measuring_time_s,
        )
        self._checkpoint = CheckpointWriter(context.run_dir, parts.localizer, mission, is_patient=context.is_patient)
        self._watch = SurveyWatch(cfg, parts, telemetry)
        self._mirror_check: MirrorCheck | None = MirrorCheck(parts.mirror)
        self._recovery = parts.recovery
        self._is_odometry_off = False
        self._state = MissionState.IDLE
        self._motion: StateEstimate | None = None
        self._has_reported_calibration = False
        self._sent_commands: tuple[tuple[float, float, float, float], int] | None = None
        # An operator's commands are the mission's; so is what holds it.
        self.pause, self.resume, self.abort, self.stop = mission.pause, mission.resume, mission.abort, mission.stop
        self.interrupt, self.on_tracking_gap = mission.interrupt, mission.lose_sight

    @property
    def telemetry(self) -> SurveyTelemetry:
        """Tells the others."""
        return self._telemetry

    @property
    def cause(self) -> str:
        """Why it is held."""
        return self._mission.cause

    @property
    def is_paused(self) -> bool:
        """Held until somebody resumes."""
        return self._mission.is_paused

    @property
    def is_busy(self) -> bool:
        """A measurement is under way."""
        return self._fix_service.is_busy

    @property
    def is_at_rest(self) -> bool:
        """The robot is at rest."""
        control = self._cfg.control
        return (
            abs(self._localizer.speed_m_s) <= control.settle_speed_m_s
            and abs(self._localizer.rate_rad_s) <= control.settle_rate_rad_s
        )

    def status(self) -> MissionStatus:
        """Progress of the mission."""
        mission = self._mission
        stop = mission.journey.current
        point = stop.point if stop is not None else None
        if mission.is_paused:
            point = mission.survey.next_point
        return MissionStatus(
            seq=self._clock.seq,
            t_s=self._clock.t_s,
            state=str(mission.state),
            cause=mission.cause,
            done=len(mission.done) + self._parts.already_done,
            skipped=len(mission.skipped),
            total=self._parts.total_points,
            point=f"{point.row}-{point.col}-{point.point}" if point is not None else "",
            eta_s=round(mission.eta_s, 3),
            error_mm=1e3 * self._fix_service.arrival_error_m,
            outcome=str(mission.outcome),
            lower_bound_s=self._parts.lower_bound_s,
            left_out=dict(by_reason(mission.left_out)),
        )

    # -- beside the frames ----------------------------------------------------------------------------------------

    async def connect(self) -> None:
        """Connect to the laser system.

        Raises:
            UnreachableError: it does not answer.
        """
        try:
            await self._etalon.connect()
        except EtalonError as error:
            raise DaemonUnreachableError(str(error)) from error

    def _on_retry(self, error: EtalonError, tries_left: int) -> None:
        self._telemetry.log.warning("etalon_retry", error=str(error), tries_left=tries_left)

    async def run(self) -> None:
        """Take measurements, for ever."""
        await self._fix_service.run()

    async def close(self) -> None:
        """Close the files and the laser system."""
        self._checkpoint.close()
        await self._etalon.close()

    def check_robot(self, hello: Hello) -> None:
        """Refuse a robot whose own geometry contradicts the configuration."""
        self._parts.check_robot(hello)

    def begin_session(self, hello: Hello) -> None:
        """A session begins."""
        self._commands.begin(hello.frame_hz)
        self._checkpoint.boot = hello.boot
        self._fans.begin(hello.robot.fan_floor)

    def begin_drives(self) -> None:
        """The fans, before the first drive."""
        self._fans.send()

    def save_checkpoint(self) -> None:
        """Write down what a successor needs."""
        self._checkpoint.write(self._clock.seq, self._clock.t_s, self._clock.elapsed_s)

    def publish_state(self) -> None:
        """Tell a state that is new, and end where that is the end."""
        if self._mission.state is not self._state:
            self._on_state_change()

    def log_statistics(self) -> None:
        """What the gates refused."""
        self._telemetry.log.info("gate_statistics", denied=self._gate_log.counts, fans_refused=self._fans.refused)

    # -- the frame ------------------------------------------------------------------------------------------------

    def estimate(self, frame: TimedFrame) -> None:
        """The frame's samples go to the localizer, or as much of them as is to be believed."""
        sensors, mission, localizer = frame.sensors, self._mission, self._localizer
        self._publish_beginning(sensors)
        is_odometry_off = mission.ignores_motion
        if is_odometry_off is not self._is_odometry_off:
            self._is_odometry_off = is_odometry_off
            self._telemetry.publish_treatment(
                sensors.seq, sensors.t, "odometry_off" if is_odometry_off else "odometry_on"
            )
        imu, enc = ((), as_standing(sensors.enc)) if is_odometry_off else (sensors.imu, sensors.enc)
        localizer.step(sensors.t, imu, enc, sensors.edge, sensors.gravity)
        if localizer.hold_requested:
            # A filter that diverged is frozen until it has a fix.
            mission.recover(localizer.hold_cause, frame.t_s)
            localizer.clear_hold()
        self._motion = self._state_estimate(frame) if frame.dt_s > 0.0 else None

    def _publish_beginning(self, sensors: Sensors) -> None:
        """Where the localizer of a loop that takes over begins: who replays the run has to know."""
        recovery, self._recovery = self._recovery, None
        if recovery is not None:
            pose, sigmas = recovery.pose, (recovery.position_sigma_m, recovery.heading_sigma_rad)
            values = (pose.x_m, pose.y_m, pose.heading_rad, *sigmas)
            self._telemetry.publish_treatment(sensors.seq, sensors.t, "begun", values)

    def _state_estimate(self, frame: TimedFrame) -> StateEstimate:
        localizer, echo = self._localizer, frame.sensors.cmd
        pose, v, omega, creep = localizer.pose, localizer.speed_m_s, localizer.rate_rad_s, localizer.creep
        place = pose.x_m, pose.y_m, pose.heading_rad
        ahead = self._commands.predictor.ahead(place, v, omega, echo.seq, echo.age, echo.held, creep)
        return StateEstimate(
            frame.t_s, frame.dt_s, pose, self._mirror.deck_pose, v, omega, creep, ahead, self._position_sigma_m
        )

    def _position_sigma_m(self) -> float:
        return self._localizer.position_sigma_m

    def plan(self, frame: TimedFrame, verdict: Verdict | None, lag_s: float) -> DriveCommand:
        """What the mission wants, as far as the gate lets it through."""
        mission, motion = self._mission, self._motion
        if motion is None:
            raise RuntimeError("plan comes after estimate, and not for a stale frame")
        command = mission.step(motion, verdict) if self._is_on_mirror(frame.sensors) else HOLD_POSITION
        self._apply_requests(frame.sensors)
        right, left = self._gate.pass_through(command.twist, verdict, motion.dt_s, motion.t_s, lag_s, mission.purpose)
        self._gate_log.update(motion.t_s)
        if command.at_rest or command.measure:
            self._execute(command, motion)
        self._note_commands(frame)
        return DriveCommand(right, left)

    def hold(self, frame: TimedFrame) -> DriveCommand:
        """The robot stands, and nothing is decided in this frame."""
        self._note_commands(frame)
        return STILL

    def _note_commands(self, frame: TimedFrame) -> None:
        """What the wheels were told since the last estimate, where one is due."""
        is_due = frame.is_first or is_estimate_due(frame.sensors.seq)
        self._sent_commands = self._commands.since_last_estimate() if is_due else None

    def _is_on_mirror(self, sensors: Sensors) -> bool:
        """Whether the robot may move, as far as gravity knows: it stands on the mirror of the configuration.

        In lockstep the mission begins at once, and ends when gravity contradicts: nothing real can be harmed, and a run
        stays the same function of its seed.
        """
        check = self._mirror_check
        if check is None:
            return True
        if check.hear(sensors.t, sensors.gravity, self._localizer.deck_pose):
            self._mirror_check = None
            if check.warning:
                self._telemetry.notify_operator("warning", check.warning)
        if check.contradiction:
            self._telemetry.notify_operator("error", check.contradiction)
            self._context.finish(ExitStatus.USAGE)
            return False
        return self._mirror_check is None or self._session.is_lockstep

    def _apply_requests(self, sensors: Sensors) -> None:
        """What the mission wants besides the drive, before that is sent."""
        mission, health = self._mission, self._cfg.health
        if mission.doubts_pose:
            mission.doubts_pose = False
            doubt = health.doubt_position_m, health.doubt_heading_rad
            self._localizer.doubt(*doubt)
            self._telemetry.publish_treatment(sensors.seq, sensors.t, "doubted", doubt)
        if mission.wants_calibration and not self._has_reported_calibration:
            self._has_reported_calibration = True
            self._telemetry.notify_operator("warning", GIVEN_UP)
        if mission.wants_full_fans:
            self._fans.set_full()  # pressed on first, held then
        if mission.is_faulted:
            self._watch.check_unattended_fault(sensors)

    def _execute(self, command: MissionCommand, motion: StateEstimate) -> None:
        mission, seq = self._mission, self._clock.seq
        if command.at_rest:
            self._localizer.rest()
            self._telemetry.publish_rest(seq, motion.t_s)
        if command.arrived is not None:
            error_m = mission.survey.distance_m(motion.pose)
            self._telemetry.publish_arrival(seq, motion.t_s, command.arrived, error_m)
            self._store.record_arrival(command.arrived, motion.t_s, error_m)
        if command.measure:
            pose = self._localizer.deck_pose
            expected = self._mirror.puck_world(pose, self._cfg.robot.puck_height_m)
            # The localizer dates a fix by the robot's own clock.
            t_s = motion.t_s - self._clock.offset_s
            self._fix_service.begin(FixRequest(mission.request, t_s, mission.measuring_point, expected, pose))

    def publish(self, frame: TimedFrame) -> None:
        """The estimate, the checkpoint, a state that is new."""
        seq, t_s = frame.sensors.seq, frame.sensors.t
        self._telemetry.publish_frame(
            seq, t_s, self._localizer, self._mission.state, frame.raw, self._sent_commands, is_first=frame.is_first
        )
        self._checkpoint.write_if_due(seq, t_s, self._clock.elapsed_s)
        self.publish_state()

    def _on_state_change(self) -> None:
        mission = self._mission
        before, self._state = self._state, mission.state
        self._watch.publish_state_change(before, self._clock.seq)
        if mission.state is MissionState.DONE:
            self._context.finish(EXIT_STATUS[mission.outcome])
        elif mission.is_faulted and self._session.is_lockstep:
            # Nobody can be waited for while simulated time runs at many times the wall clock.
            self._context.finish(EXIT_STATUS[SurveyOutcome.STOPPED])


def survey_runner_config(cfg: Config) -> RunnerConfig:
    """What the process needs of the configuration of a survey."""
    return RunnerConfig(
        cfg.robot,
        cfg.run.realtime_priority,
        cfg.mission.verdict_timeout_s,
        cfg.health.clock_jump_s,
        cfg.sim.robot.frame_hz,
    )


@contextmanager
def open_survey(args: ProcessArgs) -> Iterator[RunnerFactory]:
    """The parts and the database of a survey, new or taken over; what makes the mission of them."""
    parts, store = build_parts(args)
    with store:
        yield lambda context: SurveyRunner(args.config, context, parts, store)
