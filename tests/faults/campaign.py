"""Missions in process with random plans of faults that pass by, and what became of them."""

import random
from dataclasses import dataclass

import numpy as np

from ccatp.config.loader import load_config
from ccatp.config.models import Config
from ccatp.sim.faults.models import SENSOR_SIGNALS
from ccatp.sim.faults.plan import FaultPlan, parse_plan
from ccatp.sim.faults.record import Injected
from ccatp.sim.robot import Robot
from ccatp.studies.rehearsal import Rehearsing
from ccatp.studies.rehearsal_laser import LaserDesk
from ccatp.studies.rehearsal_result import Rehearsal
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

    def _note_truth(self) -> None:
        super()._note_truth()
        for _ in range(LOST_FRAMES):
            if self.robot.delivered is not None:
                return
            self.robot.advance()
            super()._note_truth()
        raise AssertionError("no frame arrives any more")

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
