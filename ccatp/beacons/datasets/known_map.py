"""Maps of beacons that are known before a run: surveyed places, or the map of an earlier run."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.beacons.datasets.columns import read_survey
from ccatp.beacons.datasets.events import is_events_csv, read_events_csv
from ccatp.beacons.datasets.tables import RadioDataError, read_text
from ccatp.beacons.estimation.recording import KnownMap
from ccatp.core import FloatArray

SURVEYED_M = 0.02  # standard deviation of a place for which none is given: a tape measure, or a total station indoors
FINEST_M = 1e-3  # added to each coordinate: a map is not known better, and the estimators invert its covariance
FARTHEST_M = 1e8
WANTED = "a table with beacon, x, y, a CSV of events, or a map.toml"


def read_known_map(file: Path) -> KnownMap:
    """Read a map: a table ``beacon, x, y, [z], [sigma]``, the events ``beacon`` of a CSV, or TOML as we write it.

    Raises RadioDataError: it cannot be read, or is no map.
    """
    try:
        return _read(file)
    except RadioDataError as error:
        raise error.with_page() from error


def _read(file: Path) -> KnownMap:
    text = read_text(file, WANTED)
    if file.suffix == ".toml":
        return _checked(file, *_of_toml(file, text))
    if is_events_csv(text):
        recording = read_events_csv(file)
        if "beacon" not in recording.tables:
            raise RadioDataError(file, "has no event beacon, so it is no map")
        values = recording.tables["beacon"].values
        names = [recording.names[int(k)] for k in values[:, 0].tolist()]
        places, sigmas = values[:, 1:], np.full((len(values), 2), SURVEYED_M)
    else:
        names, places, sigma_m = read_survey(file, text)
        if not (wrong := ~np.isnan(sigma_m) & ~((sigma_m >= 0.0) & (sigma_m <= FARTHEST_M))).any():
            sigma_m = np.where(np.isnan(sigma_m), SURVEYED_M, sigma_m)
        else:
            k = int(np.argmax(wrong))
            raise RadioDataError(file, f"place of {names[k]}: its sigma of {sigma_m[k]:g} m is none")
        sigmas = np.column_stack([sigma_m, sigma_m])
    return _checked(file, names, places, np.diag(np.square(sigmas).ravel()))


def _of_toml(file: Path, text: str) -> tuple[list[str], FloatArray, FloatArray]:
    """Names, places with heights (n, 3), and the covariance of the places in the plane, (2 n, 2 n)."""
    try:
        tree: dict[str, Any] = tomllib.loads(text)
        beacons = tree["beacons"]
        size = int(tree.get("dimension", 2))
        places = np.array([one["position_m"] for one in beacons.values()], dtype=np.float64).reshape(-1, size)
        sigmas = np.array([one["sigma_m"] for one in beacons.values()], dtype=np.float64).reshape(-1, size)
        joint = tree.get("joint", {}).get("covariance_m2", np.diag(np.square(sigmas).ravel()))
        covariance = np.array(joint, dtype=np.float64).reshape(places.size, places.size)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        what = f"{error} is missing" if isinstance(error, KeyError) else " ".join(str(error).split())[:120]
        raise RadioDataError(file, f"is no map of beacons as radio slam --out writes it: {what}") from error
    flat = np.array([size * k + axis for k in range(len(places)) for axis in range(2)], dtype=int)
    heights = places[:, 2] if size > 2 else np.full(len(places), np.nan)
    return list(beacons), np.column_stack([places[:, :2], heights]), covariance[np.ix_(flat, flat)]


def _checked(file: Path, names: list[str], places: FloatArray, covariance: FloatArray) -> KnownMap:
    if not names:
        raise RadioDataError(file, "holds no beacon")
    if doubled := [name for name in names if names.count(name) > 1]:
        raise RadioDataError(file, f"holds beacon {doubled[0]} twice")
    for name, place in zip(names, places[:, :2], strict=True):
        if not (np.abs(place) <= FARTHEST_M).all():
            raise RadioDataError(file, f"place of {name}: is no place within {FARTHEST_M:g} m")
    with np.errstate(all="ignore"):
        sound = bool(np.isfinite(covariance).all() and np.abs(covariance).max() <= FARTHEST_M**2)
        sound = sound and bool(np.linalg.eigvalsh(covariance)[0] >= -1e-9 * np.trace(covariance))
    if not sound:
        raise RadioDataError(file, "the covariance of its places is none: not finite, or with a negative eigenvalue")
    covariance = 0.5 * (covariance + covariance.T) + FINEST_M**2 * np.eye(len(covariance))
    return KnownMap(tuple(names), places[:, :2], covariance, places[:, 2])
