"""Settings of ``BeaconSlam`` for tests: those of CSV recordings with what a test changes."""

from typing import NamedTuple

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.config.models import RecordingConfig, SlamFilterConfig
from ccatp.beacons.estimation.motion import DifferentialDrive

_NOTHING: dict[str, object] = {
    **{f"odometry__{axis}": 0.0 for axis in ("distance_per_sqrt_rad", "turn_per_sqrt_s", "lateral_per_sqrt_m")},
    **{
        f"priors__{name}": 0.0
        for name in ("distance_scale", "distance_per_rad", "turn_scale", "turn_bias_rad_s", "odometry_delay_s",
                     "range_scale", "range_offset_m", "rssi_reference_db", "beacon_reference_db", "rssi_exponent",
                     "beacon_height_m2", "antenna_ahead_m", "antenna_left_m")
    },
    "filter__turn_bias_walk_rad_s_sqrt_s": 0.0,
    "filter__rest_speed_m_s": 0.0,
    "filter__rest_turn_rad_s": 0.0,
    "radio__range_sigma_per_m": 0.0,
    "radio__correlation_s": 0.0,
}  # fmt: skip


class Settings(NamedTuple):
    """What ``BeaconSlam`` takes first."""

    cfg: RecordingConfig
    how: SlamFilterConfig

    def but(self, **changes: object) -> "Settings":
        """With other values, as in ``radio__range_sigma_m``; ``filter__`` are those of the filter."""
        cfg, how = self
        for key, value in changes.items():
            part, _, name = key.partition("__")
            if part == "filter":
                how = how.model_copy(update={name: value})
            else:
                cfg = cfg.model_copy(update={part: getattr(cfg, part).model_copy(update={name: value})})
        return Settings(cfg, how)

    @property
    def drive(self) -> DifferentialDrive:
        """The vehicle."""
        return DifferentialDrive(self.cfg.odometry, self.cfg.priors, self.how)


def settings(**changes: object) -> Settings:
    """Nothing calibrated, nothing that wanders, no rest, but for the changes."""
    loaded = load_recordings_config()
    return Settings(loaded.csv, loaded.filter).but(**_NOTHING).but(**changes)


def trust(
    gate_sigmas: float, knee_sigmas: float, learn_memory: float, learn_prior: float, doubt_pose_after: int,
    doubt_beacon_after: int,
) -> dict[str, object]:  # fmt: skip
    """How far readings are believed."""
    return {
        "radio__gate_sigmas": gate_sigmas, "filter__knee_sigmas": knee_sigmas, "filter__learn_memory": learn_memory,
        "filter__learn_prior": learn_prior, "filter__doubt_pose_after": doubt_pose_after,
        "filter__doubt_beacon_after": doubt_beacon_after, "filter__jump_m": 0.3, "filter__jump_rad": 0.3,
        "filter__transports": True,
    }  # fmt: skip


def odometry(*noise: float) -> dict[str, object]:
    """Random walks by metre and radian: of the distance, of the turn; of the turn by second; sideways by metre."""
    names = (
        "distance_per_sqrt_m", "distance_per_sqrt_rad", "turn_per_sqrt_m", "turn_per_sqrt_rad", "turn_per_sqrt_s",
        "lateral_per_sqrt_m",
    )  # fmt: skip
    return {f"odometry__{name}": value for name, value in zip(names, noise, strict=True)}
