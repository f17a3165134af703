"""Pure. From the configuration to the filter, and from wheels and scans to its odometry and readings."""

from collections.abc import Iterable
from typing import Protocol

import numpy as np
from scipy.special import chdtri

from ccatp.config.radio_models import RadioConfig
from ccatp.radio.motion import Increment, Odometry, Pose, Steering
from ccatp.radio.moving_radio import MovingRadio
from ccatp.radio.path_loss import PathLoss
from ccatp.radio.readings import RssiReading
from ccatp.radio.reflector import ReflectorScan, ScanResult
from ccatp.radio.shadowing_map import ShadowingMap
from ccatp.radio.signal_slam import SignalSettings, SignalSlam
from ccatp.radio.slipping_vehicle import SlippingVehicle, WheelNoise


class Wheels(Protocol):
    """What the wheels tell of an interval."""

    @property
    def interval_s(self) -> float:
        """Its length."""

    @property
    def speed_m_s(self) -> float:
        """Mean speed."""

    @property
    def steer_rad(self) -> float:
        """Steering angle to the left; of a steered vehicle."""

    @property
    def turn_rate_rad_s(self) -> float:
        """Turn rate to the left; of a differential drive."""


class Seen(Protocol):
    """The result of a scan as a radio tells it."""

    @property
    def beacon(self) -> str:
        """Node identifier."""

    @property
    def rssi_dbm(self) -> float:
        """Level."""

    @property
    def bearing_rad(self) -> float | None:
        """Left of the heading; None where it is not known."""


def new_slam(cfg: RadioConfig) -> SignalSlam:
    """The filter of a configuration, at its believed start."""
    start = cfg.start
    variances = np.square((start.position_sigma_m, start.position_sigma_m, start.heading_sigma_rad))
    return SignalSlam(signal_settings(cfg), Pose(start.x_m, start.y_m, start.heading_rad), np.diag(variances))


def signal_settings(cfg: RadioConfig) -> SignalSettings:
    """What the filter is told of vehicle and radios."""
    loss = cfg.path_loss
    sigma_db = loss.shadowing_sigma_db if cfg.estimator.shadowing != "none" else 0.0
    quantile = cfg.estimator.gate_probability
    return SignalSettings(
        motion=vehicle_of(cfg),
        path_loss={
            name: PathLoss(reference_dbm, loss.exponent, loss.white_sigma_db)
            for name, reference_dbm in loss.reference_dbm_of.items()
        },
        default=PathLoss(loss.reference_dbm, loss.exponent, loss.white_sigma_db),
        bearing_sigma_rad=scan_of(cfg).sigma_rad,
        shadowing_sigma_db=sigma_db,
        shadowing=_map(cfg, sigma_db) if cfg.estimator.shadowing == "map" and sigma_db > 0.0 else None,
        moving=_moving(cfg, sigma_db),
        placed_share=cfg.estimator.placed_share,
        waiting_scans=cfg.estimator.waiting_scans,
        gates=(float(chdtri(1, 1.0 - quantile)), float(chdtri(2, 1.0 - quantile))),
    )


def _map(cfg: RadioConfig, sigma_db: float) -> ShadowingMap:
    spacing_m, length_m = cfg.estimator.shadowing_grid_m, cfg.path_loss.shadowing_length_m
    return ShadowingMap(cfg.workspace.size_m, spacing_m, sigma_db, length_m)


def _moving(cfg: RadioConfig, sigma_db: float) -> MovingRadio:
    """The radio that moves; in a room without one the name is never heard."""
    estimator = cfg.estimator
    return MovingRadio(
        cfg.follow.target,
        estimator.target_speed_sigma_m_s,
        estimator.target_course_time_s,
        sigma_db,
        cfg.path_loss.shadowing_length_m,
        cfg.workspace.size_m,
    )


def vehicle_of(cfg: RadioConfig) -> SlippingVehicle:
    """The motion model of a configuration."""
    odometry, vehicle = cfg.odometry, cfg.vehicle
    turn_sigma = odometry.steer_sigma_rad if vehicle.kind == "ackermann" else odometry.turn_rate_sigma_rad_s
    noise = WheelNoise(odometry.speed_sigma_m_s, turn_sigma, odometry.heading_drift_sigma_rad_s, odometry.slip_sigma)
    return SlippingVehicle(vehicle.kind, vehicle.wheelbase_m, noise)


def scan_of(cfg: RadioConfig) -> ReflectorScan:
    """How the scans of a configuration are read."""
    scan = cfg.scan
    return ReflectorScan(scan.readings, scan.bearing_sigma_rad, scan.loss_tolerance)


def odometry_of(cfg: RadioConfig, time_s: float, wheels: Wheels) -> Odometry:
    """What the wheels tell, as the motion model takes it."""
    interval_s = wheels.interval_s
    if cfg.vehicle.kind == "ackermann":
        return Steering(time_s, interval_s, wheels.speed_m_s, wheels.steer_rad)
    return Increment(time_s, interval_s, wheels.speed_m_s * interval_s, wheels.turn_rate_rad_s * interval_s)


def readings_of(time_s: float, results: Iterable[Seen | ScanResult]) -> list[RssiReading]:
    """Scan results as readings of the filter."""
    return [RssiReading(time_s, seen.beacon, seen.rssi_dbm, seen.bearing_rad) for seen in results]
