"""Missions in process with random plans of faults that pass by, and what became of them."""

import random
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import hypot
from typing import NamedTuple

import numpy as np

from ccatp.config.loader import load_config
from ccatp.config.models import Config
from ccatp.samples import DeckPose, Severity, Verdict
from ccatp.sim.faults.models import SENSOR_SIGNALS
from ccatp.sim.faults.plan import FaultPlan, parse_plan
from ccatp.sim.faults.record import Injected
from ccatp.sim.robot import Robot
from ccatp.studies.rehearsal import Rehearsing
from ccatp.studies.rehearsal_laser import LaserDesk
from ccatp.studies.rehearsal_result import Rehearsal
from ccatp.surveying.states import State
from ccatp.wire.robot import Sensors

LONGEST_S = 2.0
FIRST_S, LAST_S = 3.0, 80.0
FAULTS_PER_MISSION = 4
LOST_FRAMES = 500  # without a frame for so long a mission is over


class FaultyRehearsal(Rehearsing):
    """A rehearsal whose robot has a plan.

    As the processes: a frame that nobody can take is passed over, and one that is not newer than the last is answered
    with zeros.
    """

    def __init__(self, cfg: Config, plan: FaultPlan) -> None:
        super().__init__(cfg, with_track=False)
        self.robot = Robot(cfg, self.mirror, np.random.default_rng(cfg.run.seed), plan)
        self.laser = LaserDesk(cfg, self.mirror, self.robot)
        self.denied_s: list[float] = []  # when lines that were no frames took the permit away

    def _note_truth(self) -> None:
        super()._note_truth()
        for _ in range(LOST_FRAMES):
            if self.robot.delivered is not None:
                return
            self._hear_garbled()
            self.robot.advance()
            super()._note_truth()
        raise AssertionError("no frame arrives any more")

    def _hear_garbled(self) -> None:
        """As the danger loop on a line that no client may take."""
        last = self.monitor.verdict
        if not self.robot.delivered_line or last.seq < 0:
            return
        verdict = self.monitor.garbled(last.seq, last.t_s, self.robot.t_s)
        if verdict is not None:
            self.denied_s.append(self.robot.t_s)
            self._drive_seq += 1  # numbers drives and permits alike here
            self.robot.permit(self._drive_seq, verdict.forward, verdict.reverse, verdict.turn)

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        if dt_s > 0.0:
            super()._serve(frame, dt_s)
            return
        self.localizer.step(frame.t, frame.imu, frame.enc, frame.edge, frame.gravity)
        self._drive_seq += 1
        self._foresee(self._drive_seq, 0.0, 0.0)
        self.robot.drive(self._drive_seq, 0.0, 0.0)

    @property
    def injected(self) -> tuple[Injected, ...]:
        assert self.robot.injector is not None
        return self.robot.injector.injected


class Seen(NamedTuple):
    """One frame of a watched mission: what the robot was told after it, and where it really was."""

    t_s: float
    verdict: Verdict
    state: State
    cause: str
    drive: tuple[float, float]
    pose: DeckPose
    estimate: tuple[float, float]

    @property
    def is_zero(self) -> bool:
        return self.drive == (0.0, 0.0)


class _Enough(Exception):
    """Seen what was to be seen."""


class Watched(FaultyRehearsal):
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

    def watch(self, is_enough: Callable[[Seen], bool]) -> Rehearsal | None:
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
    result: Rehearsal

    @property
    def line(self) -> str:
        """For people: faults, outcome, cause, falls, points."""
        faults = ", ".join(f"{f.signal} {f.type} at {f.at_s:.1f}" for f in self.plan.faults)
        points = self.result.summary["points"]
        falls = self.result.summary["danger"]["falls"]
        return f"{faults}: {self.result.outcome} ({self.result.cause}), {points['measured']} points, {falls} falls"


def random_plan(seed: int) -> FaultPlan:
    """Faults that last at most ``LONGEST_S``, of sensors, frames and wheels, at random times."""
    rng = random.Random(f"plan {seed}")
    texts = []
    for _ in range(FAULTS_PER_MISSION):
        signal, kind, keys = _draw(rng)
        at_s, for_s = rng.uniform(FIRST_S, LAST_S), rng.uniform(0.05, LONGEST_S)
        texts.append(
            f'[[fault]]\nsignal = "{signal}"\ntype = "{kind}"\nat_s = {at_s:.3f}\nfor_s = {for_s:.3f}\n{keys}\n'
        )
    return parse_plan("".join(texts), f"plan {seed}")


def _draw(rng: random.Random) -> tuple[str, str, str]:
    if rng.random() < 0.25:
        return rng.choice(
            [
                ("frames", "drop", f"every = {rng.randint(1, 4)}"),
                ("frames", "reorder", f"every = {rng.randint(2, 5)}"),
                ("frames", "duplicate", "every = 2"),
                ("clock", "jump", f"by_s = {rng.uniform(-0.5, 0.5):.3f}"),
                ("body", "slip", f"factor = {rng.uniform(0.2, 1.0):.3f}"),
                ("right_wheel", "blocked", ""),
                ("left_wheel", "blocked", ""),
                ("faults", "raise", 'names = ["imu", "edge"]'),
            ]
        )
    signal = rng.choice(SENSOR_SIGNALS)
    kind, keys = rng.choice(
        [
            ("off", ""),
            ("stuck", ""),
            ("garbage", f"beyond = {rng.choice((0.0, 0.3))}"),
            ("wrong", f"factor = {rng.uniform(0.5, 1.5):.3f}"),
            ("slow", f"every = {rng.randint(2, 20)}"),
            ("delayed", f'by_s = {rng.uniform(0.02, 0.5):.3f}\nstamps = "{rng.choice(("old", "fresh"))}"'),
            ("intermittent", f"period_s = {rng.uniform(0.01, 0.3):.3f}\nduty = 0.5"),
            ("saturated", "low = -0.1\nhigh = 0.1" if not signal.startswith("edge") else "high = 0.0"),
            ("non_finite", 'token = "NaN"'),
        ]
    )
    return signal, kind, keys


def single(fault: str) -> FaultPlan:
    """A plan of one fault."""
    return parse_plan("[[fault]]\n" + fault, "plan")


def survey(seed: int, plan: FaultPlan) -> Ending:
    """One panel in the hard world with the extended filter."""
    cfg = load_config(overrides={"run.world": "hard", "run.filter": "ekf", "run.panels": 1, "run.seed": seed})
    rehearsal = FaultyRehearsal(cfg, plan)
    result = rehearsal.run()
    return Ending(plan, rehearsal.injected, result)
