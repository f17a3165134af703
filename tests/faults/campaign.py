"""Missions in process with random plans of faults that pass by, and what became of them."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import hypot
from typing import NamedTuple

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, Severity, Verdict
from ccatp.links.robot_messages import Sensors
from ccatp.sim.fault_models import Injected
from ccatp.sim.fault_plan import FaultPlan, parse_plan
from ccatp.studies.faults_study import FaultySilRun, random_plan
from ccatp.studies.sil_models import SilResult
from ccatp.survey.state import MissionState

LAST_S = 80.0
FAULTS_PER_MISSION = 4


class Seen(NamedTuple):
    """One frame of a watched mission: what the robot was told after it, and where it really was."""

    t_s: float
    verdict: Verdict
    state: MissionState
    cause: str
    drive: tuple[float, float]
    pose: DeckPose
    estimate: tuple[float, float]

    @property
    def is_zero(self) -> bool:
        return self.drive == (0.0, 0.0)


class _Enough(Exception):
    """Seen what was to be seen."""


class Watched(FaultySilRun):
    """Keeps what happened frame by frame; ends as soon as somebody has seen enough."""

    def __init__(self, cfg: Config, plan: FaultPlan) -> None:
        super().__init__(cfg, plan)
        self.seen: list[Seen] = []
        self.is_enough: Callable[[Seen], bool] = lambda _: False

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        super()._serve(frame, dt_s)
        deck = self.localizer.deck_pose
        mission, plant = self.mission, self.robot.world.plant
        now = Seen(
            self.robot.t_s, self.monitor.verdict, mission.state, mission.cause, self._driven, plant.pose,
            (deck.x_m, deck.y_m),
        )  # fmt: skip
        self.seen.append(now)
        if self.is_enough(now):
            raise _Enough

    def watch(self, is_enough: Callable[[Seen], bool]) -> SilResult | None:
        """Run until it is enough, or to the end: then its result."""
        self.is_enough = is_enough
        try:
            return self.run()
        except _Enough:
            return None

    def since(self, t_s: float) -> list[Seen]:
        return [one for one in self.seen if one.t_s >= t_s - 1e-9]

    def first(self, t_s: float, is_it: Callable[[Seen], bool]) -> Seen:
        """The first frame from ``t_s`` on of which something is true."""
        return next(one for one in self.since(t_s) if is_it(one))

    def time_to_zero_s(self, t_s: float) -> float:
        """From ``t_s`` to the first zero drive of the hold that follows."""
        held = self.first(t_s, lambda one: one.verdict.severity >= Severity.PAUSE or one.verdict.code != 0)
        return self.first(held.t_s, lambda one: one.is_zero).t_s - t_s

    def way_m(self, t_s: float, until_s: float) -> float:
        """True travel of the robot's centre."""
        poses = [one.pose for one in self.since(t_s) if one.t_s <= until_s]
        return sum(hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in pairwise(poses))


def short_survey(world: str = "hard", **overrides: object) -> Config:
    """One panel without the calibration drive."""
    wanted = {"run.world": world, "run.panels": 1, "mission.calibration_length_m": 0.0}
    return load_config(overrides=wanted | {key.replace("__", "."): value for key, value in overrides.items()})


def watched(fault: str, cfg: Config, is_enough: Callable[[Seen], bool]) -> Watched:
    """A watched mission with faults, each as in ``single``, separated by empty lines."""
    text = "\n".join("[[fault]]\n" + one for one in fault.strip().split("\n\n")) if fault else ""
    rehearsal = Watched(cfg, parse_plan(text, "plan"))
    rehearsal.watch(is_enough)
    return rehearsal


def was_real(record: Injected) -> bool:
    """The fault acted on something and changed it."""
    return record.samples > 0 and record.changed > 0


@dataclass(frozen=True, slots=True)
class Ending:
    """What became of one mission."""

    plan: FaultPlan
    injected: tuple[Injected, ...]
    result: SilResult

    @property
    def line(self) -> str:
        """For people: faults, outcome, cause, falls, points."""
        faults = ", ".join(f"{f.signal} {f.type} at {f.at_s:.1f}" for f in self.plan.faults)
        points = self.result.summary["points"]
        falls = self.result.summary["danger"]["falls"]
        return f"{faults}: {self.result.outcome} ({self.result.cause}), {points['measured']} points, {falls} falls"


def plan_of(seed: int) -> FaultPlan:
    """Faults of a mission on one panel."""
    return random_plan(seed, FAULTS_PER_MISSION, LAST_S)


def single(fault: str) -> FaultPlan:
    """A plan of one fault."""
    return parse_plan("[[fault]]\n" + fault, "plan")


def survey(seed: int, plan: FaultPlan) -> Ending:
    """One panel in the hard world with the extended filter."""
    cfg = load_config(overrides={"run.world": "hard", "run.filter": "ekf", "run.panels": 1, "run.seed": seed})
    rehearsal = FaultySilRun(cfg, plan)
    result = rehearsal.run()
    return Ending(plan, rehearsal.injected, result)
