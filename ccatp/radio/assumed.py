"""Pure. From the configuration of a recording's format to the settings of the estimators."""

from ccatp.config.recording_models import RecordingConfig, SlamFilterConfig
from ccatp.radio.batch.settings import BatchPriors, BatchSettings, RadioNoise
from ccatp.radio.motion import DifferentialDrive, DifferentialNoise
from ccatp.radio.slam_settings import BearingModel, RangeModel, RssiModel, SlamSettings, Trust, Wander


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
    wander = Wander(how.wander_share, how.wander_length_m, radio.correlation_s) if radio.correlation_s > 0.0 else None
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


def _trust(how: SlamFilterConfig, gate_sigmas: float) -> Trust:
    return Trust(
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
