"""Missions among beacons for tests: shipped configurations with what a test changes."""

from math import hypot
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.load import load_radio_config
from ccatp.config.package import configs_dir
from ccatp.studies.mote_navigation import BeaconSilResult, BeaconSilWorld


def beacon_config(system: str, **overrides: Any) -> RadioConfig:
    """The shipped configuration of a system; dots in keys are written as two underscores."""
    keys = {name.replace("__", "."): value for name, value in overrides.items()}
    return load_radio_config(Path(configs_dir() / f"{system}.toml"), keys)


def play(stage: BeaconSilWorld, until_s: float = 1e9) -> BeaconSilWorld:
    """Serve frames until a time, or the end."""
    while not stage.is_over and stage.robot.t_s < until_s:
        stage.frame()
    return stage


def target_distances(found: BeaconSilResult) -> np.ndarray[Any, np.dtype[np.float64]]:
    """True distance of the robot's origin from the target, one a frame."""
    return np.array([hypot(row[2] - row[5], row[3] - row[6]) for row in found.truth])


def moved_m(found: BeaconSilResult, from_s: float, until_s: float) -> float:
    """How far the robot really went between two times."""
    places = np.array([row[2:4] for row in found.truth if from_s <= row[1] <= until_s])
    return float(np.hypot(*np.diff(places, axis=0).T).sum())
