"""Driving to a point with fuzzy, PI-controlled or constant speed; a zero-order Sugeno controller; waypoint lists."""

from collections.abc import Mapping, Sequence
from itertools import pairwise, product
from math import cos, hypot, pi
from typing import NamedTuple

from ccatp.beacons.config.models import FuzzyConfig, RadioControlConfig, VehicleConfig
from ccatp.control.pid import Pid, PidState
from ccatp.kinematics import bearing, wrap_pi

_Trapezoid = tuple[float, float, float, float]


class FuzzyGapError(ValueError):
    """No rule fires for some inputs, which it carries."""

    def __init__(self, inputs: Mapping[str, float]) -> None:
        where = ", ".join(f"{name} = {value:g}" for name, value in inputs.items())
        super().__init__(f"no rule of the fuzzy controller fires at {where}; add a rule or widen a term")
        self.inputs = dict(inputs)


class Sugeno:
    """Output u = sum(w_i u_i) / sum(w_i), w_i the product of the memberships that rule i names (Takagi, Sugeno 1985).

    Memberships are trapezoids. Each input is limited to the range from its first to its last shoulder, so rules without
    a gap there have none anywhere. Raises FuzzyGapError: no rule fires at a combination of corners of the trapezoids or
    of points halfway between corners.
    """

    def __init__(self, cfg: FuzzyConfig) -> None:
        self.inputs = tuple(cfg.inputs)
        self._terms = [tuple(given.terms.values()) for given in cfg.inputs.values()]
        names = [list(given.terms) for given in cfg.inputs.values()]
        self._spans = [(min(t[1] for t in terms), max(t[2] for t in terms)) for terms in self._terms]
        self._rules = [
            (
                tuple((i, names[i].index(rule.when[name])) for i, name in enumerate(self.inputs) if name in rule.when),
                cfg.outputs[rule.then],
            )
            for rule in cfg.rules
        ]
        self._check_gaps()

    def evaluate(self, values: Sequence[float]) -> float:
        """The output. Raises FuzzyGapError: no rule fires."""
        grades = [self.memberships(index, value) for index, value in enumerate(values)]
        total = weighted = 0.0
        for conditions, output in self._rules:
            weight = 1.0
            for i, k in conditions:
                weight *= grades[i][k]
            total += weight
            weighted += weight * output
        if total <= 0.0:
            raise FuzzyGapError(dict(zip(self.inputs, values, strict=True)))
        return weighted / total

    def memberships(self, index: int, value: float) -> list[float]:
        """Grades of a value in the terms of one input, in their order."""
        low, high = self._spans[index]
        return [_grade(min(max(value, low), high), term) for term in self._terms[index]]

    def _check_gaps(self) -> None:
        axes = []
        for (low, high), terms in zip(self._spans, self._terms, strict=True):
            corners = sorted({min(max(corner, low), high) for term in terms for corner in term})
            halves = [0.5 * (a + b) for a, b in pairwise(corners)]
            axes.append(sorted({*corners, *halves}))
        for values in product(*axes):
            self.evaluate(values)


def _grade(value: float, term: _Trapezoid) -> float:
    left_foot, left_shoulder, right_shoulder, right_foot = term
    if left_shoulder <= value <= right_shoulder:
        return 1.0
    if value <= left_foot or value >= right_foot:
        return 0.0
    if value < left_shoulder:
        return (value - left_foot) / (left_shoulder - left_foot)
    return (right_foot - value) / (right_foot - right_shoulder)


PlanarPose = tuple[float, float, float]  # x m, y m, heading rad
Point = tuple[float, float]


class SteeringCommand(NamedTuple):
    """Set points, held until the next step."""

    speed_m_s: float
    steer_rad: float
    turn_rate_rad_s: float


HALT = SteeringCommand(0.0, 0.0, 0.0)


class BearingToPoint(NamedTuple):
    """A goal relative to the vehicle."""

    distance_m: float
    error_rad: float  # of the heading: positive if the goal is to the left


def aim_at(pose: PlanarPose, goal_m: Point) -> BearingToPoint:
    """Distance and heading error from a pose (x m, y m, heading rad) to a point in the frame of the room."""
    dx_m, dy_m = goal_m[0] - pose[0], goal_m[1] - pose[1]
    return BearingToPoint(hypot(dx_m, dy_m), wrap_pi(bearing(dx_m, dy_m) - pose[2]))


class WaypointSteering:
    """Set points that drive to a goal.

    Steering gamma = K error, limited (Hevrdejs and Knoll 2017). A differential drive turns at K v_max / l error, which
    is the same curve at full speed; at zero speed it turns on the spot. Speed:

    * ``fuzzy``: of the distance and of the heading error's magnitude (2017).
    * ``pi``: of the distance, times the cosine of the heading error (Auth and Hovey 2018, section 2.4).
    * ``constant``: always the same (2018, as built).

    Raises FuzzyGapError: the rules leave a gap.
    """

    def __init__(self, control: RadioControlConfig, vehicle: VehicleConfig) -> None:
        self._control = control
        self._vehicle = vehicle
        self._fuzzy = Sugeno(control.fuzzy)
        self._pi, self._pi_memory = Pid(control.pi, vehicle.speed_max_m_s), PidState()

    def reset(self) -> None:
        """Reset the integral, for a new goal or after a stop."""
        self._pi_memory = PidState()

    def drive(self, aim: BearingToPoint, interval_s: float) -> SteeringCommand:
        """Set points for the next interval, s."""
        return self._turning(self._speed(aim, interval_s), aim.error_rad)

    def away(self, speed_m_s: float, error_rad: float) -> SteeringCommand:
        """Set points that move away from an object at ``error_rad``: backwards if it is ahead, else forwards.

        Steered wheels turn a vehicle in the opposite sense when it moves backwards.
        """
        speed_m_s = min(speed_m_s, self._vehicle.speed_max_m_s)
        if abs(error_rad) > pi / 2.0:
            return self._turning(speed_m_s, -wrap_pi(pi - error_rad))
        return self._turning(-speed_m_s, -error_rad if self._vehicle.kind == "ackermann" else error_rad)

    def face(self, error_rad: float) -> SteeringCommand:
        """Set points that turn on the spot towards a goal; an Ackermann vehicle cannot, so it stops."""
        if self._vehicle.kind == "ackermann":
            return HALT
        return self._turning(0.0, error_rad)

    def _turning(self, speed_m_s: float, error_rad: float) -> SteeringCommand:
        vehicle = self._vehicle
        steer_rad = _clamped(self._control.steering_gain * error_rad, vehicle.steer_max_rad)
        if vehicle.kind == "ackermann":
            return SteeringCommand(speed_m_s, steer_rad, 0.0)
        rate_rad_s = self._control.steering_gain * error_rad * vehicle.speed_max_m_s / vehicle.wheelbase_m
        return SteeringCommand(speed_m_s, 0.0, _clamped(rate_rad_s, vehicle.turn_rate_max_rad_s))

    def _speed(self, aim: BearingToPoint, interval_s: float) -> float:
        limit_m_s = self._vehicle.speed_max_m_s
        if self._control.speed_mode == "constant":
            return min(self._control.constant_speed_m_s, limit_m_s)
        if self._control.speed_mode == "pi":
            self._pi_memory, speed_m_s = self._pi.step(self._pi_memory, aim.distance_m, interval_s)
            return max(0.0, speed_m_s) * max(0.0, cos(aim.error_rad))
        values = {"distance_m": aim.distance_m, "heading_error_rad": abs(aim.error_rad)}
        wanted_m_s = self._fuzzy.evaluate([values[name] for name in self._fuzzy.inputs])
        return max(0.0, min(wanted_m_s, limit_m_s))


class WaypointList:
    """Waypoints in order, and the number of those reached."""

    def __init__(self, waypoints_m: Sequence[Point], arrival_radius_m: float, *, loops: bool) -> None:
        self._waypoints_m = tuple(waypoints_m)
        self._radius_m = arrival_radius_m
        self._loops = loops
        self.reached = 0

    @property
    def current_m(self) -> Point | None:
        """The waypoint to go to; None when all are reached."""
        count = len(self._waypoints_m)
        if self.reached >= count and not self._loops:
            return None
        return self._waypoints_m[self.reached % count]

    def visit(self, pose: PlanarPose) -> Point | None:
        """The next waypoint, after counting those that are reached at a pose."""
        for _ in self._waypoints_m:
            goal_m = self.current_m
            if goal_m is None or aim_at(pose, goal_m).distance_m > self._radius_m:
                return goal_m
            self.reached += 1
        return self.current_m


def _clamped(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
