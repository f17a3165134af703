"""From the configuration of a robot among radios to its filter."""

import numpy as np
from scipy.special import chdtri

from ccatp.beacons.slam.motion import SlippingVehicle, VehiclePose, WheelNoise
from ccatp.beacons.slam.path_loss import PathLoss
from ccatp.beacons.slam.reflector import ReflectorScan
from ccatp.beacons.slam.signal_landmarks import MovingRadio, ShadowingMap
from ccatp.beacons.slam.signal_slam import SignalSettings, SignalSlam
from ccatp.config.beacon_models import RadioConfig


def new_slam(cfg: RadioConfig) -> SignalSlam:
    """The filter of a configuration, at its believed start."""
    start = cfg.start
    variances = np.square((start.position_sigma_m, start.position_sigma_m, start.heading_sigma_rad))
    return SignalSlam(signal_settings(cfg), VehiclePose(start.x_m, start.y_m, start.heading_rad), np.diag(variances))


def signal_settings(cfg: RadioConfig) -> SignalSettings:
    """Vehicle and radios of the filter of levels."""
    loss, estimator, room_m = cfg.path_loss, cfg.estimator, cfg.workspace.size_m
    sigma_db = loss.shadowing_sigma_db if estimator.shadowing != "none" else 0.0
    shadowing = None
    if estimator.shadowing == "map" and sigma_db > 0.0:
        shadowing = ShadowingMap(room_m, estimator.shadowing_grid_m, sigma_db, loss.shadowing_length_m)
    speed_sigma_m_s, course_time_s = estimator.target_speed_sigma_m_s, estimator.target_course_time_s
    quantile = estimator.gate_probability
    return SignalSettings(
        motion=vehicle_of(cfg),
        path_loss={
            name: PathLoss(reference_dbm, loss.exponent, loss.white_sigma_db)
            for name, reference_dbm in loss.reference_dbm_of.items()
        },
        default=PathLoss(loss.reference_dbm, loss.exponent, loss.white_sigma_db),
        bearing_sigma_rad=scan_of(cfg).sigma_rad,
        shadowing_sigma_db=sigma_db,
        shadowing=shadowing,
        # In a room without a radio that moves, its name is never received.
        moving=MovingRadio(
            cfg.follow.target, speed_sigma_m_s, course_time_s, sigma_db, loss.shadowing_length_m, room_m
        ),
        placed_share=estimator.placed_share,
        waiting_scans=estimator.waiting_scans,
        gates=(float(chdtri(1, 1.0 - quantile)), float(chdtri(2, 1.0 - quantile))),
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
