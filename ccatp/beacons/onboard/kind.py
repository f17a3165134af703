"""The robot among beacons as a kind of robot with a program on its own computer."""

from collections.abc import Callable

from ccatp.beacons.config.onboard_models import BeaconOnboardConfig
from ccatp.beacons.onboard.hardware import BeaconHardware
from ccatp.beacons.onboard.robot import BeaconOnboardRobot
from ccatp.missions import Part
from ccatp.onboard.kinds import Controlled, RobotKind


def beacon_robot(cfg: BeaconOnboardConfig, hardware: BeaconHardware) -> Controlled:
    """The robot on started hardware."""
    return Controlled(BeaconOnboardRobot(cfg, hardware), cfg.robot.loop_hz)


def beacon_hardware(cfg: BeaconOnboardConfig, clock: Callable[[], float]) -> BeaconHardware:
    """Its devices."""
    return BeaconHardware(cfg, clock)


BEACONS = RobotKind(
    load=Part("ccatp.beacons.config.onboard_load:load_beacon_onboard_config"),
    make_hardware=Part(f"{__name__}:beacon_hardware"),
    make_robot=Part(f"{__name__}:beacon_robot"),
    no_tuning="the base has servos of its own; ccatp radio calibrate finds the path loss from a drive past a radio",
)
