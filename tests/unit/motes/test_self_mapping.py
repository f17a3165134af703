"""Phase 2: the filter against the batch, repeats that teach nothing new, what is known, the stop, refusals."""

import numpy as np
import pytest

from ccatp.beacons.cricket.map_fit import MapFitSettings, MapModel, fit_map
from ccatp.beacons.cricket.range_network import MappingError
from ccatp.beacons.cricket.self_mapping import MapperSettings, MoteMapper, conditioned, printed_prior, run_phase_two
from tests.unit.motes.fields import ADJACENT, ALL, HEADS, SIGMA_M, ZIGZAG, FloatArray, Pairs, network_of

POOLED = MapperSettings(linearisations=10, pools=True, gate_probability=1.0, target_rms_m=0.0)
PRINTED = MapperSettings(linearisations=1, pools=False, gate_probability=1.0, target_rms_m=0.0)
KNOWN = np.full((6, 2), np.nan)
KNOWN[0], KNOWN[1, 1] = HEADS[0], HEADS[1, 1]


def readings(pairs: Pairs, times: int, rng: np.random.Generator | None) -> list[tuple[int, int, float, float]]:
    found = []
    for _ in range(times):
        for i, j in pairs:
            noise_m = 0.0 if rng is None else float(rng.normal(0.0, SIGMA_M))
            found.append((i, j, float(np.linalg.norm(HEADS[i] - HEADS[j])) + noise_m, SIGMA_M))
    return found


def mapper(start: FloatArray, settings: MapperSettings = POOLED, sigma_m: float = 0.2) -> MoteMapper:
    return MoteMapper(start, np.eye(12) * sigma_m**2, settings, KNOWN)


def test_the_filter_ends_where_the_batch_does() -> None:
    rng = np.random.default_rng(1)
    rows = readings(ALL, 4, rng)
    start = HEADS + rng.normal(0.0, 0.1, HEADS.shape)
    filtered = mapper(start, sigma_m=10.0)  # so wide that it counts for nothing
    run_phase_two(filtered, rows, 0.0)
    network = network_of(HEADS, [row[:2] for row in rows], known_m=KNOWN)
    network.ranges_m[:] = [row[2] for row in rows]
    model = MapModel(network)
    batch = fit_map(model, model.state(start), MapFitSettings())
    assert filtered.positions_m == pytest.approx(batch.state.positions_m, abs=1e-5)  # of the wide prior


def test_the_order_of_pairs_does_not_matter() -> None:
    rng = np.random.default_rng(2)
    rows = readings(ADJACENT, 3, rng)
    one, other = mapper(HEADS + 0.05), mapper(HEADS + 0.05)
    run_phase_two(one, rows, 0.0)
    run_phase_two(other, [rows[at] for at in rng.permutation(len(rows))], 0.0)
    assert one.positions_m == pytest.approx(other.positions_m, abs=1e-6)
    assert one.covariance_m2 == pytest.approx(other.covariance_m2, rel=1e-4, abs=1e-12)


def test_repeats_of_few_pairs_teach_their_lengths_alone() -> None:
    """Five pairs see five of nine directions; a filter that linearises each anew believes in all nine."""
    rng = np.random.default_rng(3)
    start = HEADS + rng.normal(0.0, 0.2, HEADS.shape)
    pooled, printed = mapper(start), mapper(start, PRINTED)
    for one in (pooled, printed):
        run_phase_two(one, readings(ZIGZAG, 60, rng), 0.0)
    free = np.linalg.eigvalsh(pooled.covariance_m2)[-4:]
    assert np.sqrt(free) == pytest.approx(np.full(4, 0.2), rel=1e-6)  # the prior, untouched in the other four
    assert np.sqrt(np.linalg.eigvalsh(printed.covariance_m2)[-4:]).min() < 0.15


def test_what_is_known_stays() -> None:
    one = mapper(HEADS + 0.3)
    run_phase_two(one, readings(ALL, 5, np.random.default_rng(4)), 0.0)
    assert one.positions_m[0].tolist() == HEADS[0].tolist()
    assert one.positions_m[1, 1] == HEADS[1, 1]
    assert one.covariance_m2[:2].any() == one.covariance_m2[3].any() == False  # noqa: E712


def test_knowing_moves_what_hangs_together() -> None:
    covariance = np.array([[4.0, 3.0], [3.0, 4.0]])
    mean, after = conditioned(np.zeros(2), covariance, np.array([1.0, np.nan]))
    assert mean == pytest.approx([1.0, 0.75])
    assert after == pytest.approx(np.array([[0.0, 0.0], [0.0, 4.0 - 9.0 / 4.0]]))


def test_phase_two_stops_at_the_target() -> None:
    one = mapper(HEADS + 0.02)
    went = run_phase_two(one, readings(ALL, 40, np.random.default_rng(5)), 0.004)
    assert went.reached
    assert went.expected_rms_m[-1] <= 0.004 < went.expected_rms_m[-2]
    assert len(went.nis) == len(went.positions_m) - 1 < 600
    again = run_phase_two(mapper(HEADS), readings(ZIGZAG, 4, None), 0.004)
    assert not again.reached


def test_a_range_out_of_all_proportion_is_refused() -> None:
    gated = POOLED._replace(gate_probability=0.9999)
    one = mapper(HEADS, gated, sigma_m=0.05)
    learned = one.observe(0, 5, 12.0, SIGMA_M)
    assert not learned.accepted
    assert one.positions_m == pytest.approx(HEADS)
    assert one.observe(0, 5, float(np.linalg.norm(HEADS[5] - HEADS[0])), SIGMA_M).accepted


def test_offset_and_scale_are_found_among_known_motes() -> None:
    settings = POOLED._replace(offset_sigma_m=0.5, scale_sigma=0.05)
    one = MoteMapper(HEADS, np.zeros((12, 12)), settings, HEADS)
    for i, j, range_m, sigma_m in readings(ALL, 1, None):
        one.observe(i, j, 1.02 * range_m + 0.1, sigma_m)
    assert one.offset_m == pytest.approx(0.1, abs=1e-3)
    assert one.scale == pytest.approx(0.02, abs=1e-4)


def test_consistency_over_runs() -> None:
    """NEES of nine coordinates over 60 runs: mean 9, of standard deviation sqrt(18 / 60)."""
    rng, nees, nis = np.random.default_rng(6), [], []
    free = np.isnan(KNOWN.ravel())
    for _ in range(60):
        start = HEADS + np.where(np.isnan(KNOWN), rng.normal(0.0, 0.1, HEADS.shape), 0.0)
        one = mapper(start, sigma_m=0.1)
        went = run_phase_two(one, readings(ADJACENT, 2, rng), 0.0)
        error = (one.positions_m - HEADS).ravel()[free]
        nees.append(error @ np.linalg.solve(one.covariance_m2[np.ix_(free, free)], error))
        nis.append(went.nis.mean())
    assert np.mean(nees) == pytest.approx(9.0, abs=1.65)  # three standard deviations
    assert np.mean(nis) == pytest.approx(1.0, abs=0.1)


def test_the_printed_prior() -> None:
    prior = printed_prior(6, 2, [0, 1, 3], 99.0)
    assert prior.diagonal().tolist() == [0.0, 0.0, 99.0, 0.0, *[99.0] * 8]
    assert np.count_nonzero(prior) == 9


def test_refusals() -> None:
    with pytest.raises(MappingError, match=r"covariance of shape \(3, 3\) for 6 motes in 2 dimensions"):
        MoteMapper(HEADS, np.eye(3), POOLED)
    with pytest.raises(MappingError, match="a mote has no place to begin with"):
        MoteMapper(KNOWN, np.eye(12), POOLED)
    one = MoteMapper(np.zeros((2, 2)), np.eye(4), POOLED)
    with pytest.raises(MappingError, match="motes 0 and 1 stand in one place"):
        one.observe(0, 1, 1.0, 0.1)
