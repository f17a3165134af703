"""A whole mission in one process: the daemon's own localizer, danger rules, mission and gate against the sim.

What the sockets carry is handed over directly; the order of events is that of lockstep, so that a rehearsal and a run
of the daemon with the same configuration and seed go through the same states.
"""

from collections import defaultdict

import numpy as np

from ccatp.config.models import Config
from ccatp.control.motion_checks import as_standing
from ccatp.control.prediction import CommandPredictor
from ccatp.core import EventCode, Fix, PanelPose, twist_of
from ccatp.danger import DangerMonitor
from ccatp.estimation.fixes import FixGated, FixRefused
from ccatp.links.robot_codec import set_point_on_wire
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage, is_estimate_due
from ccatp.localizer import Localizer
from ccatp.mirror.multilateration import MultilaterationError
from ccatp.safety.robot_clock import SteadyTime
from ccatp.safety.wheel_monitors import CommandSpan
from ccatp.sim.fault_plan import FaultPlan
from ccatp.sim.robot import Robot
from ccatp.studies.sil_models import SilLaser, SilResult, SilTrace
from ccatp.survey.composition import SurveyParts, assemble
from ccatp.survey.route_follower import StateEstimate
from ccatp.survey.state import DONE, MissionState, SurveyOutcome

# A mission that takes this many times its bound hangs; the robot's own deadlines should have ended it long before.
_ENDLESS = 6.0


def rehearse(cfg: Config, *, with_track: bool = False) -> SilResult:
    """Survey the mirror of a configuration in its world.

    Args:
        cfg: the configuration; ``run.seed`` seeds everything.
        with_track: keep true and estimated pose of every frame.
    """
    return SilRun(cfg, with_track=with_track).run()


class SilRun:
    """The processes' parts side by side.

    A subclass may exchange parts before ``run``, or look on by overriding what happens in a frame.

    Args:
        with_track: keep true and estimated pose of every frame.
        faults: what shall go wrong with the robot; ``FaultyRehearsal`` can serve it.
    """

    def __init__(self, cfg: Config, *, with_track: bool, faults: FaultPlan | None = None) -> None:
        self.cfg = cfg
        parts: SurveyParts = assemble(cfg)
        self.parts, self.mirror = parts, parts.mirror
        self.localizer: Localizer = parts.localizer
        self.mission, self.gate = parts.mission, parts.gate
        self.robot = Robot(cfg, self.mirror, np.random.default_rng(cfg.run.seed), faults)
        self.monitor = DangerMonitor(self.mirror, cfg.robot, cfg.danger, cfg.health)
        self.predictor = CommandPredictor(cfg.robot.wheel_lag_s, self.robot.frame_s)
        self.laser = SilLaser(cfg, self.mirror, self.robot)
        self.book = SilTrace(parts, with_track=with_track)
        self.states_s: defaultdict[MissionState, float] = defaultdict(float)
        self.notices: list[str] = []
        self._published: EstimateMessage | None = None
        self._sigma_of = lambda: self.localizer.position_sigma_m
        self._code = EventCode.NORMAL
        self._drive_seq = 0
        self._driven = (0.0, 0.0)
        self._span = CommandSpan()
        self._time = SteadyTime(cfg.health.clock_jump_s)
        self._has_full_fans = False
        self._state, self._state_s = MissionState.IDLE, 0.0
        self._wheels_m = cfg.robot.wheel_radius_m, cfg.robot.wheel_base_m

    def run(self) -> SilResult:
        """From the first frame to the end of the mission."""
        robot, mission = self.robot, self.mission
        robot.join_monitor()
        robot.join_controller()
        self._note_truth()
        while robot.delivered is None:
            robot.advance()
            self._note_truth()
        robot.command_fans(1, *self.cfg.robot.fan_duty)
        first_s = t_s = self._time.at(robot.delivered.seq, robot.delivered.t)
        last_s = first_s - robot.frame_s
        limit_s = _ENDLESS * self.parts.lower_bound_s + 600.0
        while mission.state is not DONE:
            frame = robot.delivered
            is_news = frame.seq > self.monitor.verdict.seq
            t_s = self._time.at(frame.seq, frame.t) if is_news else last_s
            self._serve(frame, t_s - last_s)
            last_s = t_s
            if mission.is_faulted or t_s - first_s > limit_s:
                break
            robot.advance()
            self._note_truth()
        return self._result(t_s - first_s)

    def _note_truth(self) -> None:
        robot = self.robot
        self.book.note_truth(robot.world.truth_row(robot.seq, robot.t_s))

    # -- a frame, as in processes.main_loop and processes.danger_loop -------------------------------------------------

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        localizer, mission, robot = self.localizer, self.mission, self.robot
        seq, t_s = frame.seq, frame.t
        # Main publishes a pose in five frames; the verdict on a frame waits for the newest that is due before it.
        verdict = self.monitor.step(frame, self._published)
        if verdict.code is not self._code:
            self._code = verdict.code
            self.book.builder.add_verdict_event(seq, verdict.code)
        is_deaf = mission.ignores_motion
        imu, enc = ((), as_standing(frame.enc)) if is_deaf else (frame.imu, frame.enc)
        localizer.step(t_s, imu, enc, frame.edge, frame.gravity)
        if localizer.hold_requested:
            mission.recover(localizer.hold_cause, t_s + self._time.offset_s)
            localizer.clear_hold()
        motion = self._motion(frame, dt_s)
        order = mission.step(motion, verdict)
        if mission.doubts_pose:
            mission.doubts_pose = False
            localizer.doubt(self.cfg.health.doubt_position_m, self.cfg.health.doubt_heading_rad)
        if mission.wants_full_fans and not self._has_full_fans:
            self._has_full_fans = True
            robot.command_fans(2, 1.0, 1.0)
        right, left = self.gate.pass_through(order.twist, verdict, dt_s, t_s, 0.0, mission.purpose)
        if order.at_rest:
            localizer.rest()
            if order.arrived is not None:
                self.book.builder.add_arrival(order.arrived, seq)
        state = mission.state
        if state is not self._state:
            self._note_state(state)
        self._state_s += dt_s
        self._publish(seq, t_s, motion.pose, state)
        if order.measure:
            self._measure(frame)
            right = left = 0.0  # the held frame is answered by zeros
        self._drive_seq = number = self._drive_seq + 1
        self._foresee(number, right, left)
        robot.permit(number, verdict.forward, verdict.reverse, verdict.turn)
        robot.drive(number, set_point_on_wire(right), set_point_on_wire(left))

    def _motion(self, frame: Sensors, dt_s: float) -> StateEstimate:
        localizer, echo = self.localizer, frame.cmd
        pose, v, omega, creep = localizer.pose, localizer.speed_m_s, localizer.rate_rad_s, localizer.creep
        here = pose.x_m, pose.y_m, pose.heading_rad
        ahead = self.predictor.ahead(here, v, omega, echo.seq, echo.age, echo.held, creep)
        return StateEstimate(
            frame.t + self._time.offset_s, dt_s, pose, self.mirror.deck_pose, v, omega, creep, ahead, self._sigma_of
        )

    def _foresee(self, number: int, right: float, left: float) -> None:
        self._driven = right, left
        self._span.add(right, left)
        twist = twist_of(right, left, *self._wheels_m)
        self.predictor.sent(number, twist.v_m_s, twist.omega_rad_s)

    def _note_state(self, state: MissionState) -> None:
        """Another state begins, or the mission is over in it."""
        self.states_s[self._state] = self._state_s
        self._state, self._state_s = state, self.states_s[state]

    def _publish(self, seq: int, t_s: float, pose: PanelPose, state: MissionState) -> None:
        self.book.note_estimate(seq, t_s, pose)
        if is_estimate_due(seq):
            deck, sigma_m = self.localizer.deck_pose, self.localizer.position_sigma_m
            x_m, y_m, heading_rad = deck.x_m, deck.y_m, deck.heading_rad
            self._published = EstimateMessage(
                seq=seq,
                t_s=t_s,
                x_m=x_m,
                y_m=y_m,
                heading_rad=heading_rad,
                sigma_m=sigma_m,
                state=state,
                commanded=self._span.take(*self._driven),
                drive_seq=self._drive_seq,
            )

    # -- a measurement, as in processes.measuring ---------------------------------------------------------------------

    def _measure(self, frame: Sensors) -> None:
        mission, localizer, laser = self.mission, self.localizer, self.laser
        point = mission.measuring_point
        row = None
        if point is not None:
            row = laser.stop_row(frame.t, point, self.book.truth_at(frame.seq), localizer)
        try:
            fix = laser.fix(frame.t, localizer.deck_pose)
            self._fuse(fix)
        except (MultilaterationError, FixRefused) as error:
            mission.not_fixed(point, str(error))
            return
        self.notices += localizer.notices
        localizer.notices.clear()
        if point is not None and row is not None:
            distance_m = mission.survey.distance_m(localizer.pose)
            if laser.is_too_far(row, point, fix, distance_m, localizer):
                mission.again()
                return
        mission.fixed(point)

    def _fuse(self, fix: Fix) -> None:
        """A fix that contradicts the estimate is measured again until it is accepted or refused for good."""
        while True:
            try:
                self.localizer.fuse_fix(fix)
            except FixGated:
                continue
            return

    def _result(self, mission_time_s: float) -> SilResult:
        mission, misalignments = self.mission, self.robot.world.misalignments
        self._note_state(self._state)
        return SilResult(
            summary=self.book.summary(mission, mission_time_s, self.laser.panel_fits(), misalignments),
            stops=self.laser.stops,
            corrections=mission.corrections,
            counts=dict(self.localizer.counts),
            outcome=str(mission.outcome if mission.state is DONE else SurveyOutcome.STOPPED),
            cause=mission.cause,
            states_s={str(state): time_s for state, time_s in self.states_s.items()},
            track=self.book.track(),
            notices=self.notices,
        )
