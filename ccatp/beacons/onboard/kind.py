"""The robot among beacons as a kind of robot with a program on its own computer."""

from ccatp.missions import Part
from ccatp.onboard.kinds import RobotKind

BEACONS = RobotKind(
    load=Part("ccatp.beacons.config.onboard_load:load_beacon_onboard_config"),
    make_hardware=Part("ccatp.beacons.onboard.hardware:BeaconHardware"),
    make_robot=Part("ccatp.beacons.onboard.robot:BeaconOnboardRobot"),
    no_tuning="the base has servos of its own; ccatp radio calibrate finds the path loss from a drive past a radio",
)
