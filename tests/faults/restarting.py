"""Missions in process whose main loop dies and is followed by another one, which knows what the first one kept."""

from math import hypot

from ccatp.config.models import Config
from ccatp.control.prediction import CommandPredictor
from ccatp.core import DeckPose, PointId
from ccatp.links.robot_messages import Sensors
from ccatp.studies.sil_models import SilResult
from ccatp.studies.sil_run import SilRun
from ccatp.survey.composition import assemble
from ccatp.survey.heading_recovery import TakeoverState, doubted
from ccatp.survey.state import DRIVING, RETURNING, TURNING, MissionState

MOVING = (TURNING, DRIVING, RETURNING, MissionState.BACKING_OFF)
RECORD_FRAMES = 10
LONGEST_S = 900.0


class RestartingRehearsal(SilRun):
    """A rehearsal in which the main loop is killed at given frames.

    Args:
        cfg: the configuration.
        kills: numbers of the frames after which main is gone.
        silent_frames: for how long the robot is without a controller, each time.
    """

    def __init__(self, cfg: Config, kills: set[int], silent_frames: int = 150) -> None:
        super().__init__(cfg, with_track=False)
        self._kills, self._silent_frames = kills, silent_frames
        self._records: list[tuple[DeckPose, tuple[float, float], tuple[float, float], MissionState]] = []
        self.done: list[PointId] = []
        self.states: list[MissionState] = []
        self.heading_errors_rad: list[float] = []
        self.first_moves_m: list[float] = []

    def run(self) -> SilResult:
        """As of a rehearsal, with whichever mission is the present one."""
        robot = self.robot
        robot.join_monitor()
        robot.join_controller()
        self._note_truth()
        while robot.delivered is None:
            robot.advance()
            self._note_truth()
        robot.command_fans(1, *self.cfg.robot.fan_duty)
        first_s = robot.delivered.t
        last_s = first_s - robot.frame_s
        while not (self.mission.state is MissionState.DONE or self.mission.is_faulted or last_s - first_s > LONGEST_S):
            frame = robot.delivered
            self._serve(frame, frame.t - last_s)
            last_s = frame.t
            robot.advance()
            self._note_truth()
        return self._result(last_s - first_s)

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        super()._serve(frame, dt_s)
        if frame.seq % RECORD_FRAMES == 0:
            localizer = self.localizer
            sigmas = localizer.position_sigma_m, localizer.heading_sigma_rad
            speeds = localizer.speed_m_s, localizer.rate_rad_s
            self._records.append((localizer.deck_pose, sigmas, speeds, self.mission.state))
        if frame.seq in self._kills:
            self._die()

    def _die(self) -> None:
        robot = self.robot
        self.states.append(self.mission.state)
        self.done += self.mission.done
        robot.lose_controller()
        for _ in range(self._silent_frames):
            robot.advance()
            self._note_truth()
        robot.join_controller()
        self._take_over()

    def _take_over(self) -> None:
        cfg = self.cfg
        pose, sigmas, speeds, state = self._records[-1]
        limits = cfg.limits.a_max_m_s2, cfg.limits.alpha_max_rad_s2
        sigma_m, sigma_rad = doubted(sigmas, speeds, limits, stood=state not in MOVING)
        recovery = TakeoverState(pose, sigma_m, sigma_rad, abort_cause=self.mission.abort_cause)
        parts = assemble(cfg, self.done, recovery)
        truth = self.robot.world.plant
        self.first_moves_m.append(hypot(truth.x_m - pose.x_m, truth.y_m - pose.y_m) / sigma_m)
        self.heading_errors_rad.append((truth.heading_rad - pose.heading_rad) / sigma_rad)
        self.localizer, self.mission, self.gate = parts.localizer, parts.mission, parts.gate
        self.predictor = CommandPredictor(cfg.robot.wheel_lag_s, self.robot.frame_s)

    @property
    def measured(self) -> list[PointId]:
        """All points measured, by whichever main loop, in their order."""
        return self.done + self.mission.done
