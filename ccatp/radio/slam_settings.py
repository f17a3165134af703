"""Pure. What ``BeaconSlam`` is told of its vehicle and of its radios; nothing about a place."""

from dataclasses import dataclass

from ccatp.radio.motion import MotionModel


@dataclass(frozen=True, slots=True)
class Wander:
    """An error of a beacon's readings that stays while the vehicle does: multipath, shadowing, a tilted camera.

    A Gauss-Markov process of each beacon by itself: correlation exp(-way / length_m - time / time_s).

    Attributes:
        share: of the variance of the noise; the rest is new with every reading.
        length_m: way of the vehicle after which it is forgotten.
        time_s: time after which it is forgotten.
    """

    share: float
    length_m: float
    time_s: float


@dataclass(frozen=True, slots=True)
class RangeModel:
    """A ranging radio: z = (1 + scale) r + offset + wander + noise.

    Attributes:
        sigma_m: standard deviation of the noise; where it starts if the noise is learned.
        sigma_per_m: what a metre of range adds to it, in squares: var = sigma_m^2 + (sigma_per_m r)^2.
        scale_sigma: prior of the relative error that all ranges share; 0: not estimated.
        offset_sigma_m: prior of the offset that all ranges share; 0: not estimated.
        wander: of each beacon; None: there is none.
    """

    sigma_m: float
    sigma_per_m: float
    scale_sigma: float
    offset_sigma_m: float
    wander: Wander | None = None


@dataclass(frozen=True, slots=True)
class BearingModel:
    """A direction finder.

    Attributes:
        sigma_rad: standard deviation of the noise; where it starts if the noise is learned.
    """

    sigma_rad: float


@dataclass(frozen=True, slots=True)
class RssiModel:
    """Signal strength by the log-distance model z = P_ref - 10 eta log10(r / 1 m) + noise (Hevrdejs and Knoll, eq. 4).

    Attributes:
        sigma_db: standard deviation of the noise; where it starts if the noise is learned.
        reference_dbm: P_ref at 1 m.
        reference_sigma_db: its prior, of each beacon by itself; 0: not estimated.
        exponent: eta.
        exponent_sigma: its prior, of each beacon by itself; 0: not estimated.
        wander: of each beacon; None: there is none.
    """

    sigma_db: float
    reference_dbm: float
    reference_sigma_db: float
    exponent: float
    exponent_sigma: float
    wander: Wander | None = None


@dataclass(frozen=True, slots=True)
class Trust:
    """How far readings are believed.

    Attributes:
        gate_sigmas: innovations further off than that are refused.
        knee_sigmas: innovations beyond weigh no more than those at the knee (Huber).
        learn_memory: readings over which noise levels are learned; 0: the noise is as it is given.
        learn_prior: readings that the given noise counts for.
        doubt_pose_after: refusals in a row, of any beacons, after which the pose is doubted.
        doubt_beacon_after: refusals in a row of one beacon, others being believed, after which it is placed anew.
        jump_m: what the pose may have jumped by when it is doubted, standard deviation of x and of y.
        jump_rad: the same of the heading.
        transports: whether the covariance follows corrections of the map, so that its heading is never learned from
            linearising anew (``Transport``).
    """

    gate_sigmas: float
    knee_sigmas: float
    learn_memory: float
    learn_prior: float
    doubt_pose_after: int
    doubt_beacon_after: int
    jump_m: float
    jump_rad: float
    transports: bool


@dataclass(frozen=True, slots=True)
class SlamSettings:
    """What a run of ``BeaconSlam`` needs to know.

    Attributes:
        motion: the vehicle.
        trust: of the readings.
        range: of range and range-bearing readings; None where there are none.
        bearing: of readings with a bearing; None where there are none.
        rssi: of RSSI readings; None where there are none.
        delay_sigma_s: prior of the time after which the vehicle has done what its odometry tells, by the stamps of the
            readings: commands that take a while to be followed, stamps that come late; 0: not estimated.
    """

    motion: MotionModel
    trust: Trust
    range: RangeModel | None = None
    bearing: BearingModel | None = None
    rssi: RssiModel | None = None
    delay_sigma_s: float = 0.0
