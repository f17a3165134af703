"""Where the radios of a vehicle are, by their ranges on a known path: a check of the places that were given."""

from collections.abc import Iterator, Mapping

import numpy as np

from ccatp.beacons.estimation.recording import EstimatedPath, RecordedRun
from ccatp.core import FloatArray

FEWEST = 100  # ranges of a radio
LEAST_ARM_M = 0.15  # above the error of the ranges
BETTER = 0.8  # of the misfit that remains with the other place
SURE = 10.0  # standard errors of white ranges: those of correlated ones are several times larger
ASIDE = 0.5  # of a place error, up to which it is along the way
STEPS = 10  # of the reweighting


def misplaced_radios(
    run: RecordedRun, poses: FloatArray, places_m: Mapping[str, tuple[float, float]], what: str
) -> Iterator[str]:
    """A warning for each radio whose ranges fit far better to another place of it on the vehicle.

    ``poses``: at the readings, NaN where it is not known, shape (m, 3). ``places_m``: of the beacons. ``what`` these
    are, for the message.
    """
    r = run.readings
    nowhere = (np.nan, np.nan)
    beacons = np.array([places_m.get(name, nowhere) for name in run.beacon_ids]).reshape(-1, 2)
    way = beacons[r.beacon] - r.radios_at(poses)
    # With a bearing it is no radio but a camera, whose ranges depend on the direction.
    known = (
        np.isfinite(r.range_m) & ~np.isfinite(r.bearing_rad) & np.isfinite(way).all(axis=1) & np.isfinite(poses[:, 2])
    )
    for k, radio in enumerate(run.radios):
        rows = known if r.tag is None else known & (r.tag == k)
        if rows.sum() < FEWEST:
            continue
        arm_m = _better_place(way[rows], poses[rows, 2], r.range_m[rows])
        if arm_m is None:
            continue
        ahead_m, left_m = run.antenna_m + arm_m if radio is None else np.array(radio[1:]) + arm_m
        name, given = ("the radio", run.antenna_m) if radio is None else (f"tag {radio.name}", radio[1:])
        ahead = f"{abs(ahead_m):.2g} m {'ahead' if ahead_m >= 0.0 else 'behind'}"
        left = f"{abs(left_m):.2g} m to the {'left' if left_m >= 0.0 else 'right'}"
        # At a constant speed a radio behind its place is like ranges that are late; only a place aside is none.
        along = abs(arm_m[1]) < ASIDE * abs(arm_m[0])
        late = f", or are the ranges {'late' if arm_m[0] < 0.0 else 'early'}" if along else ""
        yield (
            f"ranges fit {what} better if {name} is about {ahead} and {left} of the vehicle's origin, not at "
            f"{given[0]:.3g} and {given[1]:.3g} m (ahead, left): is its place given rightly{late}?"
        )


def radio_doubts(run: RecordedRun, track: EstimatedPath) -> list[str]:
    """The same for an estimated path and map of a vehicle with several radios: one alone may be anywhere."""
    if not run.tags:
        return []
    places_m = {name: (fix.x_m, fix.y_m) for name, fix in track.beacons.items()}
    return list(misplaced_radios(run, track.poses_at(run.readings.times_s), places_m, "path and map"))


def _better_place(way: FloatArray, heading_rad: FloatArray, range_m: FloatArray) -> FloatArray | None:
    """Error of a radio's place, ahead and left, m, shape (2,), by a robust fit; None if it explains little.

    Errors of the ranges are e = offset + scale r - u (place error turned by the heading), with u towards the beacon.
    """
    far_m = np.maximum(np.hypot(*way.T), 1e-3)
    u, v = (way / far_m[:, None]).T
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    calibration = np.column_stack([np.ones(far_m.size), far_m])
    _, misfit_m, _ = robust_fit(calibration, range_m - far_m)
    arms = np.column_stack([-(c * u + s * v), -(c * v - s * u), calibration])
    found, better_m, sigmas = robust_fit(arms, range_m - far_m)
    far = np.hypot(*found[:2])
    if far < LEAST_ARM_M or better_m > BETTER * misfit_m or far < SURE * np.hypot(*sigmas[:2]):
        return None
    return found[:2]


def robust_fit(H: FloatArray, e: FloatArray) -> tuple[FloatArray, float, FloatArray]:
    """Terms of a fit with Cauchy's weights, the median of its absolute residuals, and standard errors of the terms."""
    weights, found, scale = np.ones(e.size), np.zeros(H.shape[1]), 0.0
    spread: FloatArray = np.eye(H.shape[1])
    for _ in range(STEPS):
        normal = H.T @ (weights[:, None] * H) + 1e-9 * np.eye(H.shape[1])
        spread = np.asarray(np.linalg.inv(normal))
        found = spread @ (H.T @ (weights * e))
        off = np.abs(e - H @ found)
        scale = max(1.4826 * float(np.median(off)), 1e-6)
        weights = 1.0 / (1.0 + (off / scale) ** 2)
    return found, scale / 1.4826, scale * np.sqrt(spread.diagonal())
