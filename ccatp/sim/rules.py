"""What the robot enforces by itself, whatever its clients do: two keys, time-to-live, directions, newest only.

Deny by default: a set point reaches the wheels only through ``MotionRules.set_points``.

A frame as the robot read it, as a line of the robot link and as the message that a client decodes from it.
"""

from collections.abc import Iterable
from itertools import repeat
from math import isfinite
from typing import TypeVar

import msgspec

from ccatp.core import EdgeSample, GravitySample, ImuSample, WheelSample
from ccatp.links.robot_codec import encode_sensors
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.sim.edge_sensors import EdgeTuple
from ccatp.sim.sensors import GravityTuple, ImuTuple, WheelTuple

HELD = (0.0, 0.0)
_EVERYTHING = (True, True, True)


class MotionRules:
    """Decides what the wheels may do.

    Wheels turn only while the newest drive is at most ``ttl_s`` old and, once a monitor has joined in this boot, the
    newest permit is at most ``ttl_s`` old and allows the direction: v = r (wr + wl)/2 > 0 needs ``forward``, < 0
    ``reverse``, wr != wl needs ``turn``. Sequence numbers count per kind and per session: a new session starts anew.

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
        """A new session holds the monitor's role; from now on the second key is needed."""
        self.has_monitor_joined = True
        self._permit, self._permit_seq = None, -1

    def lose_controller(self) -> None:
        """The controller's session is gone: hold."""
        self._drive = None

    def lose_monitor(self) -> None:
        """The monitor's session is gone: hold."""
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
        """(right, left) wheel set points of a step that ends at ``until_s``: both keys must last as long, rad/s."""
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
        """A new session counts anew; the duties stay."""
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


_Row = TypeVar("_Row", ImuSample, WheelSample, EdgeSample)


class RobotFrame(msgspec.Struct, frozen=True, gc=False):
    """A frame as it was read: what ``Sensors`` says, in the same places, with samples as plain tuples.

    Making named tuples of twenty samples takes as long as reading them, so it waits until somebody asks for names.
    """

    seq: int
    t: float
    imu: list[ImuTuple]
    enc: list[WheelTuple]
    edge: list[EdgeTuple]
    gravity: GravityTuple | None
    fans: tuple[float, float]
    soc: float
    cmd: CommandEcho
    faults: tuple[str, ...]


def as_line(frame: RobotFrame) -> bytes:
    """The frame as a line with its LF."""
    seq, t_s, imu, encoders, edges, gravity, fans, soc, cmd, faults = msgspec.structs.astuple(frame)
    return encode_sensors(seq, t_s, imu, encoders, edges, gravity, fans, soc, msgspec.structs.astuple(cmd), faults)


def as_message(frame: RobotFrame) -> Sensors:
    """The message that a client decodes from the frame's line."""
    gravity = frame.gravity
    return Sensors(
        frame.seq,
        frame.t,
        named(ImuSample, frame.imu),
        named(WheelSample, frame.enc),
        named(EdgeSample, frame.edge),
        None if gravity is None else GravitySample(*gravity),
        frame.fans,
        frame.soc,
        frame.cmd,
        list(frame.faults),
    )


def named(kind: type[_Row], rows: Iterable[tuple[object, ...]]) -> list[_Row]:
    """The rows as named tuples; five times as fast as calling the class for each."""
    return list(map(tuple.__new__, repeat(kind), rows))
