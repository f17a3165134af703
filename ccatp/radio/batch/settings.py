"""Pure. What the batch smoother needs to know of a vehicle and its radios; nothing about a place."""

from dataclasses import dataclass

from ccatp.radio.motion import DifferentialNoise


@dataclass(frozen=True, slots=True)
class RadioNoise:
    """Noise of the readings.

    Attributes:
        range_sigma_m: standard deviation of a range.
        range_sigma_per_m: what a metre of range adds to it, in squares: var = sigma^2 + (sigma_per_m r)^2.
        bearing_sigma_rad: standard deviation of a bearing.
        rssi_sigma_db: standard deviation of a signal strength.
        rssi_reference_dbm: signal strength at 1 m, P_ref.
        rssi_exponent: eta of the log-distance model z = P_ref - 10 eta log10(r / 1 m).
        freedom: degrees of freedom of Student's t, the law of the noise: few for outliers, many for Gaussian noise.
        correlation_s: readings of a beacon within it share their error: together they count as one.
    """

    range_sigma_m: float
    range_sigma_per_m: float
    bearing_sigma_rad: float
    rssi_sigma_db: float
    rssi_reference_dbm: float
    rssi_exponent: float
    freedom: float
    correlation_s: float


@dataclass(frozen=True, slots=True)
class BatchPriors:
    """Standard deviations, before any reading, of what is calibrated; 0: taken as zero, not estimated.

    Attributes:
        distance_scale: relative error of distances.
        turn_scale: relative error of turns.
        turn_per_m: turning of a vehicle that believes to go straight, rad/m.
        turn_bias_rad_s: constant error of the turn rate.
        delay_s: by how much the vehicle does later what its odometry says.
        range_scale: relative error that all ranges share.
        range_offset_m: error that all ranges share.
        bearing_offset_rad: error that all bearings share.
        rssi_reference_db: error of P_ref that all beacons share.
        rssi_exponent: error of eta, which all beacons share.
        beacon_offset_m: error of a beacon's ranges beside the shared one.
        beacon_reference_db: error of a beacon's P_ref beside the shared one.
        pose_m: of the first position.
        heading_rad: of the first heading.
    """

    distance_scale: float
    turn_scale: float
    turn_per_m: float
    turn_bias_rad_s: float
    delay_s: float
    range_scale: float
    range_offset_m: float
    bearing_offset_rad: float
    rssi_reference_db: float
    rssi_exponent: float
    beacon_offset_m: float
    beacon_reference_db: float
    pose_m: float
    heading_rad: float


@dataclass(frozen=True, slots=True)
class BatchSettings:
    """All of it.

    Attributes:
        odometry: random walks of the odometry (its priors are not used, ``priors`` holds them).
        radio: noise of the readings, to begin with.
        priors: of what is calibrated.
    """

    odometry: DifferentialNoise
    radio: RadioNoise
    priors: BatchPriors
