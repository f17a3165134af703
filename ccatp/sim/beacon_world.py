"""Pure. The simulated robot among beacons of a configuration, and the world round it."""

import numpy as np

from ccatp.config.radio_models import RadioConfig
from ccatp.sim.beacon_robot import BeaconRobot
from ccatp.sim.motes.layout import TrueMotes, true_motes
from ccatp.sim.motes.robot_ears import RobotEars
from ccatp.sim.radio.world import RadioWorld

# Streams of random numbers of a seed, apart from those of the world.
_LAYOUT, _EARS = 20, 21


def build_beacon_robot(cfg: RadioConfig) -> BeaconRobot:
    """The robot of a configuration, just booted."""
    world = RadioWorld(cfg)
    if cfg.system != "cricket":
        return BeaconRobot(cfg, world)
    rng = np.random.default_rng([cfg.run.seed, _EARS])
    return BeaconRobot(cfg, world, RobotEars(cfg.cricket, cfg.listener, _motes(cfg), rng))


def motes_of(cfg: RadioConfig) -> dict[str, tuple[float, float]]:
    """Where the motes are, by name."""
    if cfg.system != "cricket":
        return {}
    motes = _motes(cfg)
    places = motes.positions_m.tolist()
    return {name: (place[0], place[1]) for name, place in zip(motes.names, places, strict=True)}


def _motes(cfg: RadioConfig) -> TrueMotes:
    return true_motes(cfg.cricket, np.random.default_rng([cfg.run.seed, _LAYOUT]))
