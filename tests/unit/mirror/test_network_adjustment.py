"""The self-calibration of the laser network: against a dense solution, what it finds, and what it leaves open."""

import re
from collections.abc import Callable, Mapping

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import multivariate_normal, norm

from ccatp.core import UNRELIABLE, FloatArray, Measured, PanelId, PointId, Vector3
from ccatp.mirror.fix_judgement import FixJudge
from ccatp.mirror.mirror_alignment import align_survey, compare
from ccatp.mirror.misalignment import PanelMisalignment, misaligned_puck_world
from ccatp.mirror.multilateration import solve_fix
from ccatp.mirror.network_adjustment import (
    NetworkResult,
    NetworkState,
    calibrate,
    change_price,
    prior_of_both,
    prior_of_many,
)
from ccatp.mirror.network_model import Effect, EffectKind, SurveyLengths, adjust, equal_effects, score_since
from ccatp.mirror.network_points import CalibratedSurveys, CommonErrors, RefinedSurvey, calibrate_surveys
from ccatp.report.network import air_text, network_data, remarks, sentence, undetermined_text
from tests.support.length_surveys import places
from tests.support.scenario import world_of

HEIGHT_M = 0.05
CFG, M1 = world_of()
COLLIMATORS = np.array(M1.collimators_m)
CHANNELS = len(COLLIMATORS)
PUCKS = places(M1, HEIGHT_M)
EVERY_FOURTH = PUCKS[::4]  # 174 points
OFFSET, COLLIMATOR, SCALE, DRIFT, VARIATION = EffectKind
Errors = Mapping[Effect, FloatArray | float]
NOTHING: Errors = {}


def lengths(
    errors: Errors,
    *,
    seed: int = 1,
    pucks: FloatArray = EVERY_FOURTH,
    noise: float | FloatArray = 1.0,
    surveys: int = 1,
    wave: Callable[[FloatArray], FloatArray] = np.zeros_like,
) -> tuple[SurveyLengths, FloatArray]:
    """Lengths with noise and these errors, and the true points, which are some mm beside the places.

    ``noise``: over the configured one, of all channels or of each. ``wave``: scale by the hours.
    """
    rng = np.random.default_rng(seed)
    points = pucks + rng.normal(size=pucks.shape) * 2e-3
    hours, survey = np.linspace(-0.5, 0.5, len(pucks)), np.arange(len(pucks)) * surveys // len(pucks)
    moved, offsets = np.zeros((len(pucks), CHANNELS, 3)), np.zeros((len(pucks), CHANNELS))
    scale = wave(hours)
    for effect, value in errors.items():
        since = slice(effect.since, None)
        if effect.kind is COLLIMATOR:
            moved[since, effect.of] += value
        elif effect.kind is OFFSET:
            offsets[since, effect.of] += value
        else:
            factor = hours[since] if effect.kind is DRIFT else 1.0
            scale[since] += np.where(survey[since] == effect.of, factor * value, 0.0)
    distances = np.linalg.norm(points[:, None] - COLLIMATORS - moved, axis=2)
    sigmas = CFG.etalon.length_sigma_m + CFG.etalon.length_sigma_per_m * distances
    found = distances * (1.0 + scale[:, None]) + offsets + noise * sigmas * rng.normal(size=distances.shape)
    return SurveyLengths(found, sigmas, COLLIMATORS, pucks, hours, survey), points


def found_in(errors: Errors, **how: object) -> NetworkResult:
    return calibrate(lengths(errors, **how)[0], CFG.etalon, CFG.align.network, CFG.align.false_alarm)  # type: ignore[arg-type]


# -- the adjustment, against a dense solution ------------------------------------------------------------------------


def test_the_adjustment_is_the_dense_least_squares_solution_of_points_and_network_together() -> None:
    step, wave = Effect(OFFSET, 2, 7), Effect(VARIATION, 1, order=2, terms=2)
    sigmas = {one: 1e-3 if one.is_of_channel else 1e-5 for one in equal_effects(CHANNELS, 2)} | {step: 1e-3, wave: 1e-5}
    errors: Errors = {Effect(COLLIMATOR, 1): np.array([1e-3, 0.0, -5e-4]), Effect(SCALE, 1): 4e-6, step: 2e-4}
    given, _ = lengths(errors, pucks=PUCKS[::50][:13], surveys=2)
    given.lengths_m[3, 5] = given.lengths_m[8, 0] = np.nan
    found = adjust(given, sigmas)
    count, valid = len(given.start_m), np.isfinite(given.lengths_m)

    def residuals(unknowns: FloatArray) -> FloatArray:
        """Written out again, length by length; scaled so that each unknown is about one."""
        points = given.start_m + unknowns[: 3 * count].reshape(-1, 3) * 1e-3
        network = unknowns[3 * count :]
        values, at = {}, 0
        for effect, sigma in sigmas.items():
            values[effect] = network[at : at + effect.size] * sigma
            at += effect.size
        rows = []
        for k in range(count):
            for i in range(CHANNELS):
                if not valid[k, i]:
                    continue
                away = np.linalg.norm(points[k] - COLLIMATORS[i] - values[Effect(COLLIMATOR, i)])
                scale = values[Effect(SCALE, int(given.survey[k]))][0]
                scale += values[Effect(DRIFT, int(given.survey[k]))][0] * given.hours[k]
                if given.survey[k] == wave.of:
                    own = given.hours[given.survey == wave.of]
                    time = given.hours[k] / (own[-1] - own[0])
                    scale -= values[wave][0] * np.cos(2.0 * np.pi * time)
                    scale += values[wave][1] * (np.sin(3.0 * np.pi * time) + 8.0 / (3.0 * np.pi**2) * time)
                length = away * (1.0 + scale) + values[Effect(OFFSET, i)][0]
                length += values[step][0] if i == step.of and k >= step.since else 0.0
                rows.append((given.lengths_m[k, i] - length) / given.sigmas_m[k, i])
        return np.array([*rows, *network])

    start = np.zeros(3 * count + len(found.values))
    dense = least_squares(residuals, start, "3-point", method="trf", xtol=1e-15, ftol=1e-15, gtol=1e-12)
    jacobian = np.asarray(dense.jac)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    units = np.concatenate([np.full(one.size, sigma) for one, sigma in sigmas.items()])
    # The oracle's Jacobian is of central differences, good to a part in 1e6.
    sigma = np.sqrt(np.diag(covariance))[3 * count :] * units
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(sigma, rel=1e-3)
    assert np.max(np.abs(dense.x[3 * count :] * units - found.values) / sigma) < 0.01
    assert np.max(np.abs(given.start_m + dense.x[: 3 * count].reshape(-1, 3) * 1e-3 - found.points_m)) < 1e-7
    whole = found.noise_m2[4] + found.moves[4] @ found.covariance @ found.moves[4].T
    assert np.diag(whole) == pytest.approx(np.diag(covariance)[12:15] * 1e-6, rel=1e-3)
    assert float(found.chi2.sum() + np.sum(found.values**2 / found.prior)) == pytest.approx(2.0 * dense.cost, rel=1e-6)


def test_the_score_is_the_chi_square_that_the_effect_takes_away() -> None:
    given, _ = lengths({Effect(OFFSET, 3, 60): 5e-6})
    sigmas = {one: 2e-6 if one.is_of_channel else 1e-7 for one in equal_effects(CHANNELS, 1)}
    without = adjust(given, sigmas)
    for base in (Effect(OFFSET, 3), Effect(COLLIMATOR, 5), Effect(SCALE, 0)):
        score = score_since(without, base, given, np.array([0, 60]))
        for first, gained in zip((0, 60), score.tolist(), strict=True):
            effect = base._replace(since=first)
            free = adjust(given, {**sigmas, effect: 10.0}, start=without)
            cost = [float(one.chi2.sum() + np.sum(one.values**2 / one.prior)) for one in (without, free)]
            assert gained == pytest.approx(cost[0] - cost[1], rel=0.01, abs=0.1)


def test_a_rigid_motion_of_all_collimators_shows_in_no_length_and_keeps_its_prior() -> None:
    given, _ = lengths(NOTHING)
    sigma = 2e-6
    found = adjust(given, {one: sigma if one.is_of_channel else 1e-7 for one in equal_effects(CHANNELS, 1)})
    collimators = slice(0, 3 * CHANNELS)
    for axis in range(3):
        shift = np.tile(np.eye(3)[axis], CHANNELS)
        turn = np.cross(np.eye(3)[axis], COLLIMATORS - COLLIMATORS.mean(axis=0)).ravel()
        for motion in (shift, turn):
            unit = motion / np.linalg.norm(motion)
            assert unit @ found.covariance[collimators, collimators] @ unit == pytest.approx(sigma**2, rel=1e-6)
            # All of it comes from the prior, and nothing from the noise.
            assert unit @ found.by_survey[collimators, collimators] @ unit == pytest.approx(0.0, abs=1e-6 * sigma**2)
    assert np.linalg.eigvalsh(found.by_survey).min() > -1e-18


# -- what is found -----------------------------------------------------------------------------------------------------

MOVE = np.array([6e-4, -4e-4, 3e-4])
CASES: dict[str, Errors] = {
    "an offset": {Effect(OFFSET, 2): 3e-4},
    "a small offset": {Effect(OFFSET, 6): -2.5e-5},
    "a moved collimator": {Effect(COLLIMATOR, 4): MOVE},
    "a scale": {Effect(SCALE, 0): 5e-6},
    "a drift": {Effect(DRIFT, 0): 1e-5},
    "a slipped channel": {Effect(OFFSET, 3, 60): 3e-4},
    "a kicked collimator": {Effect(COLLIMATOR, 5, 100): MOVE},
    "a warmer second half": {Effect(SCALE, 0, 80): 8e-6},
    "several": {Effect(OFFSET, 0): 1e-4, Effect(OFFSET, 5): -8e-4, Effect(COLLIMATOR, 1): MOVE, Effect(SCALE, 0): 5e-6},
}


@pytest.mark.parametrize("errors", CASES.values(), ids=[*CASES])
@pytest.mark.parametrize("noise", [1.0, 2.0])
def test_what_changed_is_found_with_its_size_and_nothing_else(errors: Errors, noise: float) -> None:
    if noise > 1.0 and max(np.max(np.abs(value)) for value in errors.values()) < 6e-5:
        noise = 1.2
    found = found_in(errors, noise=noise)
    assert found.state is NetworkState.CHANGED
    assert {(one.effect.kind, one.effect.of) for one in found.findings} == {(one.kind, one.of) for one in errors}
    for finding in found.findings:
        (effect,) = [one for one in errors if (one.kind, one.of) == (finding.effect.kind, finding.effect.of)]
        assert finding.alternatives == ()
        assert abs(finding.effect.since - effect.since) <= 2
        error = finding.values - errors[effect]
        # Five sigmas of a chi-square with three degrees of freedom.
        assert error @ np.linalg.solve(finding.covariance, error) < 40.0
    assert found.noise == pytest.approx(noise, rel=0.12)
    assert not found.bad_lengths.any()
    assert not found.bad_points.any()


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_a_network_as_configured_is_consistent_also_with_more_noise(noise: float) -> None:
    for seed in range(6):
        found = found_in(NOTHING, seed=seed, noise=noise, pucks=PUCKS[::8])
        assert (found.state, found.findings) == (NetworkState.CONSISTENT, ())
        assert found.is_noisy is (noise > 1.0)
        scale = Effect(SCALE, 0)
        assert abs(found.adjustment.of(scale)[0]) < 4.0 * np.sqrt(found.adjustment.covariance_of(scale)[0, 0])
        assert {one.kind for one in found.undetermined} >= {OFFSET}  # their priors are better than what the lengths say


@pytest.mark.parametrize(("noise", "factor"), [(1.0, 3.0), (2.0, 10.0)])
def test_a_noisy_channel_is_one_finding_and_keeps_its_lengths(noise: float, factor: float) -> None:
    """And the points are as uncertain as they say."""
    noises = noise * np.where(np.arange(CHANNELS) == 4, factor, 1.0)
    given, points = lengths(NOTHING, noise=noises)
    found = calibrate(given, CFG.etalon, CFG.align.network, CFG.align.false_alarm)
    assert (found.state, found.findings) == (NetworkState.CONSISTENT, ())
    assert (found.bad_lengths.sum(), found.bad_points.sum()) == (0, 0)
    assert found.channel_noise == pytest.approx(noises, rel=0.2)  # of 174 lengths
    assert np.flatnonzero(found.channel_noise > found.noise).tolist() == [4]
    assert_uncertain_as_stated(found, points)


def assert_uncertain_as_stated(found: NetworkResult, points: FloatArray) -> None:
    """The errors of the points by their covariances."""
    errors = found.adjustment.points_m - points
    whole = found.adjustment.noise_m2 + found.adjustment.moves @ found.adjustment.covariance @ np.swapaxes(
        found.adjustment.moves, 1, 2
    )
    nees = np.einsum("ka,kab,kb->k", errors, np.linalg.inv(whole), errors)
    assert 1.0 < nees.mean() < 4.0  # 3 in the mean over networks; the points of one share its errors


def test_wrong_lengths_of_a_channel_are_no_noise() -> None:
    given, _ = lengths(NOTHING)
    given.lengths_m[::20, 3] += 1e-4
    found = calibrate(given, CFG.etalon, CFG.align.network, CFG.align.false_alarm)
    assert np.flatnonzero(found.bad_lengths[:, 3]).tolist() == list(range(0, len(given.start_m), 20))
    assert (found.channel_noise == found.noise).all()


@pytest.mark.parametrize("period_min", [6.0, 25.0])
def test_a_scale_that_oscillates_is_found_and_the_points_are_computed_with_it(period_min: float) -> None:
    def wave(hours: FloatArray) -> FloatArray:
        return np.asarray(3e-6 * np.sin(2.0 * np.pi * 60.0 * hours / period_min))

    given, points = lengths(NOTHING, wave=wave, pucks=PUCKS[::2])
    found = calibrate(given, CFG.etalon, CFG.align.network, CFG.align.false_alarm)
    # The ends of the survey may be a step besides.
    assert {VARIATION} <= {one.effect.kind for one in found.findings} <= {VARIATION, SCALE}
    assert_uncertain_as_stated(found, points)
    adjusted, truth = found.adjustment, wave(given.hours)
    errors = adjusted.scale_design @ adjusted.values - truth
    assert np.sqrt(np.mean(errors**2)) < 0.4 * np.sqrt(np.mean(truth**2))
    points_of = tuple((PointId(1, 1, number), 10.0 * number) for number in range(len(points)))
    own = RefinedSurvey((), CommonErrors({}, 0), 0)
    told = CalibratedSurveys(found, M1.channels, (own,), points_of)
    shortest, longest = map(int, re.findall(r"with periods of (\d+) to (\d+) minutes", sentence(told))[0])
    assert shortest <= period_min <= longest
    # Of a sine the rms is its amplitude over the square root of two.
    (rms,) = re.findall(r"the scale of all lengths varies about its drift by (.*) ppm rms", sentence(told))
    assert float(rms) == pytest.approx(3.0 / np.sqrt(2.0), rel=0.2)
    assert sentence(told).count("scale") == 1
    assert "a variation of the scale of " in air_text(told)
    data = network_data(told)
    assert data is not None
    bands = [one["periods_min"] for one in data["findings"] if one["kind"] == "variation"]
    assert any(low <= period_min <= high for low, high in bands)


def test_panels_that_lie_in_waves_are_no_variation_of_the_scale() -> None:
    """The points are free: what the mirror looks like changes nothing of the network."""
    up = np.array(M1.rotate_world_from_deck((0.0, 0.0, 1.0)))
    waves = 2e-4 * np.sin(2.0 * np.pi * np.arange(len(EVERY_FOURTH)) / 30.0)[:, None] * up
    flat, wavy = (found_in(NOTHING, pucks=EVERY_FOURTH + one) for one in (0.0 * waves, waves))
    for found in (flat, wavy):
        assert (found.state, found.findings) == (NetworkState.CONSISTENT, ())
    sigmas = np.sqrt(np.diag(flat.adjustment.covariance))
    assert np.max(np.abs(flat.adjustment.values - wavy.adjustment.values) / sigmas) < 0.2


def test_the_prior_of_a_band_is_the_mean_of_all_by_what_the_lengths_say() -> None:
    rng = np.random.default_rng(4)
    root: FloatArray = rng.normal(size=(5, 3)) * 1e6
    information, wide = root.T @ root, 3e-6
    sigmas: FloatArray = np.array([2e-6, 1e-6, 5e-7])
    for size in (0.0, 5e-7, 2e-6):
        seen = size * rng.normal(size=3)  # by the lengths alone
        covariance = np.asarray(np.linalg.inv(information + np.eye(3) / wide**2), dtype=np.float64)
        chances = [
            chance * multivariate_normal.pdf(seen, cov=np.linalg.inv(information) + sigma**2 * np.eye(3))
            for chance, sigma in zip((0.7, 0.1, 0.1, 0.1), (0.0, *sigmas), strict=True)
        ]
        expected = np.sqrt(np.dot(chances[1:], sigmas**2) / sum(chances))
        found = prior_of_many(covariance @ information @ seen, covariance, wide, sigmas, 0.3)
        assert found == pytest.approx(expected, rel=1e-6)


USUAL, MOVED = 1e-7, 5e-6


def prior_and_interval(seen: float, sigma: float) -> tuple[float, float, float]:
    """The prior of an unknown whose value by the lengths is ``seen``, and its value and sigma with this prior."""
    variance = 1.0 / (sigma**-2 + USUAL**-2)
    prior = prior_of_both(seen * variance / sigma**2, variance, USUAL, MOVED)
    variance = 1.0 / (sigma**-2 + prior**-2)
    return prior, seen * variance / sigma**2, float(np.sqrt(variance))


def test_two_priors_count_by_what_the_lengths_say() -> None:
    assert prior_and_interval(4e-6, 3e-7)[0] == pytest.approx(MOVED, rel=1e-3)
    # Lengths that say nothing leave the chances as they were: one in ten.
    assert prior_and_interval(0.0, 1e-2)[0] == pytest.approx(np.sqrt(0.9 * USUAL**2 + 0.1 * MOVED**2), rel=1e-3)
    for seen in (0.0, 3e-7, 9e-7):
        chances = [chance * norm.pdf(seen, scale=np.hypot(one, 3e-7)) for chance, one in ((0.9, USUAL), (0.1, MOVED))]
        mean = (chances[0] * USUAL**2 + chances[1] * MOVED**2) / sum(chances)
        assert prior_and_interval(seen, 3e-7)[0] == pytest.approx(np.sqrt(mean), rel=1e-6)


@pytest.mark.parametrize("share", [0.1, 0.4])
@pytest.mark.parametrize("sigma", [3e-7, 1e-6])
def test_intervals_hold_with_two_priors(share: float, sigma: float) -> None:
    rng, inside = np.random.default_rng(8), 0
    for _ in range(4000):
        truth = rng.normal() * (MOVED if rng.random() < share else USUAL)
        _, value, own = prior_and_interval(truth + sigma * rng.normal(), sigma)
        inside += abs(value - truth) < 1.959964 * own
    assert 0.93 < inside / 4000 < 0.98


def test_the_points_of_a_changed_network_are_those_of_one_that_has_not() -> None:
    given, points = lengths({Effect(COLLIMATOR, 4): MOVE, Effect(OFFSET, 2): 3e-4})
    found = calibrate(given, CFG.etalon, CFG.align.network, CFG.align.false_alarm)
    errors = found.adjustment.points_m - points
    assert_uncertain_as_stated(found, points)
    assert np.sqrt(np.mean(errors**2)) < 5e-6


def test_two_collimators_that_agree_are_no_frame() -> None:
    rng = np.random.default_rng(5)
    found = found_in({Effect(COLLIMATOR, i): rng.normal(size=3) * 1e-3 for i in range(6)})
    assert (found.state, found.has_frame, found.findings) == (NetworkState.CHANGED, False, ())
    # The common motion is as uncertain as a collimator that may have moved.
    assert np.sqrt(found.adjustment.covariance_of(Effect(COLLIMATOR, 7)).trace()) > 1e-3


def test_too_few_points_are_no_test() -> None:
    found = found_in({Effect(OFFSET, 2): 1e-3}, pucks=PUCKS[:6])
    assert (found.state, found.findings) == (NetworkState.TOO_FEW, ())


def test_what_few_points_do_not_decide_has_its_alternatives_and_a_wide_sigma() -> None:
    found = found_in({Effect(OFFSET, 2): 3e-4}, pucks=PUCKS[:9])
    (finding,) = found.findings
    assert {finding.effect, *finding.alternatives} >= {Effect(OFFSET, 2), Effect(COLLIMATOR, 2)}
    sigma = np.sqrt(found.adjustment.covariance_of(Effect(OFFSET, 2))[0, 0])
    assert sigma > 20.0 * finding.sigma


def test_a_small_slip_is_named_as_an_offset_and_the_move_that_explains_it_as_well_as_its_alternative() -> None:
    (finding,) = found_in({Effect(OFFSET, 3, 60): 5e-5}).findings
    assert (finding.effect.kind, finding.effect.of) == (OFFSET, 3)
    assert {(one.kind, one.of) for one in finding.alternatives} <= {(COLLIMATOR, 3)}
    assert finding.size == pytest.approx(5e-5, abs=5.0 * finding.sigma)


def test_a_wrong_length_is_left_out_and_a_point_that_cannot_be_saved_is_marked() -> None:
    given, points = lengths(NOTHING)
    given.lengths_m[17, 3] += 2e-3
    given.lengths_m[40, 4:] = np.nan  # four lengths left: nothing to contradict
    given.lengths_m[50, 5:] = np.nan
    given.lengths_m[50, 1] += 1e-3  # five: a contradiction, and nobody knows where
    found = calibrate(given, CFG.etalon, CFG.align.network, CFG.align.false_alarm)
    assert np.argwhere(found.bad_lengths).tolist() == [[17, 3]]
    assert np.flatnonzero(found.bad_points).tolist() == [50]
    assert found.state is NetworkState.CONSISTENT
    assert np.linalg.norm(found.adjustment.points_m[17] - points[17]) < 3e-5


def test_two_surveys_of_one_network_have_their_own_scales() -> None:
    found = found_in({Effect(SCALE, 1): 8e-6, Effect(OFFSET, 1): 4e-4}, surveys=2)
    assert {one.effect for one in found.findings} == {Effect(SCALE, 1), Effect(OFFSET, 1)}


def test_the_price_of_a_change_is_that_of_the_largest_of_many_scores() -> None:
    """Largest score of a Brownian bridge over its first points, by simulation."""
    rng, count, chance = np.random.default_rng(3), 200, 0.05
    steps = rng.normal(size=(4000, 3, count))
    sums = np.cumsum(steps, axis=2)
    share = np.arange(1, count + 1) / count
    bridge = sums - share * sums[:, :, -1:]
    inside = slice(4, count - 5)
    largest = (np.sum(bridge**2, axis=1) / (count * share * (1.0 - share) + 1e-30))[:, inside].max(axis=1)
    share_above = float(np.mean(largest > change_price(3, chance, count)))
    assert 0.2 * chance < share_above < 1.3 * chance


# -- fixes and panels --------------------------------------------------------------------------------------------------


def survey(
    change: Callable[[int, dict[int, float]], dict[int, float]], truth: Mapping[PanelId, PanelMisalignment]
) -> list[Measured]:
    """The points of panels as the daemon measures and judges them."""
    rng = np.random.default_rng(3)
    there = dict(zip(M1.channels, COLLIMATORS, strict=True))
    judge, measured = FixJudge(CFG.etalon, there), list[Measured]()
    for panel, lies in truth.items():
        for point in M1.point_ids(panel):
            x, y = M1.point_on_deck(point)
            pose = M1.base_pose.__class__(x + float(rng.normal()) * 2e-3, y + float(rng.normal()) * 2e-3, 0.0)
            puck = misaligned_puck_world(M1, panel, lies, pose, HEIGHT_M)
            away = {channel: float(np.linalg.norm(np.array(puck) - one)) for channel, one in there.items()}
            noisy = {channel: one + (1e-6 + 2.5e-7 * one) * float(rng.normal()) for channel, one in away.items()}
            number = len(measured)
            fix = judge.fix(4.0 * number, puck, change(number, noisy))
            measured.append(Measured(point, fix))
    return measured


PANELS = [PanelId(4, 5), PanelId(5, 4), PanelId(5, 5), PanelId(6, 6)]
LIES = {panel: PanelMisalignment(40e-6 * (-1) ** k, 90e-6, -60e-6 * k) for k, panel in enumerate(PANELS)}
TRUTH: dict[PanelId, Vector3] = {panel: (one.piston_m, one.tip_rad, one.tilt_rad) for panel, one in LIES.items()}


def slipped(number: int, some: dict[int, float]) -> dict[int, float]:
    return some | {3: some[3] + 3e-4} if number >= 12 else some


def as_it_is(_: int, some: dict[int, float]) -> dict[int, float]:
    return some


@pytest.mark.parametrize("change", [as_it_is, slipped])
def test_panels_are_right_within_their_sigmas_with_and_without_a_slipped_channel(
    change: Callable[[int, dict[int, float]], dict[int, float]],
) -> None:
    measured = survey(change, LIES)
    result, network = align_survey(CFG, M1, measured, PANELS)
    assert network is not None
    against = compare(result.panels, TRUTH)
    assert against is not None
    # The simulated network is exact, so that the errors are smaller than its priors permit.
    assert 0.0 < against.chi2 < against.high
    pistons = np.array([one.fit.values[0] - TRUTH[one.panel][0] for one in result.panels])
    # The scale, which four panels hardly determine, moves all of them alike.
    assert np.std(pistons) < 1e-6
    assert abs(pistons.mean()) < 2.0 * np.mean([one.fit.sigma[0] for one in result.panels])
    plain = align_survey(CFG, M1, [one for one in measured if not one.fix.left_out], PANELS).result
    assert result.panels[0].fit.covariance == pytest.approx(plain.panels[0].fit.covariance, rel=0.5)
    # Pistons of panels share the errors of the network.
    one, other = (panel.fit for panel in result.panels[:2])
    shared = (one.common @ other.common.T)[0, 0] / (one.sigma[0] * other.sigma[0])
    assert 0.3 < shared < 1.0
    words = sentence(network)
    if change is slipped:
        assert words.startswith("The laser network has changed: channel 3 reads 3")
        assert "since about point" in words
        assert [warning for warning in remarks(network) if "channel 3" in warning]
        # All its lengths are used again, corrected.
        assert {one.fix.metrology for one in network.surveys[0].measured} == {"good"}
    else:
        assert words.startswith("The laser network is consistent: 288 lengths, noise as configured")
        assert remarks(network) == []
    assert "a common motion of all collimators, which shows in no length" in undetermined_text(network)
    data = network_data(network)
    assert data is not None
    assert data["state"] == ("changed" if change is slipped else "consistent")
    assert len(data["effects"]) == 2 * CHANNELS + 2 + (change is slipped)


def test_a_noisy_channel_is_named_with_its_factor_in_the_sentence_and_in_the_data() -> None:
    rng = np.random.default_rng(6)

    def noisy(_: int, some: dict[int, float]) -> dict[int, float]:
        return some | {3: some[3] + 2e-5 * float(rng.normal())}

    result, network = align_survey(CFG, M1, survey(noisy, LIES), PANELS)
    assert network is not None
    expected = (
        re.escape(
            "The laser network is consistent within its noise: 288 lengths, noise of the other channels as configured, "
            "in channel 3 "
        )
        + r"(.*?) times"
    )
    (factor,) = re.findall(expected, sentence(network))
    sigma_m = float(network.network.given.sigmas_m[:, M1.channels.index(3)].mean())
    assert float(factor) == pytest.approx(np.hypot(1.0, 2e-5 / sigma_m), rel=0.4)  # by 36 lengths
    assert "channel 3 have" in " ".join(remarks(network))
    data = network_data(network)
    assert data is not None
    assert [one["channel"] for one in data["noisy_channels"]] == [3]
    against = compare(result.panels, TRUTH)
    assert against is not None
    assert against.chi2 < against.high


def test_a_network_that_bends_is_not_taken_for_panels_nor_the_other_way_round() -> None:
    """The same panels, level and misaligned, give the same network; the same network bent and not, the same panels."""
    level = {panel: PanelMisalignment(0.0, 0.0, 0.0) for panel in PANELS}
    by_panels = [align_survey(CFG, M1, survey(as_it_is, lies), PANELS) for lies in (level, LIES)]
    values = [one.network.network.adjustment.values for one in by_panels if one.network is not None]
    sigma = np.sqrt(np.diag(by_panels[0].network.network.adjustment.covariance)) if by_panels[0].network else 0.0
    assert np.max(np.abs(values[1] - values[0]) / sigma) < 0.05

    def bent(_: int, some: dict[int, float]) -> dict[int, float]:
        return {channel: one + (2e-4 if channel == 6 else 0.0) for channel, one in some.items()}

    plain, moved = (align_survey(CFG, M1, survey(change, LIES), PANELS).result for change in (as_it_is, bent))
    for one, other in zip(plain.panels, moved.panels, strict=True):
        assert np.max(np.abs(one.fit.values - other.fit.values) / other.fit.sigma) < 2.5


def test_fixes_without_lengths_stay_as_they_are() -> None:
    measured = survey(as_it_is, {PANELS[0]: LIES[PANELS[0]]})
    there = dict(zip(M1.channels, COLLIMATORS, strict=True))
    some = dict(zip(measured[0].fix.channels, measured[0].fix.lengths_m, strict=True))
    old = [Measured(one.point, solve_fix(CFG.etalon, 1.0, one.fix.position_m, some, there)) for one in measured[:1]]
    assert calibrate_surveys(M1, CFG.etalon, CFG.align, [old]) is None
    found = calibrate_surveys(M1, CFG.etalon, CFG.align, [[*old, *measured[1:]]])
    assert found is not None
    assert found.surveys[0].measured[0] == old[0]
    assert found.surveys[0].unchanged == 1
    assert "1 fixes have no lengths" in remarks(found)[-1]


def test_a_survey_whose_lengths_contradict_each_other_at_a_point_does_not_use_it() -> None:
    def one_place(number: int, some: dict[int, float]) -> dict[int, float]:
        if number != 5:
            return some
        return {channel: some[channel] + (4e-4 if channel == 2 else 0.0) for channel in (1, 2, 3, 4, 5)}

    network = calibrate_surveys(M1, CFG.etalon, CFG.align, [survey(one_place, LIES)])
    assert network is not None
    assert [one.fix.metrology for one in network.surveys[0].measured].count(UNRELIABLE) == 1
    assert network.surveys[0].measured[5].fix.metrology == UNRELIABLE


def test_a_slip_in_the_second_of_two_surveys_is_said_to_be_there() -> None:
    surveys = [survey(change, LIES) for change in (as_it_is, slipped)]
    network = align_survey(CFG, M1, surveys[1], PANELS, surveys[:1]).network
    text = sentence(network)
    assert text.startswith("The laser network has changed: channel 3 reads 3")
    assert " of survey 2 (" in text


def drifting(number: int, some: dict[int, float]) -> dict[int, float]:
    return some | {5: some[5] + 2e-5 * number}


def test_a_channel_that_drifts_is_told_as_one_that_changes_often() -> None:
    """A drift of one channel is not in the model: one line states its parts, and the panels are right."""
    measured = survey(drifting, LIES)
    result, network = align_survey(CFG, M1, measured, PANELS)
    assert network is not None
    assert {one.effect.of for one in network.network.findings} == {4}
    text = sentence(network)
    assert text.startswith("The laser network has changed: channel 5 changes ")
    assert " times, by up to " in text
    assert ": it drifts or is noisy, or its collimator moves (" in text
    against = compare(result.panels, TRUTH)
    assert against is not None
    assert against.chi2 < against.high


def slipped_all_along(_: int, some: dict[int, float]) -> dict[int, float]:
    return some | {3: some[3] + 3e-4}


@pytest.mark.parametrize(("change", "since"), [(slipped, 12), (slipped_all_along, 0)])
def test_a_slip_that_is_gone_in_the_second_of_two_surveys_is_one_change(
    change: Callable[[int, dict[int, float]], dict[int, float]], since: int
) -> None:
    surveys = [survey(one, LIES) for one in (change, as_it_is)]
    network = align_survey(CFG, M1, surveys[1], PANELS, surveys[:1]).network
    assert network is not None
    (finding,) = network.network.findings
    assert finding.effect == Effect(EffectKind.OFFSET, 2, since, until=len(surveys[0]))
    assert finding.size == pytest.approx(3e-4, abs=4.0 * finding.sigma)
    assert network.network.suspects == ()
    assert " until survey 2 begins (noise as configured)" in sentence(network)
