"""The robot on mirrors as a kind of robot."""

from collections.abc import Callable

from ccatp.config.onboard_models import OnboardConfig
from ccatp.missions import Part
from ccatp.onboard.devices.linux import LinuxHardware
from ccatp.onboard.kinds import RobotKind


def linux_hardware(cfg: OnboardConfig, clock: Callable[[], float]) -> LinuxHardware:
    """Its devices."""
    return LinuxHardware(cfg.devices, clock)


MIRROR = RobotKind(
    load=Part("ccatp.config.load:load_onboard_config"),
    make_hardware=Part(f"{__name__}:linux_hardware"),
    make_robot=Part("ccatp.onboard.robot:OnboardRobot"),
)
