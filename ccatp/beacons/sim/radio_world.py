"""The true world of a robot among radio beacons: each step takes a command and returns readings.

The vehicle has Ackermann or differential drive, wheels that slip, a heading that drifts, and noisy odometry.
"""

from math import cos, sin, tau
from typing import TypeVar

import numpy as np

from ccatp.beacons.config.models import (
    ObstacleIncidentConfig,
    RadioConfig,
    RadioLossConfig,
    SimObstacleConfig,
    SimVehicleConfig,
    TargetApproachConfig,
    VehicleConfig,
)
from ccatp.beacons.links.messages import BeaconFrame, RadioSample, RadioScan
from ccatp.beacons.sim.radio import (
    MovingTarget,
    RadioDraws,
    SimDriveCommand,
    TruePose,
    TrueRadio,
    WheelReading,
    WorldFrame,
    clearance_m,
    seen_m,
)


class TrueVehicle:
    """A vehicle that follows its commands without lag, within its limits.

    Ackermann, 2017 eq. 3 (x, y of the front axle): x += T v cos(theta + gamma), y += T v sin(theta + gamma),
    theta += T v sin(gamma) / l. Differential drive: the chord of a circular arc. The travel of the body is (1 - slip)
    times that of the wheels, and the heading has an additional drift; the odometry measures neither and has white
    noise.
    """

    def __init__(
        self, geometry: VehicleConfig, truth: SimVehicleConfig, pose: TruePose, rng: np.random.Generator
    ) -> None:
        self._geometry, self._truth, self._rng, self.pose = geometry, truth, rng, pose

    def step(self, command: SimDriveCommand, interval_s: float) -> WheelReading:
        """Drive for an interval (s); return its odometry."""
        limits, truth = self._geometry, self._truth
        speed_m_s = _clamped(command.speed_m_s, limits.speed_max_m_s)
        travel_m = speed_m_s * (1.0 - truth.slip) * interval_s
        drift_rad = truth.heading_drift_rad_s * interval_s
        noise = self._rng.standard_normal(2).tolist()
        read_m_s = speed_m_s + truth.speed_sigma_m_s * noise[0]
        if limits.kind == "ackermann":
            steer_rad = _clamped(command.steer_rad, limits.steer_max_rad)
            self._roll(travel_m, steer_rad, drift_rad)
            return WheelReading(interval_s, read_m_s, steer_rad + truth.steer_sigma_rad * noise[1], 0.0)
        rate_rad_s = _clamped(command.turn_rate_rad_s, limits.turn_rate_max_rad_s)
        self._arc(travel_m, rate_rad_s * (1.0 - truth.slip) * interval_s + drift_rad)
        return WheelReading(interval_s, read_m_s, 0.0, rate_rad_s + truth.turn_rate_sigma_rad_s * noise[1])

    def _roll(self, travel_m: float, steer_rad: float, drift_rad: float) -> None:
        x_m, y_m, heading_rad = self.pose
        course_rad = heading_rad + steer_rad
        turn_rad = travel_m * sin(steer_rad) / self._geometry.wheelbase_m + drift_rad
        self.pose = TruePose(x_m + travel_m * cos(course_rad), y_m + travel_m * sin(course_rad), heading_rad + turn_rad)

    def _arc(self, travel_m: float, turn_rad: float) -> None:
        x_m, y_m, heading_rad = self.pose
        half_rad = 0.5 * turn_rad
        chord_m = travel_m * (sin(half_rad) / half_rad if half_rad else 1.0)
        course_rad = heading_rad + half_rad
        self.pose = TruePose(x_m + chord_m * cos(course_rad), y_m + chord_m * sin(course_rad), heading_rad + turn_rad)


def _clamped(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


Point = tuple[float, float]
_Incident = TypeVar("_Incident", RadioLossConfig, ObstacleIncidentConfig, TargetApproachConfig)
# Streams of random numbers of a seed: the draws of one do not depend on the others.
_START, _WHEELS, _TARGET, _DISTANCES, _PLACES, _NOISE = range(6)


class RadioWorld:
    """Vehicle, beacons, moving target, obstacles, and planned incidents: lost radios, obstacles, target approach."""

    def __init__(self, cfg: RadioConfig, seed: int | None = None) -> None:
        seed = cfg.run.seed if seed is None else seed
        self._cfg = cfg
        self.obstacles = list(cfg.sim.obstacles)
        x, y, turn = _stream(seed, _START).standard_normal(3).tolist()
        start, offset_m = cfg.start, cfg.sim.vehicle.start_position_offset_m
        heading_rad = start.heading_rad + cfg.sim.vehicle.start_heading_offset_rad * turn
        pose = TruePose(start.x_m + offset_m * x, start.y_m + offset_m * y, heading_rad)
        self._vehicle = TrueVehicle(cfg.vehicle, cfg.sim.vehicle, pose, _stream(seed, _WHEELS))
        self._target = MovingTarget(cfg.sim.target, cfg.workspace.size_m, cfg.sim.obstacles, _stream(seed, _TARGET))
        self._distances = _stream(seed, _DISTANCES)
        references = {name: beacon.reference_dbm for name, beacon in cfg.sim.beacons.items()}
        if cfg.sim.target.motion != "none":
            references[cfg.follow.target] = cfg.sim.target.reference_dbm
        self._radios = {
            name: TrueRadio(
                reference_dbm, cfg.sim.radio, cfg.workspace.size_m, self.obstacles, cfg.scan.readings,
                RadioDraws(_stream(seed, _PLACES, index), _stream(seed, _NOISE, index)),
            )
            for index, (name, reference_dbm) in enumerate(references.items())
        }  # fmt: skip
        self.time_s = 0.0

    @property
    def pose(self) -> TruePose:
        """True pose of the vehicle."""
        return self._vehicle.pose

    @property
    def target_m(self) -> Point | None:
        """Position of the moving radio; None without one."""
        return None if self._cfg.sim.target.motion == "none" else self._target.position_m

    @property
    def beacons_m(self) -> dict[str, Point]:
        """Positions of the static radios, by name."""
        return {name: (beacon.x_m, beacon.y_m) for name, beacon in self._cfg.sim.beacons.items()}

    @property
    def clearance_m(self) -> float:
        """Distance between the vehicle's body and the nearest obstacle, m; negative in a collision."""
        return clearance_m(self.pose, self.obstacles) - self._cfg.vehicle.radius_m

    def step(self, command: SimDriveCommand, interval_s: float, *, static: bool, target: bool) -> WorldFrame:
        """Drive for an interval, then take the readings; ``static``, ``target``: scan these radios."""
        obstacles = self._lasting(ObstacleIncidentConfig)
        self.obstacles[:] = self._cfg.sim.obstacles
        self.obstacles += [SimObstacleConfig(x_m=one.x_m, y_m=one.y_m, radius_m=one.radius_m) for one in obstacles]
        wheels = self._vehicle.step(command, interval_s)
        approaches = self._lasting(TargetApproachConfig)
        if approaches:
            self._target.approach(self.pose[:2], approaches[0].speed_m_s * interval_s)
        else:
            self._target.step(interval_s)
        self.time_s = round(self.time_s + interval_s, 9)
        radio, scan = self._receive(static=static, target=target)
        return WorldFrame(self.time_s, wheels, BeaconFrame(radio=radio, scan=scan, distances=self._distances_m()))

    def _lasting(self, kind: type[_Incident]) -> list[_Incident]:
        """The active incidents of a kind."""
        incidents = [one for one in self._cfg.sim.incidents if isinstance(one, kind)]
        return [one for one in incidents if one.at_s <= self.time_s < one.at_s + one.for_s]

    def level(self, name: str, direction_rad: float) -> float | None:
        """Level of a radio with the reflector in a direction, dBm; None for a lost packet."""
        place_m = self.target_m if name == self._cfg.follow.target else self.beacons_m[name]
        losses = self._lasting(RadioLossConfig)
        if place_m is None or any(not one.beacons or name in one.beacons for one in losses):
            return None
        return self._radios[name].level(self.pose, place_m, direction_rad)

    def _receive(self, *, static: bool, target: bool) -> tuple[list[RadioSample], RadioScan | None]:
        """Drawn results of scans, or the levels of one turn of the reflector."""
        places = dict(self.beacons_m) if static else {}
        if target and self.target_m is not None:
            places[self._cfg.follow.target] = self.target_m
        losses = self._lasting(RadioLossConfig)
        for name in tuple(places):
            if any(not one.beacons or name in one.beacons for one in losses):
                del places[name]
        if self._cfg.sim.radio.scan == "drawn":
            found = {name: self._radios[name].sight(self.pose, place_m) for name, place_m in places.items()}
            return [RadioSample(self.time_s, name, *result) for name, result in found.items() if result], None
        levels = {name: self._radios[name].scan(self.pose, place_m) for name, place_m in places.items()}
        levels = {name: row for name, row in levels.items() if any(level_dbm is not None for level_dbm in row)}
        return [], RadioScan(self.time_s, tau / self._cfg.scan.readings, levels) if levels else None

    def _distances_m(self) -> list[float]:
        cfg = self._cfg
        distances = []
        for direction_rad in cfg.avoidance.sensors_rad:
            true_m = seen_m(self.pose, direction_rad, self.obstacles)
            read_m = true_m + cfg.sim.range_sigma_m * self._distances.standard_normal()
            distances.append(max(0.0, min(read_m, cfg.avoidance.range_max_m)))
        return distances


def _stream(seed: int, *name: int) -> np.random.Generator:
    return np.random.default_rng([seed, *name])
