"""Frozen models of what is assumed of recorded radio data. Values live in ``configs/recordings.toml``."""

from typing import Annotated

from pydantic import Field

from ccatp.config.models import Model, NonNegative, Positive

Level = Annotated[float, Field(ge=-150.0, le=30.0)]  # dBm: from below any receiver's noise to a watt
Exponent = Annotated[float, Field(gt=0.5, le=8.0)]


class OdometryNoiseConfig(Model):
    """Random walks of the odometry: standard deviations after a metre, a radian, a second."""

    distance_per_sqrt_m: NonNegative
    distance_per_sqrt_rad: NonNegative
    turn_per_sqrt_m: NonNegative
    turn_per_sqrt_rad: NonNegative
    turn_per_sqrt_s: NonNegative
    lateral_per_sqrt_m: NonNegative


class RadioNoiseConfig(Model):
    """Noise of the readings."""

    range_sigma_m: Positive
    range_sigma_per_m: NonNegative
    bearing_sigma_rad: Positive
    rssi_sigma_db: Positive
    rssi_reference_dbm: Level
    rssi_exponent: Exponent
    freedom: Annotated[float, Field(ge=1.0)]  # of Student's t
    correlation_s: NonNegative
    gate_sigmas: Positive


class PriorsConfig(Model):
    """Standard deviations, before any reading, of what is calibrated on the way; 0: not estimated."""

    distance_scale: NonNegative
    turn_scale: NonNegative
    turn_per_m: NonNegative
    turn_bias_rad_s: NonNegative
    delay_s: NonNegative
    range_scale: NonNegative
    range_offset_m: NonNegative
    bearing_offset_rad: NonNegative
    rssi_reference_db: NonNegative
    rssi_exponent: NonNegative
    beacon_offset_m: NonNegative
    beacon_reference_db: NonNegative
    pose_m: Positive
    heading_rad: Positive


class RecordingConfig(Model):
    """One format."""

    odometry: OdometryNoiseConfig
    radio: RadioNoiseConfig
    priors: PriorsConfig


class SlamFilterConfig(Model):
    """How the filter takes readings, of whatever format."""

    knee_sigmas: Positive
    learn_memory: NonNegative
    learn_prior: Positive
    doubt_pose_after: Annotated[int, Field(ge=1)]
    doubt_beacon_after: Annotated[int, Field(ge=1)]
    jump_m: Positive
    jump_rad: Positive
    transports: bool
    wander_share: Annotated[float, Field(ge=0.0, lt=1.0)]
    wander_length_m: Positive
    rest_speed_m_s: NonNegative
    rest_turn_rad_s: NonNegative
    turn_bias_walk_rad_s_sqrt_s: NonNegative


class RecordingsConfig(Model):
    """All formats."""

    plaza: RecordingConfig
    mrclam: RecordingConfig
    labyrinth: RecordingConfig
    csv: RecordingConfig
    filter: SlamFilterConfig
