"""The mission in virtual time: an ideal robot on one panel, verdicts as scripted."""

from collections.abc import Callable, Collection, Sequence
from math import cos, exp, sin
from types import SimpleNamespace
from typing import Any, cast

from msgspec.structs import replace

from ccatp.conditions.danger import EMERGENCY, RIM_AHEAD
from ccatp.config.models import Config
from ccatp.core import DeckPose, EventCode, PanelId, PanelPose, PointId, Stop, StopKind, Twist, Verdict
from ccatp.mirror.mirror import Mirror
from ccatp.survey.behaviours import MissionCommand
from ccatp.survey.events import FixStored, Mode
from ccatp.survey.planning.route import Route, RoutePlanner
from ccatp.survey.route_follower import StateEstimate
from ccatp.survey.state import SurveyState
from ccatp.survey.statechart import Mission, Survey

DT, LAG = 0.01, 0.08
PANEL = PanelId(5, 5)
FREE = Verdict.normal(0, 0.0)
FRONT_OFF = replace(
    FREE, code=EventCode.NEAR_EDGE, cause=RIM_AHEAD.cause(), forward=False, turn=False, off=(True, True, False, False)
)
ABORT = replace(FREE, code=EventCode.ABORTED, cause=EMERGENCY.cause(kind="fire"), raised=1)


class Story:
    """A mission, an ideal robot, and what was ordered so far."""

    def __init__(self, config: Config, mirror: Mirror) -> None:
        self.config, self.mirror = config, mirror
        self.stops = tuple(
            Stop(*mirror.point_on_deck(PointId(5, 5, k)), StopKind.MEASURE, PointId(5, 5, k)) for k in (1, 2, 3)
        )
        self.mission = Mission(Survey(config, mirror, self.route_of(self.stops), self.planner()))
        self.plans: list[DeckPose] = []
        start = mirror.point_on_deck(PointId(5, 5, 4))
        pose = mirror.panel_pose(PANEL, DeckPose(*start, 0.0))
        self.x, self.y, self.heading = pose.x_m, pose.y_m, pose.heading_rad
        self.v = self.omega = self.t = 0.0
        self.base = start
        self.orders: list[MissionCommand] = []
        self.auto_fix = True

    @staticmethod
    def route_of(stops: tuple[Stop, ...]) -> Route:
        left = tuple(float(len(stops) - k) for k in range(len(stops) + 1))
        return Route(stops, left)

    @property
    def state(self) -> SurveyState:
        return self.mission.state

    def planner(self, **methods: Any) -> RoutePlanner:
        """Of the story, but for some methods."""
        plans = {"home": self.plan_home, "rejoin": self.plan_rest, "route": self.plan_due} | methods
        return cast(RoutePlanner, SimpleNamespace(**plans))

    def plan_due(self, start: DeckPose, points: Sequence[PointId]) -> Route:
        self.plans.append(start)
        return self.route_of(tuple(stop for point in points for stop in self.stops if stop.point == point))

    def plan_rest(self, _route: Route, start: DeckPose, skip: Collection[PointId]) -> Route:
        self.plans.append(start)
        return self.route_of(tuple(stop for stop in self.stops if stop.point not in skip))

    def plan_home(self, _start: DeckPose) -> tuple[Stop, ...]:
        return (Stop(*self.base, StopKind.BASE, heading_rad=1.0),)

    def motion(self) -> StateEstimate:
        pose = PanelPose(PANEL, self.x, self.y, self.heading)
        return StateEstimate(self.t, DT, pose, self.v, self.omega)

    def deck(self) -> DeckPose:
        return self.mirror.deck_pose(self.motion().pose)

    def frame(self, verdict: Verdict | None = FREE) -> MissionCommand:
        order = self.mission.step(self.motion(), verdict)
        self.orders.append(order)
        if order.measure and self.auto_fix:
            self.mission.handle(FixStored(self.state.measuring_point))
        self.move(order.twist)
        return order

    def move(self, twist: Twist) -> None:
        keep = exp(-DT / LAG)
        v, omega = twist.v_m_s, twist.omega_rad_s
        middle = self.heading + 0.5 * self.omega * DT
        mean = v + (self.v - v) * LAG * (1.0 - keep) / DT
        self.x += mean * DT * cos(middle)
        self.y += mean * DT * sin(middle)
        self.heading += (omega + (self.omega - omega) * LAG * (1.0 - keep) / DT) * DT
        self.v, self.omega = v + (self.v - v) * keep, omega + (self.omega - omega) * keep
        self.t += DT

    def until(self, is_there: Callable[[], bool], verdict: Verdict | None = FREE, frames: int = 3000) -> None:
        for _ in range(frames):
            if is_there():
                return
            self.frame(verdict)
        raise AssertionError(f"still {self.state.mode} ({self.state.cause}) after {frames} frames")

    def drive_on(self) -> None:
        """Until it is at speed on a leg."""
        self.until(lambda: self.state.mode is Mode.DRIVING and self.v > 0.09)

    def finish(self) -> None:
        """The rest of the survey: it is complete."""
        self.until_state(Mode.DONE)
        assert [p.point for p in self.state.points.done] == [1, 2, 3]

    def until_state(self, state: Mode, verdict: Verdict | None = FREE) -> None:
        self.until(lambda: self.state.mode is state, verdict)


def from_first_leg(config: Config) -> Config:
    """Stories begin with the first leg, not with the fix before it."""
    return config.model_copy(update={"mission": config.mission.model_copy(update={"fix_at_start": False})})
