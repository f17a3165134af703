"""Pure. What ``BeaconSlam`` is told of its vehicle and of its radios; nothing about a place."""

from dataclasses import dataclass

from ccatp.radio.motion import MotionModel


@dataclass(frozen=True, slots=True)
class RangeModel:
    """A ranging radio: z = (1 + scale) r + offset + noise.

    Attributes:
        sigma_m: standard deviation of the noise.
        sigma_per_m: what a metre of range adds to it, in squares: var = sigma_m^2 + (sigma_per_m r)^2.
        scale_sigma: prior of the relative error that all ranges share; 0: not estimated.
        offset_sigma_m: prior of the offset that all ranges share; 0: not estimated.
    """

    sigma_m: float
    sigma_per_m: float
    scale_sigma: float
    offset_sigma_m: float


@dataclass(frozen=True, slots=True)
class BearingModel:
    """A direction finder.

    Attributes:
        sigma_rad: standard deviation of the noise.
    """

    sigma_rad: float


@dataclass(frozen=True, slots=True)
class RssiModel:
    """Signal strength by the log-distance model z = P_ref - 10 eta log10(r / 1 m) + noise (Hevrdejs and Knoll, eq. 4).

    Attributes:
        sigma_db: standard deviation of the noise.
        reference_dbm: P_ref at 1 m.
        reference_sigma_db: its prior, of each beacon by itself; 0: not estimated.
        exponent: eta.
        exponent_sigma: its prior, of each beacon by itself; 0: not estimated.
    """

    sigma_db: float
    reference_dbm: float
    reference_sigma_db: float
    exponent: float
    exponent_sigma: float


@dataclass(frozen=True, slots=True)
class SlamSettings:
    """What a run of ``BeaconSlam`` needs to know.

    Attributes:
        motion: the vehicle.
        gate_sigmas: readings further off than that many standard deviations are refused.
        range: of range and range-bearing readings; None where there are none.
        bearing: of readings with a bearing; None where there are none.
        rssi: of RSSI readings; None where there are none.
    """

    motion: MotionModel
    gate_sigmas: float
    range: RangeModel | None = None
    bearing: BearingModel | None = None
    rssi: RssiModel | None = None
