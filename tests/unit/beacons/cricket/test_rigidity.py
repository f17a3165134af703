"""Rank and free directions before anything is estimated: chains, ladders, space, bodies, what is known, scale."""

from itertools import combinations

import numpy as np

from ccatp.beacons.cricket.map_fit import MapModel
from ccatp.beacons.cricket.range_network import RigidBody, components
from ccatp.beacons.cricket.rigidity import Freedom, find_fold_over, find_freedom, generic_state
from tests.unit.beacons.cricket.fields import ADJACENT, ALL, HEADS, ZIGZAG, FloatArray, Pairs, near_pairs, network_of

NOWHERE = np.full((6, 2), np.nan)
SURVEYED = NOWHERE.copy()
SURVEYED[0], SURVEYED[1, 1] = HEADS[0], HEADS[1, 1]


def freedom(pairs: Pairs, known_m: FloatArray | None = None, **options: bool) -> Freedom:
    model = MapModel(network_of(HEADS, pairs, known_m=known_m), **options)
    return find_freedom(model, generic_state(model, np.random.default_rng(0)))


def test_a_zigzag_turns_at_its_four_hinges() -> None:
    found = freedom(ZIGZAG, SURVEYED)
    assert (found.unknowns, found.rank, found.deficiency) == (9, 5, 4)
    assert found.frame == ()
    assert found.flexes == (
        "M2, M3, M4, M5 against M0, M1",
        "M3, M4, M5 against M0, M1",
        "M4, M5 against M0, M1",
        "M5 against M0, M1",
    )


def test_a_scale_is_taken_for_the_size_of_the_map() -> None:
    found = freedom(ALL, with_scale=True)
    assert found.deficiency == 1
    assert "range scale: the map takes it up" in found.lines
    assert found.flexes == ()
    assert freedom(ALL, with_offset=True).deficiency == 0
    known = NOWHERE.copy()
    known[:3] = HEADS[:3]
    assert freedom(ALL, known, with_scale=True).deficiency == 0


def test_shapes_of_stands_hold_what_ranges_do_not() -> None:
    local = np.array([[0.0, 0.0], [0.5, 0.0], [0.2, 0.4]])
    places = np.concatenate([local, local + np.array([5.0, 1.0])])
    pairs = [(0, 3), (1, 4), (2, 5)]
    bodies = [RigidBody("a", (0, 1, 2), local), RigidBody("b", (3, 4, 5), local)]
    without = MapModel(network_of(places, [(0, 3), (3, 1), (1, 4), (4, 2), (2, 5)]))
    rng = np.random.default_rng(0)
    assert find_freedom(without, generic_state(without, rng)).deficiency == 4
    with_shapes = MapModel(network_of(places, pairs, bodies=bodies))
    found = find_freedom(with_shapes, generic_state(with_shapes, rng))
    assert (found.unknowns, found.rank, found.deficiency) == (6, 3, 0)


def test_space_asks_for_more() -> None:
    rng = np.random.default_rng(1)
    places = rng.normal(size=(6, 3))
    model = MapModel(network_of(places, near_pairs(places, 99.0)))
    found = find_freedom(model, generic_state(model, rng))
    assert (found.deficiency, len(found.frame)) == (0, 6)
    assert found.frame[3:] == ("rotation 1", "rotation 2", "rotation 3")
    few = MapModel(network_of(places, [pair for pair in near_pairs(places, 99.0) if 5 not in pair] + [(0, 5), (1, 5)]))
    assert find_freedom(few, generic_state(few, rng)).flexes == ("M5 against M0, M1, M2, M3, M4",)


def test_motes_on_a_ceiling_move_across_it_unseen() -> None:
    """Generic places are rigid; those of a plane are not, to first order: an estimate there shows it."""
    rng = np.random.default_rng(2)
    places = np.column_stack([rng.uniform(0.0, 5.0, (6, 2)), np.full(6, 2.5)])
    model = MapModel(network_of(places, near_pairs(places, 99.0)))
    assert find_freedom(model, generic_state(model, rng)).deficiency == 0
    assert find_freedom(model, model.state(places)).deficiency == 3


def is_unique(places: FloatArray, pairs: Pairs) -> bool:
    return find_fold_over(network_of(places, pairs), np.random.default_rng(0)).is_unique


def test_nine_pairs_fold_at_every_pair_between() -> None:
    found = find_fold_over(network_of(HEADS, ADJACENT), np.random.default_rng(0))
    assert ((1, 2), (0,)) in found.mirrors
    assert ((3, 4), (5,)) in found.mirrors
    assert ((2, 3), (0, 1)) in found.mirrors or ((2, 3), (4, 5)) in found.mirrors
    assert "M0 may be mirrored across the line through M1, M2" in found.warnings


def test_a_prism_names_the_ranges_that_nothing_confirms() -> None:
    pairs = [(0, 1), (1, 2), (0, 2), (3, 4), (4, 5), (3, 5), (0, 3), (1, 4), (2, 5)]
    found = find_fold_over(network_of(HEADS, pairs), np.random.default_rng(0))
    assert found.mirrors == ()
    assert "ranges that nothing confirms, so that several maps may fit: M0 to M1" in found.warnings[0]


def test_space() -> None:
    places = np.random.default_rng(2).normal(size=(6, 3))
    complete = near_pairs(places, 99.0)
    assert is_unique(places, [pair for pair in complete if pair != (0, 1)])
    hanging = [pair for pair in complete if 5 not in pair or pair in ((0, 5), (1, 5), (2, 5))]
    found = find_fold_over(network_of(places, hanging), np.random.default_rng(0))
    assert found.mirrors == (((0, 1, 2), (5,)),)
    assert found.warnings == ("M5 may be mirrored across the plane through M0, M1, M2",)
    # the double banana: four-connected but for its two tips, and it turns about them
    banana = [(i, j) for i, j in combinations(range(5), 2) if (i, j) != (0, 1)]
    other = [(a + 3 if a > 1 else a, b + 3 if b > 1 else b) for a, b in banana]
    assert not is_unique(np.random.default_rng(3).normal(size=(8, 3)), [*banana, *other])


def test_bodies_and_known_places_count_as_measured() -> None:
    local = np.array([[0.0, 0.0], [0.5, 0.0], [0.2, 0.4]])
    places = np.concatenate([local, local + np.array([5.0, 1.0])])
    pairs = [(i, j) for i in range(3) for j in range(3, 6)]
    bodies = [RigidBody("a", (0, 1, 2), local), RigidBody("b", (3, 4, 5), local)]
    rng = np.random.default_rng(0)
    assert not find_fold_over(network_of(places, pairs), rng).is_unique
    assert find_fold_over(network_of(places, pairs, bodies=bodies), rng).is_unique
    known = np.full((6, 2), np.nan)
    known[:5] = HEADS[:5]
    assert find_fold_over(network_of(HEADS, [(0, 5), (1, 5), (3, 5)], known_m=known), rng).is_unique
    assert not find_fold_over(network_of(HEADS, [(0, 5), (1, 5)], known_m=known), rng).is_unique


def test_random_graphs_against_hendricksons_conditions() -> None:
    """In the plane: unique if and only if 3-connected and rigid without any one range (Jackson and Jordan 2005)."""
    rng = np.random.default_rng(5)
    seen = set()
    for _ in range(60):
        count = int(rng.integers(5, 9))
        pairs = [pair for pair in combinations(range(count), 2) if rng.random() < 0.62]
        if {mote for pair in pairs for mote in pair} != set(range(count)) or not connected(count, pairs, set()):
            continue
        places = rng.normal(size=(count, 2))
        three = all(connected(count, pairs, set(cut)) for cut in combinations(range(count), 2))
        spare = all(rank(places, [p for p in pairs if p != gone]) == 2 * count - 3 for gone in pairs)
        assert is_unique(places, pairs) == (three and spare)
        seen.add(three and spare)
    assert seen == {True, False}


def connected(count: int, pairs: Pairs, without: set[int]) -> bool:
    kept = np.array([pair for pair in pairs if not without & set(pair)]).reshape(-1, 2)
    return len(set(components(count, kept)[sorted(set(range(count)) - without)])) == 1


def rank(places: FloatArray, pairs: Pairs) -> int:
    rows = np.zeros((len(pairs), places.size))
    for row, (i, j) in enumerate(pairs):
        rows[row, 2 * i : 2 * i + 2] = places[i] - places[j]
        rows[row, 2 * j : 2 * j + 2] = places[j] - places[i]
    return int(np.linalg.matrix_rank(rows))
