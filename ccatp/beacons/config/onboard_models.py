"""Frozen configuration models of the on-board program of a robot among beacons.

Values live in ``configs/beacon_onboard.toml``.
"""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from ccatp.beacons.config.models import Angle, Name
from ccatp.config.checks import check_top_speed, problem_of
from ccatp.config.messages import ConfigProblem
from ccatp.config.models import Model, NonNegative, Positive, Text
from ccatp.config.onboard_models import Line, OnboardLinkConfig
from ccatp.config.robot_limits import VEHICLE_FRAME_HZ, WheelBase, WheelRadius

ListenerName = Annotated[Name, Field(max_length=16)]  # many of them share a line of the link
Baud = Annotated[int, Field(ge=1200, le=921_600)]
BaseBaud = Annotated[int, Field(ge=9600, le=115_200)]  # with 4800 baud commands would queue up before the base
COLDEST_C, HOTTEST_C = -60.0, 80.0  # that a thermometer of a robot may show
Celsius = Annotated[float, Field(ge=COLDEST_C, le=HOTTEST_C)]
SCAN_LEVELS = 800  # of a scan, which must not exceed the limit of a line of the link
_STEPS_OF_WATCHDOG = 5  # of the control loop, in the time of the base's watchdog: one may be late
_CYCLE_BITS = 600  # of the packets that the base sends in a cycle: counts, speeds and six sonars


class BeaconLinkConfig(OnboardLinkConfig):
    """The robot link; a robot with a vehicle may send fewer frames."""

    frame_hz: Annotated[float, Field(ge=VEHICLE_FRAME_HZ.low, le=VEHICLE_FRAME_HZ.high)]


class BeaconBodyConfig(Model):
    """Data of the robot in the hello."""

    wheel_radius_m: WheelRadius
    track_m: WheelBase
    axle_distance_m: Positive
    max_wheel_rad_s: Positive
    loop_hz: Annotated[float, Field(ge=20.0, le=1000.0)]


class ScanTimesConfig(Model):
    """When the robot stands and listens to radios."""

    every_s: NonNegative
    standing_s: Positive
    standing_rad_s: Positive


class RadioDeviceConfig(Model):
    """The XBee that is the coordinator of the network."""

    is_used: bool
    device: Text
    baud: Baud
    api_mode: Literal[1, 2]
    names: tuple[Name, ...]
    discovery_s: Positive
    answer_timeout_s: Positive
    tries: Annotated[int, Field(ge=1, le=20)]


class DishConfig(Model):
    """The reflector on its stepper motor; lines of one GPIO chip."""

    is_used: bool
    gpio_chip: Text
    step_line: Line
    direction_line: Line
    left_is_high: bool
    homing: Literal["switch", "hand"]
    switch_line: Line
    switch_is_high: bool
    steps_per_turn: Annotated[int, Field(ge=4, le=100_000)]
    positions: Annotated[int, Field(ge=4, le=720)]
    step_s: Positive
    settle_s: NonNegative
    tolerance_steps: Annotated[int, Field(ge=0)]


class BaseDeviceConfig(Model):
    """The Pioneer base."""

    is_used: bool
    device: Text
    baud: BaseBaud
    timeout_s: Positive
    counts_per_mm: Positive
    acceleration_m_s2: Positive
    turn_acceleration_rad_s2: Positive
    most_watchdog_s: Positive
    battery_empty_v: Positive
    battery_full_v: Positive
    sonars: tuple[Annotated[int, Field(ge=0, le=31)], ...]  # numbers, in the order of sonars_rad
    sonars_rad: tuple[Angle, ...]
    sonar_max_m: Positive
    sonar_timeout_s: Positive


class ListenersConfig(Model):
    """Cricket motes as listeners on serial lines, by the name of the listener."""

    is_used: bool
    devices: dict[ListenerName, Text]
    baud: Baud
    timeout_s: Positive
    temperature_c: Celsius


class BeaconDevicesConfig(Model):
    """The devices; each can be left out."""

    base: BaseDeviceConfig
    radio: RadioDeviceConfig
    dish: DishConfig
    listeners: ListenersConfig


class BeaconOnboardConfig(Model):
    """The whole configuration."""

    kind: Literal["beacons"]
    link: BeaconLinkConfig
    robot: BeaconBodyConfig
    scan: ScanTimesConfig
    devices: BeaconDevicesConfig


def check_beacon_onboard_config(cfg: BeaconOnboardConfig) -> Iterator[ConfigProblem]:
    """Everything wrong with a configuration whose values are each in range."""
    link, body, devices = cfg.link, cfg.robot, cfg.devices
    base, dish = devices.base, devices.dish
    least_s = _STEPS_OF_WATCHDOG / body.loop_hz
    yield from check_top_speed(body)
    for is_wrong, key, what, *related in (
        (link.frame_hz * link.ttl_s < 2.0, "link.ttl_s", "must last for two frames at least", "link.frame_hz"),
        (body.loop_hz < link.frame_hz, "robot.loop_hz", "must not be below link.frame_hz", "link.frame_hz"),
        (base.most_watchdog_s < least_s, "devices.base.most_watchdog_s",
         f"stops a loop with steps of {1.0 / body.loop_hz:g} s; allow {least_s:g} at least", "robot.loop_hz"),
        (base.battery_empty_v >= base.battery_full_v, "devices.base.battery_empty_v",
         "must be below devices.base.battery_full_v", "devices.base.battery_full_v"),
        (len(set(base.sonars)) < len(base.sonars), "devices.base.sonars", "names a sonar twice"),
        (len(base.sonars) != len(base.sonars_rad), "devices.base.sonars_rad", "needs a direction for each of sonars",
         "devices.base.sonars"),
        (dish.is_used and not devices.radio.is_used, "devices.dish.is_used", "needs devices.radio",
         "devices.radio.is_used"),
        (dish.steps_per_turn % dish.positions != 0, "devices.dish.positions",
         f"must divide steps_per_turn = {dish.steps_per_turn}", "devices.dish.steps_per_turn"),
        (len({dish.step_line, dish.direction_line, dish.switch_line}) < 3, "devices.dish.step_line",
         "names a line twice", "devices.dish.direction_line", "devices.dish.switch_line"),
        (dish.is_used and len(devices.radio.names) * dish.positions > SCAN_LEVELS, "devices.radio.names",
         f"times devices.dish.positions exceeds {SCAN_LEVELS} levels, which a line of the link can hold",
         "devices.dish.positions"),
        (not any(one.is_used for one in (base, devices.radio, devices.listeners)), "devices.base.is_used",
         "is false, as of all other devices", "devices.radio.is_used", "devices.listeners.is_used"),
        (base.is_used and devices.listeners.is_used and link.sample_latency_s * base.baud < _CYCLE_BITS,
         "devices.base.baud", f"lets packets take {_CYCLE_BITS / base.baud:.2f} s: then wheels are known later than "
         "motes, by more than link.sample_latency_s; set HostBaud of the base to 115200", "devices.listeners.is_used"),
        (devices.listeners.is_used and not devices.listeners.devices, "devices.listeners.devices",
         "names no listener", "devices.listeners.is_used"),
    ):  # fmt: skip
        if is_wrong:
            yield problem_of(key, what, *related)
