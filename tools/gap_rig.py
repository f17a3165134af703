"""Drives with a gap in the samples, without daemon and link: how wrong the estimate is, and how wrong it says it is.

A drive warms up with fixes, as a survey does: it stands, and drives legs and turns. Then comes the drive in which
sensors are silent. The process forks for each begin of the gap, and again for each set of silent sensors, because a
localizer cannot be copied. The state within a gap does not depend on when the gap will end, so one drive shows all
lengths.
"""

import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from itertools import combinations, product
from math import pi
from typing import Any, NamedTuple

import numpy as np

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.control.wheel_motion import SentDrives, SetPoints
from ccatp.core import DeckPose, Fix, FloatArray, Twist
from ccatp.dataloop import MotorRobot, motor_robot
from ccatp.estimation.fixes import FixGated
from ccatp.kinematics import difference, wheel_rates
from ccatp.links.robot_codec import set_point_on_wire
from ccatp.links.robot_messages import Sensors
from ccatp.localizer import Localizer, build_with_uncertainty
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.sim.robot import Robot

SENSORS = "imu", "enc", "edge"
SILENT = tuple("+".join(part) for n in range(4) for part in combinations(SENSORS, n))  # the first one: none
GAPS_S = 0.05, 0.1, 0.2, 0.5, 1.0, 2.0
WORLDS = "thesis", "hard", "extreme"
MOTORS = "lag", "motors"
FILTERS = "ekf", "ukf", "kf"

_FRAME_S = 0.01
_RULE_S = 0.17  # danger.stale_after_s and two frames: then a rule of the daemon stops the drive
_FIX_SIGMA_M = 5e-6
_LEG_M, _TURN_RAD = 0.12, 0.6
_V_M_S, _A_M_S2, _OMEGA_RAD_S, _ALPHA_RAD_S2 = 0.1, 0.2, 1.0, 2.0
_REST_S = 0.5


class Drive(NamedTuple):
    """What a drive depends on, besides its seed."""

    world: str
    motors: str
    filter: str = "ekf"


class Way(NamedTuple):
    """Where the gap begins, and what stops the robot: the daemon's rule, or the robot's time-to-live."""

    begin: str
    stop: str


WAYS = tuple(Way(*way) for way in product(("standstill", "leg", "turn"), ("rule", "ttl")))


class Errors(NamedTuple):
    """At the end of each gap, shape (len(GAPS_S),): errors and standard deviations of the estimate."""

    position_m: FloatArray  # (gaps, 2)
    covariance_m2: FloatArray  # (gaps, 2, 2)
    heading_rad: FloatArray
    heading_sigma_rad: FloatArray


@cache
def _mirror(cfg_name: str) -> Mirror:
    return build_mirror(load_config(overrides={"run.mirror": cfg_name}).mirror)


def _config(drive: Drive, seed: int) -> Config:
    keys = {"run.mirror": "fyst-m2", "run.world": drive.world, "run.filter": drive.filter, "run.seed": seed}
    return load_config(overrides=keys | {"sim.robot.physics": drive.motors})


def ramp(way: float, top: float, slope: float, lag_s: float) -> list[float]:
    """Set points of a drive over ``way`` from rest to rest, with the feed-forward of the servo's lag."""
    sign, way = (1.0 if way > 0.0 else -1.0), abs(way)
    top = min(top, (way * slope) ** 0.5)
    up_s, whole_s = top / slope, way / top + top / slope
    found = []
    for k in range(round(whole_s / _FRAME_S)):
        t = (k + 1) * _FRAME_S
        rate = max(0.0, min(top, slope * t, slope * (whole_s - t)))
        change = slope if t < up_s else -slope if t > whole_s - up_s else 0.0
        found.append(sign * (rate + lag_s * change))
    return found


class GapDrive:
    """One drive."""

    def __init__(self, drive: Drive, seed: int) -> None:
        self.cfg, self.mirror = _config(drive, seed), _mirror("fyst-m2")
        self._rng = np.random.default_rng([seed, 77])
        panels = [p for p in self.mirror.panels.values() if abs(p.x_m) < 1.5 and abs(p.y_m) < 1.5]
        panel = panels[int(self._rng.integers(len(panels)))]
        x_m, y_m = self._rng.uniform(-0.2, 0.2, 2).tolist()
        start = DeckPose(panel.x_m + x_m, panel.y_m + y_m, float(self._rng.uniform(-pi, pi)))
        self.robot: Robot | MotorRobot = (
            Robot(self.cfg, self.mirror, np.random.default_rng(seed), None, start)
            if drive.motors == "lag"
            else motor_robot(self.cfg, start)
        )
        self._truth: dict[int, tuple[float, float, float]] = {}
        self.sent = SentDrives(self.cfg.robot, _FRAME_S)
        sigmas = 0.002, 0.01
        off = self._rng.normal(size=3) * (*sigmas[:1], *sigmas)
        believed = DeckPose(start.x_m + off[0], start.y_m + off[1], start.heading_rad + off[2])
        self.localizer: Localizer = build_with_uncertainty(self.cfg, self.mirror, believed, sigmas)
        self._seq = 0
        self.robot.join("monitor")
        self.robot.join("controller")
        self.robot.command_fans(1, *self.cfg.robot.fan_duty)
        while self.robot.delivered is None:
            self.robot.advance()

    def frame(self, drive: Twist | None, is_permitted: bool = True) -> tuple[Sensors, SetPoints | None]:
        """Send a drive (None: none any more), and receive the next frame."""
        robot = self.robot
        if drive is not None:
            self._seq += 1
            right, left = (
                set_point_on_wire(rate)
                for rate in wheel_rates(drive, self.cfg.robot.wheel_radius_m, self.cfg.robot.wheel_base_m)
            )
            self.sent.add(self._seq, right, left)
            robot.permit(self._seq, is_permitted, is_permitted, is_permitted)
            robot.drive(self._seq, right, left)
        robot.advance()
        _, _, x, y, heading, *_ = robot.truth_row()
        self._truth[robot.seq] = x, y, heading
        sensors = robot.delivered
        assert sensors is not None
        echo = sensors.cmd
        acted = self.sent.acted(_FRAME_S, echo.seq, echo.age, echo.permit_age, echo.held)
        self.sent.ahead((0.0, 0.0, 0.0), 0.0, 0.0, echo.seq, echo.age, echo.held)
        return sensors, acted

    def take(self, localizer: Localizer, sensors: Sensors, acted: SetPoints | None, silent: str = "") -> None:
        """Let a localizer take a frame without the samples of the silent sensors."""
        imu, enc, edge = (() if name in silent else getattr(sensors, name) for name in SENSORS)
        localizer.step(sensors.t, imu, enc, edge, sensors.gravity, acted)

    def drive(self, twists: Sequence[Twist]) -> None:
        """Drive with all sensors, then stand, and take a fix."""
        for twist in (*twists, *[Twist(0.0, 0.0)] * round(_REST_S / _FRAME_S)):
            self.take(self.localizer, *self.frame(twist))
        self.localizer.rest()
        puck = np.array(self.robot.world.puck_world()) + _FIX_SIGMA_M * self._rng.normal(size=3)
        c = _FIX_SIGMA_M**2
        fix = Fix(self.localizer.t_s, (puck[0], puck[1], puck[2]), (c, 0, 0, 0, c, 0, 0, 0, c), 1.5, (1, 2, 3, 4), 1e-6)
        for _ in range(3):  # a fix that contradicts the estimate is taken again
            try:
                self.localizer.fuse_fix(fix)
            except FixGated:
                continue
            return

    def leg(self, way_m: float) -> list[Twist]:
        """A straight leg."""
        return [Twist(v, 0.0) for v in ramp(way_m, _V_M_S, _A_M_S2, self.cfg.robot.wheel_lag_s)]

    def turn(self, angle_rad: float) -> list[Twist]:
        """A turn in place."""
        return [Twist(0.0, w) for w in ramp(angle_rad, _OMEGA_RAD_S, _ALPHA_RAD_S2, self.cfg.robot.wheel_lag_s)]

    def warm_up(self) -> None:
        """Learn biases, heading, slip, creep and lag."""
        self.drive([Twist(0.0, 0.0)] * 60)
        for k in range(3):
            for way_m in (_LEG_M, -_LEG_M):
                self.drive(self.leg(way_m))
            self.drive(self.turn(_TURN_RAD if k % 2 else -_TURN_RAD))

    def errors(self, seq: int, localizer: Localizer) -> tuple[FloatArray, FloatArray, float, float]:
        """Errors of position and heading at a frame, and what the localizer says about them."""
        x, y, heading = self._truth[seq]
        pose = localizer.deck_pose
        P = localizer.pose_covariance
        off = np.array((x - pose.x_m, y - pose.y_m))
        return off, P[:2, :2].copy(), difference(heading, pose.heading_rad), float(P[2, 2]) ** 0.5

    def gap_frames(self, way: Way) -> Iterator[tuple[Sensors, SetPoints | None]]:
        """Drive until the gap begins, then yield its frames. The set points end by a rule, or with the daemon."""
        twists = self.turn(2.5) if way.begin == "turn" else self.leg(0.35)
        # Begun at standstill, a drive that was sent before the gap was noticed begins in the gap.
        before = 0 if way.begin == "standstill" else int(self._rng.integers(10, len(twists) - 40))
        for twist in twists[:before]:
            self.take(self.localizer, *self.frame(twist))
        still = Twist(0.0, 0.0)
        ahead = [*([still] * 4 if way.begin == "standstill" else []), *twists[before:]]
        for k in range(round(GAPS_S[-1] / _FRAME_S)):
            is_over = k * _FRAME_S >= _RULE_S
            if way.stop == "ttl":
                yield self.frame(ahead[k] if k < 2 else None)
            elif is_over:
                yield self.frame(still, is_permitted=False)
            else:
                yield self.frame(ahead[k] if k < len(ahead) else still)


def _forked(task: Callable[[], Any]) -> Any:
    """The result of a task in a child process, which begins with a copy of everything here."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.close(reader)
            with os.fdopen(writer, "wb") as pipe:
                pickle.dump(task(), pipe)
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        result = pickle.load(pipe)
    os.waitpid(child, 0)
    return result


def run(
    drive: Drive, seed: int, ways: Sequence[Way] = WAYS, silent: Sequence[str] = SILENT
) -> dict[Way, dict[str, Errors]]:
    """Errors at the end of all gaps, for each way into it and each set of silent sensors."""
    rig = GapDrive(drive, seed)
    rig.warm_up()
    return {way: _forked(partial(_run_way, rig, way, silent)) for way in ways}


def _run_way(rig: GapDrive, way: Way, silent: Sequence[str]) -> dict[str, Errors]:
    frames = list(rig.gap_frames(way))
    return {name: _forked(partial(_run_silent, rig, frames, name)) for name in silent}


def _run_silent(rig: GapDrive, frames: Sequence[tuple[Sensors, SetPoints | None]], silent: str) -> Errors:
    ends, rows = [round(gap_s / _FRAME_S) - 1 for gap_s in GAPS_S], []
    for k, (sensors, acted) in enumerate(frames):
        rig.take(rig.localizer, sensors, acted, silent)
        if k in ends:
            rows.append(rig.errors(sensors.seq, rig.localizer))
    return Errors(*(np.array(column) for column in zip(*rows, strict=True)))
