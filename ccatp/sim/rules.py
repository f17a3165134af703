"""The robot's side of the link, the same for every simulated robot; time is an argument.

It enforces by itself, whatever its clients do: drive and permit, time-to-live, directions, newest only. Deny by
default: a set point reaches the wheels only through ``MotionRules.set_points``.
"""

from abc import ABC, abstractmethod
from collections import deque
from math import isfinite

from ccatp.links.robot_messages import PROTOCOL, Hello, RobotData

HELD = (0.0, 0.0)
_EVERYTHING = (True, True, True)


class MotionRules:
    """Decides what the wheels may do.

    Wheels turn only while the newest drive is at most ``ttl_s`` old and, once a monitor has joined in this boot, the
    newest permit is at most ``ttl_s`` old and allows the direction: v = r (wr + wl)/2 > 0 needs ``forward``, < 0
    ``reverse``, wr != wl needs ``turn``. Sequence numbers count per kind and per session: a new session begins again.

    Args:
        max_wheel_rad_s: limit of a wheel; a faster drive is slowed down as a whole, so that its path stays the same.

    Attributes:
        is_held: the last ``set_points`` held the wheels.
    """

    __slots__ = (
        "_drive",
        "_drive_s",
        "_drive_seq",
        "_is_steered",
        "_max_wheel_rad_s",
        "_permit",
        "_permit_s",
        "_permit_seq",
        "_ttl_s",
        "has_monitor_joined",
        "is_held",
    )

    def __init__(self, ttl_s: float, max_wheel_rad_s: float, boot_s: float = 0.0) -> None:
        self._ttl_s, self._max_wheel_rad_s = ttl_s, max_wheel_rad_s
        self._drive: tuple[float, float] | None = None
        self._permit: tuple[bool, bool, bool] | None = None
        self._drive_seq = self._permit_seq = -1
        self._drive_s = self._permit_s = boot_s  # as old as the boot
        self._is_steered = self.has_monitor_joined = False
        self.is_held = True

    def join_controller(self) -> None:
        """A new session holds the controller's role: nothing of the one before is in force."""
        self._drive, self._drive_seq = None, -1

    def join_monitor(self) -> None:
        """A new session holds the monitor's role; from now on its permit is needed."""
        self.has_monitor_joined = True
        self._permit, self._permit_seq = None, -1

    def lose_controller(self) -> None:
        """The controller's session has ended: hold."""
        self._drive = None

    def lose_monitor(self) -> None:
        """The monitor's session has ended: hold."""
        self._permit = None

    def drive(self, seq: int, right_rad_s: float, left_rad_s: float, now_s: float, *, is_steered: bool = False) -> bool:
        """Take a drive that arrived at ``now_s``; false for an old or equal ``seq`` and for numbers not finite.

        Args:
            is_steered: wheels beside these two make a turn of it.
        """
        if seq <= self._drive_seq:
            return False
        limit = self._max_wheel_rad_s
        if not (-limit <= right_rad_s <= limit and -limit <= left_rad_s <= limit):
            if not isfinite(right_rad_s) or not isfinite(left_rad_s):
                return False
            scale = limit / max(abs(right_rad_s), abs(left_rad_s))
            right_rad_s, left_rad_s = scale * right_rad_s, scale * left_rad_s
        self._drive = (float(right_rad_s), float(left_rad_s))  # one number of numpy's would slow down all that follows
        self._drive_seq, self._drive_s, self._is_steered = seq, now_s, is_steered
        return True

    def permit(self, seq: int, forward: bool, reverse: bool, turn: bool, now_s: float) -> bool:
        """Take a permit that arrived at ``now_s``; false for an old or equal ``seq``."""
        if seq <= self._permit_seq:
            return False
        self._permit = (forward, reverse, turn)
        self._permit_seq, self._permit_s = seq, now_s
        return True

    def set_points(self, until_s: float) -> tuple[float, float]:
        """(right, left) wheel set points, rad/s, of a step to ``until_s``: drive and permit must last to its end."""
        drive = self._drive
        if drive is None or not self._may_move(drive, until_s):
            self.is_held = True
            return HELD
        self.is_held = False
        return drive

    def _may_move(self, drive: tuple[float, float], until_s: float) -> bool:
        # Times are multiples of the frame period: an age of exactly the time-to-live must not fail for its last bit.
        limit_s = self._ttl_s + 1e-9
        if until_s - self._drive_s > limit_s:
            return False
        if not self.has_monitor_joined:
            return True
        permit = self._permit
        if permit is None or until_s - self._permit_s > limit_s:
            return False
        if permit == _EVERYTHING:
            return True
        (right, left), (forward, reverse, turn) = drive, permit
        speed = right + left
        turns = right != left or (self._is_steered and speed != 0.0)
        return (forward or speed <= 0.0) and (reverse or speed >= 0.0) and (turn or not turns)

    def echo(self, now_s: float) -> tuple[int, float, float, bool]:
        """(seq, age, permit age, held) of the drive in force: seq -1 without one; ages count from the boot at most."""
        seq = -1 if self._drive is None else self._drive_seq
        return seq, max(now_s - self._drive_s, 0.0), max(now_s - self._permit_s, 0.0), self.is_held


class FanRules:
    """Fan duties: in force until changed by a newer command, never by time or by a lost session.

    Args:
        floor: no duty below this is accepted (0 = no floor); the fans start there.

    Attributes:
        duty: (left, right), 0 to 1.
        health: (left, right) share of the thrust that comes out, 1 = sound.
    """

    __slots__ = ("_floor", "_seq", "duty", "health")

    def __init__(self, floor: float) -> None:
        self._floor = floor
        self._seq = -1
        self.duty = (floor, floor)
        self.health = (1.0, 1.0)

    def join_controller(self) -> None:
        """A new session counts from the start; the duties stay."""
        self._seq = -1

    def command(self, seq: int, left: float, right: float) -> bool:
        """Take a command, clamped to the floor; false for an old or equal ``seq`` and for numbers not finite."""
        if seq <= self._seq or not isfinite(left) or not isfinite(right):
            return False
        self._seq = seq
        self.duty = (min(max(left, self._floor), 1.0), min(max(right, self._floor), 1.0))
        return True

    @property
    def thrust(self) -> float:
        """Mean thrust, 0 to 1."""
        return 0.5 * (self.duty[0] * self.health[0] + self.duty[1] * self.health[1])


class CommandDelay:
    """The way of commands to the wheels: what arrives takes effect a whole number of frames later.

    A command that arrives while frame n is the newest takes effect in the frame that follows n + delay. Its age counts
    from its arrival, so the time-to-live covers the delay, too. Whether a command is newer than the one before is
    decided when it arrives. Drives, permits and duties do not overtake their own kind; the kinds are independent.
    """

    __slots__ = ("_drives", "_duties", "_fans", "_frames", "_newest_drive", "_newest_duty", "_newest_permit",
                 "_permits", "_rules")  # fmt: skip

    def __init__(self, rules: MotionRules, fans: FanRules, frames: int) -> None:
        self._rules, self._fans, self._frames = rules, fans, frames
        # (frame in which it is due, what the rules or the fans take)
        self._drives: deque[tuple[int, int, float, float, float]] = deque()
        self._permits: deque[tuple[int, int, tuple[bool, bool, bool], float]] = deque()
        self._duties: deque[tuple[int, int, float, float]] = deque()
        self._newest_drive = self._newest_permit = self._newest_duty = -1

    def drive(self, frame: int, seq: int, right_rad_s: float, left_rad_s: float, now_s: float) -> bool:
        """Take a drive; false for an old or equal ``seq`` and for numbers not finite."""
        if not self._frames:
            return self._rules.drive(seq, right_rad_s, left_rad_s, now_s)
        if seq <= self._newest_drive or not (isfinite(right_rad_s) and isfinite(left_rad_s)):
            return False
        self._newest_drive = seq
        self._drives.append((frame + self._frames, seq, right_rad_s, left_rad_s, now_s))
        return True

    def permit(self, frame: int, seq: int, allowed: tuple[bool, bool, bool], now_s: float) -> bool:
        """Take a permit (forward, reverse, turn); false for an old or equal ``seq``."""
        if not self._frames:
            return self._rules.permit(seq, *allowed, now_s)
        if seq <= self._newest_permit:
            return False
        self._newest_permit = seq
        self._permits.append((frame + self._frames, seq, allowed, now_s))
        return True

    def fans(self, frame: int, seq: int, left: float, right: float) -> bool:
        """Take fan duties; false for an old or equal ``seq`` and for numbers not finite."""
        if not self._frames:
            return self._fans.command(seq, left, right)
        if seq <= self._newest_duty or not (isfinite(left) and isfinite(right)):
            return False
        self._newest_duty = seq
        self._duties.append((frame + self._frames, seq, left, right))
        return True

    def release(self, frame: int) -> None:
        """Hand on what is due when the step after ``frame`` begins."""
        drives, permits, duties = self._drives, self._permits, self._duties
        while drives and drives[0][0] <= frame:
            _, seq, right_rad_s, left_rad_s, now_s = drives.popleft()
            self._rules.drive(seq, right_rad_s, left_rad_s, now_s)
        while permits and permits[0][0] <= frame:
            _, seq, (forward, reverse, turn), now_s = permits.popleft()
            self._rules.permit(seq, forward, reverse, turn, now_s)
        while duties and duties[0][0] <= frame:
            _, seq, left, right = duties.popleft()
            self._fans.command(seq, left, right)

    def join_controller(self) -> None:
        """A new session: drives of the one before are forgotten; its fan duties, already accepted, come into force."""
        self.lose_controller()
        for _, seq, left, right in self._duties:
            self._fans.command(seq, left, right)
        self._duties.clear()
        self._newest_duty = -1

    def join_monitor(self) -> None:
        """A new session: permits of the one before are forgotten."""
        self.lose_monitor()

    def lose_controller(self) -> None:
        """Drives on their way are forgotten; fan duties are not."""
        self._drives.clear()
        self._newest_drive = -1

    def lose_monitor(self) -> None:
        """Permits on their way are forgotten."""
        self._permits.clear()
        self._newest_permit = -1


class SimulatedRobot(ABC):
    """The robot's side of the link that every simulated robot has: roles, commands, and the newest frame.

    Attributes:
        seq, t_s: newest frame and its time on the robot's clock.
        reboots: power-ups since the start.
    """

    def __init__(
        self, limits: tuple[float, float, float], frame_s: float, frame_hz: float, commands_delay_frames: int = 0
    ) -> None:
        self._limits = limits
        self.frame_s, self._frame_hz = frame_s, frame_hz
        self.commands_delay_frames = commands_delay_frames
        self.seq, self.t_s, self.reboots = 0, 0.0, 0
        self._boot(0.0)

    def _boot(self, boot_s: float) -> None:
        """Rules without any command; the fans at their floor."""
        ttl_s, max_wheel_rad_s, fan_floor = self._limits
        self.rules = MotionRules(ttl_s, max_wheel_rad_s, boot_s)
        self.fans = FanRules(fan_floor)
        self._commands = CommandDelay(self.rules, self.fans, self.commands_delay_frames)

    @abstractmethod
    def describe(self) -> RobotData:
        """What the hello says of the robot."""

    @property
    @abstractmethod
    def next_t_s(self) -> float:
        """Time of the next frame."""

    @property
    @abstractmethod
    def delivered_seq(self) -> int:
        """Number of the frame that reached the clients at this instant; -1 while none has, or a fault took it."""

    @property
    @abstractmethod
    def delivered_line(self) -> bytes:
        """That frame as a line with its LF; empty while none has reached the clients."""

    @abstractmethod
    def advance(self) -> None:
        """Drive one frame and read the sensors."""

    def hello(self, *, boot: int, nonce: str, auth: str, lockstep: bool) -> Hello:
        """The first message on a connection."""
        return Hello(
            protocol=PROTOCOL,
            boot=boot,
            nonce=nonce,
            auth="hmac-sha256" if auth == "hmac-sha256" else "none",
            lockstep=lockstep,
            frame_hz=self._frame_hz,
            ttl_s=self._limits[0],
            robot=self.describe(),
        )

    def join_controller(self) -> None:
        """A new session holds the controller's role."""
        self._commands.join_controller()
        self.rules.join_controller()
        self.fans.join_controller()

    def join_monitor(self) -> None:
        """A new session holds the monitor's role; from now on its permit is needed."""
        self._commands.join_monitor()
        self.rules.join_monitor()

    def lose_controller(self) -> None:
        """The controller's session has ended: hold."""
        self._commands.lose_controller()
        self.rules.lose_controller()

    def lose_monitor(self) -> None:
        """The monitor's session has ended: hold."""
        self._commands.lose_monitor()
        self.rules.lose_monitor()

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
        del steer_rad
        return self._commands.drive(self.seq, seq, right_rad_s, left_rad_s, self.t_s if now_s is None else now_s)

    def permit(self, seq: int, forward: bool, reverse: bool, turn: bool, now_s: float | None = None) -> bool:
        """Take a permit; false for an old or equal ``seq``. ``now_s`` as for ``drive``."""
        allowed = forward, reverse, turn
        return self._commands.permit(self.seq, seq, allowed, self.t_s if now_s is None else now_s)

    def command_fans(self, seq: int, left: float, right: float) -> bool:
        """Take fan duties; false for an old or equal ``seq`` and for numbers that are not finite."""
        return self._commands.fans(self.seq, seq, left, right)
