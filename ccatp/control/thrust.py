"""The fans' duty: the thrust that the slope and the manoeuvre need, by the friction that the creep of turns shows."""

from math import ceil, cos, hypot, pi, sqrt
from typing import NamedTuple

from ccatp.config.models import RobotConfig
from ccatp.control.grip_model import HEADINGS_RAD, MOST_USE, GripModel
from ccatp.core import DeckPose, Vector3
from ccatp.kinematics import difference
from ccatp.mirror.mirror import Mirror

_RAMP_PER_S = 1.0  # of the duty
_STEP = 0.02  # of the duty; smaller changes are not commanded
_LEAST_TURN_RAD = 1.0  # turn between two fixes; a shorter one does not show the creep
_TURNS = 4  # number of turns in the mean creep
_TILT_STEP = 1e-3  # step of the sine of the slope's angle, within which the creep changes by less than 1 %
_MOST_SHARE = 0.95  # largest used part of the friction; the law diverges at 1
_TOLERANCE = 1.8  # ratio by which the creep at the configured friction varies with slope and heading


class _CreepLaw(NamedTuple):
    """Friction over used friction with downhill to the side, its increase with downhill ahead; mean creep.

    The mean creep is 0 if the wheels lift.
    """

    level: float
    swing: float
    mean: float


class TurnCreep:
    """Creep of a turn at one heading, divided by its mean over all headings; see ``GripModel.friction_by_creep``.

    The thrust is that of a turn. Tyres creep as if they had 0.8 of their friction.
    """

    def __init__(self, robot: RobotConfig) -> None:
        self._grip = GripModel(robot)
        self._slopes: dict[tuple[int, bool], _CreepLaw] = {}

    def share(self, gravity: Vector3) -> float:
        """Ratio at the heading with this gravity (unit vector, robot frame); 1 if the wheels lift."""
        x, y, z = gravity
        tilt = hypot(x, y)
        key = round(tilt / _TILT_STEP), z > 0.0
        law = self._slopes.get(key)
        if law is None:
            law = self._slopes[key] = self._law(key[0] * _TILT_STEP, overhangs=key[1])
        return _creep(law.level + law.swing * x / tilt) / law.mean if law.mean else 1.0

    def _law(self, tilt: float, *, overhangs: bool) -> _CreepLaw:
        """``tilt``: sine of the angle between surface and horizontal."""
        grip, robot, height = self._grip, self._grip.robot, sqrt(max(1.0 - tilt * tilt, 0.0))
        gravity = tilt, 0.0, height if overhangs else -height
        thrust_n = min(max(grip.turn_thrust_n(gravity), 0.5 * sum(robot.fan_duty) * robot.thrust_n), robot.thrust_n)
        aside, ahead = grip.used_friction(gravity, thrust_n, (0.5 * pi, pi))
        if min(grip.used_friction(gravity, thrust_n, HEADINGS_RAD)) <= 0.0:
            return _CreepLaw(0.0, 0.0, 0.0)
        level, swing = MOST_USE * robot.friction / aside, MOST_USE * robot.friction * (1.0 / ahead - 1.0 / aside)
        creeps = [_creep(level - swing * cos(to_rear)) for to_rear in HEADINGS_RAD]
        return _CreepLaw(level, swing, sum(creeps) / len(creeps))


def _creep(per_use: float) -> float:
    """The law u / sqrt(1 - u^2) for the used part u = 1 / ``per_use`` of the friction."""
    share = min(1.0 / per_use, _MOST_SHARE) if per_use > 0.0 else _MOST_SHARE
    return share / sqrt(1.0 - share * share)


class ThrustControl:
    """Sets the duty of both fans by slope and manoeuvre, with a ramp, never below the configured duty.

    ``duty``: last command (left, right). A standing robot already gets the thrust for a turn. ``friction``: of the
    tyres, from the creep of turns; 0 before the first measurement. ``margin``: full thrust over the least that holds
    the robot on the whole mirror; 0 likewise. It uses the configured friction while the creep is at most 1.8 times the
    creep expected from it, and a smaller one otherwise.
    """

    def __init__(self, robot: RobotConfig, mirror: Mirror) -> None:
        self._grip = GripModel(robot)
        self._configured_friction = robot.friction
        self._mirror = mirror
        self.duty = robot.fan_duty
        self.friction = self.margin = 0.0
        self._t_s: float | None = None
        self._is_full = False
        self._fixes = self._turns = 0
        self._heading_rad = mirror.base_pose.heading_rad
        self._turned_rad = 0.0
        self._creep_m_rad = 0.0

    def give_all(self) -> bool:
        """Full duty from now on; returns whether this is a change."""
        is_new = not self._is_full
        self._is_full = True
        self.duty = (1.0, 1.0)
        return is_new

    def step(self, t_s: float, pose: DeckPose, *, turns: bool) -> bool:
        """Set the duty; returns whether it has changed. ``turns``: the robot turns, or may turn at any time."""
        elapsed_s = 0.0 if self._t_s is None else t_s - self._t_s
        grip, robot = self._grip, self._grip.robot
        self._t_s = t_s
        self._turned_rad += abs(difference(pose.heading_rad, self._heading_rad))
        self._heading_rad = pose.heading_rad
        if self._is_full:
            return False
        gravity = self._mirror.gravity_in_robot(pose)
        straight_n = robot.thrust_margin * grip.least_thrust_n(gravity, turns=False)
        wanted_n = grip.turn_thrust_n(gravity) if turns else straight_n
        wanted = _STEP * ceil(wanted_n / robot.thrust_n / _STEP)
        ramp = _RAMP_PER_S * min(max(elapsed_s, 0.0), 0.1)
        before = self.duty
        left, right = [
            round(min(max(wanted, lowest, now - ramp), now + ramp, 1.0), 3)
            for lowest, now in zip(robot.fan_duty, before, strict=True)
        ]
        self.duty = left, right
        return self.duty != before

    def measure_grip(self, fixes: int, pose: DeckPose, creep_m_rad: float) -> bool:
        """Update friction and margin from the turn before fix number ``fixes``; returns whether there was a new value.

        ``creep_m_rad``: estimated downhill creep per radian of a turn.
        """
        if fixes == self._fixes:
            return False
        turned_rad = self._turned_rad
        self._fixes = fixes
        self._turned_rad = 0.0
        if turned_rad < _LEAST_TURN_RAD:
            return False
        self._turns = min(self._turns + 1, _TURNS)
        self._creep_m_rad += (creep_m_rad - self._creep_m_rad) / self._turns
        grip, gravity = self._grip, self._mirror.gravity_in_robot(pose)
        thrust_n = 0.5 * sum(self.duty) * grip.robot.thrust_n
        measured = grip.friction_by_creep(gravity, thrust_n, self._creep_m_rad)
        largest = grip.friction_by_creep(gravity, thrust_n, self._creep_m_rad / _TOLERANCE)
        if measured is None or largest is None:
            return False
        self.friction = measured
        friction = min(largest, self._configured_friction)
        if friction != grip.robot.friction or not self.margin:
            self._grip = grip.with_friction(friction)
            self.margin = grip.robot.thrust_n / self._grip.forecast(self._mirror).least_n
        return True
