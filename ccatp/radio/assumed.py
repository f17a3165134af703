"""Pure. From the configuration of a recording's format to the settings of the estimators."""

from ccatp.config.recording_models import RecordingConfig
from ccatp.radio.batch.settings import BatchPriors, BatchSettings, RadioNoise
from ccatp.radio.motion import DifferentialDrive, DifferentialNoise
from ccatp.radio.slam_settings import BearingModel, RangeModel, RssiModel, SlamSettings


def batch_settings(cfg: RecordingConfig) -> BatchSettings:
    """Of the smoother."""
    radio = {name: value for name, value in cfg.radio.model_dump().items() if name != "gate_sigmas"}
    return BatchSettings(
        odometry=DifferentialNoise(**cfg.odometry.model_dump()),
        radio=RadioNoise(**radio),
        priors=BatchPriors(**cfg.priors.model_dump()),
    )


def slam_settings(cfg: RecordingConfig) -> SlamSettings:
    """Of the filter."""
    priors, radio = cfg.priors, cfg.radio
    noise = DifferentialNoise(
        **cfg.odometry.model_dump(),
        turn_bias_sigma_rad_s=priors.turn_bias_rad_s,
        turn_scale_sigma=priors.turn_scale,
        distance_scale_sigma=priors.distance_scale,
    )
    return SlamSettings(
        motion=DifferentialDrive(noise),
        gate_sigmas=radio.gate_sigmas,
        range=RangeModel(
            sigma_m=radio.range_sigma_m,
            sigma_per_m=radio.range_sigma_per_m,
            scale_sigma=priors.range_scale,
            offset_sigma_m=priors.range_offset_m,
        ),
        bearing=BearingModel(sigma_rad=radio.bearing_sigma_rad),
        rssi=RssiModel(
            sigma_db=radio.rssi_sigma_db,
            reference_dbm=radio.rssi_reference_dbm,
            reference_sigma_db=(priors.rssi_reference_db**2 + priors.beacon_reference_db**2) ** 0.5,
            exponent=radio.rssi_exponent,
            exponent_sigma=priors.rssi_exponent,
        ),
    )
