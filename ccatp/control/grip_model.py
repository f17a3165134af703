"""Forces on a robot on a slope: its load, the friction of its tyres, and the thrust that holds it.

Robot frame: x forward, z along the normal away from the surface; gravity is the unit vector of the direction of fall.
Two driven wheels at x = 0 give the friction; a smooth caster at x = -c carries a part of the load. With the centre of
mass at (x, h), weight G and thrust T against the surface, moments about the axle give the caster's load. The wheels
hold while

    mu N >= |G tangential|,   N = (T - G_z)(1 + x/c) + G_x h/c.

The worst heading has downhill behind, because the load moves to the caster. With downhill ahead, the caster must not
lift.
"""

from collections.abc import Sequence
from math import cos, hypot, pi, sqrt
from typing import NamedTuple

from ccatp.config.models import RobotConfig
from ccatp.core import GRAVITY_M_S2, DeckPose, Vector3
from ccatp.mirror.mirror import Mirror

_STOP_WAY_M = 0.03  # stopping distance at the rim that leaves two edge sensors on the mirror
HEADINGS_RAD = tuple(k * pi / 4.0 for k in range(8))
_LEAST_USE = 0.1  # tangential load over load of the wheels; with less the creep does not show either
_MOST_FRICTION = 2.0
MOST_USE = 0.8  # part of its friction that a wheel uses in a turn; with more it slips, and the creep grows steeply


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
        moved_n = load.to_rear_n * height_m / robot.caster_m  # from the wheels to the caster
        grips = load.outward_n + (load.tangential_n / robot.friction + moved_n) / share
        ahead_n = load.tangential_n if turns else -load.to_rear_n
        lifts = load.outward_n + ahead_n * height_m / -x_m if x_m < 0.0 else 0.0
        return max(grips, lifts, 0.0)

    def turn_thrust_n(self, gravity: Vector3) -> float:
        """Thrust for a turn, N: it has its margin, and at any heading each wheel uses at most 0.8 of its friction.

        The slope reduces the load of the higher wheel, and a centre of mass behind the axle increases its side force.
        The worst heading has downhill behind and a little to the side.
        """
        robot, load = self.robot, self._load(gravity, turns=True)
        x_m, height_m = robot.centre_of_mass_m
        per_friction = 1.0 / (MOST_USE * robot.friction)
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
        """Load along the surface over load of the wheels, by the angle of downhill from behind; < 0: wheels lift."""
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
        # The creep falls with the friction. Halved to the last bit: scipy's search would cost each start 0.15 s.
        low, high = least, _MOST_FRICTION
        while low < (middle := 0.5 * (low + high)) < high:
            low, high = (middle, high) if excess_m_rad(middle) > 0.0 else (low, middle)
        return low

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
