"""Frozen configuration models of the on-board program. Values live in ``configs/onboard.toml``."""

from typing import Annotated, Literal

from pydantic import Field

from ccatp.config.models import Host, Model, NonNegative, Pair, Port, Positive, Text
from ccatp.config.robot_limits import FrameRate, TimeToLive, WheelBase, WheelRadius

Line = Annotated[int, Field(ge=0, le=1023)]
Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]


class OnboardLinkConfig(Model):
    """The robot link, of which this program is the server."""

    host: Host
    port: Port
    key_file: Text  # empty = no authentication
    frame_hz: FrameRate
    ttl_s: TimeToLive
    sample_latency_s: Annotated[float, Field(ge=0.0, le=0.05)]


class OnboardRobotConfig(Model):
    """Data of the robot in the hello; lengths in m, robot frame."""

    wheel_radius_m: WheelRadius
    wheel_base_m: WheelBase
    edge_sensors_m: tuple[Pair, Pair, Pair, Pair]
    puck_m: tuple[float, float, float]
    max_wheel_rad_s: Positive
    fan_floor: Fraction
    grip_slide_m_s: Positive
    grip_turn_rad: Positive


class WheelServoConfig(Model):
    """The speed controller of one wheel: feed-forward and PI, in volts."""

    loop_hz: Annotated[float, Field(ge=100.0, le=2000.0)]
    response_s: Positive
    counts_per_rev: Positive
    speed_window_s: Positive
    max_v: Positive
    slew_v_s: Positive
    static_v: NonNegative
    volt_per_rad_s: NonNegative
    proportional_v_per_rad_s: NonNegative
    integral_v_per_rad: NonNegative
    stall_s: Positive


class EdgeThresholdConfig(Model):
    """The threshold of an analogue edge sensor over a panel."""

    threshold_v: Positive
    hysteresis_v: NonNegative
    debounce_s: NonNegative
    is_panel_above: bool


class Bno055Config(Model):
    """The inertial unit; ``axes``: which of its axes points along robot x, y and z."""

    bus: Annotated[int, Field(ge=0, le=255)]
    address: Annotated[int, Field(ge=0x08, le=0x77)]
    axes: tuple[Axis, Axis, Axis]
    rate_hz: Annotated[float, Field(gt=0.0, le=100.0)]
    timeout_s: Positive
    noise_rad_s: Positive
    noise_m_s2: Positive


class DaqConfig(Model):
    """The serial data acquisition device: encoder counters, edge sensors, battery."""

    device: Text
    baud: Annotated[int, Field(ge=9600, le=4_000_000)]
    sample_hz: Annotated[float, Field(gt=0.0, le=1000.0)]
    timeout_s: Positive
    full_scale_v: Positive
    battery_ratio: Positive  # battery voltage over the voltage at the converter
    battery_empty_v: Positive
    battery_full_v: Positive
    noise_v: Positive


class PwmChannelConfig(Model):
    """One output of the kernel's PWM: ``pwmchip<chip>/pwm<channel>``."""

    chip: Line
    channel: Line


class MotorConfig(PwmChannelConfig):
    """A motor: its PWM and the two lines of its bridge; both high short-brake it."""

    forward_line: Line
    reverse_line: Line


class MotorsConfig(Model):
    """The motor bridge."""

    gpio_chip: Text
    supply_v: Positive
    period_s: Positive
    right: MotorConfig
    left: MotorConfig


class FansConfig(Model):
    """The fans."""

    period_s: Positive
    left: PwmChannelConfig
    right: PwmChannelConfig


class ExternalTimerConfig(Model):
    """The external timer that brakes the motors when ``line`` has not changed for ``timeout_s``."""

    gpio_chip: Text
    line: Line
    timeout_s: Annotated[float, Field(gt=0.0, le=0.05)]


class DevicesConfig(Model):
    """The devices of a robot."""

    bno055: Bno055Config
    daq: DaqConfig
    motors: MotorsConfig
    fans: FansConfig
    timer: ExternalTimerConfig


class OnboardConfig(Model):
    """The whole configuration of the on-board program."""

    kind: Literal["mirror"]  # of the robot
    link: OnboardLinkConfig
    robot: OnboardRobotConfig
    servo: WheelServoConfig
    edges: EdgeThresholdConfig
    devices: DevicesConfig
