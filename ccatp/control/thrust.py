"""Thrust that holds the robot on its slope: what load, friction and manoeuvre need, and the fans' duty that gives it.

Robot frame: x ahead, z along the normal away from the surface; gravity is the unit vector along which things fall. Two
driven wheels at x = 0 carry the friction, a smooth caster at x = -c carries some of the load. With the centre of mass
at (x, h), weights G and thrust T against the surface, moments about the axle give the caster's load, and the wheels
hold while

    mu N >= |G tangential|,   N = (T - G_z)(1 + x/c) + G_x h/c.

Downhill behind is the worst heading: the load goes to the caster. Downhill ahead it must not leave the ground.
"""

from math import ceil, hypot, sqrt
from typing import NamedTuple

from ccatp.config.models import RobotConfig
from ccatp.core import GRAVITY_M_S2, DeckPose, Vector3
from ccatp.mirror.mirror import Mirror

_RAMP_PER_S = 1.0  # of the duty
_STEP = 0.02  # of the duty: smaller changes are not worth a command
_STOP_WAY_M = 0.03  # an overrun at the rim that leaves two edge sensors on the mirror


def least_thrust_n(robot: RobotConfig, gravity: Vector3, *, turns: bool) -> float:
    """Least thrust that holds the robot where it stands, or with ``turns`` at any heading there, N."""
    tangential, outward, ahead = _load_n(robot, gravity, turns=turns)
    x_m, height_m = robot.centre_of_mass_m
    share = 1.0 + x_m / robot.caster_m
    grips = outward + (tangential / robot.friction + ahead * height_m / robot.caster_m) / share
    lifts = outward + (tangential if turns else -ahead) * height_m / -x_m if x_m < 0.0 else 0.0
    return max(grips, lifts, 0.0)


def _load_n(robot: RobotConfig, gravity: Vector3, *, turns: bool) -> Vector3:
    """Weight along the surface, away from it, and along it to the rear (with ``turns`` at the worst heading), N."""
    x, y, z = gravity
    weight_n = robot.mass_kg * GRAVITY_M_S2
    tangential = weight_n * hypot(x, y)
    return tangential, weight_n * z, tangential if turns else -weight_n * x


class GripForecast(NamedTuple):
    """Where on a mirror a turn needs most thrust: the least there, N, and what the fans make of it at full duty.

    ``safe_speed_m_s``: see there; 0 where the robot cannot be held, or not stopped.
    """

    place: DeckPose
    least_n: float
    wanted_n: float
    thrust_n: float
    safe_speed_m_s: float

    @property
    def is_short(self) -> bool:
        """Less than the configured margin over the least: slow."""
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


def forecast_grip(robot: RobotConfig, mirror: Mirror) -> GripForecast:
    """By the configuration of the robot, at the centre of the panel that needs most."""
    places = [DeckPose(panel.x_m, panel.y_m, 0.0) for panel in mirror.panels.values()]
    needs = [(least_thrust_n(robot, mirror.gravity_in_robot(place), turns=True), place) for place in places]
    least_n, place = max(needs, key=lambda need: need[0])
    speed_m_s = safe_speed_m_s(robot, mirror.gravity_in_robot(place), robot.thrust_n)
    return GripForecast(place, least_n, robot.thrust_margin * least_n, robot.thrust_n, speed_m_s)


def safe_speed_m_s(robot: RobotConfig, gravity: Vector3, thrust_n: float) -> float:
    """Speed from which the grip that the slope leaves stops the robot within an overrun of 30 mm; 0: it cannot stop."""
    tangential, outward, to_rear = _load_n(robot, gravity, turns=True)
    x_m, height_m = robot.centre_of_mass_m
    wheels_n = (thrust_n - outward) * (1.0 + x_m / robot.caster_m) - to_rear * height_m / robot.caster_m
    spare_n = robot.friction * wheels_n - tangential
    return sqrt(2.0 * max(spare_n, 0.0) / robot.mass_kg * _STOP_WAY_M)


class ThrustControl:
    """The duty of both fans, never below the configured one: by the slope and the manoeuvre, with a ramp.

    ``duty``: (left, right) as last commanded. While the robot stands it has the thrust for a turn already.
    """

    def __init__(self, robot: RobotConfig, mirror: Mirror) -> None:
        self._robot, self._mirror = robot, mirror
        self.duty = robot.fan_duty
        self._t_s: float | None = None

    def step(self, t_s: float, pose: DeckPose, *, turns: bool) -> bool:
        """Set the duty for now; ``turns``: the robot turns, or may at any time. Whether it has changed."""
        elapsed_s = 0.0 if self._t_s is None else t_s - self._t_s
        robot, self._t_s = self._robot, t_s
        least_n = least_thrust_n(robot, self._mirror.gravity_in_robot(pose), turns=turns)
        wanted = _STEP * ceil(robot.thrust_margin * least_n / robot.thrust_n / _STEP)
        ramp = _RAMP_PER_S * min(max(elapsed_s, 0.0), 0.1)
        before = self.duty
        left, right = [
            round(min(max(wanted, lowest, now - ramp), now + ramp, 1.0), 3)
            for lowest, now in zip(robot.fan_duty, before, strict=True)
        ]
        self.duty = left, right
        return self.duty != before
