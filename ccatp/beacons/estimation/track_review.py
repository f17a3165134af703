"""Review of an estimated path: residuals of its readings, the file for evo, and the best next measurement."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from ccatp.beacons.config.models import RadioNoiseConfig
from ccatp.beacons.estimation.measurement_models import range_variance
from ccatp.beacons.estimation.predictions import predicted, prediction_lines
from ccatp.beacons.estimation.recording import EstimatedPath, RecordedRun, antenna_path
from ccatp.beacons.rigid_motion import rigid_modes
from ccatp.core import FloatArray

_PLACES = 200  # number of places along the path at which a next reading is considered


def range_residuals(run: RecordedRun, track: EstimatedPath, camera_field_rad: float) -> FloatArray:
    """Calibrated ranges minus those of path and map, m, shape (m,); NaN without a range or a beacon on the map."""
    nowhere = np.full(2, np.nan)
    places = np.array([track.beacons[name][:2] if name in track.beacons else nowhere for name in run.beacon_ids])
    r = track.calibrated(run.readings.with_distances(camera_field_rad), run.beacon_ids)
    at = r.radios_at(track.poses_at(r.times_s))
    return np.asarray(r.range_m - np.hypot(*(places[r.beacon] - at).T))


def residuals_by_beacon(run: RecordedRun, residuals_m: FloatArray) -> dict[str, dict[str, float]]:
    """Number, median and half the width of the middle 68 % of the residuals, m, of each beacon that has residuals."""
    found = {}
    for k, name in enumerate(run.beacon_ids):
        own = residuals_m[(run.readings.beacon == k) & np.isfinite(residuals_m)]
        if own.size:
            low, median, high = np.percentile(own, (16, 50, 84)).tolist()
            found[name] = {"readings": float(own.size), "median_m": median, "sigma_m": 0.5 * (high - low)}
    return found


def tum_lines(times_s: FloatArray, poses: FloatArray, antenna_m: tuple[float, float] = (0.0, 0.0)) -> Iterator[str]:
    """Poses of the vehicle in the TUM format of ``evo``: time, x, y, z, and the quaternion x, y, z, w.

    ``poses``: x_m, y_m, heading_rad of the antenna, shape (n, 3).
    """
    places = antenna_path(poses, antenna_m, -1.0)
    for time_s, (x_m, y_m), half in zip(times_s.tolist(), places.tolist(), (0.5 * poses[:, 2]).tolist(), strict=True):
        yield f"{time_s:.6f} {x_m:.6f} {y_m:.6f} 0 0 0 {np.sin(half):.9f} {np.cos(half):.9f}"


class NextRange(NamedTuple):
    """The range that reduces the error of a map most, and the expected error before and after it."""

    ends: tuple[int, int]  # beacon and place, or two motes
    before_m: float  # root mean square error of a position, after the best rigid alignment of the map
    after_m: float


def next_range(
    points_m: FloatArray, covariance_m2: FloatArray, ends: np.ndarray, ways_m: FloatArray, sigmas_m: FloatArray
) -> NextRange | None:
    """The best of m possible ranges: tr P falls by |P h|^2 / (h^T P h + sigma^2); None with fewer than three points.

    ``points_m``: of the map, shape (n, d). ``covariance_m2``: shape (n d, n d). ``ends``: of each range, shape (m, 2);
    an end of n or more is a known place, not a point of the map. ``ways_m``: vectors from the second end to the first,
    shape (m, d). ``sigmas_m``: shape (m,).
    """
    count, d = points_m.shape
    if count < 3 or not len(ends):
        return None
    modes = rigid_modes(points_m)
    P = covariance_m2 - modes @ (modes.T @ covariance_m2)
    P = P - (P @ modes) @ modes.T
    u = ways_m / np.maximum(np.linalg.norm(ways_m, axis=1), 1e-9)[:, None]
    blocks = np.concatenate([P.reshape(count * d, count, d), np.zeros((count * d, 1, d))], axis=1)
    first, second = np.minimum(ends, count).T
    # P h of each range, shape (n d, m); an end that is not a point of the map contributes zero.
    Ph = np.einsum("amk,mk->am", blocks[:, first] - blocks[:, second], u)
    rows = np.concatenate([Ph.reshape(count, d, -1), np.zeros((1, d, len(u)))])
    at = np.arange(len(u))
    hPh = ((rows[first, :, at] - rows[second, :, at]) * u).sum(axis=1)
    gains = (Ph**2).sum(axis=0) / (hPh + sigmas_m**2)
    best, total = int(np.argmax(gains)), float(np.trace(P))
    after_m = float(np.sqrt(max(total - float(gains[best]), 0.0) / count))
    return NextRange((int(ends[best, 0]), int(ends[best, 1])), float(np.sqrt(max(total, 0.0) / count)), after_m)


def next_reading(track: EstimatedPath, noise: RadioNoiseConfig) -> dict[str, Any] | None:
    """The best beacon and place for the next range, and its effect; None with fewer than three beacons."""
    names, count = list(track.beacons), len(track.beacons)
    points = np.array([track.beacons[name][:2] for name in names]).reshape(-1, 2)
    places = track.poses[np.unique(np.linspace(0, len(track.poses) - 1, _PLACES).astype(int)), :2]
    which, where = np.divmod(np.arange(count * len(places)), len(places))
    ways = points[which] - places[where]
    sigmas = np.sqrt(range_variance(noise, np.linalg.norm(ways, axis=1)))
    found = next_range(points, track.map_covariance, np.column_stack([which, count + where]), ways, sigmas)
    if found is None:
        return None
    beacon, place = found.ends
    from_m: list[float] = places[place - count].tolist()
    return {"beacon": names[beacon], "from_m": from_m, "map_m": found.before_m, "after_m": found.after_m}


def reviewed(run: RecordedRun, track: EstimatedPath, noise: RadioNoiseConfig) -> dict[str, Any]:
    """Residuals, errors of predicted ranges and the best next measurement, for JSON of ``ccatp radio slam``."""
    residuals = residuals_by_beacon(run, range_residuals(run, track, noise.camera_field_rad))
    found = predicted(run, track, noise.camera_field_rad)
    predictions = None if found is None else found._asdict()
    return {"residuals": residuals, "predictions": predictions, "measure_next": next_reading(track, noise)}


def review_lines(data: Mapping[str, Any]) -> Iterator[str]:
    """The data of ``reviewed`` as lines of text."""
    if data["residuals"]:
        yield ""
        yield f"{'beacon':<8} {'ranges':>9} {'median_m':>9} {'sigma_m':>8}"
        for name, one in data["residuals"].items():
            yield f"{name:<8} {one['readings']:9.0f} {one['median_m']:9.3f} {one['sigma_m']:8.3f}"
    yield from prediction_lines(data["predictions"])
    if (advice := data["measure_next"]) is not None:
        x_m, y_m = advice["from_m"]
        yield ""
        yield (
            f"measure next: beacon {advice['beacon']} from ({x_m:.2f}, {y_m:.2f}); the map's expected error falls from "
            f"{advice['map_m']:.3f} to {advice['after_m']:.3f} m"
        )
