"""Pure. Frozen configuration models of missions among beacons: goals, dangers, robot link, incidents."""

from typing import Annotated, Literal

from pydantic import Field

from ccatp.config.models import LinkConfig, Model, NonNegative, Positive

# Frames come ten times a second: what is older than two of them is stale.
SlowFreshness = Annotated[float, Field(gt=0.0, le=1.0)]
RadioName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
Place = Annotated[float, Field(ge=-1e3, le=1e3)]
Laps = Annotated[int, Field(ge=1, le=1000)]


class BeaconRobotConfig(LinkConfig):
    """The robot link, and the wheels as the link counts them."""

    sensors_timeout_s: SlowFreshness
    lag_limit_s: SlowFreshness
    wheel_radius_m: Annotated[float, Field(gt=0.0, le=0.5)]
    max_wheel_rad_s: Positive


class BeaconMissionConfig(Model):
    """What the robot is there for, and when that takes too long."""

    laps: Laps  # how often all waypoints are visited
    follow_s: Positive  # how long a target is followed
    time_limit_s: Positive  # a mission that takes longer is held for an operator
    verdict_timeout_s: SlowFreshness
    settle_speed_m_s: Positive  # at rest: slower than this
    map_period_s: Positive  # how often the map is published


class BeaconDangerConfig(Model):
    """When the danger loop denies motion; distances from the vehicle's origin."""

    obstacle_m: Positive  # no forward motion with anything ahead that is nearer
    ahead_rad: Positive  # ahead: within this of the course
    memory_s: Positive  # what was seen is believed for this long
    target_m: Positive  # no motion towards the target when it is nearer
    target_window_s: Positive  # its levels are averaged over this time
    target_level_sigma_db: Positive  # of the white noise of its level
    radio_timeout_s: Positive  # hold when no static radio, or no mote, was heard for this long
    position_sigma_m: Positive  # hold while the estimate's standard deviation is larger ...
    position_clear_m: Positive  # ... until it is smaller than this
    estimate_timeout_s: Positive  # hold without an estimate that is newer
    hold_limit_s: Positive  # a hold that lasts longer needs an operator
    stale_after_s: SlowFreshness  # no permit on frames that are older


class ListenerConfig(Model):
    """How the robot hears ultrasonic motes."""

    name: RadioName  # of the robot's own listener, in readings
    pulses_per_frame: Annotated[int, Field(ge=1, le=20)]  # motes that send in one frame, one after the other
    mapping_rounds: Annotated[int, Field(ge=1, le=10_000)]  # in which motes report what they hear of each other
    gate_probability: Annotated[float, Field(gt=0.5, lt=1.0)]  # a range less likely than this is not used


class SimBeaconRobotConfig(Model):
    """The DataLoop: the robot's stand-in."""

    host: str
    port: Annotated[int, Field(ge=0, le=65535)]
    ttl_s: Positive


class RadioLossConfig(Model):
    """Radios fall silent."""

    type: Literal["radio_loss"]
    at_s: NonNegative
    for_s: Positive
    beacons: tuple[RadioName, ...]  # empty: all of them


class ObstacleIncidentConfig(Model):
    """Somebody puts something in the way, and takes it away again."""

    type: Literal["obstacle"]
    at_s: NonNegative
    for_s: Positive
    x_m: Place
    y_m: Place
    radius_m: Positive


class TargetApproachConfig(Model):
    """The radio that moves comes straight at the robot."""

    type: Literal["target_approach"]
    at_s: NonNegative
    for_s: Positive
    speed_m_s: Positive


IncidentConfig = Annotated[RadioLossConfig | ObstacleIncidentConfig | TargetApproachConfig, Field(discriminator="type")]
