"""Pure. The simulated robot among beacons of a configuration, and the world round it."""

from ccatp.config.radio_models import RadioConfig
from ccatp.sim.beacon_robot import BeaconRobot
from ccatp.sim.radio.world import RadioWorld


def build_beacon_robot(cfg: RadioConfig) -> BeaconRobot:
    """The robot of a configuration, just booted."""
    return BeaconRobot(cfg, RadioWorld(cfg))


def motes_of(_cfg: RadioConfig) -> dict[str, tuple[float, float]]:
    """Where the motes are, by name."""
    return {}
