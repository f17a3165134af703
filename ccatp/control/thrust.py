"""Thrust that holds the robot on its slope, from load, friction and manoeuvre, and the fans' duty for it.

Robot frame: x forward, z along the normal away from the surface; gravity is the unit vector of the direction of fall.
Two driven wheels at x = 0 give the friction; a smooth caster at x = -c carries a part of the load. With the centre of
mass at (x, h), weight G and thrust T against the surface, moments about the axle give the caster's load. The wheels
hold while

    mu N >= |G tangential|,   N = (T - G_z)(1 + x/c) + G_x h/c.

The worst heading has downhill behind, because the load moves to the caster. With downhill ahead, the caster must not
lift.
"""

from collections.abc import Sequence
from math import ceil, cos, hypot, pi, sqrt
from typing import NamedTuple

from scipy.optimize import brentq

from ccatp.config.models import RobotConfig
from ccatp.core import GRAVITY_M_S2, DeckPose, Vector3
from ccatp.kinematics import difference
from ccatp.mirror.mirror import Mirror

_RAMP_PER_S = 1.0  # of the duty
_STEP = 0.02  # of the duty; smaller changes are not commanded
_STOP_WAY_M = 0.03  # stopping distance at the rim that leaves two edge sensors on the mirror
HEADINGS_RAD = tuple(k * pi / 4.0 for k in range(8))
_LEAST_TURN_RAD = 1.0  # turn between two fixes; a shorter one does not show the creep
_LEAST_USE = 0.1  # tangential load over load of the wheels; with less the creep does not show either
_MOST_FRICTION = 2.0
_TURNS = 4  # number of turns in the mean creep
_MOST_USE = 0.8  # part of its friction that a wheel uses in a turn; with more it slips, and the creep grows steeply
_TILT_STEP = 1e-3  # step of the sine of the slope's angle, within which the creep changes by less than 1 %
_MOST_SHARE = 0.95  # largest used part of the friction; the law diverges at 1
_TOLERANCE = 1.8  # ratio by which the creep at the configured friction varies with slope and heading


class SlopeLoad(NamedTuple):
    """Weight along the surface, away from it, and along it to the rear, N."""

    tangential_n: float
    outward_n: float
    to_rear_n: float


class GripForecast(NamedTuple):
    """The place on a mirror where a turn needs most thrust: least and wanted thrust there, and full thrust, N.

    ``safe_speed_m_s``: see ``GripModel``; 0 where the robot cannot be held or stopped.
    """

    place: DeckPose
    least_n: float
    wanted_n: float
    thrust_n: float
    safe_speed_m_s: float

    @property
    def is_short(self) -> bool:
        """Less than the configured margin over the least: the robot has to drive slowly."""
        return self.thrust_n < 0.999 * self.wanted_n

    @property
    def is_held(self) -> bool:
        """Enough for every stop and turn."""
        return self.safe_speed_m_s > 0.0

    @property
    def text(self) -> str:
        """One line."""
        at = f"({self.place.x_m:.2f}, {self.place.y_m:.2f}) m"
        found = f"the fans give {self.thrust_n:.1f} N; turns need {self.least_n:.1f} N at {at}"
        if not self.is_held:
            return f"{found}: the robot WOULD SLIDE, no speed is safe; {self.wanted_n:.1f} N are needed"
        if self.is_short:
            return (
                f"{found}: little grip, half the speed; from {self.safe_speed_m_s:.2f} m/s it stops within "
                f"{1e3 * _STOP_WAY_M:.0f} mm; {self.wanted_n:.1f} N are needed for more"
            )
        return found


class GripModel:
    """The forces on a robot on a slope: load, friction of its tyres, thrust of its fans.

    ``gravity``: unit vector of the direction of fall, robot frame.
    """

    def __init__(self, robot: RobotConfig) -> None:
        self.robot = robot

    def with_friction(self, friction: float) -> "GripModel":
        """The model with another friction of the tyres."""
        return GripModel(self.robot.model_copy(update={"friction": friction}))

    def least_thrust_n(self, gravity: Vector3, *, turns: bool) -> float:
        """Least thrust that holds the robot at its place and heading, or with ``turns`` at any heading, N."""
        robot, load = self.robot, self._load(gravity, turns=turns)
        x_m, height_m = robot.centre_of_mass_m
        share = 1.0 + x_m / robot.caster_m
        grips = (
            load.outward_n + (load.tangential_n / robot.friction + load.to_rear_n * height_m / robot.caster_m) / share
        )
        ahead_n = load.tangential_n if turns else -load.to_rear_n
        lifts = load.outward_n + ahead_n * height_m / -x_m if x_m < 0.0 else 0.0
        return max(grips, lifts, 0.0)

    def turn_thrust_n(self, gravity: Vector3) -> float:
        """Thrust for a turn, N, so that it has its margin and each wheel uses at most 0.8 of its friction at any heading.

        The slope reduces the load of the higher wheel, and a centre of mass behind the axle increases its side force.
        The worst heading has downhill behind and a little to the side.
        """
        robot, load = self.robot, self._load(gravity, turns=True)
        x_m, height_m = robot.centre_of_mass_m
        per_friction = 1.0 / (_MOST_USE * robot.friction)
        along = per_friction + height_m / robot.caster_m
        across = 2.0 * (abs(x_m) * per_friction + height_m) / robot.wheel_base_m
        higher_n = load.outward_n + load.tangential_n * hypot(along, across) / (1.0 + x_m / robot.caster_m)
        return max(robot.thrust_margin * self.least_thrust_n(gravity, turns=True), higher_n)

    def forecast(self, mirror: Mirror) -> GripForecast:
        """Forecast from the robot's configuration, at the centre of the panel that needs most thrust."""
        robot = self.robot
        places = [DeckPose(panel.x_m, panel.y_m, 0.0) for panel in mirror.panels.values()]
        needs = [(self.least_thrust_n(mirror.gravity_in_robot(place), turns=True), place) for place in places]
        least_n, place = max(needs, key=lambda need: need[0])
        speed_m_s = self.safe_speed_m_s(mirror.gravity_in_robot(place), robot.thrust_n)
        return GripForecast(place, least_n, robot.thrust_margin * least_n, robot.thrust_n, speed_m_s)

    def safe_speed_m_s(self, gravity: Vector3, thrust_n: float) -> float:
        """Speed from which the robot stops within 30 mm by the grip that the slope leaves; 0: it cannot stop."""
        load = self._load(gravity, turns=True)
        wheels_n = self._wheels_n(thrust_n - load.outward_n, load.to_rear_n)
        spare_n = self.robot.friction * wheels_n - load.tangential_n
        return sqrt(2.0 * max(spare_n, 0.0) / self.robot.mass_kg * _STOP_WAY_M)

    def used_friction(self, gravity: Vector3, thrust_n: float, headings_rad: Sequence[float]) -> list[float]:
        """Load along the surface over load of the wheels, by the angle of downhill from behind; < 0: the wheels lift."""
        load = self._load(gravity, turns=True)
        pressed_n, tangential_n = thrust_n - load.outward_n, load.tangential_n
        loads_n = [self._wheels_n(pressed_n, tangential_n * cos(to_rear)) for to_rear in headings_rad]
        return [tangential_n / load_n if load_n > 0.0 else -1.0 for load_n in loads_n]

    def friction_by_creep(self, gravity: Vector3, thrust_n: float, creep_m_rad: float) -> float | None:
        """Friction of tyres that creep downhill by ``creep_m_rad`` per radian of a turn in place.

        ``None`` on too little slope. The forces of a pivoting contact are limited by an ellipsoid, and the contact
        slides along its normal (Howe and Cutkosky 1996): using the part u of its friction, it creeps by
        tyre_m u / sqrt(1 - u^2) per radian. Mean over all headings.
        """
        robot, used = self.robot, self.used_friction(gravity, thrust_n, HEADINGS_RAD)
        if min(used) < 0.0:
            return None

        def excess_m_rad(friction: float) -> float:
            creeps = (robot.tyre_m * use / sqrt(friction * friction - use * use) for use in used)
            return sum(creeps) / len(used) - creep_m_rad

        least = 1.001 * max(used)  # the robot did not slide
        if not _LEAST_USE < least < _MOST_FRICTION or robot.tyre_m == 0.0:
            return None
        if excess_m_rad(_MOST_FRICTION) > 0.0:
            return _MOST_FRICTION
        return float(brentq(excess_m_rad, least, _MOST_FRICTION)) if excess_m_rad(least) > 0.0 else least

    def _load(self, gravity: Vector3, *, turns: bool) -> SlopeLoad:
        """With ``turns``: at the worst heading, with downhill behind."""
        x, y, z = gravity
        weight_n = self.robot.mass_kg * GRAVITY_M_S2
        tangential_n = weight_n * hypot(x, y)
        return SlopeLoad(tangential_n, weight_n * z, tangential_n if turns else -weight_n * x)

    def _wheels_n(self, pressed_n: float, to_rear_n: float) -> float:
        """Load of both wheels, N."""
        x_m, height_m = self.robot.centre_of_mass_m
        return pressed_n * (1.0 + x_m / self.robot.caster_m) - to_rear_n * height_m / self.robot.caster_m


class _CreepLaw(NamedTuple):
    """Friction over used friction with downhill to the side, its increase with downhill ahead; mean creep.

    The mean creep is 0 if the wheels lift.
    """

    level: float
    swing: float
    mean: float


class TurnCreep:
    """Creep of a turn at one heading, divided by its mean over all headings, by the law of
    ``GripModel.friction_by_creep``.

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
        level, swing = _MOST_USE * robot.friction / aside, _MOST_USE * robot.friction * (1.0 / ahead - 1.0 / aside)
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
        self._heading_rad, self._turned_rad, self._creep_m_rad = mirror.base_pose.heading_rad, 0.0, 0.0

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
