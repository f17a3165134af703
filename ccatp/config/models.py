"""Frozen configuration models. Values live in ``configs/``; nothing here has a default with a unit."""

from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from ccatp.config.robot_limits import FrameRate, TimeToLive, WheelBase, WheelRadius

# Larger than all quantities of this project, in the units of their keys.
Positive = Annotated[float, Field(gt=0.0, le=1e6)]
NonNegative = Annotated[float, Field(ge=0.0, le=1e6)]
# No decision is made on data older than 150 ms.
Freshness = Annotated[float, Field(gt=0.0, le=0.15)]
Port = Annotated[int, Field(ge=0, le=65535)]
PeerPort = Annotated[int, Field(ge=1, le=65535)]  # of a server; 0 is not allowed
Seed = Annotated[int, Field(ge=0, lt=2**63)]  # an integer of TOML
Pair = tuple[float, float]
TEXT, HOST = r"^[^\x00-\x1f\x7f-\x9f]*$", r"^([^\s./\x00-\x1f\x7f-\x9f]{1,63}(\.|$))+$"
URL = r"^(https?://[^\s\x00-\x20\x7f-\x9f]+)?$"
# Descriptions of the patterns, for messages.
PATTERNS = {
    URL: "must be empty or an address that begins with http:// or https://",
    TEXT: "must not contain control characters",
    HOST: "must be the name or the address of a host",
}
Text = Annotated[str, Field(max_length=4096, pattern=TEXT)]
Host = Annotated[str, Field(max_length=253, pattern=HOST)]


class Model(BaseModel):
    """Base of every section: frozen, unknown keys refused, only finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ProcessesConfig(Model):
    """The processes of a run: folder of their sockets, and when one counts as hanging."""

    runtime_dir: Text  # empty = chosen from the environment
    realtime_priority: Annotated[int, Field(ge=0, le=99)]  # 0 = ordinary scheduling
    hang_timeout_s: Positive
    start_timeout_s: Positive
    restart_limit: Annotated[int, Field(ge=0)]
    restart_window_s: Positive


FOUR_STATE = ("kf",)
"""Values of ``run.filter`` for linear models, which use the thesis's four states; all others use the full state."""


class RunConfig(ProcessesConfig):
    """What to survey and how."""

    mirror: Text
    world: Text
    seed: Seed
    filter: Literal["kf", "ekf", "ukf"]
    panels: Annotated[int, Field(ge=0)]  # 0 = the whole mirror
    order: Literal["thesis", "optimised", "calibration"]
    budget_s: Positive


class SurveyMetadata(Model):
    """Who measured what with which instruments; without effect. Empty = not given."""

    telescope: Text
    operator: Text
    robot_serial_number: Text
    laser_serial_number: Text
    retroreflector_serial_number: Text
    comment: Text


class LinkConfig(Model):
    """The robot link: where the robot is, and when its data are too old."""

    host: Host
    port: PeerPort
    key_file: Text
    connect_timeout_s: Positive
    sensors_timeout_s: Freshness
    late_after_s: Positive
    lag_limit_s: Freshness
    silence_timeout_s: Positive
    reconnect_timeout_s: Positive


class RobotConfig(LinkConfig):
    """Address and geometry of the robot."""

    wheel_radius_m: WheelRadius
    wheel_base_m: WheelBase
    edge_sensors_m: tuple[Pair, Pair, Pair, Pair]
    puck_height_m: Annotated[float, Field(ge=0.0, le=0.5)]
    max_wheel_rad_s: Positive
    wheel_lag_s: NonNegative
    fan_duty: tuple[Annotated[float, Field(ge=0.0, le=1.0)], Annotated[float, Field(ge=0.0, le=1.0)]]
    mass_kg: Annotated[float, Field(gt=0.1, le=10.0)]
    centre_of_mass_m: Pair
    caster_m: Annotated[float, Field(gt=0.0, le=0.5)]
    friction: Annotated[float, Field(gt=0.0, le=2.0)]
    thrust_n: Positive
    thrust_margin: Annotated[float, Field(ge=1.0, le=5.0)]
    tyre_m: Annotated[float, Field(ge=0.0, le=0.05)]


class LimitsConfig(Model):
    """Motion limits of the robot's origin."""

    v_max_m_s: Annotated[float, Field(ge=0.001, le=0.3)]  # slower, a survey would take days
    a_max_m_s2: Annotated[float, Field(ge=0.001, le=2.0)]
    omega_max_rad_s: Annotated[float, Field(ge=0.001, le=5.0)]
    alpha_max_rad_s2: Annotated[float, Field(ge=0.001, le=20.0)]


class PidConfig(Model):
    """One PID controller, thesis eq. 3.4, in seconds and SI units of its error and output."""

    kp: NonNegative = Field(description="output per error")
    ki: NonNegative = Field(description="output per integral of the error")
    kd: NonNegative = Field(description="output per rate of the error")
    derivative_filter_s: NonNegative = Field(description="time constant of the derivative's low-pass filter")
    integral_limit: NonNegative = Field(description="largest contribution of the integral, in the unit of the output")


class GainsConfig(Model):
    """A named set of gains: one controller for the forward speed, one for the angular rate."""

    shaped: bool  # follow an acceleration-limited set point with feed-forward; False = the thesis's step set point
    position_tolerance_m: Positive  # arrived: the stop is at most this far ahead or behind
    heading_tolerance_rad: Positive  # turned: the bearing is at most this far off
    forward: PidConfig
    angular: PidConfig


class ControlConfig(Model):
    """Waypoint tracking."""

    gains: Text
    straight_tolerance_rad: Positive
    lookahead_m: Positive
    cross_track_gain_rad_m2: NonNegative
    heading_weight_1_s2: Positive
    slip_time_s: Positive
    slip_limit: Annotated[float, Field(ge=0.0, lt=0.5)]
    stop_tolerance_m: Positive
    stop_time_s: NonNegative
    settle_speed_m_s: Positive
    settle_rate_rad_s: Positive
    settle_time_s: NonNegative
    settle_mean_time_s: Positive
    predicts_delay: bool
    compensates_creep: bool
    leg_timeout_factor: Positive
    gain_sets: dict[str, GainsConfig] = Field(description="gains by their name")


class TechniquesConfig(Model):
    """Parts of the full-state localizer; each may be switched off to see its effect."""

    zero_velocity: bool
    rest_biases: bool
    seams: bool
    gravity: bool
    slip_per_leg: bool
    accelerometer: bool


class FullStateConfig(Model):
    """Model of the full-state filters; standard deviations of what is not known before the first leg."""

    update_period_s: Positive
    jerk_density_m2_s5: Positive
    angular_acceleration_density_rad2_s3: Positive
    gyroscope_bias_sigma_rad_s: Positive
    gyroscope_bias_walk_rad_s_sqrt_s: NonNegative
    gyroscope_scale_sigma: Positive
    accelerometer_bias_sigma_m_s2: Positive
    accelerometer_bias_walk_m_s2_sqrt_s: NonNegative
    acceleration_jump_m_s2: NonNegative
    wheel_base_sigma: Positive
    encoder_period_s: Positive
    slip_mean: Annotated[float, Field(ge=0.0, lt=0.5)]
    slip_sigma: Positive
    slip_scatter_max: Positive
    slip_difference_sigma: Positive
    creep_sigma: Positive
    creep_scatter_share: NonNegative  # scatter from leg to leg, part of the creep itself
    turn_creep_sigma_m_rad: Positive
    turn_creep_scatter_share: NonNegative
    turn_creep_aside: NonNegative
    turn_loss_per_creep: NonNegative
    wander_fraction: NonNegative  # of the scatter from leg to leg: change of slip and creep within a leg
    wander_time_s: Positive
    edge_sigma_m: Positive
    line_gate: Positive
    rest_after_s: Positive
    rest_rate_rad_s: Positive
    rest_speed_sigma_m_s: Positive
    rest_acceleration_sigma_m_s2: Positive
    rest_turn_sigma_rad_s: Positive
    gravity_sigma_rad: Positive
    gravity_floor_rad: Positive
    gravity_least_tilt: Positive
    gravity_gate: Positive
    panel_tilt_sigma_rad: Positive
    fix_gate_nis: Positive
    consistent_m: Positive
    relocated_heading_sigma_rad: Positive
    rewind_s: Positive
    use: TechniquesConfig


class FourStateConfig(Model):
    """Noise of the thesis's four-state filter, and its use of crossed seams; without effect with other filters."""

    jerk_density_m2_s5: Positive
    angular_acceleration_density_rad2_s3: Positive
    slip_fraction: NonNegative
    crossing_time_sigma_s: Positive
    crossing_max_rate_rad_s: Positive
    crossing_min_speed_m_s: Positive
    crossing_gate_sigma: Positive


class LocalizerConfig(Model):
    """Noise model of the localizer; standard deviations."""

    accelerometer_sigma_m_s2: Positive
    gyroscope_sigma_rad_s: Positive
    gyroscope_bias_rad_s: Annotated[float, Field(ge=-1.0, le=1.0)]
    encoder_sigma_rad_s: Positive
    start_position_sigma_m: Positive
    start_heading_sigma_rad: Positive
    reset_speed_sigma_m_s: Positive
    reset_acceleration_sigma_m_s2: Positive
    reset_rate_sigma_rad_s: Positive
    history_s: Positive
    four_state: FourStateConfig
    full_state: FullStateConfig


class EtalonConfig(Model):
    """Address and use of the MultiLine server."""

    host: Host
    port: PeerPort
    connect_timeout_s: Positive
    request_timeout_s: Positive
    retries: Annotated[int, Field(ge=0, le=10)]
    reconnect_delay_s: Positive
    reconnect_for_s: NonNegative
    measuring_time_s: Positive
    length_sigma_m: Positive
    length_sigma_per_m: NonNegative
    collimator_sigma_m: NonNegative
    offset_sigma_m: NonNegative
    refraction_sigma: NonNegative
    false_alarm: Annotated[float, Field(gt=0.0, lt=0.5)]
    alarm_points: Annotated[int, Field(ge=1, le=1000)]
    max_residual_m: Positive
    max_dop: Positive
    max_distance_m: Positive
    max_surface_residual_m: Positive
    doubt_nis: Positive
    repeat_m: Positive
    start_distance_m: Positive


class DangerConfig(Model):
    """The edge rule and the ages the danger loop accepts (distances are sensor travel)."""

    map_sigmas: Positive
    map_margin_m: Positive
    gap_tolerance_m: NonNegative
    seam_extra_m: Positive
    no_map_travel_m: Positive
    max_crossing_angle_rad: Annotated[float, Field(gt=0.0, lt=1.5)]
    slanted_crossing_m: Positive
    turn_travel_limit_m: Positive
    stale_after_s: Freshness
    estimate_stale_after_s: Freshness
    debounce_samples: Annotated[int, Field(ge=1, le=100)]
    lifted_samples: Annotated[int, Field(ge=1, le=1000)]
    outward_turn_limit_m: Positive
    clear_samples: Annotated[int, Field(ge=1, le=10000)]


class LightConfig(Model):
    """The light that falls on a mirror, world frame."""

    direction_world: tuple[float, float, float]  # of propagation, at the origin of the mirror frame; any length
    vergence_1_m: NonNegative  # 1 over the distance from that origin to where its rays meet; 0 = parallel light


class NetworkConfig(Model):
    """Self-calibration of the laser network: drift of its scale, priors of what the lengths show to have changed."""

    drift_sigma_per_h: NonNegative
    offset_changed_m: Positive
    collimator_moved_m: Positive
    refraction_changed: Positive
    drift_changed_per_h: Positive


class AlignConfig(Model):
    """The alignment result of a survey."""

    point_floor_m: NonNegative
    puck_height_sigma_m: NonNegative
    false_alarm: Annotated[float, Field(gt=0.0, lt=1.0)]
    network: NetworkConfig
    light: dict[str, LightConfig] = Field(description="light at each mirror, by its name")  # by mirror name


class HealthConfig(Model):
    """Limits and times of the monitors of sensors, wheels, fans and link."""

    slow_speed_m_s: Positive
    slow_rate_rad_s: Positive
    doubt_position_m: Positive
    doubt_heading_rad: Positive
    gap_s: Positive
    garbled_lines: Annotated[int, Field(ge=1, le=20)]
    garbled_window_s: Positive
    pause_limit_s: Positive
    hold_limit_s: Positive
    lifted_limit_s: Positive
    retries: Annotated[int, Field(ge=0, le=10)]
    retry_after_s: Positive
    retry_window_s: Positive
    stall_command_m_s: Positive
    stall_speed_m_s: Positive
    stall_time_s: Positive
    stop_time_s: Positive
    stop_speed_m_s: Positive
    creep_m: Positive
    runaway_m_s: Positive
    runaway_time_s: Positive
    ratio_share: Annotated[float, Field(gt=0.0, lt=1.0)]
    ratio_time_s: Positive
    ratio_travel_m: Positive
    yaw_limit_rad: Positive
    yaw_share: Annotated[float, Field(ge=0.0, le=1.0)]
    yaw_time_s: Positive
    turn_delay_s: Positive
    grip_slide_m_s: Positive
    grip_turn_rad: Positive
    identical_samples: Annotated[int, Field(ge=2, le=1000)]
    imu_rate_rad_s: Positive
    imu_jump_rad_s: Positive
    imu_largest_rad_s: Positive
    imu_rate_share: Annotated[float, Field(ge=0.0, le=1.0)]
    imu_acceleration_m_s2: Positive
    imu_quarantine_s: Positive
    rate_share: Annotated[float, Field(gt=0.0, lt=1.0)]
    rate_time_s: Positive
    latency_slow_s: Positive
    latency_pause_s: Positive
    clock_jump_s: Positive
    seam_margin_m: Positive
    seams_suspect: Annotated[int, Field(ge=1, le=10)]
    seams_failed: Annotated[int, Field(ge=1, le=10)]
    stuck_off_m: Annotated[float, Field(gt=0.0, le=0.06)]
    chatter_transitions: Annotated[int, Field(ge=1, le=1000)]
    chatter_time_s: Positive
    fan_early_share: Annotated[float, Field(gt=0.0, lt=1.0)]
    fan_share: Annotated[float, Field(gt=0.0, lt=1.0)]
    fan_time_s: Positive
    battery_life_s: Positive
    battery_reserve: Annotated[float, Field(ge=0.0, lt=1.0)]
    battery_margin: Annotated[float, Field(ge=1.0, le=10.0)]
    battery_time_s: Positive


class ObservatoryConfig(Model):
    """The observatory channel over TCP, in addition to the unix socket, which always exists."""

    endpoint: Text  # empty = none
    key_file: Text
    clients_file: Text


class AlarmsConfig(Model):
    """Further reports of alarms, besides page, terminal and log."""

    webhook_url: Annotated[str, Field(max_length=2048, pattern=URL)]
    webhook_timeout_s: Positive
    webhook_give_up_s: Positive


class DashboardConfig(Model):
    """The operator's web page, and the commands over HTTP."""

    enabled: bool
    host: Host
    port: Port
    token_file: Text  # empty = a new token at each start
    host_names: tuple[Text, ...]
    rate_hz: Annotated[float, Field(gt=0.0, le=50.0)]
    max_connections: Annotated[int, Field(ge=8, le=512)]  # a browser opens up to six
    slow_client_s: Positive
    command_timeout_s: Positive


class MissionConfig(Model):
    """The survey as a sequence of states."""

    leg_clearance_m: Positive
    turn_clearance_m: NonNegative
    backoff_m: Annotated[float, Field(gt=0.0, le=0.06)]
    backoff_speed_m_s: Annotated[float, Field(gt=0.0, le=0.05)]
    turn_away_rad: Positive
    max_backoffs_per_stop: Annotated[int, Field(ge=1)]
    fix_at_start: bool
    via_sigma_m: Positive
    longest_leg_m: Positive
    calibration_length_m: Annotated[float, Field(ge=0.0, le=0.5)]  # 0 = no calibration drive
    calibration_rounds: Annotated[int, Field(ge=1, le=5)]
    arrival_tolerance_m: Positive
    correction_tolerance_m: Positive
    correction_margin: Annotated[float, Field(gt=0.0, le=1.0)]
    correction_reach_m: NonNegative
    max_approaches: Annotated[int, Field(ge=1)]
    verdict_timeout_s: Freshness
    measure_timeout_s: Positive
    failed_points_before_hold: Annotated[int, Field(ge=1)]
    heading_doubt_rad: Positive
    alignment_leg_m: Annotated[float, Field(gt=0.0, le=0.5)]
    holds_to_budget: bool
    alarm_period_s: Positive


class SimRobotConfig(Model):
    """The DataLoop: the robot's stand-in."""

    host: Host
    port: Port
    frame_hz: FrameRate
    ttl_s: TimeToLive
    imu_hz: Annotated[float, Field(gt=0.0, le=100.0)]
    encoder_hz: Annotated[float, Field(gt=0.0, le=1000.0)]
    edge_hz: Annotated[float, Field(gt=0.0, le=1000.0)]
    gravity_hz: Annotated[float, Field(gt=0.0, le=100.0)]
    physics: Literal["lag", "motors", "mujoco"]
    wheel_lag_s: Positive
    fan_floor: Annotated[float, Field(ge=0.0, le=1.0)]  # used on an overhanging mirror
    gravity_sigma_rad: NonNegative
    fall_thrust_s: Positive


class PhysicsConfig(Model):
    """The body of the robot with real physics (``sim.robot.physics = "mujoco"``)."""

    friction: Annotated[float, Field(gt=0.0, le=2.0)]
    tyre: Literal["round", "flat"]
    mass_kg: Annotated[float, Field(gt=0.2, le=10.0)]
    thrust_n: NonNegative
    rotor_inertia_kg_m2: NonNegative
    tyre_width_m: Annotated[float, Field(ge=0.001, le=0.05)]
    pivot_m: Annotated[float, Field(ge=0.0, le=0.02)]
    caster_friction: Annotated[float, Field(ge=0.0, le=1.0)]
    contact_s: Annotated[float, Field(ge=0.004, le=0.1)]
    accelerometer_s: Annotated[float, Field(gt=0.0, le=0.1)]


class SimEtalonConfig(Model):
    """The Etalon stand-in."""

    host: Host
    port: Port
    length_sigma_m: NonNegative
    length_sigma_per_m: NonNegative
    motion_tolerance_m: Positive


class SimTruthConfig(Model):
    """The simulated truth of the mirror."""

    piston_sigma_m: NonNegative
    tilt_sigma_rad: NonNegative


class SimConfig(Model):
    """Everything that exists only in simulation."""

    open_to_network: bool
    robot: SimRobotConfig
    physics: PhysicsConfig
    etalon: SimEtalonConfig
    truth: SimTruthConfig


class WorldConfig(Model):
    """One simulated world: noise, errors and disturbances. 0 (delays, too) switches each of them off by itself.

    Sigmas are standard deviations; ``walk`` names what changes with time: a random walk (per square root of a second)
    or an Ornstein-Uhlenbeck process of that sigma and correlation time.
    """

    name: Text
    accelerometer_sigma_m_s2: NonNegative
    accelerometer_bias_sigma_m_s2: NonNegative
    accelerometer_bias_walk_m_s2_sqrt_s: NonNegative
    gyroscope_sigma_rad_s: NonNegative
    gyroscope_bias_sigma_rad_s: NonNegative
    gyroscope_bias_walk_rad_s_sqrt_s: NonNegative
    gyroscope_scale_sigma: Annotated[float, Field(ge=0.0, le=0.2)]
    encoder_sigma_rad_s: NonNegative  # not added where counts are counted
    encoder_counts_per_rev: Annotated[int, Field(ge=0, le=10_000_000)]  # 0 = the rate itself is read
    start_position_sigma_m: NonNegative
    start_heading_sigma_rad: NonNegative
    slip_min: Annotated[float, Field(ge=0.0, le=0.5)]
    slip_max: Annotated[float, Field(ge=0.0, le=0.5)]
    slip_walk_sigma: Annotated[float, Field(ge=0.0, le=0.2)]
    slip_walk_time_s: Positive
    creep_fraction: Annotated[float, Field(ge=0.0, le=0.5)]
    creep_walk_fraction: Annotated[float, Field(ge=0.0, le=1.0)]
    creep_walk_time_s: Positive
    vibration_rate_rad_s: NonNegative
    vibration_speed_m_s: NonNegative
    vibration_acceleration_m_s2: NonNegative
    wheel_radius_sigma: Annotated[float, Field(ge=0.0, le=0.1)]
    wheel_base_sigma: Annotated[float, Field(ge=0.0, le=0.1)]
    wheel_lag_spread: Annotated[float, Field(ge=0.0, le=0.9)]
    panel_edge_sigma_m: Annotated[float, Field(ge=0.0, le=0.01)]
    sensors_delay_s: Annotated[float, Field(ge=0.0, le=1.0)]
    commands_delay_s: Annotated[float, Field(ge=0.0, le=1.0)]


class SurfaceConfig(Model):
    """Polynomial sag, thesis eq. 1.1; millimetres in the mirror frame."""

    normalisation_radius_mm: Annotated[float, Field(ge=100.0, le=1e6)]  # its sixth power divides coefficients
    terms: tuple[tuple[int, int, float], ...]  # (power of x, power of y, coefficient in mm)


class FrameConfig(Model):
    """Pose of the mirror frame in the world: p_mirror = R (p_world - origin)."""

    origin_world_mm: tuple[float, float, float]
    rotation_about_x_rad: float
    reflecting_side_sign: Literal[-1, 1]
    # Unit vector of gravity. Files of older versions do not have it: they are of a telescope at the zenith.
    gravity_world: tuple[float, float, float] = (0.0, 0.0, 1.0)


class PanelsConfig(Model):
    """Panel layout in the x-y projection of the mirror frame."""

    count: Annotated[int, Field(ge=1)]
    cols: Annotated[int, Field(ge=1)]
    panels_per_row: tuple[Annotated[int, Field(ge=1)], ...]  # row 1 first, each row centred
    size_x_mm: Positive
    size_y_mm: Positive
    pitch_x_mm: Positive
    pitch_y_mm: Positive
    gap_mm: Positive
    y_offset_mm: Annotated[float, Field(ge=-1e5, le=1e5)]
    points_x_mm: tuple[float, float, float]
    points_y_mm: tuple[float, float, float]
    adjusters_mm: dict[str, Pair]  # vertical adjusters, offsets in the panel's tangent plane


class AdjustersConfig(Model):
    """Names and limits of the vertical adjusters; 0: not known, no limit."""

    order: Literal["manufacturer", "observatory"] = "manufacturer"  # whose names the adjusters have
    pitch_mm: NonNegative = 0.0  # move per turn of a screw
    travel_mm: NonNegative = 0.0  # largest move of an adjuster in one work list
    step_mm: NonNegative = 0.0  # largest move of an adjuster in one round; each round moves all adjusters of a panel


class BaseConfig(Model):
    """Where the robot starts and returns to, in a panel frame."""

    row: Annotated[int, Field(ge=1)]
    col: Annotated[int, Field(ge=1)]
    x_mm: float
    y_mm: float
    heading_rad: float


class CollimatorsConfig(Model):
    """Surveyed collimator positions of the laser system, world frame."""

    # a position has three unknowns, and one more length is needed: interface control document 2
    channels: Annotated[tuple[Annotated[int, Field(ge=1, le=32)], ...], Field(min_length=4)]
    positions_world_mm: tuple[tuple[float, float, float], ...]


class MirrorConfig(Model):
    """One mirror: surface, frame, panels, base, collimators."""

    name: Text
    overhang: bool
    provenance: tuple[Text, ...]
    unverified: tuple[Text, ...]
    surface: SurfaceConfig
    frame: FrameConfig
    panels: PanelsConfig
    base: BaseConfig
    collimators: CollimatorsConfig
    adjusters: AdjustersConfig = AdjustersConfig()


class Config(Model):
    """The whole configuration of one run. ``mirror`` and ``world`` are the files that ``run`` names, read in."""

    system: ClassVar[str] = "survey"
    run: RunConfig
    observation: SurveyMetadata
    robot: RobotConfig
    limits: LimitsConfig
    control: ControlConfig
    localizer: LocalizerConfig
    etalon: EtalonConfig
    danger: DangerConfig
    align: AlignConfig
    health: HealthConfig
    observatory: ObservatoryConfig
    alarms: AlarmsConfig
    dashboard: DashboardConfig
    mission: MissionConfig
    sim: SimConfig
    mirror: MirrorConfig
    world: WorldConfig

    @property
    def processes(self) -> ProcessesConfig:
        """Time-outs, restarts and priorities of the processes."""
        return self.run
