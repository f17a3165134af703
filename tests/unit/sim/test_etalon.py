"""The simulated laser metrology."""

import msgspec
import numpy as np
import pytest
from scipy import stats

from ccatp.config.models import SimEtalonConfig
from ccatp.sim.laser import EtalonModel, PuckTruth

CHANNELS = (1, 2, 5, 9)
COLLIMATORS = np.array([[0.0, 0.0, 10.0], [3.0, 0.0, 9.0], [0.0, 4.0, 8.0], [-3.0, -4.0, 12.0]])
PUCK = PuckTruth(t_s=12.5, position_m=(0.1, -0.2, 0.3), moved_m=0.0)
CFG = SimEtalonConfig(host="127.0.0.1", port=0, length_sigma_m=1e-6, length_sigma_per_m=2.5e-7, motion_tolerance_m=1e-4)
QUIET = CFG.model_copy(update={"length_sigma_m": 0.0, "length_sigma_per_m": 0.0})


def model(cfg: SimEtalonConfig = CFG, seed: int = 1) -> EtalonModel:
    return EtalonModel(cfg, CHANNELS, COLLIMATORS, np.random.default_rng(seed))


def test_lengths_without_noise_are_the_distances_in_the_order_asked() -> None:
    records = model(QUIET).records((9, 1), PUCK)
    assert [record.channel for record in records] == [9, 1]
    expected = [1e3 * float(np.linalg.norm(COLLIMATORS[i] - PUCK.position_m)) for i in (3, 0)]
    assert [record.length_mm for record in records] == pytest.approx(expected, abs=5e-7)  # rounded to 1e-6 mm
    assert all(not record.errors for record in records)


def test_noise_is_normal_with_the_configured_sigma_per_channel() -> None:
    lengths_m = np.linalg.norm(COLLIMATORS - PUCK.position_m, axis=1)
    sigmas_m = 1e-6 + 2.5e-7 * lengths_m
    etalon = model()
    draws = np.array(
        [
            [r.length_mm * 1e-3 for r in etalon.records(CHANNELS, msgspec.structs.replace(PUCK, t_s=0.01 * k))]
            for k in range(500)
        ]
    )
    normalised = ((draws - lengths_m) / sigmas_m).ravel()
    # Kolmogorov-Smirnov of 2000 draws; the seed is fixed, so this is a check of the code and not of luck.
    assert stats.kstest(normalised, "norm").pvalue > 0.01
    # Channels are independent: correlations of 500 pairs stay within 4.5/sqrt(500).
    correlations = np.corrcoef((draws - lengths_m).T)[np.triu_indices(4, 1)]
    assert np.all(np.abs(correlations) < 0.2)


def test_noise_belongs_to_seed_time_and_channel_and_to_nothing_else() -> None:
    first = model()
    reference = first.records(CHANNELS, PUCK)
    other = model()
    other.records(CHANNELS, msgspec.structs.replace(PUCK, t_s=3.0))
    assert other.records(CHANNELS[::-1], PUCK) == reference[::-1]
    assert (
        first.records(CHANNELS[2:], msgspec.structs.replace(PUCK, t_s=PUCK.t_s + 4e-7)) == reference[2:]
    )  # less than half a us
    assert first.records(CHANNELS, msgspec.structs.replace(PUCK, t_s=PUCK.t_s + 1e-6)) != reference
    assert model(seed=2).records(CHANNELS, PUCK) != reference


def test_a_blocked_channel_has_no_length_no_light_and_beam_break() -> None:
    etalon = model()
    etalon.blocked = {2}
    blocked = etalon.records(CHANNELS, PUCK)[1]
    assert blocked.errors == ("beam_break",)
    assert (blocked.length_mm, blocked.intensity_min, blocked.intensity_max) == (0.0, 0, 0)


def test_channels_and_collimators_must_fit() -> None:
    assert model().channels == CHANNELS
    with pytest.raises(ValueError, match=r"3 channels, collimators of shape \(4, 3\)"):
        EtalonModel(CFG, (1, 2, 3), COLLIMATORS, np.random.default_rng(1))
