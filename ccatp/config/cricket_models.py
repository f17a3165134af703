"""Pure. Frozen configuration models of ultrasonic motes that map themselves. Values live in ``configs/radio.toml``."""

from typing import Annotated, Literal

from pydantic import Field

from ccatp.config.models import Model, NonNegative, Positive

MoteName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
Coordinates = Annotated[tuple[Annotated[float, Field(ge=-1e3, le=1e3)], ...], Field(min_length=2, max_length=3)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Celsius = Annotated[float, Field(ge=-60.0, le=80.0)]
Off = Annotated[float, Field(ge=0.0, le=3.1416)]
Draws = Annotated[int, Field(ge=0, le=100_000)]
Many = Annotated[int, Field(ge=1, le=100_000)]


class MotePlaceConfig(Model):
    """Where a mote or a stand is, and the direction that it faces."""

    place_m: Coordinates
    facing: Coordinates


class RandomMotesConfig(Model):
    """Motes that are drawn."""

    count: Annotated[int, Field(ge=3, le=5000)]
    size_m: Coordinates
    reach_m: Positive


class AirConfig(Model):
    """What the motes know of the speed of sound."""

    sound_speed_m_s: Annotated[float, Field(ge=200.0, le=500.0)]
    temperature_c: Celsius


class RangingConfig(Model):
    """How good a range is, as the estimators take it."""

    sigma_m: Annotated[float, Field(ge=1e-6, le=1e3)]
    thermometer_sigma_c: NonNegative
    repeats: Many
    combine: Literal["mean", "median"]


class TransducerConfig(Model):
    """Where a mote hears another: reach against the angle off the axis."""

    is_omnidirectional: bool
    off_axis_rad: Annotated[tuple[Off, ...], Field(min_length=2)]
    reach_m: Annotated[tuple[NonNegative, ...], Field(min_length=2)]
    nearest_m: NonNegative


class PhaseOneConfig(Model):
    """Trilateration."""

    max_dop: Positive
    draws: Draws  # 0, or many


class PhaseTwoConfig(Model):
    """The filter over distances between motes."""

    pairs: Literal["zigzag", "adjacent", "all"]
    frame: Literal["surveyed", "free"]
    prior: Literal["trilateration", "printed"]
    printed_variance_m2: Positive
    pools: bool
    linearisations: Annotated[int, Field(ge=1, le=50)]
    gate_probability: Annotated[float, Field(gt=0.5, lt=1.0)]
    target_rms_m: Positive
    max_updates: Many


class BatchConfig(Model):
    """Least squares over all ranges."""

    uses_shapes: bool
    uses_phase2: bool
    estimates_offset: bool
    estimates_scale: bool
    robust_scale: Positive
    max_iterations: Many


class MoteSimConfig(Model):
    """The true air and the true faults of ranging."""

    temperature_c: Celsius
    sigma_m: NonNegative
    thermometer_sigma_c: NonNegative
    tick_s: NonNegative
    latency_s: NonNegative
    loss_probability: Fraction
    multipath_probability: Fraction
    multipath_excess_m: Positive


class CricketConfig(Model):
    """Everything about motes that map themselves."""

    dimension: Literal[2, 3]
    layout: Literal["networks", "motes", "random"]
    anchors: dict[MoteName, Coordinates]
    networks: dict[MoteName, MotePlaceConfig]
    stand_m: Annotated[tuple[Coordinates, ...], Field(min_length=1)]
    motes: dict[MoteName, MotePlaceConfig]
    random: RandomMotesConfig
    air: AirConfig
    ranging: RangingConfig
    transducer: TransducerConfig
    phase1: PhaseOneConfig
    phase2: PhaseTwoConfig
    batch: BatchConfig
    sim: MoteSimConfig
