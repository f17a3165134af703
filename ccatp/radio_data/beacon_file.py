"""Edge. Writes and reads a map of beacons as TOML: what navigation takes over from self-mapping."""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.config.toml_text import format_toml
from ccatp.motes.range_network import MappingError
from ccatp.samples import FloatArray

_HEAD = "# Beacons, mapped by ccatp radio map: m, and the covariance of all coordinates in their order, m^2.\n\n"


class BeaconFileError(MappingError):
    """A file of beacons that cannot be written or read."""


class BeaconMap(NamedTuple):
    """Beacons with what is uncertain about them.

    Attributes:
        names: of the n beacons.
        positions_m: shape (n, d).
        covariance_m2: of all coordinates, shape (n d, n d).
        frame: which frame they are in.
    """

    names: tuple[str, ...]
    positions_m: FloatArray
    covariance_m2: FloatArray
    frame: str


def write_beacons(
    path: Path, names: Sequence[str], positions_m: FloatArray, covariance_m2: FloatArray, frame: str
) -> None:
    """Write a map.

    Args:
        path: the file.
        names: of the beacons.
        positions_m: shape (n, d).
        covariance_m2: shape (n d, n d).
        frame: one line that says which frame this is.

    Raises:
        BeaconFileError: the file cannot be written.
    """
    d = positions_m.shape[1]
    beacons = {}
    for row, name in enumerate(names):
        block = covariance_m2[row * d : (row + 1) * d, row * d : (row + 1) * d]
        beacons[name] = {
            "position_m": positions_m[row].tolist(),
            "sigma_m": np.sqrt(np.maximum(block.diagonal(), 0.0)).tolist(),
        }
    tree = {"frame": frame, "dimension": d, "beacons": beacons, "joint": {"covariance_m2": covariance_m2.tolist()}}
    try:
        path.write_text(_HEAD + format_toml(tree), encoding="utf-8")
    except OSError as error:
        raise BeaconFileError(f"{path}: cannot be written: {error.strerror or error}") from error


def read_beacons(path: Path) -> BeaconMap:
    """Read a map that ``write_beacons`` wrote.

    Raises:
        BeaconFileError: it cannot be read, or it is no such map.
    """
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BeaconFileError(f"{path}: cannot be read as a map of beacons: {error}") from error
    try:
        names = tuple(tree["beacons"])
        positions = np.array([tree["beacons"][name]["position_m"] for name in names], dtype=np.float64)
        covariance = np.array(tree["joint"]["covariance_m2"], dtype=np.float64)
        frame = str(tree["frame"])
    except (KeyError, TypeError, ValueError) as error:
        raise BeaconFileError(f"{path}: is no map of beacons: {error}") from error
    if positions.ndim != 2 or covariance.shape != (positions.size, positions.size):
        raise BeaconFileError(f"{path}: covariance of shape {covariance.shape} for {positions.size} coordinates")
    return BeaconMap(names, positions, covariance, frame)
