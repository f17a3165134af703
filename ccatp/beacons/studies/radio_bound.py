"""The posterior Cramér-Rao bound of a vehicle among radios: the least error of any estimator of their positions.

For Gaussian noise, the bound is the covariance of an extended Kalman filter that is linearised at the truth (Taylor
1979; Tichavsky, Muravchik and Nehorai 1998). States: pose, positions of the static radios, position and velocity of the
moving one, and the static shadowing at each place of reception. Reflected rays are not modelled: in a world with
reflections the bound assumes that they cause no error.
"""

from collections.abc import Sequence
from math import hypot, log, pi, sqrt, tau
from typing import NamedTuple

import numpy as np

from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.estimation.motion import POSE, Odometry, SlippingVehicle
from ccatp.beacons.estimation.signal_slam import MovingRadio
from ccatp.beacons.filters.ekf_slam import BlockId, EkfSlam, columns_of
from ccatp.core import FloatArray

_ANYWHERE = 10.0  # times the size of the room: standard deviation of an unknown position
_MOST_PLACES = 100  # limit with shadowing, because the state has a value for each place and radio
_LEVEL_PER_LOG = 10.0 / log(10.0)
_TARGET, _FIELD = "target", "shadowing"


class TrueStep(NamedTuple):
    """A true step: x_m, y_m, heading_rad at its end, its odometry, and the position of the moving radio."""

    pose: tuple[float, float, float]
    odometry: Odometry
    target_m: tuple[float, float] | None


class RadioBound(NamedTuple):
    """Lower bounds of root mean square errors, m."""

    beacons_m: float  # of the static radios at the end
    target_m: float | None  # of the moving one, over the last steps; None without one


def radio_bound(
    cfg: RadioConfig, steps: Sequence[TrueStep], beacons_m: Sequence[tuple[float, float]], settled_share: float
) -> RadioBound | None:
    """The bound along a driven path.

    ``settled_share``: first part of the run, for which the error of the moving radio is not counted. None if shadowing
    would need too many states.
    """
    every, target_every = cfg.observation.every_steps, cfg.observation.target_every_steps
    places_m = np.array([step.pose[:2] for step in steps[every - 1 :: every]])
    has_field = cfg.sim.radio.shadowing_sigma_db > 0.0
    if has_field and len(places_m) > _MOST_PLACES:
        return None
    vehicle, noise, R = SlippingVehicle(cfg.vehicle, cfg.odometry), cfg.estimator, _noise(cfg)
    engine = _begun(cfg, vehicle, steps[0].target_m is not None, len(beacons_m), places_m if has_field else None)
    moving = MovingRadio(_TARGET, noise.target_speed_sigma_m_s, noise.target_course_time_s, 0.0, 1.0, (1.0, 1.0))
    before, target_m2 = np.zeros(vehicle.size), []
    before[:POSE] = cfg.start.x_m, cfg.start.y_m, cfg.start.heading_rad
    for number, step in enumerate(steps, start=1):
        moved = vehicle.step(before, step.odometry)
        before[:POSE] = step.pose
        engine.predict(before, moved.F, moved.Q)
        if number % every == 0:
            for index, place_m in enumerate(beacons_m):
                field = (index, number // every - 1) if has_field else None
                _learn(engine, cfg, R, step.pose, place_m, index, field)
        if step.target_m is not None:
            moving.predict(engine, cfg.run.step_s, 0.0)
            if number % target_every == 0:
                _learn(engine, cfg, R, step.pose, step.target_m, _TARGET, None)
            target_m2.append(_variance(engine, _TARGET))
    settled = target_m2[round(settled_share * len(target_m2)) :]
    beacon_m2 = float(np.mean([_variance(engine, index) for index in range(len(beacons_m))]))
    return RadioBound(sqrt(beacon_m2), sqrt(float(np.mean(settled))) if settled else None)


def _begun(
    cfg: RadioConfig, vehicle: SlippingVehicle, has_target: bool, beacons: int, places_m: FloatArray | None
) -> EkfSlam:
    start, speed_m_s = cfg.start, cfg.estimator.target_speed_sigma_m_s
    known = (start.position_sigma_m, start.position_sigma_m, start.heading_sigma_rad, *vehicle.prior_sigmas)
    engine = EkfSlam(np.zeros(vehicle.size), np.diag(np.square(known)))
    anywhere_m = _ANYWHERE * hypot(*cfg.workspace.size_m)

    def join(block: BlockId, covariance: FloatArray) -> None:
        size = len(covariance)
        engine.augment(block, np.zeros(size), columns_of(), np.zeros((size, 0)), np.eye(size), covariance)

    for index in range(beacons):
        join(index, np.eye(2) * anywhere_m**2)
    if has_target:
        join(_TARGET, np.diag(np.square((anywhere_m, anywhere_m, speed_m_s, speed_m_s))))
    if places_m is not None:
        radio = cfg.sim.radio
        apart = np.linalg.norm(places_m[:, None] - places_m, axis=2) / radio.shadowing_length_m
        for index in range(beacons):
            join((_FIELD, index), radio.shadowing_sigma_db**2 * np.exp(-apart))
    return engine


def _learn(
    engine: EkfSlam, cfg: RadioConfig, R: FloatArray, pose: tuple[float, float, float], place_m: tuple[float, float],
    block: BlockId, field: tuple[int, int] | None,
) -> None:  # fmt: skip
    """Update with level and bearing of a radio. ``field``: its shadowing state, by radio and place."""
    dx, dy = place_m[0] - pose[0], place_m[1] - pose[1]
    r2 = dx * dx + dy * dy
    slope = _LEVEL_PER_LOG * cfg.path_loss.exponent / r2
    at = engine.block(block).start
    columns = [0, 1, 2, at, at + 1]
    H = np.array(
        ((slope * dx, slope * dy, 0.0, -slope * dx, -slope * dy), (dy / r2, -dx / r2, -1.0, -dy / r2, dx / r2))
    )
    if field is not None:
        columns.append(engine.block((_FIELD, field[0])).start + field[1])
        H = np.column_stack((H, (1.0, 0.0)))
    engine.update(np.array(columns, dtype=np.intp), H, np.zeros(2), R)


def _variance(engine: EkfSlam, block: BlockId) -> float:
    at = engine.block(block).start
    return float(engine.covariance[at, at] + engine.covariance[at + 1, at + 1])


def _noise(cfg: RadioConfig) -> FloatArray:
    """Variances of level and bearing if all information of a scan is used, shape (2,)."""
    radio, step_rad = cfg.sim.radio, tau / cfg.scan.readings
    level_db2 = radio.white_sigma_db**2
    if radio.scan == "drawn":
        return np.array((level_db2, radio.bearing_sigma_rad**2 + step_rad**2 / 12.0))
    off = (np.arange(cfg.scan.readings) * step_rad + pi) % tau - pi
    slopes = 24.0 * off / radio.beam_width_rad**2  # dB/rad, of 12 (off / width)^2
    slopes[12.0 * (off / radio.beam_width_rad) ** 2 > radio.front_to_back_db] = 0.0
    return np.array((level_db2 / cfg.scan.readings, level_db2 / float(slopes @ slopes)))
