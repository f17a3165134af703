"""The rules that a robot enforces by itself, and the commands that it takes; time is an argument.

The rules do not depend on its clients: drive and permit, time-to-live, directions, newest only. Motion is denied by
default: a set point reaches the wheels only through ``MotionRules.set_points``.
"""

from abc import ABC, abstractmethod
from collections import deque
from math import hypot, inf, isfinite
from typing import Any, Literal

from ccatp.core import ALL_MOTION, Permits
from ccatp.kinematics import twist_of
from ccatp.links.robot_messages import PROTOCOL, Hello, RobotData, Role
from ccatp.slide_rule import SlideRule

HELD = (0.0, 0.0)
_BIAS_TIME_S = 1.0
_MOTION: dict[Role, str] = {"controller": "drive", "monitor": "permit"}  # command of a role that moves the robot


class MotionRules:
    """Decides what the wheels may do.

    Wheels turn only while the newest drive is at most ``ttl_s`` old and, once a monitor has joined in this boot, the
    newest permit is at most ``ttl_s`` old and allows the direction: v = r (wr + wl)/2 > 0 needs ``forward``, < 0
    ``reverse``, wr != wl or a steering angle needs ``turn``. For a drive over ``max_wheel_rad_s`` both speeds are
    scaled by the same factor, so that its path stays the same.

    Attributes:
        is_held: the last ``set_points`` held the wheels.
        steer_rad: steering angle of the newest drive.
    """

    def __init__(self, ttl_s: float, max_wheel_rad_s: float) -> None:
        self._ttl_s, self._max_wheel_rad_s = ttl_s, max_wheel_rad_s
        self._drive: tuple[float, float] | None = None
        self._permit: Permits | None = None
        self._drive_seq = 0
        self._drive_s = self._permit_s = inf  # before the first of the boot: gives the age 0
        self.steer_rad = 0.0
        self.has_monitor_joined = False
        self.is_held = True

    def lose(self, role: Role) -> None:
        """Cancel the command of a role."""
        if role == "controller":
            self._drive = None
        else:
            self._permit = None

    def drive(self, seq: int, right_rad_s: float, left_rad_s: float, now_s: float, steer_rad: float = 0.0) -> None:
        """Take a drive that arrived at ``now_s``."""
        fastest = max(abs(right_rad_s), abs(left_rad_s))
        if fastest > self._max_wheel_rad_s:
            scale = self._max_wheel_rad_s / fastest
            right_rad_s, left_rad_s = scale * right_rad_s, scale * left_rad_s
        self._drive = (float(right_rad_s), float(left_rad_s))  # a numpy number would slow down the computations
        self._drive_seq, self._drive_s, self.steer_rad = seq, now_s, steer_rad

    def permit(self, forward: bool, reverse: bool, turn: bool, now_s: float) -> None:
        """Take a permit that arrived at ``now_s``."""
        self._permit, self._permit_s = Permits(forward, reverse, turn), now_s

    def set_points(self, until_s: float) -> tuple[float, float]:
        """(right, left) wheel set points, rad/s, of a step to ``until_s``: drive and permit must last to its end."""
        drive = self._drive
        self.is_held = drive is None or not self._may_move(drive, until_s)
        return HELD if drive is None or self.is_held else drive

    def _may_move(self, drive: tuple[float, float], until_s: float) -> bool:
        # Times are multiples of the frame period: rounding must not reject an age of exactly the time-to-live.
        limit_s = self._ttl_s + 1e-9
        if until_s - self._drive_s > limit_s:
            return False
        if not self.has_monitor_joined:
            return True
        permit = self._permit
        if permit is None or until_s - self._permit_s > limit_s:
            return False
        if permit == ALL_MOTION:
            return True
        (right, left), (forward, reverse, turn) = drive, permit
        speed = right + left
        turns = right != left or (self.steer_rad != 0.0 and speed != 0.0)
        return (forward or speed <= 0.0) and (reverse or speed >= 0.0) and (turn or not turns)

    def echo(self, now_s: float) -> tuple[int, float, float, bool]:
        """(seq, age, permit age, held) of the drive in force: seq 0 without one; ages are 0 before the first."""
        seq = 0 if self._drive is None else self._drive_seq
        return seq, max(now_s - self._drive_s, 0.0), max(now_s - self._permit_s, 0.0), self.is_held


class FanRules:
    """Fan duties. Only a newer command changes them, never time or a lost session.

    A duty below ``floor`` is raised to it (0 = no floor); the fans start there.

    Attributes:
        duty: (left, right), 0 to 1.
        health: (left, right) actual thrust / nominal thrust.
    """

    def __init__(self, floor: float) -> None:
        self._floor = floor
        self.duty = (floor, floor)
        self.health = (1.0, 1.0)

    def command(self, left: float, right: float) -> None:
        """Set the duties, clamped to between the floor and 1."""
        self.duty = (min(max(left, self._floor), 1.0), min(max(right, self._floor), 1.0))

    @property
    def thrust(self) -> float:
        """Mean thrust, 0 to 1."""
        return 0.5 * (self.duty[0] * self.health[0] + self.duty[1] * self.health[1])


class SlideMonitor:
    """Detects loss of grip from accelerations ahead and to the left, gyroscope, gravity and wheels.

    The running mean over 1 s of inertial minus wheel values is subtracted, because it comes from errors of the sensors
    and of the removed gravity.
    """

    def __init__(self, limits: tuple[float, float], wheel_radius_m: float, wheel_base_m: float) -> None:
        self._rule, self._radius_m, self._base_m = SlideRule(*limits), wheel_radius_m, wheel_base_m
        self._last: tuple[float, float, float] | None = None
        self._speed_m_s = 0.0
        self._biases = [0.0, 0.0, 0.0]
        self._count = 0

    def step(
        self,
        sample: tuple[float, float, float, float],
        angles_rad: tuple[float | None, float | None],
        gravity: tuple[float, float, float, float] | None,
    ) -> bool:
        """Take an inertial sample and the (right, left) wheel angles; true if the robot slides."""
        rule, last, (t_s, ax, wz, ay), (right, left) = self._rule, self._last, sample, angles_rad
        self._last = None if right is None or left is None else (t_s, right, left)
        if (
            last is None
            or right is None
            or left is None
            or gravity is None
            or not last[0] < t_s < last[0] + rule.MEMORY_S
        ):
            rule.reset()
            return False
        dt_s = t_s - last[0]
        wheels = twist_of((right - last[1]) / dt_s, (left - last[2]) / dt_s, self._radius_m, self._base_m)
        change_m_s, self._speed_m_s = wheels.v_m_s - self._speed_m_s, wheels.v_m_s
        self._count += 1
        if not rule.is_possible(max(abs(ax), abs(ay))) or abs(change_m_s) > rule.WHEEL_JUMP_M_S:
            rule.reset()
            return False
        excess = ax - change_m_s / dt_s, ay - wz * wheels.v_m_s, wz - wheels.omega_rad_s
        share = max(dt_s / (_BIAS_TIME_S + dt_s), 1.0 / self._count)
        biases = self._biases
        for k, value in enumerate(excess):
            biases[k] += share * (value - biases[k])
        ahead, left_m_s2, turn = (dt_s * (value - bias) for value, bias in zip(excess, biases, strict=True))
        _, gx, gy, _ = gravity
        slope = hypot(gx, gy)
        downhill = (gx / slope, gy / slope) if slope >= rule.LEAST_SLOPE else HELD
        return rule.step(dt_s, ahead, left_m_s2, turn, downhill) > 0.0 and self._count > rule.BIAS_SAMPLES


class LinkedRobot(ABC):
    """Roles, commands and the newest frame (``seq``, ``t_s`` on the robot's clock) of a robot behind its link.

    A command that arrives while frame n is the newest takes effect in frame n + 1 + ``commands_delay_frames``. Its age
    counts from its arrival, so the time-to-live includes the delay. Its sequence number is compared with the one before
    when it arrives; sequence numbers count per kind and session.

    Attributes:
        reboots: restarts of a simulated robot so far.
        boot_count: those that its boot number shows.
        delivered_seq: number of the frame that reached the clients at this instant; -1 before the first, or if a fault
            removed it.
    """

    is_steerable = False

    def __init__(
        self, limits: tuple[float, float, float], frame_s: float, frame_hz: float, commands_delay_frames: int = 0
    ) -> None:
        self._limits = limits
        self.frame_s, self.frame_hz = frame_s, frame_hz
        self.commands_delay_frames = commands_delay_frames
        self.seq, self.t_s = 0, 0.0
        self.reboots = self.boot_count = 0
        self.delivered_seq = -1
        self._boot()

    def _boot(self) -> None:
        """Start the rules without any command, with the fans at their floor."""
        ttl_s, max_wheel_rad_s, fan_floor = self._limits
        self.rules = MotionRules(ttl_s, max_wheel_rad_s)
        self.fans = FanRules(fan_floor)
        self._waiting: deque[tuple[int, str, int, Any]] = deque()  # frame in which it is due, kind, seq, values
        self._newest = {"drive": -1, "permit": -1, "fans": -1}

    def hello(self, *, boot: int, nonce: str, auth: Literal["none", "hmac-sha256"], lockstep: bool) -> Hello:
        """The first message on a connection."""
        return Hello(PROTOCOL, boot, nonce, auth, lockstep, self.frame_hz, self._limits[0], self.describe())

    @abstractmethod
    def describe(self) -> RobotData:
        """The robot's data in the hello message."""

    @property
    def next_t_s(self) -> float:
        """Time of the next frame."""
        return (self.seq + 1) / self.frame_hz

    @property
    @abstractmethod
    def delivered_line(self) -> bytes:
        """Frame ``delivered_seq`` as a line with its LF; empty before the first.

        With faults it contains all bytes that leave the robot at this instant: nothing, an invalid line, several lines.
        """

    @abstractmethod
    def advance(self) -> None:
        """Drive one frame and read the sensors."""

    def join(self, role: Role) -> None:
        """Give a role to a new session; delayed fan duties of the previous controller take effect at once."""
        if role == "controller":
            for _, kind, _, values in self._waiting:
                if kind == "fans":
                    self.fans.command(*values)
            self._forget("fans")
        else:
            self.rules.has_monitor_joined = True
        self.lose(role)

    def lose(self, role: Role) -> None:
        """End the session of a role: its command is cancelled, so the wheels are held. Fan duties stay."""
        self._forget(_MOTION[role])
        self.rules.lose(role)

    def _forget(self, kind: str) -> None:
        self._newest[kind] = -1
        self._waiting = deque(command for command in self._waiting if command[1] != kind)

    def drive(
        self,
        seq: int,
        right_rad_s: float,
        left_rad_s: float,
        now_s: float | None = None,
        steer_rad: float | None = None,
    ) -> bool:
        """Take a drive; false for an old or equal ``seq`` and for numbers that are not finite.

        ``now_s`` is the robot's clock at its arrival, by default the time of the newest frame. Without a steered wheel
        ``steer_rad`` has no effect.
        """
        steer = steer_rad if steer_rad is not None and self.is_steerable else 0.0
        return self._take("drive", seq, (right_rad_s, left_rad_s, self.t_s if now_s is None else now_s, steer))

    def permit(self, seq: int, forward: bool, reverse: bool, turn: bool, now_s: float | None = None) -> bool:
        """Take a permit; false for an old or equal ``seq``. ``now_s`` as for ``drive``."""
        return self._take("permit", seq, (forward, reverse, turn, self.t_s if now_s is None else now_s))

    def command_fans(self, seq: int, left: float, right: float) -> bool:
        """Take fan duties; false for an old or equal ``seq`` and for numbers that are not finite."""
        return self._take("fans", seq, (left, right))

    def _take(self, kind: str, seq: int, values: tuple[Any, ...]) -> bool:
        if seq <= self._newest[kind] or not all(map(isfinite, values)):
            return False
        self._newest[kind] = seq
        if self.commands_delay_frames:
            self._waiting.append((self.seq + self.commands_delay_frames, kind, seq, values))
        else:
            self._apply(kind, seq, values)
        return True

    def _apply(self, kind: str, seq: int, values: tuple[Any, ...]) -> None:
        if kind == "drive":
            self.rules.drive(seq, *values)
        elif kind == "permit":
            self.rules.permit(*values)
        else:
            self.fans.command(*values)

    def _release_commands(self) -> None:
        """Apply the commands that are due when the step after the newest frame begins."""
        while self._waiting and self._waiting[0][0] <= self.seq:
            self._apply(*self._waiting.popleft()[1:])
