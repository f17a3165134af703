"""Random attacks on the samples of a robot: gaps, wrong time stamps, slow and stuck sensors, in any combination.

Every attack ends in one of three ways. *Handled*: the survey is complete, and each point is reached within its
tolerance. *Reported*: the robot is held or at base with a cause. *Silently wrong*: the robot moved on a pose that is
wrong by more than its uncertainty says, missed a point without a word, hung over the rim, or fell.
"""

from dataclasses import dataclass, field
from math import hypot

import numpy as np

from ccatp.conditions import text_of
from ccatp.config.models import Config
from ccatp.core import DeckPose
from ccatp.links.robot_messages import Sensors
from ccatp.sim.fault_plan import parse_plan
from ccatp.studies.sil_run import SilRun
from ccatp.survey.events import DONE
from tests.support.scenario import one_panel

_LISTS = {
    "imu": ("imu_ax",), "enc": ("encoder_right", "encoder_left"), "edge": ("edge_rear_left",),
    "gravity": ("gravity",),
}  # fmt: skip
_CLOCKS = {"imu": "imu_clock", "enc": "encoder_clock", "edge": "edge_clock", "gravity": "gravity_clock"}
_FIRST_S, _LAST_S = 1.0, 80.0  # from the start of the first move to the way home
# A pose is wrong if the robot moves on it for longer than the wheels run down, while it is off by more than this many
# standard deviations and by more than the tolerance of an arrival.
_SIGMAS, _RUNDOWN_S = 5.0, 0.5
_TOLERANCE_M = 0.010
_OVERRUN_M = 0.020  # invariant I5


@dataclass
class Attack:
    """One attack: its plan of faults, and the world and mirror in which it happens."""

    seed: int
    text: str
    mirror: str
    world: str

    @property
    def cfg(self) -> Config:
        return one_panel(
            mirror=self.mirror, run__world=self.world, run__seed=self.seed, mission__calibration_length_m=0.1
        )


def attack(seed: int) -> Attack:
    """The attack of a seed: one to three faults, which may overlap."""
    rng = np.random.default_rng([seed, 42])
    rows: list[str] = []
    begin_s = float(rng.uniform(_FIRST_S, _LAST_S))
    for _ in range(int(rng.integers(1, 4))):
        at_s, for_s = begin_s + float(rng.uniform(0.0, 1.0)), float(np.exp(rng.uniform(np.log(0.03), np.log(4.0))))
        kinds = [kind for kind in _LISTS if rng.random() < 0.5] or ["enc"]
        what = rng.choice(["gap", "stamps", "late", "sparse", "flicker"])
        by_s = float(rng.choice([-6.0, -1.2, -0.5, 0.002, 0.05, 0.4, 3.0]))
        every, period_s, duty = int(rng.integers(2, 30)), float(rng.uniform(0.02, 0.6)), float(rng.uniform(0.1, 0.9))
        for kind in kinds:
            common = {"at_s": round(at_s, 3), "for_s": round(for_s, 3)}
            if what == "stamps":
                rows.append(_row(_CLOCKS[kind], "jump", by_s=by_s, **common))
                continue
            for signal in _LISTS[kind]:
                if what == "gap":
                    rows.append(_row(signal, "off", **common))
                elif what == "late":
                    rows.append(_row(signal, "delayed", by_s=round(min(for_s, 1.9), 3), stamps="old", **common))
                elif what == "sparse":
                    rows.append(_row(signal, "slow", every=every, **common))
                else:
                    rows.append(
                        _row(signal, "intermittent", period_s=round(period_s, 3), duty=round(duty, 2), **common)
                    )
    mirror = str(rng.choice(["fyst-m1", "fyst-m2", "thesis-m1"]))
    return Attack(seed, "\n".join(rows), mirror, str(rng.choice(["thesis", "hard"])))


def _row(signal: str, kind: str, **keys: float | str) -> str:
    values = "\n".join(
        f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value}" for key, value in keys.items()
    )
    return f'[[fault]]\nsignal = "{signal}"\ntype = "{kind}"\n{values}\n'


@dataclass
class Result:
    """How an attack ended: ``wrong`` lists what went wrong without a word."""

    attack: Attack
    is_complete: bool
    cause: str
    wrong: list[str] = field(default_factory=list)

    @property
    def kind(self) -> str:
        return "silently wrong" if self.wrong else "handled" if self.is_complete else "reported"


class AttackedSurvey(SilRun):
    """A survey under attack. ``wrong``: what the robot did on a pose that its samples do not support."""

    def __init__(self, one: Attack) -> None:
        super().__init__(one.cfg, parse_plan(one.text, "attack"))
        self.wrong: list[str] = []
        self._wrong_s = self._worst_out_m = 0.0

    def _serve(self, sensors: Sensors, dt_s: float) -> None:
        super()._serve(sensors, dt_s)
        pose, deck = self.robot.world.plant.pose, self.localizer.deck_pose
        off_m = hypot(pose.x_m - deck.x_m, pose.y_m - deck.y_m)
        limit_m = max(_TOLERANCE_M, _SIGMAS * self.localizer.position_sigma_m)
        is_moving = self.pipeline.sent.rates != (0.0, 0.0) and not sensors.cmd.held
        self._wrong_s = self._wrong_s + dt_s if is_moving and off_m > limit_m else 0.0
        if self._wrong_s > _RUNDOWN_S and not self.wrong:
            self.wrong.append(f"moves at {self.robot.t_s:.2f} s while the pose is {1e3 * off_m:.1f} mm off")
        self._worst_out_m = max(self._worst_out_m, -self._clearance_m(pose))

    def _clearance_m(self, pose: DeckPose) -> float:
        hx, hy, lx, ly = self.mirror.body_axes(pose)
        corners = ((pose.x_m + a * hx + b * lx, pose.y_m + a * hy + b * ly) for a, b in self.cfg.robot.edge_sensors_m)
        return min(self.mirror.rim.signed_distance_m(x, y) for x, y in corners)

    def judged(self, one: Attack) -> Result:
        """Run the survey, and judge it."""
        self.run()
        state, wrong = self.mission.state, self.wrong
        missed = [row for row in self.laser.stops if row.approach == 1 and row.distance_m > _TOLERANCE_M]
        # In the hard world slip moves an arrival by up to 8.5 mm without any attack.
        wrong += [f"arrives {1e3 * row.distance_m:.1f} mm off at {row.t_s:.2f} s" for row in missed]
        if self._worst_out_m > _OVERRUN_M:
            wrong.append(f"a sensor hangs {1e3 * self._worst_out_m:.1f} mm over the rim")
        if self.robot.world.is_fallen:
            wrong.append("fallen")
        is_complete = state.mode is DONE and not state.points.skipped
        return Result(one, is_complete, text_of(state.cause), wrong)


def run_attack(seed: int) -> Result:
    """Run the attack of a seed."""
    one = attack(seed)
    return AttackedSurvey(one).judged(one)
