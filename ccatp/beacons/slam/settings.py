"""From the configuration of a recording's format to the settings of the estimators.

From the configuration to the filter, and from wheels and scans to its odometry and readings.
"""

from collections.abc import Iterable
from typing import Protocol

import numpy as np
from scipy.special import chdtri

from ccatp.beacons.slam.batch_odometry import BatchPriors, BatchSettings, RadioNoise
from ccatp.beacons.slam.beacon_map import BearingModel, GaussMarkovBias, RangeModel, RobustLoss, RssiModel, SlamSettings
from ccatp.beacons.slam.motion import (
    DifferentialDrive,
    DifferentialNoise,
    Increment,
    Odometry,
    SlippingVehicle,
    Steering,
    VehiclePose,
    WheelNoise,
)
from ccatp.beacons.slam.path_loss import PathLoss
from ccatp.beacons.slam.recording import RssiReading
from ccatp.beacons.slam.reflector import ReflectorScan, ScanResult
from ccatp.beacons.slam.signal_landmarks import MovingRadio, ShadowingMap
from ccatp.beacons.slam.signal_slam import SignalSettings, SignalSlam
from ccatp.config.beacon_models import RadioConfig
from ccatp.config.recording_models import RecordingConfig, SlamFilterConfig


def batch_settings(cfg: RecordingConfig) -> BatchSettings:
    """Of the smoother."""
    radio = {name: value for name, value in cfg.radio.model_dump().items() if name != "gate_sigmas"}
    return BatchSettings(
        odometry=DifferentialNoise(**cfg.odometry.model_dump()),
        radio=RadioNoise(**radio),
        priors=BatchPriors(**cfg.priors.model_dump()),
    )


def slam_settings(cfg: RecordingConfig, how: SlamFilterConfig) -> SlamSettings:
    """Of the filter: a format's instruments, and how readings are taken."""
    priors, radio = cfg.priors, cfg.radio
    noise = DifferentialNoise(
        **cfg.odometry.model_dump(),
        turn_bias_sigma_rad_s=priors.turn_bias_rad_s,
        turn_bias_walk_rad_s_sqrt_s=how.turn_bias_walk_rad_s_sqrt_s,
        turn_scale_sigma=priors.turn_scale,
        distance_scale_sigma=priors.distance_scale,
        rest_speed_m_s=how.rest_speed_m_s,
        rest_turn_rad_s=how.rest_turn_rad_s,
    )
    wander = (
        GaussMarkovBias(how.wander_share, how.wander_length_m, radio.correlation_s)
        if radio.correlation_s > 0.0
        else None
    )
    return SlamSettings(
        motion=DifferentialDrive(noise),
        trust=_trust(how, radio.gate_sigmas),
        range=RangeModel(
            sigma_m=radio.range_sigma_m,
            sigma_per_m=radio.range_sigma_per_m,
            scale_sigma=priors.range_scale,
            offset_sigma_m=priors.range_offset_m,
            wander=wander,
        ),
        bearing=BearingModel(sigma_rad=radio.bearing_sigma_rad),
        rssi=RssiModel(
            sigma_db=radio.rssi_sigma_db,
            reference_dbm=radio.rssi_reference_dbm,
            reference_sigma_db=(priors.rssi_reference_db**2 + priors.beacon_reference_db**2) ** 0.5,
            exponent=radio.rssi_exponent,
            exponent_sigma=priors.rssi_exponent,
            wander=wander,
        ),
        delay_sigma_s=priors.delay_s,
    )


def _trust(how: SlamFilterConfig, gate_sigmas: float) -> RobustLoss:
    return RobustLoss(
        gate_sigmas=gate_sigmas,
        knee_sigmas=how.knee_sigmas,
        learn_memory=how.learn_memory,
        learn_prior=how.learn_prior,
        doubt_pose_after=how.doubt_pose_after,
        doubt_beacon_after=how.doubt_beacon_after,
        jump_m=how.jump_m,
        jump_rad=how.jump_rad,
        transports=how.transports,
    )


class WheelAngles(Protocol):
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


class SignalMeasurements(Protocol):
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
    return SignalSlam(signal_settings(cfg), VehiclePose(start.x_m, start.y_m, start.heading_rad), np.diag(variances))


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


def odometry_of(cfg: RadioConfig, time_s: float, wheels: WheelAngles) -> Odometry:
    """What the wheels tell, as the motion model takes it."""
    interval_s = wheels.interval_s
    if cfg.vehicle.kind == "ackermann":
        return Steering(time_s, interval_s, wheels.speed_m_s, wheels.steer_rad)
    return Increment(time_s, interval_s, wheels.speed_m_s * interval_s, wheels.turn_rate_rad_s * interval_s)


def readings_of(time_s: float, results: Iterable[SignalMeasurements | ScanResult]) -> list[RssiReading]:
    """Scan results as readings of the filter."""
    return [RssiReading(time_s, seen.beacon, seen.rssi_dbm, seen.bearing_rad) for seen in results]
