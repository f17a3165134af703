"""Robot, danger rules, localizer, mission and gate in one process, with what the outside may do to them at any frame.

As in real time, the verdict in force is the newest that is fresh; whoever is away sends nothing. After each frame the
invariants of the fault table are looked at, most of them by other means than the code under test uses.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, isfinite, sin
from typing import Any

import numpy as np
from msgspec.structs import replace

from ccatp.config.models import Config
from ccatp.control.gate import FanGate, Purpose
from ccatp.core import Cause, EdgeSample, EventCode, PointId, Stop, Twist, Verdict, WheelSample
from ccatp.daemon.loops.mission_runner import STILL, TimedFrame
from ccatp.danger import DangerMonitor
from ccatp.kinematics import twist_of
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import is_estimate_due
from ccatp.mirror.multilateration import MultilaterationError
from ccatp.sim.robot import Robot
from ccatp.studies.sil_run import SilLaser, SilRun
from ccatp.survey.events import (
    BACKING_OFF,
    DONE,
    DRIVING,
    HELD,
    PURPOSES,
    RETURNING,
    TURNING,
    Abort,
    FixFailed,
    FixStored,
    Pause,
)

FRESH_S = 0.15  # I10
BACK_IN_SIGHT_S = 1e-6  # times are multiples of a frame, up to rounding
OVERRUN_M = 0.020  # I5
MARGIN_M = 0.09  # I7: the least that any goal keeps from the rim
MOVING = (TURNING, DRIVING, BACKING_OFF, RETURNING)


class SpyRobot(Robot):
    """Keeps the drive and the permit sent last."""

    sent = (0.0, 0.0)

    def drive(
        self, seq: int, right_rad_s: float, left_rad_s: float, now_s: float | None = None, _: float | None = None
    ) -> bool:
        self.sent = right_rad_s, left_rad_s
        return super().drive(seq, right_rad_s, left_rad_s, now_s)


@dataclass(slots=True)
class Trouble:
    """What is wrong at present, in frames that it still lasts."""

    off: tuple[bool, bool, bool, bool] = (False, False, False, False)
    off_frames: int = 0
    no_edges: int = 0
    no_wheels: int = 0
    lost: int = 0
    no_danger: int = 0
    clock_s: float = 0.0
    fixes_fail: bool = False
    fix_frames: int = 0  # until a fix is there


class Stage(SilRun):
    """One mission; ``advance`` serves frames, the other methods are what the outside does."""

    def __init__(self, cfg: Config) -> None:
        super().__init__(cfg)
        self.robot: SpyRobot = SpyRobot(cfg, self.mirror, np.random.default_rng(cfg.run.seed))
        self.laser = SilLaser(cfg, self.mirror, self.robot)
        self.fans = FanGate(self.cfg.sim.robot.fan_floor if self.mirror.overhang else 0.0)
        self.trouble = Trouble()
        self.acknowledged: list[PointId] = []
        self.aborts = 0
        self.frames = self.driven = self.edges_seen = 0
        self.overrun_m = 0.0
        self.below_floor = 0
        self._verdict: Verdict | None = None
        self._drive_t_s: float | None = None
        self._last_t_s = 0.0
        self._permit_seq = self._fan_seq = 0
        self._last = Twist(0.0, 0.0)
        self._edge_heard_s = self._wheels_heard_s = -1e9
        self._at_edge: dict[int, tuple[float, float, float]] = {}
        self._pending: tuple[int, int, Sensors] | None = None
        self._emergencies: dict[str, str] = {}
        self._stops: Sequence[Stop] = ()
        self.robot.join("monitor")
        self.robot.join("controller")
        while self.robot.delivered is None:
            self.robot.advance()
        self.command_fans(*cfg.robot.fan_duty)
        self._last_t_s = self.robot.delivered.t - self.robot.frame_s

    # -- the outside --------------------------------------------------------------------------------------------------

    def command_fans(self, left: float, right: float) -> None:
        """As main does it: the gate first, and the robot's own floor behind it."""
        if self.fans.refusal(left, right) is None:
            self._fan_seq += 1
            self.robot.command_fans(self._fan_seq, left, right)

    def command_fans_past_the_gate(self, left: float, right: float) -> None:
        """As nobody does it."""
        self._fan_seq += 1
        self.robot.command_fans(self._fan_seq, left, right)

    def emergency(self, kind: str, number: int) -> None:
        self._emergencies[f"id {number}"] = kind
        self.monitor.emergency(kind, f"id {number}")

    def clear(self, number: int) -> None:
        if self.monitor.clear(f"id {number}", self.monitor.at_base_or_held) is None:
            self._emergencies.pop(f"id {number}", None)

    def restart_danger(self, frames: int) -> None:
        """It is away for so many frames, and knows nothing but the emergencies when it is back."""
        self.trouble.no_danger = max(self.trouble.no_danger, frames)
        self.monitor = DangerMonitor(self.mirror, self.cfg.robot, self.cfg.danger)
        for number, kind in self._emergencies.items():
            self.monitor.emergency(kind, number)

    def abort(self) -> None:
        if self.mission.handle(Abort(Cause("operator"))) is None:
            self.aborts += 1

    # -- frames -------------------------------------------------------------------------------------------------------

    def advance(self, frames: int) -> None:
        """Let so many frames pass."""
        trouble = self.trouble
        for _ in range(frames):
            self.robot.advance()
            if trouble.lost > 0:
                trouble.lost -= 1
                continue
            frame = self._tampered(self.robot.delivered)
            dt_s, self._last_t_s = frame.t - self._last_t_s, frame.t
            self._serve(frame, dt_s)
            self._look(frame)

    def _tampered(self, frame: Sensors | None) -> Sensors:
        assert frame is not None
        trouble, changes = self.trouble, dict[str, Any]()
        if trouble.off_frames > 0:
            trouble.off_frames -= 1
            changes["edge"] = [_without(sample, trouble.off) for sample in frame.edge]
        if trouble.no_edges > 0:
            trouble.no_edges -= 1
            changes["edge"] = []
        if trouble.no_wheels > 0:
            trouble.no_wheels -= 1
            changes["enc"] = [WheelSample(sample[0], None, sample[2]) for sample in frame.enc]
        frame = replace(frame, **changes)
        return _shifted(frame, trouble.clock_s) if trouble.clock_s else frame

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        t_s, trouble, mission = frame.t, self.trouble, self.mission
        timed = TimedFrame(frame, b"", t_s, dt_s, is_first=False, is_estimate_due=is_estimate_due(frame.seq))
        verdict = None
        if trouble.no_danger > 0:
            trouble.no_danger -= 1
        else:
            self._verdict = verdict = self.monitor.step(frame, self._published)
            self._permit_seq += 1
            self.robot.permit(self._permit_seq, verdict.forward, verdict.reverse, verdict.turn)
        self.pipeline.estimate(timed)
        if dt_s <= 0.0:
            self._drive(STILL)
            return
        verdict = self._verdict
        if verdict is not None and not abs(t_s - verdict.t_s) <= FRESH_S:
            verdict = None
        drive = self.pipeline.decide(timed, verdict, 0.0)
        self._publish(timed)
        if self._is_measuring:
            self._is_measuring = False
            self._pending = mission.state.request, trouble.fix_frames, frame
            drive = STILL
        self._drive(drive)
        self._collect()

    def begin_drives(self) -> None:
        self.command_fans(*self.thrust.duty)

    def _collect(self) -> None:
        """A fix comes when it is ready; one that is not wanted any more is thrown away."""
        if self._pending is None:
            return
        request, frames, frame = self._pending
        if frames > 0:
            self._pending = request, frames - 1, frame
            return
        self._pending = None
        mission = self.mission
        if not (mission.state.is_awaiting_fix and mission.state.request == request):
            return
        point = mission.state.measuring_point
        if self.trouble.fixes_fail:
            mission.handle(FixFailed(point, "no fix"))
            return
        self.parts.fix_review.begin()
        try:
            doubt = self._fuse(self.laser.fix(frame.t, self.localizer.deck_pose)).doubt
        except MultilaterationError as error:
            doubt = str(error)
        if doubt:
            mission.handle(FixFailed(point, doubt))
            return
        if point is not None:
            self.acknowledged.append(point)
        mission.handle(FixStored(point))

    # -- the invariants -----------------------------------------------------------------------------------------------

    def _look(self, frame: Sensors) -> None:
        self.frames += 1
        if frame.edge:
            self._edge_heard_s = frame.edge[-1][0]
        whole = [s[0] for s in frame.enc if s[1] is not None and s[2] is not None]
        self._wheels_heard_s = whole[-1] if whole else self._wheels_heard_s
        right, left = self.robot.sent
        if right or left:
            self.driven += 1
            self._look_at_drive(frame.t, right, left)
        robot = self.cfg.robot
        self._last = twist_of(right, left, robot.wheel_radius_m, robot.wheel_base_m)
        self._look_at_edges()
        self._look_at_mission()
        self.below_floor += min(self.robot.fans.duty) < self.cfg.sim.robot.fan_floor * self.mirror.overhang
        assert not self.below_floor, "I3"
        assert not self.robot.world.is_fallen

    def _look_at_drive(self, t_s: float, right: float, left: float) -> None:
        verdict, state, robot, limits = self._verdict, self.mission.state.mode, self.cfg.robot, self.cfg.limits
        assert isfinite(right), "I2"
        assert isfinite(left), "I2"
        assert max(abs(right), abs(left)) <= robot.max_wheel_rad_s + 1e-9, "I2"
        twist = twist_of(right, left, robot.wheel_radius_m, robot.wheel_base_m)
        v, last_v = twist.v_m_s, self._last.v_m_s
        assert abs(v) <= 1.25 * limits.v_max_m_s + 1e-9, "I2"
        # A frame after a gap may step further, as long as it is below what 0.1 s allow.
        step = 1.25 * limits.a_max_m_s2 * (2.0 * robot.wheel_lag_s + 0.1)
        assert abs(v) <= max(abs(last_v), 0.0) + step + 1e-9, "I2"
        assert state in MOVING, f"I1: {state}"
        assert PURPOSES[state] is not Purpose.STAND, "I1"
        assert verdict is not None, "I1"
        assert abs(t_s - verdict.t_s) <= FRESH_S + BACK_IN_SIGHT_S, "I1, I10"
        assert verdict.forward or v <= 1e-12, "I1"
        assert verdict.reverse or v >= -1e-12, "I1"
        # Rounding of two equal wheels is no turn.
        assert verdict.turn or abs(twist.omega_rad_s) < 1e-6, "I1"
        front_left, front_right, rear_left, rear_right = verdict.off
        assert v <= 1e-12 or not (front_left or front_right), "I4"
        assert v >= -1e-12 or not (rear_left or rear_right), "I4"
        # The verdict's data at the time it was given, and its own age on top.
        limit_s = FRESH_S + abs(t_s - verdict.t_s) + self.robot.frame_s
        assert abs(t_s - self._edge_heard_s) <= limit_s, "I10"
        assert abs(t_s - self._wheels_heard_s) <= limit_s, "I10"

    def _look_at_edges(self) -> None:
        verdict, plant = self.monitor.verdict, self.robot.world.plant
        for sign, sensors in ((1, verdict.off[:2]), (-1, verdict.off[2:])):
            if verdict.code is not EventCode.NEAR_EDGE or not any(sensors):
                self._at_edge.pop(sign, None)
                continue
            if sign not in self._at_edge:
                self.edges_seen += 1
                self._at_edge[sign] = plant.x_m, plant.y_m, plant.heading_rad
            x, y, heading = self._at_edge[sign]
            further_m = sign * ((plant.x_m - x) * cos(heading) + (plant.y_m - y) * sin(heading))
            self.overrun_m = max(self.overrun_m, further_m)
            assert further_m <= OVERRUN_M, "I5"

    def _look_at_mission(self) -> None:
        mission = self.mission
        if self.aborts or (self._emergencies and self.monitor.verdict.code is EventCode.ABORTED):
            assert mission.state.mode not in (TURNING, DRIVING), "I6"
        assert list(mission.state.points.done) == self.acknowledged, "I8"
        assert len(set(mission.state.points.done)) == len(mission.state.points.done), "I8"
        assert not set(mission.state.points.done) & set(mission.state.points.skipped), "I8"
        if mission.state.stops is not self._stops:
            self._stops = mission.state.stops
            for stop in self._stops:
                assert self.mirror.rim.signed_distance_m(stop.x_m, stop.y_m) >= MARGIN_M, "I7"

    def look_at_hold(self) -> None:
        """I9: whatever it was at, a pause holds it before its next frame, and that frame drives nothing."""
        was_over = self.mission.state.mode is DONE
        self.mission.handle(Pause(Cause("I9")))
        assert self.mission.state.mode is (DONE if was_over else HELD), "I9"


def _without(sample: EdgeSample, off: tuple[bool, bool, bool, bool]) -> EdgeSample:
    t_s, *values = sample
    a, b, c, d = (0 if is_off else value for value, is_off in zip(values, off, strict=True))
    return EdgeSample(t_s, a, b, c, d)


def _shifted(frame: Sensors, by_s: float) -> Sensors:
    """The frame by a clock that is off."""

    def later(samples: Sequence[Any]) -> list[Any]:
        return [sample._replace(t_s=sample.t_s + by_s) for sample in samples]

    gravity = frame.gravity._replace(t_s=frame.gravity.t_s + by_s) if frame.gravity is not None else None
    imu, enc, edge = (later(samples) for samples in (frame.imu, frame.enc, frame.edge))
    return replace(frame, t=frame.t + by_s, imu=imu, enc=enc, edge=edge, gravity=gravity)
