"""Parts of the true world of a robot among beacons: commands, readings, obstacles, radio signals, moving target."""

from collections.abc import Iterable, Sequence
from math import atan2, cos, hypot, inf, log10, pi, sin, sqrt, tau
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccatp.beacons.config.models import SimObstacleConfig, SimRadioConfig, SimTargetConfig
from ccatp.beacons.links.messages import BeaconFrame
from ccatp.kinematics import bearing, wrap_pi


class SimDriveCommand(NamedTuple):
    """Set points until the next step; steering angle (Ackermann) or turn rate (differential drive), left positive."""

    speed_m_s: float
    steer_rad: float
    turn_rate_rad_s: float


class TruePose(NamedTuple):
    """Pose in the room: x, y, and the heading from the x axis, counter-clockwise, not wrapped."""

    x_m: float
    y_m: float
    heading_rad: float


class WheelReading(NamedTuple):
    """Odometry of one step: mean speed, and steering angle or turn rate."""

    interval_s: float
    speed_m_s: float
    steer_rad: float
    turn_rate_rad_s: float


class WorldFrame(NamedTuple):
    """All readings of one step; ``extras`` in the form of the link, received at the end of the step."""

    time_s: float
    wheels: WheelReading
    extras: BeaconFrame


Point = tuple[float, float]


def count_between(a_m: Point, b_m: Point, obstacles: Iterable[SimObstacleConfig]) -> int:
    """Number of obstacles that intersect the segment between two points."""
    return sum(_distance_to_segment((o.x_m, o.y_m), a_m, b_m) < o.radius_m for o in obstacles)


def seen_m(pose: TruePose, direction_rad: float, obstacles: Iterable[SimObstacleConfig]) -> float:
    """Distance from the vehicle to the first obstacle in a direction left of the heading, m; infinite without one."""
    return min((_along_ray(pose, pose.heading_rad + direction_rad, o) for o in obstacles), default=inf)


def clearance_m(pose: TruePose, obstacles: Iterable[SimObstacleConfig]) -> float:
    """Distance from the vehicle's origin to the nearest obstacle's surface, m; infinite without one."""
    return min((hypot(o.x_m - pose.x_m, o.y_m - pose.y_m) - o.radius_m for o in obstacles), default=inf)


def _along_ray(pose: TruePose, course_rad: float, obstacle: SimObstacleConfig) -> float:
    dx_m, dy_m = obstacle.x_m - pose.x_m, obstacle.y_m - pose.y_m
    along_m = dx_m * cos(course_rad) + dy_m * sin(course_rad)
    beside_m = dy_m * cos(course_rad) - dx_m * sin(course_rad)
    if abs(beside_m) >= obstacle.radius_m:
        return inf
    half_chord_m = sqrt(obstacle.radius_m**2 - beside_m**2)
    if along_m + half_chord_m < 0.0:
        return inf
    return max(along_m - half_chord_m, 0.0)


def _distance_to_segment(point: Point, a: Point, b: Point) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    square = dx * dx + dy * dy
    share = 0.0 if square == 0.0 else ((point[0] - a[0]) * dx + (point[1] - a[1]) * dy) / square
    share = max(0.0, min(1.0, share))
    return hypot(point[0] - a[0] - share * dx, point[1] - a[1] - share * dy)


_WAVES = 600  # the fourth moment is that of a Gaussian to within 1 / _WAVES


class ShadowingField:
    """A Gaussian random field over the places of receiver and sender, drawn once.

    Its covariance is sigma^2 exp(-d_receiver / L) exp(-d_sender / L), the exponential law of Gudmundson (1991) at both
    ends. It is a sum of plane waves whose wave vectors are drawn from the spectrum of exp(-d / L) in the plane,
    proportional to (1 + (k L)^2)^(-3/2): the share of wave numbers below k is 1 - (1 + (k L)^2)^(-1/2).
    """

    def __init__(self, sigma_db: float, length_m: float, rng: np.random.Generator) -> None:
        self._amplitude_db = sigma_db * np.sqrt(2.0 / _WAVES)
        self._phases = rng.uniform(0.0, tau, _WAVES)
        self._waves = np.hstack([_wave_vectors(length_m, rng), _wave_vectors(length_m, rng)])

    def at(self, receiver_m: tuple[float, float], sender_m: tuple[float, float]) -> float:
        """Gain over the path loss between two places, dB."""
        if not self._amplitude_db:
            return 0.0
        return float(self._amplitude_db * np.cos(self._waves @ (*receiver_m, *sender_m) + self._phases).sum())


def _wave_vectors(length_m: float, rng: np.random.Generator) -> NDArray[np.float64]:
    share = rng.uniform(0.0, 1.0, _WAVES)
    number = np.sqrt((1.0 - share) ** -2.0 - 1.0) / length_m
    angle = rng.uniform(0.0, tau, _WAVES)
    return np.column_stack([number * np.cos(angle), number * np.sin(angle)])


_NEAREST_M = 0.05  # two antennas are never nearer: the log-distance model has no value at zero
_BEYOND_WALLS_M = 1.0  # reflectors are in the room or at most this far outside


class Ray(NamedTuple):
    """One path of a signal to the receiver; ``level_dbm``: level at an omnidirectional antenna."""

    direction_rad: float
    level_dbm: float


class _Reflection(NamedTuple):
    place_m: Point
    loss_db: float


class RadioDraws(NamedTuple):
    """Generators of the random numbers of a sender: what belongs to places, and what differs in each reading."""

    places: np.random.Generator
    noise: np.random.Generator


class TrueRadio:
    """The radio channel from one sender to the receiver on the vehicle.

    The level of the direct ray is P_ref - 10 eta log10(r), plus the shadowing of both places, minus the loss of each
    obstacle in the line of sight. Each reflected ray has its own reflector, drawn once, the path loss of its whole path
    and its own reflection loss. ``reference_dbm`` is P_ref of the sender, at 1 m.
    """

    def __init__(
        self, reference_dbm: float, cfg: SimRadioConfig, size_m: Point, obstacles: Sequence[SimObstacleConfig],
        readings: int, draws: RadioDraws,
    ) -> None:  # fmt: skip
        self._reference_dbm = reference_dbm
        self._cfg = cfg
        self._obstacles = obstacles
        self._readings = readings
        self._step_rad = tau / readings
        self._noise = draws.noise
        self._shadowing = ShadowingField(cfg.shadowing_sigma_db, cfg.shadowing_length_m, draws.places)
        self._reflections = [_drawn_reflection(size_m, cfg, draws.places) for _ in range(cfg.multipath_paths)]

    def rays(self, pose: TruePose, sender_m: Point) -> list[Ray]:
        """All rays from a sender to the vehicle, the direct one first."""
        here_m = (pose.x_m, pose.y_m)
        blocked_db = self._cfg.obstacle_loss_db * count_between(here_m, sender_m, self._obstacles)
        gain_db = self._shadowing.at(here_m, sender_m) - blocked_db
        found = [Ray(_seen_from(pose, sender_m), self._path_dbm(_distance_m(here_m, sender_m)) + gain_db)]
        for place_m, loss_db in self._reflections:
            way_m = _distance_m(sender_m, place_m) + _distance_m(place_m, here_m)
            found.append(Ray(_seen_from(pose, place_m), self._path_dbm(way_m) - loss_db))
        return found

    def sight(self, pose: TruePose, sender_m: Point) -> tuple[float, float] | None:
        """The drawn result of a scan; None if the packet is lost.

        Level, dBm, and direction of the strongest ray, with noise and rounded to the nearest step, rad left of the
        heading.
        """
        strongest = max(self.rays(pose, sender_m), key=lambda ray: ray.level_dbm)
        level_dbm = self._received(strongest.level_dbm)
        noisy_rad = strongest.direction_rad + self._cfg.bearing_sigma_rad * self._noise.standard_normal()
        if level_dbm is None:
            return None
        return level_dbm, wrap_pi(round(noisy_rad / self._step_rad) * self._step_rad)

    def scan(self, pose: TruePose, sender_m: Point) -> list[float | None]:
        """Levels of one turn of the reflector, dBm, in the order of its steps; None for lost packets."""
        return [self.level(pose, sender_m, wrap_pi(index * self._step_rad)) for index in range(self._readings)]

    def level(self, pose: TruePose, sender_m: Point, direction_rad: float) -> float | None:
        """One reading with the reflector in a direction, rad left of the heading, dBm; None for a lost packet."""
        rays = self.rays(pose, sender_m)
        milliwatt = sum(10.0 ** (0.1 * (ray.level_dbm + self._gain_db(ray, direction_rad))) for ray in rays)
        return self._received(10.0 * log10(milliwatt))

    def _path_dbm(self, distance_m: float) -> float:
        return self._reference_dbm - 10.0 * self._cfg.exponent * log10(distance_m)

    def _gain_db(self, ray: Ray, direction_rad: float) -> float:
        """Gain of the reflector, dB: -12 (angle / beam width)^2, at least that of the back lobe."""
        off = wrap_pi(ray.direction_rad - direction_rad) / self._cfg.beam_width_rad
        return -min(12.0 * off * off, self._cfg.front_to_back_db)

    def _received(self, level_dbm: float) -> float | None:
        """Reading of a level by the receiver; None if the packet is lost."""
        noisy_dbm = level_dbm + self._cfg.white_sigma_db * self._noise.standard_normal()
        if self._noise.random() < self._cfg.loss_probability or noisy_dbm < self._cfg.sensitivity_dbm:
            return None
        resolution_db = self._cfg.resolution_db
        return round(noisy_dbm / resolution_db) * resolution_db if resolution_db else noisy_dbm


def _drawn_reflection(size_m: Point, cfg: SimRadioConfig, places: np.random.Generator) -> _Reflection:
    x_m, y_m = (float(places.uniform(-_BEYOND_WALLS_M, size + _BEYOND_WALLS_M)) for size in size_m)
    return _Reflection((x_m, y_m), cfg.multipath_level_db * float(places.uniform(0.5, 1.5)))


def _distance_m(a_m: Point, b_m: Point) -> float:
    return max(hypot(a_m[0] - b_m[0], a_m[1] - b_m[1]), _NEAREST_M)


def _seen_from(pose: TruePose, place_m: Point) -> float:
    return wrap_pi(bearing(place_m[0] - pose.x_m, place_m[1] - pose.y_m) - pose.heading_rad)


class MovingTarget:
    """A point that moves.

    ``random``: its course is a random walk, mirrored at walls and obstacles. ``waypoints``: straight from one to the
    next, from the last to the first, also through obstacles.
    """

    def __init__(
        self, cfg: SimTargetConfig, size_m: Point, obstacles: Sequence[SimObstacleConfig], rng: np.random.Generator
    ) -> None:
        self._cfg, self._obstacles, self._size_m, self._rng = cfg, obstacles, size_m, rng
        self._course_rad = rng.uniform(-pi, pi)
        self._next = 0
        self.position_m: Point = (cfg.x_m, cfg.y_m)

    def step(self, interval_s: float) -> None:
        """Move on for an interval, s."""
        if self._cfg.motion == "random":
            self._wander(interval_s)
        elif self._cfg.motion == "waypoints" and self._cfg.waypoints_m:
            self._walk(self._cfg.speed_m_s * interval_s)

    def approach(self, place_m: Point, travel_m: float) -> None:
        """Move straight towards a place, by at most ``travel_m``."""
        dx_m, dy_m = place_m[0] - self.position_m[0], place_m[1] - self.position_m[1]
        share = min(1.0, travel_m / max(hypot(dx_m, dy_m), 1e-9))
        self.position_m = (self.position_m[0] + share * dx_m, self.position_m[1] + share * dy_m)

    def _wander(self, interval_s: float) -> None:
        self._course_rad += self._cfg.turn_sigma_rad_sqrt_s * sqrt(interval_s) * self._rng.standard_normal()
        travel_m = self._cfg.speed_m_s * interval_s
        x_m = self.position_m[0] + travel_m * cos(self._course_rad)
        y_m = self.position_m[1] + travel_m * sin(self._course_rad)
        if not 0.0 <= x_m <= self._size_m[0]:
            x_m, self._course_rad = _folded(x_m, self._size_m[0]), pi - self._course_rad
        if not 0.0 <= y_m <= self._size_m[1]:
            y_m, self._course_rad = _folded(y_m, self._size_m[1]), -self._course_rad
        self.position_m = self._turned_back(x_m, y_m)

    def _turned_back(self, x_m: float, y_m: float) -> Point:
        """The position (x, y), or if it is in an obstacle, the nearest one on its surface, with the course mirrored."""
        for obstacle in self._obstacles:
            dx_m, dy_m = x_m - obstacle.x_m, y_m - obstacle.y_m
            distance_m = hypot(dx_m, dy_m)
            if 0.0 < distance_m < obstacle.radius_m:
                normal_rad = atan2(dy_m, dx_m)
                self._course_rad = 2.0 * normal_rad + pi - self._course_rad
                x_m = obstacle.x_m + obstacle.radius_m * cos(normal_rad)
                y_m = obstacle.y_m + obstacle.radius_m * sin(normal_rad)
        return x_m, y_m

    def _walk(self, travel_m: float) -> None:
        for _ in range(len(self._cfg.waypoints_m) + 1):
            goal = self._cfg.waypoints_m[self._next]
            dx_m, dy_m = goal[0] - self.position_m[0], goal[1] - self.position_m[1]
            left_m = hypot(dx_m, dy_m)
            if left_m > travel_m:
                course_rad = atan2(dy_m, dx_m)
                self.position_m = (
                    self.position_m[0] + travel_m * cos(course_rad),
                    self.position_m[1] + travel_m * sin(course_rad),
                )
                return
            self.position_m, travel_m = goal, travel_m - left_m
            self._next = (self._next + 1) % len(self._cfg.waypoints_m)


def _folded(value_m: float, size_m: float) -> float:
    return max(0.0, min(size_m, -value_m if value_m < 0.0 else 2.0 * size_m - value_m))
