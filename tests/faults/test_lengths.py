"""Faults of single lengths: what is found, located, marked; false alarms of whole surveys; a laser at rest."""

import re
from collections import Counter
from math import dist
from typing import NamedTuple

import numpy as np
import pytest

from ccatp.core import Fix, FloatArray
from ccatp.mirror.fix_judgement import FixJudge
from ccatp.mirror.multilateration import MultilaterationError
from ccatp.survey.laser_follow import LaserFollow
from tests.faults.linking import Measured
from tests.support.length_surveys import Alarms, alarms, places
from tests.support.scenario import MIRRORS, config_of, world_of

HEIGHT_M = 0.05
SINGLE_M = 1e-4  # limit of the error of a fix by one undetected channel
KINDS = ("offset", "drift", "frozen", "huge", "rounded", "scaled", "all long", "one place", "noise", "fewer")


def first_of(found: Alarms) -> FloatArray:
    first: FloatArray = np.minimum.reduce(found)
    return first


@pytest.mark.parametrize(
    ("mirror", "runs", "points"),
    [
        *((name, 300, 200) for name in MIRRORS[:1]),
        *(pytest.param(n, 2000, 800, marks=pytest.mark.slow) for n in MIRRORS),
    ],
)
def test_false_alarms_of_a_survey(mirror: str, runs: int, points: int) -> None:
    """At most 1 % of the surveys have any alarm: within the 99.9 % band of that share."""
    world = world_of(mirror)
    pucks = np.resize(places(world.mirror, HEIGHT_M), (points, 3))
    found = first_of(alarms(world.cfg.etalon, world.mirror.collimators_m, pucks, runs, np.random.default_rng(1)))
    count = int(np.isfinite(found).sum())
    expected = 0.01 * runs * points / 800
    assert count <= expected + 3.1 * expected**0.5 + 1.0


@pytest.mark.fault("E11")
@pytest.mark.parametrize("channel", range(8))
def test_a_channel_that_changes_by_five_sigma_warns_within_twenty_points(channel: int, measured: Measured) -> None:
    """After 100 points, which have calibrated the network."""
    world, begin = world_of("fyst-m2"), 100
    cfg, collimators = world.cfg.etalon, np.asarray(world.mirror.collimators_m)
    pucks = places(world.mirror, HEIGHT_M)[: begin + 20]
    sigma_m = cfg.length_sigma_m + cfg.length_sigma_per_m * np.linalg.norm(pucks[begin] - collimators[channel])

    def fault(number: int, lengths: FloatArray) -> FloatArray:
        changed = lengths.copy()
        changed[:, channel] += 5.0 * sigma_m * (number >= begin)
        return changed

    found = first_of(alarms(cfg, collimators, pucks, 100, np.random.default_rng(2), fault))
    measured("E11", float(np.max(found)) - begin + 1.0)
    assert np.isfinite(found).all()


@pytest.mark.parametrize("channel", range(8))
def test_an_error_since_the_first_fix_beyond_the_priors_warns_within_twenty_points(channel: int) -> None:
    """Ten sigma of a length: the random errors of the network hide five in most surveys where a channel is alone."""
    world = world_of("fyst-m2")
    cfg, collimators = world.cfg.etalon, np.asarray(world.mirror.collimators_m)
    pucks = places(world.mirror, HEIGHT_M)[:20]
    sigma_m = cfg.length_sigma_m + cfg.length_sigma_per_m * np.linalg.norm(pucks[0] - collimators[channel])

    def fault(_: int, lengths: FloatArray) -> FloatArray:
        changed = lengths.copy()
        changed[:, channel] += 10.0 * sigma_m
        return changed

    found = first_of(alarms(cfg, collimators, pucks, 100, np.random.default_rng(5), fault))
    assert np.isfinite(found).sum() >= 95


def test_the_constant_error_of_a_channel_is_named_with_its_size() -> None:
    world = world_of("fyst-m2")
    cfg, rng, error_m = world.cfg.etalon, np.random.default_rng(6), 16e-6
    collimators = dict(zip(world.mirror.channels, np.asarray(world.mirror.collimators_m), strict=True))
    judge, bad, warnings = FixJudge(cfg, collimators), world.mirror.channels[3], list[str]()
    for puck in places(world.mirror, HEIGHT_M)[:20]:
        lengths = {
            channel: float(np.linalg.norm(there - puck)) + 1e-6 * rng.standard_normal() + error_m * (channel == bad)
            for channel, there in collimators.items()
        }
        warnings += judge.fix(0.0, tuple(puck.tolist()), lengths).warnings
    (warning,) = warnings
    found = re.fullmatch(rf"channel {bad} has read \+([\d.]+) um from the others since the first fix.*", warning)
    assert found is not None
    assert float(found[1]) == pytest.approx(1e6 * error_m, rel=0.3)  # the network's own error is 2.4 um a channel


def test_noise_larger_than_configured_warns_within_twenty_points() -> None:
    world = world_of("fyst-m2")
    rng, cfg = np.random.default_rng(3), world.cfg.etalon
    pucks = places(world.mirror, HEIGHT_M)[:20]

    def fault(_: int, lengths: FloatArray) -> FloatArray:
        return lengths + 1.7 * 2.5e-6 * rng.standard_normal(lengths.shape)

    assert np.isfinite(first_of(alarms(cfg, world.mirror.collimators_m, pucks, 100, rng, fault))).all()


class Walk(NamedTuple):
    """The fixes of a walk with a fault: the largest error over its protection level, and what was said."""

    fixes: list[Fix]
    worst: float
    refused: int
    is_followed: bool


def attack(kind: str, count: int, rng: np.random.Generator) -> Walk:
    """Twelve places, a fault from a random one on; ``count`` valid channels."""
    world = world_of(str(rng.choice(MIRRORS)))
    cfg, mirror = world.cfg, world.mirror
    collimators = dict(zip(mirror.channels, np.asarray(mirror.collimators_m), strict=True))
    judge, follow = FixJudge(cfg.etalon, collimators), LaserFollow(cfg)
    driver = Driver(follow)
    channels = sorted(rng.choice(mirror.channels, count, replace=False).tolist())
    all_places = places(mirror, HEIGHT_M)
    start = int(rng.integers(0, len(all_places) - 12))
    begin, bad = int(rng.integers(0, 8)), int(rng.choice(channels))
    size_m = float(10.0 ** rng.uniform(-4.0, 0.5)) * float(rng.choice((-1.0, 1.0)))
    fixes, worst, refused, is_followed, held = [], 0.0, 0, True, dict[int, float]()
    for number, puck in enumerate(all_places[start : start + 12]):
        is_faulty = number >= begin
        there = all_places[start + begin] if kind == "one place" and is_faulty else puck
        lengths = {}
        for channel in channels:
            length = float(np.linalg.norm(collimators[channel] - there))
            noise = (1e-6 + 2.5e-7 * length) * float(rng.standard_normal())
            lengths[channel] = length + noise * (8.0 if kind == "noise" and is_faulty else 1.0)
        if is_faulty:
            wrong = {
                "offset": lengths[bad] + size_m,
                "drift": lengths[bad] + 0.1 * size_m * (number - begin),
                "frozen": held.setdefault(bad, lengths[bad]),
                "huge": float(rng.choice((1e5, 1e-9, 9e5))),
                "scaled": lengths[bad] * (1.0 + 0.1 * size_m),
            }
            if kind in wrong:
                lengths[bad] = wrong[kind]
            if kind == "rounded":
                lengths = {
                    channel: round(value / abs(size_m) * 10.0) * abs(size_m) / 10.0
                    for channel, value in lengths.items()
                }
            if kind == "all long":
                lengths = {channel: value + size_m for channel, value in lengths.items()}
        try:
            fix = judge.fix(1.0, tuple((puck + rng.normal(scale=1e-3, size=3)).tolist()), lengths)
        except MultilaterationError:
            refused += 1
            continue
        if number:
            driver.move()
        follow.begin()
        if follow.doubt(fix):
            is_followed = False
            continue
        fixes.append(fix)
        error_m = dist(fix.position_m, puck)
        if fix.metrology == "good" and fix.protection_m is not None:
            # One faulty channel must not use the wider limit of an error that all lengths have in common.
            limit_m = fix.protection_m if kind == "all long" else min(fix.protection_m, SINGLE_M)
            worst = max(worst, error_m / limit_m)
    return Walk(fixes, worst, refused, is_followed)


class Driver:
    """Gives samples of motion to a test of the laser, with times that rise."""

    def __init__(self, follow: LaserFollow) -> None:
        self._follow, self._t_s = follow, 0.0

    def move(self) -> None:
        """A turn, then a leg."""
        for rate_rad_s, wheel_rad_s in ((0.5, 0.0), (0.0, 5.0)):
            for _ in range(200):
                self._t_s += 0.01
                self._follow.add([(self._t_s, 0.0, rate_rad_s)], [(self._t_s, wheel_rad_s, wheel_rad_s)])


def verdict(walk: Walk) -> str:
    """Silently wrong: a fix that counts as good is wrong beyond its limit, and nothing was said in the walk."""
    is_reported = (
        walk.refused
        or not walk.is_followed
        or any(fix.warnings or fix.left_out or fix.metrology != "good" for fix in walk.fixes)
    )
    if is_reported:
        return "reported, a fix is wrong" if walk.worst > 1.0 else "handled"
    return "silently wrong" if walk.worst > 1.0 else "within its limits"


@pytest.mark.fault("E12")
@pytest.mark.parametrize(("seed", "count"), [(1, 2), pytest.param(2, 30, marks=pytest.mark.slow)])
def test_attacks_on_lengths(seed: int, count: int, measured: Measured) -> None:
    rng = np.random.default_rng(seed)
    found = Counter(
        (kind, verdict(attack(kind, int(rng.integers(4, 9)) if kind == "fewer" or k % 2 else 8, rng)))
        for kind in KINDS
        for k in range(count)
    )
    print({f"{kind}: {what}": n for (kind, what), n in sorted(found.items())})
    measured("E12", float(sum(n for (_, what), n in found.items() if what == "silently wrong")))


def test_a_laser_at_rest_is_certain_at_the_third_standstill_and_never_used() -> None:
    follow = LaserFollow(config_of())
    fix = Fix(0.0, (1.0, 2.0, 3.0), (1e-12, 0, 0, 0, 1e-12, 0, 0, 0, 1e-12), 1.0, (1, 2, 3, 4), 0.0)
    driver, found = Driver(follow), []
    for _ in range(3):
        follow.begin()
        found.append((bool(follow.doubt(fix)), follow.is_certain))
        driver.move()
    assert found == [(False, False), (True, False), (True, True)]
    follow.begin()
    elsewhere = Fix(0.0, (1.0, 2.3, 3.0), fix.covariance_m2, 1.0, fix.channels, 0.0)
    assert not follow.doubt(elsewhere)  # what releases it
    assert follow.standstills == 1
    assert not follow.is_certain
