"""Levels to ranges and back; calibration against numbers drawn from a known model."""

import numpy as np
import pytest

from ccatp.beacons.slam.path_loss import LevelPair, PathLoss, PathLossError, fit_path_loss


def test_printed_ranges_of_2017_come_out() -> None:
    model = PathLoss(-33.0, 2.0, 2.0)
    printed = [(-23.0, 0.3162), (-33.103, 1.0119), (-38.308, 1.8425), (-41.974, 2.81)]
    for level_dbm, range_m in printed:
        assert model.median_range_m(level_dbm) == pytest.approx(range_m, abs=6e-4)


def test_range_is_without_bias_and_as_sure_as_it_says() -> None:
    model = PathLoss(-40.0, 2.0, 5.0)
    levels = model.level_dbm(3.0) + 5.0 * np.random.default_rng(1).standard_normal(20000)
    ranges = np.array([model.range_from(level).range_m for level in levels.tolist()])
    medians = np.array([model.median_range_m(level) for level in levels.tolist()])
    assert np.mean(ranges) == pytest.approx(3.0, abs=0.05)
    assert np.mean(medians) > 3.4  # exp(s^2 / 2) too long
    longer_m = 3.0 * np.exp(0.5 * model.log_sigma**2)  # the level whose estimate is 3 m
    assert np.std(ranges) == pytest.approx(model.range_from(model.level_dbm(longer_m)).sigma_m, rel=0.05)


def test_a_mean_of_levels_has_less_bias_and_spread() -> None:
    model = PathLoss(-40.0, 2.0, 5.0)
    one, many = model.range_from(-50.0), model.range_from(-50.0, 100)
    assert many.sigma_m == pytest.approx(one.sigma_m / 10.0, rel=0.25)
    assert many.range_m == pytest.approx(model.median_range_m(-50.0), rel=0.01)


def test_what_has_no_range_is_refused() -> None:
    model = PathLoss(-40.0, 2.0, 5.0)
    with pytest.raises(ValueError, match="must be positive"):
        model.level_dbm(0.0)
    with pytest.raises(ValueError, match="give at least one"):
        model.range_from(-50.0, 0)


def drawn(seed: int, places: int, repeats: int, static_db: float, white_db: float) -> list[LevelPair]:
    rng = np.random.default_rng(seed)
    found = []
    for distance_m in np.geomspace(0.3, 6.0, places).tolist():
        level = -45.0 - 25.0 * np.log10(distance_m) + static_db * rng.standard_normal()
        found += [LevelPair(distance_m, level + white_db * rng.standard_normal()) for _ in range(repeats)]
    return found


def test_exact_pairs_give_the_model_back() -> None:
    fit = fit_path_loss(drawn(0, 6, 1, 0.0, 0.0))
    assert fit.reference_dbm == pytest.approx(-45.0)
    assert fit.exponent == pytest.approx(2.5)
    assert fit.sigma_db == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(fit.white_sigma_db)


def test_confidence_intervals_hold_what_they_promise() -> None:
    inside = np.zeros(3)
    for seed in range(300):
        fit = fit_path_loss(drawn(seed, 8, 1, 4.0, 0.0))
        reference, exponent = fit.half_widths(0.9)
        low, high = fit.sigma_interval_db(0.9)
        inside += abs(fit.reference_dbm + 45.0) < reference, abs(fit.exponent - 2.5) < exponent, low < 4.0 < high
    assert inside / 300 == pytest.approx(0.9, abs=0.055)  # 3.2 sigma of 300 trials


def test_repeated_readings_tell_white_from_static() -> None:
    fit = fit_path_loss(drawn(3, 40, 30, 4.0, 1.5))
    assert fit.white_sigma_db == pytest.approx(1.5, rel=0.05)
    assert fit.shadowing_sigma_db == pytest.approx(4.0, rel=0.3)
    once = fit_path_loss(drawn(3, 40, 1, 4.0, 1.5))
    assert fit.sigma_db == pytest.approx(once.sigma_db, rel=0.3)  # thirty readings of a place are one witness


def test_places_at_the_same_distance_stay_places() -> None:
    pairs = [LevelPair(d, -45.0 - d + s, (d, s)) for d in (1.0, 2.0, 4.0) for s in (-1.0, 1.0)]
    assert fit_path_loss(pairs).places == 6
    assert fit_path_loss([LevelPair(*pair[:2]) for pair in pairs]).places == 3


def test_doubts_are_told() -> None:
    good = drawn(1, 12, 1, 0.5, 0.0)
    assert fit_path_loss(good).doubts() == []
    off = [*good[:-1], LevelPair(good[-1].distance_m, good[-1].level_dbm + 20.0)]
    assert any("off the line" in doubt for doubt in fit_path_loss(off).doubts())
    flat = [LevelPair(d, -60.0 - 0.5 * d) for d in (1.0, 2.0, 3.0, 4.0)]
    assert any("is outside 1 to 6" in doubt for doubt in fit_path_loss(flat).doubts())
    far = [LevelPair(100.0 * pair.distance_m, pair.level_dbm) for pair in good]
    assert any("is above -10 dBm" in doubt and "in metres" in doubt for doubt in fit_path_loss(far).doubts())
    line = [LevelPair(r, -40.0 - 20.0 * np.log10(r)) for r in (1.0, 2.0, 4.0, 8.0)]
    assert any("on a line exactly" in doubt for doubt in fit_path_loss(line).doubts())


@pytest.mark.parametrize("slope_db_m", [0.0, 5.0])
def test_levels_that_do_not_fall_are_no_path_loss(slope_db_m: float) -> None:
    with pytest.raises(PathLossError, match="levels do not fall with distance"):
        fit_path_loss([LevelPair(d, -60.0 + slope_db_m * d) for d in (1.0, 2.0, 3.0, 4.0)])


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([(1.0, -40.0), (2.0, -46.0), (2.0, -47.0)], "2 different distances, at least 3 needed"),
        ([(1.0, -40.0), (0.0, -46.0), (2.0, -47.0)], "pair of 0 m and -46 dBm cannot be used"),
        ([(1.0, -40.0), (3.0, float("nan")), (2.0, -47.0)], "cannot be used"),
    ],
)
def test_pairs_without_a_path_loss_are_refused(pairs: list[tuple[float, float]], message: str) -> None:
    with pytest.raises(PathLossError, match=message):
        fit_path_loss(LevelPair(*pair) for pair in pairs)
