"""Pure. Assembles the parts of a mission among beacons from a configuration, for the daemon and rehearsals alike."""

from ccatp.beacon_mission.mission import BeaconMission
from ccatp.beacon_mission.mote_navigator import MoteNavigator
from ccatp.beacon_mission.navigator import Navigator
from ccatp.beacon_mission.radio_navigator import RadioNavigator
from ccatp.config.radio_models import RadioConfig
from ccatp.errors import ConfigError
from ccatp.wire.robot import Hello

# The configuration may be calibrated, the robot's own figures are nominal: this much apart they describe two robots.
TOLERANCE = 0.05
TrackRow = tuple[int, float, float, float, float, float, float, float, float, float, float, float, float]


def assemble_beacons(cfg: RadioConfig) -> BeaconMission:
    """The mission of a configuration, the robot standing at its believed start."""
    return BeaconMission(cfg, build_navigator(cfg))


def build_navigator(cfg: RadioConfig) -> Navigator:
    """What finds the robot: radios mapped on the way, or motes that map themselves first."""
    return MoteNavigator(cfg) if cfg.system == "cricket" else RadioNavigator(cfg)


def track_row(seq: int, t_s: float, navigator: Navigator) -> TrackRow:
    """A row of the topic ``beacon_track``."""
    (x, y, heading), P = navigator.belief
    xx, xy, xh = P[0].tolist()
    _, yy, yh = P[1].tolist()
    return seq, t_s, x, y, heading, xx, xy, yy, xh, yh, float(P[2, 2]), *navigator.reckoned_m


def check_beacon_robot(cfg: RadioConfig, hello: Hello) -> None:
    """Refuse a robot whose own geometry contradicts the configuration.

    Raises:
        ConfigError: it is another robot.
    """
    own, vehicle = hello.robot, hello.robot.vehicle
    if vehicle is None:
        raise ConfigError("robot: it says nothing of its vehicle: this is no robot for missions among beacons")
    problems = [
        f"{name} is {ours:g} here and {theirs:g} there"
        for name, ours, theirs in (
            ("robot.wheel_radius_m", cfg.robot.wheel_radius_m, own.wheel_radius_m),
            ("vehicle.track_m", cfg.vehicle.track_m, own.wheel_base_m),
            ("vehicle.wheelbase_m", cfg.vehicle.wheelbase_m, vehicle.axle_distance_m),
        )
        if abs(ours - theirs) > TOLERANCE * theirs
    ]
    if vehicle.kind != cfg.vehicle.kind:
        problems.append(f"vehicle.kind is {cfg.vehicle.kind} here and {vehicle.kind} there")
    ours, theirs = cfg.avoidance.sensors_rad, vehicle.distance_sensors_rad
    if len(ours) != len(theirs) or any(abs(a - b) > TOLERANCE for a, b in zip(ours, theirs, strict=True)):
        problems.append("the distance sensors look elsewhere (avoidance.sensors_rad)")
    if problems:
        raise ConfigError(f"robot: the configuration is not of this robot: {'; '.join(problems)}")
