"""Phase 2: the filter against the batch, repeats that teach nothing new, what is known, the stop, refusals."""

from typing import Any

import numpy as np
import pytest

from ccatp.beacons.config.load import load_radio_config
from ccatp.beacons.config.models import PhaseTwoConfig
from ccatp.beacons.cricket.map_fit import MapFitSettings, MapModel, fit_map
from ccatp.beacons.cricket.mote_plan import MotePlan, network_plan
from ccatp.beacons.cricket.range_network import (
    MappingError,
    MoteRange,
    RigidBody,
    TdoaError,
    build_network,
    coordinates_of,
    pair_range,
)
from ccatp.beacons.cricket.self_mapping import MoteMapper, complete_stands, conditioned, run_phase_two
from ccatp.beacons.cricket.trilateration import DegenerateStep, FirstMap, map_by_plan
from ccatp.beacons.sim.motes import true_motes
from ccatp.beacons.studies.mote_runs import first_map, simulate_field
from tests.unit.beacons.cricket.fields import (
    ADJACENT,
    ALL,
    HEADS,
    SIGMA_M,
    ZIGZAG,
    FloatArray,
    Pairs,
    names,
    near_pairs,
    network_of,
)

CRICKET = load_radio_config(None, {"system": "cricket"}).cricket
POOLED = CRICKET.phase2.model_copy(update={"linearisations": 10, "pools": True, "gate_probability": 1.0})
PRINTED = CRICKET.phase2.model_copy(update={"linearisations": 1, "pools": False, "gate_probability": 1.0})
KNOWN = np.full((6, 2), np.nan)
KNOWN[0], KNOWN[1, 1] = HEADS[0], HEADS[1, 1]


def readings(pairs: Pairs, times: int, rng: np.random.Generator | None) -> list[tuple[int, int, float, float]]:
    found = []
    for _ in range(times):
        for i, j in pairs:
            noise_m = 0.0 if rng is None else float(rng.normal(0.0, SIGMA_M))
            found.append((i, j, float(np.linalg.norm(HEADS[i] - HEADS[j])) + noise_m, SIGMA_M))
    return found


def mapper(start: FloatArray, settings: PhaseTwoConfig = POOLED, sigma_m: float = 0.2) -> MoteMapper:
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


def test_phase_two_stops_at_the_target() -> None:
    one = mapper(HEADS + 0.02)
    went = run_phase_two(one, readings(ALL, 40, np.random.default_rng(5)), 0.004)
    assert went.expected_rms_m[-1] <= 0.004 < went.expected_rms_m[-2]
    assert len(went.nis) == len(went.positions_m) - 1 < 600
    again = run_phase_two(mapper(HEADS), readings(ZIGZAG, 4, None), 0.004)
    assert again.expected_rms_m[-1] > 0.004


def test_a_range_out_of_all_proportion_is_refused() -> None:
    gated = POOLED.model_copy(update={"gate_probability": 0.9999})
    one = mapper(HEADS, gated, sigma_m=0.05)
    learned = one.observe(0, 5, 12.0, SIGMA_M)
    assert not learned.accepted
    assert one.positions_m == pytest.approx(HEADS)
    assert one.observe(0, 5, float(np.linalg.norm(HEADS[5] - HEADS[0])), SIGMA_M).accepted


def test_offset_and_scale_are_found_among_known_motes() -> None:
    both = CRICKET.batch.model_copy(update={"estimates_offset": True, "estimates_scale": True})
    one = MoteMapper(HEADS, np.zeros((12, 12)), POOLED, HEADS, both)
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


def test_refusals() -> None:
    with pytest.raises(MappingError, match=r"covariance of shape \(3, 3\) for 6 motes in 2 dimensions"):
        MoteMapper(HEADS, np.eye(3), POOLED)
    with pytest.raises(MappingError, match="a mote has no place to begin with"):
        MoteMapper(KNOWN, np.eye(12), POOLED)
    one = MoteMapper(np.zeros((2, 2)), np.eye(4), POOLED)
    with pytest.raises(MappingError, match="motes 0 and 1 stand in one place"):
        one.observe(0, 1, 1.0, 0.1)


PLAN = network_plan(CRICKET)
TRUE_M = true_motes(CRICKET, np.random.default_rng(0)).positions_m


def test_the_plan_of_the_paper() -> None:
    assert len(PLAN.names) == 20
    assert PLAN.names[:4] == ("A", "B", "N1-1", "N1-2")
    assert [PLAN.names[mote] for mote in PLAN.heads] == [f"N{number}-1" for number in range(1, 7)]
    # A to B, both to three motes, 45 between stands
    assert len(PLAN.phase1_pairs) == 1 + 6 + 45
    assert np.isfinite(PLAN.surveyed_m).sum() == 3
    assert PLAN.mapped == tuple(range(2, 20))


def test_errors_of_a_stands_turn_reach_its_other_motes() -> None:
    rng, sigma_m, found = np.random.default_rng(1), 0.01, []
    heads, covariance = list(PLAN.heads), np.zeros((36, 36))
    for _ in range(400):
        first_m = TRUE_M + rng.normal(0.0, sigma_m, TRUE_M.shape)
        first = FirstMap(first_m, np.eye(40) * sigma_m**2, np.zeros((20, 2)))
        heads_m = TRUE_M[heads] + rng.normal(0.0, 0.002, (6, 2))
        whole = complete_stands(PLAN, first, MoteMapper(heads_m, np.eye(12) * 0.002**2, POOLED))
        found.append((whole.positions_m - TRUE_M[list(whole.motes)]).ravel())
        covariance = whole.covariance_m2
    sample = np.cov(np.array(found).T)
    # 400 runs: a standard deviation is known to 4 %
    assert np.sqrt(sample.diagonal()) == pytest.approx(np.sqrt(covariance.diagonal()), rel=0.15)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(0.002)
    assert np.sqrt(covariance[2:6, 2:6].trace()) > 2.0 * 0.002


def ranged(delays_s: list[float], temperature_c: float = 20.0, **ranging: Any) -> MoteRange:
    cfg = CRICKET.model_copy(update={"ranging": CRICKET.ranging.model_copy(update=ranging)})
    return pair_range(cfg, ("A", "B"), delays_s, temperature_c)


def test_ranges_from_delays() -> None:
    assert ranged([0.006]).range_m == pytest.approx(2.064, abs=1e-12)  # the printed example
    # an ideal gas: c(0 C) = 344 sqrt(273.15 / 293.15)
    assert ranged([1.0], 0.0).range_m == pytest.approx(332.06, abs=0.01)
    assert ranged([0.001, 0.002, 0.009], combine="median").range_m == pytest.approx(0.688)
    assert ranged([0.01] * 9, sigma_m=0.006).sigma_m == pytest.approx(0.002)
    # one kelvin of 293.15: half a part in 293, however often it is repeated
    warm = ranged([0.01] * 90, sigma_m=1e-6, thermometer_sigma_c=1.0)
    assert warm.sigma_m == pytest.approx(3.44 / (2.0 * 293.15), rel=1e-4)


def row(first: str, second: str, range_m: float = 1.0, sigma_m: float = 0.01) -> MoteRange:
    return MoteRange(first, second, range_m, sigma_m)


A_TO_B = "range A to B: "
REFUSALS: list[tuple[list[MoteRange], str]] = [
    ([row("A", "X")], "range A to X: no mote 'X'; there are A, B"),
    ([row("A", "B", -0.1)], f"{A_TO_B}-0.1 m is no distance"),
    ([row("A", "B", float("nan"))], f"{A_TO_B}nan m is no distance"),
    ([row("A", "B", 1.0, 0.0)], f"{A_TO_B}sigma of 0 m, must be positive"),
    ([row("A", "A")], "from a mote to itself"),
    ([], "0 ranges among 2 motes"),
]


@pytest.mark.parametrize(("rows", "what"), REFUSALS, ids=[what for _, what in REFUSALS])
def test_ranges_of_no_network(rows: list[MoteRange], what: str) -> None:
    with pytest.raises(MappingError, match=what):
        build_network(rows, 2, ["A", "B"])


@pytest.mark.parametrize(
    ("delay_s", "temperature_c", "what"),
    [
        *((delay_s, 20.0, "cannot arrive before the message") for delay_s in (-1e-6, float("inf"), float("nan"))),
        (0.006, 851.0, "temperature of 851 C is outside"),
    ],
)
def test_delays_of_no_range(delay_s: float, temperature_c: float, what: str) -> None:
    with pytest.raises(TdoaError, match=what):
        ranged([delay_s], temperature_c)


def test_parts_that_hang_on_known_places_are_no_error() -> None:
    known = np.array([[0.0, 0.0], [1.0, 0.0], [np.nan, np.nan], [0.0, 5.0], [1.0, 5.0], [np.nan, np.nan]])
    rows = [row("a", "c"), row("b", "c"), row("d", "f")]
    assert build_network(rows, 2, list("abcdef"), (), known).count == 6
    known[3] = np.nan
    with pytest.raises(MappingError, match="into 2 parts with no range between them: d, f on one side"):
        build_network(rows, 2, list("abcdef"), (), known)


# -- phase 1 -----------------------------------------------------------------------------------------------------------


A, B = np.zeros(2), np.array([0.0, 2.0])
LINE = [[1.0, 0.5], [1.0, 1.0], [1.0, 1.5]]


def first_map_of(places: FloatArray, pairs: Pairs, rng: np.random.Generator | None = None, draws: int = 0) -> FirstMap:
    """A and B, a stand of three motes or fewer, and one mote that it places."""
    count, stands = len(places), [tuple(range(2, min(len(places), 5))), *([(5,)] if len(places) > 5 else [])]
    bodies = tuple(RigidBody(f"N{motes[0]}", motes, places[list(motes)]) for motes in stands)
    plan = MotePlan(names(count), 2, (0, 1), bodies, np.array([A, B]), (), (), np.full_like(places, np.nan))
    return map_by_plan(plan, network_of(places, pairs, rng, sigma_m=1e-3), 60.0, draws)


def test_joint_errors_of_cosines_and_trilateration() -> None:
    places = np.array([A, B, [1.0, 1.0], [1.4, 1.3], [1.4, 0.7], [4.0, 1.5]])
    rng, pairs = np.random.default_rng(1), near_pairs(places, 1e3)
    sample = np.cov(np.array([first_map_of(places, pairs, rng).positions_m.ravel() for _ in range(300)]).T)
    _, covariance, bias, _ = first_map_of(places, pairs, draws=2000)
    assert bias == pytest.approx(np.zeros((6, 2)), abs=1e-3)
    spread = np.sqrt(covariance.diagonal())
    at = spread > 1e-9  # the origin and B's x are exact
    assert np.flatnonzero(~at).tolist() == [0, 1, 2]
    assert np.sqrt(sample.diagonal())[at] == pytest.approx(spread[at], rel=0.13)  # 300 runs: 4 %
    # correlations too: what a mote inherits from B and from its references
    scale = np.outer(spread[at], spread[at])
    assert (sample[np.ix_(at, at)] / scale) == pytest.approx(covariance[np.ix_(at, at)] / scale, abs=0.25)


@pytest.mark.parametrize(
    ("more", "what"),
    [
        ([[0.0, 1.0]], r"M2: ranges of 1.000 and 1.000 m to M0 and M1, 2.000 m apart, meet on"),
        ([[0.01, 1.0]], r"M2 from M0, M1: dilution of precision \d+(\.\d+)? exceeds 60"),
        ([*LINE, [9.0, 1.0]], "M5 from M2, M3, M4: the mirror image across them, 16 m away"),
        ([*LINE, [1.0, 9.0]], r"M5 from M2, M3, M4: .*(undetermined|dilution)"),
    ],
)
def test_motes_that_no_step_determines_are_refused(more: list[list[float]], what: str) -> None:
    places = np.array([A, B, *more])
    with pytest.raises(DegenerateStep, match=what):
        first_map_of(places, near_pairs(places, 1e3))


def test_a_missing_range_names_both_motes() -> None:
    with pytest.raises(MappingError, match="no range between M1 and M2"):
        first_map_of(np.array([A, B, [1.0, 1.0]]), [(0, 1), (0, 2)])


def test_exact_ranges_give_the_field_in_its_frame() -> None:
    network = network_of(TRUE_M, PLAN.phase1_pairs)
    # three motes 0.5 m apart, 5 to 6 m away: dilutions of precision of some 14 to 20
    assert map_by_plan(PLAN, network, 25.0).positions_m == pytest.approx(TRUE_M, abs=1e-6)
    with pytest.raises(DegenerateStep, match=r"dilution of precision 1\d\.\d+ exceeds 10"):
        map_by_plan(PLAN, network, 10.0)


DRAWS = 800


def after_phase_one(seeds: range, *, with_expected: bool = False) -> tuple[FloatArray, FloatArray]:
    """NEES of each field by degree of freedom, and what errors drawn at the found map alone make it on the average.

    What is known exactly does not count. With the covariance P that is reported, and errors of covariance C about a
    mean that is d off, the expectation is (tr(P^-1 C) + d^T P^-1 d) / dof, whatever their distribution.
    """
    squares, expected = [], []
    for seed in seeds:
        field = simulate_field(CRICKET, seed)
        motes = list(field.plan.heads)
        at, known = coordinates_of(motes, 2), field.plan.surveyed_m[motes].ravel()

        def prior(found: FirstMap) -> tuple[FloatArray, FloatArray]:
            mean = (found.positions_m + found.bias_m)[motes].ravel()  # noqa: B023
            return conditioned(mean, found.covariance_m2[np.ix_(at, at)], known)  # noqa: B023

        mean, covariance = prior(first_map(CRICKET, field, DRAWS))
        variances, axes = np.linalg.eigh(covariance)
        free = variances > 1e-14
        whitening = axes[:, free] / np.sqrt(variances[free])
        squares.append(float((((mean - field.true_m[motes].ravel()) @ whitening) ** 2).mean()))
        if with_expected:
            alone = map_by_plan(field.plan, field.network(), CRICKET.phase1.max_dop, DRAWS, maps=0)
            likely, spread = prior(alone)
            seen = np.einsum("ij,ik,kj->j", whitening, spread, whitening) + ((likely - mean) @ whitening) ** 2
            expected.append(float(seen.mean()))
    return np.array(squares), np.array(expected)


def test_phase_one_knows_how_good_it_is() -> None:
    assert after_phase_one(range(10))[0].mean() < 1.4  # 90 degrees of freedom: 1.0 within 0.30


@pytest.mark.slow
def test_nees_of_phase_one_over_100_fields() -> None:
    """The covariance is that of errors at maps near the found one, which are turned one way and the other.

    Across the arcs along which the errors lie it is wider than that of the errors there are, so NEES is less than 1:
    by as much as the errors at the found map alone make expected. The nine coordinates of a field are bent and not
    Gaussian, so the band is that of the mean of 100 fields by their own spread, 99 %, and not chi-squared of 900.
    """
    squares, expected = after_phase_one(range(100), with_expected=True)
    off = squares - expected
    assert abs(off.mean()) < 2.58 * off.std(ddof=1) / np.sqrt(len(off))
    assert expected.mean() < 1.0  # it never promises more than there is
