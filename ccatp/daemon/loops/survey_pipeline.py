"""A survey's frames, from samples to set points: in the main loop, and in a run in one process."""

from typing import Protocol

from ccatp.config.models import Config
from ccatp.control.wheel_motion import SentDrives
from ccatp.core import Verdict
from ccatp.daemon.loops.mission_runner import DriveCommand, TimedFrame
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage, TreatmentKind
from ccatp.sensing.wheel_means import as_standing
from ccatp.survey.behaviours import MissionCommand
from ccatp.survey.composition import SurveyParts
from ccatp.survey.events import EstimateDiverged, Mode
from ccatp.survey.route_follower import StateEstimate


class SurveySink(Protocol):
    """What a survey's frames send, report and record besides the drives."""

    def begin_drives(self) -> None:
        """Send the fans' duties, before the first drive and whenever they change."""

    def record_treatment(self, sensors: Sensors, kind: TreatmentKind, values: tuple[float, ...] = ()) -> None:
        """Record, for a replay, that the samples of a frame are not used as they were received."""

    def execute(self, command: MissionCommand, motion: StateEstimate) -> None:
        """Handle a command with ``at_rest`` or ``measure``."""

    def after_requests(self, sensors: Sensors, command: MissionCommand) -> None:
        """The mission gave requests in this frame, or is faulted, or gives up the calibration drive."""

    def report_grip(self) -> None:
        """The grip was measured for the first time, in the turns of the calibration drive."""


class SurveyPipeline:
    """Processes a survey's frames: localizer, mission, gate, thrust. ``sink`` gets everything but the drives.

    ``sent``: the drives that were sent. ``motion``: estimate of the newest frame, ``None`` if it is stale.
    """

    def __init__(self, cfg: Config, parts: SurveyParts, frame_s: float, sink: SurveySink) -> None:
        self._cfg = cfg
        self._sink = sink
        self.parts = parts
        self.mirror = parts.mirror
        self.thrust = parts.thrust
        self.localizer = parts.localizer
        self.mission = parts.mission
        self.gate = parts.gate
        self.sent = SentDrives(cfg.robot, frame_s)
        self.motion: StateEstimate | None = None
        self._sent_commands: tuple[tuple[float, float, float, float] | None, int] = None, -1
        self._start = parts.start
        self._is_odometry_off = False

    def estimate(self, frame: TimedFrame) -> None:
        """Pass the frame's samples to the localizer, as far as they are trusted."""
        sensors, mission, localizer = frame.sensors, self.mission, self.localizer
        self.parts.fix_review.add(sensors.imu, sensors.enc)
        start, self._start = self._start, None
        if start is not None:  # a replay needs the start pose of a localizer that takes over
            begun, sigmas = start
            self._sink.record_treatment(sensors, "begun", (begun.x_m, begun.y_m, begun.heading_rad, *sigmas))
        state = mission.state
        is_odometry_off = state.rejects_odometry
        if is_odometry_off is not self._is_odometry_off:
            self._is_odometry_off = is_odometry_off
            self._sink.record_treatment(sensors, "odometry_off" if is_odometry_off else "odometry_on")
        imu, enc = ((), as_standing(sensors.enc)) if is_odometry_off else (sensors.imu, sensors.enc)
        echo, set_points = sensors.cmd, None
        if frame.dt_s > 0.0:
            acted = self.sent.acted(frame.dt_s, echo.seq, echo.age, echo.permit_age, is_held=echo.held)
            set_points = None if is_odometry_off else acted
        localizer.step(sensors.t, imu, enc, sensors.edge, gravity=sensors.gravity, set_points=set_points)
        if localizer.coasted is not None:  # a replay does not know the drives
            self._sink.record_treatment(sensors, "coasted", localizer.coasted)
        if localizer.hold_cause:
            # A filter that diverged is frozen until the next fix.
            mission.handle(EstimateDiverged(localizer.hold_cause, frame.t_s))
            localizer.clear_hold()
        if frame.dt_s <= 0.0:
            self.motion = None
            return
        pose, v, omega, creep = localizer.pose, localizer.speed_m_s, localizer.rate_rad_s, localizer.creep
        place = pose.x_m, pose.y_m, pose.heading_rad
        ahead = self.sent.ahead(place, v, omega, echo.seq, echo_age_s=echo.age, is_held=echo.held, creep=creep)
        sigmas = localizer.position_sigma_m, self.parts.heading_sigma_rad()
        turn_creep_m_rad = self.parts.turn_creep_m_rad()
        self.motion = StateEstimate(
            frame.t_s, frame.dt_s, pose, v, omega, creep, ahead, *sigmas, turn_creep_m_rad, localizer.gap_s
        )

    def decide(self, frame: TimedFrame, verdict: Verdict | None, lag_s: float) -> DriveCommand:
        """The drive for the mission's velocity, as far as the gate permits it."""
        mission, motion, sensors = self.mission, self.motion, frame.sensors
        if motion is None:
            raise RuntimeError("plan comes after estimate, and not for a stale frame")
        command = mission.step(motion, verdict)
        state = mission.state
        if command.inflates_covariance or command.skips_calibration or state.full_fans or state.is_faulted:
            self._apply_requests(sensors, command)
            state = mission.state
        # The gate compares with the verdict's time, which is the robot's own and may have jumped.
        right, left = self.gate.pass_through(
            command.twist, verdict, motion.dt_s, sensors.t, age_s=lag_s, purpose=state.purpose
        )
        if command.at_rest or command.measure:
            self._sink.execute(command, motion)
        if frame.is_estimate_due:
            self._sent_commands = self.sent.take_span(), self.sent.newest
            turns = state.mode is not Mode.DRIVING
            is_measured = bool(self.thrust.friction)
            if self.parts.measure_grip() and not is_measured:
                self._sink.report_grip()
            if self.thrust.step(motion.t_s, self.localizer.deck_pose, turns=turns):
                self._sink.begin_drives()
        return DriveCommand(right, left)

    def hold(self, frame: TimedFrame) -> None:
        """Called instead of ``plan`` if the mission does not step in this frame."""
        if frame.is_estimate_due:
            self._sent_commands = self.sent.take_span(), self.sent.newest

    def _apply_requests(self, sensors: Sensors, command: MissionCommand) -> None:
        """Execute the requests of the mission before the drive is sent."""
        health = self._cfg.health
        if command.inflates_covariance:
            doubt = health.doubt_position_m, health.doubt_heading_rad
            self.localizer.inflate_covariance(*doubt)
            self._sink.record_treatment(sensors, "doubted", doubt)
        if self.mission.state.full_fans and self.thrust.give_all():  # thrust first, then the drive
            self._sink.begin_drives()
        self._sink.after_requests(sensors, command)

    def estimate_message(self, frame: TimedFrame) -> EstimateMessage:
        """The estimate for the danger loop."""
        deck, sensors = self.localizer.deck_pose, frame.sensors
        place = deck.x_m, deck.y_m, deck.heading_rad, self.localizer.position_sigma_m
        mode, grip = self.mission.state.mode.value, self.thrust.margin
        return EstimateMessage(*place, mode, *self._sent_commands, grip, seq=sensors.seq, t_s=sensors.t)
