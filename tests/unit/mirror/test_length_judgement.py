"""Lengths at the limits of the tests: few and changing channels, no priors, impossible numbers, special geometries."""

from collections.abc import Callable, Mapping, Sequence
from math import inf, isfinite, nan
from typing import NamedTuple

import numpy as np
import pytest

from ccatp.config.models import EtalonConfig
from ccatp.core import Fix, FloatArray
from ccatp.mirror.fix_judgement import FixJudge
from ccatp.mirror.length_integrity import NetworkCalibration
from ccatp.mirror.length_watch import constant_limit
from ccatp.mirror.multilateration import MultilaterationError
from tests.support.cases import slow_case
from tests.support.length_surveys import places
from tests.support.scenario import world_of

HEIGHT_M = 0.05
WORLD = world_of("fyst-m2")
CFG = WORLD.cfg.etalon
CHANNELS = WORLD.mirror.channels
COLLIMATORS = dict(zip(CHANNELS, np.asarray(WORLD.mirror.collimators_m), strict=True))
PLACES = places(WORLD.mirror, HEIGHT_M)
NO_PRIORS = CFG.model_copy(update={"collimator_sigma_m": 0.0, "offset_sigma_m": 0.0, "refraction_sigma": 0.0})
WIDE_PRIORS = CFG.model_copy(update={"collimator_sigma_m": 1.0, "offset_sigma_m": 1.0, "refraction_sigma": 0.1})
Lengths = dict[int, float]


class Walk(NamedTuple):
    """The fixes of a walk, the numbers of the fixes that were refused, and the constant errors at its end."""

    fixes: list[Fix]
    refused: list[int]
    constant: FloatArray

    @property
    def warnings(self) -> list[str]:
        return [warning for fix in self.fixes for warning in fix.warnings]


def lengths_of(
    cfg: EtalonConfig, puck: FloatArray, rng: np.random.Generator, there: Mapping[int, FloatArray]
) -> Lengths:
    found = {}
    for channel, collimator in there.items():
        length = float(np.linalg.norm(collimator - puck))
        sigma_m = cfg.length_sigma_m + cfg.length_sigma_per_m * length
        found[channel] = length + sigma_m * float(rng.standard_normal())
    return found


def walk(
    cfg: EtalonConfig,
    count: int,
    change: Callable[[int, Lengths, np.random.Generator], Lengths] = lambda _, lengths, __: lengths,
    *,
    collimators: Mapping[int, FloatArray] = COLLIMATORS,
    pucks: Sequence[FloatArray] = tuple(PLACES),
) -> Walk:
    rng, judge = np.random.default_rng(1), FixJudge(cfg, collimators)
    fixes, refused = [], []
    for number in range(count):
        puck = pucks[number % len(pucks)]
        lengths = change(number, lengths_of(cfg, puck, rng, collimators), rng)
        try:
            fixes.append(judge.fix(float(number), tuple(puck.tolist()), lengths))
        except MultilaterationError:
            refused.append(number)
    return Walk(fixes, refused, judge._integrity.network.constant_errors()[0])


def first(count: int) -> Callable[[int, Lengths, np.random.Generator], Lengths]:
    return lambda _, lengths, __: {channel: lengths[channel] for channel in CHANNELS[:count]}


def some(_: int, lengths: Lengths, rng: np.random.Generator) -> Lengths:
    kept = rng.choice(CHANNELS, int(rng.integers(4, 9)), replace=False).tolist()
    return {channel: lengths[channel] for channel in kept}


SETS = {
    **{f"{count} valid": first(count) for count in range(4, 9)},
    "changing": some,
    "one never": lambda _, lengths, __: {channel: lengths[channel] for channel in CHANNELS[1:]},
    "one from the middle on": lambda k, lengths, __: {c: lengths[c] for c in CHANNELS if k > 30 or c != CHANNELS[0]},
    "one until the middle": lambda k, lengths, __: {c: lengths[c] for c in CHANNELS if k < 30 or c != CHANNELS[0]},
}


@pytest.mark.parametrize("change", SETS.values(), ids=[*SETS])
@pytest.mark.parametrize("cfg", [CFG, NO_PRIORS, WIDE_PRIORS], ids=["priors", "no priors", "wide priors"])
def test_good_lengths_of_any_channels_give_fixes_without_a_warning(
    cfg: EtalonConfig, change: Callable[[int, Lengths, np.random.Generator], Lengths]
) -> None:
    """Warnings of numpy are errors here; no alarm in sixty fixes is the case in 99.9 % of the walks."""
    found = walk(cfg, 60, change)
    assert found.refused == []
    assert found.warnings == []
    assert {fix.metrology for fix in found.fixes} <= {"good", "unchecked"}
    for fix in found.fixes:
        assert (fix.metrology == "good") is (len(fix.channels) > 4)
        assert all(map(isfinite, (*fix.position_m, *fix.covariance_m2)))
    assert np.isfinite(found.constant).all()
    assert np.max(np.abs(found.constant)) < constant_limit(cfg, len(CHANNELS))


@pytest.mark.parametrize("cfg", [CFG, NO_PRIORS, WIDE_PRIORS], ids=["priors", "no priors", "wide priors"])
def test_constant_errors_are_standard_normal_with_changing_channels_and_zero_without_information(
    cfg: EtalonConfig,
) -> None:
    runs, rng, collimators = 400, np.random.default_rng(2), np.array([*COLLIMATORS.values()])
    network = NetworkCalibration(cfg, len(collimators))
    assert network.constant_errors()[0].tolist() == [0.0] * len(collimators)  # before the first fix
    error = rng.standard_normal((runs, len(network.mean))) * np.sqrt(np.diag(network.covariance))
    network.mean = np.zeros_like(error)
    for puck in PLACES[::5][:40]:
        rows = sorted((1 + rng.choice(7, int(rng.integers(4, 8)), replace=False)).tolist())  # never the first one
        offsets = puck - collimators[rows]
        distances = np.linalg.norm(offsets, axis=1)
        directions, sigmas = offsets / distances[:, None], cfg.length_sigma_m + cfg.length_sigma_per_m * distances
        noise = rng.standard_normal((runs, len(rows))) * sigmas
        parity = network.parity(rows, directions, distances, sigmas)
        lengths = noise + error @ network.design(rows, directions, distances).T
        network.correct(parity, network.innovation(parity, lengths))
    standardised, errors_m = network.constant_errors()
    assert not standardised[:, 0].any()
    assert not errors_m[:, 0].any()
    # The mean square of 400 standard normal values is within five of its sigmas, sqrt(2 / 400).
    assert np.mean(standardised[:, 1:] ** 2, axis=0) == pytest.approx(np.ones(7), abs=0.36)


IMPOSSIBLE = [nan, inf, -inf, 1e308, -1e308, 1e30, 1e7, 0.0, -5.0, 1e-320]


@pytest.mark.parametrize("value", IMPOSSIBLE)
@pytest.mark.parametrize("wrong", [1, 4, 5, 8])
def test_impossible_lengths_are_left_out_or_refuse_the_fix(value: float, wrong: int) -> None:
    found = walk(CFG, 3, lambda _, lengths, __: lengths | dict.fromkeys(CHANNELS[:wrong], value))
    if len(CHANNELS) - wrong < 4:
        assert found.refused == [0, 1, 2]
        return
    assert [fix.left_out for fix in found.fixes] == [CHANNELS[:wrong]] * 3
    assert len(found.warnings) == wrong  # once, not at each fix
    for fix in found.fixes:
        assert np.linalg.norm(np.array(fix.position_m) - PLACES[int(fix.t_s)]) < 1e-4


@pytest.mark.parametrize("expected", [(nan, nan, nan), (inf, 0.0, 0.0), (1e308, 1e308, 1e308)])
def test_an_expected_place_that_cannot_be_refuses_the_fix(expected: tuple[float, float, float]) -> None:
    lengths = lengths_of(CFG, PLACES[0], np.random.default_rng(1), COLLIMATORS)
    with pytest.raises(MultilaterationError):
        FixJudge(CFG, COLLIMATORS).fix(0.0, expected, lengths)


def test_lengths_that_are_repeated_to_the_last_digit_are_no_new_evidence_against_a_channel() -> None:
    kept: Lengths = {}

    def repeated(number: int, lengths: Lengths, _: np.random.Generator) -> Lengths:
        kept.update(lengths if number <= 10 else {})
        return dict(kept)

    found = walk(CFG, 200, repeated, pucks=[PLACES[0]])
    assert found.warnings == []
    assert np.array_equal(found.constant, walk(CFG, 11, pucks=[PLACES[0]]).constant)


@pytest.mark.parametrize("count", range(4, 9))
@pytest.mark.parametrize("bad", [*CHANNELS[:2], *map(slow_case, CHANNELS[2:4])])
@pytest.mark.parametrize("begin", [0, 30])
def test_a_warning_names_the_wrong_channel_among_those_that_it_cannot_distinguish(
    count: int, bad: int, begin: int
) -> None:
    """With few lengths all channels explain an error nearly equally well; a single name would be a guess."""
    error_m = 1.6e-5

    def change(number: int, lengths: Lengths, rng: np.random.Generator) -> Lengths:
        kept = first(count)(number, lengths, rng)
        return kept | {bad: kept[bad] + error_m * (number >= begin)}

    found = [text for text in walk(CFG, 60, change).warnings if "since the first fix" in text or "changed" in text]
    for text in found:
        assert f" {bad} " in text.replace(",", " ")
    if count < 6:
        assert not any(text.startswith(("channel", "the length of channel")) for text in found)


def ring(count: int) -> dict[int, FloatArray]:
    """Collimators around an axis: an error that all lengths have in common moves a puck on it, and does not show."""
    angles = 2.0 * np.pi * np.arange(count) / count
    return {k + 1: np.array([3.0 * np.cos(a), 3.0 * np.sin(a), 4.0]) for k, a in enumerate(angles)}


@pytest.mark.parametrize("cfg", [CFG, NO_PRIORS], ids=["priors", "no priors"])
@pytest.mark.parametrize("count", [5, 6, 8])
@pytest.mark.parametrize("error_m", [0.0, 1e-3])
def test_an_error_that_does_not_show_has_no_protection_and_explains_nothing(
    cfg: EtalonConfig, count: int, error_m: float
) -> None:
    def change(_: int, lengths: Lengths, __: np.random.Generator) -> Lengths:
        return lengths | {2: lengths[2] + error_m}

    found = walk(cfg, 10, change, collimators=ring(count), pucks=[np.zeros(3)])
    assert found.refused == []
    for fix in found.fixes:
        assert fix.protection_m is None
        assert np.linalg.norm(fix.position_m) < 2e-3
        if error_m and count > 5:
            assert fix.left_out in ((2,), ())
        assert fix.metrology == ("unreliable" if error_m and not fix.left_out else "good")
