"""Frozen configuration models of robots among radio beacons and of recorded radio data.

Values live in ``configs/radio.toml`` and ``configs/recordings.toml``.
"""

from typing import Annotated, Literal

from pydantic import Field

from ccatp.config.models import (
    AlarmsConfig,
    DashboardConfig,
    Host,
    LinkConfig,
    Model,
    NonNegative,
    ObservatoryConfig,
    Pair,
    PidConfig,
    Port,
    Positive,
    ProcessesConfig,
    Seed,
)
from ccatp.config.robot_limits import TimeToLive, VehicleFramePeriod, WheelBase, WheelRadius

# Frames come ten times a second: what is older than two of them is stale.
SlowFreshness = Annotated[float, Field(gt=0.0, le=1.0)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
Length = Annotated[float, Field(ge=-1e3, le=1e3)]
Coordinates = Annotated[tuple[Length, ...], Field(min_length=2, max_length=3)]
Angle = Annotated[float, Field(ge=-6.2832, le=6.2832)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Share = Annotated[float, Field(ge=0.0, lt=1.0)]
Level = Annotated[float, Field(ge=-150.0, le=30.0)]  # dBm: from below any receiver's noise to a watt
Decibel = Annotated[float, Field(ge=0.0, le=60.0)]
Exponent = Annotated[float, Field(gt=0.5, le=8.0)]
Celsius = Annotated[float, Field(ge=-60.0, le=80.0)]
Many = Annotated[int, Field(ge=1, le=100_000)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
Membership = tuple[float, float, float, float]


class BeaconRobotConfig(LinkConfig):
    """The robot link, and the wheels as the link counts them."""

    sensors_timeout_s: SlowFreshness
    lag_limit_s: SlowFreshness
    wheel_radius_m: WheelRadius
    max_wheel_rad_s: Positive


class BeaconMissionConfig(Model):
    """What the robot is there for, and when that takes too long."""

    laps: Annotated[int, Field(ge=1, le=1000)]
    follow_s: Positive
    time_limit_s: Positive
    verdict_timeout_s: SlowFreshness
    settle_speed_m_s: Positive
    map_period_s: Positive


class BeaconDangerConfig(Model):
    """When the danger loop denies motion; distances from the vehicle's origin."""

    obstacle_m: Positive
    ahead_rad: Positive
    memory_s: Positive
    target_m: Positive
    target_window_s: Positive
    target_level_sigma_db: Positive
    radio_timeout_s: Positive
    position_sigma_m: Positive
    position_clear_m: Positive
    estimate_timeout_s: Positive
    hold_limit_s: Positive
    stale_after_s: SlowFreshness


class ListenerConfig(Model):
    """How the robot receives ultrasonic motes."""

    name: Name
    pulses_per_frame: Annotated[int, Field(ge=1, le=20)]
    mapping_rounds: Annotated[int, Field(ge=1, le=10_000)]
    gate_probability: Annotated[float, Field(gt=0.5, lt=1.0)]


class SimBeaconRobotConfig(Model):
    """The simulated robot."""

    host: Host
    port: Port
    ttl_s: TimeToLive


class RadioLossConfig(Model):
    """Radios send nothing."""

    type: Literal["radio_loss"]
    at_s: NonNegative
    for_s: Positive
    beacons: tuple[Name, ...]  # empty: all of them


class ObstacleIncidentConfig(Model):
    """An obstacle is added, and removed at the end."""

    type: Literal["obstacle"]
    at_s: NonNegative
    for_s: Positive
    x_m: Length
    y_m: Length
    radius_m: Positive


class TargetApproachConfig(Model):
    """The radio that moves approaches the robot in a straight line."""

    type: Literal["target_approach"]
    at_s: NonNegative
    for_s: Positive
    speed_m_s: Positive


IncidentConfig = Annotated[RadioLossConfig | ObstacleIncidentConfig | TargetApproachConfig, Field(discriminator="type")]


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
    """Where a mote receives another: reach against the angle off the axis."""

    is_omnidirectional: bool
    off_axis_rad: Annotated[tuple[Annotated[float, Field(ge=0.0, le=3.1416)], ...], Field(min_length=2)]
    reach_m: Annotated[tuple[NonNegative, ...], Field(min_length=2)]
    nearest_m: NonNegative


class PhaseOneConfig(Model):
    """Trilateration."""

    max_dop: Positive
    draws: Annotated[int, Field(ge=100, le=100_000)]


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
    anchors: dict[Name, Coordinates]
    networks: dict[Name, MotePlaceConfig]
    stand_m: Annotated[tuple[Coordinates, ...], Field(min_length=1)]
    motes: dict[Name, MotePlaceConfig]
    random: RandomMotesConfig
    air: AirConfig
    ranging: RangingConfig
    transducer: TransducerConfig
    phase1: PhaseOneConfig
    phase2: PhaseTwoConfig
    batch: BatchConfig
    sim: MoteSimConfig


class RadioRunConfig(Model):
    """One run: clock, seed, end."""

    seed: Seed
    step_s: VehicleFramePeriod  # one frame of the robot for each step
    steps: Count


class WorkspaceConfig(Model):
    """The room, its corner at the origin, and the loop of waypoints."""

    size_m: tuple[Positive, Positive]
    waypoints_m: Annotated[tuple[Pair, ...], Field(min_length=1)]
    loops: bool


class VehicleConfig(Model):
    """Geometry and limits of the vehicle, as its controller and its filter know them."""

    kind: Literal["ackermann", "differential"]
    wheelbase_m: Positive
    track_m: WheelBase
    speed_max_m_s: Positive
    steer_max_rad: Annotated[float, Field(gt=0.0, le=1.5)]
    turn_rate_max_rad_s: Positive
    radius_m: Positive


class StartConfig(Model):
    """Where the filter believes to begin, and how sure it is."""

    x_m: Length
    y_m: Length
    heading_rad: Angle
    position_sigma_m: Positive
    heading_sigma_rad: Positive


class OdometryConfig(Model):
    """Noise of the odometry as the filter models it."""

    speed_sigma_m_s: NonNegative
    steer_sigma_rad: NonNegative
    turn_rate_sigma_rad_s: NonNegative
    heading_drift_sigma_rad_s: NonNegative
    slip_sigma: NonNegative


class PathLossConfig(Model):
    """Log-distance model z = P_ref - 10 eta log10(r)."""

    reference_dbm: Level
    exponent: Exponent
    white_sigma_db: Positive
    shadowing_sigma_db: Decibel
    shadowing_length_m: Positive
    reference_dbm_of: dict[Name, Level]


class ScanConfig(Model):
    """The turning reflector."""

    readings: Annotated[int, Field(ge=4, le=720)]
    bearing_sigma_rad: Positive
    loss_tolerance: Share


class ObservationConfig(Model):
    """When radios are listened to."""

    every_steps: Count
    target_every_steps: Count


class EstimatorConfig(Model):
    """What the filter assumes and estimates besides poses and positions."""

    shadowing: Literal["none", "white", "map"]
    shadowing_grid_m: Positive
    placed_share: Annotated[float, Field(gt=0.0, le=1.0)]
    waiting_scans: Annotated[int, Field(ge=1, le=200)]
    radios_beyond_m: NonNegative
    gate_probability: Annotated[float, Field(gt=0.5, lt=1.0)]
    target_speed_sigma_m_s: Positive
    target_course_time_s: Positive


class FuzzyInputConfig(Model):
    """One input: trapezoids (left foot, left shoulder, right shoulder, right foot) by name."""

    terms: Annotated[dict[Name, Membership], Field(min_length=1)]


class FuzzyRuleConfig(Model):
    """If all named inputs are in their terms, the output is this one."""

    when: Annotated[dict[Name, Name], Field(min_length=1)]
    then: Name


class FuzzyConfig(Model):
    """A zero-order Sugeno controller."""

    inputs: Annotated[dict[Name, FuzzyInputConfig], Field(min_length=1)]
    outputs: Annotated[dict[Name, float], Field(min_length=1)]
    rules: Annotated[tuple[FuzzyRuleConfig, ...], Field(min_length=1)]


class RadioControlConfig(Model):
    """Steering and speed."""

    speed_mode: Literal["fuzzy", "pi", "constant"]
    steering_gain: Positive
    constant_speed_m_s: Positive
    arrival_radius_m: Positive
    pi: PidConfig
    fuzzy: FuzzyConfig


class FollowConfig(Model):
    """Keeping a distance from the target."""

    is_active: bool
    target: Name
    safe_distance_m: Positive
    band_m: Positive
    margin_sigmas: NonNegative
    foresight_s: NonNegative
    back_speed_m_s: Positive
    retreat_s: Positive
    lost_after_s: Positive


class AvoidanceConfig(Model):
    """Driving around what the distance sensors detect."""

    is_active: bool
    sensors_rad: tuple[Angle, ...]
    range_max_m: Positive
    influence_m: Positive
    stop_m: Positive
    margin_m: NonNegative
    memory_s: Positive
    back_speed_m_s: Positive
    back_time_s: Positive
    directions: Annotated[int, Field(ge=8, le=720)]


class SimBeaconConfig(Model):
    """A true beacon."""

    x_m: Length
    y_m: Length
    reference_dbm: Level


class SimRadioConfig(Model):
    """True propagation."""

    scan: Literal["drawn", "reflector"]
    exponent: Exponent
    white_sigma_db: Decibel
    bearing_sigma_rad: NonNegative
    shadowing_sigma_db: Decibel
    shadowing_length_m: Positive
    multipath_paths: Annotated[int, Field(ge=0, le=20)]
    multipath_level_db: Decibel
    beam_width_rad: Positive
    front_to_back_db: Decibel
    resolution_db: Decibel
    loss_probability: Fraction
    obstacle_loss_db: Decibel
    sensitivity_dbm: Level


class SimVehicleConfig(Model):
    """How the true vehicle differs from its odometry."""

    speed_sigma_m_s: NonNegative
    steer_sigma_rad: NonNegative
    turn_rate_sigma_rad_s: NonNegative
    slip: Share
    heading_drift_rad_s: Annotated[float, Field(ge=-1.0, le=1.0)]
    start_position_offset_m: NonNegative
    start_heading_offset_rad: NonNegative


class SimTargetConfig(Model):
    """The radio that moves."""

    motion: Literal["none", "random", "waypoints"]
    x_m: Length
    y_m: Length
    reference_dbm: Level
    speed_m_s: NonNegative
    turn_sigma_rad_sqrt_s: NonNegative
    waypoints_m: tuple[Pair, ...]


class SimObstacleConfig(Model):
    """A round obstacle."""

    x_m: Length
    y_m: Length
    radius_m: Positive


class RadioSimConfig(Model):
    """The true world behind ``--sim``."""

    beacons: dict[Name, SimBeaconConfig]
    radio: SimRadioConfig
    vehicle: SimVehicleConfig
    target: SimTargetConfig
    obstacles: tuple[SimObstacleConfig, ...]
    range_sigma_m: NonNegative
    robot: SimBeaconRobotConfig
    incidents: tuple[IncidentConfig, ...]


class RadioConfig(Model):
    """Everything about a robot among radio beacons."""

    system: Literal["zigbee", "follow", "cricket"]
    run: RadioRunConfig
    workspace: WorkspaceConfig
    vehicle: VehicleConfig
    start: StartConfig
    odometry: OdometryConfig
    path_loss: PathLossConfig
    scan: ScanConfig
    observation: ObservationConfig
    estimator: EstimatorConfig
    control: RadioControlConfig
    follow: FollowConfig
    avoidance: AvoidanceConfig
    listener: ListenerConfig
    mission: BeaconMissionConfig
    danger: BeaconDangerConfig
    robot: BeaconRobotConfig
    processes: ProcessesConfig
    observatory: ObservatoryConfig
    alarms: AlarmsConfig
    dashboard: DashboardConfig
    sim: RadioSimConfig
    cricket: CricketConfig


# -- recorded data ----------------------------------------------------------------------------------------------------


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
    camera_field_rad: Annotated[float, Field(ge=0.0, le=1.5)]  # half; 0: no camera
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
    distance_per_rad: NonNegative
    turn_scale: NonNegative
    turn_per_m: NonNegative
    turn_bias_rad_s: NonNegative
    odometry_delay_s: NonNegative
    range_scale: NonNegative
    range_offset_m: NonNegative
    bearing_offset_rad: NonNegative
    rssi_reference_db: NonNegative
    rssi_exponent: NonNegative
    beacon_offset_m: NonNegative
    beacon_reference_db: NonNegative
    beacon_height_m2: NonNegative
    antenna_ahead_m: NonNegative
    antenna_left_m: NonNegative
    pose_m: Positive
    heading_rad: Positive
    core: Annotated[float, Field(gt=0.0, le=1.0)]


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
    beacon_walk_m_sqrt_s: Positive
    jump_m: Positive
    jump_rad: Positive
    transports: bool
    wander_share: Annotated[float, Field(ge=0.0, lt=1.0)]
    wander_length_m: Positive
    rest_speed_m_s: NonNegative
    rest_turn_rad_s: NonNegative
    turn_bias_walk_rad_s_sqrt_s: NonNegative


class FixedLagConfig(Model):
    """The windows of the fixed-lag smoother."""

    lag_s: Positive
    poses: Annotated[int, Field(ge=1)]
    window_s: Positive
    map_s: Positive


class RecordingsRunConfig(Model):
    """What the studies of recorded runs are made of."""

    seed: Annotated[int, Field(ge=0)]
    data: str
    peer_limit_s: Positive


class RecordingsConfig(Model):
    """All formats."""

    run: RecordingsRunConfig
    plaza: RecordingConfig
    mrclam: RecordingConfig
    labyrinth: RecordingConfig
    csv: RecordingConfig
    filter: SlamFilterConfig
    fixed_lag: FixedLagConfig
