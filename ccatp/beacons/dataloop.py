"""The simulated robot among beacons, as the process of the simulated robot serves it."""

from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.sim.robot import build_beacon_robot
from ccatp.dataloop import StandIn, StandInOptions


def beacon_stand_in(cfg: RadioConfig, _options: StandInOptions) -> StandIn:
    """The robot of a configuration, at its start; it knows no plan of faults."""
    return StandIn(build_beacon_robot(cfg))
