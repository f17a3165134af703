"""Simulated runs among beacons, each with chosen traits of real recordings that violate the estimators' assumptions."""

from collections.abc import Collection
from dataclasses import dataclass
from math import atan2, cos, exp, hypot, pi, sin

import numpy as np

from ccatp.beacons.estimation.recording import Readings, RecordedRun, ReferencePath, Steps, antenna_path, running_total
from ccatp.core import FloatArray
from ccatp.kinematics import wrap_pi

TRAITS = {
    "correlated": "range errors of each beacon last for 1 to 20 s",
    "scale": "scales of odometry and ranges are wrong, and that of the odometry varies slowly",
    "outliers": "0.9 % of the ranges are wrong by up to 5 m",
    "lateral": "the vehicle also moves sideways, and its odometry reads that",
    "heights": "beacons are above the antenna, which is not at the vehicle's origin; neither is known",
    "reflected": "ranges of one beacon are too long for tens of seconds",
    "single": "one beacon alone, and long straight drives",
    "far": "all beacons are far outside the path, on one side",
    "rates": "the odometry is reported at 200 Hz, in ticks of a millimetre",
}
LONG_S = 150.0
FINE_S = 0.005  # of the true motion
_ODOMETRY_S = 0.1
_OUTLIERS, _OUTLYING_M = 0.009, 5.0
_FIRST_POSE = (0.05, 0.05, 0.05)  # standard deviations of its error: x and y, m; heading, rad
_TICK_M, _TICK_RAD = 1e-3, 2e-3  # of the odometry at 200 Hz


@dataclass(frozen=True, slots=True)
class _Motion:
    """The true motion: ``times_s`` (n + 1,), poses x_m, y_m, heading_rad (n + 1, 3), and its steps, each (n,)."""

    times_s: FloatArray
    poses: FloatArray
    distance_m: FloatArray
    lateral_m: FloatArray
    turn_rad: FloatArray


def trait_run(traits: Collection[str], seed: int) -> RecordedRun:
    """A run of two and a half minutes in a room of 8 to 25 m with some of ``TRAITS``; the same for equal arguments.

    Noise and calibration errors without a trait are drawn within those of the format ``csv`` of recordings.toml. The
    first pose differs from the truth as its prior there says, or a consistent covariance would be too large.
    Raises ValueError: there is no such trait.
    """
    for name in traits:
        if name not in TRAITS:
            raise ValueError(f"there is no trait {name!r}; there are {', '.join(TRAITS)}")
    rng = np.random.default_rng(seed)
    room_m = np.array((1.0, 0.7)) * float(rng.uniform(8.0, 25.0))
    motion = _driven(room_m, rng, is_sideways="lateral" in traits, is_straight="single" in traits)
    steps = _odometry(motion, rng, traits)
    places_m = _placed(room_m, rng, traits)
    readings = _ranges(motion, places_m, rng, traits)
    x_m, y_m, heading_rad = (motion.poses[0] + rng.normal(0.0, _FIRST_POSE)).tolist()
    names = tuple(f"b{k}" for k in range(len(places_m)))
    shown = slice(None, None, round(_ODOMETRY_S / FINE_S))
    return RecordedRun(
        name=f"{'+'.join(traits) or 'plain'}, seed {seed}",
        kind="csv",
        steps=steps,
        readings=readings,
        beacon_ids=names,
        beacon_truth_m={name: (float(x), float(y)) for name, (x, y) in zip(names, places_m, strict=True)},
        truth=ReferencePath(motion.times_s[shown], *motion.poses[shown].T),
        first_pose=(x_m, y_m, heading_rad),
        warnings=(),
    )


def _driven(room_m: FloatArray, rng: np.random.Generator, *, is_sideways: bool, is_straight: bool) -> _Motion:
    """A drive to random places of the room, or back and forth along its longer side."""
    coarse_s, speed_m_s = 0.05, float(rng.uniform(0.4, 1.0))
    n = round(LONG_S / coarse_s)
    x, y = (0.5 * room_m).tolist()
    heading, goal = float(rng.uniform(-pi, pi)), np.array((x, y))
    speeds, rates = np.empty(n), np.empty(n)
    for k in range(n):
        if hypot(goal[0] - x, goal[1] - y) < 1.0:
            goal = rng.uniform(0.1, 0.9, 2) * room_m
            if is_straight:
                goal[0] = (0.9 if x < 0.5 * room_m[0] else 0.1) * room_m[0]
        off_rad = wrap_pi(atan2(goal[1] - y, goal[0] - x) - heading)
        rates[k] = max(-0.6, min(0.6, 1.5 * off_rad))
        speeds[k] = speed_m_s * (0.3 + 0.7 * exp(-2.0 * abs(off_rad)))
        heading += rates[k] * coarse_s
        x += speeds[k] * coarse_s * cos(heading)
        y += speeds[k] * coarse_s * sin(heading)
    times_s: FloatArray = FINE_S * np.arange(round(LONG_S / FINE_S) + 1, dtype=np.float64)
    share = np.repeat(np.arange(n), round(coarse_s / FINE_S))
    distance_m, turn_rad = speeds[share] * FINE_S, rates[share] * FINE_S
    side = 0.3 * np.sin(2.0 * pi * times_s[:-1] / float(rng.uniform(10.0, 40.0))) if is_sideways else 0.0
    lateral_m = distance_m * side
    start = np.array((*(0.5 * room_m), float(heading)))
    headings = start[2] + running_total(turn_rad)
    middle = headings[:-1] + 0.5 * turn_rad
    c, s = np.cos(middle), np.sin(middle)
    poses = np.column_stack([
        start[0] + running_total(distance_m * c - lateral_m * s),
        start[1] + running_total(distance_m * s + lateral_m * c),
        headings,
    ])  # fmt: skip
    return _Motion(times_s, poses, distance_m, lateral_m, turn_rad)


def _odometry(motion: _Motion, rng: np.random.Generator, traits: Collection[str]) -> Steps:
    way_scale, turn_scale, bias_rad_s = rng.normal(0.0, (0.01, 0.015, 0.004)).tolist()
    t = motion.times_s[:-1]
    scale = np.full(t.size, 1.0 + way_scale)
    if "scale" in traits:
        scale += float(rng.choice((-0.04, 0.04))) + 0.015 * np.sin(2.0 * pi * (t / 150.0 + float(rng.uniform())))
    every = 1 if "rates" in traits else round(_ODOMETRY_S / FINE_S)
    starts = np.arange(0, t.size, every)

    def added(amounts: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(amounts, starts))

    way, side, turn = added(motion.distance_m), added(motion.lateral_m), added(motion.turn_rad)
    noise = rng.standard_normal((4, len(starts)))
    travelled = np.hypot(way, side)
    measured = [
        added(motion.distance_m * scale) + 0.015 * np.sqrt(travelled) * noise[0],
        added(motion.turn_rad) * (1.0 + turn_scale)
        + bias_rad_s * every * FINE_S
        + 0.015 * np.sqrt(travelled) * noise[1]
        + 0.02 * np.sqrt(np.abs(turn)) * noise[2],
        added(motion.lateral_m * scale) + (0.01 * np.sqrt(travelled) * noise[3] if side.any() else 0.0),
    ]
    if "rates" in traits:
        measured = [
            np.diff(tick * np.floor(running_total(one) / tick))
            for one, tick in zip(measured, (_TICK_M, _TICK_RAD, _TICK_M), strict=True)
        ]
    return Steps(np.append(motion.times_s[starts], motion.times_s[-1]), *measured)


def _placed(room_m: FloatArray, rng: np.random.Generator, traits: Collection[str]) -> FloatArray:
    count = 1 if "single" in traits else int(rng.integers(4, 8))
    if "far" in traits:
        away_rad = rng.uniform(0.0, 0.5 * pi, count)
        off_m = rng.uniform(2.0, 4.0, count) * room_m[0]
        return np.asarray(0.5 * room_m + off_m[:, None] * np.column_stack([np.cos(away_rad), np.sin(away_rad)]))
    angles = 2.0 * pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    off_m = rng.uniform(0.35, 0.8, count)[:, None] * room_m
    return np.asarray(0.5 * room_m + off_m * np.column_stack([np.cos(angles), np.sin(angles)]))


def _ranges(motion: _Motion, places_m: FloatArray, rng: np.random.Generator, traits: Collection[str]) -> Readings:
    """Ranges of the beacons in turn, some of them lost."""
    count, rate_hz = len(places_m), float(rng.uniform(4.0, 8.0))
    times_s = np.arange(1, int(LONG_S * rate_hz) - 1) / rate_hz
    beacon = np.arange(times_s.size) % count
    kept = rng.random(times_s.size) > 0.2
    times_s, beacon = times_s[kept], beacon[kept]
    m = times_s.size
    poses = np.column_stack([np.interp(times_s, motion.times_s, column) for column in motion.poses.T])
    heights_m = rng.uniform(1.0, 3.0, count) if "heights" in traits else np.zeros(count)
    lever_m = (0.4, 0.2) if "heights" in traits else (0.0, 0.0)
    flat_m = places_m[beacon] - antenna_path(poses, lever_m)
    range_m = np.hypot(np.hypot(*flat_m.T), heights_m[beacon])
    scale, offset_m = rng.normal(0.0, (0.01, 0.05)).tolist()
    if "scale" in traits:
        scale += float(rng.choice((-0.05, 0.05)))
    sigma_m = float(rng.uniform(0.05, 0.12))
    error = sigma_m * rng.standard_normal(m)
    if "correlated" in traits:
        error = 0.3 * error
        for k in range(count):
            rows = np.flatnonzero(beacon == k)
            error[rows] += _lasting(times_s[rows], 2.0 * sigma_m, exp(float(rng.uniform(0.0, np.log(20.0)))), rng)
    if "reflected" in traits:
        rows = np.flatnonzero(beacon == int(rng.integers(count)))
        hidden = _lasting(times_s[rows], 1.0, 15.0, rng) > 0.0
        error[rows] += hidden * (0.5 + np.abs(_lasting(times_s[rows], 1.5, 5.0, rng)))
    if "outliers" in traits:
        wrong = rng.random(m) < _OUTLIERS
        error[wrong] += rng.uniform(-_OUTLYING_M, _OUTLYING_M, int(wrong.sum()))
    measured = np.maximum((1.0 + scale) * range_m + offset_m + error, 0.01)
    nothing = np.full(m, np.nan)
    return Readings(times_s, beacon, measured, nothing, nothing.copy())


def _lasting(times_s: FloatArray, sigma: float, lasts_s: float, rng: np.random.Generator) -> FloatArray:
    """A first-order Gauss-Markov process at rising times."""
    kept = np.exp(-np.diff(times_s) / lasts_s)
    drawn = sigma * rng.standard_normal(times_s.size)
    for k, phi in enumerate(kept.tolist(), 1):
        drawn[k] = phi * drawn[k - 1] + np.sqrt(1.0 - phi * phi) * drawn[k]
    return np.asarray(drawn)
