"""Pure. True signal strengths: path loss, static shadowing, obstacles, reflected rays, a reflector's pattern, loss."""

from collections.abc import Sequence
from math import hypot, log10, tau
from typing import NamedTuple

import numpy as np

from ccatp.angles import bearing, wrap_pi
from ccatp.config.radio_models import SimObstacleConfig, SimRadioConfig
from ccatp.sim.radio.frame import Packet, Sighting, TruePose
from ccatp.sim.radio.obstacles import count_between
from ccatp.sim.radio.shadowing import ShadowingField

Point = tuple[float, float]
_NEAREST_M = 0.05  # two antennas are never nearer: the log-distance model has no value at zero
_BEYOND_WALLS_M = 1.0  # things that reflect stand in the room and as far as this round it


class Ray(NamedTuple):
    """One way of a signal to the receiver.

    Attributes:
        direction_rad: where it comes from, left of the heading.
        level_dbm: as an antenna without direction would receive it.
    """

    direction_rad: float
    level_dbm: float


class _Reflection(NamedTuple):
    place_m: Point
    loss_db: float


class TrueRadio:
    """The way from one sender to the receiver on the vehicle.

    The direct ray has P_ref - 10 eta log10(r), the shadowing of both places, and the loss of each obstacle in the
    line of sight. Each reflected ray comes by a place of its own, drawn once, with the path loss of the whole way and a
    loss of its own.

    Args:
        name: of the sender.
        reference_dbm: P_ref of the sender, at 1 m.
        cfg: propagation.
        size_m: the room.
        obstacles: in it.
        readings: of one turn of the reflector.
        places: draws what stays: shadowing and reflections.
        noise: draws what does not.
    """

    def __init__(
        self, name: str, reference_dbm: float, cfg: SimRadioConfig, size_m: Point,
        obstacles: Sequence[SimObstacleConfig], readings: int, places: np.random.Generator, noise: np.random.Generator,
    ) -> None:  # fmt: skip
        self._name = name
        self._reference_dbm = reference_dbm
        self._cfg = cfg
        self._obstacles = obstacles
        self._step_rad = tau / readings
        self._readings = readings
        self._noise = noise
        self._shadowing = ShadowingField(cfg.shadowing_sigma_db, cfg.shadowing_length_m, places)
        self._reflections = [_drawn_reflection(size_m, cfg, places) for _ in range(cfg.multipath_paths)]

    def rays(self, pose: TruePose, sender_m: Point) -> list[Ray]:
        """All ways of the signal from a sender to the vehicle, the direct one first."""
        here_m = (pose.x_m, pose.y_m)
        blocked_db = self._cfg.obstacle_loss_db * count_between(here_m, sender_m, self._obstacles)
        gain_db = self._shadowing.at(here_m, sender_m) - blocked_db
        found = [Ray(_seen_from(pose, sender_m), self._path_dbm(_distance_m(here_m, sender_m)) + gain_db)]
        for place_m, loss_db in self._reflections:
            way_m = _distance_m(sender_m, place_m) + _distance_m(place_m, here_m)
            found.append(Ray(_seen_from(pose, place_m), self._path_dbm(way_m) - loss_db))
        return found

    def sight(self, pose: TruePose, sender_m: Point) -> Sighting | None:
        """The result of a scan, drawn: direction of the strongest ray with noise, to the nearest step; None if lost."""
        strongest = max(self.rays(pose, sender_m), key=lambda ray: ray.level_dbm)
        level_dbm = self._received(strongest.level_dbm)
        noisy_rad = strongest.direction_rad + self._cfg.bearing_sigma_rad * self._noise.standard_normal()
        if level_dbm is None:
            return None
        return Sighting(self._name, level_dbm, wrap_pi(round(noisy_rad / self._step_rad) * self._step_rad))

    def scan(self, pose: TruePose, sender_m: Point) -> list[Packet]:
        """The packets of one turn of the reflector, in the order of its steps; lost ones are missing."""
        rays = self.rays(pose, sender_m)
        packets = []
        for index in range(self._readings):
            direction_rad = wrap_pi(index * self._step_rad)
            milliwatt = sum(10.0 ** (0.1 * (ray.level_dbm + self._gain_db(ray, direction_rad))) for ray in rays)
            level_dbm = self._received(10.0 * log10(milliwatt))
            if level_dbm is not None:
                packets.append(Packet(self._name, direction_rad, level_dbm))
        return packets

    def _path_dbm(self, distance_m: float) -> float:
        return self._reference_dbm - 10.0 * self._cfg.exponent * log10(distance_m)

    def _gain_db(self, ray: Ray, direction_rad: float) -> float:
        """Of the reflector: 12 dB per squared beam width off the axis, down to the back lobe."""
        off = wrap_pi(ray.direction_rad - direction_rad) / self._cfg.beam_width_rad
        return -min(12.0 * off * off, self._cfg.front_to_back_db)

    def _received(self, level_dbm: float) -> float | None:
        """What the receiver tells of a level; None if the packet is lost."""
        noisy_dbm = level_dbm + self._cfg.white_sigma_db * self._noise.standard_normal()
        is_lost = self._noise.random() < self._cfg.loss_probability or noisy_dbm < self._cfg.sensitivity_dbm
        if is_lost:
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
