"""A kind of mission of another package, as small as it can be: the survey's robot drives a square, by time alone."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import cos, pi, sin
from pathlib import Path
from typing import Any, Literal

from msgspec.structs import replace

from ccatp.config import models
from ccatp.config.load import DEFAULT_FILE, Overrides, layers, load_config, merged, validated
from ccatp.core import NO_CAUSE, Verdict
from ccatp.daemon.loops import mission_runner
from ccatp.daemon.loops.mission_runner import STILL, DriveCommand, TimedFrame
from ccatp.dataloop import StandIn, StandInOptions, survey_stand_in
from ccatp.links import topics
from ccatp.links.bus import Telemetry
from ccatp.missions import MissionKind, Part
from ccatp.survey import failsafe
from ccatp.survey.engagement import EngagedMission, Engagement, EngagementRules, Event, Kind, Phase, enter
from ccatp.survey.events import DONE, DRIVING, SurveyOutcome

SPEED_M_S, TURN_RAD_S, SIDES = 0.05, 0.5, 4


class SquareConfig(models.Model):
    system: Literal["square"]
    side_m: models.Positive = 0.2
    run: models.RunConfig
    robot: models.RobotConfig
    danger: models.DangerConfig
    mission: models.MissionConfig
    observatory: models.ObservatoryConfig
    alarms: models.AlarmsConfig
    dashboard: models.DashboardConfig
    sim: models.SimConfig

    @property
    def processes(self) -> models.ProcessesConfig:
        return self.run


def load(file: Path | None = None, overrides: Overrides = None, *, any_ports: bool = False) -> SquareConfig:
    command, user, base = sources = layers(DEFAULT_FILE, file, overrides, any_ports=any_ports)
    shipped = {name: base.tree[name] for name in SquareConfig.model_fields if name in base.tree}
    return validated(SquareConfig, merged(merged(shipped, user.tree), command.tree), sources)


def stand_in(cfg: SquareConfig, options: StandInOptions) -> StandIn:
    return survey_stand_in(load_config(None, {"run.seed": cfg.run.seed, "run.world": "thesis"}), options)


class Driving(Phase, frozen=True, tag=True):
    kind, shown = Kind.WORK, DRIVING


class Rules(EngagementRules[Engagement]):
    rows = (*(failsafe.ON_EARTHQUAKE, failsafe.ON_FAULT, failsafe.ON_UNKNOWN, failsafe.ON_HOLD),
            *(failsafe.ON_NO_VERDICT, failsafe.ON_EMERGENCY))  # fmt: skip

    def proceed(self, s: Engagement) -> Engagement:
        if s.abort_cause:  # it has no way home
            return self.finish(s, SurveyOutcome.STOPPED)
        return enter(replace(s, cause=NO_CAUSE), Event.GO_ON, Driving())


class Runner(mission_runner.MissionRunner):
    """Drives each side, then turns by a right angle; ``_lasts_s``: how long it has driven the side, or turned."""

    def __init__(self, cfg: SquareConfig, host: mission_runner.MissionHost) -> None:
        telemetry = Telemetry(host.publisher, host.log, "square_track", topics.TrackBatch)
        super().__init__(EngagedMission(Rules(), Engagement()), telemetry)
        self._cfg, self._host = cfg, host
        self._drive, self._pose = STILL, (0.0, 0.0, 0.0)
        self._sides, self._lasts_s, self._is_turning = 0, 0.0, False

    @property
    def is_at_rest(self) -> bool:
        return self._drive == STILL

    def status(self) -> topics.MissionStatus:
        state, at = self.mission.state, self._host.clock
        now = topics.MissionStatus(seq=at.seq, t_s=at.t_s, state=state.mode, outcome=state.outcome)
        return replace(now, done=self._sides, total=SIDES)

    def display_state(self) -> topics.DisplayState:
        x_m, y_m, heading_rad = self._pose
        return topics.DisplayState(
            seq=self.telemetry.seq, t_s=self.telemetry.t_s, x_m=x_m, y_m=y_m, heading_rad=heading_rad, nis=0.0, size=0,
            covariance_m2=(0.0, 0.0, 0.0), heading_sigma_rad=0.0, line=self.telemetry.newest_line,
        )  # fmt: skip

    def check_robot(self, hello: Any) -> None: ...
    def on_tracking_gap(self) -> None: ...
    def log_statistics(self) -> None: ...
    def estimate(self, frame: TimedFrame) -> None: ...

    def decide(self, frame: TimedFrame, verdict: Verdict | None, _lag_s: float) -> DriveCommand:
        mission, robot, (x, y, heading) = self.mission, self._cfg.robot, self._pose
        if not all(mission.react(frame, verdict).permits(verdict)):
            return self.hold(frame)
        self._lasts_s += frame.dt_s
        v, omega, until = (0.0, TURN_RAD_S, 0.5 * pi) if self._is_turning else (SPEED_M_S, 0.0, self._cfg.side_m)
        if self._lasts_s * (v + omega) >= until:
            self._lasts_s, self._is_turning, self._sides = 0.0, not self._is_turning, self._sides + self._is_turning
        if self._sides == SIDES:
            mission.finish(SurveyOutcome.COMPLETE)
            return self.hold(frame)
        self._pose = x + v * cos(heading) * frame.dt_s, y + v * sin(heading) * frame.dt_s, heading + omega * frame.dt_s
        rates = (v + side * 0.5 * omega * robot.wheel_base_m for side in (1.0, -1.0))
        self._drive = DriveCommand(*(rate / robot.wheel_radius_m for rate in rates))
        return self._drive

    def hold(self, _frame: TimedFrame) -> DriveCommand:
        self._drive = STILL
        return STILL

    def publish(self, frame: TimedFrame) -> None:
        seq, t_s = frame.sensors.seq, frame.sensors.t
        if frame.is_estimate_due:
            state = str(self.mission.state.mode)
            self.telemetry.send("estimate", topics.EstimateMessage(*self._pose, 0.0, state, seq=seq, t_s=t_s))
        self.telemetry.add_frame(seq, t_s, frame.raw, (seq, t_s, *self._pose))
        self.publish_state()

    def publish_state(self) -> None:
        if self.mission.state.mode is DONE:
            self._host.finish(mission_runner.EXIT_STATUS[self.mission.state.outcome])


@contextmanager
def open_square(cfg: SquareConfig, _args: Any) -> Iterator[Callable[[mission_runner.MissionHost], Runner]]:
    yield lambda host: Runner(cfg, host)


HERE = "tests.support.square"
TOPICS = (topics.Topic("square_track", topics.TrackBatch, "main", 1.0, 0.0, True),)
SQUARE = MissionKind(
    systems=("square",), title="drive around a square", no_resume="it is short", load=Part(f"{HERE}:load"),
    runner=Part(f"{HERE}:open_square"), stand_in=Part(f"{HERE}:stand_in"), topics=Part(f"{HERE}:TOPICS"),
)  # fmt: skip
