"""Reads the configuration of the on-board program of a robot among beacons."""

from pathlib import Path

from ccatp.beacons.config.onboard_models import BeaconOnboardConfig, check_beacon_onboard_config
from ccatp.config.load import Overrides, layers, merged, validated

FILE = "beacon_onboard.toml"
_WHOLE = (("devices", "listeners", "devices"),)  # a file that names its own listeners means these and no others


def load_beacon_onboard_config(file: Path | None = None, overrides: Overrides = None) -> BeaconOnboardConfig:
    """The configuration; arguments and errors as of ``load_onboard_config``."""
    command, user, base = sources = layers(FILE, file, overrides)
    tree = merged(merged(base.tree, user.tree, _WHOLE), command.tree)
    return validated(BeaconOnboardConfig, tree, sources, check_beacon_onboard_config)
