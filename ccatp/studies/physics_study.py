"""The studies with rigid-body physics.

`physics`: whole missions with different tyres, friction and thrust. `stops`: drives over the rim, and stops by command.
`slides`: the friction falls while the robot drives or turns. `bodies`: missions of bodies whose unknown properties are
drawn.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from math import ceil, cos, hypot, pi, sin
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.conditions.danger import GRIP_LOST
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.control.grip_model import GripModel
from ccatp.control.thrust import ThrustControl
from ccatp.core import DeckPose, EventCode, PanelId, Twist, Verdict
from ccatp.danger import DangerMonitor
from ccatp.dataloop import motor_robot
from ccatp.kinematics import wheel_rates
from ccatp.links.topics import EstimateMessage, is_estimate_due
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.sim.physics import PhysicsPlant
from ccatp.studies.campaign import Cell, CellResult, Factors, Job, JobOutcome, Study
from ccatp.studies.mission_study import combine_missions, run_mission
from ccatp.studies.results import Measure, draw_ranges, grouped, rows_by
from ccatp.studies.survey_studies import MISSION, SHOWN

# -- whole missions ---------------------------------------------------------------------------------------------------

MIRRORS = "fyst-m1", "fyst-m2"
TYRES_M = {"round": 0.002, "flat": 0.0075}  # lever arms of the tyres' friction: they give the creep of turns


def robot_keys(mirror: str, tyre: str, friction: float, margin: float | None) -> dict[str, object]:
    """Configuration keys for the robot and its physics; ``margin``: thrust over the least one, None: as configured."""
    keys: dict[str, object] = {"run.mirror": mirror, "sim.physics.tyre": tyre, "robot.tyre_m": TYRES_M[tyre]}
    cfg = load_config(None, {"run.mirror": mirror, "robot.friction": friction})
    thrust_n = cfg.robot.thrust_n
    if margin is not None:
        # Rounded up: with less than the required margin, a survey is slow.
        thrust_n = ceil(100.0 * margin * GripModel(cfg.robot).forecast(build_mirror(cfg.mirror)).least_n) / 100.0
    for place in ("robot", "sim.physics"):
        keys |= {f"{place}.friction": friction, f"{place}.thrust_n": thrust_n}
    return keys


def physics_cells() -> Sequence[Cell]:
    """Mirror, tyre, friction, and the thrust at full duty over the least that holds the robot anywhere on the mirror.

    The robot's configuration has the same friction and thrust as the physics.
    """
    found = []
    for name, tyre, friction, margin in product(MIRRORS, TYRES_M, (0.5, 0.6, 0.8, 1.0), (1.1, 1.3, 2.0, 3.0)):
        keys = robot_keys(name, tyre, friction, margin)
        found.append(Cell({"mirror": name, "tyre": tyre, "friction": friction, "margin": margin}, keys))
    return found


def draw_physics(cells: Sequence[CellResult], out: Path) -> None:
    """Errors and time: a figure for each mirror and thrust."""
    for (mirror, margin), there in grouped(cells, "mirror", "margin").items():
        rows = rows_by(there, "tyre", "friction")
        title = f"{mirror}, {margin} times the least thrust, by friction: {SHOWN}"
        draw_ranges(rows, MISSION, title, out / f"physics-{mirror}-{100.0 * margin:.0f}")


PHYSICS = Study(
    cells=physics_cells,
    run_job=run_mission,
    combine=combine_missions,
    columns="""
        complete points.measured
        danger: falls
        localization_error_mm: mean p99 max
        arrival_error_mm: mean max within_10mm_fraction
        corrections mission_time_s time_ratio
    """,
    draw=draw_physics,
    defaults={"sim.robot.physics": "mujoco", "run.panels": 9},
    mirrors=(),
    runs=1,
)

# Properties of a body that a builder hardly knows, and the range from which each is drawn, in proportion (log-uniform).
BODY_RANGES = {
    "accelerometer_s": (0.002, 0.02),
    "tyre_width_m": (0.006, 0.014),
    "pivot_m": (0.0005, 0.002),
    "caster_friction": (0.01, 0.1),
    "contact_s": (0.01, 0.03),
}


def drawn_body(number: int) -> dict[str, float]:
    """Configuration keys of a body; each ``number`` always gives the same one."""
    rng = np.random.default_rng(number)
    return {
        f"sim.physics.{name}": round(float(np.exp(rng.uniform(np.log(low), np.log(high)))), 5)
        for name, (low, high) in BODY_RANGES.items()
    }


def body_cells() -> Sequence[Cell]:
    """Mirror, tyre, and number of the body, at a friction of 0.8 and 1.3 times the least thrust."""
    return [
        Cell({"mirror": name, "tyre": tyre, "body": number}, {**robot_keys(name, tyre, 0.8, 1.3), **drawn_body(number)})
        for name, tyre, number in product(MIRRORS, TYRES_M, range(1, 9))
    ]


def draw_bodies(cells: Sequence[CellResult], out: Path) -> None:
    """Errors and time: a figure for each mirror."""
    for (mirror,), there in grouped(cells, "mirror").items():
        draw_ranges(rows_by(there, "tyre", "body"), MISSION, f"{mirror}, by body: {SHOWN}", out / f"bodies-{mirror}")


BODIES = replace(PHYSICS, cells=body_cells, draw=draw_bodies)

# -- single drives ----------------------------------------------------------------------------------------------------

_REST_FRAMES = 120  # before a drive: the fans run up, and the accelerometer's bias is learned
_STOP_FRAMES = 60
_INSIDE_M = 0.25  # distance inside the rim at which a drive begins
_SIDES_RAD = tuple(k * pi / 2.0 for k in range(4))


class Truth(NamedTuple):
    """True state; ``clearance_m``: of the edge sensor that is furthest out, negative beyond the rim."""

    pose: DeckPose
    clearance_m: float
    has_fallen: bool


class PhysicsDrive:
    """A robot with rigid-body physics on set points; the danger monitors get its true pose. ``verdict``: the last."""

    def __init__(self, cfg: Config, mirror: Mirror, start: DeckPose) -> None:
        self._cfg, self._robot = cfg, motor_robot(cfg, start)
        self._monitor = DangerMonitor(mirror, cfg.robot, cfg.danger, cfg.health)
        self._thrust = ThrustControl(cfg.robot, mirror)
        self._estimate: EstimateMessage | None = None
        self._number, self._speed_m_s = 0, 0.0
        self.verdict: Verdict | None = None
        self._robot.join("monitor")
        self._robot.join("controller")
        self._command_fans()
        self.set_friction(cfg.robot.friction)
        for _ in range(_REST_FRAMES):
            self.step(Twist(0.0, 0.0))

    @property
    def truth(self) -> Truth:
        """True pose and clearance."""
        _, _, x_m, y_m, heading_rad, *_, clearance_m, has_fallen, _ = self._robot.truth_row()
        return Truth(DeckPose(x_m, y_m, heading_rad), clearance_m, has_fallen > 0.0)

    def _command_fans(self) -> None:
        self._robot.command_fans(self._number + 1, *self._thrust.duty)

    def step(self, wanted: Twist) -> None:
        """Drive one frame towards a twist, with limited acceleration; a zero speed is commanded immediately."""
        robot, cfg = self._robot, self._cfg
        most_m_s = cfg.limits.a_max_m_s2 * robot.frame_s
        ahead_m_s = min(max(wanted.v_m_s - self._speed_m_s, -most_m_s), most_m_s) + self._speed_m_s
        self._speed_m_s = ahead_m_s if wanted.v_m_s else 0.0
        self._advance()
        frame, pose = robot.delivered, self.truth.pose
        if frame is None:
            return
        self.verdict = verdict = self._monitor.step(frame, self._estimate)
        self._number += 1
        if verdict.full_fans and self._thrust.give_all():
            self._command_fans()
        if is_estimate_due(frame.seq):
            place = pose.x_m, pose.y_m, pose.heading_rad
            self._estimate = EstimateMessage(*place, 0.001, "driving", seq=frame.seq, t_s=frame.t)
            if self._thrust.step(frame.t, pose, turns=wanted.omega_rad_s != 0.0 or wanted.v_m_s == 0.0):
                self._command_fans()
        twist = Twist(self._speed_m_s, wanted.omega_rad_s)
        right, left = wheel_rates(twist, cfg.robot.wheel_radius_m, cfg.robot.wheel_base_m)
        robot.permit(self._number, *verdict.permits)
        robot.drive(self._number, right, left)

    def set_friction(self, friction: float) -> None:
        """Set the friction of both tyres, and reset ``slid_m``."""
        plant = self._robot.world.plant
        if isinstance(plant, PhysicsPlant):
            plant.set_friction(friction)
        self._slide_m = 0j

    @property
    def slid_m(self) -> float:
        """Sliding distance of the body (its motion minus that of the wheels) since the friction was set, m."""
        return abs(self._slide_m)

    def _advance(self) -> None:
        plant = self._robot.world.plant
        before_m, before_rad = complex(plant.x_m, plant.y_m), plant.right_angle_rad + plant.left_angle_rad
        self._robot.advance()
        rolled_m = 0.5 * self._cfg.robot.wheel_radius_m * (plant.right_angle_rad + plant.left_angle_rad - before_rad)
        self._slide_m += complex(plant.x_m, plant.y_m) - before_m - rolled_m * complex(plant.hx, plant.hy)

    def stop(self) -> float:
        """Command zero speed for ``_STOP_FRAMES``; returns the distance from begin to end, m."""
        before = self.truth.pose
        for _ in range(_STOP_FRAMES):
            self.step(Twist(0.0, 0.0))
        after = self.truth.pose
        return hypot(after.x_m - before.x_m, after.y_m - before.y_m)


def drives_to_rim(mirror: Mirror) -> Iterator[tuple[DeckPose, bool]]:
    """Start poses before the middle of each side, straight and at 45 degrees to it; True: the drive is in reverse."""
    row, col = (mirror.rows + 1) // 2, (mirror.cols + 1) // 2
    for outward in _SIDES_RAD:
        dx, dy = round(cos(outward)), round(sin(outward))
        on_side = [p for p in mirror.panels if PanelId(p.row + dy, p.col + dx) not in mirror.panels]
        panel = mirror.panels[
            min(on_side, key=lambda p: (abs(p.row - row) if dx else abs(p.col - col), -dx * p.col - dy * p.row))
        ]
        x_m = panel.x_m + dx * (panel.half_x_m - _INSIDE_M)
        y_m = panel.y_m + dy * (panel.half_y_m - _INSIDE_M)
        for angle, reverse in product((-pi / 4.0, 0.0, pi / 4.0), (False, True)):
            yield DeckPose(x_m, y_m, outward + angle + pi * reverse), reverse


def run_stops(job: Job) -> JobOutcome:
    """Drives over the rim, and stops by command in eight directions."""
    cfg, mirror = job.cfg, build_mirror(job.cfg.mirror)
    speed_m_s = cfg.limits.v_max_m_s
    further_m, overruns_m, falls, missed = [], [], 0, 0
    for start, reverse in drives_to_rim(mirror):
        drive, twist = PhysicsDrive(cfg, mirror, start), Twist(-speed_m_s if reverse else speed_m_s, 0.0)
        frames = round((2.0 * _INSIDE_M / speed_m_s + 1.0) / 0.01)
        while frames and (drive.verdict is None or drive.verdict.code is not EventCode.NEAR_EDGE):
            drive.step(twist)
            frames -= 1
        at_m = max(-drive.truth.clearance_m, 0.0)
        drive.stop()
        missed += not frames
        falls += drive.truth.has_fallen
        overruns_m.append(max(-drive.truth.clearance_m, 0.0))
        further_m.append(overruns_m[-1] - at_m)
    stops_m = []
    for k in range(8):
        drive = PhysicsDrive(cfg, mirror, DeckPose(0.0, 0.0, k * pi / 4.0))  # the rim is far
        for _ in range(round(speed_m_s / cfg.limits.a_max_m_s2 / 0.01) + 20):
            drive.step(Twist(speed_m_s, 0.0))
        stops_m.append(drive.stop())
        falls += drive.truth.has_fallen
    values = {"speed_m_s": round(speed_m_s, 3), "drives": len(overruns_m), "missed": missed, "falls": falls}
    for name, found_m in (("overrun", overruns_m), ("further", further_m), ("stop", stops_m)):
        values |= {f"{name}_mm": {"mean": 1e3 * sum(found_m) / len(found_m), "max": 1e3 * max(found_m)}}
    return JobOutcome(values, {})


def first_outcome(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """The only outcome: nothing is random, so there is one run."""
    return outcomes[0]


def draw_stops(cells: Sequence[CellResult], out: Path) -> None:
    """Figures ``stops-<mirror>``: mean and largest overrun."""
    labels = {"overrun_mm": "beyond the rim, mm", "further_mm": "since the verdict", "stop_mm": "on command"}
    measures = [
        Measure(label, (f"{key}.mean", f"{key}.max"), f"{key}.max", is_log=False) for key, label in labels.items()
    ]
    for (mirror,), there in grouped(cells, "mirror").items():
        rows = rows_by(there, "tyre", "thrust", "speed")
        draw_ranges(rows, measures, f"Stops on {mirror}: mean, largest", out / f"stops-{mirror}")


def stop_cells() -> Sequence[Cell]:
    """Mirror, tyre, thrust, and speed: that of a survey, and the safe speed, limited by the wheels."""
    found = []
    for mirror, tyre, thrust, speed in product(MIRRORS, TYRES_M, ("1.3 x least", "shipped"), ("survey", "safe")):
        keys = robot_keys(mirror, tyre, 0.6, None if thrust == "shipped" else 1.3)
        if speed == "safe":
            cfg = load_config(None, keys)
            safe_m_s = GripModel(cfg.robot).forecast(build_mirror(cfg.mirror)).safe_speed_m_s
            keys["limits.v_max_m_s"] = min(safe_m_s, cfg.robot.max_wheel_rad_s * cfg.robot.wheel_radius_m)
        found.append(Cell({"mirror": mirror, "tyre": tyre, "thrust": thrust, "speed": speed}, keys))
    return found


STOPS = Study(
    cells=stop_cells,
    run_job=run_stops,
    combine=first_outcome,
    columns="""
        speed_m_s drives missed falls
        overrun_mm: mean max
        further_mm: mean max
        stop_mm: mean max
    """,
    draw=draw_stops,
    defaults={"sim.robot.physics": "mujoco"},
    mirrors=(),
    runs=1,
)

_HEADINGS_RAD = tuple(k * pi / 4.0 + 0.2 for k in range(8))
_SLIDE_FRAMES = 60
_SOON_FRAMES = 5


def run_slides(job: Job) -> JobOutcome:
    """Detection of a fall of the friction from the robot's value to that of the physics, in eight directions."""
    cfg, mirror = job.cfg, build_mirror(job.cfg.mirror)
    values: dict[str, object] = {}
    ways_m, slides_m, falls = [], [], 0
    for way, twist in (("drive", Twist(cfg.limits.v_max_m_s, 0.0)), ("turn", Twist(0.0, 0.5))):
        found: list[int] = []
        for heading_rad in _HEADINGS_RAD:
            drive = PhysicsDrive(cfg, mirror, DeckPose(0.0, 0.0, heading_rad))
            for _ in range(_REST_FRAMES):
                drive.step(twist)
            drive.set_friction(cfg.sim.physics.friction)
            frames = 0
            while frames < _SLIDE_FRAMES and (drive.verdict is None or drive.verdict.cause.condition != GRIP_LOST.name):
                drive.step(twist)
                frames += 1
            if frames < _SLIDE_FRAMES:
                found.append(frames)
                slides_m.append(drive.slid_m)
            ways_m.append(drive.stop())
            falls += drive.truth.has_fallen
        soon = sum(frames <= _SOON_FRAMES for frames in found)
        values[way] = {"found": len(found), "within_50ms": soon, "latest_ms": 10 * max(found, default=0)}
    for name, each_m in (("slid", slides_m), ("way", ways_m)):
        values[f"{name}_mm"] = {"mean": 1e3 * sum(each_m) / max(len(each_m), 1), "max": 1e3 * max(each_m, default=0.0)}
    return JobOutcome({"trials": len(ways_m), **values, "falls": falls}, {})


def slide_cells() -> Sequence[Cell]:
    """Mirrors and reduced frictions, with a thrust of 1.3 times the least one."""
    found = []
    for mirror, friction in product(MIRRORS, (0.1, 0.2, 0.3)):
        keys = robot_keys(mirror, "round", 0.6, 1.3)
        found.append(Cell({"mirror": mirror, "friction": friction}, {**keys, "sim.physics.friction": friction}))
    return found


def draw_slides(cells: Sequence[CellResult], out: Path) -> None:
    """Figure ``slides``: stopping distance after the slide was detected."""
    measures = [Measure("way after that, mm", ("way_mm.mean", "way_mm.max"), "way_mm.max")]
    draw_ranges(rows_by(cells, "mirror", "friction"), measures, "Slides: mean, largest", out / "slides")


SLIDES = Study(
    cells=slide_cells,
    run_job=run_slides,
    combine=first_outcome,
    columns="""
        trials falls
        drive: found within_50ms latest_ms
        turn: found within_50ms latest_ms
        slid_mm: mean max
        way_mm: mean max
    """,
    draw=draw_slides,
    defaults={"sim.robot.physics": "mujoco"},
    mirrors=(),
    runs=1,
)
